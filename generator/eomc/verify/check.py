"""All checks of a compiled module, against the reference and against general laws of mechanics.

There are two kinds of checks. A value of the module is compared with the independent `reference`,
in units of rounding (see `sampling`). A property (symmetry, order of convergence, power balance) is
tested on the module alone, whatever the reference returns. The report of `eomc check` has one line
for each check.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from eomc.model.system import System
from eomc.runtime.package import model_of
from eomc.verify import (
    checks_adaptive,
    checks_bodies,
    checks_constraints,
    checks_derivatives,
    checks_events,
    checks_inputs_outputs,
    checks_newton,
    checks_plain,
    checks_runs,
)
from eomc.verify.checks_batch import BatchChecks
from eomc.verify.checks_bodies import BodyChecks
from eomc.verify.checks_refusals import RefusalChecks
from eomc.verify.checks_runs import RunChecks
from eomc.verify.comparison import Comparison
from eomc.verify.report import LIMIT, CheckReport
from eomc.verify.sampling import VALUES


def check(
    system: System, module: Any, *, plain: Any = None, seed: int = 0, states: int | None = None
) -> CheckReport:
    """Compare a compiled module with the independent reference in Python; return the report.

    Parameters
    ----------
    system : System
        The system from which the module was generated.
    module : module
        The compiled module.
    plain : module, optional
        The module of the portable form of the C code, compared with the reference and `module`.
    seed : int
        Seed of the random states and parameters; the same seed gives the same states.
    states : int, optional
        Number of states; the default is a number whose evaluation takes seconds.

    Returns
    -------
    CheckReport
        The results of all checks. If the module raises an exception in a check, the check fails
        and its result shows the exception.

    Raises
    ------
    EomcError
        If there is no reference for the system; see `symbolic.reference_for`.
    """
    comparison = Comparison(system, module, np.random.default_rng(seed), states, plain)
    models = [model_of(form) for form, _ in comparison.forms if hasattr(form, "_model")]
    for model in models:
        model.integrator.ignores_events = True  # as the reference does
    try:
        return _report(comparison, module)
    finally:
        for model in models:
            model.integrator.ignores_events = False


def _report(comparison: Comparison, module: Any) -> CheckReport:
    """Run all checks and return the report."""
    system = comparison.system
    comparison.add_check(
        "names, defaults, start", 0, "that differ", comparison.metadata_differences
    )
    compiled = hasattr(module, "_model")
    if comparison.expected:
        add_value_checks(comparison)
        add_property_checks(comparison)
        if system.constraints:
            checks_constraints.report(comparison)
        if compiled:  # compiled code has several ways to compute a value
            add_compiled_checks(comparison)
        scene = system.scene
        if scene is not None and scene.assembly is not None:
            BodyChecks(comparison, scene).report()
            if compiled:
                checks_bodies.report_frames(comparison, scene)
        if compiled and system.run.inverse_dynamics:
            checks_bodies.report_inverse_dynamics(comparison)
        if system.outputs and hasattr(module, "output"):
            checks_inputs_outputs.report_outputs(comparison)
        if compiled and system.events:
            checks_events.report_functions(comparison)
            checks_events.report_fixed_steps(comparison)
        if hasattr(module, "applied"):
            checks_inputs_outputs.report_limits(comparison)
            checks_inputs_outputs.report_closed_loop(comparison)
            checks_derivatives.report_step_derivatives(comparison)
            checks_adaptive.report_runs(comparison)
        checks_plain.report(comparison)
    else:
        comparison.add_check("states", 1, "states with a regular D", lambda: 0.0, minimum=True)
    kind = "Taylor arithmetic" if comparison.large else "equations written out"
    counts = len(comparison.expected), comparison.sampler.rejected
    return CheckReport(system.name, tuple(comparison.results), *counts, kind)


def add_value_checks(comparison: Comparison) -> None:
    """Append checks of values, single steps and short runs to the report of `eomc check`.

    They compare the compiled module with the reference, the independent evaluation in Python.
    """
    add, rounding = comparison.add_check, "units of rounding"
    for name in (*VALUES, "acceleration"):
        add(name, LIMIT, rounding, partial(comparison.value_error, name))
    if comparison.methods[0] == "rk4":  # the method of the reference
        add("one step", LIMIT, rounding, comparison.rk4_step_error)
        add("run", LIMIT, rounding + ", times steps and growth", comparison.run_error)
    for method in comparison.methods[comparison.methods[0] == "rk4" :]:
        add(f"one step of {method}", LIMIT, rounding, partial(comparison.step_error, method))
    add("run: its energy", LIMIT, rounding, comparison.run_energy_error)


def add_property_checks(comparison: Comparison) -> None:
    """Append checks of laws that the module's values must obey to the report of `eomc check`.

    Examples: D is symmetric, and derivatives agree with difference quotients.
    """
    add, rounding = comparison.add_check, "units of rounding"
    add("D = D^T", LIMIT, rounding, comparison.symmetry_error)
    if not comparison.system.constraints:  # otherwise D may be singular
        add("D > 0", 0, "least eigenvalue of D, scaled", comparison.least_eigenvalue, minimum=True)
    add("bias = C qd + g", LIMIT, rounding, comparison.bias_error)
    force = "tau + A^T lambda" if comparison.system.constraints else "tau"
    add(f"D qdd + bias = {force}", LIMIT, rounding, comparison.motion_error)
    checks_derivatives.report_acceleration_derivatives(comparison)
    if comparison.dtype == np.float64:  # difference quotients need its digits
        # differences are exact to 1e-10; a wrong sign in C makes an error of 1
        add("Ddot - 2C + dD/dt skew", 1e-6, "of D's rate", comparison.skewness_error)
        comparison.add_convergence_checks()


def add_compiled_checks(comparison: Comparison) -> None:
    """Append checks of runs, refusals and batches to the report of `eomc check`.

    They need a module compiled from C. Batches are checked if the module has functions for them.
    """
    runs, refusals = RunChecks(comparison), RefusalChecks(comparison)
    runs.report()
    checks_runs.report_vanishing_sines(comparison)
    checks_newton.report(comparison)
    refusals.report()
    checks_adaptive.report_refusals(comparison, refusals)
    if comparison.system.constraints:
        checks_constraints.report_massless(comparison, refusals)
    if hasattr(comparison.module, "simulate_batch"):
        BatchChecks(runs, refusals.singular).report()
        checks_adaptive.report_batches(comparison, refusals.singular)
