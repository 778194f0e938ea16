"""Figures of a run: curves against time, and a picture of the mechanism.

Requires matplotlib, which is an optional dependency. No display is needed, since pyplot is not
used.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.model.system import Coordinate, System
from eomc.report import picture as pictures
from eomc.report.style import COLOURS, INK, format_axes
from eomc.runtime.atomic_write import atomic_write
from eomc.runtime.labels import mathtext, rate_unit, with_unit
from eomc.runtime.plot import Curve, against, grouped, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg", ".pdf")

MAX_SAMPLES = 20_000  # rows of a run that are drawn


@dataclass(frozen=True)
class RunCurves:
    """The quantities of a run that its figure shows, at n times.

    Attributes
    ----------
    t : array (n,)
        Times in s.
    q, qd : arrays (n, nq)
        Coordinates and velocities.
    energy : array (n,)
        Total energy K + P.
    jacobi : array (n,) or None
        Jacobi's integral, if it differs from the energy.
    outputs, inputs : mappings from names to arrays (n,)
        Outputs and inputs to plot.
    balance : str
        The energy balance in words, for the heading of the plot of the energy; "" for none.
    """

    t: Array
    q: Array
    qd: Array
    energy: Array
    jacobi: Array | None = None
    outputs: Mapping[str, Array] = field(default_factory=dict)
    inputs: Mapping[str, Array] = field(default_factory=dict)
    balance: str = ""

    @classmethod
    def from_run(cls, run: Any, balance: str = "") -> RunCurves:
        """Return the curves of a run. An adaptive run with few rows is interpolated.

        balance: the energy balance of the run in words.
        """
        drawn, model = run.curve_run, run.model
        jacobi = drawn.jacobi if model.functions.has_jacobi else None
        inputs = dict(zip(model.info.inputs, drawn.u.T, strict=True)) if model.info.inputs else {}
        return cls(drawn.t, drawn.q, drawn.qd, drawn.energy, jacobi, drawn.outputs, inputs, balance)

    def thin(self, every: int) -> RunCurves:
        """Return only the rows 0, `every`, 2 `every`, ... as numbers of double precision."""

        def rows(values: Array) -> Array:
            return np.asarray(values, dtype=float)[::every]

        return replace(
            self,
            t=rows(self.t),
            q=rows(self.q),
            qd=rows(self.qd),
            energy=rows(self.energy),
            jacobi=None if self.jacobi is None else rows(self.jacobi),
            outputs={name: rows(values) for name, values in self.outputs.items()},
            inputs={name: rows(values) for name, values in self.inputs.items()},
        )


def write_figure(
    system: System, run: RunCurves, path: str | Path, *, title: str | None = None,
    wrap: bool = False,
) -> None:  # fmt: skip
    """Write the figure of a run to a file.

    Parameters
    ----------
    system : System
        The simulated system, with the names and units of its quantities.
    run : RunCurves
        The quantities of the run.
    path : path
        The suffix determines the format: .png, .svg or .pdf.
    title : str, optional
        Heading in place of the title of the system.
    wrap : bool, optional
        Show angles in the range from -pi to pi.

    Raises
    ------
    EomcError
        If matplotlib is not installed, the suffix is unknown, or the file can't be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise EomcError(f"{path}: a picture is written as {', '.join(SUFFIXES)}: end its name so")
    result = make_figure(system, run, title, wrap)
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
    system: System, run: RunCurves, title: str | None = None, wrap: bool = False
) -> Figure:
    """Return the matplotlib figure of a run; the arguments are those of `write_figure`.

    Raises EomcError if matplotlib is not installed.
    """
    try:
        import matplotlib.figure
    except ImportError:
        raise EomcError("drawing needs matplotlib: pip install matplotlib") from None
    with matplotlib.rc_context({"text.usetex": False}):  # a title and units are no LaTeX
        every = max(len(run.t) // MAX_SAMPLES, 1)
        return _draw(system, run.thin(every), title or system.title or system.name, wrap)


def _draw(system: System, run: RunCurves, title: str, wrap: bool) -> Figure:
    from matplotlib.figure import Figure

    t, q, qd = run.t, run.q, run.qd
    moving = [
        (
            Curve(c.name, wrapped(q[:, i]), c.unit, "angles")
            if wrap and c.unit == "rad"
            else Curve(c.name, q[:, i], c.unit, "coordinates"),
            _rate(c, qd[:, i]),
        )
        for i, c in enumerate(system.coordinates)
    ]
    rates = {c.name: rate for c, rate in moving}
    modes = (system.coordinates[m.at].name for m in system.modes)
    discrete = {*system.discrete, *modes}  # between jumps
    groups = grouped([c for c, _ in moving])
    below = grouped(
        [
            Curve(x.name, values[x.name], x.unit, kind)
            for kind, some, values in (
                ("inputs", system.inputs, run.inputs), ("outputs", system.outputs, run.outputs)
            )
            for x in some
            if x.name in values
        ]
    )  # fmt: skip
    picture = pictures.make_picture(system, t, q, qd)
    rows = len(groups) + len(below) + 1
    height = min(2.1 * rows + 0.5, max(9, 1.5 * rows))
    result = Figure(figsize=(12, height), layout="constrained")
    if title.strip():
        result.suptitle(texts.figure(title), fontsize=13, color=INK)
    widths = [1, 1, 1.35] if picture else [1, 1]
    grid = result.add_gridspec(rows, len(widths), width_ratios=widths)

    first: Axes | None = None
    for row, group in enumerate(groups):
        going = [rates[c.name] for c in group if c.name not in discrete]
        for column, curves in enumerate((group, going) if going else (group,)):
            place = grid[row, column] if going else grid[row, :2]
            axes = result.add_subplot(place, sharex=first)
            first = first or axes
            _curves(axes, t, curves)
    for row, group in enumerate(below, len(groups)):
        _curves(result.add_subplot(grid[row, :2], sharex=first), t, group)
    axes = result.add_subplot(grid[-1, :2], sharex=first)
    unit = "J" if any(c.unit for c in system.coordinates) else ""
    _energy(axes, run, unit)
    axes.set_xlabel("$t$ (s)")
    if len(t) > 1 and t[-1] > t[0]:
        axes.set_xlim(t[0], t[-1])  # and of all that share it
    result.align_ylabels()
    if picture:
        picture.draw(result.add_subplot(grid[:, 2]))
    return result


# --- against time ---------------------------------------------------------------------------------


def _rate(c: Coordinate, values: Array) -> Curve:
    return Curve(c.name, values, rate_unit(c.unit, True), "velocities", mathtext(c.name, True))


def _curves(axes: Axes, t: Array, curves: Sequence[Curve]) -> None:
    axes.set_prop_cycle(color=_colours(len(curves)))
    lines = against(axes, t, curves)
    format_axes(axes)
    if len(lines) > 1:
        some = lines if len(lines) <= 8 else [lines[0], lines[len(lines) // 2], lines[-1]]
        axes.legend(handles=some, fontsize=8, frameon=False, ncols=1, loc="center left",
                    bbox_to_anchor=(1.0, 0.5), handlelength=1.0, borderaxespad=0.2)  # fmt: skip


def _energy(axes: Axes, run: RunCurves, unit: str) -> None:
    """Plot E, or E - E(0) if the energy is nearly conserved and E would be a straight line.

    If Jacobi's integral J differs from the energy, both are plotted relative to their initial
    values.
    """
    t, energy, jacobi, words = run.t, run.energy, run.jacobi, run.balance
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


def _colours(n: int) -> list[Any]:
    if n <= len(COLOURS):
        return list(COLOURS[:n])
    import matplotlib

    return list(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, n)))
