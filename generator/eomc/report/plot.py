"""Figures of a run: curves against time, and a picture of the mechanism.

Requires matplotlib, which is an optional dependency. No display is needed, since pyplot is not
used.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.model.system import System
from eomc.report import picture as pictures
from eomc.report.style import COLOURS, INK, choose_colours, format_axes
from eomc.runtime.atomic_write import atomic_write
from eomc.runtime.labels import with_unit
from eomc.runtime.plot import MAX_ROWS, Curve, Source, against, grouped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    picture = pictures.make_picture(system, t[::every], q, qd)
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
