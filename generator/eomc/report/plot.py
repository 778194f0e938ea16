"""Figures of a run: curves against time, and a picture of the mechanism or of a path beside them.

Requires matplotlib, which is an optional dependency. No display is needed, since pyplot is not
used.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from colorsys import hls_to_rgb
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from eomc.base import names, texts
from eomc.base.errors import EomcError, writing
from eomc.model.system import Coordinate, Output, System
from eomc.report.drawing import TRAVEL_LIMIT, Drawing, Mark, draw_mechanism, find_system
from eomc.runtime.atomic_write import atomic_write
from eomc.runtime.plot import (
    MAX_ROWS,
    Curve,
    Source,
    against,
    grouped,
    mathtext,
    of_words,
    rate_unit,
    with_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Okabe and Ito's colours, distinct in every kind of colour vision; yellow left out on white
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, FAINT = "#333333", "#DDDDDD"


def choose_colours(count: int) -> tuple[str, ...]:
    """Return `count` distinct colours as texts such as "#0072B2".

    They are the first of COLOURS, or hues from red to violet if COLOURS has too few.
    """
    if count <= len(COLOURS):
        return COLOURS[:count]
    hues = (k / count * 5 / 6 for k in range(count))
    shades = (tuple(round(255 * x) for x in hls_to_rgb(hue, 0.36, 0.75)) for hue in hues)
    return tuple("#{:02X}{:02X}{:02X}".format(*shade) for shade in shades)


def format_axes(axes: Axes, lines: bool = True) -> None:
    """Format matplotlib axes: a light grid, no box, and thin lines for the curves drawn so far.

    lines: False to leave the width of the curves unchanged.
    """
    axes.grid(True, color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK)
    axes.tick_params(colors=INK, labelsize=9, length=3)
    axes.ticklabel_format(axis="y", scilimits=(-3, 4), useMathText=True)
    for line in axes.get_lines() if lines else ():
        line.set_linewidth(1.3)


# --- names and units ------------------------------------------------------------------------------

_LETTERS = {word: letter for letter, word in names.GREEK.items()}


def label(coordinate: Coordinate | Output, rate: bool = False) -> str:
    """Return the axis label of a coordinate or output for matplotlib: its symbol and its unit.

    rate: True for the label of its time derivative.
    """
    return with_unit(mathtext(coordinate.name, rate), rate_unit(coordinate.unit, rate))


def html_name(name: str, rate: bool = False) -> str:
    """Return a name as HTML: theta_1 as θ with a subscript; names of whole words stay words.

    rate: True to put a dot above the symbol, for the time derivative.

    >>> html_name("theta_1"), html_name("wrist_1_joint")
    ('θ<sub>1</sub>', 'wrist 1 joint')
    """
    if of_words(name):
        return texts.name(name).replace("_", " ") + ("\N{DOT ABOVE}" if rate else "")
    head, *rest = texts.name(name).split("_")
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", head):
        head, rest = digits[1], [digits[2], *rest]
    symbol, *below = (_LETTERS.get(part, part) for part in (head, *rest))
    if rate:  # after the word: a dot would be set on one of its letters
        symbol += "\N{DOT ABOVE}" if len(symbol) > 1 else "\N{COMBINING DOT ABOVE}"
    return f"{symbol}<sub>{','.join(below)}</sub>" if below else symbol


MAX_GHOSTS = 16  # earlier instants at which a small mechanism is drawn
MANY_MARKS = 24  # above it, fewer instants are drawn
PICTURE_ROWS = 5000  # approximate number of rows from which a small picture is made
AZIMUTH, ELEVATION = -60.0, 20.0  # degrees, direction from which drawings in space are viewed
BODY, GHOST = "#4D4D4D", 0.80  # colour of rods; lightest grey of an earlier instant


def make_picture(system: System, t: Array, q: Array, qd: Array) -> Mechanism | PlaneCurve | None:
    """Return a picture of a run, for the figure of its motion.

    t: times (n,) in s. q, qd: coordinates and velocities (n, nq). The picture shows the mechanism
    if the scene describes its shape. Otherwise it is a phase portrait if nq = 1, or the path in
    configuration space if nq = 2. Returns None for nq > 2 without a shape, or if `t` is empty.
    """
    if not len(t):
        return None
    if result := draw_mechanism(system, t, q):
        return Mechanism(t, result)
    if len(system.q) == 1:
        (c,) = system.coordinates
        return PlaneCurve(np.hstack([q, qd]), (label(c), label(c, rate=True)), "Phase portrait")
    if len(system.q) == 2:
        first, second = map(label, system.coordinates)
        return PlaneCurve(q, (first, second), "Configuration space")
    return None


def of_run(run: Any) -> Mechanism | None:
    """Return the picture of the mechanism of a run at its stored times.

    Returns None if the scene of the run is unknown or does not describe the shape of the mechanism.
    """
    try:
        system = find_system(run)
    except EomcError:
        return None
    t, q = (np.asarray(x, dtype=float)[:: max(len(run) // PICTURE_ROWS, 1)] for x in (run.t, run.q))
    result = draw_mechanism(system, t, q)
    return Mechanism(t, result) if result else None


@dataclass(frozen=True)
class PlaneCurve:
    """A plot of one quantity against another: a phase portrait or a path in configuration space.

    values: (n, 2), the horizontal and vertical quantity. labels: labels of the two axes.
    """

    values: Array
    labels: tuple[str, str]
    title: str

    def draw(self, axes: Axes) -> None:
        """Draw the curve into `axes`, with a ring at its start and a dot at its end."""
        axes.plot(*self.values.T, color=COLOURS[0])
        format_axes(axes)
        axes.plot(*self.values[0], "o", color=COLOURS[0], markerfacecolor="white", markersize=5)
        axes.plot(*self.values[-1], "o", color=COLOURS[0], markersize=5)
        axes.set_xlabel(self.labels[0])
        axes.set_ylabel(self.labels[1])
        axes.locator_params(nbins=7)
        axes.set_title(f"{self.title}, from ring to dot", fontsize=10, color=INK)


@dataclass(frozen=True)
class Mechanism:
    """A picture of a mechanism at several instants of a run, with the paths of its points.

    t: times (n,) in s. drawing: the drawing of the mechanism at these times. Earlier instants are
    drawn in a lighter colour.
    """

    t: Array
    drawing: Drawing

    def draw(self, axes: Axes) -> None:
        """Draw the picture into `axes`. A mechanism in space is seen slightly from above."""
        picture = self.drawing
        flat = self._visible_part(project_points(picture))
        paths = [(p.name, flat[:, p.point]) for p in picture.paths]
        shapes = sum(mark.kind in LINES for mark in picture.marks)
        last = self._stretch(flat) if shapes else len(flat) - 1
        ghosts = self._ghosts(last)
        for k, i in enumerate(ghosts):
            shade = str(GHOST - 0.35 * k / max(len(ghosts) - 1, 1))
            draw_marks(axes, picture, flat[i], shade)
        for (name, path), colour in zip(paths, COLOURS, strict=False):
            words = f"path of {_name(name)}" if name else "path"
            axes.plot(*path.T, color=colour, linewidth=1.0, label=words, zorder=2)
        if picture.marks:
            draw_marks(axes, picture, flat[last])
        for (_, path), colour in zip(paths, COLOURS, strict=False):
            axes.plot(*path[last], "o", color=colour, markersize=5, zorder=6)
        frame(axes, picture, flat)
        end = f", t = 0 to {self.t[last]:.3g} s" if ghosts.size else ""
        where = "In the plane" if picture.is_planar else "In space"
        axes.set_title(where + end, fontsize=10, color=INK)
        if paths:
            axes.legend(fontsize=8, frameon=False, loc="upper right")

    def _visible_part(self, flat: Array) -> Array:
        """Return the initial part of the motion, if the mechanism travels too far to be seen."""
        if not self.drawing.travels:
            return flat
        distance = np.abs(flat - flat[0]).max(axis=(1, 2))
        return flat[: max(int(np.argmax(distance > TRAVEL_LIMIT / 2 * self.drawing.max_extent)), 1)]

    def _ghosts(self, last: int) -> NDArray[np.int64]:
        """Return the earlier instants that are drawn."""
        shapes = sum(mark.kind in LINES for mark in self.drawing.marks)
        if not shapes or not last:
            return np.array([], dtype=int)
        springs = any(mark.kind in ("spring", "damper") for mark in self.drawing.marks)
        few = 5 if springs else 8 if shapes > 6 or not self.drawing.is_planar else MAX_GHOSTS
        count = few if shapes <= MANY_MARKS else 3
        return np.unique(np.linspace(0, last, count).round().astype(int))[:-1]

    def _stretch(self, flat: Array) -> int:
        """Return the last drawn sample.

        Up to it, the point that moves most has moved 1.5 times the extent of its path.
        """
        steps = np.nan_to_num(np.linalg.norm(np.diff(flat, axis=0), axis=2))
        if not len(steps):
            return 0
        reach = max(float(np.nanmax(np.ptp(flat, axis=0), initial=0.0)), 1e-12)
        furthest = steps[:, steps.sum(axis=0).argmax()]
        distance = np.concatenate([[0.0], np.cumsum(furthest)])
        return min(int(np.searchsorted(distance, 1.5 * reach)), len(flat) - 1)


def _name(name: str) -> str:
    """Return the name of a point, or the pair of its coordinates' names."""
    if name.startswith("("):
        return "(" + ", ".join(map(mathtext, name[1:-1].split(", "))) + ")"
    return texts.figure(name.replace("_", " "))


