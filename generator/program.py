"""Functions as short lists of assignments, with what they share, when they run, what they cost.

Takes the equations off the tape: drops what nothing needs, takes common factors out, gives
repeated sums and products one name, and does the parameters' work ahead of the rest. Where
equations are had by more than one route, the one with the fewest operations is kept.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from itertools import combinations

import sympy
from sympy import Expr, S, Symbol

from eomc import mechanics
from eomc.expand import Expander
from eomc.mechanics import Equations
from eomc.problems import EomcError, Problem
from eomc.system import System, t
from eomc.tape import Stage, Tape, split

# --- what a program is --------------------------------------------------------------------------


@dataclass(frozen=True)
class Sum:
    """sum of coefficient times name, plus a constant."""

    terms: tuple[tuple[Expr, str], ...]
    constant: Expr = S.Zero


@dataclass(frozen=True)
class Product:
    """coefficient times a product of names, repeated for whole powers."""

    coefficient: Expr
    factors: tuple[str, ...]


@dataclass(frozen=True)
class Call:
    """A function of atoms: "reciprocal", "sqrt", "pow" or one of the scene's functions."""

    function: str
    args: tuple[Operand, ...]


@dataclass(frozen=True)
class Operand:
    """A number times a name; the name is empty for a number alone."""

    coefficient: Expr
    name: str = ""


Value = Sum | Product | Call


@dataclass(frozen=True)
class Assignment:
    """name = value, known from `stage` on; `named` where the name tells what it is."""

    name: str
    value: Value
    stage: Stage
    named: bool = False


@dataclass(frozen=True)
class Cost:
    """Operations of one call, those that depend on parameters alone left out."""

    adds: int = 0
    multiplications: int = 0
    divisions: int = 0
    sincos: int = 0
    calls: int = 0  # square roots and other functions of the mathematics library

    @property
    def flops(self) -> int:
        """Additions, multiplications and divisions."""
        return self.adds + self.multiplications + self.divisions

    def __str__(self) -> str:
        parts = [
            (self.adds, "addition"),
            (self.multiplications, "multiplication"),
            (self.divisions, "division"),
            (self.sincos, "sincos"),
            (self.calls, "other call"),
        ]
        told = [f"{n} {what}{'s' if n > 1 and what != 'sincos' else ''}" for n, what in parts if n]
        return ", ".join(told) or "no arithmetic"


@dataclass(frozen=True)
class Function:
    """One function of the generated code.

    `early` hangs on parameters alone, `body` on the rest; `outputs` are the results, row-major
    where they are a matrix. `checks` are (pivot, diagonal) pairs that must be positive.
    """

    name: str
    early: tuple[Assignment, ...]
    body: tuple[Assignment, ...]
    outputs: tuple[Operand, ...]
    checks: tuple[tuple[Operand, Operand], ...]
    cost: Cost
    route: str
    routes: tuple[tuple[str, Cost], ...]

    @property
    def uses(self) -> frozenset[str]:
        """Every name that the function reads."""
        made = {a.name for a in (*self.early, *self.body)}
        read = {n for a in (*self.early, *self.body) for n in names_of(a.value)}
        ends = [*self.outputs, *(o for pair in self.checks for o in pair)]
        return frozenset(read | {o.name for o in ends if o.name}) - made


@dataclass(frozen=True)
class Program:
    """Everything that the generated code computes."""

    system: System
    functions: Mapping[str, Function]
    notes: tuple[str, ...]
    order: tuple[int, ...]

    def __getitem__(self, name: str) -> Function:
        return self.functions[name]

    def __contains__(self, name: str) -> bool:
        return name in self.functions


def names_of(value: Value) -> tuple[str, ...]:
    """The names on a right-hand side, repeated as often as they stand there."""
    if isinstance(value, Sum):
        return tuple(n for _, n in value.terms)
    if isinstance(value, Product):
        return value.factors
    return tuple(a.name for a in value.args if a.name)


# --- from equations to a program ------------------------------------------------------------------


