"""The registry of routes: the methods by which the functions of the equations of motion are
derived.

To add a route, write a function of `RouteInputs` here or in derive/ and an entry of `ROUTES`.
`cheapest` selects the route of each function: the one with the fewest operations among those
without loss of accuracy.

One route expands expressions on a tape into polynomials, cancels and factors. Derivatives along a
tape keep definitions whole, which makes large systems possible, but terms that cancel between
definitions remain. For small systems, the expansion is used where it needs fewer operations.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property

from sympy import Add, Expr, Mul, Pow, Rational, S, Symbol

from eomc.derive.constraints import constrained_accelerations, linearize_constrained
from eomc.derive.energies import tangent_symbols
from eomc.derive.inverse_dynamics_derivatives import applies, linearize
from eomc.derive.lagrange import Derivation, EquationsOfMotion
from eomc.derive.ldl import Rows, SolveResult, solve
from eomc.derive.link_multipliers import prefer_short_chains
from eomc.derive.outputs import MAX_LINEARIZATION_SIZE, linearization
from eomc.derive.tape import Stage, Tape, split
from eomc.model.system import System
from eomc.program.ir import Cost, Function, evaluator, nearby
from eomc.program.lower import lower

Exponent = int | Fraction  # integers are int, which hashes faster
Monomial = tuple[tuple[str, Exponent], ...]  # sorted by name
Polynomial = dict[Monomial, Expr]

MAX_TERMS = 64  # of one polynomial
MAX_TOTAL_TERMS = 160  # of all outputs of a function
MAX_EXPONENT = 2**20
MAX_BITS = 900  # of a coefficient, so that it is in the range of a double
MAX_INTERMEDIATE_TERMS = 8 * MAX_TERMS  # before cancellation


class TooLargeError(Exception):
    """Raised if a polynomial has too many terms to be worth expanding."""


class Expander:
    """Expansion of definitions on a tape to polynomials; results are stored for later calls.

    `tape` is a list of named definitions, see `Tape`.
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self.known: dict[Symbol, Polynomial] = {}
        self.large: set[Symbol] = set()
        self.symbols: dict[str, Symbol] = {}

    def expand(self, outputs: Sequence[Expr]) -> list[Expr] | None:
        """Return the outputs, expanded to polynomials in variables and function values.

        The identity sin^2 + cos^2 = 1 is applied wherever it shortens a sum. None is returned if
        the polynomials become too large.
        """
        try:
            polynomials = [self.atom(output) for output in outputs]
        except TooLargeError:
            return None
        if sum(map(len, polynomials)) > MAX_TOTAL_TERMS:
            return None
        return [self.built(polynomial) for polynomial in polynomials]

    def short(self, atom: Expr) -> Expr:
        """Return a value on the tape in expanded form, in which terms cancel, if that is short.

        Otherwise return `atom` unchanged.
        """
        if (out := self.expand([atom])) is not None and len(self.atom(atom)) <= 8:
            return out[0]
        return atom

    def atom(self, atom: Expr) -> Polynomial:
        """Return the polynomial of an atom, as a coefficient for each monomial."""
        factor, symbol = split(atom)
        if symbol is None:
            return {(): factor} if factor != 0 else {}
        return {m: factor * c for m, c in self.symbol(symbol).items()}

    def symbol(self, symbol: Symbol) -> Polynomial:
        """Return the polynomial of a name on the tape. Raises TooLargeError."""
        if symbol not in self.known:
            live = self.tape.live([symbol])
            if not self.large.isdisjoint(live):
                raise TooLargeError
            for name in live:  # in order, which avoids deep recursion
                if name not in self.known:
                    try:
                        self.known[name] = self._reduced(self._expand_definition(name))
                    except TooLargeError:
                        self.large.add(name)
                        raise
            self.known.setdefault(symbol, self._as_variable(symbol))
        return self.known[symbol]

    def _as_variable(self, symbol: Symbol) -> Polynomial:
        """Return the polynomial of a name that is not expanded."""
        self.symbols[symbol.name] = symbol
        return {((symbol.name, 1),): S.One}

    def _expand_definition(self, name: Symbol) -> Polynomial:
        """Expand the definition of a name."""
        rhs = self.tape.rhs(name)
        named = name in self.tape.hint and self.tape.stage[name] <= Stage.PARAMETER
        if named or not (rhs.is_Add or rhs.is_Mul or rhs.is_Pow):
            return self._as_variable(name)
        if rhs.is_Add:
            total: Polynomial = {}
            for term in rhs.args:
                for monomial, coefficient in self.atom(term).items():
                    total[monomial] = total.get(monomial, S.Zero) + coefficient
            return {m: c for m, c in total.items() if c != 0}
        out: Polynomial = {(): S.One}
        for factor in Mul.make_args(rhs):
            base, exponent = factor.as_base_exp()
            if factor.is_number:
                out = {m: c * factor for m, c in out.items()}
            elif not (base.is_Symbol and exponent.is_number):
                return self._as_variable(name)
            elif exponent.is_Integer and exponent > 0 and len(self.symbol(base)) != 1:
                if exponent > MAX_TERMS:
                    raise TooLargeError
                for _ in range(int(exponent)):
                    out = self._times(out, self.symbol(base))
            else:
                out = self._times(out, self._power(base, exponent))
        return out

    def _power(self, base: Symbol, exponent: Expr) -> Polynomial:
        """Return a power with a negative or fractional exponent, distributed over products but not
        sums.
        """
        inner = self.symbol(base)
        if not exponent.is_Rational:
            raise TooLargeError
        p, q = int(exponent.p), int(exponent.q)
        power: Exponent = p if q == 1 else Fraction(p, q)
        if len(inner) == 1 and power.denominator == 1:
            ((monomial, coefficient),) = inner.items()
            _short(coefficient, max(power, -power))
            return _bounded({tuple((n, e * power) for n, e in monomial): coefficient**exponent})
        self.symbols[base.name] = base
        return {((base.name, power),): S.One}

    def _times(self, a: Polynomial, b: Polynomial) -> Polynomial:
        """Return the product of two polynomials."""
        if len(a) * len(b) > MAX_INTERMEDIATE_TERMS:
            raise TooLargeError
        out: Polynomial = {}
        for m1, c1 in a.items():
            for m2, c2 in b.items():
                powers = dict(m1)
                for n, e in m2:
                    powers[n] = powers.get(n, 0) + e
                key = _monomial(powers)
                out[key] = out.get(key, S.Zero) + c1 * c2
        return _bounded({m: c for m, c in out.items() if c != 0})

    def _reduced(self, polynomial: Polynomial) -> Polynomial:
        """Substitute sin^2 = 1 - cos^2, and back where that leaves a - a cos^2."""
        squared = {n for m in polynomial for n, e in m if e >= 2 and e.denominator == 1}
        for name in sorted(squared):
            twin = self.tape.squares.get(self.symbols[name])
            if twin is not None:
                self.symbols[twin.name] = twin
                sine = self.tape.is_sine(self.symbols[name])
                pair = (name, twin.name) if sine else (twin.name, name)
                polynomial = _with_square(_without_square(polynomial, *pair), *pair)
        if len(polynomial) > MAX_TERMS:
            raise TooLargeError
        return polynomial

    # --- back on the tape ------------------------------------------------------------------------

    def built(self, polynomial: Polynomial) -> Expr:
        """Write a polynomial to the tape and return its atom.

        Parameters are collected and common factors extracted.
        """
        coefficients: dict[Monomial, list[Expr]] = {}
        for monomial, c in polynomial.items():
            constant = [p for p in monomial if self._stage(p[0]) <= Stage.PARAMETER]
            varying = tuple(p for p in monomial if p not in constant)
            coefficients.setdefault(varying, []).append(c * self._expr(constant))
        return self._factored({m: self.tape.define(Add(*cs)) for m, cs in coefficients.items()})

    def _stage(self, name: str) -> Stage:
        """Return the binding time of a name."""
        return self.tape.stage[self.symbols[name]]

    def _expr(self, powers: Iterable[tuple[str, Exponent]]) -> Expr:
        """Return a product of powers as an expression."""
        return Mul(*(Pow(self.symbols[n], Rational(e.numerator, e.denominator)) for n, e in powers))

    def _factored(self, terms: Mapping[Monomial, Expr]) -> Expr:
        """Factor a polynomial: extract the most frequent factor, recursively."""
        counts = Counter(n for m in terms for n, e in m if e >= 1 and e.denominator == 1)
        best = max(counts, key=lambda n: (counts[n], -self._stage(n), n), default="")
        if counts[best] < 2:
            return self.tape.define(Add(*(c * self._expr(m) for m, c in terms.items())))
        inside: dict[Monomial, Expr] = {}
        outside: dict[Monomial, Expr] = {}
        for monomial, c in terms.items():
            e = dict(monomial).get(best, 0)
            if e >= 1 and e.denominator == 1:
                inside[_shifted(monomial, {best: -1})] = c
            else:
                outside[monomial] = c
        product = self.tape.define(self.symbols[best] * self._factored(inside))
        return self.tape.define(product + self._factored(outside)) if outside else product


