"""Draws a run: coordinates, velocities and energy against time, and the picture in the plane.

Needs matplotlib, an optional extra, and no display: figures are made without pyplot.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy.printing.latex import translate

from eomc.base import names, texts
from eomc.base.errors import EomcError
from eomc.model.system import Coordinate, Output, System, dot, t

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Outputs = Mapping[str, Array]
_NONE: Outputs = {}

SUFFIXES = (".png", ".svg", ".pdf")

# Okabe and Ito's colours, distinct in every kind of colour vision; yellow left out on white
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, FAINT = "#333333", "#DDDDDD"

ROWS = 4  # of coordinates, at most; beyond that several share axes
INSTANTS = 16  # at which the mechanism is shown
SAMPLES = 20_000  # of a run that are drawn, at most


def draw(
    system: System, t: Array, q: Array, qd: Array, energy: Array, path: str | Path, *,
    jacobi: Array | None = None, title: str | None = None, outputs: Outputs = _NONE,
    words: str = "",
) -> None:  # fmt: skip
    """Write the figure of a run to `path`; its suffix says how: .png, .svg or .pdf.

    t: (n,), s; q, qd: (n, nq); energy: (n,); jacobi: (n,), where it is not the energy; outputs:
    (n,) by name; words: what was put in and lost. Raises EomcError without matplotlib, with another
    suffix, or where the file can't be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise EomcError(f"{path}: a picture is written as {', '.join(SUFFIXES)}: end its name so")
    made = figure(system, t, q, qd, energy, title, jacobi, outputs, words)
    import matplotlib

    undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(suffix)
    try:
        with matplotlib.rc_context({"svg.hashsalt": "eomc", "text.usetex": False}):
            made.savefig(path, dpi=150, metadata=undated)
    except OSError as fault:
        raise EomcError(f"{path}: can't be written ({fault.strerror or fault})") from None


def figure(
    system: System, t: Array, q: Array, qd: Array, energy: Array, title: str | None = None,
    jacobi: Array | None = None, outputs: Outputs = _NONE, words: str = "",
) -> Figure:  # fmt: skip
    """The figure of a run. t: (n,), s; q, qd: (n, nq); energy, jacobi, each of outputs: (n,)."""
    try:
        import matplotlib.figure
    except ImportError:
        raise EomcError("drawing needs matplotlib: pip install matplotlib") from None
    with matplotlib.rc_context({"text.usetex": False}):  # a title and units are no LaTeX
        name = title or system.title or system.name
        return _figure(system, t, q, qd, energy, name, jacobi, outputs, words)


