"""Checks of refusals: a singular D, states that are not finite, no convergence.

Parameters and states are sought at which the reference's D is not positive definite. There each
function of the module must return an error and leave its outputs unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.runtime.package import model_of
from eomc.verify import kkt
from eomc.verify.comparison import Check, Comparison
from eomc.verify.kkt import EIGENVALUE_TOLERANCE
from eomc.verify.reference import Vector
from eomc.verify.sampling import State
from support.template_checks.runs import measured, parameters, run_in_c

OK, SINGULAR, NOT_FINITE, NO_CONVERGENCE, _, LOCKED = range(6)
REFUSED = (SINGULAR, NOT_FINITE, NO_CONVERGENCE, LOCKED)
FACTORS = (0.0, -3.0, -1.0, -0.3, 2.0**-60, 2.0**60)  # by which one parameter is multiplied
MARK = -7.0  # content of output arrays that must stay unchanged


def with_nonfinite_entries(s: State) -> Iterator[tuple[str, int, float, State]]:
    """Yield copies of a state in which one coordinate or velocity is replaced by nan or inf.

    Each item is (field, index, value, state): `field` is "q" or "qd", `index` the entry in it, and
    `value` nan or inf.
    """
    for field in ("q", "qd"):
        for i in range(len(s.q)):
            for what in (math.nan, math.inf):
                x = getattr(s, field).copy()
                x[i] = what
                yield field, i, what, replace(s, **{field: x})


class RefusalChecks:
    """Checks that the module refuses states and steps, by returning an error, when it must.

    singular, regular: states with a singular and with a regular mass matrix D. The checks of D
    collect them, and later checks use them.
    """

    def __init__(self, check: Comparison) -> None:
        self.check, self.module, self.model = check, check.module, model_of(check.module)
        self.random = np.random.default_rng(8)
        self.defaults = check.sampler.defaults
        self.singular: list[State] = []
        self.regular: list[State] = []

    def checks(self) -> Iterator[Check]:
        """Yield the checks of refusals.

        With constraints, negative inertia is refused: vᵀ D v < 0 for a velocity v that they permit.
        """
        unit = "calls that do not refuse"
        if self.check.system.constraints:
            name = "negative D along the rows"
            yield measured(name, 0, unit, self.negative_inertia_errors)
            yield measured(f"{name}: refusals", 0, unit, self.missing_refusals)
        else:
            yield measured("singular D", 0, "states judged wrongly", self.misjudged_states)
            yield measured("singular D: refusals", 0, unit, self.missing_refusals)
            yield measured("singular D in a run", 0, "runs that go on", self.runs_past_singularity)
        yield measured("not finite", 0, unit, self.nonfinite_errors)
        for method in self.check.methods:
            find = partial(self.overflow_errors, method)
            yield measured(f"{method} too long", 0, "runs that end otherwise", find)

    # states with a singular D

    def negative_inertia_errors(self) -> float:
        """Return the number of states with negative inertia that the module does not refuse.

        At such a state vᵀ D v < 0 for a velocity v that the constraints permit. D may be singular,
        since constraints determine coordinates without inertia. States that are refused are
        collected in `singular`.
        """
        wrong = 0
        for s in self.suspect_states():
            with np.errstate(all="ignore"):
                D, A = (
                    np.asarray(self.check.reference.evaluate(name, s.q, s.qd, 0.0, None, s.params))
                    for name in ("D", "constraint_jacobian")
                )
            if not kkt.is_nonnegative(D, A):
                if self.accelerate(s)[0] == SINGULAR:
                    self.singular.append(s)
                else:
                    wrong += not self.lacks_precision(s, D)
        return float(wrong)

    def misjudged_states(self) -> float:
        """Return the number of states at which the module accepts a bad or refuses a good D.

        The mass matrix D is good if it is positive definite. States that the module judges
        correctly are collected in `singular` and `regular`.
        """
        suspects = self.suspect_states()
        stacked: dict[str, Any] = {
            "q": np.array([s.q for s in suspects]),
            "qd": np.array([s.qd for s in suspects]),
            "params": {
                name: np.array([(s.params or self.defaults)[name] for s in suspects])
                for name in self.defaults
            },
        }
        with np.errstate(all="ignore"):
            mass_matrices = np.asarray(self.check.reference.evaluate("D", t=0.0, u=None, **stacked))
        wrong = 0
        for s, D, least in zip(
            suspects, mass_matrices, _least_eigenvalues(mass_matrices).tolist(), strict=True
        ):
            singular = least < -EIGENVALUE_TOLERANCE or (least == 0 and self.is_exact(s))
            if not (singular or least > EIGENVALUE_TOLERANCE):
                continue
            if (self.accelerate(s)[0] == SINGULAR) == singular:
                (self.singular if singular else self.regular).append(s)
            elif singular or (self.has_default_signs(s) and self.is_exact(s)):
                wrong += not self.lacks_precision(s, D)
        return float(wrong)

    def is_exact(self, s: State) -> bool:
        """Return whether rounding has no influence on whether D is singular at a state.

        It has an influence if a parameter is tiny or huge relative to its default: if one inertia
        is 2^60 times another, the smaller one is lost in sums.
        """
        sizes = [abs(x / (self.defaults[name] or 1.0)) for name, x in (s.params or {}).items()]
        return all(x == 0 or 2.0**-30 < x < 2.0**30 for x in sizes)

    def has_default_signs(self, s: State) -> bool:
        """Return whether all parameters of a state have the signs of their defaults.

        If not, a module that divides by masses (method of link multipliers) may refuse a mass that
        is not positive, even if D is regular.
        """
        pairs = [(x, self.defaults[name]) for name, x in (s.params or {}).items()]
        return all(x * default > 0 or default == 0 for x, default in pairs)

    def lacks_precision(self, s: State, D: Vector) -> bool:
        """Return whether the module's D is so inexact that rounding decides if it is singular.

        D: the exact mass matrix (nq, nq) at `s`. The module's D is so inexact if, for instance,
        lengths are huge.
        """
        size = np.sqrt(np.abs(np.diag(D)))
        off = np.abs(self.check.module_value("D", s) - D)
        return bool(np.any(off > 1e-6 * np.outer(size, size)))

    def suspect_states(self) -> list[State]:
        """Return states at which D may be singular since their parameters are changed.

        In some, a single parameter is zero, negative, tiny or huge; in others, all parameters are
        random with random signs.
        """
        states = self.base_states()
        suspects_ = []
        changes: list[dict[str, float]] = [{}]
        for name, value in self.defaults.items():
            changes += [{name: factor * (value or 1.0)} for factor in FACTORS]
        for scale in (0.0, -1.0):
            changes.append({name: scale * value for name, value in self.defaults.items()})
        n = len(self.defaults)
        # one negative eigenvalue makes one negative pivot, whatever the order of elimination
        alone = np.repeat(1 - 2 * np.eye(n), 8, axis=0)
        for signs in (*alone, *self.random.choice([-1, 1, 1], (60, n))):
            sizes = np.exp(self.random.uniform(-3, 3, n))
            changes.append({
                name: (value or 1.0) * sign * size
                for (name, value), sign, size in zip(
                    self.defaults.items(), signs.tolist(), sizes.tolist(), strict=True)
            })  # fmt: skip
        for change in changes:
            suspects_ += [replace(s, params={**self.defaults, **change}) for s in states]
        most = 240 if self.check.large else 1200
        order = self.random.permutation(len(suspects_))[:most]
        return [suspects_[k] for k in sorted(order)]

    def base_states(self) -> list[State]:
        """Return states at which D may be singular for some parameters.

        They are the initial state, three random states, and states with all coordinates equal to 0,
        π/2 or π.
        """
        own = self.check.sampler.start
        drawn = [e.state for e in self.check.few(4)[1:]]
        states = [own, *drawn]
        for at in (0.0, math.pi / 2, math.pi):
            states.append(replace(own, q=np.full(len(own.q), at)))
        return [replace(s, t=0.0, u=None) for s in states]

    def accelerate(self, s: State) -> tuple[int, bool]:
        """Return the status of the C function `acceleration`, and whether its outputs are valid.

        After an error the outputs must be unchanged; otherwise they must be finite.
        """
        model = self.model
        a = np.full(model.info.nq, MARK, model.info.dtype)
        q, qd = (np.array(x, model.info.dtype) for x in (s.q, s.qd))
        u = None if s.u is None else np.array(s.u, model.info.dtype)
        p = parameters(model, s)
        status = model.c.lib.acceleration(
            1, model.c.pointer(a), model.c.pointer(q), model.c.pointer(qd), s.t, model.c.pointer(u),
            model.c.pointer(p), model.c.tools[2],
        ) & 7  # fmt: skip
        clean = bool(np.all(a == MARK)) if status else bool(np.all(np.isfinite(a)))
        return status, clean

    def missing_refusals(self) -> float:
        """Return the number of calls at singular states that return no error or write to outputs.

        The functions are acceleration, multipliers, steps and runs by all methods, and derivatives.
        """
        wrong, run = 0, self.check.system.run
        solved = ("acceleration", "multipliers")[: 1 + bool(self.check.system.constraints)]
        for s in self.singular[:: max(1, len(self.singular) // 24)]:
            wrong += not self.accelerate(s)[1]
            for name in solved:
                wrong += not self.raises(partial(self.call, name, s), "singular")
            for method in self.check.methods:
                wrong += not self.stops_at_start(method, s, "singular")
            derivatives_present = {
                "linearize": self.model.functions.has_slopes,
                "discretize": run.discretize,
            }
            for name in (name for name, there in derivatives_present.items() if there):
                wrong += not self.raises(partial(self.call, name, s), "singular")
        return float(wrong)

    def call(self, name: str, s: State) -> Any:
        """Return the result of the module's function `name` at the state `s`."""
        return getattr(self.module, name)(s.q, s.qd, t=s.t, u=s.u, params=s.params)

    def raises(self, call: Callable[[], Any], status: str) -> bool:
        """Return whether a call raises ArithmeticError with the given status.

        status: name of the error, such as "singular". The message must contain the coordinates q.
        """
        try:
            call()
        except ArithmeticError as fault:
            return getattr(fault, "status", "") == status and "q = " in str(fault)
        return False

    def stops_at_start(self, method: str, s: State, status: str) -> bool:
        """Return whether a step and a run from `s` stop at once with the error `status`.

        The step must leave its outputs unchanged, and the run must store the initial state only.
        """
        out = tuple(np.full(len(s.q), MARK, self.model.info.dtype) for _ in range(2))
        options = {"params": s.params, "u": s.u, "method": method}
        step = partial(self.module.step, s.q, s.qd, t=s.t, out=out, **options)
        if not self.raises(step, status) or not np.all(np.array(out) == MARK):
            return False
        try:
            run = self.check.simulate(s, method, steps=5)
        except ArithmeticError:  # the projection of the initial state uses D too
            return bool(self.check.system.constraints)
        unchanged = np.array_equal(run.q, np.asarray([s.q], run.q.dtype))
        return bool(
            unchanged and run.status == status and run.steps == 0 and "stopped" in run.message
        )

    def runs_past_singularity(self) -> float:
        """Return the number of runs that continue past a singular D, or store nan or inf.

        The runs start at states with a regular D and lead to states where D is singular. States at
        which rounding decides whether D is singular are left out.
        """
        wrong = tried = 0
        h = self.check.system.run.h
        for s in filter(self.is_exact, self.singular):
            starts = [r for r in self.regular if r.params == s.params]
            for start in starts[:1]:
                if tried == 24:
                    break
                tried += 1
                ways = [
                    (start, 0.5),
                    (start, 20.5),
                    *((x, 20.5) for x in self.regular_neighbour(s, tried)),
                ]
                for begin, parts in ways:
                    at = replace(begin, qd=(s.q - begin.q) / (parts * h))
                    for method in self.check.methods:
                        wrong += self.continues_past_singularity(method, at, math.ceil(parts))
        return float(wrong)

    def regular_neighbour(self, s: State, turn: int) -> list[State]:
        """Return a list with one regular state near the singular state `s`, or an empty list.

        The regular state differs from `s` in one coordinate, which the number `turn` selects, and
        has zero velocities. The list is empty if no displacement of that coordinate gives a regular
        D.
        """
        i = turn % len(s.q)
        for by in (-0.1, 0.1, -0.4, 0.4):
            q = s.q.copy()
            q[i] += by * self.check.sampler.spread[i]
            at = replace(s, q=q, qd=np.zeros_like(q))
            if self.accelerate(at)[0] == OK:
                return [at]
        return []

    def continues_past_singularity(self, method: str, s: State, steps: int) -> bool:
        """Return whether a run makes a step from a state at which D is not positive definite.

        The run starts at `s`, by `method`, with up to steps + 3 steps. The result is True as well
        if the run stores a state that is not finite.
        """
        run = run_in_c(self.model, method, s, self.check.system.run.h, steps + 3)
        rows = run.rows[:, : run.steps + 1].astype(float)
        if not np.all(np.isfinite(rows)):
            return True
        # an angle of 1e20 rad has no digits that determine D
        digits = np.abs(rows[0]) * self.check.eps < EIGENVALUE_TOLERANCE * self.check.sampler.spread
        known = int(np.argmin([*np.all(digits, axis=1), False]))
        # the last state kept may be singular, but no step is made from it
        least = self.least_eigenvalues(rows[0, : min(known, run.steps)], s)
        if METHODS[method].c[0]:  # no stage is at the start of a step
            starts_negative = np.flatnonzero(least[: max(0, known - 1)] < -EIGENVALUE_TOLERANCE)
            positions = self.positions_along_step(
                rows[:, starts_negative], rows[:, starts_negative + 1]
            )
            least = np.max([self.least_eigenvalues(q, s) for q in positions], axis=0)
        return bool(np.any(least < -EIGENVALUE_TOLERANCE))

    def positions_along_step(self, starts: Vector, ends: Vector) -> list[Vector]:
        """Return positions within n steps, by cubic interpolation, as one array (n, nq) per point.

        The points are nine equidistant fractions of a step. starts, ends: q and q̇ before and after
        the steps, (2, n, nq).
        """
        (q, qd), (r, v), h = starts, ends, self.check.system.run.h
        return [
            q + (r - q) * x**2 * (3 - 2 * x) + h * x * (1 - x) * (qd * (1 - x) - v * x)
            for x in np.linspace(0, 1, 9).tolist()
        ]

    def least_eigenvalues(self, q: Vector, s: State) -> Vector:
        """Return the least eigenvalue of the reference's D at each of n positions, (n,).

        D is first scaled to a unit diagonal. q: the positions (n, nq). s: a state whose parameters
        are used.
        """
        if not len(q):
            return np.zeros(0)
        with np.errstate(all="ignore"):
            D = self.check.reference.evaluate("D", q, 0 * q, 0.0, None, s.params)
        return _least_eigenvalues(np.asarray(D))

    # states with nan or inf

    def nonfinite_errors(self) -> float:
        """Return the number of calls that return no error for a state with nan or infinity."""
        s, wrong = self.check.few(2)[-1].state, 0
        for field, i, what, at in with_nonfinite_entries(s):
            status, clean = self.accelerate(at)
            wrong += not clean
            # tanh and exp(-x) are finite at infinity, and a factor may be 0
            silent = math.isnan(what) and not status and self.depends_on(s, field, i)
            wrong += silent and not self.has_finite_reference(at)
            if self.check.system.constraints:
                wrong += not self.has_valid_multipliers(at)
            for method in self.check.methods:
                run = run_in_c(self.model, method, at, self.check.system.run.h, 3)
                wrong += run.steps != 0 or run.status not in REFUSED
            wrong += self.model.functions.has_slopes and not self.has_valid_linearization(at)
        return float(wrong)

    def has_valid_multipliers(self, s: State) -> bool:
        """Return whether the C function `multipliers` gives finite values, or an error and nan."""
        model = self.model
        multipliers = np.zeros(len(model.info.constraints.names), model.info.dtype)
        q, qd = (np.array(x, model.info.dtype) for x in (s.q, s.qd))
        u = None if s.u is None else np.array(s.u, model.info.dtype)
        p = parameters(model, s)
        refused = model.c.lib.multipliers(
            1, model.c.pointer(multipliers), model.c.pointer(q), model.c.pointer(qd), s.t,
            model.c.pointer(u), model.c.pointer(p), model.c.tools[2],
        )  # fmt: skip
        return bool(np.all(np.isnan(multipliers) if refused else np.isfinite(multipliers)))

    def depends_on(self, s: State, field: str, i: int) -> bool:
        """Return whether the module's accelerations at `s` depend on one coordinate or velocity.

        field: "q" or "qd". i: index of the coordinate.
        """
        x = getattr(s, field).copy()
        x[i] += 0.1 * (1 + abs(x[i]))
        one, other = (
            self.check.module_value("acceleration", at) for at in (s, replace(s, **{field: x}))
        )
        return not np.array_equal(one, other)

    def has_finite_reference(self, s: State) -> bool:
        """Return whether the reference's D, bias and tau are finite at a state with nan or inf.

        They may be, since functions such as tanh and atan are finite at infinity.
        """
        with np.errstate(all="ignore"):
            values = [
                self.check.reference.evaluate(name, s.q, s.qd, s.t, s.u, s.params)
                for name in ("D", "bias", "tau")
            ]
        return all(bool(np.all(np.isfinite(value))) for value in values)

    def has_valid_linearization(self, s: State) -> bool:
        """Return whether the C function `linearization` gives finite values or returns an error.

        After an error its outputs must be unchanged.
        """
        model, n = self.model, self.model.info.nq
        A, B = (np.full((2 * n, w), MARK, model.info.dtype) for w in (2 * n, max(1, model.info.nu)))
        q, qd = (np.array(x, model.info.dtype) for x in (s.q, s.qd))
        p = parameters(model, s)
        status = model.c.lib.linearization(
            1, *(model.c.pointer(x) for x in (A, B, q, qd)), s.t,
            model.c.pointer(None if s.u is None else np.array(s.u, model.info.dtype)),
            model.c.pointer(p), model.c.tools[2],
        )  # fmt: skip
        written = np.hstack([A, *([B] if model.info.nu else [])])
        return bool(np.all(written == MARK) if status & 7 else np.all(np.isfinite(written)))

    def overflow_errors(self, method: str) -> float:
        """Return the number of runs with far too long steps that do not end as required.

        With such steps the state overflows, or the iteration for the stages of an implicit method
        does not converge. The run must then return an error and store finite states only.
        """
        s, wrong = self.check.few(2)[-1].state, 0
        ended = []
        for power in (4, 8, 16, 40, 100, 160, 300):
            h = self.check.system.run.h * 10.0**power
            if h > float(np.finfo(self.model.info.dtype).max):
                break
            run = run_in_c(self.model, method, s, h, 12)
            stored = run.rows[:, : run.steps + 1]
            wrong += not np.all(np.isfinite(stored))
            wrong += bool(run.status == OK) != (run.steps == 12)
            wrong += run.status == NO_CONVERGENCE and not METHODS[method].implicit
            ended.append(run.status)
        # one coordinate overflows at the end of the step, if forces permit it
        huge = float(np.finfo(self.model.info.dtype).max) / 2
        for unit in np.eye(len(s.q)):
            run = run_in_c(
                self.model, method, replace(s, q=huge * unit, qd=1.01 * huge * unit), 1.0, 1
            )
            wrong += not np.all(np.isfinite(run.rows[:, : run.steps + 1]))
        return float(wrong + (ended[-1] == OK))


def _least_eigenvalues(D: Vector) -> Vector:
    """Return the least eigenvalue of D_ij / sqrt(|D_ii D_jj|) for each D (n, nq, nq): (n,).

    It is 0 if a diagonal entry is 0, and nan if a value is not finite.
    """
    diagonal = np.sqrt(np.abs(np.diagonal(D, axis1=1, axis2=2)))
    with np.errstate(all="ignore"):
        scaled = D / (diagonal[:, :, None] * diagonal[:, None, :])
    known = np.all(np.isfinite(scaled), axis=(1, 2))
    least = np.full(len(D), np.nan)
    least[known] = np.linalg.eigvalsh(scaled[known])[:, 0]
    empty = np.any(diagonal == 0, axis=1) & np.all(np.isfinite(D), axis=(1, 2))
    return np.asarray(np.where(empty, 0.0, least))