def _bounded(polynomial: Polynomial) -> Polynomial:
    """Return the polynomial. Raises TooLargeError where coefficients or exponents are too long."""
    for monomial, c in polynomial.items():
        _short(c)
        if any(abs(e.numerator) > MAX_EXPONENT for _, e in monomial):
            raise TooLargeError
    return polynomial


def _short(number: Expr, power: Exponent = 1) -> None:
    """Raise TooLargeError where a power of the number would be too long."""
    if number.is_Rational and (number.p.bit_length() + number.q.bit_length()) * power > MAX_BITS:
        raise TooLargeError


def _shifted(monomial: Monomial, by: Mapping[str, int]) -> Monomial:
    """Return the monomial with exponents changed by `by`."""
    powers = dict(monomial)
    for name, e in by.items():
        powers[name] = powers.get(name, 0) + e
    return _monomial(powers)


def _monomial(powers: Mapping[str, Exponent]) -> Monomial:
    """Return the monomial with the given powers."""
    return tuple(sorted((n, e) for n, e in powers.items() if e))


def _without_square(polynomial: Polynomial, sine: str, cosine: str) -> Polynomial:
    """Substitute sin^2 = 1 - cos^2. Raises TooLargeError, since each substitution may double the
    terms.
    """
    while True:
        out: Polynomial = {}
        changed = False
        for monomial, c in polynomial.items():
            e = dict(monomial).get(sine, 0)
            if e >= 2 and e.denominator == 1:
                changed = True
                low = _shifted(monomial, {sine: -2})
                high = _shifted(monomial, {sine: -2, cosine: 2})
                out[low] = out.get(low, S.Zero) + c
                out[high] = out.get(high, S.Zero) - c
            else:
                out[monomial] = out.get(monomial, S.Zero) + c
        polynomial = {m: c for m, c in out.items() if c != 0}
        if not changed:
            return polynomial
        if len(polynomial) > MAX_INTERMEDIATE_TERMS:
            raise TooLargeError


