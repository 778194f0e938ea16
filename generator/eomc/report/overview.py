"""Overview of a scene for a page: its note, tables, equations and motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.model.system import Coordinate, Input, Output, Parameter, System
from eomc.report import equations, large_system, mathml
from eomc.report.cost_of_digits import Report, variant
from eomc.report.labels import html_name

MIN_ROWS = 1_000  # of a drawn motion, so that curves look smooth
Row = tuple[Markup, str, Markup, Markup]  # name, value, unit, note


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
    equations: Sequence[tuple[bool, Markup]]
    rest: Sequence[tuple[bool, Markup]]
    text: Markup
    motion: Markup
    caption: str


def describe_scene(system: System, report: Report, root: Path) -> Overview:
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


Lines = Sequence[tuple[bool, Markup]]


def _equations(system: System) -> tuple[Lines, Lines, str]:
    """Return the equations of motion and the other formulas as MathML, or both as text.

    They are returned as text if latex2mathml is not installed or if the equations are too long.
    """
    try:
        derived = equations.derive(system)
    except EomcError:
        return [], [], large_system.text(system)
    try:
        return *mathml.lines(derived), ""
    except EomcError:
        return [], [], str(derived)


def _row(entry: Coordinate | Parameter | Input | Output, *numbers: str) -> Row:
    name = Markup(html_name(entry.name))
    unit, note = (Markup(texts.html(texts.flat(x))) for x in (entry.unit, entry.note))
    return name, ", ".join(numbers), unit, note


def _motion(system: System, report: Report, root: Path) -> tuple[Markup, str]:
    from eomc.report import plot

    if plot.without_pictures():
        return Markup(""), ""
    best = report.best(6) or report.finest
    module, _ = variant(system, [p.method for p in report.lines], root / system.name / "report")
    finer = max(1, math.ceil(MIN_ROWS / best.steps))  # enough rows for smooth curves
    if best.adaptive:
        run = module.simulate(tol=best.tol, duration=report.duration)._drawn
        caption = f"By steps that fit a tolerance of {best.tol:.0e}"
    else:
        h, steps = best.h / finer, best.steps * finer
        run = module.simulate(h=h, steps=steps, method=best.method)
        caption = f"By {best.method}, h = {run.h:.3g} s"
    jacobi = run.jacobi if run._model.has_jacobi else None
    inputs = dict(zip(module.inputs, run.u.T, strict=True))
    balance = run.balance() if run._model.has_power else None
    figure = plot.figure(
        system, run.t, run.q, run.qd, run.energy, " ", jacobi, run.outputs,
        balance.words if balance else "", inputs,
    )  # fmt: skip
    if best.adaptive or finer == 1:
        caption += f", within {best.along:.1g} of the reference solution"
    return plot.svg(figure), caption + "."
