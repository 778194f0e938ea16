"""Curves of runs, phase portraits and sections, drawn with matplotlib, and summaries in notebooks.

Names, units and values alone are drawn here, in the style that matplotlib is set to. `tex` and
`mathtext` return names in the form that figures and formulas print.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array, not_one_of
from .atomic_write import File
from .columns import imported
from .package import require_eomc

MAX_ROWS = 20_000  # of a drawn curve


@dataclass(frozen=True)
class Curve:
    """A named quantity over the rows of a run, with what a figure prints about it.

    Attributes
    ----------
    name : str
        Name of the column, such as "theta_dot".
    values : (n,) array
        Value at each row.
    unit : str
        Unit, or "".
    kind : str
        "coordinates", "velocities", "angles" (wrapped), "inputs", "outputs", "time" or "energy".
    symbol : str
        The name in mathtext; by default it follows from `name`.
    """

    name: str
    values: Array
    unit: str = ""
    kind: str = ""
    symbol: str = ""

    @property
    def text(self) -> str:
        """The name of the curve in mathtext, the LaTeX subset of matplotlib, for labels."""
        return self.symbol or mathtext(self.name)


def grouped(curves: Sequence[Curve]) -> list[list[Curve]]:
    """Group curves into panels, each with curves of the same kind, the same unit and similar size.

    Return the panels, each a list of its curves.
    """
    # approximate number of curves in a panel; panels of one kind, beyond which size is ignored
    few, max_panels = 6, 4
    panels: list[list[Curve]] = []
    for kind in dict.fromkeys((c.kind, c.unit) for c in curves):
        mine = [c for c in curves if (c.kind, c.unit) == kind]
        parts = _by_size(mine)
        for part in parts if len(parts) <= max_panels else [mine]:
            count = -(-len(part) // max(few, -(-len(curves) // max_panels)))
            size = -(-len(part) // count)
            panels += [part[k : k + size] for k in range(0, len(part), size)]
    return panels


def _by_size(curves: Sequence[Curve]) -> list[list[Curve]]:
    """Group curves by size; a curve joins the first panel with curves of similar size."""
    max_ratio = 30.0  # of the largest to the smallest curve of a panel
    panels: list[tuple[list[Curve], list[float]]] = []
    for curve in curves:
        finite = curve.values[np.isfinite(curve.values)]
        size = float(np.max(np.abs(finite), initial=0.0))
        for members, sizes in panels:
            some = [x for x in (*sizes, size) if x > 0]
            if not some or max(some) <= max_ratio * min(some):
                members.append(curve)
                sizes.append(size)
                break
        else:
            panels.append(([curve], [size]))
    return [members for members, _ in panels]


def wrapped(values: Array) -> Array:
    """Return angles, rad, reduced to the interval [-pi, pi)."""
    return np.asarray((values + np.pi) % (2 * np.pi) - np.pi)


def broken(x: Array, y: Array, *angles: Array) -> tuple[Array, Array]:
    """Return the curve (x, y) with gaps, so that no line is drawn where an angle jumps by a turn.

    A gap is a nan that is inserted before the jump. x, y and each of `angles`, rad, are (n,).
    """
    jumps = np.flatnonzero(sum(np.abs(np.diff(a)) > np.pi for a in angles)) + 1
    return np.insert(x, jumps, np.nan), np.insert(y, jumps, np.nan)


def against(
    axes: Any, x: Array, curves: Sequence[Curve], suffix: str = "", **style: Any
) -> list[Any]:
    """Plot curves over x and label the y axis; return the new lines of matplotlib.

    axes: the Axes to plot into. x: (n,) values on the horizontal axis. suffix: text that is
    appended to the labels of the curves. style: arguments of `Axes.plot`.
    """
    every = max(len(x) // MAX_ROWS, 1)
    lines = []
    for curve in curves:
        at, values = x[::every], np.asarray(curve.values, float)[::every]
        if curve.kind == "angles":
            at, values = broken(at, values, values)
        lines += axes.plot(at, values, label=curve.text + suffix, **style)
    first = curves[0]
    axes.set_ylabel(with_unit(first.text if len(curves) == 1 else first.kind, first.unit))
    return lines


class Source:
    """The columns of a run as curves, with units, kinds and symbols for a figure.

    run: the run. wrap: names of the angles that are reduced to [-pi, pi); True: all coordinates
    with the unit rad. Raises KeyError if one of these names is unknown.
    """

    def __init__(self, run: Any, wrap: bool | Collection[str] = False) -> None:
        model, run = run.model, getattr(run, "curve_run", run)
        self.run, self.t = run, np.asarray(run.t, float)
        self.is_held = run.request.u is not None
        self.coordinates = tuple(model.info.coordinates)
        self._units = dict(model.info.units)
        self._energy = "J" if any(self._units.get(c) for c in model.info.coordinates) else ""
        self._inputs, self._outputs = tuple(model.info.inputs), tuple(model.info.outputs)
        if wrap is True:
            wrap = [c for c in model.info.coordinates if self._units.get(c) == "rad"]
        self._wrap = {wrap} if isinstance(wrap, str) else set(wrap or ())
        for name in self._wrap:
            run[name]  # KeyError, with the names there are

    def default(self) -> list[str]:
        """Return the names of the columns that are drawn by default."""
        return [*self.coordinates, *self._inputs, *self._outputs, "energy"]

    def curve(self, name: str) -> Curve:
        """Return the column `name` of the run as a Curve.

        Raises KeyError, with the known names, for an unknown one.
        """
        values = np.asarray(self.run[name], float)
        rate = name.removesuffix("_dot")
        if name != rate and rate in self.coordinates:
            unit = rate_unit(self._units.get(rate, ""), True)
            return Curve(name, values, unit, "velocities", mathtext(rate, True))
        if name in self._wrap:
            return Curve(name, wrapped(values), self._units.get(name, ""), "angles")
        kinds = {"coordinates": self.coordinates, "inputs": self._inputs, "outputs": self._outputs}
        for kind, names in kinds.items():
            if name in names:
                return Curve(name, values, self._units.get(name, ""), kind)
        if name == "t":
            return Curve(name, values, "s", "time")
        symbol = {"energy": "energy", "jacobi": "Jacobi's integral"}.get(name, "")
        return Curve(name, values, self._energy, "energy", symbol)


class Figure(NamedTuple):
    """Arguments of the methods `plot` of runs and batches that concern the whole figure."""

    wrap: bool | str | Collection[str] = False
    ax: Any = None
    file: File | None = None
    style: Mapping[str, Any] = {}

    def panels(self, count: int, portraits: int = 0) -> list[Any]:
        """Return the Axes of `count` panels and of phase portraits: the user's, or new ones.

        Raises ValueError if the number of the user's Axes does not fit.
        """
        if "axes" in self.style:
            raise ValueError("axes: give ax=, one Axes, or a list with one for each panel")
        if self.ax is None:
            return new_axes(count, portraits)
        all_axes = [*np.ravel(self.ax)]
        if len(all_axes) != count + portraits:
            raise ValueError(
                f"ax: {len(all_axes)} for {count + portraits} panels: give a list, one a panel"
            )
        return all_axes

    def finish(self, all_axes: Sequence[Any]) -> Any:
        """Write the figure to the file, if there is one; return its Axes, several as an array."""
        if self.file is not None:
            figure = all_axes[0].figure
            getattr(figure, "figure", figure).savefig(self.file)  # of a part of a figure the whole
        return all_axes[0] if len(all_axes) == 1 else np.array(all_axes)


def plot(
    run: Any, names: Sequence[str], figure: Figure, phase: Any = None, other: Any = (),
    section: Mapping[str, Array] | None = None, labels: Sequence[str] | None = None,
) -> Any:  # fmt: skip
    """Draw a run, and others to compare, with matplotlib; return the Axes.

    The arguments are those of `Trajectory.plot`.
    """
    no_files(names)
    others = [other] if hasattr(other, "model") else [*(other or ())]
    sources = [Source(each, figure.wrap) for each in (run, *others)]
    suffixes = _suffixes(len(sources), labels)
    pairs = _pairs(phase, sources[0])
    columns = [*names] or ([] if pairs else sources[0].default())
    panels = grouped([sources[0].curve(name) for name in columns])
    if panels and figure.ax is not None and not np.ndim(figure.ax):  # one for all
        panels = [[c for panel in panels for c in panel]]
    all_axes = figure.panels(len(panels), len(pairs))
    for place, panel in zip(all_axes, panels, strict=False):
        _panel(place, sources, [c.name for c in panel], suffixes, figure.style)
    for place, (x, y) in zip(all_axes[len(panels) :], pairs, strict=True):
        _portrait(place, sources, x, y, suffixes, section, figure.style)
    return figure.finish(all_axes)


def no_files(names: Sequence[str]) -> None:
    """Raise ValueError if one of the names ends like that of a picture file, such as ".png".

    names: names of columns that the user wants to plot.
    """
    for name in names:
        if str(name).endswith((".png", ".pdf", ".svg")):
            raise ValueError(f"plot: '{name}' is no column: give file='{name}' to write a picture")


def _suffixes(count: int, labels: Sequence[str] | None) -> list[str]:
    if labels is None:
        return ["", *(f" ({k})" for k in range(2, count + 1))]
    if isinstance(labels, str) or len(labels) != count:
        raise ValueError(f"labels: give {count}, one a run")
    return [f", {plain(str(label))}" for label in labels]


def _pairs(phase: Any, source: Source) -> list[tuple[str, str]]:
    """Return the columns (x, y) of each portrait: a coordinate and its velocity, or a pair."""
    if phase is None:
        return []
    if isinstance(phase, tuple) and len(phase) == 2 and all(isinstance(x, str) for x in phase):
        return [phase]
    if not isinstance(phase, str):
        return [pair for each in phase for pair in _pairs(each, source)]
    if phase not in source.coordinates:
        known = ", ".join(source.coordinates)
        raise ValueError(f"phase: '{phase}' is no coordinate ({known}): give a pair of names")
    return [(phase, f"{phase}_dot")]


def new_axes(panels: int, portraits: int = 0) -> list[Any]:
    """Return the Axes of a new figure: first those of the panels, then those of the portraits.

    panels: number of panels below each other, with a common time axis. portraits: number of phase
    portraits, drawn beside them.
    """
    pyplot = imported("matplotlib.pyplot", "plot")
    width, height = 10.5 if panels and portraits else 6.4, max(4.8, 1.7 * panels, 3.2 * portraits)
    figure = pyplot.figure(figsize=(width, height), layout="constrained")
    columns = figure.subfigures(1, 2, squeeze=False)[0] if panels and portraits else [figure]
    all_axes: list[Any] = []
    if panels:
        all_axes += columns[0].subplots(panels, 1, sharex=True, squeeze=False)[:, 0].tolist()
    if portraits:
        all_axes += columns[-1].subplots(portraits, 1, squeeze=False)[:, 0].tolist()
    return all_axes


def _panel(
    axes: Any, sources: Sequence[Source], names: Sequence[str], suffixes: Sequence[str],
    style: Mapping[str, Any],
) -> None:  # fmt: skip
    colours: list[Any] = []
    for k, (source, suffix) in enumerate(zip(sources, suffixes, strict=True)):
        curves = [source.curve(name) for name in names]
        for i, curve in enumerate(curves):
            own = {"color": colours[i], "linestyle": ("--", ":", "-.")[(k - 1) % 3]} if k else {}
            if curve.kind == "inputs" and source.is_held:
                own["drawstyle"] = "steps-post"
            lines = against(axes, source.t, [curve], suffix, **{**own, **style})
            colours += [line.get_color() for line in lines] if not k else []
    units = dict.fromkeys(c.unit for c in curves)
    kinds = dict.fromkeys(c.kind for c in curves)
    if len(curves) > 1:
        words, unit = (next(iter(x)) if len(x) == 1 else "" for x in (kinds, units))
        axes.set_ylabel(with_unit(words, unit) if words else plain(unit))
    if len(axes.get_lines()) > 1:
        axes.legend()
    if axes.get_subplotspec() is None or axes.get_subplotspec().is_last_row():
        axes.set_xlabel(with_unit(mathtext("t"), "s"))


def _portrait(
    axes: Any, sources: Sequence[Source], x: str, y: str, suffixes: Sequence[str],
    section: Mapping[str, Array] | None, style: Mapping[str, Any],
) -> None:  # fmt: skip
    """Draw the column y over the column x of each source; with a section, only its points."""
    for source, suffix in zip(sources, suffixes, strict=True):
        first, second = source.curve(x), source.curve(y)
        if section is not None:
            at = [replace(c, values=np.asarray(section[c.name], float)) for c in (first, second)]
            values = [wrapped(c.values) if c.kind == "angles" else c.values for c in at]
            axes.plot(*values, **{"linestyle": "none", "marker": ".", **style})
            break
        every = max(len(source.t) // MAX_ROWS, 1)
        a, b = first.values[::every], second.values[::every]
        angles = [x for curve, x in ((first, a), (second, b)) if curve.kind == "angles"]
        if angles:
            a, b = broken(a, b, *angles)
        axes.plot(a, b, label=(suffix.lstrip(", ") or "run"), **style)
    axes.set_xlabel(with_unit(first.text, first.unit))
    axes.set_ylabel(with_unit(second.text, second.unit))
    if len(sources) > 1 and section is None:
        axes.legend()


def draw_fan(
    run: Any, names: Sequence[str], figure: Figure, quantiles: Sequence[float],
    lines: int | None = None, over: Any = None,
) -> Any:  # fmt: skip
    """Draw the distribution of a batch over time with matplotlib and return the Axes.

    The arguments are those of `BatchTrajectory.plot`.
    """
    no_files(names)
    source, style = Source(run, figure.wrap), figure.style
    curves = [source.curve(name) for name in ([*names] or source.coordinates)]
    panels = figure.panels(len(curves))
    for place, curve in zip(panels, curves, strict=True):
        if over is not None:
            _ends(place, curve, *_over(run, over), style)
            continue
        if lines is not None:
            for k in np.unique(np.linspace(0, len(run) - 1, min(lines, len(run))).astype(int)):
                each = replace(curve, values=curve.values[k])
                against(place, source.t, [each], **{"linewidth": 0.6, "color": "C0", **style})
        else:
            _bands(place, source.t, curve, sorted(quantiles), style)
        place.set_ylabel(with_unit(curve.text, curve.unit))
    if over is None:
        panels[-1].set_xlabel(with_unit(mathtext("t"), "s"))
    return figure.finish(panels)


def _bands(axes: Any, t: Array, curve: Curve, quantiles: Sequence[float], style: Any) -> None:
    """Fill between pairs of quantiles and draw the median."""
    has_values = ~np.isnan(curve.values).all(axis=0)  # rows with values of some instance
    t, values = t[has_values], curve.values[:, has_values]
    bands = np.nanquantile(values, quantiles, axis=0)
    colour = style.get("color", "C0")
    pairs = len(quantiles) // 2
    for k in range(pairs):
        low, high = quantiles[k], quantiles[-1 - k]
        axes.fill_between(
            t, bands[k], bands[-1 - k], color=colour, alpha=0.15 + 0.35 * (k + 1) / (pairs + 1),
            linewidth=0, label=f"{100 * low:g} to {100 * high:g} %",
        )  # fmt: skip
    if len(quantiles) % 2:
        axes.plot(t, bands[pairs], **{"color": colour, "label": "median", **style})
    axes.legend()


def _over(run: Any, over: Any) -> tuple[str, Array]:
    """Return label and values (batch,) of the axis: instance, parameter or given numbers."""
    if isinstance(over, str) and over == "instance":
        return "instance", np.arange(len(run), dtype=float)
    if isinstance(over, str):
        names = run.model.info.parameters
        if over not in names:
            raise ValueError(not_one_of("over", over, ("instance", *names)))
        unit = run.model.info.units.get(over, "")
        values = np.broadcast_to(run.request.p[:, names.index(over)], (len(run),))
        return with_unit(mathtext(over), unit), values
    values = np.asarray(over, float)
    if values.shape != (len(run),):
        raise ValueError(f"over: shape {values.shape}, expected ({len(run)},)")
    return "", values


def _ends(axes: Any, curve: Curve, label: str, x: Array, style: Any) -> None:
    """Draw the last value of each instance over x."""
    good = np.isfinite(curve.values)
    last = curve.values.shape[1] - 1 - np.argmax(good[:, ::-1], axis=1)
    y = np.where(good.any(axis=1), curve.values[np.arange(len(last)), last], np.nan)
    axes.plot(x, y, **{"linestyle": "none", "marker": ".", **style})
    axes.set_xlabel(label)
    axes.set_ylabel(with_unit(f"{curve.text} at the end", curve.unit))


def html(run: Any) -> str:
    """Return a summary of a run as HTML: status, final state, error and a small picture.

    Names and titles from the scene are escaped, and nothing is loaded from URLs. Without matplotlib
    there is no picture.
    """
    model, most = run.model, 12  # coordinates in the table
    words = [f"{run.steps} steps of {run.method}, {run.description}"]
    words += [f"to t = {run.t[-1]:g} s"] if len(run) else []
    words.append(f"status: {run.status}" if run.status == "ok" else run.message)
    if run.error is not None:
        error = max(float(np.max(x[-1])) for x in (run.error.q, run.error.qd))
        words.append(run.error.warning or f"estimated error at the end {error:.1g}")
    rows = ["<tr><td>at the end</td></tr>"] if len(run) else []
    for k, name in enumerate(model.info.coordinates[:most] if len(run) else ()):
        unit = plain(model.info.units.get(name, ""))
        q, qd = (f"{x[-1, k] + 0.0:.9g}" for x in (run.q, run.qd))  # no -0
        cells = (name, f"{q} {unit}", f"{name}_dot", f"{qd} {unit and unit + '/s'}")
        rows.append("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in cells) + "</tr>")
    if (more := len(model.info.coordinates) - most) > 0:
        rows.append(f"<tr><td>and {more} more</td></tr>")
    title = plain(model.info.title or model.info.name).replace(r"\$", "$")
    parts = [f"<b>{escape(title)}</b>", *(escape(plain(w)) for w in words)]
    return f"<div>{'<br>'.join(parts)}<table>{''.join(rows)}</table>{_picture(run)}</div>"


def _picture(run: Any) -> str:
    """Return an image (HTML) of the coordinates over time; "" without matplotlib.

    The mechanism is drawn beside them if eomc is installed and the scene describes its shape.
    """
    if not len(run) or find_spec("matplotlib") is None:
        return ""
    from matplotlib import figure as figures
    from matplotlib import rc_context

    source = Source(run)
    names = list(source.coordinates)
    panels = grouped([source.curve(name) for name in names])[:3]
    shown = [c.name for panel in panels for c in panel]
    drawn = _mechanism(run)
    with rc_context({"text.usetex": False}):
        height = max(1.6 * len(panels) + 0.5, 3.2 if drawn else 0)
        figure = figures.Figure(figsize=(9 if drawn else 6, height), layout="constrained", dpi=80)
        grid = figure.add_gridspec(len(panels), 2 if drawn else 1)
        axes = [figure.add_subplot(grid[0, 0])]
        axes += [figure.add_subplot(grid[k, 0], sharex=axes[0]) for k in range(1, len(panels))]
        plot(run, shown, Figure(ax=axes))
        for above in axes[:-1]:
            above.tick_params(labelbottom=False)
        if drawn:
            drawn.draw(figure.add_subplot(grid[:, 1]))
        file = io.BytesIO()
        figure.savefig(file, format="png")
    data = base64.b64encode(file.getvalue()).decode("ascii")
    description = "over time: " + ", ".join(shown) + ("; and the mechanism" if drawn else "")
    return f'<img alt="{escape(description, quote=True)}" src="data:image/png;base64,{data}">'


def _mechanism(run: Any) -> Any:
    """Return the object that draws the mechanism of a run; None without eomc or shapes."""
    try:
        return require_eomc("report.plot").of_run(run)
    except ImportError:
        return None


_SMALL = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau "
    "upsilon phi chi psi omega"
).split()
_LARGE = "Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega".split()
GREEK = {word: rf"\{word}" for word in (*_SMALL, *_LARGE)} | {"omicron": "o"}
_DOTS = ("", r"\dot", r"\ddot")


def tex(name: str, dots: int = 0) -> str:
    r"""Return a name in LaTeX, such as \theta_{1} for theta1 or theta_1.

    m_c becomes m_{\mathrm{c}}, and x_prime becomes x'. Words of several letters are set upright.
    dots: 1 for the velocity of the name (one dot above it), 2 for its acceleration.

    >>> tex("theta_1", 1), tex("arm", 2)
    ('\\dot{\\theta}_{1}', '\\ddot{\\mathrm{arm}}')
    """
    head, *rest = (part for part in name.split("_") if part)
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", head):
        head, rest = digits[1], [digits[2], *rest]
    symbol = head if len(head) == 1 else _upright(head)
    if dots:
        symbol = f"{_DOTS[dots]}{{{symbol}}}"
    primes = "'" * rest.count("prime")
    below = ",".join(_upright(part) for part in rest if part != "prime")
    return symbol + primes + (f"_{{{below}}}" if below else "")


def of_words(name: str) -> bool:
    """Return True if a name consists of several words, such as elbow_joint.

    Otherwise it is a word, or a letter or word with subscripts, such as theta_1 or m_cart.
    """
    words = re.search(r"[a-z]{2,}\d*_.*[a-z]{2,}", name)
    return bool(words) and not {*name.split("_")} & {*GREEK, "prime"}


def _upright(word: str) -> str:
    if greek := GREEK.get(word):
        return greek
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", word):
        return _upright(digits[1]) + digits[2]
    return word if word.isdigit() else rf"\mathrm{{{word}}}"


def mathtext(name: str, rate: bool = False) -> str:
    r"""Return a name in mathtext, the LaTeX subset of matplotlib, for labels of figures.

    rate: return the time derivative of the name. That of a word is written d/dt, since matplotlib
    would set a dot on one of the letters. Several words are separated by spaces.

    >>> mathtext("theta_1", rate=True), mathtext("arm", rate=True)
    ('$\\dot{\\theta}_{1}$', '$\\mathrm{d}\\,\\mathrm{arm}/\\mathrm{d}t$')
    >>> mathtext("wrist_1_joint")
    '$\\mathrm{wrist\\ 1\\ joint}$'
    """
    words = name.replace("_", r"\ ")
    symbol = rf"\mathrm{{{words}}}" if of_words(name) else tex(name)
    if rate and symbol.startswith(r"\mathrm"):
        return rf"$\mathrm{{d}}\,{symbol}/\mathrm{{d}}t$"
    return f"${tex(name, 1) if rate else symbol}$"


def rate_unit(unit: str, rate: bool) -> str:
    """Return the unit of a quantity, or if `rate` the unit of its time derivative, such as "rad/s".

    Returns "" if the quantity has no unit.
    """
    if not unit or not rate:
        return unit
    return f"{unit}/s" if re.fullmatch(r"\w+", unit) else f"({unit})/s"


def with_unit(text: str, unit: str) -> str:
    """Return the text followed by its unit in parentheses, or the text alone if `unit` is ""."""
    return f"{text} ({plain(unit)})" if unit else text


def plain(text: str) -> str:
    """Return free text of a scene, such as its title, in a form that a figure prints as it is.

    The result is one line. Control characters and dollar signs are escaped, so that matplotlib
    reads no part of it as a formula.
    """
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return shown.replace("$", r"\$")
