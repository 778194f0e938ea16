"""A list of small named definitions that can be differentiated without being expanded.

Symbolic mechanics explodes where nested definitions are written out before they are
differentiated. Here each definition keeps its name, and the chain rule runs along the list:
forwards for a directional derivative, backwards for a gradient (Griewank & Walther, *Evaluating
Derivatives*, 2nd ed., ch. 3). Equal expressions get one name, so nothing is written twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from enum import IntEnum

import sympy
from sympy import Add, Expr, Mul, Pow, S, Symbol, tanh

from eomc.base.errors import EomcError
from eomc.derive.atoms import is_negative, split, written_out

_ROUGH = (sympy.DiracDelta, sympy.Derivative, sympy.Subs)


class RoughError(EomcError):
    """A derivative of something that jumps is needed."""


class Stage(IntEnum):
    """When a value becomes known; a value is as late as the latest that it is made of."""

    NUMBER = 0
    PARAMETER = 1
    TIME = 2  # t and the inputs
    POSITION = 3
    VELOCITY = 4


Powers = dict[Symbol, Expr]  # {name: exponent}, a product
_Late = tuple[tuple[Symbol, Expr], ...]  # powers of names known after the parameters


class Tape:
    """Definitions in order, each a sum, a product or a function of names before it.

    `define` takes any expression and returns what stands for it: a number, a name, or a number
    times a name. Right-hand sides are in a normal form: a sum of such atoms; a product of powers
    of names; one function of atoms.
    """

    def __init__(self, leaves: Mapping[Symbol, Stage], still: Set[Symbol] = frozenset()) -> None:
        self.leaves, self.still = dict(leaves), still  # along these every gradient is 0
        self.stage: dict[Symbol, Stage] = dict(leaves)
        self.hint: dict[Symbol, str] = {}
        self.parts: dict[Symbol, tuple[Symbol, ...]] = {}  # names in each right-hand side
        self.powers: dict[Symbol, Powers] = {}  # of names that are products
        self.weights: dict[Symbol, dict[Symbol, Expr]] = {}  # of names that are sums
        self.constant: dict[Symbol, Expr] = {}  # of names that are sums
        self._number: dict[Symbol, int] = {}
        self._known: dict[object, Symbol] = {}  # by right-hand side, sums and products by content
        self._solid: set[Symbol] = set()  # names that stay whole inside products
        self._rhs: dict[Symbol, Expr] = {}  # of functions, and of others where they were asked for
        self._late: dict[Symbol, tuple[_Late, Expr]] = {}
        self.squares: dict[Symbol, Symbol] = {}  # sin(a) <-> cos(a), where both are there
        self._cosh: dict[Symbol, Expr] = {}  # names that are the cosh of an atom
        self._partial: dict[tuple[Symbol, Symbol], Expr] = {}
        self._pairs: dict[tuple[Symbol, Symbol], Expr] = {}
        self._atoms: dict[tuple[Expr, Symbol], Expr] = {}

    # --- definitions ---------------------------------------------------------------------------

    def define(self, expr: Expr) -> Expr:
        """What stands for `expr`: a number, a name, or a number times a name."""
        if expr.is_Symbol or expr.is_number:
            return expr
        if expr.is_Add:
            return self.total(self.define(term) for term in expr.args)
        if expr.is_Mul or expr.is_Pow:
            return self._product(Mul.make_args(expr))
        made = expr.func(*(self.define(arg) for arg in expr.args))
        if made.is_Symbol or made.is_number:
            return made
        if made.is_Add or made.is_Mul or made.is_Pow:  # sin(-a) has become -sin(a)
            return self.define(made)
        found = self._name(made)
        if isinstance(made, sympy.cosh):
            self._cosh[found] = made.args[0]
        for one, other in ((sympy.sin, sympy.cos), (sympy.cos, sympy.sin)):
            if isinstance(made, one) and (partner := self._known.get(other(made.args[0]))):
                self.squares |= {found: partner, partner: found}
        return found

    def named(self, expr: Expr, name: str) -> Expr:
        """Define `expr` under a name that is kept whole; numbers and leaves stay what they are."""
        atom = self.define(expr)
        factor, symbol = split(atom)
        if symbol is None or (factor == 1 and symbol in self.leaves):
            return atom
        if factor != 1:
            symbol = self._name(atom)
        self._solid.add(symbol)
        self.hint.setdefault(symbol, name)
        return symbol

    def whole(self, atom: Expr) -> Expr:
        """The atom as a name, or minus a name, that is kept whole inside products."""
        factor, symbol = split(atom)
        if symbol is None:
            return atom
        if abs(factor) != 1:
            factor, symbol = S.One, self._name(atom)
        self._solid.add(symbol)
        return self.scaled(factor, symbol)

    def stage_of(self, atom: Expr) -> Stage:
        """The binding time of what `define` returned."""
        symbol = split(atom)[1]
        return Stage.NUMBER if symbol is None else self.stage[symbol]

    def is_sine(self, symbol: Symbol) -> bool:
        """Whether the name stands for a sine."""
        return isinstance(self._rhs.get(symbol), sympy.sin)

    def rhs(self, symbol: Symbol) -> Expr:
        """What a name stands for, as SymPy has it; the tape itself keeps sums and products apart.

        Raises KeyError for a leaf.
        """
        if symbol not in self._rhs:
            if symbol in self.weights:
                terms = [self.scaled(w, name) for name, w in self.weights[symbol].items()]
                constant = self.constant[symbol]
                numbers = [constant] if constant is not S.Zero else []
                self._rhs[symbol] = Add._from_args([*numbers, *terms])
            else:
                self._rhs[symbol] = Mul(*(Pow(x, e) for x, e in self.powers[symbol].items()))
        return self._rhs[symbol]

    def _name(self, rhs: Expr) -> Symbol:
        found = self._known.get(rhs)
        if found is None:
            if rhs.has(*_ROUGH):
                raise RoughError("a derivative of something that jumps is needed")
            found = self._new(rhs, self._ordered(rhs.free_symbols))
            self._rhs[found] = rhs
        return found

    def _new(self, key: object, parts: tuple[Symbol, ...]) -> Symbol:
        found = Symbol(f"_{len(self.parts):06d}", real=True)
        self._known[key] = found
        self._number[found] = len(self.parts)
        self.parts[found] = parts
        self.stage[found] = max(self.stage[s] for s in self.parts[found])
        return found

    def _ordered(self, names: Iterable[Symbol]) -> tuple[Symbol, ...]:
        """Leaves by name, then names as they were made."""
        return tuple(sorted(names, key=lambda s: (self._number.get(s, -1), s.name)))

    def _powers_of(self, symbol: Symbol) -> Powers:
        """The symbol as a product of powers: its factors where it is one, itself elsewhere."""
        if symbol in self._solid:
            return {symbol: S.One}
        return self.powers.get(symbol) or {symbol: S.One}

    def scaled(self, number: Expr, atom: Expr) -> Expr:
        """A number times an atom."""
        factor, symbol = split(atom)
        factor = number if factor is S.One else number * factor
        if symbol is None or factor is S.Zero:
            return factor
        if factor is S.One:
            return symbol
        if (factor, symbol) not in self._atoms:
            self._atoms[factor, symbol] = Mul._from_args((factor, symbol))
        return self._atoms[factor, symbol]

    def _product(self, factors: Iterable[Expr]) -> Expr:
        number: Expr = S.One
        powers: dict[Symbol, Expr] = {}
        for factor in factors:
            base, exponent = factor.as_base_exp()
            if factor.is_number:
                number *= factor
                continue
            if not exponent.is_number:
                atom = Pow(self.define(base), self.define(exponent))
                if not atom.is_Pow:
                    atom = self.define(atom)
                coefficient, symbol = (S.One, self._name(atom)) if atom.is_Pow else split(atom)
                exponent = S.One
            else:
                coefficient, symbol = split(self.define(base))
            if symbol is None:
                number *= coefficient**exponent
                continue
            if not (exponent.is_Integer or coefficient.is_positive):
                coefficient, symbol = S.One, self._name(coefficient * symbol)
            number *= coefficient**exponent
            whole = self._powers_of(symbol) if exponent.is_Integer else {symbol: S.One}
            for name, power in whole.items():
                powers[name] = powers.get(name, S.Zero) + power * exponent
        if number == 0:
            return S.Zero
        return self.scaled(number, self._of_powers(powers))

    def _of_powers(self, powers: Powers) -> Expr:
        """What stands for a product of powers of names."""
        powers = {name: power for name, power in powers.items() if power is not S.Zero}
        for cosh, x in [(name, self._cosh[name]) for name in powers if name in self._cosh]:
            sinh = self._known.get(sympy.sinh(x))
            n = min(powers[sinh], -powers[cosh]) if sinh in powers else S.Zero
            if n.is_Integer and n > 0:  # tanh, which does not overflow: a slope of log(cosh(x))
                rest = self._of_powers(powers | {sinh: powers[sinh] - n, cosh: powers[cosh] + n})
                return self.times(rest, self._of_powers({self.define(tanh(x)): n}))
        if not powers:
            return S.One
        if len(powers) == 1 and S.One in powers.values():
            return next(iter(powers))
        key = ("product", frozenset(powers.items()))
        if (found := self._known.get(key)) is None:
            found = self._new(key, self._ordered(powers))
            self.powers[found] = powers
        return found

    def times(self, one: Expr, other: Expr) -> Expr:
        """The product of two atoms."""
        (a, x), (b, y) = split(one), split(other)
        if x is None:
            return self.scaled(a, other)
        if y is None:
            return self.scaled(b, one)
        if (x, y) not in self._pairs:
            powers = dict(self._powers_of(x))
            for name, power in self._powers_of(y).items():
                powers[name] = powers[name] + power if name in powers else power
            self._pairs[x, y] = self._pairs[y, x] = self._of_powers(powers)
        product = self._pairs[x, y]
        if a is S.One and b is S.One:
            return product
        return self.scaled(a * b, product)

    def total(self, atoms: Iterable[Expr]) -> Expr:
        """The sum of atoms."""
        weights: dict[Symbol, Expr] = {}
        constant: Expr = S.Zero
        for atom in atoms:
            factor, symbol = split(atom)
            if symbol is None:
                constant += factor
            elif symbol in weights:
                weights[symbol] += factor
            else:
                weights[symbol] = factor
        weights = {symbol: w for symbol, w in weights.items() if w is not S.Zero}
        weights, constant = written_out(weights, constant, self)
        if len(weights) + (constant is not S.Zero) < 2:
            return constant if not weights else self.scaled(*weights.popitem()[::-1])
        if self._can_gather(weights, constant):
            terms = [constant, *(self.scaled(w, x) for x, w in weights.items())]
            return self._of_total(self._gather(Add(*terms)))
        return self._of_weights(weights, constant)

    def _of_total(self, total: Expr) -> Expr:
        """The same of what may be something else: 1 + sqrt(2) is an Add to SymPy, and a number."""
        return self._of_terms(total) if total.is_Add and not total.is_number else total

    def _of_terms(self, total: Expr) -> Expr:
        """What stands for a sum of atoms as SymPy has it."""
        numbers = [term for term in total.args if term.is_number]  # 1/4 and sqrt(2), say
        terms = [split(term) for term in total.args if not term.is_number]
        return self._of_weights({name: weight for weight, name in terms if name}, Add(*numbers))

    def _of_weights(self, weights: dict[Symbol, Expr], constant: Expr) -> Expr:
        """What stands for a sum of weighted names; most weights in it are positive."""
        names = self._ordered(weights)
        last = weights[min(reversed(names), key=lambda name: self.stage[name])]
        negative = sum(map(is_negative, (constant, *weights.values())))
        count = len(weights) + (constant is not S.Zero)
        flip = 2 * negative > count or (2 * negative == count and is_negative(last))
        size = abs(last) if last.is_Rational else S.One
        if constant is not S.Zero or not all(w in (size, -size) for w in weights.values()):
            size = S.One
        sign = -size if flip else size
        if sign is not S.One:
            weights = {name: weights[name] / sign for name in names}
            constant = constant / sign
        key = ("sum", frozenset(weights.items()), constant)
        if (found := self._known.get(key)) is None:
            found = self._new(key, names)
            self.weights[found] = {name: weights[name] for name in names}
            self.constant[found] = constant
        return self.scaled(sign, found)

    def _can_gather(self, weights: Mapping[Symbol, Expr], constant: Expr) -> bool:
        """Whether terms differ in parameters' work alone, or are squares that may add up."""
        seen: set[_Late] = {()} if constant is not S.Zero else set()
        for symbol in weights:
            late = self._split_late(symbol)[0]
            if late in seen or any(e == 2 and n in self.squares for n, e in late):
                return True
            seen.add(late)
        return False

    def _split_late(self, symbol: Symbol) -> tuple[_Late, Expr]:
        """The factors that are known after the parameters, and the product of the rest."""
        if symbol not in self._late:
            powers = self._powers_of(symbol)
            early = [n for n in powers if self.stage[n] <= Stage.PARAMETER]
            late = tuple((n, powers[n]) for n in self._ordered(powers) if n not in early)
            self._late[symbol] = (late, Mul(*(Pow(n, powers[n]) for n in early)))
        return self._late[symbol]

    def _gather(self, total: Expr) -> Expr:
        """a x + b x = (a + b) x where a, b are parameters' work; a sin2 + a cos2 = a."""
        if not total.is_Add:
            return total
        groups: dict[_Late, list[Expr]] = {}
        for term in total.args:
            factor, symbol = split(term)
            late, early = self._split_late(symbol) if symbol is not None else ((), S.One)
            groups.setdefault(late, []).append(factor * early)
        weights = {
            late: self.define(parts[0])
            if len(parts) == 1
            else self._of_total(Add(*map(self.define, parts)))
            for late, parts in groups.items()
        }
        merged = self._pythagoras(weights)
        if len(merged) == len(total.args):
            return total
        return Add(
            *(
                self._product([*Mul.make_args(weight), *(Pow(n, e) for n, e in late)])
                for late, weight in merged.items()
            )
        )

    def _pythagoras(self, weights: dict[_Late, Expr]) -> dict[_Late, Expr]:
        again = True
        while again:
            again = False
            for late, weight in list(weights.items()):
                for name, power in late:
                    other = self.squares.get(name)
                    if other is None or power != 2 or late not in weights:
                        continue
                    rest = tuple(part for part in late if part[0] != name)
                    powers = dict((*rest, (other, power)))
                    twin = tuple((n, powers[n]) for n in self._ordered(powers))
                    if twin != late and weights.get(twin) == weight:
                        del weights[late], weights[twin]
                        sum_ = Add(weight, weights.get(rest, S.Zero))
                        weights[rest] = self._of_total(sum_)
                        again = True
        return {late: weight for late, weight in weights.items() if weight != 0}

    # --- derivatives -----------------------------------------------------------------------------

    def live(self, atoms: Iterable[Expr], stop: Set[Symbol] = frozenset()) -> list[Symbol]:
        """The names that `atoms` depend on, in order; what stands behind `stop` is left out."""
        found: set[Symbol] = set()
        queue = [s for atom in atoms for s in atom.free_symbols]
        while queue:
            symbol = queue.pop()
            if symbol in self.parts and symbol not in found:
                found.add(symbol)
                if symbol not in stop:
                    queue.extend(self.parts[symbol])
        return sorted(found, key=self._number.__getitem__)

    def leaves_of(self, atoms: Iterable[Expr]) -> set[Symbol]:
        """The leaves that `atoms` depend on."""
        atoms = list(atoms)
        parts = (self.parts[n] for n in self.live(atoms))
        seen = {s for atom in atoms for s in atom.free_symbols}.union(*parts)
        return seen & self.leaves.keys()

    def partial(self, symbol: Symbol, part: Symbol) -> Expr:
        """d rhs(symbol)/d part, as `define` returns it."""
        key = (symbol, part)
        if key not in self._partial:
            if symbol in self.weights:
                self._partial[key] = self.weights[symbol][part]
            elif symbol in self.powers:
                powers = dict(self.powers[symbol])
                power = powers[part]
                powers[part] = power - 1
                whole: Powers = {}
                for name, e in powers.items():  # whole powers of products become theirs
                    inside = self._powers_of(name) if e.is_Integer else {name: S.One}
                    for n, inner in inside.items():
                        whole[n] = whole.get(n, S.Zero) + inner * e
                self._partial[key] = self.scaled(power, self._of_powers(whole))
            else:
                self._partial[key] = self.define(self.rhs(symbol).diff(part))
        return self._partial[key]

    def forward(self, outputs: Sequence[Expr], seeds: Mapping[Symbol, Expr]) -> list[Expr]:
        """sum_k d(output)/d(leaf_k) seed_k, for each output."""
        tangent: dict[Symbol, Expr] = dict(seeds)
        for symbol in self.live(outputs):
            terms = [
                self.times(self.partial(symbol, part), tangent[part])
                for part in self.parts[symbol]
                if part in tangent
            ]
            if terms and (sum_ := self.total(terms)) != 0:
                tangent[symbol] = sum_
        return [
            self.scaled(factor, tangent[symbol]) if symbol in tangent else S.Zero
            for factor, symbol in map(split, outputs)
        ]

    def gradient(
        self,
        outputs: Sequence[tuple[Expr, Expr]],
        wrt: Sequence[Symbol],
        stop: Set[Symbol] = frozenset(),
    ) -> list[Expr]:
        """sum_k seed_k d(output_k)/d(name), for each name in `wrt`; (output, seed) pairs are given.

        Names in `stop` count as independent: nothing is passed on to what they are made of.
        """
        terms: dict[Symbol, list[Expr]] = {}
        for output, seed in outputs:
            factor, symbol = split(output)
            if symbol is not None and seed != 0:
                terms.setdefault(symbol, []).append(self.scaled(factor, seed))
        for symbol in reversed(self.live([o for o, _ in outputs], stop)):
            if symbol in stop or symbol not in terms:
                continue
            adjoint = self.total(terms[symbol])
            for part in self.parts[symbol]:
                if part in self.still:
                    continue
                slope = self.partial(symbol, part)
                terms.setdefault(part, []).append(self.times(slope, adjoint))
        return [self.total(() if x in self.still else terms.get(x, ())) for x in wrt]

    def substitute(self, outputs: Sequence[Expr], values: Mapping[Symbol, Expr]) -> list[Expr]:
        """The outputs with `values` in place of leaves."""
        new: dict[Symbol, Expr] = dict(values)
        for symbol in self.live(outputs):
            changed = {part: new[part] for part in self.parts[symbol] if part in new}
            if changed:
                new[symbol] = self.define(self.rhs(symbol).xreplace(changed))
        return [self.define(output.xreplace(new)) for output in outputs]
