"""What a scene is: its words, tables, equations and motion, as a page shows them."""

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

ROWS = 1_000  # of a motion that is drawn, at least
Row = tuple[Markup, str, Markup, Markup]  # name, number, unit, note


@dataclass(frozen=True)
class Presented:
    """The parts of a page, made harmless. equations, rest: lines, and which go on with the last.

    text: what stands for equations that are too long to write out, or that nothing sets. motion: a
    picture, SVG, empty without matplotlib.
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
    said: str


def of(system: System, report: Report, root: Path) -> Presented:
    """A scene as it is presented, its motion by the stepper that was found best for six digits."""
    first, rest, text = _equations(system)
    motion, said = _motion(system, report, root)
    return Presented(
        note=Markup(texts.html(texts.flat(system.note))),
        coordinates=[_row(c, f"{c.start:.6g}", f"{c.rate:.6g}") for c in system.coordinates],
        parameters=[_row(p, f"{p.value:.6g}") for p in system.parameters],
        inputs=[_row(i, "") for i in system.inputs],
        outputs=[_row(o, "") for o in system.outputs],
        equations=first,
        rest=rest,
        text=Markup("\n").join(map(texts.html, text.splitlines())),
        motion=motion,
        said=said,
    )


Lines = Sequence[tuple[bool, Markup]]


def _equations(system: System) -> tuple[Lines, Lines, str]:
    """Those of motion and the rest as MathML; else as text: without latex2mathml, or too long."""
    try:
        found = equations.of(system)
    except EomcError:
        return [], [], large_system.text(system)
    try:
        return *mathml.lines(found), ""
    except EomcError:
        return [], [], str(found)


def _row(what: Coordinate | Parameter | Input | Output, *numbers: str) -> Row:
    name = Markup(html_name(what.name))
    unit, note = (Markup(texts.html(texts.flat(x))) for x in (what.unit, what.note))
    return name, ", ".join(numbers), unit, note


def _motion(system: System, report: Report, root: Path) -> tuple[Markup, str]:
    from eomc.report import plot

    if plot.without_pictures():
        return Markup(""), ""
    best = report.best(6) or report.finest
    module, _ = variant(system, [p.method for p in report.lines], root / system.name / "report")
    finer = max(1, math.ceil(ROWS / best.steps))  # enough rows for smooth curves
    if best.adaptive:
        run = module.simulate(tol=best.tol, duration=report.duration)._drawn
        said = f"By steps that fit a tolerance of {best.tol:.0e}"
    else:
        h, steps = best.h / finer, best.steps * finer
        run = module.simulate(h=h, steps=steps, method=best.method)
        said = f"By {best.method}, h = {run.h:.3g} s"
    jacobi = run.jacobi if run._model.has_jacobi else None
    inputs = dict(zip(module.inputs, run.u.T, strict=True))
    balance = run.balance() if run._model.has_power else None
    figure = plot.figure(
        system, run.t, run.q, run.qd, run.energy, " ", jacobi, run.outputs,
        balance.words if balance else "", inputs,
    )  # fmt: skip
    if best.adaptive or finer == 1:
        said += f", within {best.along:.1g} of the reference solution"
    return plot.svg(figure), said + "."
