"""Distances of linkages from singular positions, and where they are smallest."""

from __future__ import annotations

import math

import numpy as np
import pytest

from eomc import pipeline
from eomc.base import resources
from eomc.mechanism import ranks
from eomc.mechanism.assembly import assembled
from eomc.mechanism.ranks import ClosestSingularity, closest_singularity
from eomc.model.system import System, from_scene
from eomc.scene.read import parse

PARALLELOGRAM = """
eomc = 1
name = "parallelogram"
[coordinates]
A = { unit = "rad", start = 0.5 }
B = { unit = "rad", start = 0.0, guess = true }
C = { unit = "rad", start = 0.5, guess = true }
[energy]
kinetic = "(A_dot**2 + B_dot**2 + C_dot**2)/2"
[constraints]
x = "cos(A) + 2*cos(B) - cos(C) - 2"
y = "sin(A) + 2*sin(B) - sin(C)"
"""


def assembled_from(text: str) -> System:
    return assembled(from_scene(parse(text)))


def singularity_of(name: str) -> ClosestSingularity | None:
    return closest_singularity(pipeline.read(resources.scenes()[name]))


@pytest.fixture(scope="module")
def flat() -> ClosestSingularity | None:
    return closest_singularity(assembled_from(PARALLELOGRAM))


def test_flat_parallelogram_is_singular(flat: ClosestSingularity | None) -> None:
    """One of its rows has no gradient there; each row by itself would look regular."""
    assert flat == ClosestSingularity(0.0, {"A": 0.0, "B": 0.0, "C": 0.0})
    assert str(flat) == "  smallest sigma_min/sigma_max along the motion 0: A = 0, B = 0, C = 0"


def test_four_bar_agrees_with_a_grid_of_crank_angles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bars of 1, 3, 2.5 and 3.2 m with unit inertia each, closed by trigonometry."""
    # in both directions, by a tenth of a radian, over the full circle
    monkeypatch.setattr(ranks, "MAX_CONFIGURATIONS", 50)
    text = PARALLELOGRAM.replace("2*cos(B) - cos(C) - 2", "3*cos(B) - 2.5*cos(C) - 3.2")
    text = text.replace("2*sin(B) - sin(C)", "3*sin(B) - 2.5*sin(C)")
    result = closest_singularity(assembled_from(text.replace("start = 0.0, g", "start = 0.8, g")))
    q1 = np.linspace(0, math.tau, 20_001)
    x, y = 3.2 - np.cos(q1), -np.sin(q1)
    wide = np.arccos((9 + x**2 + y**2 - 6.25) / (6 * np.hypot(x, y)))
    q2 = np.arctan2(y, x) + wide
    q3 = np.arctan2(3 * np.sin(q2) - y, 3 * np.cos(q2) - x)
    A = np.array([
        [-np.sin(q1), -3 * np.sin(q2), 2.5 * np.sin(q3)],
        [np.cos(q1), 3 * np.cos(q2), -2.5 * np.cos(q3)],
    ]).transpose(2, 0, 1)  # fmt: skip
    A /= np.linalg.norm(A, axis=2).max(axis=0)[:, None]
    sizes = np.linalg.svd(A, compute_uv=False)
    ratio = sizes[:, 1] / sizes[:, 0]
    best = int(np.argmin(ratio))
    assert result is not None
    # the largest gradients are of positions
    assert result.sigma == pytest.approx(ratio[best], rel=1e-3)
    # its mirror image is the other branch
    at, expected = np.array(list(result.q.values())), np.array([q1[best], q2[best], q3[best]])
    errors = [np.remainder(sign * at - expected + 1, math.tau) - 1 for sign in (1, -1)]
    assert min(np.max(np.abs(x)) for x in errors) < 0.03


@pytest.mark.parametrize("row", ["sin(A) - sin(C) + t/100", "dot(A) - dot(C)*cos(B)"])
def test_no_singularity_is_reported_for_rows_in_time_or_velocities(row: str) -> None:
    text = PARALLELOGRAM[: PARALLELOGRAM.index("x =")] + f'x = "B"\ny = "{row}"\n'
    assert (
        closest_singularity(assembled_from(text.replace("start = 0.5, g", "start = 0.4, g")))
        is None
    )


def test_no_singularity_is_reported_for_several_degrees_of_freedom() -> None:
    assert singularity_of("delta_robot") is None


def test_row_without_a_gradient_is_not_scaled(flat: ClosestSingularity | None) -> None:
    """A row that a parameter switches off once gave 0/0 and a traceback."""
    text = PARALLELOGRAM.replace('y = "sin(A)', 'off = "k*(B - 0.1)"\ny = "sin(A)')
    result = closest_singularity(
        assembled_from(text.replace("[energy]", "[parameters]\nk = 0.0\n[energy]"))
    )
    assert result == flat
