"""A list of small named definitions that is differentiated without being expanded.

Symbolic expressions of mechanics become huge if nested definitions are expanded before
differentiation. On a tape each definition keeps its name, and the chain rule runs along the list:
forwards for a directional derivative, backwards for a gradient (Griewank & Walther, *Evaluating
Derivatives*, 2nd ed., ch. 3). Equal expressions get the same name, so nothing is computed twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from enum import IntEnum

import sympy
from sympy import Add, Expr, Mul, Pow, S, Symbol, tanh

from eomc.base.errors import EomcError
from eomc.model.algebra import classes_of_shape

_CORNERS = classes_of_shape("corner", "jump")
_NOT_DIFFERENTIABLE = (sympy.DiracDelta, sympy.Derivative, sympy.Subs)


class NotDifferentiableError(EomcError):
    """Raised where the derivative of a discontinuous function is needed."""


class Stage(IntEnum):
    """The binding time of a value: when, or from which variables, it can be computed.

    NUMBER: when code is generated. PARAMETER: once for each set of parameters. TIME: from t and the
    inputs. POSITION: from q and the former. VELOCITY: from qd and all former variables.
    """

    NUMBER = 0
    PARAMETER = 1
    TIME = 2  # t and the inputs
    POSITION = 3
    VELOCITY = 4


Powers = dict[Symbol, Expr]  # a product as {name: exponent}
_Varying = tuple[tuple[Symbol, Expr], ...]  # powers of names that do not depend on parameters alone


@dataclass(frozen=True)
class RootSlope:
    """The derivative of a root s**p, 0 < p < 1, bounded so that it is finite where s is 0.

    The tape (list of named operations) uses it in the chain rule: the derivative of s is multiplied
    by p s**(p - 1), which is bounded by p/least with a small number `least`. If s is 0 at a smooth
    minimum, the derivative of s is 0. For p >= 1/2 the product is then 0, which is correct, since s
    is of second order. For p < 1/2 the derivative of the root is infinite, unless a factor of the
    root is 0. The derivative of a root of |x| is infinite, too; it is taken with respect to x, with
    the sign of one side at 0. If the bound remains in a result, the result is made infinite, see
    `Tape._overflowing`.

    Attributes
    ----------
    slope : Expr
        The bounded derivative.
    along : Symbol
        The name with respect to which it is taken.
    at_zero : Expr
        A term that is added for each symbol in `leaves`: nonzero where s is 0, for p < 1/2.
    leaves : tuple of Symbol
        The symbols without definition that s depends on.
    """

    slope: Expr
    along: Symbol
    at_zero: Expr = S.Zero
    leaves: tuple[Symbol, ...] = ()


class Tape:
    """A list of elementary operations, each with a named result.

    The method `define` adds an expression to the list and returns its atom: a number, a name, or a
    number times a name. Each name is defined as a sum of atoms, a product of powers of names, or
    one function of atoms, in terms of earlier names. Equal expressions have the same name.

    Parameters
    ----------
    leaves : mapping of Symbol to Stage
        The symbols without definition, such as coordinates and parameters. The `Stage` of a symbol
        says when its value is available.
    constant_leaves : set of Symbol
        Leaves that count as constant: derivatives with respect to them are 0.
    """

    def __init__(
        self, leaves: Mapping[Symbol, Stage], constant_leaves: Set[Symbol] = frozenset()
    ) -> None:
        self.leaves, self.constant_leaves = dict(leaves), constant_leaves
        self.stage: dict[Symbol, Stage] = dict(leaves)
        self.hint: dict[Symbol, str] = {}
        self.parts: dict[Symbol, tuple[Symbol, ...]] = {}  # names in each right-hand side
        self.powers: dict[Symbol, Powers] = {}  # of names that are products
        self.weights: dict[Symbol, dict[Symbol, Expr]] = {}  # of names that are sums
        self.constant: dict[Symbol, Expr] = {}  # of names that are sums
        self._number: dict[Symbol, int] = {}
        self._known: dict[object, Symbol] = {}  # by right-hand side, sums and products by content
        self._opaque: set[Symbol] = set()  # names that are not expanded inside products
        self._rhs: dict[Symbol, Expr] = {}  # of functions; of sums and products once `rhs` built it
        self._varying: dict[Symbol, tuple[_Varying, Expr]] = {}
        self.squares: dict[Symbol, Symbol] = {}  # sin(a) <-> cos(a), where both exist
        self._cosh: dict[Symbol, Expr] = {}  # names that are the cosh of an atom
        self._partial: dict[tuple[Symbol, Symbol], Expr] = {}
        self._pairs: dict[tuple[Symbol, Symbol], Expr] = {}
        self._atoms: dict[tuple[Expr, Symbol], Expr] = {}
        self._root_slopes: dict[tuple[Symbol, Symbol, Expr], RootSlope | None] = {}
        self._bounded: set[Symbol] = set()  # divisors of the derivatives of roots

    # --- definitions ---------------------------------------------------------------------------

    def define(self, expr: Expr) -> Expr:
        """Add `expr` to the tape and return its atom: a number, a name, or a number times a name.

        A subexpression that already has a name is not defined again.
        """
        if expr.is_Symbol or expr.is_number:
            return expr
        if expr.is_Add:
            return self.total(self.define(term) for term in expr.args)
        if expr.is_Mul or expr.is_Pow:
            return self._product(Mul.make_args(expr))
        result = expr.func(*(self.define(arg) for arg in expr.args))
        if result.is_Symbol or result.is_number:
            return result
        if result.is_Add or result.is_Mul or result.is_Pow:  # sin(-a) has become -sin(a)
            return self.define(result)
        name = self._name(result)
        if isinstance(result, sympy.cosh):
            self._cosh[name] = result.args[0]
        for one, other in ((sympy.sin, sympy.cos), (sympy.cos, sympy.sin)):
            if isinstance(result, one) and (partner := self._known.get(other(result.args[0]))):
                self.squares |= {name: partner, partner: name}
        return name

    def named(self, expr: Expr, name: str) -> Expr:
        """Add `expr` to the tape under a name of its own, and return the name.

        A product that contains the name is not expanded by the name's definition. `name` is the
        preferred name of the variable in generated code. An expression that is a number or a
        symbol without definition is returned unchanged.
        """
        atom = self.define(expr)
        factor, symbol = split(atom)
        if symbol is None or (factor == 1 and symbol in self.leaves):
            return atom
        if factor != 1:
            symbol = self._name(atom)
        self._opaque.add(symbol)
        self.hint.setdefault(symbol, name)
        return symbol

    def opaque(self, atom: Expr) -> Expr:
        """Return an atom with the same value that is not expanded in products.

        `atom` is a number, a name, or a number times a name. The result is a number, a name, or
        minus a name. If a product contains this name, the name's definition is not multiplied out.
        """
        factor, symbol = split(atom)
        if symbol is None:
            return atom
        if abs(factor) != 1:
            factor, symbol = S.One, self._name(atom)
        self._opaque.add(symbol)
        return self.scaled(factor, symbol)

    def stage_of(self, atom: Expr) -> Stage:
        """Return the binding time of an atom: when it can be computed, see `Stage`.

        An atom is a number, a name on the tape, or a number times a name.
        """
        symbol = split(atom)[1]
        return Stage.NUMBER if symbol is None else self.stage[symbol]

    def is_sine(self, symbol: Symbol) -> bool:
        """Return True if a name on the tape is defined as the sine of something."""
        return isinstance(self._rhs.get(symbol), sympy.sin)

    def rhs(self, symbol: Symbol) -> Expr:
        """Return the definition of a name as a SymPy expression of earlier names.

        Raises KeyError if `symbol` has no definition, as a coordinate or a parameter.
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

    def find_jumps(self) -> frozenset[Symbol]:
        """Return the names that are defined as a sign or heaviside."""
        jumps = (sympy.sign, sympy.Heaviside)
        return frozenset(name for name, rhs in self._rhs.items() if isinstance(rhs, jumps))

    def _name(self, rhs: Expr) -> Symbol:
        """Return the name of a function of atoms, a new one where it is not defined yet."""
        name = self._known.get(rhs)
        if name is None:
            if rhs.has(*_NOT_DIFFERENTIABLE):
                raise NotDifferentiableError("a derivative of something that jumps is needed")
            name = self._new(rhs, self._ordered(rhs.free_symbols))
            self._rhs[name] = rhs
        return name

    def _new(self, key: object, parts: tuple[Symbol, ...]) -> Symbol:
        """Add a definition with the given key, which depends on the names `parts`."""
        name = Symbol(f"_{len(self.parts):06d}", real=True)
        self._known[key] = name
        self._number[name] = len(self.parts)
        self.parts[name] = parts
        self.stage[name] = max(self.stage[s] for s in self.parts[name])
        return name

    def _ordered(self, names: Iterable[Symbol]) -> tuple[Symbol, ...]:
        """Sort names: leaves alphabetically, then definitions in order."""
        return tuple(sorted(names, key=lambda s: (self._number.get(s, -1), s.name)))

    def _powers_of(self, symbol: Symbol) -> Powers:
        """Return the symbol as a product of powers: its factors if it is a product, else itself."""
        if symbol in self._opaque:
            return {symbol: S.One}
        return self.powers.get(symbol) or {symbol: S.One}

    def scaled(self, number: Expr, atom: Expr) -> Expr:
        """Return the product of a number and an atom, which is an atom too.

        An atom is a number, a name on the tape, or a number times a name. Nothing is added to the
        tape.
        """
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
        """Return the atom of a product of expressions."""
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
            factors_ = self._powers_of(symbol) if exponent.is_Integer else {symbol: S.One}
            for name, power in factors_.items():
                powers[name] = powers.get(name, S.Zero) + power * exponent
        if number == 0:
            return S.Zero
        return self.scaled(number, self._of_powers(powers))

    def _of_powers(self, powers: Powers) -> Expr:
        """Return the atom of a product of powers of names."""
        powers = {name: power for name, power in powers.items() if power is not S.Zero}
        for cosh, x in [(name, self._cosh[name]) for name in powers if name in self._cosh]:
            sinh = self._known.get(sympy.sinh(x))
            n = min(powers[sinh], -powers[cosh]) if sinh in powers else S.Zero
            if n.is_Integer and n > 0:  # tanh, which does not overflow, as in d log(cosh(x))/dx
                rest = self._of_powers(powers | {sinh: powers[sinh] - n, cosh: powers[cosh] + n})
                return self.times(rest, self._of_powers({self.define(tanh(x)): n}))
        if not powers:
            return S.One
        if len(powers) == 1 and S.One in powers.values():
            return next(iter(powers))
        key = ("product", frozenset(powers.items()))
        if (result := self._known.get(key)) is None:
            result = self._new(key, self._ordered(powers))
            self.powers[result] = powers
        return result

    def times(self, first: Expr, second: Expr) -> Expr:
        """Return the product of two atoms as an atom; the tape is extended where necessary.

        An atom is a number, a name on the tape, or a number times a name.
        """
        (a, x), (b, y) = split(first), split(second)
        if x is None:
            return self.scaled(a, second)
        if y is None:
            return self.scaled(b, first)
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
        """Return the sum of `atoms` as an atom; the tape is extended where necessary.

        An atom is a number, a name on the tape, or a number times a name.
        """
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
        weights, constant = expand_sums(weights, constant, self)
        if len(weights) + (constant is not S.Zero) < 2:
            return constant if not weights else self.scaled(*weights.popitem()[::-1])
        if self._can_gather(weights, constant):
            terms = [constant, *(self.scaled(w, x) for x, w in weights.items())]
            return self._of_total(self._gather(Add(*terms)))
        return self._of_weights(weights, constant)

    def _of_total(self, total: Expr) -> Expr:
        """Return the atom of a gathered sum, which may be a number: SymPy writes 1 + sqrt(2) as
        Add.
        """
        return self._of_terms(total) if total.is_Add and not total.is_number else total

    def _of_terms(self, total: Expr) -> Expr:
        """Return the atom of a SymPy sum of atoms."""
        numbers = [term for term in total.args if term.is_number]  # 1/4 and sqrt(2), say
        terms = [split(term) for term in total.args if not term.is_number]
        return self._of_weights({name: weight for weight, name in terms if name}, Add(*numbers))

    def _of_weights(self, weights: dict[Symbol, Expr], constant: Expr) -> Expr:
        """Return the atom of a weighted sum of names, normalized so that most weights are
        positive.
        """
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
        if (symbol := self._known.get(key)) is None:
            symbol = self._new(key, names)
            self.weights[symbol] = {name: weights[name] for name in names}
            self.constant[symbol] = constant
        return self.scaled(sign, symbol)

    def _can_gather(self, weights: Mapping[Symbol, Expr], constant: Expr) -> bool:
        """Return True if terms differ in parameter-only factors alone, or have squares of sine or
        cosine.
        """
        varying: set[_Varying] = {()} if constant is not S.Zero else set()
        for symbol in weights:
            factors = self._split_varying(symbol)[0]
            if factors in varying or any(e == 2 and n in self.squares for n, e in factors):
                return True
            varying.add(factors)
        return False

    def _split_varying(self, symbol: Symbol) -> tuple[_Varying, Expr]:
        """Split a product into factors that vary and the product of those that depend on parameters
        only.
        """
        if symbol not in self._varying:
            powers = self._powers_of(symbol)
            constant = [n for n in powers if self.stage[n] <= Stage.PARAMETER]
            varying = tuple((n, powers[n]) for n in self._ordered(powers) if n not in constant)
            self._varying[symbol] = (varying, Mul(*(Pow(n, powers[n]) for n in constant)))
        return self._varying[symbol]

    def _gather(self, total: Expr) -> Expr:
        """Combine a x + b x = (a + b) x for parameter-only a and b, and a sin^2 + a cos^2 = a."""
        if not total.is_Add:
            return total
        groups: dict[_Varying, list[Expr]] = {}
        for term in total.args:
            factor, symbol = split(term)
            varying, constant = self._split_varying(symbol) if symbol is not None else ((), S.One)
            groups.setdefault(varying, []).append(factor * constant)
        weights = {
            varying: self.define(parts[0])
            if len(parts) == 1
            else self._of_total(Add(*map(self.define, parts)))
            for varying, parts in groups.items()
        }
        merged = self._pythagoras(weights)
        if len(merged) == len(total.args):
            return total
        return Add(
            *(
                self._product([*Mul.make_args(weight), *(Pow(n, e) for n, e in varying)])
                for varying, weight in merged.items()
            )
        )

    def _pythagoras(self, weights: dict[_Varying, Expr]) -> dict[_Varying, Expr]:
        """Replace pairs a sin^2 x + a cos^2 x by a."""
        again = True
        while again:
            again = False
            for varying, weight in list(weights.items()):
                for name, power in varying:
                    partner = self.squares.get(name)
                    if partner is None or power != 2 or varying not in weights:
                        continue
                    rest = tuple(part for part in varying if part[0] != name)
                    powers = dict((*rest, (partner, power)))
                    twin = tuple((n, powers[n]) for n in self._ordered(powers))
                    if twin != varying and weights.get(twin) == weight:
                        del weights[varying], weights[twin]
                        sum_ = Add(weight, weights.get(rest, S.Zero))
                        weights[rest] = self._of_total(sum_)
                        again = True
        return {varying: weight for varying, weight in weights.items() if weight != 0}

    # --- derivatives -----------------------------------------------------------------------------

    def live(self, atoms: Iterable[Expr], stop: Set[Symbol] = frozenset()) -> list[Symbol]:
        """Return all names on the tape that `atoms` depend on, in the order of their definition.

        Definitions of names in `stop` are not followed: such a name is returned, but not the names
        that only its definition depends on.
        """
        names: set[Symbol] = set()
        queue = [s for atom in atoms for s in atom.free_symbols]
        while queue:
            symbol = queue.pop()
            if symbol in self.parts and symbol not in names:
                names.add(symbol)
                if symbol not in stop:
                    queue.extend(self.parts[symbol])
        return sorted(names, key=self._number.__getitem__)

    def leaves_of(self, atoms: Iterable[Expr]) -> set[Symbol]:
        """Return the leaves (symbols without definition) that `atoms` depend on."""
        atoms = list(atoms)
        parts = (self.parts[n] for n in self.live(atoms))
        symbols = {s for atom in atoms for s in atom.free_symbols}.union(*parts)
        return symbols & self.leaves.keys()

    def partial(self, symbol: Symbol, part: Symbol) -> Expr:
        """Return the derivative of a definition with respect to a name that occurs in it.

        `symbol` is the defined name. `part` is the name in its definition; all other names in the
        definition are held constant.
        """
        key = (symbol, part)
        if key not in self._partial:
            if symbol in self.weights:
                self._partial[key] = self.weights[symbol][part]
            elif symbol in self.powers:
                powers = dict(self.powers[symbol])
                power = powers[part]
                powers[part] = power - 1
                self._partial[key] = self.scaled(power, self._product_of(powers))
            else:
                self._partial[key] = self.define(self.rhs(symbol).diff(part))
        return self._partial[key]

    def forward(
        self, outputs: Sequence[Expr], seeds: Mapping[Symbol, Expr], least: Expr | None = None
    ) -> list[Expr]:
        """Return the derivative of each output along a direction, by forward differentiation.

        Parameters
        ----------
        outputs
            The values to differentiate, as atoms of the tape: numbers, names, or numbers times
            names.
        seeds
            The direction: its component along each leaf (symbol without definition). Components
            along absent leaves are 0.
        least
            Lower bound of the denominators in derivatives of roots, so that these stay finite where
            the root is 0, see `RootSlope`. None for no bound.

        Returns
        -------
        list of Expr
            sum_k d(output)/d(leaf_k) seed_k of each output.
        """
        tangent: dict[Symbol, Expr] = dict(seeds)
        for symbol in self.live(outputs):
            terms = [
                self.times(slope, tangent[part])
                for slope, part in self._slopes(symbol, least, tangent.__contains__)
                if part in tangent
            ]
            if terms and (sum_ := self.total(terms)) != 0:
                tangent[symbol] = sum_
        derivatives = [
            self.scaled(factor, tangent[symbol]) if symbol in tangent else S.Zero
            for factor, symbol in map(split, outputs)
        ]
        return [self._overflowing(x, least) for x in derivatives]

    def gradient(
        self,
        outputs: Sequence[tuple[Expr, Expr]],
        wrt: Sequence[Symbol],
        stop: Set[Symbol] = frozenset(),
        least: Expr | None = None,
    ) -> list[Expr]:
        """Return the gradient of a weighted sum of outputs, by reverse differentiation.

        Parameters
        ----------
        outputs
            Pairs (value, seed) of atoms. The seed is the weight of the value in the sum.
        wrt
            The names with respect to which the derivatives are taken.
        stop
            Names that are independent variables: their definitions are not differentiated.
        least
            Lower bound of the denominators in derivatives of roots, so that these stay finite where
            the root is 0, see `RootSlope`. None for no bound.

        Returns
        -------
        list of Expr
            sum_k seed_k d(value_k)/d(name) for each name in `wrt`.
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
            for slope, part in self._slopes(symbol, least, self._varies):
                if self._varies(part):
                    terms.setdefault(part, []).append(self.times(slope, adjoint))
        gradient = (self.total(() if x in self.constant_leaves else terms.get(x, ())) for x in wrt)
        return [self._overflowing(x, least) for x in gradient]

    def _varies(self, name: Symbol) -> bool:
        """Return True if derivatives are taken along the name."""
        return name not in self.constant_leaves

    def _slopes(
        self, symbol: Symbol, least: Expr | None, varies: Callable[[Symbol], bool]
    ) -> Iterator[tuple[Expr, Symbol]]:
        """Yield the partial derivatives of a definition, each with the name that it belongs to.

        Those along names that do not vary are not computed: they may not exist, as where a function
        jumps.
        """
        for part in self.parts[symbol]:
            root = None if least is None else self._root_slope(symbol, part, least)
            if root is None:
                if varies(part):
                    yield self.partial(symbol, part), part
                continue
            yield root.slope, root.along
            for leaf in root.leaves:
                yield root.at_zero, leaf

    def _root_slope(self, symbol: Symbol, part: Symbol, least: Expr) -> RootSlope | None:
        """Return `_derive_root_slope`, computed once."""
        key = (symbol, part, least)
        if key not in self._root_slopes:
            self._root_slopes[key] = self._derive_root_slope(symbol, part, least)
        return self._root_slopes[key]

    def _derive_root_slope(self, symbol: Symbol, part: Symbol, least: Expr) -> RootSlope | None:
        """Return the bounded derivative of a power of `part`, or None where none is needed."""
        if self.stage[part] < Stage.POSITION or symbol in self.weights:
            return self._log_slope(symbol, part, least)
        if symbol in self.powers:
            power, rest = self.powers[symbol][part], dict(self.powers[symbol])
            del rest[part]
            if power.is_Integer or not 0 < power < 1:
                return None
            while (inner := self.powers.get(part)) and len(inner) == 1:  # sqrt(x**3), a root of one
                ((below, exponent),) = inner.items()
                if exponent.is_even:
                    break
                part, power = below, power * exponent
            if power >= 1:
                slope = self._product([self._product_of(rest), Pow(part, power - 1)])
                return RootSlope(self.scaled(power, slope), part)
            base = self._rhs.get(part)
            corner = isinstance(base, (sympy.Abs, sympy.Max, sympy.Min))
            names = self.live([part])
            within = {n for n in names if isinstance(self._rhs.get(n), _CORNERS)}
            if power < 0 or self._is_positive(part) or any(map(self._is_root, names)):
                return None
            if not corner and within and (power < S.Half or self._has_abs(within)):
                return None
            root, size = Pow(part, 1 - power), self.scaled(power, self._product_of(rest))
        else:
            raised, base = self._rhs[symbol], self._rhs.get(part)
            corner = isinstance(base, (sympy.Abs, sympy.Max, sympy.Min))
            if not (raised.is_Pow and corner and part in raised.base.free_symbols):
                return None
            power, within = raised.exp, {part}
            root = Pow(raised.base, 1 - power)
            size = self.define(power * split(raised.base)[0])
        divisor = self.define(sympy.Max(self.define(root), least))
        self._bounded.add(divisor)
        slope, leaves = self.times(size, self._of_powers({divisor: S.NegativeOne})), []
        if isinstance(base, sympy.Abs):
            factor, inside = split(base.args[0])
            if inside is None:
                return None
            side = self.define(sympy.sign(self.define(base.args[0] + least)))
            return RootSlope(self.times(self.scaled(factor, side), slope), inside)
        at_zero: Expr = S.Zero
        if not within and power < S.Half:
            leaves = [x for x in self.leaves_of([part]) if self.stage[x] >= Stage.POSITION]
            flat = self.define(1 - sympy.sign(part))
            at_zero = self.times(slope, flat)
        return RootSlope(slope, part, at_zero, self._ordered(leaves))

    def _log_slope(self, symbol: Symbol, part: Symbol, least: Expr) -> RootSlope | None:
        """Return b**n log(b), the derivative along a parameter n in an exponent, 0 where b is 0."""
        raised = self._rhs.get(symbol, S.Zero)
        if not raised.is_Pow or part in raised.base.free_symbols:
            return None
        if self.stage_of(raised.base) < Stage.POSITION:
            return None
        slope = symbol * sympy.log(sympy.Max(raised.base, least)) * raised.exp.diff(part)
        return RootSlope(self.define(slope), part)

    def _product_of(self, powers: Powers) -> Expr:
        """Return the atom of a product of powers, integer powers of products expanded."""
        whole: Powers = {}
        for name, e in powers.items():
            inside = self._powers_of(name) if e.is_Integer else {name: S.One}
            for n, inner in inside.items():
                whole[n] = whole.get(n, S.Zero) + inner * e
        return self._of_powers(whole)

    def _is_positive(self, symbol: Symbol) -> bool:
        """Return True if the name is a sum of a positive number and even powers."""
        terms = self.weights.get(symbol)
        if not terms or not self.constant[symbol].is_positive:
            return False
        return all(
            weight.is_positive and all(e.is_even for e in self._powers_of(name).values())
            for name, weight in terms.items()
        )

    def _is_root(self, name: Symbol) -> bool:
        """Return True if the name is a product with a power that is no integer."""
        return any(not e.is_Integer for e in self.powers.get(name, {}).values())

    def _has_abs(self, names: Iterable[Symbol]) -> bool:
        """Return True if one of the names is an absolute value."""
        return any(isinstance(self._rhs[n], sympy.Abs) for n in names)

    def _overflowing(self, atom: Expr, least: Expr | None) -> Expr:
        """Return the atom, which overflows where a bound of `RootSlope` has met no factor of 0."""
        if least is None or self._bounded.isdisjoint(self.live([atom])):
            return atom
        limit = least ** sympy.Rational(3, 5)
        beyond = self.define(sympy.Max(1, self.define(sympy.Abs(atom)) * limit))
        return self.times(atom, self.define(beyond**4))

    def substitute(self, outputs: Sequence[Expr], values: Mapping[Symbol, Expr]) -> list[Expr]:
        """Return the given expressions on the tape with some symbols replaced by other values.

        `outputs` are the expressions. `values` maps each symbol to its replacement. Both are atoms
        of the tape: numbers, names, or numbers times names. Definitions that depend on the symbols
        are added to the tape anew.
        """
        new: dict[Symbol, Expr] = dict(values)
        for symbol in self.live(outputs):
            changed = {part: new[part] for part in self.parts[symbol] if part in new}
            if changed:
                new[symbol] = self.define(self.rhs(symbol).xreplace(changed))
        return [self.define(output.xreplace(new)) for output in outputs]


# --- atoms: a number, a name, or a number times a name --------------------------------------------


def split(atom: Expr) -> tuple[Expr, Symbol | None]:
    """Return the pair (number, name) whose product is `atom`.

    An atom is a number, a symbol (the name of a value), or a number times a symbol. The returned
    number is 1 if `atom` is a symbol. The returned name is None if `atom` is a number.
    """
    if atom.is_Symbol:
        return S.One, atom
    if atom.is_number:
        return atom, None
    if len(atom.args) == 2 and atom.args[1].is_Symbol:
        return atom.args[0], atom.args[1]
    symbol = next(iter(atom.free_symbols))
    return Mul(*(f for f in atom.args if f is not symbol)), symbol


def is_negative(number: Expr) -> bool:
    """Return True if `number`, a SymPy number, is negative.

    For a rational number the sign of its numerator is tested, which is faster than SymPy's test.
    """
    return bool(number.p < 0 if number.is_Rational else number.is_negative)


def expand_sums(
    weights: dict[Symbol, Expr], constant: Expr, sums: Tape
) -> tuple[dict[Symbol, Expr], Expr]:
    """Return the sum sum_k weights[k] k + constant, simplified, as the pair (weights, constant).

    A name in the sum may itself be defined as a sum of leaves (symbols without definition). It is
    replaced by its terms if the result is then shorter. For example, q1 + (q2 - q1) becomes q2,
    which also avoids a large rounding error for large q1. The names are defined on the tape
    `sums`.
    """
    for symbol, weight in weights.items():
        inner = sums.weights.get(symbol)
        if not inner or inner.keys().isdisjoint(weights) or inner.keys() - sums.leaves.keys():
            continue
        expanded = {name: w for name, w in weights.items() if name is not symbol}
        for name, w in inner.items():
            expanded[name] = expanded.get(name, S.Zero) + weight * w
        expanded = {name: w for name, w in expanded.items() if w != 0}
        new_constant = constant + weight * sums.constant[symbol]
        if len(expanded) + (new_constant != 0) < len(weights) + (constant != 0):
            return expand_sums(expanded, S.Zero if new_constant == 0 else new_constant, sums)
    return weights, constant