def _with_square(polynomial: Polynomial, sine: str, cosine: str) -> Polynomial:
    """Substitute a - a cos^2 = a sin^2."""
    polynomial = dict(polynomial)
    for monomial in sorted(m for m in polynomial if dict(m).get(cosine, 0) >= 2):
        low = _shifted(monomial, {cosine: -2})
        if monomial in polynomial and polynomial.get(low) == -polynomial[monomial]:
            high = _shifted(monomial, {cosine: -2, sine: 2})
            del polynomial[monomial]
            polynomial[high] = polynomial.get(high, S.Zero) + polynomial.pop(low)
            if polynomial[high] == 0:
                del polynomial[high]
    return polynomial


MAX_EXPANDED_DEFINITIONS = 120  # definitions that C depends on, up to which it is expanded


class RouteInputs:
    """The inputs of all routes: a derivation, and Lagrange's equations expanded to polynomials.

    A route is a method by which a function is derived.
    """

    def __init__(self, derived: Derivation) -> None:
        self.derived = derived
        self.lagrange = derived.lagrange
        self.expander = Expander(derived.lagrange.tape) if derived.lagrange else None

    @cached_property
    def expanded(self) -> tuple[Tape, Rows, Sequence[Expr]] | None:
        """The tuple (tape, D by rows, b) of the equations D qdd = b by Lagrange's method.

        D and b are expanded to polynomials. None if the polynomials become too large.
        """
        if self.lagrange is None or self.expander is None:
            return None
        D, n = self.lagrange.D, len(self.lagrange.bias)
        triangle = [(i, j) for i in range(n) for j in range(i + 1)]
        entries_and_forces = self.expander.expand(
            [*(D[i][j] for i, j in triangle), *self.lagrange.balance]
        )
        if entries_and_forces is None:
            return None
        entries = dict(zip(triangle, entries_and_forces, strict=False))
        rows = tuple(tuple(entries[max(i, j), min(i, j)] for j in range(n)) for i in range(n))
        return self.lagrange.tape, rows, entries_and_forces[len(triangle) :]


