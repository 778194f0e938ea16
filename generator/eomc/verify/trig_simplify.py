"""Shorten expressions for reading: polynomials in sines, cosines and velocities.

SymPy's `trigsimp` takes minutes for long expressions. Expressions of mechanics are polynomials in
velocities whose coefficients are polynomials in sines and cosines: each coefficient is written in a
few forms, and the shortest is taken.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache

import sympy
from sympy import Expr, Symbol, cos, sin
from sympy.polys.polyerrors import PolynomialError
from sympy.polys.rings import PolyElement, sring

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
