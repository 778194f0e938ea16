"""Reduction of operations: common factors, parameter-only terms and common subexpressions.

`ScheduleBuilder` contains the assignments of one function while they are simplified and put in
order; `reduce_operations` simplifies them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from heapq import heappop, heappush
from itertools import combinations

from sympy import Expr, S

from eomc.derive.tape import Stage, is_negative
from eomc.program.ir import Assignment, Operand, Product, Sum, Value, rename_value


class ScheduleBuilder:
    """The assignments of one function while they are simplified and put in order.

    Attributes
    ----------
    values
        The right-hand side of each name.
    stages
        The binding time (see `Stage`) of each name.
    hints
        For some of the names: a preferred name in the generated code.
    known
        The name of each right-hand side; the inverse of `values`.
    """

    def __init__(self) -> None:
        self.values: dict[str, Value] = {}
        self.stages: dict[str, Stage] = {}
        self.hints: dict[str, str] = {}
        self.known: dict[Value, str] = {}
        self.made = 0

    def new(self, value: Value) -> str:
        """Return the name of a right-hand side. If it has none, add it under a new name."""
        if value not in self.known:
            self.made += 1
            self.put(f"_n{self.made:06d}", value)
        return self.known[value]

    def put(self, name: str, value: Value) -> None:
        """Set the right-hand side `value` of a name, and its binding time."""
        old = self.values.get(name)
        if old is not None:
            if old == value:
                return
            if self.known.get(old) == name:
                del self.known[old]
        self.values[name] = value
        self.known.setdefault(value, name)
        self.stages[name] = self.stage(value)

    def stage(self, value: Value) -> Stage:
        """Return the binding time of a right-hand side: when it can be computed."""
        return max((self.stages[n] for n in value.names), default=Stage.NUMBER)

    def uses(self, ends: Iterable[Operand]) -> Counter[str]:
        """Return how often each name is read, by right-hand sides and by the results `ends`."""
        uses: Counter[str] = Counter(o.name for o in ends if o.name)
        for value in self.values.values():
            uses.update(value.names)
        return uses

    def drop(self, ends: Iterable[Operand]) -> None:
        """Remove the values that none of the results `ends` depends on."""
        needed: set[str] = set()
        queue = [o.name for o in ends if o.name]
        while queue:
            name = queue.pop()
            if name in self.values and name not in needed:
                needed.add(name)
                queue.extend(self.values[name].names)
        self.values = {n: v for n, v in self.values.items() if n in needed}
        self.known = {v: n for n, v in reversed(self.values.items())}

    def sort(self) -> None:
        """Put definitions before their uses, and update their binding times."""
        self.values = {name: self.values[name] for name in _in_order(self.values)}
        for name, value in self.values.items():
            self.stages[name] = self.stage(value)

    def assignments(self, ends: list[Operand]) -> list[Assignment]:
        """Return the assignments, sorted by binding time and without copies of other values.

        `ends` are the results of the function; names of copies in them are replaced.
        """
        aliases: dict[str, Operand] = {}
        for name, value in self.values.items():
            single: Operand | None = None
            if isinstance(value, Product) and len(value.factors) == 1:
                single = Operand(value.coefficient, value.factors[0])
            elif isinstance(value, Sum) and len(value.terms) == 1 and value.constant == 0:
                single = Operand(*value.terms[0])
            if single is not None and single.coefficient == 1:
                aliases[name] = aliases.get(single.name, single)

        def real(name: str) -> str:
            """Return the name that an alias stands for."""
            return aliases[name].name if name in aliases else name

        for name, value in list(self.values.items()):
            self.values[name] = rename_value(value, real)
        ends[:] = [Operand(o.coefficient, real(o.name)) for o in ends]
        self.hints = {real(n): h for n, h in self.hints.items()}
        for alias in aliases:
            del self.values[alias]
        self.drop(ends)
        self.sort()
        ordered = [Assignment(n, v, self.stages[n]) for n, v in self.values.items()]
        return sorted(ordered, key=lambda a: a.stage)


def _in_order(values: Mapping[str, Value]) -> list[str]:
    """Sort names topologically, otherwise in the given order."""
    sorted_names: dict[str, None] = {}
    for start in values:
        stack = [start]
        while stack:
            name = stack[-1]
            missing = [n for n in values[name].names if n in values and n not in sorted_names]
            if missing:
                stack.extend(reversed(missing))
            else:
                sorted_names.setdefault(name)
                stack.pop()
    return list(sorted_names)


# --- reduction of operations ----------------------------------------------------------------------

Term = tuple[Expr, str]  # (weight, name)
_Pair = tuple[str, str, Expr]  # (name, name, ratio of the second weight to the first)


def reduce_operations(d: ScheduleBuilder, ends: list[Operand]) -> None:
    """Rewrite the assignments of `d` so that the function needs fewer operations.

    `d` contains the assignments of one function, `ends` the results of the function. Both are
    modified in place; the values of the results stay the same except for rounding.
    """
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


def _scale(d: ScheduleBuilder, ends: list[Operand]) -> None:
    """Move numeric factors of results into products, where they may be absorbed."""
    for k, o in enumerate(ends):
        if o.name in d.values and abs(o.coefficient) != 1:
            sign = S.NegativeOne if is_negative(o.coefficient) else S.One
            ends[k] = Operand(sign, d.new(Product(abs(o.coefficient), (o.name,))))


def _absorb(d: ScheduleBuilder, ends: Iterable[Operand]) -> None:
    """Merge products that are used once into the product or sum that uses them, with
    coefficients.
    """
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


def _factor(d: ScheduleBuilder, ends: Iterable[Operand], least: Stage) -> None:
    """Replace a x + b x by (a + b) x, for x with a binding time of `least` or later.

    Only products that are used once are factored.
    """
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
        factored, other_terms = [], []
        for weight, term in value.terms:
            product = inside.get(term)
            if product is None or best not in product.factors:
                other_terms.append((weight, term))
                continue
            factors = list(product.factors)
            factors.remove(best)
            factored.append((weight * product.coefficient, tuple(factors)))
        terms, constant = [], S.Zero
        for weight, factors_left in factored:
            if not factors_left:
                constant += weight
            elif len(factors_left) == 1:
                terms.append((weight, factors_left[0]))
            else:
                sign = S.NegativeOne if is_negative(weight) else S.One
                product_name = d.new(Product(abs(weight), factors_left))
                uses[product_name] += 1
                terms.append((sign, product_name))
        bracket = Sum(tuple(terms), constant)
        inner_name = d.new(bracket)
        uses[inner_name] += 1
        if other_terms or value.constant != 0:
            product_of_bracket = d.new(Product(S.One, (best, inner_name)))
            uses[product_of_bracket] += 1
            d.put(name, Sum((*other_terms, (S.One, product_of_bracket)), value.constant))
            queue.append(name)
        else:
            d.put(name, Product(S.One, (best, inner_name)))
        queue.append(inner_name)
    d.sort()


def _hoist(d: ScheduleBuilder) -> None:
    """Give names to parameter-only parts of later sums and products, so that they are
    precomputed.
    """
    for name, value in list(d.values.items()):
        if d.stages[name] <= Stage.PARAMETER:
            continue
        if isinstance(value, Product):
            constant = [f for f in value.factors if d.stages[f] <= Stage.PARAMETER]
            sign = S.NegativeOne if is_negative(value.coefficient) else S.One
            if constant and (len(constant) > 1 or abs(value.coefficient) != 1):
                varying = [f for f in value.factors if f not in constant]
                precomputed = d.new(Product(abs(value.coefficient), tuple(sorted(constant))))
                d.put(name, Product(sign, (precomputed, *varying)))
        elif isinstance(value, Sum):
            constant_terms = [p for p in value.terms if d.stages[p[1]] <= Stage.PARAMETER]
            if len(constant_terms) > 1 or (constant_terms and value.constant != 0):
                varying_terms = [p for p in value.terms if p not in constant_terms]
                precomputed = d.new(Sum(tuple(constant_terms), value.constant))
                d.put(name, Sum(((S.One, precomputed), *varying_terms)))
    d.sort()


def _share_products(d: ScheduleBuilder) -> None:
    """Name the most frequent pair of factors, repeatedly."""
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


def _share_sums(d: ScheduleBuilder) -> None:
    """Name the most frequent pair of terms up to sign, repeatedly."""
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
    """Return the pairs of terms whose weights are 1 or -1."""
    plain = sorted((x, w) for w, x in terms if w in (S.One, S.NegativeOne))
    return {(x, y, S.One if v == w else S.NegativeOne) for (x, v), (y, w) in combinations(plain, 2)}


def _share(
    items: dict[str, list[Term]],
    define_pair: Callable[[str, str, Expr], str],
    stages: Mapping[str, Stage],
) -> None:
    """Name the pair that most items have in common, until no pair is shared."""
    index: dict[_Pair, set[str]] = {}
    heap: list[tuple[int, int, str, str, int, _Pair]] = []

    def enter(name: str) -> None:
        for pair in _pairs(items[name]):
            users = index.setdefault(pair, set())
            users.add(name)
            if len(users) > 1:
                push(pair)

    def push(pair: _Pair) -> None:
        x, y, ratio = pair
        stage = max(stages[x], stages[y])
        heappush(heap, (-len(index[pair]), stage, x, y, int(ratio), pair))

    for name in items:
        enter(name)
    while heap:
        count, *_, pair = heappop(heap)
        users = index[pair]
        if len(users) != -count:
            if len(users) > 1:
                push(pair)
            continue
        x, y, ratio = pair
        pair_name = define_pair(x, y, ratio)
        for name in sorted(users):
            terms = items[name]
            if name == pair_name:
                continue
            for other in _pairs(terms):
                index[other].discard(name)
            weight = next(w for w, n in terms if n == x)
            terms.remove((weight, x))
            terms.remove((weight * ratio, y))
            terms.append((weight, pair_name))
            enter(name)
        users.clear()