# --- a view of space ------------------------------------------------------------------------------


def view_basis(up: int) -> Array:
    """Return the unit vectors to the right, upwards and towards the viewer as rows of a 3x3 matrix.

    They define the view of drawings in space. up: index (0, 1, 2) of the axis that points upwards.
    """
    a, e = np.radians([AZIMUTH, ELEVATION])
    right = [-np.sin(a), np.cos(a), 0.0]
    above = [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]
    near = [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
    return np.roll([right, above, near], (up - 2) % 3, axis=1)


def project_points(picture: Drawing) -> Array:
    """Return the points of a drawing projected onto the plane of the picture.

    The result has shape (n, number of points, 2), for n instants.
    """
    return picture.points if picture.is_planar else picture.points @ view_basis(picture.up)[:2].T


def frame(axes: Axes, picture: Drawing, flat: Array) -> None:
    """Prepare matplotlib axes for the drawing of a motion: limits, scales and coordinate axes.

    The limits contain the whole motion, and both directions have the same scale. flat: the points
    of `picture` at all n instants, projected onto the plane of the picture, (n, number of points,
    2). A plane drawing gets labelled axes, a drawing in space three arrows and a scale bar.
    """
    low, high = _bounds(flat)
    size = max(float((high - low).max()), 1e-9)
    margin = 0.06 * size
    axes.update_datalim([low, high])
    axes.margins(0.06)
    axes.set_aspect("equal", adjustable="datalim")
    if picture.is_planar:
        format_axes(axes, lines=False)
        names = [mathtext(name) for name in picture.labels]
        axes.set_xlabel(with_unit(names[0], picture.unit))
        axes.set_ylabel(with_unit(names[1], picture.unit))
        axes.locator_params(nbins=7)
        return
    axes.set_axis_off()
    length = 10.0 ** np.floor(np.log10(0.3 * size))
    length *= max(m for m in (1, 2, 5) if m * length <= 0.3 * size)
    x, y = (float(entry) - margin for entry in low)
    for name, (right, above) in zip("xyz", view_basis(picture.up)[:2].T * length, strict=True):
        arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.8}
        axes.annotate("", (x + right, y + above), (x, y), annotation_clip=False, arrowprops=arrow)
        axes.text(x + 1.2 * right, y + 1.2 * above, f"${name}$", color=INK, fontsize=9,
                  ha="center", va="center")  # fmt: skip
    words = f"{length:g} {texts.figure(picture.unit)}".strip()
    axes.annotate(words, (x, y), (0, -12), textcoords="offset points", color=INK, fontsize=8,
                  ha="center", annotation_clip=False)  # fmt: skip