@dataclass(frozen=True)
class RouteFunctions:
    """Functions of the equations of motion by one route, as atoms of `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    outputs
        The results of each function, by its name.
    notes
        Sentences that say where unusual terms of the kinetic energy appear.
    """

    tape: Tape
    outputs: Mapping[str, Sequence[Expr]]
    notes: tuple[str, ...]


def _by_ldl(system: System, order: str) -> str:
    """Describe elimination by L D L^T."""
    if system.constraints:
        return (
            "a = qdd by L diag(d) L^T of the KKT matrix [[D, A^T], [A, 0]], eliminated in the "
            f"order {order}, each row of A as soon as the coordinates that it reads are gone."
        )
    return f"a = qdd by D = L diag(d) L^T, eliminated in the order {order}."


@dataclass(frozen=True)
class Route:
    """A method to derive the accelerations, the other functions of the motion, or both.

    Attributes
    ----------
    sentence
        A description for users.
    accelerations
        Function that returns the solution for qdd, a str with the reason why the route is not used,
        or None if the route does not apply.
    functions
        Function that returns the other functions of the motion, or None if the route does not
        apply.
    linearization
        Function that returns the derivatives of the accelerations by q, qd and u, (nq, 2 nq + nu)
        by rows, from the selected computation of the accelerations, followed by the
        accelerations if `System.linearizes_stages`; None if the route does not apply.
    solved
        Returns a sentence for a comment that says how D qdd = tau - bias is solved, from the system
        and the names of the coordinates in order of elimination.
    penalty
        A factor on the operation count, for disadvantages that the count does not include.
    """

    name: str
    sentence: str
    accelerations: Callable[[RouteInputs], SolveResult] = lambda _: None
    functions: Callable[[RouteInputs], RouteFunctions | None] = lambda _: None
    linearization: Callable[[RouteInputs, Candidate], Candidate | None] = lambda *_: None
    solved: Callable[[System, str], str] = _by_ldl
    penalty: float = 1.0


def _power(e: EquationsOfMotion) -> Expr:
    """Return the power supplied to the system, including that of moving constraints, lambda . A
    qd.
    """
    if e.rows is None or not any(e.rows.drift):
        return e.power
    multipliers = constrained_accelerations(e.tape, e.D, e.balance, e.rows).multipliers
    powers = [e.tape.times(x, v) for x, v in zip(multipliers, e.rows.drift, strict=True)]
    return e.tape.total([e.power, *powers])


