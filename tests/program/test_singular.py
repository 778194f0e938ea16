"""How near linkages come to singular positions, and where."""

from __future__ import annotations

import math

import numpy as np
import pytest

from eomc import pipeline
from eomc.base import resources
from eomc.model.from_scene import from_scene
from eomc.model.system import System
from eomc.program import ranks
from eomc.program.assembly import assembled
from eomc.program.ranks import ClosestSingularity, closest_singularity
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


def made(text: str) -> System:
    return assembled(from_scene(parse(text)))


def of(name: str) -> ClosestSingularity | None:
    return closest_singularity(pipeline.read(resources.scenes()[name]))


@pytest.fixture(scope="module")
def flat() -> ClosestSingularity | None:
    return closest_singularity(made(PARALLELOGRAM))


def test_a_parallelogram_lies_flat(flat: ClosestSingularity | None) -> None:
    """Where one of its rows has no slope: each row by itself would look as good as ever."""
    assert flat == ClosestSingularity(0.0, {"A": 0.0, "B": 0.0, "C": 0.0})
    assert str(flat) == "  sigma_min/sigma_max 0 at the worst on its way: A = 0, B = 0, C = 0"


def test_a_four_bar_is_as_near_as_a_grid_of_crank_angles_finds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bars of 1, 3, 2.5 and 3.2 m, of unit inertia each: closed by the angles of triangles."""
    monkeypatch.setattr(
        ranks, "MAX_CONFIGURATIONS", 50
    )  # either way: of a tenth of a radian, all round
    text = PARALLELOGRAM.replace("2*cos(B) - cos(C) - 2", "3*cos(B) - 2.5*cos(C) - 3.2")
    text = text.replace("2*sin(B) - sin(C)", "3*sin(B) - 2.5*sin(C)")
    found = closest_singularity(made(text.replace("start = 0.0, g", "start = 0.8, g")))
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
    assert found is not None
    assert found.sigma == pytest.approx(ratio[best], rel=1e-3)  # the largest slopes are of places
    # it has a mirror image: the other branch
    at, right = np.array(list(found.q.values())), np.array([q1[best], q2[best], q3[best]])
    off = [np.remainder(sign * at - right + 1, math.tau) - 1 for sign in (1, -1)]
    assert min(np.max(np.abs(x)) for x in off) < 0.03


@pytest.mark.parametrize("row", ["sin(A) - sin(C) + t/100", "dot(A) - dot(C)*cos(B)"])
def test_none_is_told_of_rows_in_time_or_of_rates(row: str) -> None:
    text = PARALLELOGRAM[: PARALLELOGRAM.index("x =")] + f'x = "B"\ny = "{row}"\n'
    assert closest_singularity(made(text.replace("start = 0.5, g", "start = 0.4, g"))) is None


def test_none_is_told_of_several_freedoms() -> None:
    assert of("delta_robot") is None


def test_a_row_without_a_slope_counts_as_it_is(flat: ClosestSingularity | None) -> None:
    """A row that a parameter switches off had 0/0, and nothing was told but a traceback."""
    text = PARALLELOGRAM.replace('y = "sin(A)', 'off = "k*(B - 0.1)"\ny = "sin(A)')
    found = closest_singularity(made(text.replace("[energy]", "[parameters]\nk = 0.0\n[energy]")))
    assert found == flat
