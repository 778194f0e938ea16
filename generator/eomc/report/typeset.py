"""Formulas in the order in which they are taught, their lines broken, as text and as LaTeX.

Masses and lengths stand before coordinates, these before rates and accelerations, sines last;
a sum begins with accelerations, then rates. Such sums and products are not evaluated, since SymPy
would sort them by name.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.printing.latex import LatexPrinter
from sympy.printing.pretty.pretty import PrettyPrinter
from sympy.printing.pretty.pretty_symbology import pretty_symbol, pretty_use_unicode
from sympy.printing.pretty.stringpict import prettyForm, stringPict
from sympy.printing.str import StrPrinter

from eomc.model.system import System, symbol, t
from eomc.runtime.labels import tex

DECIMAL = 20  # below the line of a fraction, from which it is shown as a decimal
DOTS = ("", "\N{DOT ABOVE}", "\N{DIAERESIS}")  # behind words, not on a letter in their middle
LONG = 10**12  # above or below the line of a fraction, which is then shown as a decimal
TINY = 1e-25  # a factor below it is what rounding left of a zero
WIDE = 96  # columns of text, and of what LaTeX sets in a line

Term = tuple[bool, Expr]  # whether it is subtracted, and what


class Typesetter:
    """Prints expressions over a system's names."""

    def __init__(self, system: System) -> None:
        dotted = {c.q: (c.name, 0) for c in system.coordinates}
        dotted |= {c.qd: (c.name, 1) for c in system.coordinates}
        dotted |= {c.qdd: (c.name, 2) for c in system.coordinates}
        self._rank: dict[Symbol, tuple[int, int]] = {t: (3, 0)}
        parameters = [p.symbol for p in system.parameters]
        for group, symbols in enumerate((parameters, [], [], system.q, system.qd, system.qdd)):
            self._rank |= {s: (group, i) for i, s in enumerate(symbols)}
        self._rates = (*system.qdd, *system.qd)
        # rows keep their names: some letters have subscripts, others none
        names = {symbol(f"lambda_{c.name}"): f"λ_{c.name}" for c in system.constraints}
        shown = {s: Symbol(_dotted(name, n)) for s, (name, n) in dotted.items()}
        names |= {
            s: pretty_symbol(name) + DOTS[n]
            for s, (name, n) in dotted.items()
            if n and tex(name).startswith(r"\mathrm")
        }
        self._text = _Text(shown, names)
        self._blocks: dict[Expr, prettyForm] = {}
        self._line = _Line(shown, names)
        every = (*(c.name for c in system.coordinates), *map(str, (*system.u, *parameters)))
        words = any(tex(name).startswith(r"\mathrm") for name in every)
        in_latex = {s: tex(name, n) for s, (name, n) in dotted.items()}
        self._latex = _Latex(_apart(system.definitions) | in_latex, words)

    def terms(self, e: Expr) -> list[Term]:
        """The terms of a sum, ordered, without their signs."""
        parts = [x for part in sympy.Add.make_args(sympy.sympify(e)) for x in self._parted(part)]
        return [self.term(part) for part in sorted(parts, key=self._place)]

    def _parted(self, part: Expr) -> list[Expr]:
        """A product that is too wide for a line, multiplied out by its longest sum."""
        sums = [f for f in part.args if f.is_Add] if part.is_Mul else []
        if (apart := spread(part)) is not part:
            return [*apart.args]
        if not sums or self._block(part).width() <= WIDE - 12:
            return [part]
        longest = max(sums, key=lambda f: (f.count_ops(), str(f)))
        made = [part / longest * x for x in longest.args]
        return [y for x in made for y in sympy.Add.make_args(spread(x))]

    def term(self, *factors: Expr) -> Term:
        """A product in order; its sign by itself."""
        factors = tuple(x for f in factors for x in sympy.Mul.make_args(f) if x != 1)
        signed = sympy.Mul(*(f for f in factors if f.is_Number))
        number = abs(signed)
        others = [f for f in factors if not f.is_Number]
        sums = [f for f in others if f.is_Add]
        if _decimal(number) and not any(f.is_Pow and f.base.is_Add for f in others):
            if len(sums) == 1 and len(others) > 1:  # each term with its own
                others[others.index(sums[0])] = sympy.Add(*(number * x for x in sums[0].args))
                number = sympy.S.One
            else:
                number = sympy.Float(number, 15)
        made = [self.ordered(f) for f in sorted(others, key=self._factor)]
        if number != 1 or not made:
            made.insert(0, number)
        product = made[0] if len(made) == 1 else sympy.Mul(*made, evaluate=False)
        return bool(signed < 0), product

    def ordered(self, e: Expr) -> Expr:
        """A formula with its sums and products in order."""
        if e.is_Add:
            signed = [(-1 if minus else 1, term) for minus, term in self.terms(e)]
            return sympy.Add(*(_negative(x) if s < 0 else x for s, x in signed), evaluate=False)
        if (apart := spread(e)) is not e:
            return self.ordered(apart)
        if e.is_Mul:
            minus, made = self.term(e)
            return _negative(made) if minus else made
        if e.is_Pow:
            return sympy.Pow(self.ordered(e.base), e.exp, evaluate=False)
        if isinstance(e, sympy.MatrixBase):
            return sympy.ImmutableDenseMatrix(e.applyfunc(self.ordered))
        if isinstance(e, sympy.Function) and len(e.args) == 1:
            return e.func(self.ordered(e.args[0]), evaluate=False)
        return sympy.Float(e, 15) if _decimal(e) else e

    def _factor(self, f: Expr) -> tuple[Any, ...]:
        base = f.base if f.is_Pow else f
        if base.is_Symbol:
            return (*self._rank.get(base, (0, -1)), str(f))
        if base.is_Add:
            return (1, int(f.is_Pow), str(f))
        return (2 if f.is_Pow and not base.is_Function else 6, 0, str(f))

    def _place(self, part: Expr) -> tuple[Any, ...]:
        """Of terms: those with accelerations and rates of first coordinates first, then signs."""
        powers = part.as_powers_dict()
        degrees = [powers.get(s, 0) for s in self._rates]
        rank = tuple(-float(n) if n.is_number else 0.0 for n in map(sympy.sympify, degrees))
        return (*rank, bool(part.as_coeff_Mul()[0] < 0), sympy.default_sort_key(part))

    def text(self, e: Expr) -> prettyForm:
        """A formula as a block of text; in lines one above the other where it is too wide."""
        if e not in self._blocks:
            block = self._block(e)
            if block.width() > WIDE - 12 and not isinstance(e, sympy.MatrixBase):
                lines = textwrap.wrap(self._line.doprint(e), WIDE - 16, break_on_hyphens=False)
                longest = max(map(len, lines))
                block = prettyForm("\n".join(line.ljust(longest) for line in lines))
            self._blocks[e] = block
        return self._blocks[e]

    def _block(self, e: Expr) -> prettyForm:
        unicode = pretty_use_unicode(True)  # whatever the terminal has: what prints escapes
        try:
            return self._text._print(e)
        finally:
            pretty_use_unicode(unicode)

    def latex(self, e: Expr) -> str:
        """A formula in LaTeX."""
        made: str = self._latex.doprint(e)
        return made

    def rows(self, terms: Iterable[Term], width: int) -> list[list[Term]]:
        """Terms in lines of so many columns."""
        lines: list[list[Term]] = [[]]
        gone = 0
        for minus, term in terms:
            wide = self.text(term).width() + 3
            if lines[-1] and gone + wide > width:
                lines.append([])
                gone = 0
            lines[-1].append((minus, term))
            gone += wide
        return lines

    def text_lines(self, terms: Sequence[Term], right: Sequence[Term] | None = None) -> list[str]:
        """A sum, or an equation, as lines of text at most WIDE columns wide."""
        lines: list[str] = []
        rows = self.rows(terms, WIDE - 4)
        ends = [] if right is None else self.rows(right or [(False, sympy.S.Zero)], WIDE - 8)
        for k, row in enumerate(rows):
            block = self._row(row, "" if k == 0 else "+")
            if ends and k == len(rows) - 1:
                closing = self._row(ends[0], "=")
                joined = _beside(block, closing)
                if joined.width() <= WIDE - 4 * (k > 0):
                    block, ends = joined, ends[1:]
                else:
                    lines += _indented(block, 4 * (k > 0))
                    block, ends = closing, ends[1:]
            lines += _indented(block, 4 * (k > 0))
        for row in ends:
            lines += _indented(self._row(row, "+"), 8)
        return lines

    def _row(self, row: Sequence[Term], begin: str) -> prettyForm:
        made = prettyForm("")
        for k, (minus, term) in enumerate(row):
            if k:
                sign = " - " if minus else " + "
            elif begin == "+":
                sign = "- " if minus else "+ "
            else:
                sign = ("" if not begin else " = ") + ("-" if minus else "")
            made = _beside(made, prettyForm(sign), self.text(term)) if sign else self.text(term)
        return made

    def latex_lines(self, terms: Sequence[Term], right: Sequence[Term] | None = None) -> list[str]:
        """A sum, or an equation, as lines of LaTeX about as wide."""
        lines = [self._latex_row(row, k > 0) for k, row in enumerate(self.rows(terms, WIDE))]
        if right is not None:
            ends = self.rows(right or [(False, sympy.S.Zero)], WIDE)
            lines[-1] += " = " + self._latex_row(ends[0], False)
            lines += [self._latex_row(row, True) for row in ends[1:]]
        return lines

    def _latex_row(self, row: Sequence[Term], joined: bool) -> str:
        made = ""
        for k, (minus, term) in enumerate(row):
            sign = ("- " if minus else "+ ") if k or joined else ("-" if minus else "")
            made += (" " if k else "") + sign + self.latex(term)
        return made


