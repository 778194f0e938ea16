"""States at which a module is compared with the reference, and the units of rounding errors there.

A unit of rounding is eps times the size of the terms that are summed up to compute a value f. This
size is not |f|, since terms may cancel. It is |f| + sum_i |x_i df/dx_i|; the sum is the effect of
one rounding error of each input x_i. The laws of motion add the sizes of the sums of which f
consists: sqrt(D_ii D_jj) for D_ij, D qd times a rate for forces, and K and P for energies.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from sympy import Symbol

from eomc.model.constraints import find_wrong_rotations
from eomc.verify import kkt
from eomc.verify.reference import ReferenceModel, Vector

EPS = 2.0**-52
NUDGE = 1e-6  # relative change of an input by which its influence is estimated
MAX_DISTANCE = 100.0  # times the spread: steps that lead further are not compared
MOST_NUDGES = 32  # number of inputs up to which each one is changed separately
NOISE = 1e-12  # m or rad: smaller motions are rounding
FAR_FACTOR = 8.0  # distance of far states, relative to that of other random states
STICKING_SHARE = 1 / 2  # probability that something sticks, and that each such coordinate does
DRAWS = 8  # number of random changes of all inputs: estimates the influence to 25 %


@dataclass(frozen=True)
class SampleBudget:
    """How many states and steps are compared with the reference, by the cost of its evaluation.

    The reference is the independent evaluation of the equations in Python.

    Attributes
    ----------
    states : int
        Number of states.
    prediction_steps : int
        Number of steps of the run that estimates the range of the motion.
    stride : int
        Length of each of these steps, as a multiple of the scene's step size h.
    run : int
        Number of steps of a run that is compared.
    """

    states: int
    prediction_steps: int
    stride: int
    run: int


SMALL = SampleBudget(states=16, prediction_steps=50, stride=1, run=100)
# for a reference that takes a tenth of a second per evaluation
LARGE = SampleBudget(states=6, prediction_steps=5, stride=10, run=4)

# names of values: that of the module's function, and that of the reference
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

OF_POSITIONS = ("D", "g", "potential_energy", "constraint_jacobian")  # functions without q̇
OF_INPUTS = ("tau", "power", "acceleration", "multipliers")  # functions of the inputs


@dataclass(frozen=True)
class State:
    """Arguments at which functions of a module or of the reference are evaluated.

    q, qd: coordinates and velocities, (nq,). t: time, s. u: inputs, (nu,), or None for the scene's
    signals (its formulas for the inputs). params: all parameters by name, or None for their
    defaults.
    """

    q: Vector
    qd: Vector
    t: float = 0.0
    u: Vector | None = None
    params: Mapping[str, float] | None = None


def evaluate_module(module: Any, name: str, s: State) -> Vector:
    """Return the value of a module's function at a state, as an array.

    name: the function, such as "D" or "acceleration".
    """
    place = (s.q,) if name in OF_POSITIONS else (s.q, s.qd)
    inputs = {"u": s.u} if name in OF_INPUTS else {}
    return np.asarray(getattr(module, name)(*place, t=s.t, params=s.params, **inputs), float)


def projected_start(module: Any, s: State) -> State:
    """Return the state moved onto the module's constraints, as runs do with their initial state."""
    if not getattr(module, "constraint_names", ()):
        return s
    q, qd = module.project(s.q, s.qd, t=s.t, params=s.params)
    return replace(s, q=np.asarray(q, float), qd=np.asarray(qd, float))


def simulate(module: Any, s: State, **how: Any) -> Any:
    """Return the module's run from the state `s`, without a warning if it stops early.

    how: further arguments of the module's `simulate`, such as h and steps.
    """
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        return module.simulate(q0=s.q, qd0=s.qd, u=s.u, params=s.params, **how)


