"""Comparison of a compiled module with the reference: sampled states and expected values.

A check is a declaration (`Check`) of values of the module at some states and of the values that
they must have. The tables of checks (`check.TABLES`) yield such declarations, and `Check.evaluate`
compares the values.

The error of a check at a state is the largest |ours - reference|/scale. Most scales are rounding
errors: eps times the size of the terms that are summed up (see `sampling`). Values of correct
modules have errors below 1, stiff runs some tens. A wrong sign makes 1e15, or 1e5 in a term that is
1e-10 of the result.
"""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from eomc.model.mechanics import nonsmooth_functions
from eomc.model.system import System
from eomc.runtime.package import model_of
from eomc.verify.reference import Vector
from eomc.verify.sampling import (
    LARGE,
    SMALL,
    Expected,
    Sampler,
    State,
    evaluate_module,
    projected_start,
    simulate,
)
from eomc.verify.symbolic import reference_for
from eomc.verify.taylor import TaylorReference

Acceleration = Callable[[Vector, Vector, Any], Vector]  # of q, q̇ and t

LIMIT = 1e3  # errors in units of rounding, see above
ROUNDING = "units of rounding"


@dataclass(frozen=True)
class CheckResult:
    """One line of the report: a check with its measured error, its limit, and the unit of both.

    passed: whether the check has passed. judged: False if nothing could be judged; the check then
    counts as passed and `unit` gives the reason.
    """

    name: str
    error: float
    limit: float
    passed: bool
    unit: str
    judged: bool = True


@dataclass(frozen=True)
class Measurement:
    """A measured value that is not judged, and the reason `why`.

    The check passes; the value inf means that the check does not apply.
    """

    value: float
    why: str


def units(values: Any, expected: Any, scale: Any) -> float:
    """Return the largest error of some values, |values - expected| / scale.

    The result is 0 if there are no values and nan if one is nan. Raises ValueError if the shapes
    differ.
    """
    difference = np.abs(np.asarray(values, float) - expected)
    if difference.shape != np.shape(expected):
        raise ValueError(f"shape {np.shape(values)} where {np.shape(expected)} is meant")
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(
            np.max(np.where(difference == 0, 0, difference / np.asarray(scale)), initial=0)
        )


def largest(errors: Iterable[float | None], why: str) -> float | Measurement:
    """Return the largest of the errors; None in place of an error means nothing to compare.

    The result is nan if one of the errors is nan. If all are None, it is a Measurement with the
    reason `why`, which is not judged.
    """
    known = [x for x in errors if x is not None]
    return float(np.max(known)) if known else Measurement(math.nan, why)