def _bounds(flat: Array) -> tuple[Array, Array]:
    points = flat.reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.zeros(2), np.ones(2)
    return points.min(axis=0), points.max(axis=0)


# --- a drawing at one instant ---------------------------------------------------------------------

LINES = {"line": 1.8, "rod": 2.0, "arm": 1.0, "rail": 0.8, "spring": 1.0, "damper": 1.0, "box": 1.0,
         "inertia": 0.5, "circle": 1.0}  # fmt: skip
SYMBOLS = {"joint": ("o", 4.5, "white"), "slide": ("s", 6, "white"), "ground": ("^", 7, "#BBBBBB"),
           "mass": ("o", 4, INK), "point": ("D", 3, INK), "dot": ("o", 5, INK),
           "spiral": ("o", 9, "none")}  # fmt: skip
SKIPPED = frozenset(("rail", "arm", "inertia"))  # at earlier instants


def draw_marks(
    axes: Axes, picture: Drawing, flat: Array, shade: str = "", hues: Sequence[str] = ()
) -> list[Line2D]:
    """Draw the marks of a drawing at one instant into `axes`; return the matplotlib lines.

    flat: the projected points at that instant, (number of points, 2). shade: grey level such as
    "0.8" for an earlier instant, drawn without symbols; "" for full colours. hues: the colours of
    the instances, if several are drawn over each other.
    """
    return [
        line
        for points, look in shapes(picture, flat, shade, hues)
        for line in axes.plot(*points.T, **look)
    ]


