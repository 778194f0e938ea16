"""Sums and products on a tape, multiplied out, cancelled and factored again.

A sweep keeps definitions whole, which is what makes large systems possible, but terms that
cancel between definitions stay. For small systems it pays to multiply out: this is the second
route, taken where it counts fewer operations (program.py).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction

from sympy import Add, Expr, Mul, Pow, Rational, S, Symbol

from eomc.derive.atoms import split
from eomc.derive.tape import Stage, Tape

Exponent = int | Fraction  # whole ones are ints, of which the hash is quick
Monomial = tuple[tuple[str, Exponent], ...]  # sorted by name
Polynomial = dict[Monomial, Expr]

MOST_TERMS = 64  # of one polynomial
MOST_IN_ALL = 160  # of the outputs of one function
MOST_EXPONENT = 2**20
MOST_BITS = 900  # of a coefficient: a double holds it
MOST_ON_THE_WAY = 8 * MOST_TERMS  # before terms have cancelled


class TooLargeError(Exception):
    """The polynomial has more terms than the limit: not worth multiplying out."""


class Expander:
    """Multiplies out what stands on a tape; what it has found once serves every function."""

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self.known: dict[Symbol, Polynomial] = {}
        self.large: set[Symbol] = set()
        self.symbols: dict[str, Symbol] = {}

    def expand(self, outputs: Sequence[Expr]) -> list[Expr] | None:
        """The outputs as polynomials in leaves and functions; None where they grow too large.

        sin^2 + cos^2 = 1 is used wherever it shortens a sum.
        """
        try:
            polynomials = [self.atom(output) for output in outputs]
        except TooLargeError:
            return None
        if sum(map(len, polynomials)) > MOST_IN_ALL:
            return None
        return [self.built(polynomial) for polynomial in polynomials]

    def short(self, atom: Expr) -> Expr:
        """The atom multiplied out where that leaves few terms, so that cancellations are seen."""
        if (out := self.expand([atom])) is not None and len(self.atom(atom)) <= 8:
            return out[0]
        return atom

    def atom(self, atom: Expr) -> Polynomial:
        """The polynomial of what `Tape.define` returned."""
        factor, symbol = split(atom)
        if symbol is None:
            return {(): factor} if factor != 0 else {}
        return {m: factor * c for m, c in self.symbol(symbol).items()}

    def symbol(self, symbol: Symbol) -> Polynomial:
        """The polynomial of a name. Raises TooLargeError."""
        if symbol not in self.known:
            live = self.tape.live([symbol])
            if not self.large.isdisjoint(live):
                raise TooLargeError
            for name in live:  # in order, so that nothing recurses deeply
                if name not in self.known:
                    try:
                        self.known[name] = self._reduced(self._of(name))
                    except TooLargeError:
                        self.large.add(name)
                        raise
            self.known.setdefault(symbol, self._whole(symbol))
        return self.known[symbol]

    def _whole(self, symbol: Symbol) -> Polynomial:
        self.symbols[symbol.name] = symbol
        return {((symbol.name, 1),): S.One}

    def _of(self, name: Symbol) -> Polynomial:
        rhs = self.tape.rhs(name)
        named = name in self.tape.hint and self.tape.stage[name] <= Stage.PARAMETER
        if named or not (rhs.is_Add or rhs.is_Mul or rhs.is_Pow):
            return self._whole(name)
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
                return self._whole(name)
            elif exponent.is_Integer and exponent > 0 and len(self.symbol(base)) != 1:
                if exponent > MOST_TERMS:
                    raise TooLargeError
                for _ in range(int(exponent)):
                    out = self._times(out, self.symbol(base))
            else:
                out = self._times(out, self._power(base, exponent))
        return out

    def _power(self, base: Symbol, exponent: Expr) -> Polynomial:
        """A power that is not a whole positive one: spread over a product, kept on a sum."""
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

    def _times(self, one: Polynomial, other: Polynomial) -> Polynomial:
        if len(one) * len(other) > MOST_ON_THE_WAY:
            raise TooLargeError
        out: Polynomial = {}
        for m1, c1 in one.items():
            for m2, c2 in other.items():
                powers = dict(m1)
                for n, e in m2:
                    powers[n] = powers.get(n, 0) + e
                key = _monomial(powers)
                out[key] = out.get(key, S.Zero) + c1 * c2
        return _bounded({m: c for m, c in out.items() if c != 0})

    def _reduced(self, polynomial: Polynomial) -> Polynomial:
        """With sin^2 = 1 - cos^2, and back again where that leaves a - a cos^2."""
        squared = {n for m in polynomial for n, e in m if e >= 2 and e.denominator == 1}
        for name in sorted(squared):
            twin = self.tape.squares.get(self.symbols[name])
            if twin is not None:
                self.symbols[twin.name] = twin
                sine = self.tape.is_sine(self.symbols[name])
                pair = (name, twin.name) if sine else (twin.name, name)
                polynomial = _with_square(_without_square(polynomial, *pair), *pair)
        if len(polynomial) > MOST_TERMS:
            raise TooLargeError
        return polynomial

    # --- back on the tape ------------------------------------------------------------------------

    def built(self, polynomial: Polynomial) -> Expr:
        """The polynomial on the tape, parameters collected, common factors taken out."""
        late: dict[Monomial, list[Expr]] = {}
        for monomial, c in polynomial.items():
            early = [p for p in monomial if self._stage(p[0]) <= Stage.PARAMETER]
            rest = tuple(p for p in monomial if p not in early)
            late.setdefault(rest, []).append(c * self._expr(early))
        return self._factored({m: self.tape.define(Add(*cs)) for m, cs in late.items()})

    def _stage(self, name: str) -> Stage:
        return self.tape.stage[self.symbols[name]]

    def _expr(self, powers: Iterable[tuple[str, Exponent]]) -> Expr:
        return Mul(*(Pow(self.symbols[n], Rational(e.numerator, e.denominator)) for n, e in powers))

    def _factored(self, terms: Mapping[Monomial, Expr]) -> Expr:
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
    """The polynomial. Raises TooLargeError where numbers or exponents have grown long."""
    for monomial, c in polynomial.items():
        _short(c)
        if any(abs(e.numerator) > MOST_EXPONENT for _, e in monomial):
            raise TooLargeError
    return polynomial


def _short(number: Expr, power: Exponent = 1) -> None:
    """Raises TooLargeError where a power of the number would be long."""
    if number.is_Rational and (number.p.bit_length() + number.q.bit_length()) * power > MOST_BITS:
        raise TooLargeError


def _shifted(monomial: Monomial, by: Mapping[str, int]) -> Monomial:
    """The monomial with other exponents."""
    powers = dict(monomial)
    for name, e in by.items():
        powers[name] = powers.get(name, 0) + e
    return _monomial(powers)


def _monomial(powers: Mapping[str, Exponent]) -> Monomial:
    return tuple(sorted((n, e) for n, e in powers.items() if e))


def _without_square(polynomial: Polynomial, sine: str, cosine: str) -> Polynomial:
    """sin^2 -> 1 - cos^2. Raises TooLargeError: each pair of powers may double what is there."""
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
        if len(polynomial) > MOST_ON_THE_WAY:
            raise TooLargeError


def _with_square(polynomial: Polynomial, sine: str, cosine: str) -> Polynomial:
    """a - a cos^2 -> a sin^2"""
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
