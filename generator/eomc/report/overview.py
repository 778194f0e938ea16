"""Overview of a scene for a page: its note, tables, equations and motion."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from markupsafe import Markup

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.model.system import Coordinate, Input, Output, Parameter, System
from eomc.report import equations, equations_text
from eomc.report.cost_of_digits import WorkPrecisionReport, build_variant
from eomc.report.equations import Equations
from eomc.report.style import html_name
from eomc.report.typeset import CONTINUATION

MIN_ROWS = 1_000  # of a drawn motion, so that curves look smooth
_FUNCTION = re.compile(r"<mi>(a?(?:sin|cos|tan)h?|exp|log|min|max|arg)</mi>")
_SPACED = r'<mo lspace="0.17em" rspace="0.17em">\1</mo>'
Row = tuple[Markup, str, Markup, Markup]  # name, value, unit, note
Lines = Sequence[tuple[bool, Markup]]  # (True if the line continues the previous one, MathML)


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
        return *write_mathml(derived), ""
    except EomcError:
        return [], [], str(derived)


def write_mathml(derived: Equations) -> tuple[Lines, Lines]:
    """Convert equations to MathML and return them as a pair of lists of printed lines.

    The first list contains the equations of motion, the second all other formulas. Each line is a
    pair (continues, MathML), where continues is True if the line continues the equation of the
    previous line. MathML is shown by browsers without a script; latex2mathml makes it from LaTeX.
    Raises EomcError if latex2mathml is not installed.
    """
    first, second = ([_line(x) for x in lines] for lines in equations.latex_lines(derived.set_out))
    return first, second


def _line(text: str) -> tuple[bool, Markup]:
    continues = text.startswith(CONTINUATION)
    left, _, right = text.partition("&")
    return continues, _convert((left + right.replace(r"\quad", "", int(continues))).strip())


@cache
def _convert(latex: str) -> Markup:
    try:
        from latex2mathml.converter import convert
    except ImportError:
        raise EomcError("equations in a page need latex2mathml: pip install latex2mathml") from None
    converted = convert(latex).replace('display="inline"', 'displaystyle="true"')
    return Markup(_FUNCTION.sub(_SPACED, converted))


def _row(entry: Coordinate | Parameter | Input | Output, *numbers: str) -> Row:
    name = Markup(html_name(entry.name))
    unit, note = (Markup(texts.html(texts.flat(x))) for x in (entry.unit, entry.note))
    return name, ", ".join(numbers), unit, note


def _motion(system: System, report: WorkPrecisionReport, root: Path) -> tuple[Markup, str]:
    from eomc.report import plot

    if plot.without_pictures():
        return Markup(""), ""
    best = report.best(6) or report.finest
    module, _ = build_variant(
        system, [p.method for p in report.lines], root / system.name / "report"
    )
    finer = max(1, math.ceil(MIN_ROWS / best.steps))  # enough rows for smooth curves
    if best.adaptive:
        run = module.simulate(tol=best.tol, duration=report.duration).curve_run
        caption = f"By steps that fit a tolerance of {best.tol:.0e}"
    else:
        h, steps = best.h / finer, best.steps * finer
        run = module.simulate(h=h, steps=steps, method=best.method)
        caption = f"By {best.method}, h = {run.h:.3g} s"
    balance = run.balance().words if run.model.functions.has_power else ""
    figure = plot.make_figure(system, plot.RunCurves.from_run(run, balance), " ")
    if best.adaptive or finer == 1:
        caption += f", within {best.along:.1g} of the reference solution"
    return plot.to_svg(figure), caption + "."
