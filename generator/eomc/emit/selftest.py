"""The test cases of selftest.c: expected results of each C function, computed in Python.

Functions are evaluated by the interpreter of programs, and steps by the tableaux of their methods
with accelerations from there. Jumps and events are computed from states at which an event function
is zero. No generated C is run, and none of its text is used.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, cached_property, partial
from itertools import chain, islice, pairwise
from typing import Any

from eomc.emit.common.c_expression import DOUBLE
from eomc.emit.common.c_function import CFunction, break_comments, member
from eomc.emit.common.c_names import Target
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.public import EXTRA_ARGUMENTS, KINDS
from eomc.emit.common.templates import show
from eomc.integrators.tableaux import DP8, METHODS, Method
from eomc.model.symbols import ALONG, add_suffix
from eomc.program.ir import evaluator, nearby
from eomc.program.outline import weight
from eomc.program.program import TIME
from eomc.program.two_point import separate_angles

# Each dictionary has a value for double precision (True) and one for single precision (False).
ANGLE_LIMIT = {True: 2.0**20, False: 2.0**13}  # rad, of sincos.h and of sincosf.h
# Error limits are relative to the largest expected number. This one is some thousand rounding
# errors; it covers differences between C libraries and orders of summation.
ROUNDING_TOLERANCE = {True: 1e-12, False: 1e-4}
PERTURBATION_FACTOR = (
    1000  # error limit over the effect of one ulp in the state, as in `eomc check`
)
MAX_TOLERANCE = {True: 1e-6, False: 1e-2}  # cases with a larger error limit are left out
# At large angles sines are less accurate if a multiply-add rounds twice.
LARGE_ANGLE_TOLERANCE = {True: 1e-12, False: 1e-5}
ACCELERATION_TOLERANCE = {True: 1e-9, False: 1e-3}  # of accelerations at large angles
ITERATION_TOLERANCE = {True: 1e-11, False: 1e-3}  # of projections, differences and sums over steps
IMPLICIT_TOLERANCE = {True: 1e-9, False: 1e-3}  # of the iteration of implicit methods
SWEEP_TOLERANCE = {True: 1e-6, False: 1e-3}  # of a fixed number of fixed-point iterations
MAX_LARGE_STATES = 3  # tested states with large angles
# Large angles are multiples of 1/ANGLES_PER_RADIAN, so that sums and multiples of them are exact.
ANGLES_PER_RADIAN = 16
RUN_STEPS = 3  # steps of a tested run
MAX_GROWTH = 30  # of a state in a run: if it grows more, the steps are too long to be tested
MAX_SWEEPS = 60  # iterations over the stages of an implicit method
MAX_OPERATIONS = 4000  # of accelerations; above it, few cases and explicit steps only
START_TIME = 0.4  # s, the time of the first state; signals often are special at t = 0
# Central differences of order 8: multiples of the width, and their weights
STENCIL = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))

Vector = list[float]
Values = dict[str, float]
TriggeredEvent = tuple[float, int]  # when, and which event


class NoCaseError(Exception):
    """Error: no expected result can be computed for a test case of selftest.c.

    The reason is that accelerations are singular or not finite, that an iteration does not
    converge, or that the results are not accurate enough.
    """


@dataclass(frozen=True)
class TestArguments:
    """Arguments of one test call in selftest.c, as C literals.

    Attributes
    ----------
    arrays
        Values of q and qd, then of each other array.
    t
        Time in s.
    span
        Size of a step or length of a run, in s.
    u
        Inputs; empty if the scene's signals supply them.
    other
        Whether the parameters are a second set rather than those of the scene.
    """

    arrays: tuple[tuple[str, ...], ...]
    t: str
    span: str
    u: tuple[str, ...]
    other: bool


@dataclass(frozen=True)
class TestCase:
    """Expected result of a C function for one state, with an error limit.

    Attributes
    ----------
    state
        Index of the state.
    expected
        Expected numbers as C literals.
    limit
        Largest permitted error, relative to the largest expected number.
    """

    state: int
    expected: tuple[str, ...]
    limit: float


@dataclass(frozen=True)
class TestFunction:
    """A test function of selftest.c, which calls one function of the generated header.

    Attributes
    ----------
    name
        Name of the tested function without the scene's prefix.
    kind
        Form of the test's body in the template: "values", "number", "status", "moved", "run",
        "batch", "derivative" or "adaptive".
    call
        The C call that is tested.
    cases
        Expected results for several states.
    method
        C enumerator of the method of a run; "" if the scene has only one.
    """

    name: str
    kind: str
    call: str
    cases: tuple[TestCase, ...]
    method: str = ""

    @property
    def size(self) -> int:
        """Largest number of expected numbers in a case."""
        return max(len(case.expected) for case in self.cases)


@dataclass(frozen=True)
class TestPoint:
    """Arguments of a test call.

    Attributes
    ----------
    values
        State, time, inputs, parameters and other arguments by name.
    signals
        Whether the scene's signals supply the inputs.
    other
        Whether the parameters are those of `_Cases.other_parameters`.
    span
        Size of a step or length of a run, in s.
    """

    values: Mapping[str, float]
    signals: bool = True
    other: bool = False
    span: float = 0.0


def selftest(functions: SceneFunctions) -> str:
    """Return the text of selftest.c: test calls, their expected results and error limits."""
    target = functions.target
    cases = _Cases(functions)
    tested = [t for t in cases.test_functions() if t.cases]
    other = cases.other_parameters if cases.uses_other else ()
    limit = "2^20" if cases.double else "2^13"
    text = show(
        "c/selftest.c",
        functions,
        states=[cases.state(p) for p in cases.points],
        other=target.real.literals(p.value for p in other),
        arrays=cases.arrays,
        tested=tested,
        large_limit=limit if cases.has_large else "",
        steps=RUN_STEPS,
        tolerance=target.literal(1e-12 if cases.double else 1e-6),
    )
    return break_comments(text)


class _Cases:
    """The test cases of selftest.c for one program.

    Expected results are computed in Python. `points` are the states of the cases so far; a case
    refers to its state by the index in this list.
    """

    def __init__(self, functions: SceneFunctions) -> None:
        self.target, self.public = functions.target, functions.public
        target = self.target
        self.program, self.system = target.program, target.system
        self.double = target.real is DOUBLE
        self.points: list[TestPoint] = []
        self.has_large = self.uses_other = False
        self.state_names = tuple(x.name for x in (*self.system.q, *self.system.qd))
        self.states_after_steps: dict[tuple[Any, ...], Vector] = {}
        self.known: dict[str, Callable[[Mapping[str, float]], tuple[Vector, bool]]] = {}

    # values in Python

    def evaluate(self, name: str, values: Mapping[str, float]) -> Vector:
        """Return the results of the program's function `name`, computed in Python.

        `values` are the arguments (state, time, parameters, ...) by name. Raises NoCaseError if the
        results are not finite, or if a pivot of a matrix to be factored is not positive.
        """
        try:
            result, regular = self.evaluator(name)(values)
        except (ArithmeticError, ValueError):
            raise NoCaseError from None
        if not regular:
            raise NoCaseError
        return result

    def evaluator(self, name: str) -> Callable[[Mapping[str, float]], tuple[Vector, bool]]:
        """Return a Python function that evaluates the program's function `name`.

        It takes a mapping from names to values. It returns the results, and False if a matrix is
        singular, otherwise True. The Python function is cached.
        """
        if name not in self.known:
            unit = 2.0**-52 if self.double else 2.0**-20  # eight times a float's
            self.known[name] = evaluator(self.program[name], unit=unit)
        return self.known[name]

    def value(self, name: str, point: TestPoint) -> Vector:
        """Return the results that the generated C function `name` should give, computed in Python.

        `point` has the arguments of the C function. If it specifies no inputs, the scene's signals
        (functions of time and state) supply them. Raises NoCaseError.
        """
        values = self.complete(point)
        if name in self.program:
            results = self.evaluate(name, values)
            rows = [results[k : k + self.width] for k in range(0, len(results), self.width)]
        elif f"{name}_column" in self.program:
            rows = self.by_columns(name, values)
        elif name == "energy":
            parts = (self.evaluate(f"{n}_energy", values)[0] for n in ("kinetic", "potential"))
            return [sum(parts)]
        else:
            raise NoCaseError
        n = self.nq
        ends: tuple[int, ...] = (0, self.width)
        if name == "linearization":  # A_q, A_qd and B one after the other
            rows, ends = rows[:n], (0, n, 2 * n, self.width)
        return [x for a, b in pairwise(ends) for row in rows for x in row[a:b]]

    def by_columns(self, name: str, values: Mapping[str, float]) -> list[Vector]:
        """Return the rows of a matrix such as D or the linearization.

        It is computed by columns: the program has a function for the product of the matrix and a
        vector, and column k is the product with unit vector k. `values` are the arguments by name.
        """
        names = [x.name for x in (*self.system.q, *self.system.qd, *self.system.u)]
        zero = {add_suffix(n, ALONG): 0.0 for n in names}
        own = names if name == "linearization" else names[: self.nq]
        columns = [
            self.evaluate(f"{name}_column", {**values, **zero, add_suffix(n, ALONG): 1.0})
            for n in own
        ]
        return [list(row) for row in zip(*columns, strict=True)]

    def complete(self, point: TestPoint) -> Values:
        """Return the values of a point by name, including the inputs.

        Inputs that the point does not specify are computed by the scene's signals, the functions of
        time and state that define inputs.
        """
        values = dict(point.values)
        if point.signals and "signal" in self.program:
            u = self.evaluate("signal", values)
            values |= {i.name: x for i, x in zip(self.system.inputs, u, strict=True)}
        return values

    @property
    def nq(self) -> int:
        """The number of coordinates."""
        return len(self.system.q)

    @property
    def width(self) -> int:
        """The number of columns of [A_q, A_qd, B], the linearization: 2 nq + nu."""
        return 2 * self.nq + len(self.system.inputs)

    # steps in Python

    def acceleration(self, point: TestPoint, x: Vector, t: float) -> Vector:
        """Return the accelerations qdd at the state x = [q; qd] and time t (s).

        `point` supplies the inputs and the parameters.
        """
        return self.evaluate("acceleration", self.complete(self.at_state(point, x, t)))

    def at_state(self, point: TestPoint, x: Vector, t: float) -> TestPoint:
        """Return a copy of the point with the state x = [q; qd] and the time t (s)."""
        values = {**point.values, **dict(zip(self.state_names, x, strict=True)), TIME: t}
        return TestPoint(values, point.signals, point.other, point.span)

    def state_of(self, point: TestPoint) -> Vector:
        """Return the state [q; qd] in a point's values as one list."""
        return [point.values[name] for name in self.state_names]

    def step(self, m: Method, point: TestPoint, x: Vector, t: float, h: float) -> Vector:
        """Return the state [q; qd] after one step of the integration method m.

        The step of size h (s) begins at time t (s) in the state x. `point` supplies the inputs and
        the parameters. Raises NoCaseError if the iteration over the stages does not converge.
        Several cases begin with the same steps, whose results are cached.
        """
        key = (m.name, t, h, *x, point.signals, *point.values.values())
        if key not in self.states_after_steps:
            self.states_after_steps[key] = self.compute_step(m, point, x, t, h)
        return self.states_after_steps[key]

    def compute_step(self, m: Method, point: TestPoint, x: Vector, t: float, h: float) -> Vector:
        """Return the result of `step`, computed anew."""
        n, a = self.nq, [[0.0] * self.nq for _ in m.b]
        A, AA, (c, b, b_a) = _tableau(m.name)

        def stage(i: int) -> Vector:
            moved = list(x)
            for k in range(n):
                of_q = sum([w * a[j][k] for j, w in AA[i]])
                of_qd = sum([w * a[j][k] for j, w in A[i]])
                moved[k] += h * (c[i] * x[n + k] + h * of_q)
                moved[n + k] += h * of_qd
            return self.acceleration(point, moved, t + c[i] * h)

        if not m.implicit:
            for i in range(m.stages):
                a[i] = stage(i)
        else:
            first, last = self.acceleration(point, x, t), math.inf
            a[:] = [first] * m.stages
            for _ in range(MAX_SWEEPS):
                new = [stage(i) for i in range(m.stages)]
                change = max(
                    abs(p - q)
                    for u, v in zip(new, a, strict=True)
                    for p, q in zip(u, v, strict=True)
                )
                size = max(abs(p) for u in new for p in u) + max(map(abs, x[n:])) / abs(h)
                a[:] = new
                if change <= 1e-15 * size or last <= change <= 1e-13 * size:
                    break
                last = change
            else:
                raise NoCaseError
        end = list(x)
        for k in range(n):
            of_q = sum(w * s[k] for w, s in zip(b_a, a, strict=True))
            of_qd = sum(w * s[k] for w, s in zip(b, a, strict=True))
            end[k] += h * (x[n + k] + h * of_q)
            end[n + k] += h * of_qd
        return self.project(point, end, t + h)

    def project(self, point: TestPoint, x: Vector, t: float) -> Vector:
        """Return the state x = [q; qd], projected onto the constraints at time t (s).

        The projection iterates. `point` supplies the parameters. Without constraints, x is returned
        unchanged. Raises NoCaseError if the iteration does not converge.
        """
        if not self.system.constraints:
            return x
        for _ in range(12):
            d = self.evaluate("projection", self.complete(self.at_state(point, x, t)))
            x = [a + b for a, b in zip(x, d, strict=False)]
            if max(map(abs, d[: self.nq])) <= 1e-12 * max(1e-3, *map(abs, x)):
                return x
        raise NoCaseError

    def integrate(
        self, point: TestPoint, x: Vector, t: float, span: float, steps: int = 4
    ) -> Vector:
        """Return the state [q; qd] at time t + span (s), by integration from the state x at time t.

        The integration takes `steps` equal steps of order 8; `span` may be negative. `point`
        supplies the inputs and the parameters.
        """
        for k in range(steps):
            x = self.step(DP8, point, x, t + span * k / steps, span / steps)
        return x

    # states

    @cached_property
    def other_parameters(self) -> tuple[Any, ...]:
        """The parameters with a second set of values, each 1 to 7 percent larger in magnitude."""
        return tuple(
            replace(p, value=self.round_short(p.value * (1 + 0.01 * (k % 7 + 1))))
            for k, p in enumerate(self.system.parameters)
        )

    def round_short(self, x: float) -> float:
        """Return a number rounded to six significant digits and to the C type of numbers."""
        x = float(f"{x:.6g}")
        return x if self.double else _single(x)

    @cached_property
    def near_points(self) -> tuple[TestPoint, ...]:
        """About three points near the initial state, at which functions are tested.

        In the last ones, the inputs are specified; otherwise the scene's signals supply them. One
        point has the second set of parameters. Expensive systems have two points only.
        """
        points = [self.point(k, START_TIME + 0.37 * k) for k in range(1, 4)]
        if self.other_parameters:
            points[1] = replace(
                points[1], other=True,
                values={**points[1].values, **{p.name: p.value for p in self.other_parameters}},
            )  # fmt: skip
        if self.system.inputs:
            points[2] = self.with_inputs(points[2], 0.0)
        if "applied" in self.program:
            points += [
                self.with_inputs(self.point(k, 0.9), part) for k, part in ((4, 1.0), (5, -1.0))
            ]
        return tuple(points) if self.is_short else (points[1], points[2])

    def point(self, k: int, t: float) -> TestPoint:
        """Return the k-th test point around the initial state, at time t (s).

        It also has values for accelerations, multipliers and frame forces, which functions may
        read.
        """
        values = {**nearby(self.system, k), TIME: t}
        more = self.extra_names
        values |= {name: 0.4 + 0.3 * math.sin(1.7 * k + 2.1 * i) for i, name in enumerate(more)}
        exact = (lambda x: x) if self.double else _single
        return TestPoint(
            {
                name: self.round_short(x) if name in self.varied_names else exact(x)
                for name, x in values.items()
            }
        )

    @cached_property
    def varied_names(self) -> frozenset[str]:
        """Names of the values of a point other than parameters."""
        return frozenset(nearby(self.system, 0)) - {p.name for p in self.system.parameters} | {
            *self.extra_names
        }

    @cached_property
    def extra_names(self) -> list[str]:
        """Names of accelerations, frame forces and multipliers, then of the vectors of products."""
        arrays = self.extra_arrays
        names = [x for array in ("qdd", "wrenches", "lambda") for x in arrays[array]]
        products = [n for n in ("along", "qdd_bar") if "acceleration_vjp" in self.program]
        return [*names, *(x for array in products for x in arrays[array])]

    @cached_property
    def extra_arrays(self) -> dict[str, list[str]]:
        """The names of the variables in each array of EXTRA_ARGUMENTS, in their order."""
        s = self.system
        along = [x.name for x in (*s.q, *s.qd, *s.u, *s.parameters)]
        return {
            "qdd": [x.name for x in s.qdd],
            "wrenches": [x.name for x in self.target.wrenches],
            "lambda": self.target.multipliers,
            "along": [add_suffix(name, ALONG) for name in along],
            "qdd_bar": [add_suffix(x.name, ALONG) for x in s.qdd],
        }

    def with_inputs(self, point: TestPoint, beyond: float) -> TestPoint:
        """Return a copy of the point in which the inputs are specified.

        In other points the scene's signals supply them. beyond: 0 for inputs within their
        saturation limits; 1 or -1 for inputs above the upper or below the lower limits.
        """
        names = self.target.input_names
        u = [0.6 + 0.25 * math.cos(1.3 * i) for i in range(len(names))]
        if "applied" in self.program:
            ends = []
            for huge in (-1e9, 1e9):
                values = {**point.values, **dict.fromkeys(names, huge)}
                ends.append(self.evaluate("applied", values))
            for i, (least, most) in enumerate(zip(*ends, strict=True)):
                if beyond:
                    end = most if beyond > 0 else least
                    u[i] = end + beyond * (0.5 + 0.5 * abs(end)) if abs(end) < 1e9 else u[i]
                elif abs(least) < 1e9 or abs(most) < 1e9:
                    low, high = max(least, most - 2), min(most, least + 2)
                    low, high = (low, high) if low <= high else (least, most)
                    u[i] = low + 0.7 * (high - low)
        values = {n: self.round_short(x) for n, x in zip(names, u, strict=True)}
        return replace(point, values={**point.values, **values}, signals=False)

    def index_of(self, point: TestPoint) -> int:
        """Return the index of a point in the list of all test points.

        A point that is not yet in the list is appended to it.
        """
        if point not in self.points:
            self.points.append(point)
        self.uses_other |= point.other
        return self.points.index(point)

    @property
    def arrays(self) -> tuple[tuple[str, str], ...]:
        """Name and size (C text) of each array that C test functions take besides q and qd."""
        sizes = {a.name: a.extent for f in self.public.evaluations() for a in f.arguments}
        return tuple((n, sizes[n]) for n in EXTRA_ARGUMENTS if n in sizes)

    def state(self, point: TestPoint) -> TestArguments:
        """Return the arguments of a test call at a point, with numbers as C literals."""
        s, literal = self.system, self.target.literal
        arrays = [[x.name for x in s.q], [x.name for x in s.qd]]
        arrays += [self.extra_arrays[name] for name, _ in self.arrays]
        return TestArguments(
            arrays=tuple(tuple(literal(point.values[n]) for n in row) for row in arrays),
            t=literal(point.values[TIME]),
            span=literal(point.span),
            u=tuple(literal(point.values[n]) for n in self.input_names(point)),
            other=point.other,
        )

    def input_names(self, point: TestPoint) -> list[str]:
        """Return the names of the inputs that a point specifies.

        The list is empty if the scene's signals supply the inputs.
        """
        return [] if point.signals else self.target.input_names

    # cases

    def case(
        self, point: TestPoint, compute: Callable[[TestPoint], Vector], allowed: float = 0.0,
        sharp: bool = False,
    ) -> TestCase | None:  # fmt: skip
        """Return a test case: the expected results at a point, with their error limit.

        `compute` returns the results at a point. The limit is relative to the largest result. It is
        1000 times the effect of perturbing the state by one ulp, but at least `allowed` and a basic
        tolerance. With `sharp`, it is exactly `allowed`. Returns None if the results cannot be
        computed or the limit would be too large.
        """
        try:
            expected = compute(point)
            limit = allowed if sharp else max(allowed, ROUNDING_TOLERANCE[self.double])
            scale = max(map(abs, expected), default=0.0)
            for turn in () if sharp else range(2 if self.is_short else 1):
                limit = max(
                    limit, PERTURBATION_FACTOR * _off(compute(self.perturb(point, turn)), expected)
                )
        except (NoCaseError, ArithmeticError, ValueError, IndexError):
            return None
        if not scale < 1e12 or limit > max(MAX_TOLERANCE[self.double], allowed):
            return None
        literal = self.target.literal
        return TestCase(
            self.index_of(point), tuple(literal(x) for x in expected), float(f"{limit:.2g}")
        )

    def perturb(self, point: TestPoint, turn: int) -> TestPoint:
        """Return a copy of the point with each coordinate and velocity changed by about one ulp.

        An ulp is the distance to the next floating-point number. turn: 0 or 1, for two different
        patterns of signs.
        """
        ulp = self.target.real.epsilon
        moved = {}
        for i, name in enumerate(self.state_names):
            x, sign = point.values[name], (-1) ** (i * (turn + 1) + turn)
            moved[name] = x + sign * ulp * max(abs(x), 0.1)
        return replace(point, values={**point.values, **moved})

    def test_functions(self) -> Iterator[TestFunction]:
        """Yield a test of each function of the generated C header, in the order of the header."""
        for function in self.public.evaluations():
            name = function.name.removeprefix(f"{self.target.prefix}_")
            cases = [self.case(p, partial(self.value, name)) for p in self.near_points]
            if name in ("D", "bias"):
                cases += self.large_angle_cases(name)
            out = KINDS[name].out
            kind = "status" if self.public.refuses(name) else "values" if out else "number"
            call = self.call(function, **({out: "out"} if out else {}))
            yield self.test_function(name, kind, call, cases)
        cases = [self.case(p, partial(self.value, "acceleration")) for p in self.near_points]
        cases += self.large_angle_cases("acceleration")
        call = self.call(self.public.acceleration, qdd="out")
        yield self.test_function("acceleration", "status", call, cases)
        if {"linearization", "linearization_column"} & {*self.program.functions}:
            f = self.public.linearization
            at = {"A_q": "out", "A_qd": "out + NQ*NQ", "B": "out + 2*NQ*NQ"}
            cases = [self.case(p, partial(self.value, "linearization")) for p in self.near_points]
            yield self.test_function("linearization", "status", self.call(f, **at), cases)
        yield from self.test_motions()

    def test_function(
        self, name: str, kind: str, call: str, cases: Sequence[TestCase | None], method: str = ""
    ) -> TestFunction:
        """Return the data of a test of the C function `name`; cases that are None are left out.

        call: the tested C call. kind: form of the test's body in the template, see `TestFunction`.
        method: as in `TestFunction`.
        """
        return TestFunction(name, kind, call, tuple(filter(None, cases)), method)

    def call(self, f: CFunction, **passed: str) -> str:
        """Return a C call of f in which the arguments are members of the struct s, the test state.

        passed: C expressions of other arguments, by name.
        """
        fields = ("q", "qd", *EXTRA_ARGUMENTS, "t", "u", "p")
        at = {n: member("s", n) for n in fields}
        at |= {"t0": member("s", "t"), "h": member("s", "span")}
        return f.call(**at | passed)

    def large_angle_cases(self, name: str) -> list[TestCase | None]:
        """Return up to three test cases of function `name` with large angles."""
        cases: list[TestCase | None] = []
        for values in islice(self.large_states, MAX_LARGE_STATES):
            allowed = (ACCELERATION_TOLERANCE if name == "acceleration" else LARGE_ANGLE_TOLERANCE)[
                self.double
            ]
            point = TestPoint({n: x if self.double else _single(x) for n, x in values.items()})
            point = replace(point, values={**self.point(1, 0.0).values, **point.values})
            case = self.case(point, partial(self.value, name), allowed, sharp=True)
            self.has_large |= case is not None
            cases.append(case)
        return cases

    @cached_property
    def large_states(self) -> list[dict[str, float]]:
        """States with large angles, each as values by name, that are suitable for tests.

        At these states, bias and accelerations computed in doubles agree with the exact results.
        """
        return [x for x in _large(self.target) if self.is_sharp(x)]

    def is_sharp(self, x: Mapping[str, float]) -> bool:
        """Return True if bias and accelerations computed in doubles agree with those of 40 digits.

        x: state, time and parameters, as values by name.
        """
        known = self.complete(
            TestPoint({n: v if self.double else _single(v) for n, v in x.items()})
        )
        room, usual = (64 if self.double else 4 * 2**29), ACCELERATION_TOLERANCE[self.double]
        for name, limit in (("bias", LARGE_ANGLE_TOLERANCE[self.double]), ("acceleration", usual)):
            try:
                results = self.evaluate(name, known)
                exact, _ = evaluator(self.program[name], exact=True)(known)
            except (NoCaseError, ArithmeticError, ValueError):
                return False
            if room * _off(results, exact) > limit:
                return False
        return True

    # steps, runs, events

    def test_motions(self) -> Iterator[TestFunction]:
        """Yield the tests of steps, derivatives, runs, projections, adaptive runs and events."""
        run = self.system.run
        if self.system.constraints:
            f = self.public.project
            call = self.call(f, q="out", qd="out + NQ", fixed="NULL")
            cases = [
                self.case(p, self.projection, ITERATION_TOLERANCE[self.double])
                for p in self.start_points
            ]
            yield self.test_function("project", "moved", call, cases)
        short = self.is_short
        for name in run.methods:
            m = METHODS[name]
            method = self.public.method_enum(name) if self.public.method_type else ""
            if m.implicit and not short:
                continue
            starts = self.start_points if short else self.start_points[:1]
            points = [p for x in starts if (p := self.with_span(m, x))]
            allowed = ITERATION_TOLERANCE[self.double] if self.system.constraints else 0.0
            allowed = IMPLICIT_TOLERANCE[self.double] if m.implicit else allowed
            call = self.call(self.public.step(name), q="out", qd="out + NQ")
            cases = [self.case(p, partial(self.after_steps, m, 1), allowed) for p in points]
            yield self.test_function(f"{name}_step", "moved", call, cases)
            allowed = SWEEP_TOLERANCE[self.double] if m.sweeps else allowed
            # steps of the scene's own size, for which optimised C may use other code
            own = [
                replace(p, span=self.round_short(self.system.run.h)) for p in points[:1] if short
            ]
            more = [*points, *own]
            cases = [self.case(p, partial(self.rows, m), allowed) for p in more]
            yield self.test_function(f"{name}_run", "run", self.run_call(), cases, method)
            if run.batch:
                cases = [self.case(p, partial(self.twice, m), allowed) for p in more]
                call = self.batch_call()
                yield self.test_function(f"{name}_batch", "batch", call, cases, method)
            if run.discretize:
                cases = [self.derivative(m, p) for p in points]
                call = self.call(self.public.derivative(name), Phi="Phi", Gamma="Gamma", E="E")
                yield self.test_function(f"{name}_derivative", "derivative", call, cases)
        if self.target.integrates and short:
            yield from self.adaptive_runs()

    @cached_property
    def is_short(self) -> bool:
        """Whether the accelerations are cheap enough for many evaluations in Python."""
        return weight(self.program["acceleration"]) <= MAX_OPERATIONS

    @cached_property
    def start_points(self) -> tuple[TestPoint, ...]:
        """Points near the initial state at which tested steps begin.

        With constraints, the only point is the initial state itself, which satisfies them.
        """
        if not self.system.constraints:
            return tuple(replace(p, span=1.0) for p in self.near_points if not p.other)
        point = self.point(0, START_TIME)
        point = replace(point, values={**point.values, **nearby(self.system, 0), TIME: START_TIME})
        return (replace(point, span=1.0),)

    def with_span(self, m: Method, point: TestPoint) -> TestPoint | None:
        """Return a copy of the point with a step size for the integration method m as its `span`.

        It is the largest of some step sizes with which a few steps can be tested accurately and the
        state does not grow much. Returns None if no step size is suitable.
        """
        h = self.system.run.h
        most = 1 if m.sweeps else 2 if m.implicit else 4
        for factor in (4.0**k for k in range(most, -5, -1)):
            tried = replace(point, span=self.round_short(factor * h))
            if self.case(
                tried, partial(self.after_steps, m, RUN_STEPS), ITERATION_TOLERANCE[self.double]
            ):
                end, start = self.after_steps(m, RUN_STEPS, tried), self.state_of(tried)
                if max(map(abs, end)) <= MAX_GROWTH * max(1.0, *map(abs, start)):
                    return tried
        return None

    def after_steps(self, m: Method, steps: int, point: TestPoint) -> Vector:
        """Return, in one list, the state [q; qd] after each of several steps of method m.

        The first step begins at `point`. There are `steps` steps of size `point.span` (s).
        """
        x, result, t, h = self.state_of(point), Vector(), point.values[TIME], point.span
        for n in range(steps):
            x = self.step(m, point, x, t + n * h, h)
            result += x
        return result

    def rows(self, m: Method, point: TestPoint) -> Vector:
        """Return the results of a run of three steps of method m from a point, as C stores them.

        These are the last state [q; qd], then q before the first and after each step, then qd.
        """
        n, result = self.nq, [*self.state_of(point), *self.after_steps(m, RUN_STEPS, point)]
        states = [result[k : k + 2 * n] for k in range(0, len(result), 2 * n)]
        q, qd = ([v for x in states for v in x[part]] for part in (slice(n), slice(n, 2 * n)))
        return [*states[-1], *q, *qd]

    def twice(self, m: Method, point: TestPoint) -> Vector:
        """Return the final states of a batch of two instances of the system, by method m.

        Both instances start at `point`. The order is that of C: q of both instances, then qd of
        both.
        """
        end = self.after_steps(m, RUN_STEPS, point)[-2 * self.nq :]
        return [*end[: self.nq] * 2, *end[self.nq :] * 2]

    def projection(self, point: TestPoint) -> Vector:
        """Return the state [q; qd] of a point, projected onto the constraints."""
        return self.project(point, self.state_of(point), point.values[TIME])

    def run_call(self) -> str:
        """Return the C call of a run."""
        f = self.public.integrate
        return self.call(f, q="out", qd="out + NQ", options="&options", output="&output")

    def batch_call(self) -> str:
        """Return the C call that steps a batch of two instances with equal initial states."""
        f = self.public.integrate_batch
        return self.call(
            f, count="2", q="out", qd="out + 2*NQ", options="&options", output="output"
        )

    def derivative(self, m: Method, point: TestPoint) -> TestCase | None:
        """Return the test case for the derivative of a step of method m along a direction.

        The step begins at `point`. The direction is constant: it has the components 1, 2, 3, 1, 2,
        ... in q, qd and the specified inputs. The expected derivative is a central difference.
        Returns None if it is not accurate enough.
        """
        names = [*self.state_names, *self.input_names(point)]

        def difference(x: TestPoint, width: float) -> Vector:
            derivative = [0.0] * (2 * self.nq)
            for k, w in STENCIL:
                for sign in (-1, 1):
                    moved = {n: x.values[n] + sign * k * width * (1 + i % 3)
                             for i, n in enumerate(names)}  # fmt: skip
                    end = self.after_steps(m, 1, replace(x, values={**x.values, **moved}))
                    part = sign * w / width
                    derivative = [d + part * e for d, e in zip(derivative, end, strict=True)]
            return derivative

        try:
            wide, close = difference(point, 0.01), difference(point, 0.0025)
        except NoCaseError:
            return None
        allowed = 10 * _off(wide, close) + ITERATION_TOLERANCE[self.double]
        if not allowed < MAX_TOLERANCE[self.double]:
            return None
        return self.case(point, lambda _: close, allowed)

    # adaptive runs and events

    def adaptive_runs(self) -> Iterator[TestFunction]:
        """Yield a single test, which covers adaptive runs.

        Its cases are runs without events, and runs in which an event function crosses zero, for
        each event in both directions. With constraints or friction modes, there are only the runs
        without events.
        """
        cases = [self.run_without_event(p) for p in self.start_points]
        if not (self.system.constraints or self.system.modes):
            for k in range(len(self.system.own_events)):
                cases += self.crossings(k)
        yield self.test_function("adaptive", "adaptive", self.run_call(), cases)

    def spans(self) -> tuple[float, ...]:
        """Return the lengths (s) of adaptive runs to try, from the longest to the shortest."""
        return tuple(self.round_short(f * self.system.run.h) for f in (128.0, 32.0, 8.0, 2.0, 0.5))

    def run_without_event(self, point: TestPoint) -> TestCase | None:
        """Return the case of an adaptive run that starts at a point and in which no event occurs.

        The longest suitable run is used. Returns None if no run is suitable.
        """
        for span in self.spans():
            tried = replace(point, span=span)
            try:
                x, t = self.state_of(tried), tried.values[TIME]
                self.refuse_events(tried, x, t, span)
            except NoCaseError:
                continue
            case = self.case(tried, partial(self.adaptive_results, None), self.of_runs)
            if case:
                return case
        return None

    @property
    def of_runs(self) -> float:
        """The error limit of test cases for adaptive runs, relative to the largest result."""
        return 1e-8 if self.double else 2e-3

    def adaptive_results(self, event: TriggeredEvent | None, point: TestPoint) -> Vector:
        """Return the results of an adaptive run from a point, as C stores them.

        These are the final [q; qd] and time. If the scene has events, the number of events follows,
        and then the number (from 1), time and state of the first event. event: time and index of
        the event in this run; None for none.
        """
        x, t, span = self.state_of(point), point.values[TIME], point.span
        none = [0.0] * (3 + 2 * self.nq) if self.system.events else []
        if event is None:
            return [*self.integrate_accurately(point, x, t, span), t + span, *none]
        at, first = event
        x = self.integrate_accurately(point, x, t, at - t)
        numbers = [1.0, first + 1.0, at, *x]
        e = self.system.own_events[first]
        if e.action == "stop":
            return [*x, at, *numbers]
        if e.action == "jump":
            after = self.value("jumps", self.at_state(point, x, at))
            x = after[2 * self.nq * first : 2 * self.nq * (first + 1)]
        return [*self.integrate_accurately(point, x, at, t + span - at), t + span, *numbers]

    def integrate_accurately(self, point: TestPoint, x: Vector, t: float, span: float) -> Vector:
        """Return the state at time t + span (s), by integration from the state x at time t.

        Raises NoCaseError if integration with shorter steps gives a different result.
        """
        result, finer = (self.integrate(point, x, t, span, n) for n in (4, 6))
        if _off(result, finer) > self.of_runs / 10:
            raise NoCaseError
        return finer

    def events(self, point: TestPoint, x: Vector, t: float) -> Vector:
        """Return the values of the event functions at the state x = [q; qd] and time t (s).

        `point` supplies the inputs and the parameters.
        """
        return self.value("events", self.at_state(point, x, t))

    def refuse_events(self, point: TestPoint, x: Vector, t: float, span: float) -> None:
        """Raise NoCaseError if an event function changes sign, or nearly does, in a run.

        The run begins in the state x = [q; qd] at time t (s) and has the length `span` (s). `point`
        supplies the inputs and the parameters.
        """
        first = self.events(point, x, t) if self.system.events else []
        for k in range(8) if first else ():
            x = self.integrate(point, x, t + span * k / 8, span / 8, 1)
            events = self.events(point, x, t + span * (k + 1) / 8)
            for a, b in zip(first, events, strict=True):
                if a * b <= 0 or abs(b) < 0.02 * abs(a):
                    raise NoCaseError

    def crossings(self, k: int) -> list[TestCase | None]:
        """Return test cases of runs in which the event function k crosses zero.

        There is at most one case in which the function rises, and one in which it falls.
        """
        cases: dict[bool, TestCase] = {}
        for point in self.candidates(k):
            for span in self.spans():
                try:
                    rising, case = self.crossing(k, point, span)
                except NoCaseError:
                    continue
                if case is not None:
                    cases.setdefault(rising, case)
                    break
            if len(cases) == 2:
                break
        return [*cases.values()]

    def candidates(self, k: int) -> Iterator[TestPoint]:
        """Yield points near the initial state at which the event function k is zero.

        Each is found by changing the time, one coordinate or one velocity.
        """
        for number in range(1, 5):
            for back in (1, -1):
                point = self.point(number, 1.0)
                moved = {x.name: back * point.values[x.name] for x in self.system.qd}
                point = replace(point, values={**point.values, **moved})
                for name in (TIME, *self.state_names):
                    try:
                        yield self.solve_event(k, point, name)
                    except NoCaseError:
                        continue

    def solve_event(self, k: int, point: TestPoint, name: str) -> TestPoint:
        """Return a copy of the point at which the event function k is zero.

        The value of `name` (the time, a coordinate or a velocity) is changed by the secant method.
        Raises NoCaseError if the iteration does not converge or the value becomes too large.
        """

        def g(x: float) -> float:
            return self.value("events", replace(point, values={**point.values, name: x}))[k]

        a, b = point.values[name], point.values[name] + 0.05
        at_a, at_b = g(a), g(b)
        for _ in range(40):
            if at_b == at_a:
                raise NoCaseError
            a, b, at_a = b, b - at_b * (b - a) / (at_b - at_a), at_b
            at_b = g(b)
            if abs(b - a) <= 1e-14 * max(abs(b), 1e-3):
                break
        else:
            raise NoCaseError
        if abs(b) > 20 or (name == TIME and b <= START_TIME):
            raise NoCaseError
        return replace(point, values={**point.values, name: b})

    def crossing(self, k: int, on: TestPoint, span: float) -> tuple[bool, TestCase | None]:
        """Return whether event function k rises at its zero, and a test case of a run across it.

        on: a point at which the function is zero. The run starts half a `span` (s) before this
        point. Raises NoCaseError if other events occur in the run.
        """
        x, t, half = self.state_of(on), on.values[TIME], span / 2
        others = [i for i in range(len(self.system.events)) if i != k]
        begin = self.integrate(on, x, t, -half)
        sides = []
        for part in (-1.0, -0.5, 0.5, 1.0):
            values = self.events(on, self.integrate(on, x, t, part * half), t + part * half)
            sides.append([v > 0 for v in values])
        if any(len({s[i] for s in sides}) > 1 for i in others):
            raise NoCaseError
        rising = sides[3][k]
        if [s[k] for s in sides] != [not rising, not rising, rising, rising]:
            raise NoCaseError
        e = self.system.own_events[k]
        is_detected = e.direction in ("both", "rising" if rising else "falling")
        start = self.at_state(
            on, [self.round_short(v) if not self.double else v for v in begin], t - half
        )
        start = replace(start, span=span)
        if is_detected and e.action == "jump":
            after = self.value("jumps", on)[2 * self.nq * k : 2 * self.nq * (k + 1)]
            near = self.integrate(on, after, t, half / 8, 1)
            self.refuse_events(on, near, t + half / 8, half * 7 / 8)
        event = (t, k) if is_detected else None
        return rising, self.case(start, partial(self.adaptive_results, event), self.of_runs)


