"""Drawings of a mechanism: moving points and the marks on them, without matplotlib.

Still figures, pages and films are all made from a `Drawing`. It contains what the scene declares:
bodies, joints, points, springs and the shapes of [picture] (see sketch.py); without any of these,
the paths of points whose x and y the scene names. A scene that declares nothing of the kind has no
drawing.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from eomc.model.algebra import compiled
from eomc.model.system import System, dot
from eomc.model.system import t as time
from eomc.report import sketch
from eomc.report.marks import Drawing, Marks, superpose

Array = NDArray[np.float64]
PLANE_TOLERANCE = 1e-9  # relative to the size of the drawing


def drawing(system: System, t: Array, q: Array) -> Drawing | None:
    """Return the drawing of a mechanism at times `t` (n,) in s and coordinates `q` (n, nq).

    Returns None if `t` is empty or if the scene of the system does not describe the shape of the
    mechanism.
    """
    result = _draw(system, t, q) if len(t) else None
    return _flatten(result) if result else None


def drawings(systems: Sequence[System], t: Array, q: Array, names: Sequence[str]) -> Drawing | None:
    """Return one drawing of several instances of a mechanism, drawn over each other.

    systems: one system for each instance, with its parameter values. t: times (n,) in s, common to
    all. q: coordinates (batch, n, nq). names: the names of the instances. Returns None if `t` is
    empty or if the scene does not describe the shape of the mechanism.
    """
    if not len(t):
        return None
    each = [
        _draw(system, t, values_of_one) for system, values_of_one in zip(systems, q, strict=True)
    ]
    result = superpose(each, names)
    return _flatten(result) if result else None


def _draw(system: System, t: Array, q: Array) -> Drawing | None:
    values: dict[str, Any] = {p.name: p.value for p in system.parameters}
    columns = zip(system.coordinates, q.T, strict=True)
    values |= {c.name: own for c, own in columns if c.name in system.discrete}
    scene = system.scene or system.picture_scene
    declared = sketch.draw_declared(scene, values, t, q) if scene else None
    return declared or _draw_named_points(system, t, q)


def _flatten(original: Drawing) -> Drawing:
    """Return a drawing that never leaves one of the planes x-z, y-z, x-y as a plane drawing."""
    if original.axes != "xyz":
        return original
    points = original.points[np.isfinite(original.points).all(axis=(1, 2))]
    if not len(points):
        return original
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    for normal in (1, 0, 2):  # seen from the front, from the side, from above
        if high[normal] - low[normal] <= PLANE_TOLERANCE * (high - low).max():
            in_plane = [k for k in range(3) if k != normal]
            in_plane.sort(key=lambda k: k == original.up)
            axes = "".join("xyz"[k] for k in in_plane)
            return Drawing(
                original.points[:, :, in_plane], original.marks, original.paths, axes, original.unit
            )
    return original


# --- points that a scene only names ---------------------------------------------------------------


def _draw_named_points(system: System, times: Array, q: Array) -> Drawing | None:
    """Draw the paths of points whose x and y are named, such as x_p and y_p, or x1 and y1."""
    known = [c.name for c in system.coordinates] + [s.name for s, _ in system.definitions]
    paths = _positions(system, times, q, _pairs(known))
    if not paths:
        return None
    marks = Marks(len(times))
    for pair, path in paths.items():
        index = marks.point(np.column_stack([path, np.zeros(len(times))]))
        marks.add("dot", index)
        marks.path("(" + ", ".join(pair) + ")", index)
    x, y = next(iter(paths))
    units = {c.unit for c in system.coordinates} | {p.unit for p in system.parameters}
    names = (x, y) if len(paths) == 1 else ("x", "y")
    return marks.drawing("xy", "m" if "m" in units else "", names)


def _pairs(known: Sequence[str]) -> list[tuple[str, str]]:
    """Return pairs of names such as (x_p, y_p), (x1, y1), (tip_x, tip_y) without a matching z."""
    pairs = []
    for name in known:
        if match := re.fullmatch(r"(|.*_)x(|_.*|\d+)", name):
            before, after = match.groups()
            if f"{before}y{after}" in known and f"{before}z{after}" not in known:
                pairs.append((name, f"{before}y{after}"))
    return pairs


def _positions(
    system: System, times: Array, q: Array, pairs: Sequence[tuple[str, str]]
) -> dict[tuple[str, str], Array]:
    """Return the paths (n, 2) of those pairs that are functions of q and t only and depend on q."""
    if not pairs:
        return {}
    body = _bodies(system)
    expression = {s.name: body[s] for s in (*system.q, *(s for s, _ in system.definitions))}
    coordinates = set(system.q)
    chosen = []
    for pair in pairs:
        used = expression[pair[0]].free_symbols | expression[pair[1]].free_symbols
        rates = expression[pair[0]].has(dot) or expression[pair[1]].has(dot)
        if not rates and used & coordinates and used <= coordinates | {time}:
            chosen.append(pair)
    flat = [expression[name] for pair in chosen for name in pair]
    values = compiled((time, *system.q), flat, "numpy")(times, *q.T)
    columns = [np.broadcast_to(v, times.shape).astype(float) for v in values]
    return {pair: np.column_stack(columns[2 * k : 2 * k + 2]) for k, pair in enumerate(chosen)}


def _bodies(system: System) -> dict[sympy.Symbol, sympy.Expr]:
    """Return each name's expression in t, q and q̇, at the values of the parameters."""
    body: dict[sympy.Symbol, sympy.Expr] = {s: s for s in system.q}
    body |= {p.symbol: sympy.Float(p.value) for p in system.parameters}
    for s, expr in system.definitions:
        body[s] = expr.xreplace(body)
    return body
