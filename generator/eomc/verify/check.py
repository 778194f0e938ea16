"""A compiled module held against the reference, and against what mechanics says of any scene.

Two kinds of row. A value of the module is compared with the independent `reference`, in units of
rounding. A property (symmetry, order of convergence, power balance) is tested on the module
alone, whatever the reference says.

A unit of rounding is eps times the size of what was added up on the way. That size is not
the result, which may cancel to nothing: it is |f| + sum_i |x_i df/dx_i|, what one rounding of
each of the inputs x does to f, and beside it the size that the laws of motion give to the sums
that f is made of: sqrt(D_ii D_jj) for D_ij, D qd times a rate for forces, K and P for energies.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import sympy

from eomc.integrators.tableaux import METHODS
from eomc.model.system import System
from eomc.verify import derivatives, one_step
from eomc.verify.convergence import ORDER_MARGIN, PARTS, SEEN, Convergence, Finding, Place, largest
from eomc.verify.oracle import Answer, Vector
from eomc.verify.rows_bodies import Bodies
from eomc.verify.rows_compiled import compiled_rows
from eomc.verify.symbolic import of
from eomc.verify.taylor import Jets

EPS = 2.0**-52

# Correct builds differ by less than one unit in a value, by some tens in a stiff run. A wrong
# sign makes 1e15, and still 1e5 in a term that is a ten thousand millionth of the whole.
LIMIT = 1e3
SLOPE_LIMIT = 1e-6  # of the largest derivative, by differences
SKEW_LIMIT = 1e-6  # of D's rate of change, by differences good to 1e-10; a wrong sign makes 1
CONDITION_LIMIT = 1e8  # of D with its diagonal scaled to 1: beyond, a state says little

NUDGE = 1e-6  # relative change of an input from which its influence is estimated
MOST_NUDGES = 32  # inputs that are changed one by one; beyond, all at once
NOISE = 1e-12  # of a unit: what moves less has been moved by rounding
DRAWS = 8  # how often: the influence is known to a quarter of itself
FARTHEST = 100.0  # of the spread: how far long steps may lead
GROWTH_LIMIT = 1e4  # a run is compared as far as it magnifies a difference by no more
SHORTER = tuple(
    4.0**-k for k in range(7)
)  # parts of the scene's h, until stages are found by sweeps


@dataclass(frozen=True)
class _Effort:
    """How much is compared with the reference, as far as an answer of it costs time.

    states: at how many; ahead: steps taken to see how far things go, each `stride` times the
    scene's h; few: how many states for one step; run: steps of a run.
    """

    states: int
    ahead: int
    stride: int
    few: int
    run: int


SMALL = _Effort(states=16, ahead=50, stride=1, few=4, run=100)
LARGE = _Effort(states=6, ahead=5, stride=10, few=4, run=4)  # a tenth of a second an answer

# the module's name for a value, and the reference's
VALUES = {
    "D": "D",
    "C": "C",
    "g": "g",
    "bias": "bias",
    "tau": "tau",
    "kinetic_energy": "kinetic",
    "potential_energy": "potential",
    "energy": "energy",
    "jacobi": "jacobi",
    "power": "power",
}


@dataclass(frozen=True)
class Row:
    """One thing that was tested: how far it was off, in what unit, and how far it may be.

    Where nothing could be judged, `judged` is false and `unit` says why; such a row counts as
    passed.
    """

    name: str
    error: float
    limit: float
    passed: bool
    unit: str
    judged: bool = True


@dataclass(frozen=True)
class Report:
    """The outcome of `check`. `states` were used, `rejected` ones had no regular D.

    reference: what they were compared with: "equations written out" or "Taylor arithmetic".
    """

    scene: str
    rows: tuple[Row, ...]
    states: int
    rejected: int
    reference: str

    @property
    def passed(self) -> bool:
        """Whether every row has passed."""
        return all(row.passed for row in self.rows)

    def table(self) -> str:
        """The rows as text, for a terminal."""
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
        for row in self.rows:
            mark = ("ok" if row.judged else "?") if row.passed else "FAILED"
            table.add_row(mark, row.name, f"{row.error:.3g}", f"{row.limit:g}", row.unit)
        text = io.StringIO()
        Console(file=text, width=100).print(table)
        return "\n".join(line.rstrip() for line in text.getvalue().splitlines()).strip("\n")

    def as_dict(self) -> dict[str, Any]:
        """For JSON; numbers that are not finite are None."""
        rows = [asdict(row) for row in self.rows]
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


def check(
    system: System, module: Any, *, plain: Any = None, seed: int = 0, states: int | None = None
) -> Report:
    """Test the compiled `module` of `system` at random states and parameters.

    plain: the same compiled from plain C, which is compared with the reference and with `module`.
    states: how many, by default as many as take seconds. Always the same states for the same
    seed. A module that raises fails the row, which shows its words. Raises EomcError where
    `reference.of` does.
    """
    from eomc.verify import rows_plain

    made = Comparison(system, module, np.random.default_rng(seed), states)
    report = made.report()
    if plain is None or not made.expected:
        return report
    rows_plain.rows(made, plain)
    return replace(report, rows=tuple(made.rows))


# --- states ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class State:
    """Where to evaluate: q, qd (nq,), t in s, u (nu,) or None for the signals, params or None."""

    q: Vector
    qd: Vector
    t: float = 0.0
    u: Vector | None = None
    params: Mapping[str, float] | None = None


def ask(module: Any, name: str, s: State) -> Vector:
    """The module's value of that name."""
    place = (s.q,) if name in ("D", "g", "potential_energy") else (s.q, s.qd)
    inputs = {"u": s.u} if name in ("tau", "power", "acceleration") else {}
    return np.asarray(getattr(module, name)(*place, t=s.t, params=s.params, **inputs), float)