def _functions(e: EquationsOfMotion | None) -> RouteFunctions | None:
    """Return all functions of the equations of motion other than the accelerations."""
    if e is None:
        return None
    outputs: dict[str, Sequence[Expr]] = {
        name if len(rows) == len(e.g) else f"{name}_column": [x for row in rows for x in row]
        for name, rows in (("D", e.D), ("C", e.C))
    }
    outputs |= {"g": e.g, "bias": e.bias, "tau": e.tau}
    outputs |= {"kinetic_energy": [e.kinetic], "potential_energy": [e.potential]}
    outputs["energy"] = [e.tape.define(e.kinetic + e.potential)]
    if e.jacobi is not None:
        outputs["jacobi"] = [e.jacobi]
    if (power := _power(e)) != 0:
        outputs["power"] = [power]
    if e.signals:
        outputs["signal"] = e.signals
    return RouteFunctions(e.tape, outputs, e.notes)


def _expanded_functions(material: RouteInputs) -> RouteFunctions | None:
    """Return the functions by Lagrange, expanded."""
    plain = _functions(material.lagrange)
    if plain is None or material.expander is None:
        return None
    expand = material.expander.expand
    expanded = {name: expand(outputs) for name, outputs in plain.outputs.items()}
    outputs = {
        name: polynomials for name, polynomials in expanded.items() if polynomials is not None
    }
    return replace(plain, outputs=outputs)


def _rotated(material: RouteInputs) -> RouteFunctions | None:
    """Return C of a short tree, expanded: rotations that cancel are removed by sin^2 + cos^2 =
    1.
    """
    plain = _functions(material.derived.newton_euler)
    if plain is None or "C" not in plain.outputs:
        return None
    C, tape = plain.outputs["C"], plain.tape
    names = [x for entry in C for x in entry.free_symbols]
    expanded_C = (
        Expander(tape).expand(C) if len(tape.live(names)) <= MAX_EXPANDED_DEFINITIONS else None
    )
    return None if expanded_C is None else replace(plain, outputs={"C": expanded_C})


def _expanded(material: RouteInputs) -> SolveResult:
    """Return the accelerations by elimination in the expanded equations."""
    if material.expanded is None:
        return None
    rows = material.lagrange.rows if material.lagrange else None
    return (
        constrained_accelerations(*material.expanded, rows) if rows else solve(*material.expanded)
    )


def _cancelled(material: RouteInputs) -> SolveResult:
    """Return the accelerations, expanded again after each step of the elimination."""
    if material.expander is None or material.expanded is None:
        return None
    rows = material.lagrange.rows if material.lagrange else None
    short = material.expander.short
    if rows:
        return constrained_accelerations(*material.expanded, rows, short)
    return solve(*material.expanded, short)


def _constrained(e: EquationsOfMotion | None) -> SolveResult:
    """Return the constrained accelerations from equations that are not expanded."""
    return constrained_accelerations(e.tape, e.D, e.balance, e.rows) if e and e.rows else None


def _by_articulated_bodies(_: System, order: str) -> str:
    """Describe the articulated-body algorithm."""
    return (
        "a = qdd by articulated bodies (Featherstone), the pivots d being those of "
        f"D = L diag(d) L^T, eliminated in the order {order}."
    )


def _by_multipliers(system: System, order: str) -> str:
    """Describe elimination by link multipliers."""
    fractions = "Along a chain s = N/M: s_k is N there, and S_k is M times the entry it was. "
    return (
        "a = qdd by link multipliers (tensions), S = N T N^T = L diag(s) L^T, eliminated in the "
        f"order of the links of {order}. {fractions if prefer_short_chains(system) else ''}"
        "Every mass must be positive."
    )