def _apart(definitions: Sequence[tuple[Symbol, Expr]]) -> dict[Symbol, str]:
    """Names that LaTeX would set as others, whole: joint_y_, beside joint_y."""
    many = Counter(tex(s.name) for s, _ in definitions)
    whole = (s for s, _ in definitions if many[tex(s.name)] > 1 and "" in s.name.split("_"))
    return {s: r"\mathrm{" + s.name.replace("_", r"\_") + "}" for s in whole}


def _decimal(e: Expr) -> bool:
    """Whether it reads better as a decimal, which it was in the scene: 0.028, not 7/250."""
    if not e.is_Rational or e.q < DECIMAL:
        return False
    rest = e.q
    for prime in (2, 5):
        while rest % prime == 0:
            rest //= prime
    return bool(rest == 1)


def spread(e: Expr) -> Expr:
    """A decimal times a sum, as the sum of terms each with its own; anything else as it is."""
    if e.is_Mul and len(e.args) == 2 and _decimal(e.args[0]) and e.args[1].is_Add:
        return sympy.Add(*(e.args[0] * x for x in e.args[1].args))
    return e


def readable(value: Expr) -> Expr:
    """With decimals for fractions that nobody reads, as those of 50 digits of slanted axes.

    At 30 digits more of them fall together, and what rounding left of zeros is gone.
    """
    if not _long(value):
        return value
    short = _rounded(sympy.expand(value))
    plain = _rounded(sympy.expand(short))  # each factor whole again
    return plain.xreplace({x: _simple_fraction(x) or sympy.Float(x, 15) for x in _long(plain)})


