"""What is drawn of a mechanism: points that move and marks on them. Geometry only, no matplotlib.

The one value from which pictures, pages and films are made. It holds what a scene declares: bodies,
joints, points and springs, what its [picture] says (sketch.py has both), else the paths of
points whose x and y it names. Nothing is guessed: where a scene says none of it, there is no
drawing.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from eomc.model.numeric import compiled
from eomc.model.system import System, dot
from eomc.model.system import t as time
from eomc.report import sketch
from eomc.report.marks import Drawing, Marks, together

Array = NDArray[np.float64]
FLAT = 1e-9  # of the size of a drawing: what moves out of a plane by less stays in it


def drawing(system: System, t: Array, q: Array) -> Drawing | None:
    """What is drawn of a system at some states; None where it says nothing about its shape.

    t: (n,), s; q: (n, nq).
    """
    made = _made(system, t, q) if len(t) else None
    return _flattened(made) if made else None


def drawings(systems: Sequence[System], t: Array, q: Array, names: Sequence[str]) -> Drawing | None:
    """What is drawn of instances of one scene, over each other, as `drawing` of one.

    q: (batch, n, nq). names: of the instances.
    """
    if not len(t):
        return None
    each = [_made(system, t, own) for system, own in zip(systems, q, strict=True)]
    made = together(each, names)
    return _flattened(made) if made else None


def _made(system: System, t: Array, q: Array) -> Drawing | None:
    values: dict[str, Any] = {p.name: p.value for p in system.parameters}
    columns = zip(system.coordinates, q.T, strict=True)
    values |= {c.name: own for c, own in columns if c.name in system.discrete}
    scene = system.scene or system.pictured
    made = sketch.declared(scene, values, t, q) if scene else None
    return made or _named(system, t, q)


def _flattened(made: Drawing) -> Drawing:
    """In the plane, where a drawing in space never leaves x-z, y-z or x-y."""
    if made.axes != "xyz":
        return made
    points = made.points[np.isfinite(made.points).all(axis=(1, 2))]
    if not len(points):
        return made
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    for out in (1, 0, 2):  # seen from the front, from the side, from above
        if high[out] - low[out] <= FLAT * (high - low).max():
            kept = [k for k in range(3) if k != out]
            kept.sort(key=lambda k: k == made.up)
            axes = "".join("xyz"[k] for k in kept)
            return Drawing(made.points[:, :, kept], made.marks, made.paths, axes, made.unit)
    return made


# --- points that a scene only names ---------------------------------------------------------------


def _named(system: System, times: Array, q: Array) -> Drawing | None:
    """The paths of points whose x and y are definitions or coordinates: x_p and y_p, x1 and y1."""
    known = [c.name for c in system.coordinates] + [s.name for s, _ in system.definitions]
    found = _positions(system, times, q, _pairs(known))
    if not found:
        return None
    marks = Marks(len(times))
    for pair, path in found.items():
        at = marks.point(np.column_stack([path, np.zeros(len(times))]))
        marks.add("dot", at)
        marks.path("(" + ", ".join(pair) + ")", at)
    x, y = next(iter(found))
    units = {c.unit for c in system.coordinates} | {p.unit for p in system.parameters}
    names = (x, y) if len(found) == 1 else ("x", "y")
    return marks.drawing("xy", "m" if "m" in units else "", names)


def _pairs(known: Sequence[str]) -> list[tuple[str, str]]:
    """Names such as x_p and y_p, x1 and y1, tip_x and tip_y; not those that have a z as well."""
    pairs = []
    for name in known:
        if found := re.fullmatch(r"(|.*_)x(|_.*|\d+)", name):
            before, after = found.groups()
            if f"{before}y{after}" in known and f"{before}z{after}" not in known:
                pairs.append((name, f"{before}y{after}"))
    return pairs


def _positions(
    system: System, times: Array, q: Array, pairs: Sequence[tuple[str, str]]
) -> dict[tuple[str, str], Array]:
    """The paths (n, 2) of the pairs that are functions of q and t and move with q."""
    if not pairs:
        return {}
    body = _bodies(system)
    of = {s.name: body[s] for s in (*system.q, *(s for s, _ in system.definitions))}
    coordinates = set(system.q)
    chosen = []
    for pair in pairs:
        used = of[pair[0]].free_symbols | of[pair[1]].free_symbols
        rates = of[pair[0]].has(dot) or of[pair[1]].has(dot)
        if not rates and used & coordinates and used <= coordinates | {time}:
            chosen.append(pair)
    flat = [of[name] for pair in chosen for name in pair]
    values = compiled((time, *system.q), flat, "numpy")(times, *q.T)
    columns = [np.broadcast_to(v, times.shape).astype(float) for v in values]
    return {pair: np.column_stack(columns[2 * k : 2 * k + 2]) for k, pair in enumerate(chosen)}


def _bodies(system: System) -> dict[sympy.Symbol, sympy.Expr]:
    """Every name as an expression in t, q and qd alone, parameters at their values."""
    body: dict[sympy.Symbol, sympy.Expr] = {s: s for s in system.q}
    body |= {p.symbol: sympy.Float(p.value) for p in system.parameters}
    for s, expr in system.definitions:
        body[s] = expr.xreplace(body)
    return body
