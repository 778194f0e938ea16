"""Inertias as robot files have them: rotated, what no body can have, and what would do."""

from __future__ import annotations

from eomc.base import spatial
from eomc.base.spatial import ENTRIES, six
from eomc.robots.rotations import Matrix, Vector

Inertia = spatial.Inertia[float]

NO_INERTIA: Inertia = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

TRIANGLE = 1e-6  # relative excess of a principal moment over the other two that a scene may have


def rotated_inertia(inertia: Inertia, a: Matrix) -> Inertia:
    """A I A^T; what rounding left of a zero is zero."""
    size = 1e-15 * max(map(abs, inertia))
    return six(x if abs(x) > size else 0.0 for x in spatial.rotated_inertia(a, inertia))


def principal(inertia: Inertia) -> tuple[list[float], list[Vector]]:
    """The principal moments, the smallest first, and their axes."""
    import numpy as np

    moments, axes = np.linalg.eigh(spatial.tensor(inertia))
    return moments.tolist(), [(x, y, z) for x, y, z in axes.T.tolist()]


def indefinite(inertia: Inertia) -> str:
    """In words, with one that would do, that a principal moment is negative, or ""."""
    moments, _ = principal(inertia)
    if moments[0] >= -TRIANGLE * max(map(abs, moments)):
        return ""
    if not has_nearest(inertia):
        listed = ", ".join(f"{moment:.4g}" for moment in moments)
        return (
            f"its principal moments of inertia are {listed} kg m^2, and no body has a negative "
            "one: check the signs of the tensor in the file, or take it from the CAD model again"
        )
    return (
        f"its smallest principal moment of inertia is {moments[0]:.4g} kg m^2, and no body has "
        f"a negative one: check its signs in the file, {shown(nearest(inertia))} would do"
    )


def has_nearest(inertia: Inertia) -> bool:
    """Return whether the nearest tensor of a body has anything of this one.

    With a negative principal moment and fewer than two positive ones it is zero, that of a point:
    signs were lost.
    """
    (small, middle, _), _ = principal(inertia)
    tiny = TRIANGLE * max(map(abs, inertia))
    return small >= -tiny or middle > tiny


def unbalanced(inertia: Inertia) -> str:
    """In words, with one that would do, that a moment exceeds the other two together, or ""."""
    (small, middle, large), _ = principal(inertia)
    if large <= (small + middle) * (1 + TRIANGLE):
        return ""
    return (
        f"its principal moments of inertia {small:.4g}, {middle:.4g}, {large:.4g} break the "
        f"triangle inequality, and no body has such: correct it, {shown(nearest(inertia))} would "
        "do"
    )


def nearest(inertia: Inertia) -> Inertia:
    """The tensor that a body can have with the least sum of squares of what changes (Frobenius).

    It has the same axes. Its principal moments are I = (b + c, a + c, a + b) with the second
    moments a, b, c >= 0 of the mass along them: least squares, of which some are zero.
    """
    import numpy as np

    principal_moments, axes = principal(inertia)
    moments = np.array(principal_moments)
    sums = 1.0 - np.eye(3)
    best, least = np.zeros(3), float(moments @ moments)
    for kept in ((0, 1, 2), (0, 1), (0, 2), (1, 2), (0,), (1,), (2,)):
        second = np.linalg.lstsq(sums[:, kept], moments, rcond=None)[0]
        candidate = sums[:, kept] @ second
        deviation = float((candidate - moments) @ (candidate - moments))
        if min(second) >= 0 and deviation < least:
            best, least = candidate, deviation
    directions = np.array(axes)
    tensor = (directions.T * best) @ directions
    dust = 1e-12 * max(map(abs, inertia))
    return six(float(x) if abs(x := tensor[i, j]) > dust else 0.0 for i, j in ENTRIES)


def shown(inertia: Inertia) -> str:
    """The six numbers, for a message."""
    return f"[{', '.join(f'{x:.8g}' for x in inertia)}]"
