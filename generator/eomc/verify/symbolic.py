"""Independent reference: textbook Euler-Lagrange equations in SymPy, NumPy and plain Python.

It starts from the `System` and has nothing else in common with the compiler: definitions are
substituted, formulas are differentiated without simplification and evaluated in double precision,
linear systems are solved by NumPy, and runs are loops in Python. It is slow, short and easy to
verify.

`simplify_trig` shortens expressions for reading. SymPy's `trigsimp` takes minutes for long
expressions. Expressions of mechanics are polynomials in velocities whose coefficients are
polynomials in sines and cosines: each coefficient is written in a few forms, and the shortest is
taken.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import sympy
from numpy.typing import ArrayLike
from sympy import Expr, ImmutableMatrix, Symbol, cos, sin
from sympy.polys.polyerrors import PolynomialError
from sympy.polys.rings import PolyElement, sring

from eomc.model.algebra import compile_function
from eomc.model.system import System, dot, t
from eomc.verify.reference import (
    MATRICES,
    SCALARS,
    Params,
    ReferenceModel,
    Values,
    Vector,
    by_rows,
)
from eomc.verify.taylor import TaylorReference

_Angles = dict[Expr, list[Expr]]  # by angle: its sine and cosine among the generators


def simplify_trig(e: Expr, rates: Sequence[Symbol] = ()) -> Expr:
    """Return an equal expression with fewer operations, or `e` itself if none is found.

    rates: velocities. For each product of velocities in `e`, its coefficient is simplified
    separately. Parts that are not polynomial in sines and cosines, such as roots, are kept; only
    their arguments are simplified.
    """
    e = sympy.sympify(e)
    return min((e, simplify_by_rates(e, rates)), key=lambda form: form.count_ops())


def simplify_by_rates(e: Expr, rates: Sequence[Symbol]) -> Expr:
    """Return `e` as a sum of products of velocities, each with the shortest coefficient found.

    rates: the velocities. If `e` is not polynomial in them, the whole of it is simplified at once.
    """
    terms = coefficients(e, rates)
    if terms is None:
        return _coefficient(e)
    return _factored(sympy.Add(*(monomial * c for monomial, c in terms)))


def coefficients(e: Expr, rates: Sequence[Symbol]) -> list[tuple[Expr, Expr]] | None:
    """Return pairs (product of velocities, simplified coefficient) that add up to `e`.

    rates: the velocities. The result is None if `e` is not polynomial in them.
    """
    if not rates or not e.has(*rates):
        coefficient = _coefficient(e)
        return [(sympy.S.One, coefficient)] if coefficient != 0 else []
    try:
        polynomial = sympy.Poly(e, *rates)
    except PolynomialError:
        return None
    pairs = [(m, _coefficient(c)) for m, c in polynomial.terms()]
    return [
        (sympy.Mul(*(r**k for r, k in zip(rates, powers, strict=True))), c)
        for powers, c in pairs
        if c != 0
    ]


@lru_cache(maxsize=10_000)
def _coefficient(e: Expr) -> Expr:
    """Return the shortest of several forms of a polynomial in sines and cosines, factored."""
    e = _inside(e)
    try:
        ring, polynomial = sring(e)
    except (PolynomialError, sympy.CoercionFailed):
        return e
    if len(polynomial) > 400:  # too expensive
        return e
    waves = [g for g in ring.symbols if isinstance(g, (sin, cos))]
    angles: _Angles = {g.args[0]: [sin(g.args[0]), cos(g.args[0])] for g in waves}
    forms = [e, polynomial.as_expr()]
    if angles:
        reduced = _reduced(polynomial, angles)
        forms += map(_grouped, reduced)
        fewest = min((polynomial, *reduced), key=len)
        sums = _sums(fewest, False)
        forms += [sums, *_double_angles_as_squares(sums)]
        if len(angles) > 1:
            forms += [_sums(fewest, True)]
    shortest = _ranked(forms)[:4]
    return _ranked(shortest + [_factored(form) for form in shortest])[0]


def _ranked(forms: Sequence[Expr]) -> list[Expr]:
    """Return forms in order of length; of equally long ones, those without double angles first.

    By their texts, which take long to write, only where nothing else tells them apart.
    """
    lengths = {form: _length(form) for form in forms}
    shared = Counter(lengths.values())
    return sorted(
        forms,
        key=lambda form: (lengths[form], str(form) if shared[lengths[form]] > 1 else ""),
    )


@lru_cache(maxsize=10_000)
def _factored(e: Expr) -> Expr:
    """Factor out common factors. Cached, since energies, D and bias share many forms."""
    return sympy.factor_terms(e)


@lru_cache(maxsize=10_000)
def _length(e: Expr) -> tuple[int, int]:
    doubled = sum(f.args[0].is_Mul and f.args[0].args[0].is_Number for f in e.atoms(sin, cos))
    return (int(e.count_ops()) + int(doubled), int(doubled))


def _inside(e: Expr) -> Expr:
    """Return `e` with the arguments of non-polynomial parts, such as roots, simplified."""
    outer = [a for a in e.atoms(sympy.Function, sympy.Pow) if _opaque(a)]
    if not outer:
        return e
    return e.xreplace({a: a.func(*(_coefficient(x) for x in a.args)) for a in _maximal(outer)})


def _opaque(a: Expr) -> bool:
    if isinstance(a, sympy.Pow):
        return bool(not (a.exp.is_Integer and a.exp > 0) and a.base.is_Add)
    return not isinstance(a, (sin, cos)) and not a.is_Atom


def _maximal(parts: list[Expr]) -> list[Expr]:
    return [a for a in parts if not any(b is not a and b.has(a) for b in parts)]


def _reduced(polynomial: PolyElement, angles: _Angles) -> list[PolyElement]:
    """Return the forms without squared cosines and without squared sines, by sin^2 + cos^2 = 1."""
    ring = polynomial.ring
    named = dict(zip(ring.symbols, ring.gens, strict=True))
    forms = []
    pairs = [[named.get(f) for f in both] for both in angles.values()]
    for which in (0, 1):
        reduced = polynomial
        for both in pairs:
            this, other = both[which], both[1 - which]
            if this is not None and other is not None:
                reduced = _without_squares(reduced, this, other)
        forms.append(reduced)
    return forms


def _grouped(polynomial: PolyElement) -> Expr:
    """Return the polynomial grouped by its sines and cosines."""
    ring = polynomial.ring
    groups: dict[Expr, list[Expr]] = {}
    for powers, c in polynomial.terms():
        parts = [g**n for g, n in zip(ring.symbols, powers, strict=True)]
        trig = sympy.Mul(*(x for x in parts if x.has(sin, cos)))
        rest = sympy.Mul(ring.domain.to_sympy(c), *(x for x in parts if not x.has(sin, cos)))
        groups.setdefault(trig, []).append(rest)
    return sympy.Add(*(_factored(sympy.Add(*cs)) * x for x, cs in groups.items()))


def _without_squares(polynomial: PolyElement, this: PolyElement, other: PolyElement) -> PolyElement:
    """Substitute 1 - other^2 for this^2; both are generators."""
    ring = polynomial.ring
    k = ring.gens.index(this)
    result = ring.zero
    for powers, c in polynomial.terms():
        n = powers[k]
        rest = (*powers[:k], n % 2, *powers[k + 1 :])
        result += ring.term_new(rest, c) * (1 - other**2) ** (n // 2)
    return result


def _sums(polynomial: PolyElement, crossed: bool) -> Expr:
    """Expand products of sines and cosines: cos a cos b = (cos(a - b) + cos(a + b))/2.

    crossed: only where two angles meet; squares of one stay.
    """
    ring = polynomial.ring
    places = [k for k, g in enumerate(ring.symbols) if isinstance(g, (sin, cos))]
    products: dict[tuple[int, ...], list[Expr]] = {}  # what stands at each product of these
    for powers, c in polynomial.terms():
        others = (
            g**n for g, n in zip(ring.symbols, powers, strict=True) if not isinstance(g, (sin, cos))
        )
        rest = sympy.Mul(ring.domain.to_sympy(c), *others)
        products.setdefault(tuple(powers[k] for k in places), []).append(rest)
    total: dict[Expr, list[Expr]] = {}
    for powers, rests in products.items():
        trig = [ring.symbols[k] for k, n in zip(places, powers, strict=True) for _ in range(n)]
        if crossed and len({f.args[0] for f in trig}) < 2:
            waves = {sympy.Mul(*trig): sympy.S.One}
        else:
            waves = _waves(trig)
        for wave, size in waves.items():
            total.setdefault(wave, []).extend(size * rest for rest in rests)
    return sympy.Add(*(sympy.Mul(wave, _factored(sympy.Add(*cs))) for wave, cs in total.items()))


def _waves(trig: list[Expr]) -> dict[Expr, Expr]:
    """Return a product of sines and cosines as a sum of single ones, with their amplitudes."""
    waves: dict[Expr, Expr] = {sympy.S.One: sympy.S.One}
    for f in trig:
        products: dict[Expr, Expr] = {}
        for wave, size in waves.items():
            for new, part in _times(wave, f):
                sign, new = (-1, -new) if new.is_Mul else (1, new)
                products[new] = products.get(new, sympy.S.Zero) + sign * part * size
        products.pop(sympy.S.Zero, None)
        waves = products
    return waves


def _times(wave: Expr, f: Expr) -> list[tuple[Expr, Expr]]:
    """Return the product of a single sine or cosine, or 1, with another, as a sum."""
    half = sympy.S.Half
    if wave is sympy.S.One:
        return [(f, sympy.S.One)]
    a, b = wave.args[0], f.args[0]
    less, more = sympy.expand(a - b), sympy.expand(a + b)
    if isinstance(wave, cos) and isinstance(f, cos):
        return [(cos(less), half), (cos(more), half)]
    if isinstance(wave, sin) and isinstance(f, sin):
        return [(cos(less), half), (cos(more), -half)]
    if isinstance(wave, sin):
        return [(sin(less), half), (sin(more), half)]
    return [(sin(more), half), (sin(less), -half)]  # sin(-x) becomes -sin(x)


def _double_angles_as_squares(e: Expr) -> list[Expr]:
    """Return forms of a sum of waves with cos 2a written as 1 - 2 sin² a or 2 cos² a - 1."""
    doubled = {f: f.args[0] / 2 for f in e.atoms(sin, cos) if f.args[0].as_coeff_Mul()[0] == 2}
    if not doubled:
        return []
    forms = []
    for squares in (sin, cos):
        by = {}
        for f, a in doubled.items():
            square = 1 - 2 * sin(a) ** 2 if squares is sin else 2 * cos(a) ** 2 - 1
            by[f] = 2 * sin(a) * cos(a) if isinstance(f, sin) else square
        forms.append(sympy.expand(e.xreplace(by)))
    return forms


MAX_SIZE = 10_000  # operations: SymPy takes some seconds, for five links


@lru_cache(maxsize=16)
def derive(system: System) -> SymbolicReference:
    """Derive the reference's equations of motion D q̈ + C q̇ + g = τ of a system, with SymPy.

    They follow from d/dt ∂L/∂q̇ - ∂L/∂q + ∂R/∂q̇ = Q with L = K - U - P, without any simplification
    of the system. U is the linear part of a generalized potential. T = K - U is split by its degree
    in q̇, T = T2 + a·q̇ + T0, and p = ∂T/∂q̇:

    - D = d2T/dqd2, the mass matrix, symmetric (often called M);
    - bias = (dp/dq) qd + dp/dt - dT/dq + dP/dq, and g = bias at qd = 0;
    - C_ij = 1/2 sum_k (dD_ij/dq_k + dD_ik/dq_j - dD_jk/dq_i) qd_k (Christoffel; Spong, Hutchinson,
      Vidyasagar, Robot Modeling and Control, 2006, eq. 7.60) + (da_i/dq_j - da_j/dq_i) + dD_ij/dt,
      so that bias = C qd + g, and Ddot - 2C + dD/dt is skew-symmetric;
    - tau = Q - dR/dqd;
    - jacobi = p.qd - L, which is K + P where K is purely quadratic, and changes at the rate
      power = tau.qd - dL/dt at fixed q and qd; tau does not contain constraint forces;
    - of constraints phi(q, t), then psi(q, qd, t): A = dphi/dq, then dpsi/dqd; rates
      A qd + dphi/dt, then psi; gamma = d(rates)/dt at qdd = 0, so that A qdd + gamma = 0.

    The last 16 results are cached, since `eomc check` needs the same one several times.
    The compiler has refused systems without such equations, as with K not quadratic in q̇.
    """
    expand = _expander(system)
    q, qd = system.q, ImmutableMatrix(system.qd)
    K, P, R = (expand(e) for e in (system.kinetic, system.potential, system.dissipation))
    U = expand(system.linear_potential)
    rest = dict.fromkeys(system.qd, sympy.S.Zero)

    def gradient(e: Expr, xs: Sequence[sympy.Symbol]) -> ImmutableMatrix:
        return ImmutableMatrix([sympy.diff(e, x) for x in xs])

    p = gradient(K - U, system.qd)
    D = ImmutableMatrix(p.jacobian(qd)).applyfunc(
        lambda e: sympy.simplify(e) if e.has(*system.qd) else e
    )
    a = p.xreplace(rest)
    n = range(len(q))

    def coriolis(i: int, j: int) -> Expr:
        christoffel = [
            (D[i, j].diff(q[k]) + D[i, k].diff(q[j]) - D[j, k].diff(q[i])) * qd[k] / 2 for k in n
        ]
        return sum(christoffel, a[i].diff(q[j]) - a[j].diff(q[i]) + D[i, j].diff(t))

    bias = p.jacobian(q) * qd + p.diff(t) - gradient(K - U, q) + gradient(P, q)
    forces = system.forces or (sympy.S.Zero,) * len(q)
    friction = gradient(R, system.qd)
    tau = ImmutableMatrix([expand(e) for e in forces]) - friction
    for y, force in system.applied:
        tau += gradient(expand(y), q) * expand(force)
    zero, A, rates, gamma = _constraint_expressions(system, expand)
    return SymbolicReference(
        system=system,
        constraints=zero,
        constraint_jacobian=A,
        constraint_rates=rates,
        gamma=gamma,
        D=D,
        C=ImmutableMatrix(len(q), len(q), coriolis),
        g=bias.xreplace(rest),
        bias=bias,
        tau=tau,
        friction=friction,
        kinetic=K,
        potential=P,
        linear_potential=U,
        energy=K + P,
        jacobi=p.dot(qd) - (K - U) + P,
        power=tau.dot(qd) - sympy.diff(K - U - P, t),
        signals=ImmutableMatrix(len(system.u), 1, [expand(i.signal) for i in system.inputs]),
    )


def _constraint_expressions(
    system: System, expand: Callable[[Expr], Expr]
) -> tuple[ImmutableMatrix, ImmutableMatrix, ImmutableMatrix, ImmutableMatrix]:
    """Return zero, A, the rates without q̈, and gamma of the constraints.

    Constraints of positions stand before those of rates.
    """
    q, qd, m = system.q, ImmutableMatrix(system.qd), len(system.constraints)
    zero = ImmutableMatrix(m, 1, [expand(c.formula) for c in system.constraints])
    n = sum(c.holonomic for c in system.constraints)
    phi, psi = zero[:n, :], zero[n:, :]
    A = phi.jacobian(q).col_join(psi.jacobian(system.qd)) if m else ImmutableMatrix(0, len(q), [])
    rates = (phi.jacobian(q) * qd + phi.diff(t)).col_join(psi) if m else zero
    gamma = rates.jacobian(q) * qd + rates.diff(t) if m else zero
    return zero, ImmutableMatrix(A), ImmutableMatrix(rates), ImmutableMatrix(gamma)


def without_definitions(system: System) -> System:
    """Return an equal system without definitions, with simplified energies.

    Definitions are substituted into all formulas. The new system has no outputs and no reactions.
    """
    expand = _expander(system)
    names = ("kinetic", "potential", "linear_potential", "dissipation")
    energies = {name: simplify_by_rates(expand(getattr(system, name)), system.qd) for name in names}
    return replace(
        system, **energies, definitions=(), forces=tuple(map(expand, system.forces)),
        applied=tuple((simplify_trig(expand(y)), expand(force)) for y, force in system.applied),
        outputs=(),
        constraints=tuple(replace(c, formula=expand(c.formula)) for c in system.constraints),
        reactions=(),
    )  # fmt: skip


def reference_for(system: System) -> ReferenceModel:
    """Return the reference of a system: its independent evaluation in Python, used by the checks.

    It is symbolic (`derive`) for a small system, otherwise numerical (`TaylorReference`).
    """
    return derive(system) if is_small(system) else TaylorReference(system)


def is_small(system: System, most: float | None = None) -> bool:
    """Return whether the system's expanded equations have few enough operations for `derive`.

    most: the largest permitted number of operations; MAX_SIZE by default.
    """
    return _expanded_size(system) <= (MAX_SIZE if most is None else most)


def _expanded_size(system: System) -> float:
    """Estimate the number of operations in `derive`: those of the expanded K, times nq^2.

    What a definition hangs on is counted as often as it is named; dot(e) is e once a coordinate.
    """
    sizes: dict[Expr, float] = {}
    reach: dict[Expr, frozenset[Expr]] = {q: frozenset([q]) for q in system.q}

    def size(e: Expr) -> float:
        if e not in sizes:
            dependencies = [reach.get(s, frozenset()) for s in e.free_symbols]
            reach[e] = reach.get(e, frozenset()).union(*dependencies)
            inside = sum(size(a) for a in e.args)
            sizes[e] = inside * max(1, len(reach[e])) if isinstance(e, dot) else inside + 1
        return sizes[e]

    for name, body in system.definitions:
        sizes[name], reach[name] = size(body), reach[body]
    rows = sum(size(c.formula) for c in system.constraints) * len(system.q)
    return (
        size(system.kinetic) * len(system.q) ** 2
        + size(system.potential)
        + size(system.linear_potential)
        + rows
    )


def _expander(system: System) -> Callable[[Expr], Expr]:
    """Return a function that substitutes definitions and carries out every dot(...)."""
    known: dict[Expr, Expr] = {}

    def rate(e: Expr) -> Expr:
        """de/dt = sum de/dq qd + de/dt."""
        parts = (sympy.diff(e, x) * v for x, v in zip(system.q, system.qd, strict=True))
        return sum(parts, sympy.diff(e, t))

    def expand(e: Expr) -> Expr:
        return sympy.sympify(e).xreplace(known).replace(dot, rate)

    for name, body in system.definitions:
        known[name] = expand(body)
    return expand


@dataclass(frozen=True)
class SymbolicReference(ReferenceModel):
    """Reference whose equations of motion are SymPy expressions in q, qd, t, u and the parameters.

    A reference is the independent evaluation of a system in Python, with which modules are
    compared. `derive` explains the expressions.

    Their shapes are: constraints, constraint_rates, gamma (m, 1); constraint_jacobian (m, nq); D, C
    (nq, nq); g, bias, tau, friction (nq, 1); signals (nu, 1), the scene's formulas for the inputs.
    The others are scalars. friction is ∂R/∂q̇, which tau contains with a minus sign.
    """

    system: System
    constraints: ImmutableMatrix
    constraint_jacobian: ImmutableMatrix
    constraint_rates: ImmutableMatrix
    gamma: ImmutableMatrix
    D: ImmutableMatrix
    C: ImmutableMatrix
    g: ImmutableMatrix
    bias: ImmutableMatrix
    tau: ImmutableMatrix
    friction: ImmutableMatrix
    kinetic: Expr
    potential: Expr
    linear_potential: Expr
    energy: Expr
    jacobi: Expr
    power: Expr
    signals: ImmutableMatrix
    _functions: dict[str, Callable[..., Any]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @cached_property
    def motion(self) -> ImmutableMatrix:
        """Column with the entries of D (row by row), of bias and of tau, (nq^2 + 2 nq, 1).

        Accelerations need all of them; one function evaluates them together.
        """
        return ImmutableMatrix([*self.D, *self.bias, *self.tau])

    @cached_property
    def energy_terms(self) -> Expr:
        """Expression of the sum of the absolute values of all terms of K and P."""
        return _magnitude(self.kinetic) + _magnitude(self.potential)

    @cached_property
    def power_terms(self) -> Expr:
        """Expression of the sum of the absolute values of all terms of `power`, in W."""
        return _magnitude(self.power)

    def terms(self, name: str, s: Mapping[str, Any]) -> float:
        """Return the sum of the absolute values of all terms of "energy" or "power" at a state.

        s: the arguments of `evaluate` by name.
        """
        return float(self.evaluate(f"{name}_terms", **s))

    def value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        """Return the value of `name`; see `ReferenceModel.value`."""
        if q.ndim == 1:
            return self._value_at_state(name, q, qd, float(t), u, values)
        states = self._states(q, qd, t, u, values)
        return np.array([self._value_at_state(name, *state) for state in states])

    def mass_and_force(
        self, q: ArrayLike, qd: ArrayLike, t: ArrayLike = 0.0, u: ArrayLike | None = None,
        params: Params = None,
    ) -> tuple[Vector, Vector]:  # fmt: skip
        """Return D and τ - bias, by one call of a compiled function."""
        motion, n = self.evaluate("motion", q, qd, t, u, params), len(self.system.q)
        D = motion[..., : n * n].reshape(*np.shape(q), n)
        force = motion[..., -n:] - motion[..., n * n : -n]
        return self.without_discrete_rows("D", D), self.without_discrete_rows("tau", force)

    def _states(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Iterator[tuple[Vector, Vector, float, ArrayLike | None, Values]]:
        """Yield the arguments of each state, from arguments with one row for each."""
        rows = len(q)
        times, *each = (by_rows(x, rows) for x in (t, *values))
        us: Any = [None] * rows if u is None else np.asarray(u, float)
        params = zip(*each, strict=True) if each else [()] * rows
        return zip(q, qd, times, us, params, strict=True)

    def _value_at_state(
        self, name: str, q: Vector, qd: Vector, t: float, u: ArrayLike | None, values: Values
    ) -> Any:
        """Return the value at one state."""
        if name == "signals" or not self.system.inputs:
            u = np.zeros(len(self.system.inputs))
        elif u is None:
            u = self._value_at_state("signals", q, qd, t, None, values)
        expr = getattr(self, name)
        shape = () if name in SCALARS else expr.shape if name in MATRICES else (expr.rows,)
        try:
            values_ = self._function(name)(*q.tolist(), *qd.tolist(), t, *np.asarray(u), *values)
        except (ArithmeticError, ValueError):
            return np.full(shape, math.nan)[()]
        array = np.array(values_)
        if array.dtype.kind == "c":  # a root of a negative number
            return np.full(shape, math.nan)[()]
        return array.astype(float, copy=False).reshape(shape)[()]

    def _function(self, name: str) -> Callable[..., Any]:
        if name not in self._functions:
            system, expr = self.system, getattr(self, name)
            symbols = (*system.q, *system.qd, t, *system.u, *(p.symbol for p in system.parameters))
            entries = [expr] if name in SCALARS else expr.flat()
            self._functions[name] = compile_function(symbols, entries, [_NAMED, "math"])
        return self._functions[name]


def _magnitude(e: Expr) -> Expr:
    """Return the sum of |terms| of `e`, with sums and products expanded."""
    if e.is_Add or e.is_Mul:
        return e.func(*map(_magnitude, e.args))
    if e.is_Pow and e.exp.is_Integer and e.exp > 0:
        return _magnitude(e.base) ** e.exp
    return _SIZE(e)


def _sign(x: float) -> float:
    return float((x > 0) - (x < 0))


def _heaviside(x: float, at_zero: float = 0.5) -> float:
    return at_zero if x == 0 else float(x > 0)


def _dirac_delta(x: float, order: int = 0) -> float:
    return math.inf if x == 0 else 0.0


_SIZE = sympy.Function("size")  # SymPy splits Abs into real and imaginary parts

# functions that `math` does not have
_NAMED = {"sign": _sign, "Heaviside": _heaviside, "DiracDelta": _dirac_delta, "size": abs}
