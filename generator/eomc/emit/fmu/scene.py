"""scene.h of an FMU: the functions of a scene, with the same arguments in every scene."""

from __future__ import annotations

from eomc.base.texts import FreeText
from eomc.derive.tape import Stage, Tape
from eomc.emit import adaptive, heading
from eomc.emit.c_names import Target
from eomc.emit.evaluations import refuses, source, takes_qdd
from eomc.emit.events import DIRECTIONS
from eomc.emit.fmu.variables import input_starts
from eomc.emit.fmu.views import SceneCalls, SceneEvent, Start
from eomc.emit.package import start_formulas
from eomc.emit.public import Public
from eomc.model.algebra import expression
from eomc.program.lower import lower
from eomc.scene.formulas import parse
from eomc.scene.schema import ACTIONS

ENERGIES = ("kinetic_energy", "potential_energy", "energy")
STEPS = 10_000  # largest number of adaptive steps in one call


def view(target: Target, token: str) -> SceneCalls:
    """Return the data for the template of scene.h, a C header of the FMU.

    The header lets the hand-written C, which is the same in all FMUs, call the functions of this
    scene. target: the scene's program and its C names. token: text that identifies the build, as in
    modelDescription.xml.
    """
    s, public = target.system, Public(target)
    by_tolerance = s.run.tolerance is not None
    method, rows = s.run.methods[0], s.coordinates if s.constraints else ()
    calls = {name: _called(target, name) for name in (*ENERGIES, "outputs", "events", "jumps")}
    start_lines, starts = _starts(target)
    workspace = adaptive.METHOD.name + "_adaptive" if by_tolerance else method
    return SceneCalls(
        title=FreeText(s.title),
        stamp=heading.stamp(target)[0],
        token=token,
        prefix=target.prefix,
        PREFIX=target.PREFIX,
        real=target.real.name,
        h=repr(s.run.h),
        tolerance=repr(s.run.tolerance or 0.0),
        memory=f"{target.prefix}_{workspace}_memory",
        inputs=tuple(map(target.literal, input_starts(target))),
        parameters=tuple(p.name for p in s.parameters),
        output_count=len(s.outputs),
        events=tuple(
            SceneEvent(e.name, DIRECTIONS[e.direction], ACTIONS.index(e.action)) for e in s.events
        ),
        feedback=target.signal_state,
        solved=bool(calls["outputs"]) and takes_qdd(target, "outputs"),
        acceleration=public.acceleration.call(),
        signal=_called(target, "signal"),
        outputs=calls["outputs"],
        energies=tuple(calls[name] for name in ENERGIES),
        values=calls["events"],
        jumps=calls["jumps"],
        project=public.project.call() if s.constraints else "",
        fixed=tuple(
            int(x) for x in (*(c.start_fixed for c in rows), *(c.rate_fixed for c in rows))
        ),
        run="" if by_tolerance else public.run(method).call(
            h="(unitReal)unitStep", u_stride="0", every="0", q_rows="NULL", qd_rows="NULL",
            status="&status",
        ),
        step="" if by_tolerance else public.step(method).call(),
        adaptive=public.adaptive(adaptive.METHOD.name).call(
            h_most="0", steps=str(STEPS), times="NULL", count="0", t_rows="NULL", q_rows="NULL",
            qd_rows="NULL", room="unitRoom", status="&status",
        ) if by_tolerance else "",
        start_lines=start_lines,
        starts=starts,
        sensitivity=_called(target, "sensitivity"),
        output_sensitivity=_called(target, "output_sensitivity"),
        signals_of_parameters=_signals_read_parameters(target),
        linearization=public.linearization.call() if s.run.needs_derivatives else "",
        output_slopes=_called(target, "output_slopes"),
        refuses=refuses(target, "outputs"),
        slopes_refuse=refuses(target, "output_slopes"),
        slopes_solved=any(
            takes_qdd(target, name)
            for name in ("output_slopes", "output_sensitivity")
            if name in target.program
        ),
    )  # fmt: skip


def _starts(target: Target) -> tuple[tuple[str, ...], tuple[Start, ...]]:
    """Return C statements and the states whose start is a formula of parameters."""
    s, formulas = target.system, start_formulas(target)
    symbols = {target.as_written(p.name): p.symbol for p in s.parameters}
    tape = Tape({p.symbol: Stage.PARAMETER for p in s.parameters})
    values = [tape.define(expression(parse(text), symbols)) for text in formulas.values()]
    body = target.body(lower("starts", tape, values, s.names))
    states = [(array, c.name) for array in ("q", "qd") for c in s.coordinates]
    names = [target.as_written(n) + ("_dot" if array == "qd" else "") for array, n in states]
    places = [names.index(name) for name in formulas]
    return body.lines, tuple(
        Start(k, target.element(*states[k]), value)
        for k, value in zip(places, body.results, strict=True)
    )


def _signals_read_parameters(target: Target) -> bool:
    """Return whether the scene's signals depend on parameters."""
    parameters = {p.name for p in target.system.parameters}
    return "signal" in target.program and bool(target.program["signal"].uses & parameters)


def _called(target: Target, name: str) -> str:
    """Return the C call of an evaluation function; "" if the scene does not have it."""
    return Public(target).evaluation(name).call() if source(target, name) is not None else ""