def states_of_run(run: Any, s: State) -> list[State]:
    """Return the states that a run has stored, each with the inputs and parameters of `s`.

    s: the initial state of the run.
    """
    rows = zip(run.t, run.q, run.qd, strict=True)
    return [replace(s, q=np.array(q), qd=np.array(qd), t=float(t)) for t, q, qd in rows]


def perturb_each_input(s: State, defaults: Mapping[str, float]) -> list[State]:
    """Return copies of the state, in each of which one number is multiplied by 1 + NUDGE.

    The numbers are all nonzero coordinates, velocities and inputs, the time if it is not zero, and
    the parameters. If the state has no parameters, they are the `defaults`.
    """
    states = []
    for field in ("q", "qd", "u"):
        values = getattr(s, field)
        for i in np.flatnonzero(values) if values is not None else ():
            changed = values.copy()
            changed[i] *= 1 + NUDGE
            states.append(replace(s, **{field: changed}))
    if s.t:
        states.append(replace(s, t=s.t * (1 + NUDGE)))
    params = s.params or defaults
    for name, value in params.items():
        states.append(replace(s, params={**params, name: value * (1 + NUDGE)}))
    return states


def _perturbed(s: State, defaults: Mapping[str, float], random: np.random.Generator) -> State:
    """Return the state with all inputs changed at random by small parts of themselves."""

    def shake(x: Any) -> Any:
        return x * (1 + NUDGE * random.standard_normal(np.shape(x)))

    params = {name: float(shake(value)) for name, value in (s.params or defaults).items()}
    u = None if s.u is None else shake(s.u)
    return State(shake(s.q), shake(s.qd), float(shake(s.t)), u, params)


def _stacked(states: Sequence[State], defaults: Mapping[str, float]) -> dict[str, Any]:
    """Return states as arguments with a row each; all have external inputs or none."""
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
    """The reference's values at a state, and their sizes, which define the units of errors.

    value, size: by name, such as "D" or "acceleration". An error of eps times the size is one unit
    of rounding; eps is the relative rounding error of a number.
    """

    state: State
    value: Mapping[str, Vector]
    size: Mapping[str, Vector]


