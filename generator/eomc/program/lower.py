"""From the tape to assignments: one function, put in order.

Drops what nothing needs, takes common factors out, gives repeated sums and products one name,
does the parameters' work ahead of the rest, and names what is left for people.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from itertools import combinations

import sympy
from sympy import Expr, S, Symbol

from eomc.derive.tape import Stage, Tape, is_negative, split
from eomc.program.ir import (
    Assignment,
    Call,
    Cost,
    Function,
    Operand,
    Product,
    Sum,
    Value,
    rename,
    renamed_value,
)


def lower(
    name: str,
    tape: Tape,
    outputs: Sequence[Expr],
    checks: Sequence[tuple[Expr, Expr]],
    labels: Sequence[str],
) -> Function:
    """The function that computes `outputs`, and whose `checks` must be positive.

    labels: names for outputs, then for pivots and diagonal entries, where they have none.
    """
    ends = [*outputs, *(atom for pair in checks for atom in pair)]
    work = _Work(tape)
    for symbol in tape.live(ends):
        work.take(symbol)
    operands = [work.operand(atom) for atom in ends]
    work.tidy(operands)
    assignments = work.assignments(operands)
    for o, label in zip(operands, labels, strict=False):
        if o.coefficient == 1 and o.name in work.values:
            work.hints.setdefault(o.name, label)
    early = tuple(a for a in assignments if a.stage <= Stage.PARAMETER)
    body = tuple(a for a in assignments if a.stage > Stage.PARAMETER)
    pairs = operands[len(outputs) :]
    function = Function(
        name,
        early,
        body,
        tuple(operands[: len(outputs)]),
        tuple(zip(pairs[::2], pairs[1::2], strict=True)),
        _cost(body, operands[: len(outputs)]),
        "",
        (),
    )
    return _renamed(function, work.hints)


@dataclass
class _Work:
    """Right-hand sides of one function, while they are being put in order."""

    tape: Tape
    values: dict[str, Value] = field(default_factory=dict)
    stages: dict[str, Stage] = field(default_factory=dict)
    hints: dict[str, str] = field(default_factory=dict)
    known: dict[Value, str] = field(default_factory=dict)
    made: int = 0

    # taking over from the tape

    def take(self, symbol: Symbol) -> None:
        tape = self.tape
        if symbol in tape.weights:
            terms = tuple((w, self.leaf(name)) for name, w in tape.weights[symbol].items())
            self._put(symbol.name, Sum(terms, tape.constant[symbol]))
        elif symbol in tape.powers:
            # plain factors first, then powers, as SymPy sorts them
            powers = sorted(
                tape.powers[symbol].items(), key=lambda p: (p[1] is not S.One, p[0].name)
            )
            factors = [f for name, e in powers for f in self._power(self.operand(name), e)]
            self._put(symbol.name, self._plain(Product(S.One, tuple(factors))))
        elif (rhs := tape.rhs(symbol)).is_Mul or rhs.is_Pow:
            self._put(symbol.name, self._product(rhs))
        else:
            function = rhs.func.__name__.lower()
            args = rhs.args[:1] if function == "heaviside" else rhs.args
            if function in ("min", "max"):
                args = sorted(args, key=str)
            self._put(symbol.name, Call(function, tuple(map(self.operand, args))))
        if symbol in self.tape.hint:
            self.hints[symbol.name] = self.tape.hint[symbol]

    def operand(self, atom: Expr) -> Operand:
        factor, symbol = split(atom)
        if symbol is None:
            return Operand(factor)
        return Operand(factor, self.leaf(symbol))

    def leaf(self, symbol: Symbol) -> str:
        """The symbol's name; a leaf's stage is kept."""
        if symbol in self.tape.leaves:
            self.stages[symbol.name] = self.tape.leaves[symbol]
        return str(symbol.name)

    def _product(self, rhs: Expr) -> Value:
        coefficient: Expr = S.One
        factors: list[str] = []
        for factor in sympy.Mul.make_args(rhs):
            base, exponent = factor.as_base_exp()
            if factor.is_number:
                coefficient *= factor
            elif not (base.is_Symbol and exponent.is_number):
                args = (self.operand(base), self.operand(exponent))
                factors.append(self.new(Call("pow", args)))
            else:
                factors += self._power(self.operand(base), exponent)
        return self._plain(Product(coefficient, tuple(factors)))

    def _plain(self, product: Product) -> Value:
        """The product, or what its one factor stands for."""
        if len(product.factors) == 1 and product.coefficient == 1:
            return self.values.get(product.factors[0], product)
        return product

    def _power(self, base: Operand, exponent: Expr) -> list[str]:
        """Whole powers as repeated factors, halves by a square root, the rest by pow."""
        twice = 2 * exponent
        if not twice.is_Integer or abs(twice) > 16:
            return [self.new(Call("pow", (base, Operand(exponent))))]
        whole, half = divmod(abs(int(twice)), 2)
        if exponent > 0:
            root = [self.new(Call("sqrt", (base,)))] if half else []
            return [base.name] * whole + root
        if not half:
            return [self.new(Call("reciprocal", (base,)))] * whole
        root_of = self.new(Call("sqrt", (base,)))
        return [self.new(Call("reciprocal", (Operand(S.One, root_of),)))] * (2 * whole + 1)

    def new(self, value: Value) -> str:
        """The name of a value, made up where it has none."""
        if value not in self.known:
            self.made += 1
            self._put(f"_n{self.made:06d}", value)
        return self.known[value]

    def _put(self, name: str, value: Value) -> None:
        old = self.values.get(name)
        if old is not None:
            if old == value:
                return
            if self.known.get(old) == name:
                del self.known[old]
        self.values[name] = value
        self.known.setdefault(value, name)
        self.stages[name] = self._stage(value)

    def _stage(self, value: Value) -> Stage:
        return max((self.stages[n] for n in value.names), default=Stage.NUMBER)

    # putting in order

    def tidy(self, ends: list[Operand]) -> None:
        self._scale(ends)
        self._drop(ends)
        self._absorb(ends)
        self._factor(ends, Stage.TIME)
        self._drop(ends)
        self._absorb(ends)
        self._hoist(ends)
        self._factor(ends, Stage.NUMBER)
        self._drop(ends)
        self._absorb(ends)
        self._hoist(ends)
        self._share_products()
        self._share_sums()
        self._drop(ends)

    def _scale(self, ends: list[Operand]) -> None:
        """Numbers in front of results become part of a product, where they may cost nothing."""
        for k, o in enumerate(ends):
            if o.name in self.values and abs(o.coefficient) != 1:
                sign = S.NegativeOne if is_negative(o.coefficient) else S.One
                ends[k] = Operand(sign, self.new(Product(abs(o.coefficient), (o.name,))))

    def _uses(self, ends: Iterable[Operand]) -> Counter[str]:
        uses: Counter[str] = Counter(o.name for o in ends if o.name)
        for value in self.values.values():
            uses.update(value.names)
        return uses

    def _drop(self, ends: Iterable[Operand]) -> None:
        """Remove what no end needs; replace plain aliases by what they stand for."""
        needed: set[str] = set()
        queue = [o.name for o in ends if o.name]
        while queue:
            name = queue.pop()
            if name in self.values and name not in needed:
                needed.add(name)
                queue.extend(self.values[name].names)
        self.values = {n: v for n, v in self.values.items() if n in needed}
        self.known = {v: n for n, v in reversed(self.values.items())}

    def _absorb(self, ends: Iterable[Operand]) -> None:
        """A product used once, by a product or a sum, goes into it; so do coefficients."""
        uses = self._uses(ends)
        for name, value in list(self.values.items()):
            if isinstance(value, Product):
                coefficient: Expr = value.coefficient
                factors: list[str] = []
                for factor in value.factors:
                    inner = self.values.get(factor)
                    ripe = (
                        self.stages[factor] > Stage.PARAMETER
                        or self.stages[name] <= Stage.PARAMETER
                    )
                    single = uses[factor] == 1 and factor not in self.hints
                    if isinstance(inner, Product) and single and ripe:
                        coefficient *= inner.coefficient
                        factors += inner.factors
                    else:
                        factors.append(factor)
                self._put(name, Product(coefficient, tuple(factors)))
            elif isinstance(value, Sum):
                terms = []
                for weight, term in value.terms:
                    inner = self.values.get(term)
                    single = uses[term] == 1 and term not in self.hints
                    if isinstance(inner, Product) and single and abs(weight) != 1:
                        sign = S.NegativeOne if is_negative(weight) else S.One
                        self._put(term, Product(inner.coefficient * abs(weight), inner.factors))
                        weight = sign
                    terms.append((weight, term))
                self._put(name, Sum(tuple(terms), value.constant))

    def _factor(self, ends: Iterable[Operand], least: Stage) -> None:
        """a x + b x = (a + b) x for x known from `least` on; the products serve nothing else."""
        queue = [n for n, v in self.values.items() if isinstance(v, Sum)]
        uses = self._uses(ends)
        while queue:
            name = queue.pop()
            value = self.values[name]
            assert isinstance(value, Sum)
            inside: dict[str, Product] = {}
            for _, term in value.terms:
                inner = self.values.get(term)
                if isinstance(inner, Product) and uses[term] == 1 and term not in self.hints:
                    inside[term] = inner
            counts = Counter(
                f
                for p in inside.values()
                for f in dict.fromkeys(p.factors)
                if self.stages[f] >= least
            )
            best = max(counts, key=lambda f: (counts[f], -self.stages[f], f), default=None)
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
                    made = self.new(Product(abs(weight), factors_left))
                    uses[made] += 1
                    terms.append((sign, made))
            bracket = Sum(tuple(terms), constant)
            inner_name = self.new(bracket)
            uses[inner_name] += 1
            if rest or value.constant != 0:
                whole = self.new(Product(S.One, (best, inner_name)))
                uses[whole] += 1
                self._put(name, Sum((*rest, (S.One, whole)), value.constant))
                queue.append(name)
            else:
                self._put(name, Product(S.One, (best, inner_name)))
            queue.append(inner_name)
        self._sort()

    def _sort(self) -> None:
        """Definitions before their uses, stages anew."""
        self.values = {name: self.values[name] for name in _in_order(self.values)}
        for name, value in self.values.items():
            self.stages[name] = self._stage(value)

    def _hoist(self, ends: Iterable[Operand]) -> None:
        """What parameters alone decide inside a later sum or product gets a name of its own."""
        for name, value in list(self.values.items()):
            if self.stages[name] <= Stage.PARAMETER:
                continue
            if isinstance(value, Product):
                early = [f for f in value.factors if self.stages[f] <= Stage.PARAMETER]
                sign = S.NegativeOne if is_negative(value.coefficient) else S.One
                if early and (len(early) > 1 or abs(value.coefficient) != 1):
                    late = [f for f in value.factors if f not in early]
                    made = self.new(Product(abs(value.coefficient), tuple(sorted(early))))
                    self._put(name, Product(sign, (made, *late)))
            elif isinstance(value, Sum):
                early_terms = [p for p in value.terms if self.stages[p[1]] <= Stage.PARAMETER]
                if len(early_terms) > 1 or (early_terms and value.constant != 0):
                    late_terms = [p for p in value.terms if p not in early_terms]
                    made = self.new(Sum(tuple(early_terms), value.constant))
                    self._put(name, Sum(((S.One, made), *late_terms)))
        self._sort()

    def _share_products(self) -> None:
        """The most frequent pair of factors gets a name, again and again."""
        items: dict[str, list[Term]] = {
            n: [(S.One, f) for f in v.factors]
            for n, v in self.values.items()
            if isinstance(v, Product) and len(v.factors) > 1
        }
        _share(items, lambda x, y, _: self.new(Product(S.One, (x, y))), self.stages)
        for name, terms in items.items():
            value = self.values[name]
            assert isinstance(value, Product)
            self._put(name, Product(value.coefficient, tuple(f for _, f in terms)))
        self._sort()

    def _share_sums(self) -> None:
        """The most frequent pair of terms gets a name, up to a sign."""
        items: dict[str, list[Term]] = {
            n: list(v.terms)
            for n, v in self.values.items()
            if isinstance(v, Sum) and 1 < len(v.terms) <= 40
        }
        _share(items, lambda x, y, r: self.new(Sum(((S.One, x), (r, y)))), self.stages)
        for name, terms in items.items():
            value = self.values[name]
            assert isinstance(value, Sum)
            self._put(name, Sum(tuple(terms), value.constant))
        self._sort()

    def assignments(self, ends: list[Operand]) -> list[Assignment]:
        """The values by stage and then in order; aliases are gone."""
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
            return aliases[name].name if name in aliases else name

        for name, value in list(self.values.items()):
            self.values[name] = renamed_value(value, real)
        ends[:] = [Operand(o.coefficient, real(o.name)) for o in ends]
        self.hints = {real(n): h for n, h in self.hints.items()}
        for alias in aliases:
            del self.values[alias]
        self._drop(ends)
        self._sort()
        ordered = [Assignment(n, v, self.stages[n]) for n, v in self.values.items()]
        return sorted(ordered, key=lambda a: a.stage)


def _as_sympy_sorts(power: tuple[Symbol, Expr]) -> tuple[bool, str]:
    """Plain factors first, then powers."""
    name, exponent = power
    return exponent is not S.One, name.name


Term = tuple[Expr, str]  # (weight, name)
_Pair = tuple[str, str, Expr]  # (name, name, weight of the second over that of the first)


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


def _in_order(values: Mapping[str, Value]) -> list[str]:
    """Names so that each stands after those it is made of, otherwise as they came."""
    done: dict[str, None] = {}
    for start in values:
        stack = [start]
        while stack:
            name = stack[-1]
            missing = [n for n in values[name].names if n in values and n not in done]
            if missing:
                stack.extend(reversed(missing))
            else:
                done.setdefault(name)
                stack.pop()
    return list(done)


def _cost(body: Sequence[Assignment], outputs: Sequence[Operand]) -> Cost:
    adds = muls = divs = calls = 0
    angles = set()
    for a in body:
        v = a.value
        if isinstance(v, Sum):
            adds += len(v.terms) - (v.constant == 0)
            muls += sum(abs(w) != 1 for w, _ in v.terms)
        elif isinstance(v, Product):
            muls += len(v.factors) - 1 + (abs(v.coefficient) != 1)
        elif v.function == "reciprocal":
            divs += 1
        elif v.function in ("sin", "cos"):
            angles.add(v.args)
        else:
            calls += 1
    muls += sum(abs(o.coefficient) != 1 for o in outputs if o.name)
    return Cost(adds, muls, divs, len(angles), calls)


# --- names ----------------------------------------------------------------------------------------


def _renamed(function: Function, hints: Mapping[str, str]) -> Function:
    """Names for people: those of the scene, sin_theta and the like, w1, w2, ... for the rest."""
    assigned: dict[str, str] = {}
    taken = set(function.uses)

    def give(name: str, wish: str) -> None:
        used = wish
        while used in taken:
            used += "_"
        taken.add(used)
        assigned[name] = used

    everything = (*function.early, *function.body)
    for a in everything:
        if a.name in hints:
            give(a.name, hints[a.name])
    count = 0
    plain: set[str] = set()  # names that say nothing
    for a in everything:
        if a.name in assigned:
            continue
        wish = ""
        if isinstance(a.value, Call) and len(a.value.args) == 1:
            arg = a.value.args[0]
            inner = assigned.get(arg.name, arg.name)
            if arg.coefficient == 1 and inner not in plain:
                wish = {"reciprocal": f"inv_{inner}"}.get(
                    a.value.function, f"{a.value.function}_{inner}"
                )
            elif len(parts := _leaves(function, arg)) > 1:
                wish = f"{a.value.function}_{'_'.join(parts)}"
        if not wish:
            count += 1
            wish = f"w{count}"
            plain.add(wish)
        give(a.name, wish)

    told = {name for name, used in assigned.items() if used.rstrip("_") not in plain}
    marked = replace(
        function,
        early=tuple(replace(a, named=a.name in told) for a in function.early),
        body=tuple(replace(a, named=a.name in told) for a in function.body),
    )
    return rename(marked, assigned)


def _leaves(function: Function, arg: Operand) -> tuple[str, ...]:
    """The names in a sum of two or three, for sin_q1_q2; nothing where the argument is more."""
    for a in (*function.early, *function.body):
        if a.name == arg.name and isinstance(a.value, Sum) and len(a.value.terms) <= 3:
            names = a.value.names
            return () if any(n.startswith("_") for n in names) else names
    return ()
