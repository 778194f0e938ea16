"""All checks of a compiled module, against the reference and against general laws of mechanics.

`TABLES` lists the tables of checks. Each is a function that yields declarations
(`comparison.Check`), and one loop evaluates them. The report of `eomc check` has one line for each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from eomc.model.system import System
from eomc.runtime.package import model_of
from eomc.verify import bodies, constraints, convergence, equations, runs
from eomc.verify.comparison import Check, CheckReport, Comparison

Table = Callable[[Comparison], Iterable[Check]]

TABLES: tuple[Table, ...] = (
    equations.checks,
    runs.checks,
    convergence.checks,
    equations.derivative_checks,
    constraints.checks,
    bodies.checks,
    equations.output_and_limit_checks,
)


def check(
    system: System, module: Any, *, plain: Any = None, seed: int = 0, states: int | None = None,
    tables: Sequence[Table] = TABLES,
) -> CheckReport:  # fmt: skip
    """Compare a compiled module with the independent reference in Python; return the report.

    Parameters
    ----------
    system : System
        The system from which the module was generated.
    module : module
        The compiled module.
    plain : module, optional
        The module of the portable form of the C code. Most checks apply to both forms; the report
        shows the larger error.
    seed : int
        Seed of the random states and parameters; the same seed gives the same states.
    states : int, optional
        Number of states; the default is a number whose evaluation takes seconds.
    tables : sequence of Table
        The tables of the checks; by default, all.

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
    models = [model_of(form.module) for form in comparison.forms if form.compiled]
    for model in models:
        model.integrator.ignores_events = True  # as the reference does
    try:
        if not comparison.expected:
            tables = (_missing_states,)
        results = tuple(result for table in tables for result in comparison.report(table))
    finally:
        for model in models:
            model.integrator.ignores_events = False
    kind = "Taylor arithmetic" if comparison.large else "expanded equations"
    counts = len(comparison.expected), comparison.sampler.rejected
    return CheckReport(system.name, results, *counts, kind)


def _missing_states(comparison: Comparison) -> Iterable[Check]:
    """Yield a check that fails since there are no states with a regular mass matrix D."""
    yield Check(
        "states", lambda *_: 0.0, tolerance=1, states=(None,), unit="states with a regular D",
        minimum=True,
    )  # fmt: skip
