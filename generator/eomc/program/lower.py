"""Lowering from a tape to the intermediate representation: simplify, count and name values."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
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
    rename_value,
)


def lower(
    name: str,
    tape: Tape,
    outputs: Sequence[Expr],
    reserved: frozenset[str] = frozenset(),
    *,
    checks: Sequence[tuple[Expr, Expr]] = (),
    labels: Sequence[str] = (),
) -> Function:
    """Return a function of the generated code, as the list of assignments that compute its results.

    Parameters
    ----------
    name
        Name of the function.
    tape
        The elementary operations from which the assignments are made.
    outputs
        The results: numbers, names on the tape, or numbers times names.
    reserved
        Names that no value may have. Names that the function does not read are included, since
        values of several functions may be members of the same struct as parameters.
    checks
        Pairs (pivot, diagonal entry), in the form of `outputs`. The function fails unless all
        pivots are positive.
    labels
        Preferred names for the outputs, then for pivots and diagonal entries. They are used for
        values that have no name in the scene.
    """
    ends = [*outputs, *(atom for pair in checks for atom in pair)]
    work = _Schedule(tape)
    for symbol in tape.live(ends):
        work.take(symbol)
    operands = [work.operand(atom) for atom in ends]
    _reduce_operations(work, operands)
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
    return _renamed(function, work.hints, reserved)


class _Schedule:
    """The assignments of one function while they are read, simplified and put in order.

    Attributes
    ----------
    tape
        The named operations from which the assignments are read.
    values
        The right-hand side of each name.
    stages
        The binding time (see `Stage`) of each name.
    hints
        For some of the names: a preferred name in the generated code.
    known
        The name of each right-hand side; the inverse of `values`.
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
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

    def take(self, symbol: Symbol) -> None:
        """Add the definition of a name on the tape to the assignments."""
        tape = self.tape
        if symbol in tape.weights:
            terms = tuple((w, self.leaf(name)) for name, w in tape.weights[symbol].items())
            self.put(symbol.name, Sum(terms, tape.constant[symbol]))
        elif symbol in tape.powers:
            # factors without exponent first, then powers, as SymPy sorts them
            powers = sorted(
                tape.powers[symbol].items(), key=lambda p: (p[1] is not S.One, p[0].name)
            )
            factors = [f for name, e in powers for f in self._power(self.operand(name), e)]
            self.put(symbol.name, self._plain(Product(S.One, tuple(factors))))
        elif (rhs := tape.rhs(symbol)).is_Mul or rhs.is_Pow:
            self.put(symbol.name, self._product(rhs))
        else:
            function = rhs.func.__name__.lower()
            args = rhs.args[:1] if function == "heaviside" else rhs.args
            if function in ("min", "max"):
                args = sorted(args, key=str)
            self.put(symbol.name, Call(function, tuple(map(self.operand, args))))
        if symbol in self.tape.hint:
            self.hints[symbol.name] = self.tape.hint[symbol]

    def operand(self, atom: Expr) -> Operand:
        """Return an atom of the tape (number times name) as an operand."""
        factor, symbol = split(atom)
        if symbol is None:
            return Operand(factor)
        return Operand(factor, self.leaf(symbol))

    def leaf(self, symbol: Symbol) -> str:
        """Return the name of a symbol; if it has no definition, also record its binding time."""
        if symbol in self.tape.leaves:
            self.stages[symbol.name] = self.tape.leaves[symbol]
        return str(symbol.name)

    def _product(self, rhs: Expr) -> Value:
        """Return the value of a product of powers."""
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
        """Return the product, or the definition of its only factor."""
        if len(product.factors) == 1 and product.coefficient == 1:
            return self.values.get(product.factors[0], product)
        return product

    def _power(self, base: Operand, exponent: Expr) -> list[str]:
        """Return factors of a power: repeated for integers, a square root for halves, else a call
        of pow.
        """
        doubled = 2 * exponent
        if not doubled.is_Integer or abs(doubled) > 16:
            return [self.new(Call("pow", (base, Operand(exponent))))]
        whole, half = divmod(abs(int(doubled)), 2)
        if exponent > 0:
            root = [self.new(Call("sqrt", (base,)))] if half else []
            return [base.name] * whole + root
        if not half:
            return [self.new(Call("reciprocal", (base,)))] * whole
        root_ = self.new(Call("sqrt", (base,)))
        return [self.new(Call("reciprocal", (Operand(S.One, root_),)))] * (2 * whole + 1)


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


def _cost(body: Sequence[Assignment], outputs: Sequence[Operand]) -> Cost:
    """Count the operations of assignments and outputs."""
    adds = muls = divs = calls = 0
    angles = set()
    for a in body:
        v = a.value
        if isinstance(v, Sum):
            adds += len(v.terms) - (v.constant == 0)
            muls += sum(abs(w) != 1 for w, _ in v.terms)
        elif isinstance(v, Product):
            muls += len(v.factors) - 1 + (abs(v.coefficient) != 1)
        elif v.function in ("reciprocal", "pivot_inverse"):
            divs += 1
        elif v.function in ("sin", "cos"):
            angles.add(v.args)
        else:
            calls += 1
    muls += sum(abs(o.coefficient) != 1 for o in outputs if o.name)
    return Cost(adds, muls, divs, len(angles), calls)


