"""Compare vectors, rotations and inertias with SciPy and with point masses."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from eomc.base import spatial
from eomc.base.spatial import Vector

number = st.floats(-10, 10)
vectors = st.tuples(number, number, number)
axes = vectors.filter(lambda v: math.hypot(*v) > 1e-3).map(lambda v: unit(v))
angles = st.floats(-7, 7)
rotations = st.builds(
    lambda v, a: spatial.axis_angle_rotation(v, math.cos(a), math.sin(a)), axes, angles
)
# a rigid body: point masses and their positions
masses = st.lists(st.tuples(st.floats(0.1, 5), vectors), min_size=1, max_size=6)
# nearly all functions are linear in the drawn values, so that few examples expose a wrong entry
few = settings(max_examples=20, deadline=None)
CLOSE = {"rtol": 1e-12, "atol": 1e-11}


def unit(v: Sequence[float]) -> Vector[float]:
    x, y, z = (c / math.hypot(*v) for c in v)
    return x, y, z


def inertia_about_origin(points: Sequence[tuple[float, Vector[float]]]) -> np.ndarray:
    """Return the inertia tensor of point masses by its definition, sum m (|r|^2 1 - r r^T)."""
    total = np.zeros((3, 3))
    for mass, position in points:
        r = np.array(position)
        total += mass * (r @ r * np.eye(3) - np.outer(r, r))
    return total


def inertia_entries(tensor: np.ndarray) -> spatial.Inertia[float]:
    return spatial.as_inertia(tensor[i][j] for i, j in spatial.ENTRIES)


@few
@given(vectors, vectors, number)
def test_vector_operations_agree_with_numpy(
    a: Vector[float], b: Vector[float], factor: float
) -> None:
    assert np.allclose(spatial.plus(a, b), np.add(a, b), **CLOSE)
    assert np.allclose(spatial.scaled(a, factor), np.multiply(a, factor), **CLOSE)
    assert np.allclose(spatial.dot(a, b), np.dot(a, b), **CLOSE)
    assert np.allclose(spatial.cross(a, b), np.cross(a, b), **CLOSE)


@few
@given(axes, angles)
def test_axis_angle_rotation_agrees_with_scipy(axis: Vector[float], angle: float) -> None:
    result = spatial.axis_angle_rotation(axis, math.cos(angle), math.sin(angle))
    assert np.allclose(result, Rotation.from_rotvec(np.multiply(axis, angle)).as_matrix(), **CLOSE)


@pytest.mark.parametrize("k", range(3))
@few
@given(angle=angles)
def test_elementary_rotation_agrees_with_scipy(k: int, angle: float) -> None:
    result = spatial.elementary_rotation(k, math.cos(angle), math.sin(angle))
    assert np.allclose(result, Rotation.from_euler("xyz"[k], angle).as_matrix(), **CLOSE)


@few
@given(rotations, rotations, vectors)
def test_products_and_transposes_agree_with_scipy(
    A: spatial.Matrix[float], B: spatial.Matrix[float], v: Vector[float]
) -> None:
    one, other = Rotation.from_matrix(A), Rotation.from_matrix(B)
    assert np.allclose(spatial.product(A, B), (one * other).as_matrix(), **CLOSE)
    assert np.allclose(spatial.apply(A, v), one.apply(v), **CLOSE)
    assert np.allclose(spatial.transposed(A), one.inv().as_matrix(), **CLOSE)


@few
@given(masses, rotations)
def test_rotated_inertia_is_that_of_rotated_points(
    points: list[tuple[float, Vector[float]]], R: spatial.Matrix[float]
) -> None:
    rotated = [(m, spatial.apply(R, position)) for m, position in points]
    result = spatial.rotated_inertia(R, inertia_entries(inertia_about_origin(points)))
    assert np.allclose(spatial.tensor(result), inertia_about_origin(rotated), rtol=1e-11, atol=1e-9)


@few
@given(masses, vectors)
def test_moved_inertia_is_that_of_translated_points(
    points: list[tuple[float, Vector[float]]], center: Vector[float]
) -> None:
    total = sum(m for m, _ in points)
    center_of_mass = sum(m * np.array(position) for m, position in points) / total
    centered = [(m, tuple(np.subtract(position, center_of_mass))) for m, position in points]
    moved = [(m, tuple(np.add(position, center))) for m, position in centered]
    result = spatial.moved_inertia(inertia_entries(inertia_about_origin(centered)), total, center)
    assert np.allclose(spatial.tensor(result), inertia_about_origin(moved), rtol=1e-11, atol=1e-9)


@few
@given(st.floats(0.1, 5), vectors)
def test_point_inertia_agrees_with_definition(mass: float, position: Vector[float]) -> None:
    result = spatial.tensor(spatial.point_inertia(mass, position))
    assert np.allclose(result, inertia_about_origin([(mass, position)]), **CLOSE)


def test_symbolic_products_drop_zeros_and_ones() -> None:
    """For SymPy expressions as well: no term with a factor of zero and no factor of one."""
    c, s, x = sympy.symbols("c s x")
    zero, one = sympy.S.Zero, sympy.S.One
    turn = spatial.elementary_rotation(2, c, s)
    assert turn == ((c, -s, 0), (s, c, 0), (0, 0, 1))
    assert spatial.apply(turn, (x, zero, one)) == (c * x, s * x, 1)
    assert spatial.product(turn, spatial.transposed(turn))[0] == (c**2 + s**2, 0, 0)