def nudged(s: State, defaults: Mapping[str, float]) -> list[State]:
    """The state with one input after the other changed by a small part of itself."""
    found = []
    for field in ("q", "qd", "u"):
        values = getattr(s, field)
        for i in np.flatnonzero(values) if values is not None else ():
            changed = values.copy()
            changed[i] *= 1 + NUDGE
            found.append(replace(s, **{field: changed}))
    if s.t:
        found.append(replace(s, t=s.t * (1 + NUDGE)))
    params = s.params or defaults
    for name, value in params.items():
        found.append(replace(s, params={**params, name: value * (1 + NUDGE)}))
    return found


def _shaken(s: State, defaults: Mapping[str, float], random: np.random.Generator) -> State:
    """The state with all inputs changed at random by small parts of themselves."""

    def shake(x: Any) -> Any:
        return x * (1 + NUDGE * random.standard_normal(np.shape(x)))

    params = {name: float(shake(value)) for name, value in (s.params or defaults).items()}
    u = None if s.u is None else shake(s.u)
    return State(shake(s.q), shake(s.qd), float(shake(s.t)), u, params)


def _stacked(states: Sequence[State], defaults: Mapping[str, float]) -> dict[str, Any]:
    """States, all with inputs from outside or none, as arguments with a row each."""
    params = [s.params or defaults for s in states]
    return {
        "q": np.array([s.q for s in states]),
        "qd": np.array([s.qd for s in states]),
        "t": np.array([s.t for s in states]),
        "u": None if states[0].u is None else np.array([s.u for s in states]),
        "params": {name: np.array([p[name] for p in params]) for name in defaults},
    }


@dataclass(frozen=True)
class Expected:
    """The reference's values at a state, and the sizes that errors are measured against."""

    state: State
    value: Mapping[str, Vector]
    size: Mapping[str, Vector]