def build(equations: Equations) -> Program:
    """The program of the equations: each function by its cheapest route."""
    e, tape = equations, equations.tape
    wanted: dict[str, list[Expr]] = {
        "D": [entry for row in e.D for entry in row],
        "C": [entry for row in e.C for entry in row],
        "g": list(e.g),
        "bias": list(e.bias),
        "tau": list(e.tau),
        "kinetic_energy": [e.kinetic],
        "potential_energy": [e.potential],
        "energy": [tape.define(e.kinetic + e.potential)],
    }
    if e.jacobi is not None:
        wanted["jacobi"] = [e.jacobi]
    if e.power != 0:
        wanted["power"] = [e.power]
    if e.signals:
        wanted["signal"] = list(e.signals)
    expander = Expander(tape)
    functions: dict[str, Function] = {}
    for name, outputs in wanted.items():
        routes: dict[str, Ends] = {"program": (outputs, ())}
        if (short := expander.expand(outputs)) is not None:
            routes["expanded"] = (short, ())
        functions[name] = _cheapest(name, tape, routes)
    labels = [f"{c.name}_ddot" for c in e.system.coordinates]
    labels += [f"{what}_{e.system.coordinates[k].name}" for k in e.order for what in ("d", "D")]
    routes = _acceleration_routes(e, expander)
    functions["acceleration"] = _cheapest("acceleration", tape, routes, labels)
    if all(o.coefficient == 0 for o in functions["tau"].outputs):
        del functions["tau"]
    return Program(e.system, functions, e.notes, e.order)


Ends = tuple[Sequence[Expr], Sequence[tuple[Expr, Expr]]]


def _acceleration_routes(e: Equations, expander: Expander) -> dict[str, Ends]:
    routes: dict[str, Ends] = {"program": (e.acceleration, e.pivots)}
    n = len(e.bias)
    lower = [(i, j) for i in range(n) for j in range(i + 1)]
    both = expander.expand([*(e.D[i][j] for i, j in lower), *e.balance])
    if both is not None:
        entries = dict(zip(lower, both, strict=False))
        D = tuple(tuple(entries[max(i, j), min(i, j)] for j in range(n)) for i in range(n))
        for route, short in (("expanded", lambda atom: atom), ("cancelled", expander.short)):
            _, acceleration, pivots = mechanics.solve(e.tape, D, both[len(lower) :], short)
            routes[route] = (acceleration, pivots)
    return routes


def _cheapest(
    name: str, tape: Tape, routes: Mapping[str, Ends], labels: Sequence[str] = ()
) -> Function:
    made = {route: _lower(name, tape, *ends, labels) for route, ends in routes.items()}
    weight: Callable[[str], tuple[int, int]] = lambda route: (  # noqa: E731 - a key, used once
        _weight(made[route].cost),
        len(made[route].early),
    )
    best = min(made, key=weight)
    costs = tuple((route, f.cost) for route, f in made.items())
    return replace(made[best], route=best, routes=costs)


def _weight(cost: Cost) -> int:
    return cost.adds + cost.multiplications + 8 * cost.divisions + 25 * (cost.sincos + cost.calls)


# --- lowering -------------------------------------------------------------------------------------