def _figure(
    system: System,
    t: Array,
    q: Array,
    qd: Array,
    energy: Array,
    title: str,
    jacobi: Array | None,
    outputs: Outputs,
    words: str,
) -> Figure:
    from matplotlib.figure import Figure

    every = max(len(t) // SAMPLES, 1)
    t, q, qd, energy = (np.asarray(a, dtype=float)[::every] for a in (t, q, qd, energy))
    if jacobi is not None:
        jacobi = np.asarray(jacobi, dtype=float)[::every]

    groups, asked = _groups(system), _by_unit(system, outputs)
    picture = _picture(system, t, q, qd)
    rows = len(groups) + len(asked) + 1
    made = Figure(figsize=(12, min(2.1 * rows + 0.5, 9)), layout="constrained")
    made.suptitle(texts.figure(title), fontsize=13, color=INK)
    widths = [1, 1, 1.35] if picture else [1, 1]
    grid = made.add_gridspec(rows, len(widths), width_ratios=widths)

    first: Axes | None = None
    for row, group in enumerate(groups):
        for column, values in enumerate((q, qd)):
            axes = made.add_subplot(grid[row, column], sharex=first)
            first = first or axes
            shown = [system.coordinates[i] for i in group]
            _against_time(axes, t, values[:, group], shown, rate=column == 1)
    for row, some in enumerate(asked, len(groups)):
        axes = made.add_subplot(grid[row, :2], sharex=first)
        values = np.column_stack([np.asarray(outputs[o.name], float)[::every] for o in some])
        _against_time(axes, t, values, some, rate=False, kind="outputs")
    axes = made.add_subplot(grid[-1, :2], sharex=first)
    unit = "J" if any(c.unit for c in system.coordinates) else ""
    _energy(axes, t, energy, jacobi, unit, words)
    axes.set_xlabel("$t$ (s)")
    if len(t) > 1 and t[-1] > t[0]:
        axes.set_xlim(t[0], t[-1])  # and of all that share it
    made.align_ylabels()
    if picture:
        picture.draw(made.add_subplot(grid[:, 2]))
    return made


# --- names and units ------------------------------------------------------------------------------


def mathtext(name: str, rate: bool = False) -> str:
    r"""A name as it is printed: theta_1 or theta1 as $\theta_{1}$, m_c as $m_{\mathrm{c}}$.

    >>> mathtext("theta_1", rate=True)
    '$\\dot{\\theta}_{1}$'
    """
    head, *rest = name.split("_")
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", head):
        head, rest = digits[1], [digits[2], *rest]
    symbol, *below = (_upright(part) for part in (head, *rest))
    if len(head) == 1:
        symbol = head
    if rate:
        symbol = rf"\dot{{{symbol}}}"
    return f"${symbol}_{{{','.join(below)}}}$" if below else f"${symbol}$"


def _upright(word: str) -> str:
    if word in names.GREEK.values():
        return str(translate(word))
    return word if word.isdigit() else rf"\mathrm{{{word}}}"


def _label(coordinate: Coordinate | Output, rate: bool = False) -> str:
    return _with_unit(mathtext(coordinate.name, rate), _unit(coordinate.unit, rate))


def _unit(unit: str, rate: bool) -> str:
    return f"{unit}/s" if unit and rate else unit


def _with_unit(text: str, unit: str) -> str:
    return f"{text} ({texts.figure(unit)})" if unit else text


# --- against time ---------------------------------------------------------------------------------


def _groups(system: System) -> list[list[int]]:
    """Which coordinates share axes: none up to ROWS, beyond that those of one unit."""
    n = len(system.coordinates)
    if n <= ROWS:
        return [[i] for i in range(n)]
    units = [c.unit for c in system.coordinates]
    groups = []
    for unit in dict.fromkeys(units):
        mine = [i for i in range(n) if units[i] == unit]
        size = max(len(COLOURS), -(-n // ROWS))
        parts = -(-len(mine) // size)
        groups += [list(map(int, part)) for part in np.array_split(mine, parts)]
    return groups


def _by_unit(system: System, outputs: Outputs) -> list[list[Output]]:
    """Which outputs share axes: none up to ROWS, beyond that those of one unit."""
    mine = [o for o in system.outputs if o.name in outputs]
    if len(mine) <= ROWS:
        return [[o] for o in mine]
    return [[o for o in mine if o.unit == unit] for unit in dict.fromkeys(o.unit for o in mine)]


def _against_time(
    axes: Axes, t: Array, values: Array, coordinates: Sequence[Coordinate | Output], rate: bool,
    kind: str = "coordinates",
) -> None:  # fmt: skip
    for c, x, colour in zip(coordinates, values.T, _colours(len(coordinates)), strict=True):
        axes.plot(t, x, color=colour, label=mathtext(c.name, rate))
    _plain(axes)
    first = coordinates[0]
    if len(coordinates) == 1:
        axes.set_ylabel(_label(first, rate))
    else:
        axes.set_ylabel(_with_unit("velocities" if rate else kind, _unit(first.unit, rate)))
        lines = axes.get_lines()
        some = lines if len(lines) <= 8 else [lines[0], lines[len(lines) // 2], lines[-1]]
        axes.legend(handles=some, fontsize=8, frameon=False, ncols=1, loc="center left",
                    bbox_to_anchor=(1.0, 0.5), handlelength=1.0, borderaxespad=0.2)  # fmt: skip


def _energy(
    axes: Axes, t: Array, energy: Array, jacobi: Array | None, unit: str, words: str
) -> None:
    """E, or E - E(0) where it is conserved so well that E would be a straight line.

    Where Jacobi's integral J is another, both from where they start. words: where it went.
    """
    change = energy - energy[:1]
    drift = float(np.max(np.abs(change), initial=0.0))
    conserved = jacobi is not None or drift <= 0.01 * float(np.max(np.abs(energy), initial=0.0))
    axes.plot(t, change if conserved else energy, color=INK, label="energy, not conserved")
    label = "$E - E(0)$" if conserved else "$E$"
    told, of = f", max $|E - E(0)|$ = {_quantity(drift, unit, 2)}", ""
    if jacobi is not None:
        other, of = jacobi - jacobi[:1], "Jacobi's integral: "
        axes.plot(t, other, color=COLOURS[1], label=of[:-2] + ("" if words else ", conserved"))
        axes.legend(fontsize=8, frameon=False, loc="upper left")
        label = "$E - E(0)$, $J - J(0)$"
        told += f"; {of}max $|J - J(0)|$ = {_quantity(float(np.abs(other).max()), unit, 2)}"
    if words:
        told = "; " + of + texts.figure(words).replace("; ", "\n")
    _plain(axes)
    axes.set_ylabel(_with_unit(label, unit))
    start = _quantity(float(energy[0]), unit) if len(energy) else "?"
    axes.set_title(f"Energy: $E(0)$ = {start}{told}", fontsize=10, color=INK)
    if drift == 0 and jacobi is None:
        axes.set_ylim(-1, 1)


def _quantity(value: float, unit: str, digits: int = 4) -> str:
    text = f"{value:.{digits}g}".replace("-", "\N{MINUS SIGN}")
    if "e" in text:
        mantissa, exponent = f"{value:.{digits}g}".split("e")
        text = rf"${mantissa}\times10^{{{int(exponent)}}}$"
    return f"{text} {texts.figure(unit)}".rstrip()


def _colours(n: int) -> list[Any]:
    if n <= len(COLOURS):
        return list(COLOURS[:n])
    import matplotlib

    return list(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, n)))


def _plain(axes: Axes) -> None:
    """Light grid, no box, thin lines."""
    axes.grid(True, color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK)
    axes.tick_params(colors=INK, labelsize=9, length=3)
    axes.ticklabel_format(axis="y", scilimits=(-3, 4), useMathText=True)
    for line in axes.get_lines():
        line.set_linewidth(1.3)


# --- the picture ----------------------------------------------------------------------------------


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
        _plain(axes)
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
        _plain(axes)
        axes.plot(*self.values[0], "o", color=COLOURS[0], markerfacecolor="white", markersize=5)
        axes.plot(*self.values[-1], "o", color=COLOURS[0], markersize=5)
        axes.set_xlabel(self.labels[0])
        axes.set_ylabel(self.labels[1])
        axes.locator_params(nbins=7)
        axes.set_title(f"{self.title}, from ring to dot", fontsize=10, color=INK)


def _picture(system: System, t: Array, q: Array, qd: Array) -> _Plane | _Path | None:
    """What a person expects to see of the system next to its curves."""
    if len(t) == 0:
        return None
    if plane := _plane(system, t, q) or _polar(system, t, q):
        return plane
    if len(system.q) == 1:
        (c,) = system.coordinates
        labels = (_label(c), _label(c, rate=True))
        return _Path(np.hstack([q, qd]), labels, "Phase portrait")
    if len(system.q) == 2:
        first, second = map(_label, system.coordinates)
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
    return _Plane(t, points, parents, (_with_unit(x, unit), _with_unit(y, unit)))


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
    return _Plane(t, [("", path)], [None], (_with_unit(f"${x}$", unit), _with_unit(f"${y}$", unit)))