# --- reduction of operations ----------------------------------------------------------------------

Term = tuple[Expr, str]  # (weight, name)
_Pair = tuple[str, str, Expr]  # (name, name, ratio of the second weight to the first)


def _reduce_operations(d: _Schedule, ends: list[Operand]) -> None:
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


def _scale(d: _Schedule, ends: list[Operand]) -> None:
    """Move numeric factors of results into products, where they may be absorbed."""
    for k, o in enumerate(ends):
        if o.name in d.values and abs(o.coefficient) != 1:
            sign = S.NegativeOne if is_negative(o.coefficient) else S.One
            ends[k] = Operand(sign, d.new(Product(abs(o.coefficient), (o.name,))))


def _absorb(d: _Schedule, ends: Iterable[Operand]) -> None:
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


def _factor(d: _Schedule, ends: Iterable[Operand], least: Stage) -> None:
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


def _hoist(d: _Schedule) -> None:
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


def _share_products(d: _Schedule) -> None:
    """Name the most frequent pair of factors, repeatedly."""
    items: dict[str, list[Term]] = {
        n: [(S.One, f) for f in v.factors]
        for n, v in d.values.items()
        if isinstance(v, Product) and len(v.factors) > 1
    }
    _share(items, lambda x, y, _: d.new(Product(S.One, (x, y))), d)


def _share_sums(d: _Schedule) -> None:
    """Name the most frequent pair of terms up to sign, repeatedly."""
    items: dict[str, list[Term]] = {
        n: list(v.terms)
        for n, v in d.values.items()
        if isinstance(v, Sum) and 1 < len(v.terms) <= 40
    }
    _share(items, lambda x, y, r: d.new(Sum(((S.One, x), (r, y)))), d)


def _pairs(terms: Sequence[Term]) -> set[_Pair]:
    """Return the pairs of terms whose weights are 1 or -1."""
    plain = sorted((x, w) for w, x in terms if w in (S.One, S.NegativeOne))
    return {(x, y, S.One if v == w else S.NegativeOne) for (x, v), (y, w) in combinations(plain, 2)}


def _share(
    items: dict[str, list[Term]],
    define_pair: Callable[[str, str, Expr], str],
    d: _Schedule,
) -> None:
    """Name the pair that most items have in common, until no pair is shared; rewrite the items."""
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
        stage = max(d.stages[x], d.stages[y])
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
    for name, terms in items.items():
        value = d.values[name]
        if isinstance(value, Product):
            d.put(name, Product(value.coefficient, tuple(f for _, f in terms)))
        elif isinstance(value, Sum):
            d.put(name, Sum(tuple(terms), value.constant))
    d.sort()


# --- names ----------------------------------------------------------------------------------------


def _renamed(function: Function, hints: Mapping[str, str], reserved: frozenset[str]) -> Function:
    """Give readable names to values: those of the scene, sin_theta and the like, else w1, w2,
    ...
    """
    assigned: dict[str, str] = {}
    used_names = {*function.uses, *reserved}

    def assign_name(name: str, preferred: str) -> None:
        """Give a value the preferred name, with "_", "_2", "_3", ... appended if it is in use."""
        preferred = re.sub("__+", "_", preferred)
        stem, name_, number = preferred.rstrip("_"), preferred, 1
        while name_ in used_names:
            name_ = f"{stem}_{number}" if number > 1 else f"{stem}_"
            number += 1
        used_names.add(name_)
        assigned[name] = name_

    assignments = (*function.early, *function.body)
    for a in assignments:
        if a.name in hints:
            assign_name(a.name, hints[a.name])
    count = 0
    plain: set[str] = set()  # names without a meaning
    for a in assignments:
        if a.name in assigned:
            continue
        preferred = ""
        if isinstance(a.value, Call) and len(a.value.args) == 1:
            arg = a.value.args[0]
            inner = assigned.get(arg.name, arg.name)
            if arg.coefficient == 1 and inner not in plain:
                preferred = {"reciprocal": f"inv_{inner}"}.get(
                    a.value.function, f"{a.value.function}_{inner}"
                )
            elif len(parts := _leaves(function, arg)) > 1:
                preferred = f"{a.value.function}_{'_'.join(parts)}"
        if not preferred:
            count += 1
            preferred = f"w{count}"
            plain.add(preferred)
        assign_name(a.name, preferred)

    meaningful = {name for name, name_ in assigned.items() if name_.rstrip("_") not in plain}
    marked = replace(
        function,
        early=tuple(replace(a, named=a.name in meaningful) for a in function.early),
        body=tuple(replace(a, named=a.name in meaningful) for a in function.body),
    )
    return rename(marked, assigned)


def _leaves(function: Function, arg: Operand) -> tuple[str, ...]:
    """Return the names in a sum of two or three terms, for sin_q1_q2; () for other arguments."""
    for a in (*function.early, *function.body):
        if a.name == arg.name and isinstance(a.value, Sum) and len(a.value.terms) <= 3:
            names = a.value.names
            return () if any(n.startswith("_") for n in names) else names
    return ()