class _Sampler:
    """Draws states around the start that are finite and have a regular D."""

    def __init__(self, reference: Answer, random: np.random.Generator, effort: _Effort) -> None:
        self.reference, self.random = reference, random
        self.system = system = reference.system
        self.defaults = {p.name: p.value for p in system.parameters}
        self.rejected = 0
        start = self.start = State(*np.array([(c.start, c.rate) for c in system.coordinates]).T)
        # how far things go: from the start, from what happens next, else 1 of the unit
        with np.errstate(all="ignore"):
            try:
                h = effort.stride * system.run.h
                _, q, qd = reference.simulate(h=h, steps=effort.ahead)
            except np.linalg.LinAlgError:
                q, qd = start.q[None], start.qd[None]
        far, fast = (np.nan_to_num(np.max(np.abs(x), axis=0), posinf=0) for x in (q, qd))
        self.angles = np.array([c.unit == "rad" for c in system.coordinates])
        self.spread = np.where(self.angles, np.pi, np.where(far > NOISE, far, 1.0))
        self.speed = np.maximum(fast, 10 * self.spread / system.run.duration)

    def states(self, count: int) -> list[Expected]:
        """The start, some states with the parameters' defaults, then all at random."""
        found: list[Expected] = []
        nearness = 1.0  # every rejection moves the next draw closer to the start
        for attempt in range(20 * count):
            if len(found) == count:
                break
            usual = len(found) < count // 4
            state = self.start if attempt == 0 else self.draw(nearness, usual, len(found) % 2 == 1)
            with np.errstate(all="ignore"):
                expected = self.expected(state) if self.regular(state) else None
            if expected is None:
                self.rejected += 1
                nearness *= 0.7
            else:
                found.append(expected)
                nearness = 1.0
        return found

    def draw(self, nearness: float, usual: bool, given: bool) -> State:
        """A random state; `usual`: default parameters; `given`: inputs from outside."""
        random, n, start = self.random, len(self.start.q), self.start
        centre = np.where(self.angles, nearness < 1, 1) * start.q
        q = centre + nearness * self.spread * random.uniform(-1, 1, n)
        qd = start.qd + nearness * self.speed * random.uniform(-1, 1, n)
        t = random.uniform(0, self.system.run.duration)
        u = None
        if given and self.system.inputs:
            signals = np.abs(self.reference.evaluate("signals", q, qd, t))
            u = random.normal(size=len(signals)) * np.where(signals > 0, signals, 1)
        # a parameter that is 0 by default, such as a friction, is tried too
        factors = np.exp(random.uniform(-0.5, 0.5, len(self.defaults)))
        params = {
            name: value * factor if value else factor - 0.5
            for (name, value), factor in zip(self.defaults.items(), factors.tolist(), strict=True)
        }
        return State(q, qd, t, u, None if usual else params)

    def regular(self, s: State) -> bool:
        """D finite and far from singular, and positive definite where we chose the parameters."""
        D = self.reference.evaluate("D", s.q, s.qd, s.t, s.u, s.params)
        diagonal = np.abs(np.diag(D))
        if not (np.all(np.isfinite(D)) and np.all(diagonal > 0)):
            return False
        eigenvalues = np.linalg.eigvalsh(D / np.sqrt(np.outer(diagonal, diagonal)))
        least, most = np.min(np.abs(eigenvalues)), np.max(np.abs(eigenvalues))
        return bool(least * CONDITION_LIMIT > most and (s.params is None or eigenvalues[0] > 0))

    def expected(self, s: State) -> Expected | None:
        """The reference's values and their sizes; None where something is not finite."""
        value: dict[str, Vector] = {}
        reach: dict[str, Vector] = {}
        for name, field in VALUES.items():
            value[name], reach[name] = self.reach(partial(self.reference.evaluate, field), s)
        D, qd = value["D"], np.abs(s.qd)
        qdd = np.asarray(np.linalg.solve(D, value["tau"] - value["bias"]), float)
        value["acceleration"] = qdd
        if not all(np.all(np.isfinite(x)) for x in value.values()):
            return None
        diagonal = np.sqrt(np.diag(reach["D"]))
        inertia = np.outer(diagonal, diagonal) + reach["D"]
        rate = np.max(qd / self.spread)  # of change of D, in 1/s
        force = reach["bias"] + reach["g"] + reach["tau"] + rate * inertia @ qd
        # a force that is zero along one coordinate may be the sum of what others have whole
        force = np.maximum(force, diagonal * np.max(force / diagonal))
        energy = reach["kinetic_energy"] + reach["potential_energy"]
        size = {
            "D": inertia,
            "C": reach["C"] + rate * inertia,
            **dict.fromkeys(("g", "bias", "tau"), force),
            **dict.fromkeys(("kinetic_energy", "potential_energy", "energy", "jacobi"), energy),
            "power": reach["power"] + force @ qd,
            "motion": inertia @ np.abs(qdd) + force,
        }
        size["acceleration"] = np.abs(np.linalg.inv(D)) @ size["motion"]
        return Expected(s, value, size)

    def energy(self, s: State) -> tuple[Vector, Vector]:
        """K + P and its size."""
        names = ("kinetic", "potential")
        K, P = (self.reach(partial(self.reference.evaluate, name), s)[1] for name in names)
        return self.reference.evaluate("energy", s.q, s.qd, s.t, s.u, s.params), K + P

    def reach(self, of: Callable[..., Any], s: State) -> tuple[Vector, Vector]:
        """f and |f| + sum_i |x_i df/dx_i|; of: f of states as rows.

        Where there are many inputs the sum is the root of that of the squares, from DRAWS changes
        of all at once: no larger, and smaller by the root of their number at most.
        """
        near = nudged(s, self.defaults)
        many = len(near) > MOST_NUDGES
        if many:
            near = [_shaken(s, self.defaults, self.random) for _ in range(DRAWS)]
        found = np.asarray(of(**_stacked([s, *near], self.defaults)))
        value, off = found[0], np.nan_to_num(np.abs(found[1:] - found[0]) / NUDGE)
        spread = np.sqrt(np.mean(off**2, axis=0)) if many else np.sum(off, axis=0)
        return value, np.abs(value) + spread