def _forward(material: RouteInputs, taken: Candidate) -> Candidate:
    """Return the derivatives of the accelerations by forward differentiation."""
    system = material.derived.system
    rows = linearization(system, taken.tape, taken.outputs)
    entries = [x for row in rows for x in row]
    columns = 2 * len(system.q) + len(system.u)
    calls = columns * len(system.q) // len(entries)
    if calls == 1 and system.linearizes_stages:
        entries += taken.outputs
    return Candidate(taken.tape, entries, taken.checks, calls=calls)


def _by_inverse_dynamics(material: RouteInputs, _: Candidate) -> Candidate | None:
    """Return the derivatives of the accelerations from those of inverse dynamics."""
    system, tree = material.derived.system, material.derived.system.tree
    if tree is None or system.constraints or not applies(system, tree):
        return None
    derived = linearize(system, tree)
    entries = [x for row in derived.rows for x in row]
    entries += derived.accelerations if system.linearizes_stages else ()
    return Candidate(derived.tape, entries, derived.pivots)


def _by_residuals(material: RouteInputs, _: Candidate) -> Candidate | None:
    """Return the derivatives of constrained accelerations from those of their equations."""
    derived = material.derived
    known = [e for e in (derived.lagrange, derived.newton_euler) if e is not None]
    e = min(known, key=lambda e: len(e.tape.live([x for row in e.D for x in row])))
    width = 2 * len(derived.system.q) + len(derived.system.u)
    if e.rows is None or e.rows.switched or len(e.D) < len(e.g):
        return None
    if width * len(e.tape.live(e.balance)) > MAX_LINEARIZATION_SIZE:
        return None
    rows, pivots = linearize_constrained(derived.system, e.tape, e.D, e.balance, e.rows)
    return Candidate(e.tape, [x for row in rows for x in row], pivots)


ROUTES: Mapping[str, Route] = {
    r.name: r
    for r in (
        Route(
            "lagrange",
            "Lagrange over the program of K and P",
            lambda m: m.derived.ldl or _constrained(m.lagrange),
            lambda m: _functions(m.lagrange),
        ),
        Route("expanded", "the same, multiplied out", _expanded, _expanded_functions),
        Route("cancelled", "multiplied out again during elimination", _cancelled),
        Route(
            "articulated",
            "Newton and Euler, articulated bodies",
            lambda m: m.derived.articulated,
            solved=_by_articulated_bodies,
        ),
        Route(
            "composite",
            "Newton and Euler, D of composite bodies, L D L^T",
            lambda m: m.derived.composite or _constrained(m.derived.newton_euler),
        ),
        Route(
            "newton-euler",
            "Newton and Euler along the tree",
            functions=lambda m: _functions(m.derived.newton_euler),
        ),
        Route("rotated", "the same, multiplied out", functions=_rotated),
        Route(
            "multipliers",
            "link multipliers: the tensions of links between point masses",
            lambda m: m.derived.multipliers,
            solved=_by_multipliers,
            penalty=1.25,  # D allows massless links, which justifies 25 % more operations
        ),
        Route(
            "forward",
            "forward differentiation of the accelerations",
            linearization=_forward,
        ),
        Route(
            "tree",
            "Newton and Euler differentiated along the tree, L D L^T",
            linearization=_by_inverse_dynamics,
        ),
        Route(
            "kkt",
            "the equations with constraints differentiated, KKT matrix by L D L^T",
            linearization=_by_residuals,
        ),
    )
}


# --- selection ------------------------------------------------------------------------------------

MAX_ERROR_RATIO = 2  # a route with more than twice the rounding error of another is not used


