"""Text, JSON and HTML of the report of `cost_of_digits`, with an overview of the scene."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.emit.common.templates import environment
from eomc.model.system import Coordinate, Input, Output, Parameter, System
from eomc.report import equations, equations_text
from eomc.report.cost_of_digits import (
    DIGITS,
    LARGE_CONDITION,
    USELESS_ERROR,
    WorkPrecisionPoint,
    WorkPrecisionReport,
    build_variant,
)
from eomc.report.plot import html_name, make_figure, to_svg, without_pictures
from eomc.report.typeset import write_mathml

Row = tuple[Markup, str, Markup, Markup]  # name, value, unit, note
Lines = Sequence[tuple[bool, Markup]]  # (True if the line continues the previous one, MathML)
EXPLAINED = """\
Usable h: the largest measured with an error below 1 all along. Stable to: by the eigenvalues of
the linearised motion; steps up to it let no difference grow, though their errors may add up to
more than the motion. Rounding from: the h below which finer steps don't help."""


def recommendation(report: WorkPrecisionReport, digits: float, to: float | None = None) -> str:
    """Return one recommendation, such as "for 6 digits up to t = 10 s: dp8 with h = 40 ms, ...".

    It names the fastest stepper of the report whose errors allow `digits` correct digits at all
    times. If `to` is given, the text is for the range from `digits` to `to` digits.
    """
    best = report.best(digits)
    span = f"{digits:g}" if to is None or to == digits else f"{digits:g} to {to:g}"
    what = f"for {span} digits up to t = {report.duration:g} s"
    if best is None:
        p = report.finest
        if not p.along < USELESS_ERROR:
            return f"{what}: no stepper follows this motion to its end"
        return (
            f"{what}: out of reach here; the most is {-math.log10(p.along):.1f} digits, by "
            f"{_stepper_text(p)}, {_time(p.seconds)} of computing"
        )
    parts = "" if best.adaptive else f" ({report.duration:g} s/{best.steps})"
    return (
        f"{what}: {_stepper_text(best)}{parts}, {_time(best.seconds)} of computing, "
        f"{best.evaluations} evaluations"
    )


def _stepper_text(p: WorkPrecisionPoint) -> str:
    """Return "dp8 with h = 40 ms", or "adaptive steps with tol = 1e-09, 52 steps"."""
    if p.adaptive:
        return f"adaptive steps with tol = {p.tol:g}, {p.steps} steps"
    return f"{p.method} with h = {_time(p.h)}"


def _step_text(p: WorkPrecisionPoint) -> str:
    """Return the step size, or the tolerance of an adaptive run."""
    return f"tol {p.tol:g}" if p.adaptive else _time(p.h)


def recommendations(report: WorkPrecisionReport) -> list[str]:
    """Return recommendations of steppers (see `recommendation`) for 3 to 15 correct digits.

    Numbers of digits for which the same run is the fastest share one recommendation. If no stepper
    reaches a number of digits, the text states this.
    """
    spans: list[tuple[WorkPrecisionPoint | None, list[int]]] = []
    for digits in DIGITS:
        best = report.best(digits)
        if not spans or spans[-1][0] is not best:
            spans.append((best, []))
        spans[-1][1].append(digits)
    return [recommendation(report, digits[0], digits[-1]) for _, digits in spans]


def digit_rows(report: WorkPrecisionReport) -> list[tuple[str, ...]]:
    """Return the rows of the table of the fastest run for each number of correct digits.

    The cells of a row are texts: digits, stepper, step size or tolerance, number of steps, number
    of evaluations and computing time.
    """
    table_rows: list[tuple[str, ...]] = []
    for digits in DIGITS:
        p = report.best(digits)
        if p is None:
            table_rows.append((str(digits), "out of reach", "-", "-", "-", "-"))
        else:
            times = (_step_text(p), str(p.steps), str(p.evaluations), _time(p.seconds))
            table_rows.append((str(digits), p.method, *times))
    return table_rows


