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
from sympy import Add, Expr, Mul, Pow, S, Symbol

from eomc.problems import EomcError

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


class Tape:
    """Definitions in order, each a sum, a product or a function of names before it.

    `define` takes any expression and returns what stands for it: a number, a name, or a number
    times a name. Right-hand sides are in a normal form: a sum of such atoms; a product of powers
    of names; one function of atoms.
    """

    def __init__(self, leaves: Mapping[Symbol, Stage]) -> None:
        self.leaves = dict(leaves)
        self.rhs: dict[Symbol, Expr] = {}
        self.stage: dict[Symbol, Stage] = dict(leaves)
        self.hint: dict[Symbol, str] = {}
        self.parts: dict[Symbol, tuple[Symbol, ...]] = {}  # names in the right-hand side
        self._number: dict[Symbol, int] = {}
        self._known: dict[Expr, Symbol] = {}
        self._solid: set[Symbol] = set()  # names that stay whole inside products
        self._powers: dict[Symbol, dict[Symbol, Expr]] = {}
        self.squares: dict[Symbol, Symbol] = {}  # sin(a) <-> cos(a), where both are there
        self._partial: dict[tuple[Symbol, Symbol], Expr] = {}
        self._pairs: dict[tuple[Symbol, Symbol], Expr] = {}

    # --- definitions ---------------------------------------------------------------------------

    def define(self, expr: Expr) -> Expr:
        """What stands for `expr`: a number, a name, or a number times a name."""
        if expr.is_Symbol or expr.is_number:
            return expr
        if expr.is_Add:
            return self._sum(self.define(term) for term in expr.args)
        if expr.is_Mul or expr.is_Pow:
            return self._product(Mul.make_args(expr))
        made = expr.func(*(self.define(arg) for arg in expr.args))
        if made.is_Symbol or made.is_number:
            return made
        if made.is_Add or made.is_Mul or made.is_Pow:  # sin(-a) has become -sin(a)
            return self.define(made)
        found = self._name(made)
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

    def stage_of(self, atom: Expr) -> Stage:
        """The binding time of what `define` returned."""
        symbol = split(atom)[1]
        return Stage.NUMBER if symbol is None else self.stage[symbol]

    def is_sine(self, symbol: Symbol) -> bool:
        """Whether the name stands for a sine."""
        return isinstance(self.rhs.get(symbol), sympy.sin)

    def _name(self, rhs: Expr) -> Symbol:
        found = self._known.get(rhs)
        if found is None:
            if rhs.has(*_ROUGH):
                raise RoughError("a derivative of something that jumps is needed")
            found = Symbol(f"_{len(self.rhs):06d}", real=True)
            self._known[rhs] = found
            self._number[found] = len(self.rhs)
            self.rhs[found] = rhs
            parts = sorted(rhs.free_symbols, key=lambda s: (self._number.get(s, -1), s.name))
            self.parts[found] = tuple(parts)
            self.stage[found] = max(self.stage[s] for s in parts)
        return found

    def _powers_of(self, symbol: Symbol) -> Mapping[Symbol, Expr]:
        """The symbol as a product of powers: its factors where it is one, itself elsewhere."""
        if symbol in self._solid:
            return {symbol: S.One}
        return self._powers.get(symbol) or {symbol: S.One}

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
        powers = {name: power for name, power in powers.items() if power != 0}
        product = Mul(*(Pow(name, power) for name, power in powers.items()))
        if number == 0 or product.is_number:
            return number * product
        if product.is_Symbol:
            return number * product
        symbol = self._name(product)
        self._powers[symbol] = powers
        return number * symbol

    def times(self, one: Expr, other: Expr) -> Expr:
        """The product of two atoms."""
        (a, x), (b, y) = split(one), split(other)
        if x is None or y is None:
            return one * other
        if (x, y) not in self._pairs:
            self._pairs[x, y] = self._pairs[y, x] = self._product((x, y))
        product = self._pairs[x, y]
        return product if a == b == 1 else a * b * product

    def _sum(self, atoms: Iterable[Expr]) -> Expr:
        total = self._gather(Add(*atoms))
        if not total.is_Add:
            return total
        terms = total.args
        weights = [split(term)[0] for term in terms]
        sign = weights[0] if weights[0].is_Rational else S.One
        if all(w == sign or w == -sign for w in weights) and not any(w.is_number for w in terms):
            return sign * self._name(Add(*(term / sign for term in terms)))
        if sign.is_negative:
            return -self._name(Add(*(-term for term in terms)))
        return self._name(total)

    def _gather(self, total: Expr) -> Expr:
        """a x + b x = (a + b) x where a, b are parameters' work; a sin2 + a cos2 = a."""
        if not total.is_Add:
            return total
        groups: dict[tuple[tuple[Symbol, Expr], ...], list[Expr]] = {}
        for term in total.args:
            factor, symbol = split(term)
            powers = self._powers_of(symbol) if symbol is not None else {}
            early = [n for n in powers if self.stage[n] <= Stage.PARAMETER]
            late = tuple(sorted(((n, e) for n, e in powers.items() if n not in early), key=str))
            weight = Mul(factor, *(Pow(n, powers[n]) for n in early))
            groups.setdefault(late, []).append(weight)
        weights = {
            late: self.define(parts[0])
            if len(parts) == 1
            else self._sum_of_parameters(self.define(part) for part in parts)
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

    def _sum_of_parameters(self, atoms: Iterable[Expr]) -> Expr:
        total = Add(*atoms)
        return self._name(total) if total.is_Add else total

    def _pythagoras(
        self, weights: dict[tuple[tuple[Symbol, Expr], ...], Expr]
    ) -> dict[tuple[tuple[Symbol, Expr], ...], Expr]:
        again = True
        while again:
            again = False
            for late, weight in list(weights.items()):
                for name, power in late:
                    other = self.squares.get(name)
                    if other is None or power != 2 or late not in weights:
                        continue
                    rest = tuple(part for part in late if part[0] != name)
                    twin = tuple(sorted((*rest, (other, power)), key=str))
                    if twin != late and weights.get(twin) == weight:
                        del weights[late], weights[twin]
                        sum_ = Add(weight, weights.get(rest, S.Zero))
                        weights[rest] = self._sum_of_parameters([sum_]) if sum_.is_Add else sum_
                        again = True
        return {late: weight for late, weight in weights.items() if weight != 0}

    # --- derivatives -----------------------------------------------------------------------------

    def live(self, atoms: Iterable[Expr], stop: Set[Symbol] = frozenset()) -> list[Symbol]:
        """The names that `atoms` hang on, in order; what stands behind `stop` is left out."""
        found: set[Symbol] = set()
        queue = [s for atom in atoms for s in atom.free_symbols]
        while queue:
            symbol = queue.pop()
            if symbol in self.rhs and symbol not in found:
                found.add(symbol)
                if symbol not in stop:
                    queue.extend(self.parts[symbol])
        return sorted(found, key=self._number.__getitem__)

    def leaves_of(self, atoms: Iterable[Expr]) -> set[Symbol]:
        """The leaves that `atoms` hang on."""
        atoms = list(atoms)
        names = self.live(atoms)
        seen = {s for atom in atoms for s in atom.free_symbols}.union(
            *(self.parts[n] for n in names)
        )
        return seen & self.leaves.keys()

    def partial(self, symbol: Symbol, part: Symbol) -> Expr:
        """d rhs(symbol)/d part, as `define` returns it."""
        key = (symbol, part)
        if key not in self._partial:
            rhs = self.rhs[symbol]
            self._partial[key] = rhs.coeff(part) if rhs.is_Add else self.define(rhs.diff(part))
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
            if terms and (sum_ := self._sum(terms)) != 0:
                tangent[symbol] = sum_
        return [
            factor * tangent[symbol] if symbol in tangent else S.Zero
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
                terms.setdefault(symbol, []).append(factor * seed)
        for symbol in reversed(self.live([o for o, _ in outputs], stop)):
            if symbol in stop or symbol not in terms:
                continue
            adjoint = self._sum(terms[symbol])
            for part in self.parts[symbol]:
                slope = self.partial(symbol, part)
                terms.setdefault(part, []).append(self.times(slope, adjoint))
        return [self._sum(terms.get(symbol, ())) for symbol in wrt]

    def substitute(self, outputs: Sequence[Expr], values: Mapping[Symbol, Expr]) -> list[Expr]:
        """The outputs with `values` in place of leaves."""
        new: dict[Symbol, Expr] = dict(values)
        for symbol in self.live(outputs):
            changed = {part: new[part] for part in self.parts[symbol] if part in new}
            if changed:
                new[symbol] = self.define(self.rhs[symbol].xreplace(changed))
        return [self.define(output.xreplace(new)) for output in outputs]


def split(atom: Expr) -> tuple[Expr, Symbol | None]:
    """(number, name) of what `define` returned; the name is None where it is a number."""
    if atom.is_Symbol:
        return S.One, atom
    if atom.is_number:
        return atom, None
    if len(atom.args) == 2 and atom.args[1].is_Symbol:
        return atom.args[0], atom.args[1]
    symbol = next(iter(atom.free_symbols))
    return Mul(*(f for f in atom.args if f is not symbol)), symbol
