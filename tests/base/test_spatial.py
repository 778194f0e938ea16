"""The kit of vectors, rotations and inertias against SciPy and point masses."""

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
# a rigid body: masses at places
masses = st.lists(st.tuples(st.floats(0.1, 5), vectors), min_size=1, max_size=6)
# linear in nearly all that is drawn: a wrong entry shows at once
few = settings(max_examples=20, deadline=None)
CLOSE = {"rtol": 1e-12, "atol": 1e-11}


def unit(v: Sequence[float]) -> Vector[float]:
    x, y, z = (c / math.hypot(*v) for c in v)
    return x, y, z


def inertia_about_origin(points: Sequence[tuple[float, Vector[float]]]) -> np.ndarray:
    """The tensor of point masses by its definition, sum m (|r|^2 1 - r r^T)."""
    total = np.zeros((3, 3))
    for mass, place in points:
        r = np.array(place)
        total += mass * (r @ r * np.eye(3) - np.outer(r, r))
    return total


def six(tensor: np.ndarray) -> spatial.Inertia[float]:
    return spatial.as_inertia(tensor[i][j] for i, j in spatial.ENTRIES)


@few
@given(vectors, vectors, number)
def test_vectors(a: Vector[float], b: Vector[float], factor: float) -> None:
    assert np.allclose(spatial.plus(a, b), np.add(a, b), **CLOSE)
    assert np.allclose(spatial.scaled(a, factor), np.multiply(a, factor), **CLOSE)
    assert np.allclose(spatial.dot(a, b), np.dot(a, b), **CLOSE)
    assert np.allclose(spatial.cross(a, b), np.cross(a, b), **CLOSE)


@few
@given(axes, angles)
def test_rotation_about_any_axis(axis: Vector[float], angle: float) -> None:
    found = spatial.axis_angle_rotation(axis, math.cos(angle), math.sin(angle))
    assert np.allclose(found, Rotation.from_rotvec(np.multiply(axis, angle)).as_matrix(), **CLOSE)


@pytest.mark.parametrize("k", range(3))
@few
@given(angle=angles)
def test_rotation_about_a_coordinate_axis(k: int, angle: float) -> None:
    found = spatial.elementary_rotation(k, math.cos(angle), math.sin(angle))
    assert np.allclose(found, Rotation.from_euler("xyz"[k], angle).as_matrix(), **CLOSE)


@few
@given(rotations, rotations, vectors)
def test_products(A: spatial.Matrix[float], B: spatial.Matrix[float], v: Vector[float]) -> None:
    one, other = Rotation.from_matrix(A), Rotation.from_matrix(B)
    assert np.allclose(spatial.product(A, B), (one * other).as_matrix(), **CLOSE)
    assert np.allclose(spatial.apply(A, v), one.apply(v), **CLOSE)
    assert np.allclose(spatial.transposed(A), one.inv().as_matrix(), **CLOSE)


@few
@given(masses, rotations)
def test_a_rotated_body_has_the_rotated_inertia(
    points: list[tuple[float, Vector[float]]], R: spatial.Matrix[float]
) -> None:
    rotated = [(m, spatial.apply(R, place)) for m, place in points]
    found = spatial.rotated_inertia(R, six(inertia_about_origin(points)))
    assert np.allclose(spatial.tensor(found), inertia_about_origin(rotated), rtol=1e-11, atol=1e-9)


@few
@given(masses, vectors)
def test_a_moved_body_has_the_moved_inertia(
    points: list[tuple[float, Vector[float]]], center: Vector[float]
) -> None:
    total = sum(m for m, _ in points)
    middle = sum(m * np.array(place) for m, place in points) / total
    own = [(m, tuple(np.subtract(place, middle))) for m, place in points]
    moved = [(m, tuple(np.add(place, center))) for m, place in own]
    found = spatial.moved_inertia(six(inertia_about_origin(own)), total, center)
    assert np.allclose(spatial.tensor(found), inertia_about_origin(moved), rtol=1e-11, atol=1e-9)


@few
@given(st.floats(0.1, 5), vectors)
def test_a_point_mass(mass: float, place: Vector[float]) -> None:
    found = spatial.tensor(spatial.point_inertia(mass, place))
    assert np.allclose(found, inertia_about_origin([(mass, place)]), **CLOSE)


def test_expressions_stay_short() -> None:
    """Of SymPy's expressions too: no term with a zero, no factor one."""
    c, s, x = sympy.symbols("c s x")
    zero, one = sympy.S.Zero, sympy.S.One
    turn = spatial.elementary_rotation(2, c, s)
    assert turn == ((c, -s, 0), (s, c, 0), (0, 0, 1))
    assert spatial.apply(turn, (x, zero, one)) == (c * x, s * x, 1)
    assert spatial.product(turn, spatial.transposed(turn))[0] == (c**2 + s**2, 0, 0)
