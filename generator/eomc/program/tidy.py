"""Fewer operations: common factors out, parameters' work first, repeated pairs named once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from heapq import heappop, heappush
from itertools import combinations

from sympy import Expr, S

from eomc.derive.atoms import is_negative
from eomc.derive.tape import Stage
from eomc.program.draft import Draft
from eomc.program.ir import Operand, Product, Sum

Term = tuple[Expr, str]  # (weight, name)
_Pair = tuple[str, str, Expr]  # (name, name, weight of the second over that of the first)


def tidy(d: Draft, ends: list[Operand]) -> None:
    """Fewer operations for the same results."""
    _scale(d, ends)
    d.drop(ends)
    _absorb(d, ends)
    _factor(d, ends, Stage.TIME)
    d.drop(ends)
    _absorb(d, ends)
    _hoist(d)
    _factor(d, ends, Stage.NUMBER)
    d.drop(ends)
    _absorb(d, ends)
    _hoist(d)
    _share_products(d)
    _share_sums(d)
    d.drop(ends)


def _scale(d: Draft, ends: list[Operand]) -> None:
    """Numbers in front of results become part of a product, where they may cost nothing."""
    for k, o in enumerate(ends):
        if o.name in d.values and abs(o.coefficient) != 1:
            sign = S.NegativeOne if is_negative(o.coefficient) else S.One
            ends[k] = Operand(sign, d.new(Product(abs(o.coefficient), (o.name,))))


def _absorb(d: Draft, ends: Iterable[Operand]) -> None:
    """A product used once, by a product or a sum, goes into it; so do coefficients."""
    uses = d.uses(ends)
    for name, value in list(d.values.items()):
        if isinstance(value, Product):
            coefficient: Expr = value.coefficient
            factors: list[str] = []
            for factor in value.factors:
                inner = d.values.get(factor)
                ripe = d.stages[factor] > Stage.PARAMETER or d.stages[name] <= Stage.PARAMETER
                single = uses[factor] == 1 and factor not in d.hints
                if isinstance(inner, Product) and single and ripe:
                    coefficient *= inner.coefficient
                    factors += inner.factors
                else:
                    factors.append(factor)
            d.put(name, Product(coefficient, tuple(factors)))
        elif isinstance(value, Sum):
            terms = []
            for weight, term in value.terms:
                inner = d.values.get(term)
                single = uses[term] == 1 and term not in d.hints
                if isinstance(inner, Product) and single and abs(weight) != 1:
                    sign = S.NegativeOne if is_negative(weight) else S.One
                    d.put(term, Product(inner.coefficient * abs(weight), inner.factors))
                    weight = sign
                terms.append((weight, term))
            d.put(name, Sum(tuple(terms), value.constant))


def _factor(d: Draft, ends: Iterable[Operand], least: Stage) -> None:
    """a x + b x = (a + b) x for x known from `least` on; the products serve nothing else."""
    queue = [n for n, v in d.values.items() if isinstance(v, Sum)]
    uses = d.uses(ends)
    while queue:
        name = queue.pop()
        value = d.values[name]
        assert isinstance(value, Sum)
        inside: dict[str, Product] = {}
        for _, term in value.terms:
            inner = d.values.get(term)
            if isinstance(inner, Product) and uses[term] == 1 and term not in d.hints:
                inside[term] = inner
        counts = Counter(
            f for p in inside.values() for f in dict.fromkeys(p.factors) if d.stages[f] >= least
        )
        best = max(counts, key=lambda f: (counts[f], -d.stages[f], f), default=None)
        if best is None or counts[best] < 2:
            continue
        taken, rest = [], []
        for weight, term in value.terms:
            product = inside.get(term)
            if product is None or best not in product.factors:
                rest.append((weight, term))
                continue
            factors = list(product.factors)
            factors.remove(best)
            taken.append((weight * product.coefficient, tuple(factors)))
        terms, constant = [], S.Zero
        for weight, factors_left in taken:
            if not factors_left:
                constant += weight
            elif len(factors_left) == 1:
                terms.append((weight, factors_left[0]))
            else:
                sign = S.NegativeOne if is_negative(weight) else S.One
                made = d.new(Product(abs(weight), factors_left))
                uses[made] += 1
                terms.append((sign, made))
        bracket = Sum(tuple(terms), constant)
        inner_name = d.new(bracket)
        uses[inner_name] += 1
        if rest or value.constant != 0:
            whole = d.new(Product(S.One, (best, inner_name)))
            uses[whole] += 1
            d.put(name, Sum((*rest, (S.One, whole)), value.constant))
            queue.append(name)
        else:
            d.put(name, Product(S.One, (best, inner_name)))
        queue.append(inner_name)
    d.sort()


def _hoist(d: Draft) -> None:
    """What parameters alone decide inside a later sum or product gets a name of its own."""
    for name, value in list(d.values.items()):
        if d.stages[name] <= Stage.PARAMETER:
            continue
        if isinstance(value, Product):
            early = [f for f in value.factors if d.stages[f] <= Stage.PARAMETER]
            sign = S.NegativeOne if is_negative(value.coefficient) else S.One
            if early and (len(early) > 1 or abs(value.coefficient) != 1):
                late = [f for f in value.factors if f not in early]
                made = d.new(Product(abs(value.coefficient), tuple(sorted(early))))
                d.put(name, Product(sign, (made, *late)))
        elif isinstance(value, Sum):
            early_terms = [p for p in value.terms if d.stages[p[1]] <= Stage.PARAMETER]
            if len(early_terms) > 1 or (early_terms and value.constant != 0):
                late_terms = [p for p in value.terms if p not in early_terms]
                made = d.new(Sum(tuple(early_terms), value.constant))
                d.put(name, Sum(((S.One, made), *late_terms)))
    d.sort()


def _share_products(d: Draft) -> None:
    """The most frequent pair of factors gets a name, again and again."""
    items: dict[str, list[Term]] = {
        n: [(S.One, f) for f in v.factors]
        for n, v in d.values.items()
        if isinstance(v, Product) and len(v.factors) > 1
    }
    _share(items, lambda x, y, _: d.new(Product(S.One, (x, y))), d.stages)
    for name, terms in items.items():
        value = d.values[name]
        assert isinstance(value, Product)
        d.put(name, Product(value.coefficient, tuple(f for _, f in terms)))
    d.sort()


def _share_sums(d: Draft) -> None:
    """The most frequent pair of terms gets a name, up to a sign."""
    items: dict[str, list[Term]] = {
        n: list(v.terms)
        for n, v in d.values.items()
        if isinstance(v, Sum) and 1 < len(v.terms) <= 40
    }
    _share(items, lambda x, y, r: d.new(Sum(((S.One, x), (r, y)))), d.stages)
    for name, terms in items.items():
        value = d.values[name]
        assert isinstance(value, Sum)
        d.put(name, Sum(tuple(terms), value.constant))
    d.sort()


def _pairs(terms: Sequence[Term]) -> set[_Pair]:
    """Pairs of terms whose weights are one or minus one."""
    plain = sorted((x, w) for w, x in terms if w in (S.One, S.NegativeOne))
    return {(x, y, S.One if v == w else S.NegativeOne) for (x, v), (y, w) in combinations(plain, 2)}


def _share(
    items: dict[str, list[Term]],
    made_of: Callable[[str, str, Expr], str],
    stages: Mapping[str, Stage],
) -> None:
    """Give the pair that most items have in common a name of its own, until none is shared."""
    index: dict[_Pair, set[str]] = {}
    heap: list[tuple[int, int, str, str, int, _Pair]] = []

    def enter(name: str) -> None:
        for pair in _pairs(items[name]):
            where = index.setdefault(pair, set())
            where.add(name)
            if len(where) > 1:
                push(pair)

    def push(pair: _Pair) -> None:
        x, y, ratio = pair
        late = max(stages[x], stages[y])
        heappush(heap, (-len(index[pair]), late, x, y, int(ratio), pair))

    for name in items:
        enter(name)
    while heap:
        count, *_, pair = heappop(heap)
        where = index[pair]
        if len(where) != -count:
            if len(where) > 1:
                push(pair)
            continue
        x, y, ratio = pair
        made = made_of(x, y, ratio)
        for name in sorted(where):
            terms = items[name]
            if name == made:
                continue
            for other in _pairs(terms):
                index[other].discard(name)
            weight = next(w for w, n in terms if n == x)
            terms.remove((weight, x))
            terms.remove((weight * ratio, y))
            terms.append((weight, made))
            enter(name)
        where.clear()