def _lower(
    name: str,
    tape: Tape,
    outputs: Sequence[Expr],
    checks: Sequence[tuple[Expr, Expr]],
    labels: Sequence[str],
) -> Function:
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
        rhs = self.tape.rhs[symbol]
        if rhs.is_Add:
            constant = Sum((), sum((a for a in rhs.args if a.is_number), S.Zero)).constant
            terms = tuple((o.coefficient, o.name) for o in map(self.operand, rhs.args) if o.name)
            self._put(symbol.name, Sum(terms, constant))
        elif rhs.is_Mul or rhs.is_Pow:
            self._put(symbol.name, self._product(rhs, symbol.name))
        else:
            function = rhs.func.__name__.lower()
            function = {"heaviside": "heaviside"}.get(function, function)
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
        if symbol in self.tape.leaves:
            self.stages[symbol.name] = self.tape.leaves[symbol]
        return Operand(factor, symbol.name)

    def _product(self, rhs: Expr, name: str) -> Value:
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
        if len(factors) == 1 and coefficient == 1 and factors[0] in self.values:
            return self.values[factors[0]]
        return Product(coefficient, tuple(factors))

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
        if old is not None and self.known.get(old) == name:
            del self.known[old]
        self.values[name] = value
        self.known.setdefault(value, name)
        self.stages[name] = max((self.stages[n] for n in names_of(value)), default=Stage.NUMBER)

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
                sign = S.NegativeOne if o.coefficient.is_negative else S.One
                ends[k] = Operand(sign, self.new(Product(abs(o.coefficient), (o.name,))))

    def _uses(self, ends: Iterable[Operand]) -> Counter[str]:
        uses: Counter[str] = Counter(o.name for o in ends if o.name)
        for value in self.values.values():
            uses.update(names_of(value))
        return uses

    def _drop(self, ends: Iterable[Operand]) -> None:
        """Remove what no end needs; replace plain aliases by what they stand for."""
        needed: set[str] = set()
        queue = [o.name for o in ends if o.name]
        while queue:
            name = queue.pop()
            if name in self.values and name not in needed:
                needed.add(name)
                queue.extend(names_of(self.values[name]))
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
                        sign = S.NegativeOne if weight.is_negative else S.One
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
                    sign = S.NegativeOne if weight.is_negative else S.One
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
        values, self.values = self.values, {}
        for name in _in_order(values):
            self._put(name, values[name])

    def _hoist(self, ends: Iterable[Operand]) -> None:
        """What parameters alone decide inside a later sum or product gets a name of its own."""
        for name, value in list(self.values.items()):
            if self.stages[name] <= Stage.PARAMETER:
                continue
            if isinstance(value, Product):
                early = [f for f in value.factors if self.stages[f] <= Stage.PARAMETER]
                sign = S.NegativeOne if value.coefficient.is_negative else S.One
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
            self.values[name] = _renamed_value(value, real)
        ends[:] = [Operand(o.coefficient, real(o.name)) for o in ends]
        self.hints = {real(n): h for n, h in self.hints.items()}
        for alias in aliases:
            del self.values[alias]
        self._drop(ends)
        self._sort()
        ordered = [Assignment(n, v, self.stages[n]) for n, v in self.values.items()]
        return sorted(ordered, key=lambda a: a.stage)


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
            missing = [n for n in names_of(values[name]) if n in values and n not in done]
            if missing:
                stack.extend(reversed(missing))
            else:
                done.setdefault(name)
                stack.pop()
    return list(done)


def _renamed_value(value: Value, real: Callable[[str], str]) -> Value:
    if isinstance(value, Sum):
        return Sum(tuple((w, real(n)) for w, n in value.terms), value.constant)
    if isinstance(value, Product):
        return Product(value.coefficient, tuple(real(n) for n in value.factors))
    return Call(
        value.function, tuple(replace(a, name=real(a.name)) if a.name else a for a in value.args)
    )


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
            names = names_of(a.value)
            return () if any(n.startswith("_") for n in names) else names
    return ()


def rename(function: Function, new: Mapping[str, str]) -> Function:
    """The function with other names for some of its values."""

    def real(name: str) -> str:
        return new.get(name, name)

    def operand(o: Operand) -> Operand:
        return replace(o, name=real(o.name)) if o.name else o

    def renamed(items: Iterable[Assignment]) -> tuple[Assignment, ...]:
        return tuple(
            replace(a, name=real(a.name), value=_renamed_value(a.value, real)) for a in items
        )

    return replace(
        function,
        early=renamed(function.early),
        body=renamed(function.body),
        outputs=tuple(map(operand, function.outputs)),
        checks=tuple((operand(a), operand(b)) for a, b in function.checks),
    )


# --- evaluation in Python -----------------------------------------------------------------------

