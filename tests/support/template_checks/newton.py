"""Checks of Newton's method, by which implicit methods solve for the stages of long steps.

Steps are long compared with the fastest mode, near an equilibrium, where forces are almost linear:
there Newton's method needs a few iterations, fixed-point iteration does not converge, and an
iteration for wrong equations converges slowly or not at all. The number of iterations is compared
with that of Newton's method in NumPy on the reference's accelerations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.runtime.package import model_of
from eomc.verify import reference
from eomc.verify.comparison import Check, Comparison, Measurement
from eomc.verify.reference import Vector
from eomc.verify.sampling import State
from support.template_checks.runs import measured, run_in_c

STEPS = 3  # of a run
# distance of the initial state from the equilibrium, relative to the range of the motion: so small
# that the motion stays linear during two fixed-point iterations that diverge
START_DISTANCE = 1e-6
# iterations per step that the module may need in addition to those of Newton's method, since it
# first finds out that fixed-point iteration does not converge
MAX_EXTRA_SWEEPS = 8.0


@dataclass(frozen=True)
class _Equilibrium:
    """An equilibrium and a state near it.

    slopes: derivatives of the accelerations with respect to q and q̇ there, (nq, 2 nq).
    """

    centre: State
    start: State
    slopes: Vector

    @property
    def fastest(self) -> float:
        """Largest |eigenvalue| of the linearised motion, 1/s.

        It is the rate at which a difference turns, decays or grows fastest.
        """
        n = len(self.slopes)
        matrix = np.block([[np.zeros((n, n)), np.eye(n)], [self.slopes]])
        return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def checks(check: Comparison) -> Iterator[Check]:
    """Yield the checks of Newton's method, for each implicit method that uses it.

    There are none in single precision, in which a motion near an equilibrium has too few digits.
    There are none under constraints either, where a step is corrected after its stages are found.
    """
    if check.system.constraints or check.dtype != np.float64:
        return
    newton = NewtonChecks(check)
    for method in check.methods:
        if METHODS[method].newton:
            unit = "sweeps a step more than Newton's method"
            find = partial(newton.extra_sweeps, method)
            yield measured(f"{method} in stiff steps", MAX_EXTRA_SWEEPS, unit, find)


class NewtonChecks:
    """Comparison of iteration counts: the module's implicit steps against those of the reference.

    scale: typical sizes of q and q̇, (2, nq).
    """

    def __init__(self, check: Comparison) -> None:
        self.check = check
        self.scale = check.sampler.scale

    def extra_sweeps(self, method: str) -> float | Measurement:
        """Return by how many iterations per step the module at most exceeds the reference.

        The maximum is over steps of several sizes by `method`. It is inf if the module's steps fail
        or end at a wrong state. Nothing is judged (a Measurement with the reason) without a
        suitable motion.
        """
        place = self.place()
        if place is None or not place.fastest:
            return Measurement(math.inf if place else math.nan, "no mode oscillates or decays")
        # step sizes as multiples of the time scale of the fastest mode
        sweeps = [self.sweeps(method, place, x / place.fastest) for x in (1.5, 3.0, 6.0, 15.0)]
        known = [x for x in sweeps if x is not None]
        return float(np.max(known)) if known else Measurement(math.nan, "no stiff motion is linear")

    def sweeps(self, method: str, place: _Equilibrium, h: float) -> float | None:
        """Return by how many iterations per step the module exceeds the reference, in steps of h s.

        place: the equilibrium near which the run starts. The result is None if the motion is not
        linear there. It is also None if fixed-point iteration converges, however slowly, since the
        module may then use it in place of Newton's method. It is inf if the module's steps fail or
        end at a wrong state.
        """
        m, s = METHODS[method], place.start
        # fixed-point iteration with this factor converges in fewer than 20 iterations
        if reference.contraction_factor(m, place.slopes, h) < 1 / 7:
            return None
        x, counts = np.array([s.q, s.qd]), []
        rows = [x]
        for n in range(STEPS):
            with np.errstate(all="ignore"):
                x, count = reference.step_by_newton(
                    m, self.accelerations, x[0], x[1], s.t + n * h, h
                )
            far = np.abs(x - [place.centre.q, place.centre.qd]) / self.reach(place)
            if count > 8 or not np.all(far < 0.01):  # the motion is not linear
                return None
            counts.append(count)
            rows.append(x)
        run = run_in_c(model_of(self.check.module), method, s, h, STEPS)
        if run.status:
            return math.inf
        off = np.max(np.abs(run.rows[:, -1] - x) / self.reach(place))
        grown = (1 + h * place.fastest) ** 2 * STEPS
        size = float(np.max(np.abs([place.centre.q, place.centre.qd]) / self.reach(place))) + 1
        if not off <= 1e4 * grown * size * self.check.eps:
            return math.inf
        work = self.check.simulate(s, method, h=h, steps=STEPS).evaluations
        return float(work / m.stages - sum(counts)) / STEPS

    def reach(self, place: _Equilibrium) -> Vector:
        """Return how far q and q̇ go in a motion, (2, nq), with velocities of the fastest mode."""
        return np.array([self.scale[0], np.maximum(self.scale[1], self.scale[0] * place.fastest)])

    def accelerations(self, q: Vector, qd: Vector, t: Vector) -> Vector:
        """Return the reference's accelerations at n states, (n, nq).

        q and qd are (n, nq), t is (n,). Parameters and inputs are those of the scene.
        """
        return self.check.reference.acceleration(q, qd, t)

    def place(self) -> _Equilibrium | None:
        """An equilibrium found by Newton's method from the scene's start, and a state near it.

        It is None if accelerations or their derivatives become infinite or nan in the search.
        """
        s = self.check.sampler.start
        q, rest = s.q.copy(), np.zeros_like(s.q)
        n = len(q)
        with np.errstate(all="ignore"):
            for _ in range(40):
                a = self.accelerations(q[None], rest[None], np.array([s.t]))[0]
                slopes = reference.acceleration_slopes(self.accelerations, q, rest, s.t, self.scale)
                if not (np.all(np.isfinite(a)) and np.all(np.isfinite(slopes))):
                    return None
                step = np.linalg.lstsq(slopes[:, :n], -a, rcond=1e-10)[0]
                step /= max(1.0, 4 * float(np.max(np.abs(step) / self.scale[0])))
                q = q + step
                if np.max(np.abs(step) / self.scale[0]) < START_DISTANCE**2:
                    break
        centre = State(q, rest, s.t)
        signs = np.random.default_rng(4).choice([-1.0, 1.0], (2, n)) * START_DISTANCE
        start = State(q + signs[0] * self.scale[0], signs[1] * self.scale[1], s.t)
        return _Equilibrium(centre, start, slopes)
