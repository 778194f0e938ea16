"""Paths on the constraint manifold, in steps small enough to stay on one branch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eomc.program.manifold import Configuration, Flags, Manifold, TangentSpace, Vector

STEPS, MAX_DIRECTIONS = 6, 4  # steps between samples; directions tried per sample
INITIAL_STEP, MAX_STEP = 0.1, 0.3  # in the units of the coordinates
MAX_CORRECTION = 0.1  # of the return to the manifold, relative to the step


def random_walk(
    manifold: Manifold, start: Configuration, positions: int
) -> Iterator[Configuration]:
    """Yield configurations that satisfy the constraints, by small steps in random directions.

    The walk begins at `start`. At most `positions` configurations are yielded, fewer if the system
    cannot move. If the constraints depend on time, the time of the configurations increases.
    """
    random = np.random.default_rng(17)
    free = np.ones(len(start.q), dtype=bool)
    span = manifold.system.run.duration if manifold.timed else 0.0
    configuration, step, count = start, INITIAL_STEP, 0
    for _ in range(MAX_DIRECTIONS * positions):
        direction = random.normal(size=len(start.q))
        has_moved, steps = False, 0
        for _ in range(8 * STEPS):
            frame = TangentSpace(configuration, free, manifold.holonomic)
            unit = np.sqrt(np.diag(configuration.metric))
            tangent = frame.projected(direction / unit)
            size = float(np.max(np.abs(tangent), initial=0))
            drift = span / positions / STEPS * min(1.0, step / INITIAL_STEP)
            if size <= 1e-12 * float(np.max(1 / unit)) and not drift:
                return  # no freedom
            tangent = tangent * (step / size) if size > 0 else tangent
            next_configuration = step_on_manifold(manifold, configuration, tangent, drift, free)
            if next_configuration is None:
                step /= 2
                if step < 1e-9:
                    break
                continue
            configuration, has_moved, steps, step = (
                next_configuration,
                True,
                steps + 1,
                min(MAX_STEP, 1.5 * step),
            )
            if steps == STEPS:
                break
        if not has_moved:  # at a singular configuration few directions are possible
            step = INITIAL_STEP
            continue
        q, converged = manifold.refine(configuration, free)
        if converged:
            configuration = (
                manifold.configuration(np.array([float(x) for x in q]), configuration.t)
                or configuration
            )
        yield configuration
        count += 1
        if count == positions:
            return


def trace_branch(
    manifold: Manifold, start: Configuration, max_step: float = MAX_STEP, sign: int = 1
) -> Iterator[Configuration]:
    """Yield configurations that satisfy the constraints, along a curve from `start`.

    Each configuration is a small step from the last. No coordinate changes by more than about
    `max_step` in a step. `sign` (1 or -1) selects one of the two directions at the start.
    """
    free, configuration, step = np.ones(len(start.q), dtype=bool), start, INITIAL_STEP
    tangent = np.random.default_rng(17).normal(size=len(start.q)) / np.sqrt(np.diag(start.metric))
    tangent = sign * tangent
    while step > 1e-9:
        tangent = TangentSpace(configuration, free, manifold.holonomic).projected(tangent)
        size = float(np.max(np.abs(tangent), initial=0))
        if size == 0:
            return
        next_configuration = step_on_manifold(
            manifold, configuration, tangent * (step / size), 0.0, free
        )
        if next_configuration is None:
            step /= 2
            continue
        configuration, step = next_configuration, min(max_step, 1.5 * step)
        yield configuration


def step_on_manifold(
    manifold: Manifold, place: Configuration, tangent: Vector, drift: float, free: Flags
) -> Configuration | None:
    """Return the configuration after the step `tangent` (nq,), corrected to satisfy constraints.

    The step begins at the configuration `place`. `drift` is the increase of time (s), and `free`
    marks the coordinates that the correction may change. None is returned if the step may be too
    long to stay on the same branch of solutions.
    """
    predicted = manifold.configuration(place.q + tangent, place.t + drift)
    if predicted is None:
        return None
    frame = TangentSpace(predicted, free, manifold.holonomic)
    length = frame.length(tangent) + 1e-9 * frame.length(np.ones(len(tangent)))
    if not drift and frame.length(frame.correction(predicted.phi)) > MAX_CORRECTION * length:
        return None
    corrected, converged = manifold.gauss_newton(predicted.q, free, predicted.t)
    if not converged or corrected is None:
        return None
    return (
        corrected
        if drift or frame.length(corrected.q - predicted.q) <= 2 * MAX_CORRECTION * length
        else None
    )