def remarks(report: WorkPrecisionReport) -> list[str]:
    """Return the remarks of the report on the motion, each a sentence.

    They state how fast perturbations grow (chaos), how accurate the reference solution is, and how
    well-conditioned the mass matrix D is, and name events, non-smooth functions and the steppers
    that can't be used.
    """
    g = report.growth
    sentences = [
        f"A small difference at the start grows {g.amplification[-1]:.2g}-fold in "
        f"{report.duration:g} s"
        + (f", at the end by a factor e in {_time(1 / g.rate)} (chaos)." if g.wild else ".")
    ]
    if math.isfinite(g.horizon):
        sentences.append(
            f"Beyond t = {g.horizon:.3g} s no run in doubles means anything: the rounding of "
            "the start alone has grown to a tenth of the motion."
        )
    if report.digits < 25:
        sentences.append(
            f"The reference solution is known to {report.digits:.0f} digits only; smaller "
            "errors are not distinguished."
        )
    condition, t_worst, q = report.condition
    where = ", ".join(f"{c} = {x:.4g}" for c, x in zip(report.coordinates, q, strict=True))
    place = f"at t = {t_worst:.4g} s, {where if len(q) <= 6 else f'{len(q)} coordinates'}"
    if condition > LARGE_CONDITION:
        sentences.append(
            f"D is nearly singular {place}: condition number {condition:.2g}, so "
            f"{math.log10(condition):.0f} digits of the accelerations are lost there."
        )
    else:
        sentences.append(
            f"D is regular: its condition number, once scaled to a diagonal of ones, is at most "
            f"{condition:.2g}, {place}."
        )
    if report.events:
        sentences.append(
            f"The scene has events ({report.events}); all figures here are of its motion without "
            "them."
        )
    if report.corners:
        sentences.append(
            f"Forces or energies jump or bend ({report.corners}): past a jump every fixed step "
            "is of order 1, whatever its method."
        )
    return sentences + [
        f"{name} is not for this scene: {why}" for name, why in report.skipped.items()
    ]


