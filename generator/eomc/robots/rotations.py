"""Rotations as robot files write them, in floats: angles, quaternions, axes; and back to angles."""

from __future__ import annotations

import math
from collections.abc import Sequence

from eomc.base import spatial
from eomc.base.spatial import axis_angle_rotation, matrix, product, transposed

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