class Comparison:
    """Comparison of one module with the reference: states and expected values.

    The reference is the independent evaluation of the equations in Python.

    Parameters
    ----------
    system : System
        The system of which `module` is the compiled form.
    module : module
        The compiled module; an object with the same functions will do.
    random : Generator
        Source of the random states.
    states : int or None
        Number of states; None for the default, which depends on the cost of the reference.
    plain : module, optional
        The module of the portable form of the C code.
    """

    def __init__(
        self, system: System, module: Any, random: np.random.Generator, states: int | None,
        plain: Any = None,
    ) -> None:  # fmt: skip
        self.system, self.module, self.plain = system, module, plain
        self.dtype = np.dtype(getattr(module, "dtype", "float64"))
        self.eps = float(np.finfo(self.dtype).eps)
        self.methods: tuple[str, ...] = getattr(module, "methods", ("rk4",))
        self.reference = reference_for(system)
        self.large = isinstance(self.reference, TaylorReference)
        self.effort = LARGE if self.large else SMALL
        self.sampler = Sampler(self.reference, random, self.effort)
        self.expected = self.sampler.states(self.effort.states if states is None else states)

    @property
    def forms(self) -> list[Comparison]:
        """This comparison, and the same one for the portable form of C if there is one."""
        if self.plain is None:
            return [self]
        portable = copy.copy(self)
        portable.module = self.plain
        return [self, portable]

    @property
    def compiled(self) -> bool:
        """Whether the module is compiled from C, so that it has several ways to make a run."""
        return model_of(self.module) is not None

    def report(self, table: Callable[[Comparison], Iterable[Check]]) -> list[CheckResult]:
        """Return the results of the checks that a table declares for this comparison."""
        return [check.evaluate(self) for check in table(self)]

    @cached_property
    def unusual_states(self) -> list[Expected]:
        """Reference values at states that runs hardly reach.

        The module must give correct values at these states as well.
        """
        return self.sampler.unusual_states(1 if self.large else 2)

    @cached_property
    def corners(self) -> str:
        """Names of functions with discontinuities or kinks in the scene, as text for a message.

        The text is "" if there are none.
        """
        return nonsmooth_functions(self.system)

    def few(self, count: int) -> list[Expected]:
        """Return `count` states with their reference values: the first and the last ones."""
        half = count // 2
        return self.expected[:half] + self.expected[half:][-half:]

    def units(self, values: Any, expected: Any, size: Any) -> float:
        """Return the largest error in units of rounding, |values - expected| / (eps size).

        eps is the relative rounding error of the module's numbers.
        """
        return units(values, expected, self.eps * np.asarray(size))

    def module_value(self, name: str, s: State) -> Vector:
        """Return the value of the module's function `name`, such as "D", at the state `s`."""
        return evaluate_module(self.module, name, s)

    def has_finite_accelerations(self, s: State) -> bool:
        """Return whether the module's accelerations at `s` are finite, for single precision.

        In double precision the result is always True.
        """
        if self.dtype == np.float64:
            return True
        try:
            self.module_value("acceleration", s)
        except ArithmeticError:
            return False
        return True

    def accelerations(self, s: State) -> Acceleration:
        """Return a function of q, qd and t that computes the reference's accelerations.

        Inputs and parameters are those of `s`. q, qd and the result have the shape (nq,), or (n,
        nq) for n states.
        """

        def acceleration(q: Vector, qd: Vector, t: Vector) -> Vector:
            inputs = None if s.u is None else np.broadcast_to(s.u, (*q.shape[:-1], len(s.u)))
            return self.reference.acceleration(q, qd, t, inputs, s.params)

        return acceleration

    def start_time(self, s: State) -> float:
        """Return the time at which runs from the state `s` start, in s.

        It is the state's own time if there are constraints, which may hold at that time only.
        Otherwise it is 0.
        """
        return s.t if self.system.constraints else 0.0

    def simulate(self, s: State, method: str = "", **how: Any) -> Any:
        """Return the module's run from the state `s`, as by its method `simulate`.

        method: by default, the first of the module. how: further arguments of `simulate`, such as h
        and steps.
        """
        if method not in ("", self.methods[0]):
            how["method"] = method
        if begin := self.start_time(s):
            how.setdefault("t0", begin)
        return simulate(self.module, projected_start(self.module, s), **how)


