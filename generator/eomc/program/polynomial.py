"""Expansion of expressions on a tape into polynomials, cancellation and factoring.

Derivatives along a tape keep definitions whole, which makes large systems possible, but terms that
cancel between definitions remain. For small systems, expanding them is a second route, which is
used where it needs fewer operations (program.py).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction

from sympy import Add, Expr, Mul, Pow, Rational, S, Symbol

from eomc.derive.tape import Stage, Tape, split

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
