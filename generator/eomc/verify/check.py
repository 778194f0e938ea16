"""A compiled module compared with the reference, and with what mechanics says of any scene.

Two kinds of row. A value of the module is compared with the independent `reference`, in units of
rounding (see `sampling`). A property (symmetry, order of convergence, power balance) is tested on
the module alone, whatever the reference says.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from eomc.model.system import System
from eomc.verify import (
    rows_adaptive,
    rows_adaptive_batch,
    rows_adaptive_refusals,
    rows_constraints,
    rows_derivatives,
    rows_discretize,
    rows_events,
    rows_frames,
    rows_limits,
    rows_newton,
    rows_outputs,
    rows_plain,
    rows_projection,
    rows_signals,
    rows_sines,
    rows_stepped,
)
from eomc.verify.comparison import Comparison
from eomc.verify.report import LIMIT, Report
from eomc.verify.rows_batch import Batches
from eomc.verify.rows_bodies import Bodies
from eomc.verify.rows_refusals import Refusals
from eomc.verify.rows_runs import Runs
from eomc.verify.sampling import VALUES

SKEW_LIMIT = 1e-6  # of D's rate of change, by differences good to 1e-10; a wrong sign makes 1


def check(
    system: System, module: Any, *, plain: Any = None, seed: int = 0, states: int | None = None
) -> Report:
    """Test the compiled `module` of `system` at random states and parameters.

    plain: the same compiled from plain C, which is compared with the reference and with `module`.
    states: how many, by default as many as take seconds. Always the same states for the same
    seed. A module that raises fails the row, which shows its words. Raises EomcError where
    `symbolic.of` does.
    """
    made = Comparison(system, module, np.random.default_rng(seed), states, plain)
    models = [form._model for form, _ in made.forms if hasattr(form, "_model")]
    for model in models:
        model._passes_over = True  # as the reference does
    try:
        return _report(made, module)
    finally:
        for model in models:
            model._passes_over = False


def _report(made: Comparison, module: Any) -> Report:
    """All rows."""
    system = made.system
    made.row("names, defaults, start", 0, "that differ", made.faces)
    compiled = hasattr(module, "_model")
    if made.expected:
        value_rows(made)
        property_rows(made)
        if system.constraints:
            rows_constraints.report(made)
        if compiled:  # what is compiled has several ways to one answer
            compiled_rows(made)
        scene = system.scene
        if scene is not None and scene.assembly is not None:
            Bodies(made, scene).report()
            if compiled:
                rows_frames.report(made, scene)
        if compiled and system.run.inverse_dynamics:
            rows_frames.inverse_dynamics(made)
        if system.outputs and hasattr(module, "output"):
            rows_outputs.report(made)
        if compiled and system.events:
            rows_events.report(made)
            rows_stepped.report(made)
        if hasattr(module, "applied"):
            rows_limits.report(made)
            rows_signals.report(made)
            rows_discretize.report(made)
            rows_adaptive.report(made)
        rows_plain.rows(made)
    else:
        made.row("states", 1, "states with a regular D", lambda: 0.0, least=True)
    kind = "Taylor arithmetic" if made.large else "equations written out"
    counts = len(made.expected), made.sampler.rejected
    return Report(system.name, tuple(made.rows), *counts, kind)


def value_rows(made: Comparison) -> None:
    """Add the rows against the reference: values, one step, runs."""
    row, rounding = made.row, "units of rounding"
    for name in (*VALUES, "acceleration"):
        row(name, LIMIT, rounding, partial(made.value, name))
    if made.methods[0] == "rk4":  # which is what the reference steps by
        row("one step", LIMIT, rounding, made.steps)
        row("run", LIMIT, rounding + ", times steps and growth", made.runs)
    for method in made.methods[made.methods[0] == "rk4" :]:
        row(f"one step of {method}", LIMIT, rounding, partial(made.step_by, method))
    row("run: its energy", LIMIT, rounding, made.run_energy)


def property_rows(made: Comparison) -> None:
    """Add the rows about the module alone, and those by differences."""
    row, rounding = made.row, "units of rounding"
    row("D = D^T", LIMIT, rounding, made.symmetry)
    if not made.system.constraints:  # the KKT matrix has to be regular, D need not
        row("D > 0", 0, "least eigenvalue of D, scaled", made.definiteness, least=True)
    row("bias = C qd + g", LIMIT, rounding, made.bias)
    force = "tau + A^T lambda" if made.system.constraints else "tau"
    row(f"D qdd + bias = {force}", LIMIT, rounding, made.motion)
    rows_derivatives.report(made)
    if made.dtype == np.float64:  # single precision leaves its differences too few digits
        row("Ddot - 2C + dD/dt skew", SKEW_LIMIT, "of D's rate", made.skewness)
        made.convergence_rows()


def compiled_rows(made: Comparison) -> None:
    """Add the rows about runs, refusals and, where the module has them, batches."""
    runs, refusals = Runs(made), Refusals(made)
    runs.report()
    rows_sines.report(made)
    rows_newton.report(made)
    refusals.report()
    rows_adaptive_refusals.report(made, refusals)
    if made.system.constraints:
        rows_projection.of_inertia(made, refusals)
    if hasattr(made.module, "simulate_batch"):
        Batches(runs, refusals.singular).report()
        rows_adaptive_batch.report(made, refusals.singular)