@dataclass(frozen=True)
class CheckReport:
    """The report of `eomc check`: the results of all checks, and how they were obtained.

    scene: name of the scene. states: number of states used. rejected: number of random states left
    out since their mass matrix D was not regular. reference: how the expected values were computed,
    either "expanded equations" (formulas) or "Taylor arithmetic" (numerical).
    """

    scene: str
    results: tuple[CheckResult, ...]
    states: int
    rejected: int
    reference: str

    @property
    def passed(self) -> bool:
        """True if every check has passed."""
        return all(result.passed for result in self.results)

    def table(self) -> str:
        """Return the results as a text table, 100 columns wide, for a terminal."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table

        used = f"{self.states} random states" + f", {self.rejected} rejected" * bool(self.rejected)
        title = f"{self.scene}: {used}, against {self.reference}"
        table = Table(box=SIMPLE_HEAD, title=title, title_justify="left")
        table.add_column()
        table.add_column()
        table.add_column("found", justify="right")
        table.add_column("limit", justify="right")
        table.add_column("in")
        for x in self.results:
            mark = ("ok" if x.judged else "?") if x.passed else "FAILED"
            table.add_row(mark, x.name, f"{x.error:.3g}", f"{x.limit:g}", x.unit)
        text = io.StringIO()
        Console(file=text, width=100).print(table)
        return "\n".join(line.rstrip() for line in text.getvalue().splitlines()).strip("\n")

    def as_dict(self) -> dict[str, Any]:
        """Return the report as a dict that can be written as JSON.

        An error that is not finite becomes None.
        """
        rows = [asdict(row) for row in self.results]
        for row in rows:
            row["error"] = row["error"] if math.isfinite(row["error"]) else None
        return {
            "scene": self.scene,
            "passed": self.passed,
            "states": self.states,
            "rejected": self.rejected,
            "reference": self.reference,
            "rows": rows,
        }


Values = Callable[[Comparison, Any], Any]  # of a comparison and one of the check's states


@dataclass(frozen=True)
class Check:
    """Declaration of a check: values of the module, and the values that they must have.

    Attributes
    ----------
    name : str
        First column of the report.
    ours : callable
        Returns values of the module at a state; None if nothing can be compared there. A check
        without reference returns its error itself, as a number or a Measurement.
    reference : callable, optional
        Returns the values that `ours` must equal.
    scale : callable, optional
        Returns the size of an error of 1, for each value.
    tolerance : float
        Largest permitted error. With `minimum`, the error must exceed it.
    states : sequence
        Arguments of the three functions; by default, all sampled states with reference values.
    unit : str
        Last column of the report: what the error is measured in.
    minimum : bool
        Whether the least of the values at all states must exceed the tolerance.
    portable : bool
        Whether the check applies to the portable form of C, too.
    excuse : str
        Reason why a failing check is not judged; "" for none.
    why : str
        Reason why nothing is judged if `ours` is None at all states.
    """

    name: str
    ours: Values
    reference: Values | None = None
    scale: Values | None = None
    tolerance: float = LIMIT
    states: Sequence[Any] | None = None
    unit: str = ROUNDING
    minimum: bool = False
    portable: bool = False
    excuse: str = ""
    why: str = "there is no state to compare"

    def evaluate(self, comparison: Comparison) -> CheckResult:
        """Return the result for the optimised form of C, or for the portable one if it is worse.

        The latter counts if it fails although the optimised form passes, or has a larger error.
        """
        first, *others = (self._result(form) for form in comparison.forms[: 1 + self.portable])
        for other in others:
            if first.passed and not other.passed:
                return replace(other, name=f"plain C: {self.name}")
            if first.passed and first.judged and other.error > first.error:
                first = other
        return first

    def _result(self, of: Comparison) -> CheckResult:
        """Return the result for one form of C; an exception of the module is a failure."""
        try:
            return self._judge(self._measure(of))
        except Exception as fault:
            unit = f"{type(fault).__name__}: {fault}"
            return CheckResult(self.name, math.nan, self.tolerance, False, unit)

    def _measure(self, of: Comparison) -> float | Measurement:
        """Return the largest error over the states, or the least value."""
        errors, reason = list[float](), Measurement(math.nan, self.why)
        for state in of.expected if self.states is None else self.states:
            ours = self.ours(of, state)
            if isinstance(ours, Measurement):
                reason = ours
            if ours is None or isinstance(ours, Measurement):
                continue
            expected = (
                np.zeros(np.shape(ours)) if self.reference is None else self.reference(of, state)
            )
            scale = 1.0 if self.scale is None else self.scale(of, state)
            errors.append(float(ours) if self.minimum else units(ours, expected, scale))
        if self.minimum and errors:
            return float(np.min(np.array(errors, float)))
        return float(np.max(errors)) if errors else reason

    def _judge(self, measured: float | Measurement) -> CheckResult:
        """Return the result for a measured error."""
        limit, unit = self.tolerance, self.unit
        if isinstance(measured, Measurement):
            idle = math.isinf(measured.value)
            unit = ("not applicable: " if idle else "not judged: ") + measured.why
            return CheckResult(self.name, measured.value, limit, True, unit, judged=idle)
        passed = bool(measured > limit if self.minimum else measured <= limit)
        if not passed and self.excuse and not math.isnan(measured):
            unit = f"not judged: {self.excuse}"
            return CheckResult(self.name, measured, limit, True, unit, judged=False)
        return CheckResult(self.name, measured, limit, passed, unit)
