"""The mechanism beside the curves of a run: drawn in the plane, or as a path."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import sympy
from numpy.typing import NDArray

from eomc.model.system import System, dot, t
from eomc.report.labels import label, mathtext, with_unit
from eomc.report.style import COLOURS, INK, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
INSTANTS = 16  # at which the mechanism is shown


@dataclass(frozen=True)
class _Plane:
    """Points moving in the plane; `parents` are paths that a rod joins them to, if any."""

    t: Array
    points: list[tuple[str, Array]]  # name and path, (n, 2)
    parents: list[Array | None]
    labels: tuple[str, str]

    def draw(self, axes: Axes) -> None:
        """The paths, and the mechanism at the beginning of the run, from light to dark."""
        shown = self.points if len(self.points) <= 3 else self.points[-1:]
        end = self._strobe(axes)
        for (name, path), colour in zip(shown, COLOURS, strict=False):
            axes.plot(*path.T, color=colour, label=f"path of {name}" if name else "path")
            axes.plot(*path[-1], "o", color=colour, markersize=5, zorder=4)
        plain(axes)
        for line in axes.get_lines()[-2 * len(shown) :]:
            line.set_linewidth(1.0)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(self.labels[0])
        axes.set_ylabel(self.labels[1])
        axes.locator_params(nbins=7)
        axes.set_title(f"In the plane{end}", fontsize=10, color=INK)
        if len(shown) > 1 or len(self.points) > 1:
            axes.legend(fontsize=9, frameon=False, loc="upper right")

    def _strobe(self, axes: Axes) -> str:
        """The rods at some instants; says when."""
        both = zip(self.points, self.parents, strict=True)
        rods = [(parent, path) for (_, path), parent in both if parent is not None]
        if not rods:
            axes.plot(0, 0, "+", color=INK, markersize=7, zorder=4)
            return ""
        last = self._stretch()
        chosen = np.unique(np.linspace(0, last, INSTANTS).round().astype(int))
        for k, i in enumerate(chosen):
            shade = str(0.86 - 0.66 * k / max(len(chosen) - 1, 1))
            for parent, path in rods:
                axes.plot(*np.array([parent[i], path[i]]).T, color=shade, zorder=1.5, marker="o",
                          markersize=2.5, solid_capstyle="round")  # fmt: skip
        return f", rods from t = 0 to {self.t[last]:.3g} s"

    def _stretch(self) -> int:
        """The sample up to which the last point has gone about one and a half times its extent."""
        path = self.points[-1][1]
        extents = [np.ptp(points, axis=0) for _, points in self.points]
        reach = max(float(np.max(extents)), 1e-12)
        gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        return min(int(np.searchsorted(gone, 1.5 * reach)), len(path) - 1)


@dataclass(frozen=True)
class _Path:
    """One quantity against another: a phase portrait or a path in configuration space."""

    values: Array
    labels: tuple[str, str]
    title: str

    def draw(self, axes: Axes) -> None:
        """The path, its start as a ring and its end as a dot."""
        axes.plot(*self.values.T, color=COLOURS[0])
        plain(axes)
        axes.plot(*self.values[0], "o", color=COLOURS[0], markerfacecolor="white", markersize=5)
        axes.plot(*self.values[-1], "o", color=COLOURS[0], markersize=5)
        axes.set_xlabel(self.labels[0])
        axes.set_ylabel(self.labels[1])
        axes.locator_params(nbins=7)
        axes.set_title(f"{self.title}, from ring to dot", fontsize=10, color=INK)


def picture(system: System, t: Array, q: Array, qd: Array) -> _Plane | _Path | None:
    """What a person expects to see of the system next to its curves."""
    if len(t) == 0:
        return None
    if plane := _plane(system, t, q) or _polar(system, t, q):
        return plane
    if len(system.q) == 1:
        (c,) = system.coordinates
        labels = (label(c), label(c, rate=True))
        return _Path(np.hstack([q, qd]), labels, "Phase portrait")
    if len(system.q) == 2:
        first, second = map(label, system.coordinates)
        return _Path(q, (first, second), "Configuration space")
    return None


def _plane(system: System, t: Array, q: Array) -> _Plane | None:
    """Points whose x and y the scene names, as definitions or as coordinates."""
    named = _pairs([c.name for c in system.coordinates] + [s.name for s, _ in system.definitions])
    found = _positions(system, t, q, named)
    if not found:
        return None
    points = [(f"({mathtext(x)}, {mathtext(y)})", path) for (x, y), path in found.items()]
    free = {c.name for c in system.coordinates}
    anchors = [np.zeros((len(t), 2))]
    for axis, name in enumerate("xy"):  # a cart on a rail
        if name in free and not any(name in pair for pair in found):
            rail = np.zeros((len(t), 2))
            rail[:, axis] = q[:, [c.name for c in system.coordinates].index(name)]
            anchors.insert(0, rail)
    parents: list[Array | None] = []
    before: list[Array] = []
    for (x, _), path in found.items():
        parents.append(None if x in free else _parent(path, before[::-1] + anchors))
        before.append(path)
    units = {c.unit for c in system.coordinates} | {p.unit for p in system.parameters}
    unit = "m" if "m" in units else ""
    x, y = map(mathtext, next(iter(found))) if len(found) == 1 else ("$x$", "$y$")
    return _Plane(t, points, parents, (with_unit(x, unit), with_unit(y, unit)))


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
    body = _bodies(system)
    of = {s.name: body[s] for s in (*system.q, *(s for s, _ in system.definitions))}
    coordinates = set(system.q)
    chosen = []
    for pair in pairs:
        used = of[pair[0]].free_symbols | of[pair[1]].free_symbols
        rates = of[pair[0]].has(dot) or of[pair[1]].has(dot)
        if not rates and used & coordinates and used <= coordinates | {t}:
            chosen.append(pair)
    flat = [of[name] for pair in chosen for name in pair]
    values = sympy.lambdify((t, *system.q), flat, "numpy", cse=True)(times, *q.T)
    columns = [np.broadcast_to(v, times.shape).astype(float) for v in values]
    return {pair: np.column_stack(columns[2 * k : 2 * k + 2]) for k, pair in enumerate(chosen)}


def _parent(path: Array, candidates: Sequence[Array]) -> Array:
    """The nearest of the candidates, in their order, that keeps its distance; else the first."""
    for candidate in candidates:
        distance = np.linalg.norm(path - candidate, axis=1)
        if np.ptp(distance) <= 1e-6 * np.max(distance):
            return candidate
    return candidates[0]


def _bodies(system: System) -> dict[sympy.Symbol, sympy.Expr]:
    """Every name as an expression in t, q and qd alone, parameters at their values."""
    body: dict[sympy.Symbol, sympy.Expr] = {s: s for s in system.q}
    body |= {p.symbol: sympy.Float(p.value) for p in system.parameters}
    for s, expr in system.definitions:
        body[s] = expr.xreplace(body)
    return body


def _polar(system: System, t: Array, q: Array) -> _Plane | None:
    """The path of polar coordinates; the angle from straight down where gravity says so."""
    index = {c.name: i for i, c in enumerate(system.coordinates)}
    radius = next((index[n] for n in ("r", "rho") if n in index), None)
    angle = next((index[n] for n in ("theta", "phi") if n in index), None)
    if radius is None or angle is None or len(index) != 2:
        return None
    potential = system.potential.xreplace(_bodies(system))
    at_one = potential.subs(system.q[radius], 1)
    fall = sympy.N(at_one.subs(system.q[angle], 0) - at_one.subs(system.q[angle], sympy.pi))
    downwards = bool(fall.is_negative)
    r, phi = (mathtext(system.coordinates[i].name).strip("$") for i in (radius, angle))
    across, along = q[:, radius] * np.sin(q[:, angle]), q[:, radius] * np.cos(q[:, angle])
    path = np.column_stack([across, -along] if downwards else [along, across])
    sine, cosine = rf"{r}\,\sin {phi}", rf"{r}\,\cos {phi}"
    x, y = (sine, f"-{cosine}") if downwards else (cosine, sine)
    unit = system.coordinates[radius].unit
    return _Plane(t, [("", path)], [None], (with_unit(f"${x}$", unit), with_unit(f"${y}$", unit)))