def write_table(report: WorkPrecisionReport) -> str:
    """Return the report as text for a terminal: table of steppers, recommendations and remarks."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    title = f"{report.scene}: up to t = {report.duration:g} s, against {report.digits:.0f} digits"
    table = Table(box=SIMPLE_HEAD, title=title, title_justify="left")
    for head in ("stepper", "order", "observed", "usable h", "stable to", "smallest error",
                 "at h", "computing", "rounding from"):  # fmt: skip
        table.add_column(head, justify="left" if head == "stepper" else "right")
    for row in stepper_rows(report):
        table.add_row(*row)
    text = io.StringIO()
    Console(file=text, width=116).print(table)
    lines = [line.rstrip() for line in text.getvalue().splitlines()]
    words = [EXPLAINED, "", *recommendations(report), "", *remarks(report)]
    return "\n".join([*lines, *words]).strip("\n")


def stepper_rows(report: WorkPrecisionReport) -> list[tuple[str, ...]]:
    """Return the rows of the table of steppers, one for each stepper in the report.

    The cells of a row are texts: stepper, order, observed order, usable h, stable h, smallest
    error, step size of the run with that error, its computing time, and the h at which rounding
    begins to limit the error.
    """
    table_rows: list[tuple[str, ...]] = []
    for line in report.lines:
        p = min(line.points, key=lambda p: p.along)
        stable_to = "any" if math.isinf(line.stable_to) else _time(line.stable_to)
        cells = (line.method, str(line.order), _figure(line.observed, "{:.1f}"))
        times = (_step_text(p), _time(p.seconds), _time(line.rounding))
        table_rows.append(
            (*cells, _time(line.usable_h), stable_to, _figure(p.along, "{:.1e}"), *times)
        )
    return table_rows


def as_dict(report: WorkPrecisionReport) -> dict[str, Any]:
    """Return the report as a dictionary for JSON, without the energy errors over time.

    It also contains the best run for each number of digits, the recommendations and the remarks.
    """
    best = {str(digits): report.best(digits) for digits in DIGITS}
    fields = asdict(report) | {
        "best": {digits: asdict(p) if p else None for digits, p in best.items()},
        "recommendations": recommendations(report),
        "remarks": remarks(report),
    }
    return {key: _for_json(value) for key, value in fields.items()}


def _for_json(value: Any) -> Any:
    """Replace numbers that are not finite by None and complex numbers by pairs."""
    if isinstance(value, dict):
        return {key: _for_json(inside) for key, inside in value.items() if key != "energies"}
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_for_json(inside) for inside in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Overview:
    """Data for the overview in the template report/report.html.jinja, escaped for HTML.

    Attributes
    ----------
    note
        Note of the scene.
    coordinates, parameters, inputs, outputs
        Rows of the tables of these quantities, each with name, value, unit and note.
    equations, rest
        Lines of the equations of motion, and lines of all other formulas. Each is a pair (True if
        the line continues the previous one, MathML of the line).
    text
        Plain text that replaces equations that are too long or can't be converted to MathML.
    motion, caption
        Figure of the motion as SVG (empty without matplotlib), and its caption.
    """

    note: Markup
    coordinates: Sequence[Row]
    parameters: Sequence[Row]
    inputs: Sequence[Row]
    outputs: Sequence[Row]
    equations: Lines
    rest: Lines
    text: Markup
    motion: Markup
    caption: str


def describe_scene(system: System, report: WorkPrecisionReport, root: Path) -> Overview:
    """Return the overview of a scene: its tables, its equations and a figure of its motion.

    The figure shows the fastest run of the report that has six correct digits, or else the most
    accurate run. root: build directory.
    """
    first, rest, text = _equations(system)
    motion, caption = _motion(system, report, root)
    return Overview(
        note=Markup(texts.html(texts.flat(system.note))),
        coordinates=[_row(c, f"{c.start:.6g}", f"{c.rate:.6g}") for c in system.coordinates],
        parameters=[_row(p, f"{p.value:.6g}") for p in system.parameters],
        inputs=[_row(i, "") for i in system.inputs],
        outputs=[_row(o, "") for o in system.outputs],
        equations=first,
        rest=rest,
        text=Markup("\n").join(map(texts.html, text.splitlines())),
        motion=motion,
        caption=caption,
    )


def _equations(system: System) -> tuple[Lines, Lines, str]:
    """Return the equations of motion and the other formulas as MathML, or both as text.

    They are returned as text if latex2mathml is not installed or if the equations are too long.
    """
    try:
        derived = equations.derive(system)
    except EomcError:
        return [], [], equations_text.describe(system)
    try:
        first, rest = map(write_mathml, derived.set_out.groups)
    except EomcError:
        return [], [], str(derived)
    return first, rest, ""


def _row(entry: Coordinate | Parameter | Input | Output, *numbers: str) -> Row:
    name = Markup(html_name(entry.name))
    unit, note = (Markup(texts.html(texts.flat(x))) for x in (entry.unit, entry.note))
    return name, ", ".join(numbers), unit, note


def _motion(system: System, report: WorkPrecisionReport, root: Path) -> tuple[Markup, str]:
    if without_pictures():
        return Markup(""), ""
    min_rows = 1_000  # so that curves look smooth
    best = report.best(6) or report.finest
    module, _ = build_variant(
        system, [p.method for p in report.lines], root / system.name / "report"
    )
    finer = max(1, math.ceil(min_rows / best.steps))
    if best.adaptive:
        run = module.simulate(tol=best.tol, duration=report.duration).curve_run
        caption = f"By steps that fit a tolerance of {best.tol:.0e}"
    else:
        h, steps = best.h / finer, best.steps * finer
        run = module.simulate(h=h, steps=steps, method=best.method)
        caption = f"By {best.method}, h = {run.h:.3g} s"
    balance = run.balance().words if run.model.functions.has_power else ""
    figure = make_figure(system, run, " ", balance=balance)
    if best.adaptive or finer == 1:
        caption += f", within {best.along:.1g} of the reference solution"
    return to_svg(figure), caption + "."


def write_page(report: WorkPrecisionReport, overview: Overview | None = None) -> str:
    """Return the report as one HTML page with embedded figures.

    overview: description of the scene that the page begins with. If matplotlib is not installed,
    the page has no figures and states the reason.
    """
    shown = report.best(6) or report.finest
    runs = [
        (
            p.method, _step_text(p), str(p.steps), p.status, _figure(p.q, "{:.1e}"),
            _figure(p.qd, "{:.1e}"), _figure(p.along, "{:.1e}"), _figure(p.energy, "{:.1e}"),
            str(p.evaluations), _time(p.seconds),
            _time(p.seconds / report.duration),
        )
        for p in report.points
    ]  # fmt: skip
    adaptive_points = [p for p in report.points if p.adaptive and p.along < USELESS_ERROR]
    missing_pictures = without_pictures()
    tolerances = (
        _svg(lambda axes: _tolerances(axes, adaptive_points), (8.6, 3.6)) if adaptive_points else ""
    )
    template = environment().get_template("report/report.html.jinja")
    return template.render(
        report=report,
        about=overview,
        digit_rows=digit_rows(report),
        title=texts.html(report.title),
        rows=stepper_rows(report),
        recommendations=recommendations(report),
        remarks=remarks(report),
        explained=EXPLAINED,
        runs=runs,
        lacking=missing_pictures,
        work=_svg(lambda axes: _work(axes, report), (8.6, 5.0)),
        energy=_svg(lambda axes: _energy(axes, report, shown), (8.6, 3.6)),
        tolerances=tolerances,
        growth=_svg(lambda axes: _growth(axes, report), (8.6, 3.0)),
        shown=_time(shown.seconds),
        digits=f"{report.digits:.0f}",
        duration=f"{report.duration:g}",
    )


def _svg(draw: Callable[[Any], None], size: tuple[float, float]) -> Markup:
    """Return a figure as SVG text, equal for equal reports; empty without matplotlib."""
    if without_pictures():
        return Markup("")
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": 10, "text.usetex": False}):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.add_subplot()
        axes.grid(color="#DDDDDD", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        draw(axes)
        return to_svg(figure)


def _styles(report: WorkPrecisionReport) -> dict[str, tuple[str, str]]:
    from eomc.report.plot import COLOURS, INK

    colours = (*COLOURS, INK, "#999999")
    marks = "osD^vPX*"
    return {
        line.method: (colours[k % len(colours)], marks[k % len(marks)])
        for k, line in enumerate(report.lines)
    }


def _work(axes: Any, report: WorkPrecisionReport) -> None:
    """Plot error against computing time; the best stepper for each number of digits is marked."""
    styles = _styles(report)
    for line in report.lines:
        colour, mark = styles[line.method]
        good = [p for p in line.points if p.along < USELESS_ERROR]
        axes.loglog(
            [p.seconds for p in good], [p.along for p in good], color=colour, marker=mark,
            markersize=4, linewidth=1.2, label=line.method,
        )  # fmt: skip
    marked: dict[tuple[str, int], tuple[WorkPrecisionPoint, list[int]]] = {}
    for digits in DIGITS:
        if best := report.best(digits):
            marked.setdefault((best.method, best.steps), (best, []))[1].append(digits)
    for p, reached in marked.values():
        axes.plot(
            p.seconds, p.along, marker="o", markersize=12, markerfacecolor="none",
            markeredgecolor=styles[p.method][0], markeredgewidth=1.6,
        )  # fmt: skip
        axes.annotate(
            f"{reached[-1]}", (p.seconds, p.along), xytext=(-9, -9), ha="right", va="center",
            textcoords="offset points", fontweight="bold", color=styles[p.method][0],
        )  # fmt: skip
    axes.set_xlabel("computing time of the whole run, s")
    axes.set_ylabel("largest relative error along the run")
    axes.legend(frameon=False)


def _energy(axes: Any, report: WorkPrecisionReport, shown: WorkPrecisionPoint) -> None:
    """Plot energy errors over time, for runs of each stepper with similar computing times."""
    styles = _styles(report)
    for line in report.lines:
        good = [p for p in line.points if p.along < USELESS_ERROR]
        if not good:
            continue
        p = min(good, key=lambda p: abs(math.log(p.seconds / shown.seconds)))
        t = report.t[:: max(1, (len(report.t) - 1) // (len(p.energies) - 1))]
        axes.semilogy(
            t, np.maximum(p.energies, 1e-17), color=styles[line.method][0], linewidth=1.0,
            label=f"{line.method}, {_step_text(p) if p.adaptive else f'h = {_time(p.h)}'}",
        )  # fmt: skip
    axes.set_xlabel("t, s")
    axes.set_ylabel("relative energy error")
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _tolerances(axes: Any, points: Sequence[WorkPrecisionPoint]) -> None:
    """Plot the error of each adaptive run against its tolerance."""
    tol = [p.tol for p in points]
    axes.loglog(tol, tol, color="#999999", linewidth=1.0, linestyle="--", label="as asked")
    for name, errors, mark in (
        ("at the end", [p.end for p in points], "s"),
        ("largest along the run", [p.along for p in points], "o"),
    ):
        axes.loglog(tol, errors, marker=mark, markersize=4, linewidth=1.2, label=name)
    axes.invert_xaxis()
    axes.set_xlabel("tolerance")
    axes.set_ylabel("relative error")
    axes.legend(frameon=False)


def _growth(axes: Any, report: WorkPrecisionReport) -> None:
    """Plot the growth of a perturbation of the initial state."""
    g = report.growth
    axes.semilogy(g.t, g.amplification, color="#333333", linewidth=1.4)
    axes.set_xlabel("t, s")
    axes.set_ylabel("growth of a small difference")
    if report.t[-1] > g.horizon:
        axes.axvline(g.horizon, color="#D55E00", linewidth=1.2, linestyle="--")


def _figure(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "-"


def _time(seconds: float) -> str:
    """Return a time with a suitable unit: 2 s, 4.88 ms, 12.3 us."""
    if not math.isfinite(seconds):
        return "-"
    for size, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"