def shapes(
    picture: Drawing, flat: Array, shade: str = "", hues: Sequence[str] = ()
) -> Iterator[tuple[Array, dict[str, Any]]]:
    """Yield the lines and symbols of all marks at one instant, as pairs (points, style).

    In each pair, points is an array (k, 2) and style a dict of keyword arguments for `axes.plot`.
    The arguments are those of `draw_marks`. The number of pairs is the same at every instant, so
    that a film can update the lines. If a point of a mark is not finite, its lines consist of nan.
    """
    widest = np.linalg.norm(np.nanmax(flat, axis=0) - np.nanmin(flat, axis=0))
    width = 0.02 * float(widest)
    pairs = [frozenset(m.points) for m in picture.marks if m.kind in ("spring", "damper")]
    for mark in picture.marks:
        points = flat[list(mark.points)]
        if not np.isfinite(points).all():
            points = np.full_like(points, np.nan)
        ink, rod = (INK, BODY) if mark.instance is None else (hues[mark.instance],) * 2
        if mark.kind in LINES:
            if shade and (mark.kind in SKIPPED and len(picture.marks) > 3):
                continue
            offset = width * 1.4 if pairs.count(frozenset(mark.points)) > 1 else 0.0
            look = {
                "color": shade or (rod if mark.kind != "line" else ink),
                "linewidth": LINES[mark.kind] * (0.7 if shade else 1.0),
                "zorder": 1 if shade else 3,
                "linestyle": (0, (4, 3)) if mark.kind == "rail" else "-",
                "solid_capstyle": "round",
                "solid_joinstyle": "round",
            }
            for line in outline(mark, points, width, offset):
                yield line, look
        elif not shade:
            symbol, size, face = SYMBOLS[mark.kind]
            face = ink if face == INK else face
            yield points[:1], {"marker": symbol, "linestyle": "none", "color": ink, "zorder": 4,
                               "markersize": size, "markerfacecolor": face,
                               "markeredgewidth": 0.9}  # fmt: skip
            if mark.kind == "mass" and len(points) == 2:  # how it is turned
                direction = points[1] - points[0]
                tick = points[0] + direction / np.linalg.norm(direction) * 2 * width
                yield np.array([points[0], tick]), {"color": ink, "linewidth": 1.2, "zorder": 4}


def outline(mark: Mark, points: Array, width: float, offset: float) -> Iterator[Array]:
    """Yield the lines that draw a mark, as arrays of points (k, 2).

    points: projected positions of the points of the mark, (number of points, 2). width: half the
    width of a coil or dashpot. offset: sideways shift of a spring, and opposite shift of a damper,
    if both are drawn between the same points. Both lengths are in the unit of `points`.
    """
    if mark.kind in ("box", "inertia"):
        yield from _box(points)
    elif mark.kind == "circle":
        turn = np.linspace(0, 2 * np.pi, 49)[:, None]
        yield (
            points[0]
            + np.cos(turn) * (points[1] - points[0])
            + np.sin(turn) * (points[2] - points[0])
        )
    elif mark.kind in ("spring", "damper"):
        yield from _coil_or_dashpot(points, width, offset, mark.kind)
    else:
        yield points


def _box(points: Array) -> Iterator[Array]:
    """Yield the edges of a box, given its centre and the tips of its half axes."""
    center, halves = points[0], points[1:] - points[0]
    if len(halves) == 2:
        a, b = halves
        yield center + _parallelogram(a, b)
        return
    a, b, c = halves
    for side in (c, -c):
        yield center + side + _parallelogram(a, b)
    for corner in (a + b, a - b, -a - b, b - a):
        yield center + np.array([corner + c, corner - c])


def _parallelogram(a: Array, b: Array) -> Array:
    """Return the closed outline of a parallelogram about the origin with half axes a and b."""
    return np.array([a + b, a - b, -a - b, b - a, a + b])


