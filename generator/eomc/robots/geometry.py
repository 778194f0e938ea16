"""Rotations, poses and inertia tensors of robot files, in floats.

Rotations are made from angles, quaternions and axes, and converted back to angles. Inertia tensors
are rotated, checked whether a body can have them, and replaced by the nearest valid ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from eomc.base import spatial
from eomc.base.spatial import (
    ENTRIES,
    apply,
    as_inertia,
    axis_angle_rotation,
    matrix,
    plus,
    product,
    transposed,
)
from eomc.scene.validate_tables import MOMENT_TOLERANCE

Vector = spatial.Vector[float]
Matrix = spatial.Matrix[float]

ORIGIN: Vector = (0.0, 0.0, 0.0)
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

SNAP = 1e-10  # rad: files write pi/2 with eleven digits and mean it


def cleaned(a: Matrix) -> Matrix:
    """Return a rotation matrix with entries within 1e-12 of 0, 1 and -1 rounded to these.

    For example, cos(pi/2) is 6e-17 in floating point.
    """

    def clean(x: float) -> float:
        near = float(round(x))
        return near + 0.0 if abs(x - near) < 1e-12 else x

    return matrix([clean(x) for x in row] for row in a)


def times(a: Matrix, b: Matrix) -> Matrix:
    """Return the product A B of two rotation matrices, with rounding errors removed.

    Entries within 1e-12 of 0, 1 and -1 are rounded to these.
    """
    return cleaned(product(a, b))


class Transform(NamedTuple):
    """The pose of a frame in another frame.

    `place` is its origin (m), and the columns of `turn` are its axes.
    """

    place: Vector
    turn: Matrix

    def compose(self, other: Transform) -> Transform:
        """Return the product of two poses: frame C in frame A, from B in A and C in B.

        This pose is that of B in A, and `other` is that of C in B.
        """
        return Transform(self.point(other.place), times(self.turn, other.turn))

    def point(self, at: Vector) -> Vector:
        """Return the position of a point in the outer frame, from that in the inner one (m)."""
        return plus(self.place, apply(self.turn, at))


IDENTITY_TRANSFORM = Transform(ORIGIN, IDENTITY)


def unit(v: Vector) -> Vector:
    """Return the unit vector v/|v|. Raises ValueError if |v| is zero or not finite."""
    size = math.hypot(*v)
    if not size or not math.isfinite(size):
        raise ValueError("a vector of length zero" if not size else "a vector that is not finite")
    if abs(size - 1) < 1e-15:
        return v
    x, y, z = (c / size + 0.0 for c in v)
    return x, y, z


def from_axis_angle(axis: Vector, angle: float) -> Matrix:
    """Return the matrix of the rotation by `angle` (rad) about `axis`.

    The axis may have any nonzero length.
    """
    return cleaned(axis_angle_rotation(unit(axis), math.cos(angle), math.sin(angle)))


def from_rpy(roll: float, pitch: float, yaw: float) -> Matrix:
    """Return the rotation matrix Rz(yaw) Ry(pitch) Rx(roll) of angles in rad, as in URDF."""
    return from_euler("zyx", (yaw, pitch, roll))


def from_quaternion(w: float, x: float, y: float, z: float) -> Matrix:
    """Return the rotation matrix of a quaternion of any nonzero length.

    Raises ValueError if its length is zero or not finite.
    """
    size = math.hypot(w, x, y, z)
    if not size or not math.isfinite(size):
        raise ValueError("a quaternion of length zero")
    w, x, y, z = w / size, x / size, y / size, z / size
    return cleaned(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


def from_euler(sequence: str, angles: Sequence[float]) -> Matrix:
    """Return the rotation matrix of successive rotations about coordinate axes.

    `sequence` names the axes, and `angles` are in rad. Lowercase letters are axes of the rotating
    frame, uppercase ones are fixed axes.
    """
    out = IDENTITY
    for axis, angle in zip(sequence, angles, strict=True):
        turn = from_axis_angle(IDENTITY["xyz".index(axis.lower())], angle)
        out = times(out, turn) if axis.islower() else times(turn, out)
    return out


def toward(z: Vector) -> Matrix:
    """Return the matrix of the smallest rotation that takes the z axis to the unit vector `z`.

    If `z` is opposite to the z axis, it is half a turn about x.
    """
    sine = math.hypot(z[0], z[1])
    axis = (-z[1], z[0], 0.0) if sine > 1e-10 else (1.0, 0.0, 0.0)
    return from_axis_angle(axis, math.atan2(sine, z[2]))


def axis_rotations(a: Matrix) -> tuple[tuple[str, float], ...]:
    """Return the rotations about z, y and x whose product is the rotation matrix `a`.

    Each is a pair (axis, angle in rad). Zero rotations are left out. Near a pitch of pi/2 only the
    sum of the other two angles is well determined. The last angle is therefore computed from the
    rotation that remains after the first one, which compensates its rounding error.
    """
    yaw = math.atan2(a[1][0], a[0][0]) if math.hypot(a[0][0], a[1][0]) > 1e-12 else 0.0
    rest = times(transposed(from_axis_angle((0.0, 0.0, 1.0), yaw)), a)
    pitch = math.atan2(-rest[2][0], rest[0][0])
    roll = math.atan2(-rest[1][2], rest[1][1])
    # half turns about z and x are one about y the other way: the fewest turns are the clearest
    if abs(abs(yaw) - math.pi) < SNAP and abs(abs(roll) - math.pi) < SNAP:
        yaw, roll, pitch = 0.0, 0.0, math.pi - pitch if pitch >= 0 else -math.pi - pitch
    turns = (("z", yaw), ("y", pitch), ("x", roll))
    return tuple((axis, angle) for axis, angle in turns if abs(angle) >= SNAP)


def yaw_pitch_roll(a: Matrix) -> Vector:
    """Return the yaw, pitch and roll (rad) of a rotation matrix a = Rz(yaw) Ry(pitch) Rx(roll).

    At a pitch of a quarter turn, where the angles are singular, the roll is 0.
    """
    cosine = math.hypot(a[0][0], a[1][0])
    pitch = math.atan2(-a[2][0], cosine)
    if cosine < 1e-9:
        return math.atan2(-a[0][1], a[1][1]) + 0.0, pitch + 0.0, 0.0
    yaw = math.atan2(a[1][0], a[0][0])
    return yaw + 0.0, pitch + 0.0, math.atan2(a[2][1], a[2][2]) + 0.0


# --- inertias ------------------------------------------------------------------------------------

Inertia = spatial.Inertia[float]

NO_INERTIA: Inertia = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

ROUNDING = 1e-15  # relative to neighbouring entries: smaller ones become zero


def rotated_inertia(inertia: Inertia, a: Matrix) -> Inertia:
    """Return the inertia tensor A I A^T, in which entries that are only rounding errors are zero.

    A is the rotation matrix that transforms vectors from the frame of `inertia` to that of the
    result.
    """
    size = max(map(abs, inertia))
    return as_inertia(rounded(x, size) for x in spatial.rotated_inertia(a, inertia))


def rounded(x: float, size: float) -> float:
    """Return x, or 0 if it is a rounding error relative to numbers of magnitude `size`."""
    return x if abs(x) > ROUNDING * size else 0.0


def principal_moments(inertia: Inertia) -> tuple[list[float], list[Vector]]:
    """Return the principal moments of inertia in ascending order (kg m^2), and their axes."""
    import numpy as np

    moments, axes = np.linalg.eigh(spatial.tensor(inertia))
    return moments.tolist(), [(x, y, z) for x, y, z in axes.T.tolist()]


def indefinite_message(inertia: Inertia) -> str:
    """Return an error message if a principal moment of inertia is negative, otherwise "".

    The message proposes the nearest valid tensor, unless that is zero (see `has_nearest_valid`).
    """
    moments, _ = principal_moments(inertia)
    if moments[0] >= -MOMENT_TOLERANCE * max(map(abs, moments)):
        return ""
    if not has_nearest_valid(inertia):
        listed = ", ".join(f"{moment:.4g}" for moment in moments)
        return (
            f"its principal moments of inertia are {listed} kg m^2, and no body has a negative "
            "one: check the signs of the tensor in the file, or take it from the CAD model again"
        )
    return (
        f"its smallest principal moment of inertia is {moments[0]:.4g} kg m^2, and no body has "
        "a negative one: check its signs in the file, "
        f"{entries_text(nearest_valid(inertia))} would do"
    )


def has_nearest_valid(inertia: Inertia) -> bool:
    """Return True if the valid inertia tensor nearest to `inertia` differs from zero.

    A tensor is valid if a body can have it. The nearest one is zero if one principal moment of
    `inertia` is negative and fewer than two are positive. The signs in the file are then wrong.
    """
    (small, middle, _), _ = principal_moments(inertia)
    tiny = MOMENT_TOLERANCE * max(map(abs, inertia))
    return small >= -tiny or middle > tiny


def triangle_message(inertia: Inertia) -> str:
    """Return a message if a principal moment of inertia exceeds the sum of the others.

    No body has such an inertia. Returns "" for a valid tensor.
    """
    (small, middle, large), _ = principal_moments(inertia)
    if large <= (small + middle) * (1 + MOMENT_TOLERANCE):
        return ""
    return (
        f"its principal moments of inertia {small:.4g}, {middle:.4g}, {large:.4g} break the "
        "triangle inequality, and no body has such: correct it, "
        f"{entries_text(nearest_valid(inertia))} would do"
    )


def nearest_valid(inertia: Inertia) -> Inertia:
    """Return the valid inertia tensor that is nearest to `inertia` in the Frobenius norm.

    It has the same principal axes. Its principal moments are I = (b + c, a + c, a + b), where
    a, b, c >= 0 are the second moments of mass along the axes: nonnegative least squares, solved
    by trying every set of positive ones.
    """
    import numpy as np

    listed, axes = principal_moments(inertia)
    moments = np.array(listed)
    sums = 1.0 - np.eye(3)
    best, least = np.zeros(3), float(moments @ moments)
    for columns in ((0, 1, 2), (0, 1), (0, 2), (1, 2), (0,), (1,), (2,)):
        second = np.linalg.lstsq(sums[:, columns], moments, rcond=None)[0]
        candidate = sums[:, columns] @ second
        deviation = float((candidate - moments) @ (candidate - moments))
        if min(second) >= 0 and deviation < least:
            best, least = candidate, deviation
    directions = np.array(axes)
    tensor = (directions.T * best) @ directions
    dust = 1e-12 * max(map(abs, inertia))
    return as_inertia(float(x) if abs(x := tensor[i, j]) > dust else 0.0 for i, j in ENTRIES)


def entries_text(inertia: Inertia) -> str:
    """Return the text of the six different entries of an inertia tensor, for a message."""
    return f"[{', '.join(f'{x:.8g}' for x in inertia)}]"