def _simple_fraction(x: sympy.Rational) -> sympy.Rational | None:
    """Return the fraction of at most three digits that float64 does not tell from x, if any."""
    simple = Fraction(int(x.p), int(x.q)).limit_denominator(999)
    return sympy.Rational(simple) if float(simple) == float(x) else None


def _rounded(e: Expr) -> Expr:
    return e.xreplace(
        {x: sympy.Rational(str(sympy.Float(x, 30))) if abs(x) > TINY else 0 for x in _long(e)}
    )


def _long(e: Expr) -> set[sympy.Rational]:
    return {x for x in e.atoms(sympy.Rational) if max(abs(x.p), x.q) >= LONG}


def _negative(e: Expr) -> Expr:
    factors = sympy.Mul.make_args(e)
    if factors[0].is_Number:
        return sympy.Mul(-factors[0], *factors[1:], evaluate=False) if factors[1:] else -e
    return sympy.Mul(-1, *factors, evaluate=False)


def _beside(*blocks: prettyForm) -> prettyForm:
    return prettyForm(*stringPict.next(*blocks))


def _indented(block: prettyForm, by: int) -> list[str]:
    return [(" " * by + line).rstrip() for line in str(block).splitlines()]


def _dotted(name: str, dots: int) -> str:
    """theta2 -> thetadot2, which SymPy prints as a dotted theta with a subscript 2."""
    if not dots:
        return name
    base = name.split("_")[0].rstrip("0123456789") or name
    return f"{base}{'d' * (dots - 1)}dot{name[len(base) :]}"


def _set_as_name(name: str) -> str:
    """With its subscripts, as far as Unicode has them; else as it is."""
    made = str(pretty_symbol(name))
    return name if {" ", "_"} & {*made} else made


class _Text(PrettyPrinter):  # type: ignore[misc]
    """Blocks of Unicode."""

    def __init__(self, names: dict[Symbol, Symbol], plain: dict[Symbol, str]) -> None:
        super().__init__(
            {"use_unicode": True, "wrap_line": False, "order": "none", "full_prec": False}
        )
        self._names, self._plain = names, plain

    def _print_Symbol(self, e: Symbol, bold_name: bool = False) -> prettyForm:
        return prettyForm(self._plain.get(e) or _set_as_name(self._names.get(e, e).name))

    def _print_dot(self, e: Expr) -> prettyForm:
        inside = prettyForm(*self._print(e.args[0]).parens())
        return prettyForm(*prettyForm("d/dt ").right(inside))


class _Line(StrPrinter):  # type: ignore[misc]
    """One line of text: √(x + y), x^2."""

    def __init__(self, names: dict[Symbol, Symbol], plain: dict[Symbol, str]) -> None:
        super().__init__({"order": "none", "full_prec": False})
        self._names, self._plain = names, plain

    def _print_Symbol(self, e: Symbol) -> str:
        return self._plain.get(e) or _set_as_name(self._names.get(e, e).name)

    def _print_dot(self, e: Expr) -> str:
        return f"d/dt ({self._print(e.args[0])})"

    def doprint(self, e: Expr) -> str:
        made: str = super().doprint(e)
        return made.replace("**", "^").replace("*", "⋅").replace("sqrt(", "√(")


class _Latex(LatexPrinter):  # type: ignore[misc]
    """LaTeX with upright words, a thin space between factors where there are any; sin θ bare."""

    def __init__(self, names: dict[Symbol, str], words: bool) -> None:
        settings = {"order": "none", "fold_func_brackets": True, "full_prec": False}
        super().__init__(settings | ({"mul_symbol": r" \, "} if words else {}))
        self._names = names

    def _print_Symbol(self, e: Symbol, style: str = "plain") -> str:
        return self._names.get(e) or tex(e.name)
