"""Inertia tensors of robot files: rotation, physical validity, and the nearest valid tensor."""

from __future__ import annotations

from eomc.base import spatial
from eomc.base.spatial import ENTRIES, as_inertia
from eomc.robots.rotations import Matrix, Vector

Inertia = spatial.Inertia[float]

NO_INERTIA: Inertia = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

TRIANGLE = 1e-6  # relative excess of a principal moment over the other two that a scene may have


def rotated_inertia(inertia: Inertia, a: Matrix) -> Inertia:
    """Return the inertia tensor A I A^T, in which entries that are only rounding errors are zero.

    A is the rotation matrix that transforms vectors from the frame of `inertia` to that of the
    result.
    """
    size = 1e-15 * max(map(abs, inertia))
    return as_inertia(x if abs(x) > size else 0.0 for x in spatial.rotated_inertia(a, inertia))


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
    if moments[0] >= -TRIANGLE * max(map(abs, moments)):
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
    tiny = TRIANGLE * max(map(abs, inertia))
    return small >= -tiny or middle > tiny


def triangle_message(inertia: Inertia) -> str:
    """Return a message if a principal moment of inertia exceeds the sum of the others.

    No body has such an inertia. Returns "" for a valid tensor.
    """
    (small, middle, large), _ = principal_moments(inertia)
    if large <= (small + middle) * (1 + TRIANGLE):
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