@dataclass(frozen=True)
class Candidate:
    """One way to compute a function of the generated code, as derived by one route.

    A route is a method of derivation, such as Lagrange's or Newton and Euler's. All expressions are
    defined on the attribute `tape`, a list of elementary operations with named results.

    Attributes
    ----------
    outputs
        The results of the function.
    checks
        Pairs (pivot, diagonal entry) of a matrix factorization; every pivot must be positive.
    labels
        Names for the outputs, then for pivots and diagonal entries.
    order
        Indices of the coordinates in order of elimination.
    multipliers
        Lagrange multipliers of the constraints; for accelerations only.
    parts
        For each constraint that is active in some contact or friction modes only: the numerator and
        the denominator of its multiplier.
    calls
        Number of calls of the function that give the whole result: one for each column of a matrix
        that is given as its product with a symbolic direction.
    """

    tape: Tape
    outputs: Sequence[Expr]
    checks: Sequence[tuple[Expr, Expr]] = ()
    labels: Sequence[str] = ()
    order: tuple[int, ...] = ()
    multipliers: Sequence[Expr] = ()
    parts: Mapping[int, Sequence[Expr]] = field(default_factory=dict)
    calls: int = 1


def cheapest(name: str, system: System, routes: Mapping[str, Candidate]) -> Function:
    """Return the function with the given name, computed by the route with the fewest operations.

    A route is a method of derivation. `routes` maps the name of each route to the function that it
    gives. Routes with significantly larger rounding errors than another are excluded.
    """
    lowered = {
        way: lower(name, r.tape, r.outputs, system.names, checks=r.checks, labels=r.labels)
        for way, r in routes.items()
    }

    def rank(route: str) -> tuple[float, int]:
        size = weight(lowered[route].cost) * routes[route].calls
        return size * ROUTES[route].penalty, len(lowered[route].early)

    by_weight = sorted(lowered, key=rank)
    best, first = by_weight[0], next(iter(lowered))
    if len(lowered) > 1 and lowered[best].body != lowered[first].body:
        errors = _roundings(lowered, system)
        least = min(errors.values())
        # Without cancellation, n rounding errors add up to about sqrt(n) units of rounding.
        usual = 2.0**-52 * max(4.0, math.sqrt(len(lowered[best].body)))
        best = next(r for r in by_weight if errors[r] <= MAX_ERROR_RATIO * max(least, usual))
    costs = tuple((route, f.cost) for route, f in lowered.items())
    return replace(lowered[best], route=best, routes=costs)


def _roundings(functions: Mapping[str, Function], system: System) -> dict[str, float]:
    """Return the largest relative error of each function in doubles, at some states around the
    start.

    The error is infinite where a function fails and another does not: without masses, link
    multipliers fail where D may still be regular.
    """
    states = range(5 if all(len(f.body) < 500 for f in functions.values()) else 2)
    return largest_errors({route: _errors(f, system, states) for route, f in functions.items()})


def largest_errors(errors: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the largest error of each route at the states at which a route has a result."""
    comparable = [
        column for column in zip(*errors.values(), strict=True) if any(map(math.isfinite, column))
    ]
    return {route: max((c[k] for c in comparable), default=0.0) for k, route in enumerate(errors)}


def _errors(function: Function, system: System, states: Iterable[int]) -> list[float]:
    """Return the relative error of the results at each state; inf where there is no result."""
    in_doubles, exact, out = evaluator(function), evaluator(function, exact=True), []
    for k in states:
        values = nearby(system, k)
        values |= {x.name: 1.0 / (k + 1) for x in tangent_symbols(system).values()}
        values |= {i.name: 0.7 + 0.1 * n for n, i in enumerate(system.inputs)}
        try:
            (computed, regular), (true, _) = in_doubles(values), exact(values)
        except (ArithmeticError, ValueError):
            regular = False
        if not regular:
            out.append(math.inf)
            continue
        size = max(map(abs, true))
        difference = max(abs(a - b) for a, b in zip(computed, true, strict=True))
        out.append(difference / size if size else 0.0)
    return out


def weight(cost: Cost) -> int:
    """Return the cost of one call of a function, in units of the cost of one addition."""
    return cost.adds + cost.multiplications + 8 * cost.divisions + 25 * (cost.sincos + cost.calls)
