"""Diagnosis of a start that cannot be assembled: inconsistent constraints and fixed values."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import cache
from math import prod
from typing import Any

import numpy as np
from sympy import QQ, Add, Expr, Integer, ring, sqf_part

from eomc.base.errors import Problem
from eomc.base.texts import listed
from eomc.mechanism.manifold import (
    Configuration,
    Flags,
    Manifold,
    TangentSpace,
    Vector,
)
from eomc.model.symbols import Constraint
from eomc.model.system import System
from eomc.runtime import rank

VIOLATED_FRACTION = 0.01  # residuals below this fraction of the largest one are not reported
MAX_RELEASED_VALUES = 12  # fixed values that are released one by one
MAX_PROPOSALS = 3  # values that a message proposes
NO_SOLUTION = "Remove one of them, or correct a formula or a parameter"
SEPARATE_TERMS = "an equation for each quantity that is zero, x and y for x**2 + y**2"
MAX_FORMULA_LENGTH = 60  # characters of a formula in a message


def scene_key(row: Constraint) -> str:
    """Return the key under which a constraint stands in the scene, such as "loop.knee".

    The scene is the TOML file that describes the system.
    """
    return f"loop.{row.loop}" if row.loop else f"constraints.{row.name}"


def position_problems(
    manifold: Manifold, free: Flags, configuration: Configuration
) -> Iterator[Problem]:
    """Yield error messages that explain why no positions satisfy the constraints.

    Parameters
    ----------
    manifold
        The constraint equations of the system, for evaluation.
    free
        For each coordinate, whether its initial value may change.
    configuration
        The last configuration of the search for consistent initial values, which failed.
    """
    system = manifold.system
    step = TangentSpace(configuration, free, manifold.holonomic).truncated_correction(
        configuration.phi
    )
    nearer = manifold.configuration(configuration.q + step, configuration.t)
    configuration = (
        nearer
        if nearer is not None and nearer.residual_norm <= configuration.residual_norm
        else configuration
    )
    residuals = np.abs(configuration.phi / configuration.sizes)
    rows = [k for k in manifold.holonomic if residuals[k] > VIOLATED_FRACTION * np.max(residuals)]
    involved = [k for k in np.flatnonzero(free == 0).tolist() if np.any(manifold.reads[rows, k])]

    def released(moving: Flags) -> tuple[Vector, bool]:
        closest, converged = _closest(manifold, moving, configuration)
        return closest.q, converged

    starts = {k: (system.coordinates[k].name, system.coordinates[k].start) for k in involved}
    proposed = _proposals(starts, free, released)
    row = system.constraints[rows[0]]
    fixed_values = listed(
        [f"{system.coordinates[k].name} = {configuration.q[k]:.6g}" for k in involved]
    )
    others = _together_with(system.constraints, rows)
    if proposed:
        message = (
            f"cannot be satisfied{others} with the fixed values {fixed_values}: {proposed}. "
            "Correct an initial value, or let assembly change it: guess = true"
        )
    else:
        closest, converged = _closest(manifold, np.ones(len(free), dtype=bool), configuration)
        if not (involved and converged):
            yield _inconsistent(manifold, rows, closest)
            return
        changes = [
            f"{system.coordinates[k].name} {_required_value(configuration.q[k], closest.q[k])}"
            for k in involved
        ]
        message = (
            f"cannot be satisfied{others} with the fixed values {fixed_values}, nor if one of them "
            f"changes: {', '.join(changes)}. Correct them, or let assembly change them: "
            "guess = true"
        )
    yield system.problem(scene_key(row), message)


def velocity_problems(
    manifold: Manifold, free: Flags, place: Configuration, q: Sequence[Any], rates: Vector
) -> Iterator[Problem]:
    """Yield error messages that explain why no initial velocities satisfy the constraints.

    Parameters
    ----------
    manifold
        The constraint equations of the system, for evaluation.
    free
        For each coordinate, whether its initial velocity may change.
    place
        The initial configuration.
    q
        The initial coordinates in forty digits.
    rates
        The velocities for which the residual of the velocity constraints is smallest.
    """
    system = manifold.system
    B = TangentSpace(place, np.ones(len(free), dtype=bool), manifold.rows).B
    drift = manifold.value("constraint_rates", place.q, 0 * place.q, place.t) / place.sizes
    if clash := _contradictory(B, drift, rank.tolerance()):
        yield _inconsistent_rates(manifold, clash, place)
        return
    residuals = np.abs(manifold.value("constraint_rates", place.q, rates, 0.0) / place.sizes)
    rows = [k for k in manifold.rows if residuals[k] > VIOLATED_FRACTION * np.max(residuals)]
    involved = [k for k in np.flatnonzero(free == 0).tolist() if np.any(place.A[rows, k] != 0)]
    starts = {
        k: (f"{c.name}_dot", c.rate) for k, c in enumerate(system.coordinates) if k in involved
    }
    proposed = _proposals(
        starts, free, lambda moving: manifold.rates(place, list(q), rates, moving)
    )
    row, others = system.constraints[rows[0]], _together_with(system.constraints, rows)
    fixed_values = listed([f"{system.coordinates[k].name}_dot = {rates[k]:.6g}" for k in involved])
    if proposed:
        message = (
            f"cannot be satisfied{others} with the fixed velocities {fixed_values}: {proposed}. "
            "Correct a rate, or omit it, so that it is computed"
        )
    else:
        message = (
            f"cannot be satisfied{others} with the fixed velocities {fixed_values}, nor if one of "
            "them changes: omit them, so that they are computed"
        )
    yield system.problem(scene_key(row), message)


def _proposals(
    fixed: Mapping[int, tuple[str, float]], free: Flags,
    solve: Callable[[Flags], tuple[Any, bool]],
) -> str:  # fmt: skip
    """Return the fixed values one of which alone would have to change, as text; "" for none.

    fixed: names and fixed values, by index. free: which values may change. solve: returns
    consistent values for other such flags, and whether there are any.
    """
    proposals: list[tuple[float, str]] = []
    for k, (name, before) in [*fixed.items()][:MAX_RELEASED_VALUES]:
        values, consistent = solve(free | (np.arange(len(free)) == k))
        if consistent:
            after = float(values[k])
            proposals.append((abs(after - before), f"{name} {_required_value(before, after)}"))
    return ", or ".join(text for _, text in sorted(proposals)[:MAX_PROPOSALS])


def _inconsistent(manifold: Manifold, rows: Sequence[int], configuration: Configuration) -> Problem:
    """Report constraints that cannot be satisfied together near the start, whatever values are
    fixed.
    """
    constraints = manifold.system.constraints
    free, holonomic = np.ones(len(configuration.q), dtype=bool), manifold.holonomic
    B = TangentSpace(configuration, free, holonomic).B
    scaled = (configuration.phi / configuration.sizes)[holonomic]
    # where residuals are least, A^T residual = 0: how nearly is the accuracy of the null vector
    accuracy = 10 * float(np.linalg.norm(B.T @ scaled) / np.linalg.norm(scaled))
    clash = _contradictory(B, scaled, max(accuracy, rank.tolerance()))
    rows = [holonomic[k] for k in clash] or rows
    residuals = ", ".join(
        f"{constraints[k].name} = {configuration.phi[k]:.2g}" for k in rows[:MAX_PROPOSALS]
    )
    row, others = constraints[rows[0]], _together_with(constraints, rows)
    if len(rows) > 1 and _alike(manifold, rows, configuration):
        message = (
            f"contradicts {_names(constraints, rows[1:])}: the smallest residuals are {residuals}. "
            f"{NO_SOLUTION}"
        )
    else:
        leave = ", remove one," if others else ""
        message = (
            f"cannot be satisfied{others} near the initial state: the search for a position ends "
            f"with {residuals}. Correct a formula or a parameter{leave} or choose an initial state "
            "nearer to a solution"
        )
    return manifold.system.problem(scene_key(row), message)


def _inconsistent_rates(manifold: Manifold, rows: Sequence[int], place: Configuration) -> Problem:
    """Report constraints that no velocities satisfy, whatever values are fixed."""
    constraints = manifold.system.constraints
    row, others = constraints[rows[0]], _together_with(constraints, rows)
    if len(rows) > 1 and _alike(manifold, rows, place):
        names = _names(constraints, rows[1:])
        message = f"contradicts {names}: no velocities satisfy them. {NO_SOLUTION}"
    else:
        message = (
            f"cannot be satisfied{others} by any initial velocities: the initial position is "
            "singular. Choose one nearby, or correct a formula"
        )
    return manifold.system.problem(scene_key(row), message)


def _contradictory(B: Vector, residuals: Vector, tolerance: float) -> list[int]:
    """Return a minimal set of the equations B d = -residuals that have no solution together.

    The set is empty if all have a solution. There is none if a null vector u of the Jacobian,
    u^T B = 0, has u^T residuals != 0; the equations with nonzero entries of u contradict one
    another. `tolerance` is relative to the largest singular value, and to the residuals.
    """
    everything = list(range(len(residuals)))

    def is_consistent(rows: list[int]) -> bool:
        """Return True if no null vector of the given equations contradicts them."""
        U, s, _ = np.linalg.svd(B[rows], full_matrices=False)
        basis = U[:, s > tolerance * s[0]]
        rest = residuals[rows] - basis @ (basis.T @ residuals[rows])
        return bool(np.linalg.norm(rest) <= tolerance * np.linalg.norm(residuals))

    needed = [] if is_consistent(everything) else everything
    for k in reversed(needed):
        fewer = [i for i in needed if i != k]
        if fewer and not is_consistent(fewer):
            needed = fewer
    return needed


def _alike(manifold: Manifold, rows: Sequence[int], place: Configuration) -> bool:
    """Return True if the constraints are also dependent at nearby configurations."""
    free = np.ones(len(place.q), dtype=bool)
    return not any(
        TangentSpace(nearby, free, rows).rank == len(rows)
        for nearby in manifold.nearby(place.q, place.t)
    )


def constraints_without_gradient(system: System) -> list[int]:
    """Return the indices of constraints whose gradient vanishes wherever they are satisfied.

    An example is x^2 = 0. Such constraints are recognised by their formulas: powers above 1, sums
    of even powers with coefficients of one sign, and expanded powers.
    """
    indices, coordinates = [], {*system.q}
    for k, c in enumerate(system.constraints):
        terms = [term.as_coeff_Mul() for term in Add.make_args(c.formula)]
        exponents = [power.as_base_exp()[1] for _, power in terms]
        signs = {bool(factor > 0) for factor, _ in terms}
        same_sign_even = len(signs) == 1 and all(e.is_even and e > 0 for e in exponents)
        single_power = len(terms) == 1 and exponents[0].is_number and exponents[0] > 1
        if c.holonomic and (
            single_power
            or same_sign_even
            or (not c.loop and has_only_repeated_factors(c.formula, coordinates))
        ):
            indices.append(k)
    return indices


def gradient_problems(system: System, flat: Sequence[int]) -> Iterator[Problem]:
    """Yield an error message for each constraint whose gradient vanishes where it is satisfied.

    `flat` contains the indices of these constraints. If `flat` is empty, a single message about all
    constraints is yielded.
    """
    for row in [system.constraints[k] for k in flat]:
        base, power = row.formula.as_coeff_Mul()[1].as_base_exp()
        if power == 1 and has_only_repeated_factors(row.formula, {*system.q}):
            base, power = sqf_part(row.formula), Integer(2)
        simple = (
            power.is_number
            and power != 1
            and not base.is_Number
            and len(str(base)) < MAX_FORMULA_LENGTH
        )
        alternative = f"{base} in place of {row.formula}" if simple else SEPARATE_TERMS
        message = f"has a zero gradient where it is satisfied, so no force: write {alternative}"
        yield system.problem(scene_key(row), message)
    if not flat:
        message = f"have zero gradients where satisfied, so no force: write {SEPARATE_TERMS}"
        yield system.problem("constraints", message)


def massless_problem(manifold: Manifold, massless: Sequence[int], start: Configuration) -> Problem:
    """Return an error message about coordinates that neither inertia nor a constraint determines.

    `massless` contains the indices of the coordinates, `start` is the initial configuration.
    """
    system = manifold.system
    names = [system.coordinates[k].name for k in massless]
    if any(not nearby.singular for nearby in manifold.nearby(start.q, start.t, 1.0)):
        at = _values_text(manifold, massless, start.q)
        message = (
            f"the constraints lead to {at}, where the mass matrix is singular, but not nearby: the "
            "angles of a spherical or free joint are singular at a pitch of pi/2. Rotate the frame "
            "of the body, or describe the rotation by a unit quaternion"
        )
        return system.problem(f"coordinates.{names[0]}", message)
    message = (
        f"{listed(names)} {'can move' if len(names) == 1 else 'can move together'} without moving "
        "mass or inertia, and no constraint determines "
        f"{'it' if len(names) == 1 else 'them'}: add a mass that moves, or a constraint"
    )
    return system.problem(f"coordinates.{names[0]}", message)


def value_problems(manifold: Manifold, q: Vector) -> Iterator[Problem]:
    """Yield an error message for each constraint or energy that is not finite at `q`, (nq,).

    A message is also yielded if its gradient is not finite.
    """
    system, count = manifold.system, 0
    for k, c in enumerate(system.constraints):
        manifold_of_one = Manifold(replace(system, constraints=(c,)))
        functions = ("constraints", "value"), ("constraint_jacobian", "derivative")
        for name, quantity in functions:
            if not np.all(np.isfinite(manifold_of_one.value(name, q, 0 * q, 0.0))):
                position = _values_text(manifold, np.flatnonzero(manifold.reads[k]), q)
                message = (
                    f"has no {quantity} at {position}: choose an initial state where it has one"
                )
                yield system.problem(scene_key(c), message)
                count += 1
                break
    if not count:
        position = _values_text(manifold, range(len(q)), q)
        yield system.problem(
            "energy.kinetic", f"has no value at the initial state, {position}: choose another one"
        )


def _values_text(manifold: Manifold, indices: Iterable[int], q: Vector) -> str:
    """Return "q1 = 1 and q2 = 2" for the given coordinates."""
    names = [(manifold.system.coordinates[k].name, q[k]) for k in indices]
    return listed([f"{name} = {value:.6g}" for name, value in names])


def _closest(manifold: Manifold, free: Flags, start: Configuration) -> tuple[Configuration, bool]:
    """Return the configuration near `start` where residuals are least, and whether they vanish.

    `free` marks the coordinates that may change.
    """
    for strict in (True, False):
        closest, converged = manifold.gauss_newton(start.q, free, start.t, strict)
        if converged:
            break
    return closest or start, converged


def _together_with(constraints: Sequence[Constraint], rows: Sequence[int]) -> str:
    """Return " together with ..." for the constraints after the first."""
    return f" together with {_names(constraints, rows[1:])}" if len(rows) > 1 else ""


def _names(constraints: Sequence[Constraint], rows: Sequence[int]) -> str:
    """Return the names of constraints as a list in words."""
    return listed([constraints[k].name for k in rows])


def _required_value(before: float, after: float) -> str:
    """Return the required value, with enough digits to differ from the value before."""
    for digits in range(4, 18):
        shown_before, shown_after = f"{before:.{digits}g}", f"{after:.{digits}g}"
        if shown_before != shown_after and abs(float(shown_after) - after) < 0.05 * abs(
            after - before
        ):
            break
    return f"would have to be {shown_after} ({after - before:+.2g})"


# --- products of powers, detected without factoring -----------------------------------------------

MAX_RANDOM = 10**6  # of the random numbers that replace variables and functions
MAX_DEGREE = 60  # of a polynomial that is factored


def has_only_repeated_factors(formula: Expr, moving: Set[Expr]) -> bool:
    """Return True if every factor of a formula occurs at least twice, as in (x - y)^2.

    Factors that do not depend on the variables `moving` are ignored. The formula is a polynomial in
    the variables and in function values such as sin(x), which count as variables. All are set to
    points of a random line, which gives a polynomial in one variable. Different factors remain
    different with probability 1 (Hilbert's irreducibility theorem). Expanded sums of squares and
    polynomials of high degree are not detected.
    """
    numbers = random.Random(11)
    line, s = ring("s", QQ)

    def bounded(degree: int) -> None:
        if degree > MAX_DEGREE:
            raise OverflowError

    @cache
    def restrict(e: Expr) -> Any:
        """Return the restriction of an expression to the line, a polynomial in its parameter s."""
        if e.is_Rational:
            return line(QQ.from_sympy(e))
        if e.is_Add:
            return sum(map(restrict, e.args), line(0))
        if e.is_Mul:
            factors = [restrict(x) for x in e.args]
            bounded(sum(f.degree() for f in factors if f))
            return prod(factors, start=line(1))
        if e.is_Pow and e.exp.is_Integer and e.exp > 0:
            base = restrict(e.base)
            bounded(max(base.degree(), 1) * int(e.exp))
            return base ** int(e.exp)
        start, slope = (numbers.randint(1, MAX_RANDOM) for _ in range(2))
        return start + (slope * s if e.free_symbols & moving else line(0))

    try:
        _, factors = restrict(formula).sqf_list()
    except OverflowError:
        return False
    return bool(factors) and all(times > 1 for _, times in factors)