def _units(found: Any, expected: Any, size: Any, eps: float = EPS) -> float:
    """The largest difference in units of rounding, nan where something is not a number."""
    off = np.abs(np.asarray(found, float) - expected)
    if off.shape != np.shape(expected):
        raise ValueError(f"shape {np.shape(found)} where {np.shape(expected)} is meant")
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.max(np.where(off == 0, 0, off / (eps * np.asarray(size))), initial=0))


def _rows(run: Any, s: State) -> list[State]:
    """The states that a run from `s` went through."""
    rows = zip(run.t, run.q, run.qd, strict=True)
    return [replace(s, q=np.array(q), qd=np.array(qd), t=float(t)) for t, q, qd in rows]


# --- rows -----------------------------------------------------------------------------------------


class Comparison:
    """All rows of one report."""

    def __init__(
        self, system: System, module: Any, random: np.random.Generator, states: int | None
    ) -> None:
        self.system, self.module = system, module
        self.dtype = np.dtype(getattr(module, "dtype", "float64"))
        self.eps = float(np.finfo(self.dtype).eps)
        self.methods: tuple[str, ...] = getattr(module, "methods", ("rk4",))
        self.reference = of(system)
        self.large = isinstance(self.reference, Jets)
        self.effort = LARGE if self.large else SMALL
        self.sampler = _Sampler(self.reference, random, self.effort)
        self.expected = self.sampler.states(self.effort.states if states is None else states)
        self.rows: list[Row] = []

    def report(self) -> Report:
        """Compare, then test the properties."""
        rounding = "units of rounding"
        self.row("names, defaults, start", 0, "that differ", self.faces)
        if self.expected:
            for name in (*VALUES, "acceleration"):
                self.row(name, LIMIT, rounding, partial(self.value, name))
            if self.methods[0] == "rk4":  # which is what the reference steps by
                self.row("one step", LIMIT, rounding, self.steps)
                self.row("run", LIMIT, rounding + ", times steps and growth", self.runs)
            for method in self.methods[self.methods[0] == "rk4" :]:
                self.row(f"one step of {method}", LIMIT, rounding, partial(self.step_by, method))
            self.row("run: its energy", LIMIT, rounding, self.run_energy)
            self.row("D = D^T", LIMIT, rounding, self.symmetry)
            self.row("D > 0", 0, "least eigenvalue of D, scaled", self.definiteness, least=True)
            self.row("bias = C qd + g", LIMIT, rounding, self.bias)
            self.row("D qdd + bias = tau", LIMIT, rounding, self.motion)
            if self.dtype == np.float64:  # single precision leaves differences too few digits
                self.row("Ddot - 2C + dD/dt skew", SKEW_LIMIT, "of D's rate", self.skewness)
                for name in ("linearize", "sensitivity"):
                    if self.has(name):
                        unit = "of the largest derivative"
                        find = partial(self.slopes, name)
                        self.row(name, SLOPE_LIMIT, unit, find)
                self.convergence_rows()
            if hasattr(self.module, "_model"):  # what is compiled has several ways to one answer
                compiled_rows(self)
            scene = self.system.scene
            if scene is not None and scene.assembly is not None:
                Bodies(self, scene).report()
        else:
            self.row("states", 1, "states with a regular D", lambda: 0.0, least=True)
        kind = "Taylor arithmetic" if self.large else "equations written out"
        counts = len(self.expected), self.sampler.rejected
        return Report(self.system.name, tuple(self.rows), *counts, kind)

    def convergence_rows(self) -> None:
        """Orders, advised steps, the balance of power: see `convergence`."""
        runs, methods = self.convergence, self.methods
        for method in methods:
            least = min(METHODS[method].order, SEEN) - ORDER_MARGIN
            find = partial(runs.order, method)
            self.smooth_row(f"order of {method}", least, "order observed", find)
        for method in methods[1:]:
            unit = "of the two methods' own errors"
            self.row(f"{method} beside {methods[0]}", 2, unit, partial(runs.beside, method))
        unit = "order at which it closes"
        self.smooth_row("power balance", runs.closing_limit, unit, runs.closing)
        for method in methods:
            if math.isfinite(min(METHODS[method].limits)):
                self.advice_row(method)

    def row(
        self, name: str, limit: float, unit: str, measure: Callable[[], float | Finding],
        least: bool = False,
    ) -> None:  # fmt: skip
        """Add what `measure` finds: at most the limit, or more than it where it is the least."""
        try:
            found = measure()
        except Exception as fault:  # whatever the module raises is an outcome of the check
            self.rows.append(Row(name, math.nan, limit, False, f"{type(fault).__name__}: {fault}"))
            return
        error, why = (found.value, found.why) if isinstance(found, Finding) else (found, "")
        if isinstance(found, Finding) and found.unit:
            passed = error <= found.limit
            self.rows.append(Row(name, error, found.limit, passed, found.unit))
            return
        if why:
            idle = math.isinf(error)
            unit = ("no limit to test: " if idle else "not judged: ") + why
            self.rows.append(Row(name, error, limit, True, unit, judged=idle))
            return
        self.rows.append(Row(name, error, limit, error > limit if least else error <= limit, unit))

    def smooth_row(
        self, name: str, limit: float, unit: str, measure: Callable[[], Finding]
    ) -> None:
        """A row about orders, which is not judged where the scene's functions have corners."""
        self.row(name, limit, unit, measure, least=True)
        row = self.rows[-1]
        if math.isinf(row.error):
            self.rows[-1] = replace(row, unit=unit + ": exact, no error to measure")
        elif not row.passed and self.corners and not math.isnan(row.error):
            note = f"not judged: {unit} not to be expected with {self.corners}"
            self.rows[-1] = replace(row, passed=True, unit=note, judged=False)

    def advice_row(self, method: str) -> None:
        """At which part of the advised h a run is lost: not at an eighth of it, but at twice it."""
        unit = "of the advised h, where runs are lost"
        find = partial(self.convergence.advised, method)
        self.row(f"h of {method}", PARTS[0], unit, find, least=True)
        row = self.rows[-1]
        if not row.passed and self.corners:
            note = f"not judged: no matter with {self.corners}"
            self.rows[-1] = replace(row, passed=True, unit=note, judged=False)

    @cached_property
    def convergence(self) -> Convergence:
        """The rows that come from runs of several step sizes."""
        own = [e for e in self.expected if e.state.params is None]
        usual = own[1:4] or self.expected[:3]  # the scene's own parameters, away from its start
        return Convergence(
            self.module,
            self.methods,
            [Place(e.state, float(e.size["jacobi"])) for e in usual],
            self.expected[0].state,
            np.array([self.sampler.spread, self.sampler.speed]),
            self.system.run.h,
            self.system.run.duration,
        )

    @cached_property
    def corners(self) -> str:
        """The functions in the scene that jump or bend."""
        s = self.system
        exprs = (
            *(s.kinetic, s.potential, s.dissipation, *s.forces),
            *(e for _, e in s.definitions),
            *(i.signal for i in s.inputs),
        )
        kinds = (sympy.sign, sympy.Heaviside, sympy.Abs, sympy.Min, sympy.Max)
        found = {atom.func.__name__.lower() for e in exprs for atom in e.atoms(*kinds)}
        return ", ".join(sorted(found))

    def largest(self, of: Callable[[Expected], float]) -> float:
        """The largest error over all states; nan wins."""
        return float(np.max([of(e) for e in self.expected]))

    # against the reference

    def faces(self) -> float:
        """How many of the module's names, defaults and start values are not the system's."""
        s, m, start = self.system, self.module, self.sampler.start
        pairs = [
            (tuple(m.coordinates), tuple(c.name for c in s.coordinates)),
            (tuple(m.parameters), tuple(p.name for p in s.parameters)),
            (tuple(m.inputs), tuple(i.name for i in s.inputs)),
            (dict(m.defaults), self.sampler.defaults),
            *(
                (np.asarray(a).tolist(), b.astype(self.dtype).tolist())
                for a, b in zip(m.start, (start.q, start.qd), strict=True)
            ),
        ]
        return float(sum(theirs != ours for theirs, ours in pairs))

    def value(self, name: str) -> float:
        """One of VALUES or the acceleration."""
        return self.largest(
            lambda e: self.units(ask(self.module, name, e.state), e.value[name], e.size[name])
        )

    def steps(self) -> float | Finding:
        """One step of the scene's h from a few states."""
        h = self.system.run.h

        def reference(**rows: Any) -> Vector:
            return np.stack(self.reference.step(h=h, **rows), axis=1)

        def error(e: Expected) -> float | None:
            s = e.state
            with np.errstate(all="ignore"):
                expected, size = self.sampler.reach(reference, s)
            if not np.all(np.isfinite(expected)):
                return None
            found = self.module.step(s.q, s.qd, h=h, t=s.t, u=s.u, params=s.params)
            gain = h * e.size["acceleration"]
            return self.units(found, expected, size + np.array([h * (np.abs(s.qd) + gain), gain]))

        return largest(map(error, self.few(self.effort.few)), "no step from any state is finite")

    def step_by(self, method: str) -> float | Finding:
        """One step of a method from a few states, by its tableau on the reference's accelerations.

        Shorter than the scene's h where the stages of an implicit one are else not found.
        """
        errors = (self._step_by(method, e) for e in self.few(self.effort.few))
        return largest(errors, "no step from any state is finite")

    def _step_by(self, method: str, e: Expected) -> float | None:
        """None where there is no such step, in the reference or in the module."""
        s, gain = e.state, e.size["acceleration"]
        for h in (part * self.system.run.h for part in SHORTER):

            def reference(q: Vector, qd: Vector, t: Vector, h: float = h, **given: Any) -> Vector:
                def acceleration(q: Vector, qd: Vector, t: Vector) -> Vector:
                    return self.reference.acceleration(q, qd, t, **given)

                ends = one_step.step(METHODS[method], acceleration, q, qd, t, h)
                return np.moveaxis(ends, 0, 1)

            with np.errstate(all="ignore"):
                try:
                    expected, size = self.sampler.reach(reference, s)
                except np.linalg.LinAlgError:
                    continue
            run = self._simulate(s, method=method, h=h, steps=1, t0=s.t)
            if np.all(np.isfinite(expected)) and run.status == "ok":
                size = size + np.array([h * (np.abs(s.qd) + h * gain), h * gain])
                return self.units([run.q[-1], run.qd[-1]], expected, size)
        return None

    def runs(self) -> float | Finding:
        """A short run from the start, and one from a random state with random parameters."""
        errors = (self._run(e.state) for e in self.few(2))
        return largest(errors, "a difference grows too much in one step")

    def _run(self, s: State, h: float = 0.0, steps: int = 0) -> float | None:
        """As far as a difference at the start, in units of the spread, grows by GROWTH_LIMIT."""
        own = self.system.run.h
        h = h or own
        steps = steps or min(self.effort.run, max(1, round(self.system.run.duration / h)))
        spread = np.array([self.sampler.spread, self.sampler.speed])

        # of alternating signs, as what is rounded excites the fastest modes too
        by = NUDGE * spread * (np.where(np.arange(len(s.q)) % 2, -1, 1) if h > own else 1)
        q, qd = (np.array([x, x + d]) for x, d in zip((s.q, s.qd), by, strict=True))
        u = None if s.u is None else np.array([s.u, s.u])
        with np.errstate(all="ignore"):
            t, *found = self.reference.simulate(q, qd, h=h, steps=steps, u=u, params=s.params)
            x, y = np.moveaxis(np.stack(found, axis=1), 2, 0)
            growth = np.max(np.abs(y - x) / spread, axis=(1, 2)) / NUDGE
        if h > own:  # long steps may blow up, and say nothing then
            far = np.max(np.abs(x - x[:1]) / spread, axis=(1, 2))
            growth = np.where(far < FARTHEST, growth, math.inf)
        growth = np.maximum.accumulate(growth)
        honest = int(np.sum(growth < GROWTH_LIMIT))  # nan is not
        if honest < 2:
            return None
        t, x, growth = t[:honest], x[:honest], growth[:honest, None, None]
        run = self._simulate(s, h=h, steps=honest - 1)
        size = np.arange(1, honest + 1)[:, None, None] * (growth * spread + np.abs(x))
        if str(getattr(run.status, "value", run.status)) != "ok":
            raise RuntimeError(f"the run ended with status {run.status}")
        off_time = self.units(run.t, t, np.abs(t) + h)
        return float(np.max([off_time, self.units(np.stack([run.q, run.qd], axis=1), x, size)]))

    def _simulate(self, s: State, **how: Any) -> Any:
        with warnings.catch_warnings():  # a run that stops early is looked at here
            warnings.simplefilter("ignore", RuntimeWarning)
            return self.module.simulate(q0=s.q, qd0=s.qd, u=s.u, params=s.params, **how)

    def run_energy(self) -> float:
        """The energy that a run reports, at the states that it reports."""
        s = self.few(2)[-1].state
        run = self._simulate(s, steps=2)
        errors = []
        for row, found in zip(_rows(run, s), run.energy, strict=True):
            energy, size = self.sampler.energy(row)
            if np.isfinite(energy):
                errors.append(self.units(found, energy, size))
        return float(np.max(errors, initial=0))

    def ask(self, name: str, s: State) -> Vector:
        """The module's value of that name."""
        return ask(self.module, name, s)

    def few(self, count: int) -> list[Expected]:
        """Some of the states: the first ones and the last ones."""
        half = count // 2
        return self.expected[:half] + self.expected[half:][-half:]

    def units(self, found: Any, expected: Any, size: Any) -> float:
        """The largest difference in units of the module's rounding."""
        return _units(found, expected, size, self.eps)

    # properties of the module alone

    def symmetry(self) -> float:
        """D = D^T."""

        def error(e: Expected) -> float:
            D = ask(self.module, "D", e.state)
            return self.units(D, D.T, e.size["D"])

        return self.largest(error)

    def definiteness(self) -> float:
        """The least eigenvalue of D_ij / sqrt(D_ii D_jj) over all states."""

        def least(e: Expected) -> float:
            D = ask(self.module, "D", e.state)
            diagonal = np.diag(D)
            if np.any(diagonal <= 0):
                return float(np.min(diagonal))
            return float(np.linalg.eigvalsh(D / np.sqrt(np.outer(diagonal, diagonal)))[0])

        return -self.largest(lambda e: -least(e))

    def skewness(self) -> float:
        """(Ddot - 2C + dD/dt) + its transpose, Ddot and dD/dt by differences of order 8.

        The best of some widths counts: too wide is inexact, too narrow rounds, but no width
        makes a wrong C right.
        """
        stencil = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))

        def error(e: Expected) -> float:
            s = e.state
            rate = np.max(np.abs(s.qd) / self.sampler.spread) or 1.0
            C = ask(self.module, "C", s)

            def along(qd: Vector, width: float) -> Vector:
                at = (ask(self.module, "D", replace(s, q=s.q + k * width * qd, t=s.t + k * width))
                      for n, _ in stencil for k in (n, -n))  # fmt: skip
                return sum((w * (next(at) - next(at)) for _, w in stencil), 0 * C) / width

            def residual(width: float) -> float:
                A = along(s.qd, width) + along(0 * s.qd, width) - 2 * C
                return float(np.max(np.abs(A + A.T) / (rate * e.size["D"] + np.abs(C))))

            residuals = (residual(part / rate) for part in (0.03, 0.003, 3e-4, 3e-5))
            return min((x for x in residuals if not math.isnan(x)), default=math.nan)

        return self.largest(error)

    def has(self, name: str) -> bool:
        """Whether the module has derivatives: what implicit methods need, or the scene asks for."""
        run = self.system.run
        if name == "sensitivity":
            return run.linearize == "parameters" and bool(self.system.parameters)
        return bool(run.linearize) or any(METHODS[method].newton for method in self.methods)

    def slopes(self, name: str) -> float | Finding:
        """linearize or sensitivity against differences of the reference's accelerations.

        The best of some widths counts at each state, as of skewness.
        """
        scale = np.array([self.sampler.spread, self.sampler.speed])
        n, nu = len(self.system.q), len(self.system.inputs)
        known: list[float | None] = []
        for e in self.few(self.effort.few):
            s, size = e.state, e.size["acceleration"]
            held = {"u": s.u, "t": s.t, "params": s.params}
            if name == "linearize":
                A, B = self.module.linearize(s.q, s.qd, **held)
                found, part = np.hstack([A[n:], B[n:]]), slice(0, 2 * n + nu)
            else:
                found, part = self.module.sensitivity(s.q, s.qd, **held), slice(2 * n + nu, None)
            with np.errstate(all="ignore"):
                exact = derivatives.by_differences(self.reference, s, scale, self.sampler.defaults)
                off = [derivatives.apart(found, J[:, part], by[part], size) for J, by in exact]
            known.append(min((x for x in off if x is not None), default=None))
        return largest(known, "no state has finite differences")

    def bias(self) -> float:
        """bias = C qd + g."""

        def error(e: Expected) -> float:
            bias, C, g = (ask(self.module, name, e.state) for name in ("bias", "C", "g"))
            return self.units(C @ e.state.qd + g, bias, e.size["bias"])

        return self.largest(error)

    def motion(self) -> float:
        """D qdd + bias = tau."""

        def error(e: Expected) -> float:
            names = ("D", "acceleration", "bias", "tau")
            D, qdd, bias, tau = (ask(self.module, name, e.state) for name in names)
            return self.units(D @ qdd + bias, tau, e.size["motion"])

        return self.largest(error)