class Sampler:
    """Source of random states around the scene's initial state.

    At all of them the mass matrix D is finite and regular.

    Parameters
    ----------
    reference : ReferenceModel
        Evaluates the system's equations in Python.
    random : Generator
        Source of random numbers.
    effort : SampleBudget
        Number and length of the steps that estimate the range of the motion.

    Attributes
    ----------
    spread, speed : (nq,) array
        How far coordinates and velocities go in the scene's motion.
    scale : (2, nq) array
        Both of these.
    rejected : int
        Number of random states left out so far.
    """

    def __init__(
        self, reference: ReferenceModel, random: np.random.Generator, effort: SampleBudget
    ) -> None:
        self.reference, self.random = reference, random
        self.system = system = reference.system
        self.defaults = {p.name: p.value for p in system.parameters}
        self.rejected = 0
        self.start = State(*np.array([(c.start, c.rate) for c in system.coordinates]).T)
        # range of the motion: half a turn for angles; for others, from the first steps, else 1 m
        slides, turns = set[Symbol](), set[Symbol]()
        for link in system.tree.links if system.tree else ():
            (slides if link.angular == 0 else turns).update(link.q.free_symbols)
        slides -= turns
        self.angles = np.array([c.unit == "rad" and c.q not in slides for c in system.coordinates])
        self.discrete = [k for k, c in enumerate(system.coordinates) if c.name in system.discrete]
        far, fast = self.predicted_ranges(effort)
        self.spread = np.where(self.angles, np.pi, np.where(far > NOISE, far, 1.0))
        self.speed = np.maximum(fast, 10 * self.spread / system.run.duration)
        self.scale = np.array([self.spread, self.speed])

    def predicted_ranges(self, effort: SampleBudget) -> Vector:
        """Return how far coordinates and velocities get, (2, nq); 0 where that is not finite.

        Steps are halved until that makes no difference: the scene's h may be too long for its
        motion, which then goes to 1e40. Runs begin at the start and, since a system at rest moves
        from elsewhere, at angles turned by 1 rad from there.
        """
        start, h, steps = self.start, effort.stride * self.system.run.h, effort.prediction_steps
        q = np.array([start.q, start.q + self.angles])
        qd = np.array([start.qd, start.qd])
        if self.system.constraints:  # far from them, the correction of a step would be large
            with np.errstate(all="ignore"):
                q[1], qd[1] = self.reference.project(q[1], qd[1], nearest=False)
        ranges = np.full((2, *q.shape), math.inf)
        for part in (2**k for k in range(6)):
            before = ranges
            with np.errstate(all="ignore"):
                _, *x = self.reference.simulate(q, qd, h=h / part, steps=steps * part)
                ranges = np.array([np.max(np.abs(y), axis=0) for y in x])
                if np.all(np.abs(ranges - before) <= 0.1 * ranges + NOISE):
                    break
        return np.asarray(np.max(np.nan_to_num(ranges, posinf=0), axis=1))

    def states(self, count: int) -> list[Expected]:
        """Return `count` states with the reference's values there; fewer if too many are rejected.

        The first is the initial state. A quarter of the states have the default parameters, the
        others random ones. Every second state has random inputs.
        """
        states_: list[Expected] = []
        nearness = 1.0  # each rejected state reduces the distance of the next one
        for attempt in range(20 * count):
            if len(states_) == count:
                break
            with_defaults = len(states_) < count // 4
            state = (
                self.start
                if attempt == 0
                else self.draw(nearness, with_defaults, len(states_) % 2 == 1)
            )
            expected = self.regular_expected(state)
            if expected is None:
                self.rejected += 1
                nearness *= 0.7
            else:
                states_.append(expected)
                nearness = 1.0
        return states_

    def unusual_states(self, slow: int) -> list[Expected]:
        """Return the reference's values at states that runs hardly reach.

        In one state all coordinates differ from the start by about one unit (1 m or 1 rad). In up
        to `slow` other states all velocities are almost zero, where smoothed friction is steep.
        States with a singular D are left out.
        """
        drawn = [self.draw(1.0, True, False) for _ in range(1 + slow)]
        way = np.array([drawn[0].q - self.start.q, drawn[0].qd - self.start.qd])
        q, qd = [self.start.q, self.start.qd] + way * np.maximum(1, 1 / self.scale)
        q[self.discrete] = drawn[0].q[self.discrete]
        states = [replace(drawn[0], q=q, qd=qd)]
        states += [
            replace(s, qd=p * s.qd) for s, p in zip(drawn[1:], (2.0**-6, 2.0**-10), strict=False)
        ]
        return [e for state in states if (e := self.regular_expected(self.project(state)))]

    def far_states(self) -> list[Expected]:
        """Return a list with one state, with reference values, that is very far from the start.

        It is FAR_FACTOR times as far as other random states. There, terms that are small near the
        start become visible. The list is empty if D is not regular at that state.
        """
        drawn = [self.draw(FAR_FACTOR, True, False) for _ in range(4)]
        state = max(drawn, key=lambda s: float(np.min(np.abs(s.q - self.start.q) / self.spread)))
        expected = self.regular_expected(state)
        return [] if expected is None else [expected]

    def draw(self, nearness: float, with_defaults: bool, with_inputs: bool) -> State:
        """Return a random state, projected onto the constraints; nan if the projection fails.

        nearness: distance from the initial state, relative to the range of the scene's motion.
        with_defaults: use the default parameters instead of random ones. with_inputs: draw random
        inputs instead of using the scene's signals.
        """
        random, n, start = self.random, len(self.start.q), self.start
        centre = np.where(self.angles, nearness < 1, 1) * start.q
        q = centre + nearness * self.spread * random.uniform(-1, 1, n)
        qd = start.qd + nearness * self.speed * random.uniform(-1, 1, n)
        for k in self.discrete:
            q[k], qd[k] = self._random_factor_of(float(start.q[k]), random.uniform(-0.5, 0.5)), 0.0
        self._choose_modes(q, qd)
        t = random.uniform(0, self.system.run.duration)
        u = None
        if with_inputs and self.system.inputs:
            signals = np.abs(self.reference.evaluate("signals", q, qd, t))
            u = random.normal(size=len(signals)) * np.where(signals > 0, signals, 1)
        # a loop may not close if its lengths differ too much from the scene's
        some = nearness if self.system.constraints else 1.0
        by = some * random.uniform(-0.5, 0.5, len(self.defaults))
        params = {
            name: self._random_factor_of(value, x)
            for (name, value), x in zip(self.defaults.items(), by.tolist(), strict=True)
        }
        state = self.project(State(q, qd, t, u, None if with_defaults else params))
        for mode in self.system.modes:  # the projection may have reversed a sliding direction
            state.q[mode.at] = np.sign(state.qd[mode.of]) * abs(q[mode.at])
        return state

    def with_discrete_parameters(self, s: State) -> State:
        """Return the state with discrete variables (parameters set by jumps) as parameters."""
        if not self.discrete:
            return s
        values = {self.system.coordinates[k].name: float(s.q[k]) for k in self.discrete}
        return replace(s, params={**(s.params or self.defaults), **values})

    @staticmethod
    def _random_factor_of(value: float, by: float) -> float:
        """Return a random value near that of a parameter; one that is 0 is changed, too.

        by: distance from the default, as a logarithm.
        """
        return value * math.exp(by) if value else math.exp(by) - 0.5

    def _choose_modes(self, q: Vector, qd: Vector) -> None:
        """Set the modes of stick-slip friction by the velocities; in some states, some stick.

        At least one freedom remains.
        """
        if self.system.modes and self.system.closure:
            freedoms_left = self.system.closure.freedoms - 1
            some = self.random.uniform() < STICKING_SHARE
            for mode in self.system.modes:
                sticks = some and freedoms_left > 0 and self.random.uniform() < STICKING_SHARE
                freedoms_left -= sticks
                qd[mode.of] *= not sticks
                q[mode.at], qd[mode.at] = np.sign(qd[mode.of]), 0.0

    def project(self, s: State, nearest: bool = False) -> State:
        """Return the state projected onto the constraints; nan if no such state is found.

        nearest: find the nearest positions, as a module's `project` does.
        """
        if not self.system.constraints:
            return s
        with np.errstate(all="ignore"):
            q, qd = self.reference.project(s.q, s.qd, s.t, s.params, nearest=nearest)
        projected = replace(s, q=q, qd=qd)
        rows = [
            self.value_and_size(partial(self.reference.evaluate, name), projected)
            for name in ("constraints", "constraint_rates")
        ]
        holds = all(np.all(np.abs(off) <= 1e-9 * size + 1e-12) for off, size in rows)
        if holds and not self.wrong_rotations(projected):
            return projected
        return replace(s, q=np.full_like(q, np.nan), qd=np.full_like(q, np.nan))

    @cached_property
    def _find_wrong_rotations(self) -> Callable[..., list[str]]:
        return find_wrong_rotations(self.system)

    def wrong_rotations(self, s: State) -> list[str]:
        """Return the names of closed loops whose bodies meet with a wrong rotation.

        The equations of such a loop hold although the rotation is not the required one.
        """
        if not (self.system.reactions and np.all(np.isfinite(s.q))):
            return []
        return self._find_wrong_rotations(s.q.tolist(), s.t, s.params or {})

    def regular(self, s: State) -> bool:
        """Return whether the reference's D is finite and far from singular at a state.

        With random parameters, D must also be positive definite. Under constraints, the KKT matrix
        of D and the constraint Jacobian must be far from singular, and D nonnegative for permitted
        velocities.
        """
        D = self.reference.evaluate("D", s.q, s.qd, s.t, s.u, s.params)
        if self.system.constraints:
            A = self.reference.solved_values("constraint_jacobian", s.q, s.qd, s.t, s.params)
            off = self.reference.switched & ~np.any(A, axis=1)
            weighted = bool(self.system.closure and self.system.closure.weights)
            return kkt.is_regular(D, A[~off], 1e-6) and kkt.is_nonnegative(
                D, A[~off] if weighted else A[:0]
            )
        diagonal = np.abs(np.diag(D))
        if not (np.all(np.isfinite(D)) and np.all(diagonal > 0)):
            return False
        eigenvalues = np.linalg.eigvalsh(D / np.sqrt(np.outer(diagonal, diagonal)))
        least, most = np.min(np.abs(eigenvalues)), np.max(np.abs(eigenvalues))
        return bool(least * 1e8 > most and (s.params is None or eigenvalues[0] > 0))

    def regular_expected(self, s: State) -> Expected | None:
        """Return the reference's values and sizes at a state; None if D is not regular there."""
        with np.errstate(all="ignore"):
            return self.expected(s) if self.regular(s) else None

    def expected(self, s: State) -> Expected | None:
        """Return the reference's values and their sizes at a state; None if one is not finite."""
        value: dict[str, Vector] = {}
        reach: dict[str, Vector] = {}
        for name, field in VALUES.items():
            value[name], reach[name] = self.value_and_size(
                partial(self.reference.evaluate, field), s
            )
        D, qd = value["D"], np.abs(s.qd)
        if self.system.constraints:
            state = (s.q, s.qd, s.t, s.u, s.params)
            qdd = self.reference.acceleration(*state)
            value["multipliers"] = self.reference.multipliers(*state)
        else:
            qdd = np.asarray(np.linalg.solve(D, value["tau"] - value["bias"]), float)
        value["acceleration"] = qdd
        if not all(np.all(np.isfinite(x)) for x in value.values()):
            return None
        diagonal = np.sqrt(np.diag(reach["D"]))
        if self.system.constraints:  # a coordinate without inertia gets one from its constraints
            scale = kkt.scales(
                D, self.reference.solved_values("constraint_jacobian", s.q, s.qd, s.t, s.params)
            )[: len(qd)]
            diagonal = np.where(diagonal > 0, diagonal, 1 / scale)
        inertia = np.outer(diagonal, diagonal) + reach["D"]
        rate = np.max(qd / self.spread)  # at which D changes, 1/s
        force = reach["bias"] + reach["g"] + reach["tau"] + rate * inertia @ qd
        # a force of 0 along one coordinate may be a sum of forces that cancel
        force = np.maximum(force, diagonal * np.max(force / diagonal))
        energy = np.maximum(
            reach["kinetic_energy"] + reach["potential_energy"],
            self.reference.terms("energy", vars(s)),
        )
        power = np.maximum(reach["power"] + force @ qd, self.reference.terms("power", vars(s)))
        size = {
            "D": inertia,
            "C": reach["C"] + rate * inertia,
            **dict.fromkeys(("g", "bias", "tau"), force),
            **dict.fromkeys(("kinetic_energy", "potential_energy", "energy", "jacobi"), energy),
            "power": power,
            "motion": inertia @ np.abs(qdd) + force,
        }
        if self.system.constraints:
            self._rows_of(s, value, size)
        else:
            size["acceleration"] = np.abs(np.linalg.inv(D)) @ size["motion"]
        return Expected(s, value, size)

    def _rows_of(self, s: State, value: dict[str, Vector], size: dict[str, Vector]) -> None:
        """Add values and scales of constraints, multipliers, accelerations and corrections."""
        for name in ("constraint_jacobian", "constraints", "constraint_rates", "gamma"):
            value[name], size[name] = self.value_and_size(partial(self.reference.evaluate, name), s)
        A, a, n = size["constraint_jacobian"], np.abs(value["acceleration"]), len(s.q)
        scale = kkt.scales(value["D"], value["constraint_jacobian"])

        def row_size(x: Vector) -> Vector:
            """Return the effect on each constraint of x as if its largest part were along it."""
            return np.asarray(A @ np.abs(x) + np.max(np.abs(x) / scale[:n]) / scale[n:])

        # an entry may be a sum of terms that cancel; other entries of the same row have their size
        size["constraint_jacobian"] = A + np.outer(1 / scale[n:], 1 / scale[:n])
        size["constraints"] = size["constraints"] + row_size(s.q)
        size["constraint_rates"] = size["constraint_rates"] + row_size(s.qd)
        motion = size["motion"] + np.abs(value["multipliers"]) @ A
        size["motion"] = np.maximum(motion, np.max(motion * scale[:n]) / scale[:n])
        # power of constraints that depend on time
        pushed = value["multipliers"] @ value["constraint_jacobian"] @ s.qd
        value["power"] = value["power"] + pushed
        size["power"] = size["power"] + np.abs(value["multipliers"]) @ A @ np.abs(s.qd)
        solved, A_s = self.reference.solved, self.reference.solved @ value["constraint_jacobian"]
        spread = kkt.absolute_inverse(value["D"], A_s)
        rounded = [size["motion"], np.abs(solved) @ (size["gamma"] + row_size(a))]
        both = spread @ np.concatenate(rounded)
        size["acceleration"] = both[:n]
        if self.system.modes:  # forces on a sticking coordinate cancel those that would move it
            fixed_rows = np.where(self.reference.switched[:, None], 0.0, A_s)
            size["acceleration"] += (
                kkt.absolute_inverse(value["D"], fixed_rows)[:n, :n] @ size["motion"]
            )
        size["multipliers"] = both[n:] @ np.abs(solved)
        # effect of rounding errors of the constraints on a projected state
        size["place"] = np.array([
            spread[:n, n:] @ np.abs(solved) @ size[name]
            for name in ("constraints", "constraint_rates")
        ])  # fmt: skip

    def rounded(self, s: State, *others: Vector) -> Vector:
        """Return q and qd of a state and of states near it, stacked as (2, n, nq).

        others: further states (2, nq), which are appended. Under constraints, three states are
        added that differ from `s` by rounding only: near a singular position, rounding errors of a
        step grow more than a larger difference of its initial state suggests.
        """
        x = np.array([s.q, s.qd])
        digits = EPS * (np.abs(x) + self.scale)
        digits[:, 1::2] *= -1
        near = [x + k * digits for k in (-2, 1, 3)] if self.system.constraints else []
        return np.stack([x, *others, *near], axis=1)

    def value_and_size(self, function: Callable[..., Any], s: State) -> tuple[Vector, Vector]:
        """Return the value f of a function at a state, and the size that its errors refer to.

        The size is |f| + Σ |x_i ∂f/∂x_i|: eps times this is the effect of one rounding error in
        each input x_i. With more than MOST_NUDGES inputs, the sum is estimated from DRAWS random
        changes of all inputs, as the root of the sum of squares.

        function: f, with the arguments of `ReferenceModel.evaluate` for many states at once.
        """
        near = perturb_each_input(s, self.defaults)
        many = len(near) > MOST_NUDGES
        if many:
            near = [_perturbed(s, self.defaults, self.random) for _ in range(DRAWS)]
        values = np.asarray(function(**_stacked([s, *near], self.defaults)))
        value, off = values[0], np.nan_to_num(np.abs(values[1:] - values[0]) / NUDGE)
        spread = np.sqrt(np.mean(off**2, axis=0)) if many else np.sum(off, axis=0)
        return value, np.abs(value) + spread