_COIL_HALF_TURNS = 12
_DASHPOT = (  # lines as (along, across), from one end to the other
    ((0, 0), (0.4, 0)), ((0.65, 1), (0.4, 1), (0.4, -1), (0.65, -1)), ((0.55, 0.7), (0.55, -0.7)),
    ((0.55, 0), (1, 0)),
)  # fmt: skip


def _coil_or_dashpot(points: Array, width: float, offset: float, kind: str) -> Iterator[Array]:
    """Yield the lines of a coil or a dashpot between two points."""
    start, direction = points[0], points[1] - points[0]
    length = float(np.linalg.norm(direction))
    across = np.array([-direction[1], direction[0]]) / length if length else np.zeros(2)
    shift = across * (offset if kind == "spring" else -offset)
    if kind == "spring":
        s = np.concatenate(
            [
                [0.0, 0.15],
                0.15 + 0.7 * (np.arange(_COIL_HALF_TURNS) + 0.5) / _COIL_HALF_TURNS,
                [0.85, 1],
            ]
        )
        y = np.concatenate([[0, 0], np.resize([1.0, -1.0], _COIL_HALF_TURNS), [0, 0]])
        yield start + shift + s[:, None] * direction + y[:, None] * across * width
        return
    for part in _DASHPOT:
        s, y = np.array(part).T[:, :, None]
        yield start + shift + s * direction + y * across * width


Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg", ".pdf")


def write_figure(
    system: System, run: Any, path: str | Path, *, title: str | None = None,
    wrap: bool = False, balance: str = "",
) -> None:  # fmt: skip
    """Write the figure of a run to a file.

    Parameters
    ----------
    system : System
        The simulated system, with the names and units of its quantities.
    run : Trajectory
        The run. An adaptive run with few rows is interpolated.
    path : path
        The suffix determines the format: .png, .svg or .pdf.
    title : str, optional
        Heading in place of the title of the system.
    wrap : bool, optional
        Show angles in the range from -pi to pi.
    balance : str, optional
        The energy balance of the run in words, for the heading of the plot of the energy.

    Raises
    ------
    EomcError
        If matplotlib is not installed, the suffix is unknown, or the file can't be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise EomcError(f"{path}: a picture is written as {', '.join(SUFFIXES)}: end its name so")
    result = make_figure(system, run, title, wrap, balance)
    import matplotlib

    undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(suffix)
    drawn = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "eomc", "text.usetex": False}):
        result.savefig(drawn, format=suffix[1:], dpi=150, metadata=undated)
    with writing(path), atomic_write(path) as new:
        new.write_bytes(drawn.getvalue())


def without_pictures() -> str:
    """Return a message that pictures need matplotlib, or "" if matplotlib is installed."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        return "the page has no pictures, which need matplotlib: pip install matplotlib"
    return ""


def to_svg(figure: Figure) -> Markup:
    """Return a matplotlib figure as SVG text for an HTML page; equal figures give equal text."""
    import matplotlib

    text = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "eomc"}):
        figure.savefig(text, format="svg", metadata={"Date": None}, transparent=True)
    return Markup(text.getvalue()[text.getvalue().index("<svg") :])


def make_figure(
    system: System, run: Any, title: str | None = None, wrap: bool = False, balance: str = ""
) -> Figure:
    """Return the matplotlib figure of a run; the arguments are those of `write_figure`.

    Raises EomcError if matplotlib is not installed.
    """
    try:
        import matplotlib.figure
    except ImportError:
        raise EomcError("drawing needs matplotlib: pip install matplotlib") from None
    with matplotlib.rc_context({"text.usetex": False}):  # a title and units are no LaTeX
        return _draw(system, Source(run, wrap), title or system.title or system.name, balance)


