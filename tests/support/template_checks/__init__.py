"""Checks of what templates do in the same way for every scene.

They exercise divided runs, refusals, batches, lanes, predicted sines and workspaces. `eomc check`
leaves them out; tests/c/test_templates.py runs them for many scenes, and mutants of the generator
and of C are judged by them too.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from eomc.model.system import System
from eomc.verify import check as checking
from eomc.verify.comparison import Check, CheckReport, Comparison
from support.template_checks import adaptive, batches, newton, projection, refusals, runs


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield all checks of templates for a compiled module."""
    of_runs, of_refusals = runs.RunChecks(comparison), refusals.RefusalChecks(comparison)
    yield from of_runs.checks()
    yield from runs.sine_checks(comparison)
    yield from newton.checks(comparison)
    yield from of_refusals.checks()
    yield from adaptive.refusal_checks(comparison, of_refusals)
    yield from projection.checks(comparison, of_refusals)
    if hasattr(comparison.module, "simulate_batch"):
        yield from batches.BatchChecks(of_runs, of_refusals.singular).checks()
        yield from adaptive.batch_checks(comparison, of_refusals.singular)


def check_all(system: System, module: Any, **options: Any) -> CheckReport:
    """Return the report of `eomc check` and of the checks of templates together."""
    return checking.check(system, module, tables=(*checking.TABLES, checks), **options)


def check_templates(system: System, module: Any, **options: Any) -> CheckReport:
    """Return the report of the checks of templates alone."""
    return checking.check(system, module, tables=(checks,), **options)