@cache
def _tableau(
    name: str,
) -> tuple[list[list[tuple[int, float]]], list[list[tuple[int, float]]], list[Vector]]:
    """Return A and A^2 of a method as lists of (column, entry) by rows, and c, b and b A."""
    m = METHODS[name]
    A, AA = (
        [[(j, float(x)) for j, x in enumerate(row) if x] for row in matrix]
        for matrix in (m.a, m.a_squared)
    )
    return A, AA, [[float(x) for x in row] for row in (m.c, m.b, m.b_a)]


def _single(x: float) -> float:
    return float(struct.unpack("f", struct.pack("f", x))[0])


def _off(values: list[float], exact: list[float]) -> float:
    """Return the largest difference, relative to the largest entry."""
    worst = max(abs(a - b) for a, b in zip(values, exact, strict=True))
    return worst / max(map(abs, exact)) if worst else 0.0


def _large(target: Target) -> Iterator[dict[str, float]]:
    """States in which every angle of coordinates alone is large, up to the limit of sincos.h."""
    program, limit = target.program, ANGLE_LIMIT[target.real is DOUBLE]
    coordinates = {c.name: i for i, c in enumerate(program.system.coordinates)}
    groups = chain.from_iterable(
        separate_angles(program[name], coordinates)[0] for name in ("bias", "acceleration")
    )
    angles = [
        a
        for a in groups
        if a.offset == 0 and all((ANGLES_PER_RADIAN * c).is_integer for c, _ in a.terms)
    ]
    if not angles:
        return
    most = limit / max(float(sum(abs(c) for c, _ in a.terms)) for a in angles)
    turning = {name for a in angles for _, name in a.terms}
    for k, part in enumerate((0.97, -0.99, 0.4, -0.7, 0.1, -0.05)):
        x = nearby(program.system, k + 1)
        for name in turning:
            inward = -1.3 if part > 0 else 1.3
            some = (part * most + inward * (coordinates[name] + k + j) for j in range(12))
            on_grid = (round(ANGLES_PER_RADIAN * angle) / ANGLES_PER_RADIAN for angle in some)
            x[name] = max(on_grid, key=lambda angle: _rounding_error(angle, target.real is DOUBLE))
        # faster than nearby, so that gravity does not cover what the angles bring
        yield x | {v.name: 8 * x[v.name] for v in program.system.qd}


def _rounding_error(angle: float, double: bool) -> float:
    """Return the rounding error of n pi/2, the multiple nearest to an angle."""
    n, rounded = round(angle / (math.pi / 2)), (lambda x: x) if double else _single
    half_pi = rounded(math.pi / 2)
    return float(abs(Fraction(rounded(n * half_pi)) - n * Fraction(half_pi)))