def _draw(system: System, source: Source, title: str, balance: str) -> Figure:
    from matplotlib.figure import Figure

    run, t = source.run, source.t
    groups = grouped([source.curve(c.name) for c in system.coordinates])
    modes = (system.coordinates[m.at].name for m in system.modes)
    discrete = {*system.discrete, *modes}  # between jumps
    others = (*system.inputs, *system.outputs)
    below = grouped([source.curve(x.name) for x in others])
    every = max(len(t) // MAX_ROWS, 1)
    q, qd = (np.asarray(x, float)[::every] for x in (run.q, run.qd))
    picture = make_picture(system, t[::every], q, qd)
    rows = len(groups) + len(below) + 1
    height = min(2.1 * rows + 0.5, max(9, 1.5 * rows))
    result = Figure(figsize=(12, height), layout="constrained")
    if title.strip():
        result.suptitle(texts.figure(title), fontsize=13, color=INK)
    widths = [1, 1, 1.35] if picture else [1, 1]
    grid = result.add_gridspec(rows, len(widths), width_ratios=widths)

    first: Axes | None = None
    for row, group in enumerate(groups):
        going = [source.curve(f"{c.name}_dot") for c in group if c.name not in discrete]
        for column, curves in enumerate((group, going) if going else (group,)):
            place = grid[row, column] if going else grid[row, :2]
            axes = result.add_subplot(place, sharex=first)
            first = first or axes
            _curves(axes, t, curves)
    for row, group in enumerate(below, len(groups)):
        _curves(result.add_subplot(grid[row, :2], sharex=first), t, group)
    axes = result.add_subplot(grid[-1, :2], sharex=first)
    unit = "J" if any(c.unit for c in system.coordinates) else ""
    _energy(axes, source, unit, balance)
    axes.set_xlabel("$t$ (s)")
    if len(t) > 1 and t[-1] > t[0]:
        axes.set_xlim(t[0], t[-1])  # and of all that share it
    result.align_ylabels()
    if picture:
        picture.draw(result.add_subplot(grid[:, 2]))
    return result


# --- against time ---------------------------------------------------------------------------------


def _curves(axes: Axes, t: Array, curves: Sequence[Curve]) -> None:
    axes.set_prop_cycle(color=choose_colours(len(curves)))
    lines = against(axes, t, curves)
    format_axes(axes)
    if len(lines) > 1:
        some = lines if len(lines) <= 8 else [lines[0], lines[len(lines) // 2], lines[-1]]
        axes.legend(handles=some, fontsize=8, frameon=False, ncols=1, loc="center left",
                    bbox_to_anchor=(1.0, 0.5), handlelength=1.0, borderaxespad=0.2)  # fmt: skip


def _energy(axes: Axes, source: Source, unit: str, words: str) -> None:
    """Plot E, or E - E(0) if the energy is nearly conserved and E would be a straight line.

    If Jacobi's integral J differs from the energy, both are plotted relative to their initial
    values. words: the energy balance, for the heading.
    """
    every = max(len(source.t) // MAX_ROWS, 1)
    t, energy = source.t[::every], np.asarray(source.run.energy, float)[::every]
    jacobi = None
    if "jacobi" in source.run.column_names:
        jacobi = np.asarray(source.run.jacobi, float)[::every]
    change = energy - energy[:1]
    drift = float(np.max(np.abs(change), initial=0.0))
    conserved = jacobi is not None or drift <= 0.01 * float(np.max(np.abs(energy), initial=0.0))
    axes.plot(t, change if conserved else energy, color=INK, label="energy, not conserved")
    label = "$E - E(0)$" if conserved else "$E$"
    heading, integral_label = f", max $|E - E(0)|$ = {_quantity(drift, unit, 2)}", ""
    if jacobi is not None:
        other, integral_label = jacobi - jacobi[:1], "Jacobi's integral: "
        axes.plot(
            t, other, color=COLOURS[1], label=integral_label[:-2] + ("" if words else ", conserved")
        )
        axes.legend(fontsize=8, frameon=False, loc="upper left")
        label = "$E - E(0)$, $J - J(0)$"
        heading += (
            f"; {integral_label}max $|J - J(0)|$ = {_quantity(float(np.abs(other).max()), unit, 2)}"
        )
    if words:
        heading = "; " + integral_label + texts.figure(words).replace("; ", "\n")
    format_axes(axes)
    axes.set_ylabel(with_unit(label, unit))
    start = _quantity(float(energy[0]), unit) if len(energy) else "?"
    axes.set_title(f"Energy: $E(0)$ = {start}{heading}", fontsize=10, color=INK)
    if drift == 0 and jacobi is None:
        axes.set_ylim(-1, 1)


def _quantity(value: float, unit: str, digits: int = 4) -> str:
    text = f"{value:.{digits}g}".replace("-", "\N{MINUS SIGN}")
    if "e" in text:
        mantissa, exponent = f"{value:.{digits}g}".split("e")
        text = rf"${mantissa}\times10^{{{int(exponent)}}}$"
    return f"{text} {texts.figure(unit)}".rstrip()