_PYTHON: Mapping[str, Callable[..., float]] = {
    **{n: getattr(math, n) for n in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")},
    **{n: getattr(math, n) for n in ("sinh", "cosh", "tanh", "exp", "log", "sqrt", "pow")},
    "abs": abs,
    "sign": lambda x: float((x > 0) - (x < 0)),
    "heaviside": lambda x: 0.5 + 0.5 * ((x > 0) - (x < 0)),
    "min": min,
    "max": max,
    "reciprocal": lambda x: 1 / x,
}


def evaluate(function: Function, values: Mapping[str, float]) -> tuple[list[float], bool]:
    """The results of a function, and whether every pivot is positive; all in Python floats.

    values: coordinates, velocities, parameters, inputs and t by name. Raises ArithmeticError or
    ValueError where a result is not a finite number.
    """
    known = dict(values)

    def operand(o: Operand) -> float:
        return float(o.coefficient) * (known[o.name] if o.name else 1.0)

    for a in (*function.early, *function.body):
        v = a.value
        if isinstance(v, Sum):
            known[a.name] = float(v.constant) + sum(float(w) * known[n] for w, n in v.terms)
        elif isinstance(v, Product):
            known[a.name] = float(v.coefficient) * math.prod(known[n] for n in v.factors)
        else:
            known[a.name] = _PYTHON[v.function](*map(operand, v.args))
    results = [operand(o) for o in function.outputs]
    if not all(map(math.isfinite, results)):
        raise ValueError(f"{function.name} is not finite")
    tolerance = 8 * 2.0**-52 * max(1, len(function.checks))
    return results, all(
        operand(pivot) > (0 if pivot == diagonal else tolerance * operand(diagonal))
        for pivot, diagonal in function.checks
    )


def inertia(program: Program) -> list[Problem]:
    """A warning where D is not positive definite at the start.

    Raises EomcError where it is so at states around the start as well: no motion can be computed.
    """
    s = program.system
    weak = _without_inertia(program, 0)
    if weak is None:
        return []
    key = "energy.kinetic"
    if all(_without_inertia(program, k) is not None for k in range(1, 6)):
        raise EomcError(
            f"{s.file or s.name}: {key}: D is not positive definite: '{weak}' has no inertia of its "
            "own. Give it a mass, or leave out a coordinate that others determine"
        )
    message = (
        f"D is not positive definite at the start, '{weak}' has no inertia there: "
        "start elsewhere, or choose coordinates that are regular there"
    )
    return [Problem(message, key, s.file, severity="warning")]


def nearby(system: System, k: int) -> dict[str, float]:
    """Values by name of the k-th of some states around the start (0: the start itself)."""
    out = {p.name: p.value for p in system.parameters} | {TIME: 0.0}
    for i, c in enumerate(system.coordinates):
        # steps in directions that have nothing to do with one another, short as they are printed
        out[c.name] = (
            float(f"{c.start + 0.37 * k * math.sin(1.0 + i + 2.3 * k):.6g}") if k else c.start
        )
        rate = c.rate + 0.53 * k * math.cos(0.7 + i + 1.9 * k)
        out[f"{c.name}_dot"] = float(f"{rate:.6g}") if k else c.rate
    return out


def _without_inertia(program: Program, k: int) -> str | None:
    """The coordinate at which elimination in D finds no positive pivot, None where there is none."""
    names = [c.name for c in program.system.coordinates]
    n = len(names)
    try:
        flat, _ = evaluate(program["D"], nearby(program.system, k))
    except (ArithmeticError, ValueError):
        return names[0]
    A = [flat[n * i : n * i + n] for i in range(n)]
    for i in range(n):
        if not A[i][i] > 8 * n * 2.0**-52 * flat[n * i + i]:
            return names[i]
        for j in range(i + 1, n):
            factor = A[j][i] / A[i][i]
            A[j] = [a - factor * b for a, b in zip(A[j], A[i], strict=True)]
    return None


TIME = t.name
