"""Print equations in textbook order, broken into lines, as text, LaTeX and MathML.

In a product, masses and lengths come before coordinates, these before velocities and accelerations,
and sines last; in a sum, accelerations come first, then velocities. Such sums and products are not
evaluated, since SymPy would sort them by name.
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from itertools import groupby
from typing import Any

import sympy
from markupsafe import Markup
from sympy import Expr, MatrixBase, Symbol
from sympy.printing.latex import LatexPrinter
from sympy.printing.pretty.pretty import PrettyPrinter
from sympy.printing.pretty.pretty_symbology import pretty_symbol, pretty_use_unicode
from sympy.printing.pretty.stringpict import prettyForm, stringPict
from sympy.printing.str import StrPrinter

from eomc.base.errors import EomcError
from eomc.model.system import System, symbol, t
from eomc.runtime.plot import tex

MIN_DECIMAL_DENOMINATOR = 20  # smaller denominators are shown as fractions
DOTS = ("", "\N{DOT ABOVE}", "\N{DIAERESIS}")  # appended to names of several letters
MAX_FRACTION_PART = 10**12  # larger numerators or denominators are shown as decimals
MIN_LONG_DECIMAL = 14  # characters of a float that no one writes, such as 2.6666666666666665
ZERO_TOLERANCE = 1e-25  # a smaller factor is the rounding error of zero
WIDE = 96  # columns of a line of text; also limits lines of LaTeX
CONTINUATION = r"  & \quad "  # prefix of a line of LaTeX that continues the previous one
MAX_ENVIRONMENT_LENGTH = 3_000  # characters of LaTeX: KaTeX accepts about a page

Term = tuple[bool, Expr]  # (True if subtracted, the term without its sign)


class Typesetter:
    """Prints SymPy expressions over the names of a system as blocks of Unicode text or as LaTeX.

    Methods for sums use pairs of the type `Term`: (True if the term is subtracted, the term without
    its sign). symbols: the user's symbols by name, in place of those of the system.
    """

    def __init__(self, system: System, symbols: Mapping[str, Expr] | None = None) -> None:
        self._internal = {own: symbol(name) for name, own in (symbols or {}).items()}
        dotted = {c.q: (c.name, 0) for c in system.coordinates}
        dotted |= {c.qd: (c.name, 1) for c in system.coordinates}
        dotted |= {c.qdd: (c.name, 2) for c in system.coordinates}
        self._rank: dict[Symbol, tuple[int, int]] = {t: (3, 0)}
        parameters = [p.symbol for p in system.parameters]
        for group, members in enumerate((parameters, [], [], system.q, system.qd, system.qdd)):
            self._rank |= {s: (group, i) for i, s in enumerate(members)}
        self._rates = (*system.qdd, *system.qd)
        # rows keep their names: some letters have subscripts, others none
        names = {symbol(f"lambda_{c.name}"): f"λ_{c.name}" for c in system.constraints}
        shown = {s: Symbol(_dotted_name(name, n)) for s, (name, n) in dotted.items()}
        names |= {
            s: pretty_symbol(name) + DOTS[n]
            for s, (name, n) in dotted.items()
            if n and tex(name).startswith(r"\mathrm")
        }
        self._text = _TextPrinter(shown, names)
        self._blocks: dict[Expr, prettyForm] = {}
        self._line = _LinePrinter(shown, names)
        all_names = (*(c.name for c in system.coordinates), *map(str, (*system.u, *parameters)))
        words = any(tex(name).startswith(r"\mathrm") for name in all_names)
        in_latex = {s: tex(name, n) for s, (name, n) in dotted.items()}
        in_latex[Symbol("power")] = r"\dot h"  # of Jacobi's integral h
        self._latex = _LatexPrinter(_ambiguous_names(system.definitions) | in_latex, words)

    def internal(self, e: Any) -> Any:
        """Return an expression over the symbols of the system instead of those of the user."""
        return sympy.sympify(e).xreplace(self._internal)

    def terms(self, e: Expr) -> list[Term]:
        """Return the terms of the sum `e`, sorted for printing, each as a pair (subtracted, term).

        Terms in accelerations come first, then terms in velocities, then all others.
        """
        parts = [
            x
            for part in sympy.Add.make_args(self.internal(e))
            for x in self._split_wide_product(part)
        ]
        return [self.term(part) for part in sorted(parts, key=self._place)]

    def _split_wide_product(self, part: Expr) -> list[Expr]:
        """Expand a product that is too wide for a line over its longest sum."""
        sums = [f for f in part.args if f.is_Add] if part.is_Mul else []
        if (distributed := distribute_decimal(part)) is not part:
            return [*distributed.args]
        if not sums or self._block(part).width() <= WIDE - 12:
            return [part]
        longest = max(sums, key=lambda f: (f.count_ops(), str(f)))
        products = [part / longest * x for x in longest.args]
        return [y for x in products for y in sympy.Add.make_args(distribute_decimal(x))]

    def term(self, *factors: Expr) -> Term:
        """Return the product of `factors`, sorted for printing, as a pair (subtracted, term).

        subtracted: True if the numerical coefficient of the product is negative. term: the product
        without this sign.
        """
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
                number = _shown_number(number)
        ordered = [self.sort_expression(f) for f in sorted(others, key=self._factor)]
        if number != 1 or not ordered:
            ordered.insert(0, _shown_number(number))
        product = ordered[0] if len(ordered) == 1 else sympy.Mul(*ordered, evaluate=False)
        return bool(signed < 0), product

    def sort_expression(self, e: Expr) -> Expr:
        """Return an expression equal to `e` whose sums and products are sorted for printing.

        SymPy does not evaluate them, so that the order is preserved.
        """
        if e.is_Add:
            signed = [(-1 if minus else 1, term) for minus, term in self.terms(e)]
            return sympy.Add(*(_negate(x) if s < 0 else x for s, x in signed), evaluate=False)
        if (distributed := distribute_decimal(e)) is not e:
            return self.sort_expression(distributed)
        if e.is_Mul:
            minus, product = self.term(e)
            return _negate(product) if minus else product
        if e.is_Pow:
            return sympy.Pow(self.sort_expression(e.base), e.exp, evaluate=False)
        if isinstance(e, sympy.MatrixBase):
            return sympy.ImmutableDenseMatrix(e.applyfunc(self.sort_expression))
        if isinstance(e, sympy.Function) and len(e.args) == 1:
            return e.func(self.sort_expression(e.args[0]), evaluate=False)
        return _shown_number(e)

    def _factor(self, f: Expr) -> tuple[Any, ...]:
        base = f.base if f.is_Pow else f
        if base.is_Symbol:
            return (*self._rank.get(base, (0, -1)), str(f))
        if base.is_Add:
            return (1, int(f.is_Pow), str(f))
        return (2 if f.is_Pow and not base.is_Function else 6, 0, str(f))

    def _place(self, part: Expr) -> tuple[Any, ...]:
        """Sort key of a term: accelerations, then products of most velocities, then sign."""
        powers = part.as_powers_dict()
        degrees = [sympy.sympify(powers.get(s, 0)) for s in self._rates]
        rank = [-float(n) if n.is_number else 0.0 for n in degrees]
        n = len(rank) // 2
        return (
            *rank[:n],
            sum(rank[n:]),
            *rank[n:],
            bool(part.as_coeff_Mul()[0] < 0),
            sympy.default_sort_key(part),
        )

    def text(self, e: Expr) -> prettyForm:
        """Return an expression as a block of Unicode text, as SymPy's pretty printer makes it.

        An expression that is too wide becomes several lines of plain text.
        """
        if e not in self._blocks:
            block = self._block(e)
            if block.width() > WIDE - 12 and not isinstance(e, sympy.MatrixBase):
                lines = textwrap.wrap(self._line.doprint(e), WIDE - 16, break_on_hyphens=False)
                longest = max(map(len, lines))
                block = prettyForm("\n".join(line.ljust(longest) for line in lines))
            self._blocks[e] = block
        return self._blocks[e]

    def line(self, e: Expr | MatrixBase) -> str:
        """Return an expression as one line of text, or the size of a matrix."""
        if isinstance(e, MatrixBase):
            return f"a matrix ({e.rows}, {e.cols})"
        return self._line.doprint(self.sort_expression(self.internal(e)))

    def _block(self, e: Expr) -> prettyForm:
        unicode = pretty_use_unicode(True)  # whatever the terminal has: what prints escapes
        try:
            return self._text.block(e)
        finally:
            pretty_use_unicode(unicode)

    def latex(self, e: Expr) -> str:
        """Return an expression as LaTeX, without delimiters."""
        printed: str = self._latex.doprint(e)
        return printed

    def rows(self, terms: Iterable[Term], width: int) -> list[list[Term]]:
        """Split the terms of a sum into rows (lists of terms) at most `width` text columns wide."""
        lines: list[list[Term]] = [[]]
        used_width = 0
        for minus, term in terms:
            width_of_term = self.text(term).width() + 3
            if lines[-1] and used_width + width_of_term > width:
                lines.append([])
                used_width = 0
            lines[-1].append((minus, term))
            used_width += width_of_term
        return lines

    def text_lines(self, terms: Sequence[Term], right: Sequence[Term] | None = None) -> list[str]:
        """Return a sum, or an equation, as lines of Unicode text of at most WIDE columns.

        terms: the sum, or the left-hand side. right: terms of the right-hand side, where an empty
        sequence is 0; None for a sum.
        """
        lines: list[str] = []
        rows = self.rows(terms, WIDE - 4)
        indent = 4 if len(terms) == 1 and terms[0][1].is_Symbol else 8  # of more of the right side
        ends = [] if right is None else self.rows(right or [(False, sympy.S.Zero)], WIDE - indent)
        for k, row in enumerate(rows):
            block = self._row(row, "" if k == 0 else "+")
            if ends and k == len(rows) - 1:
                closing = self._row(ends[0], "=")
                joined = _join_blocks(block, closing)
                if joined.width() <= WIDE - 4 * (k > 0):
                    block, ends = joined, ends[1:]
                else:
                    lines += _indent(block, 4 * (k > 0))
                    block, ends = closing, ends[1:]
            lines += _indent(block, 4 * (k > 0))
        for row in ends:
            lines += _indent(self._row(row, "+"), indent)
        return lines

    def _row(self, row: Sequence[Term], begin: str) -> prettyForm:
        printed = prettyForm("")
        for k, (minus, term) in enumerate(row):
            if k:
                sign = " - " if minus else " + "
            elif begin == "+":
                sign = "- " if minus else "+ "
            else:
                sign = ("" if not begin else " = ") + ("-" if minus else "")
            printed = (
                _join_blocks(printed, prettyForm(sign), self.text(term))
                if sign
                else self.text(term)
            )
        return printed

    def latex_lines(self, terms: Sequence[Term], right: Sequence[Term] | None = None) -> list[str]:
        """Return a sum, or an equation, as lines of LaTeX.

        terms: the sum, or the left-hand side. right: terms of the right-hand side, where an empty
        sequence is 0; None for a sum. Lines are broken between terms so that each line would be
        about WIDE columns wide as Unicode text.
        """
        lines = [self._latex_row(row, k > 0) for k, row in enumerate(self.rows(terms, WIDE))]
        if right is not None:
            ends = self.rows(right or [(False, sympy.S.Zero)], WIDE)
            lines[-1] += " = " + self._latex_row(ends[0], False)
            lines += [self._latex_row(row, True) for row in ends[1:]]
        return lines

    def _latex_row(self, row: Sequence[Term], joined: bool) -> str:
        printed = ""
        for k, (minus, term) in enumerate(row):
            sign = ("- " if minus else "+ ") if k or joined else ("-" if minus else "")
            printed += (" " if k else "") + sign + self.latex(term)
        return printed


# --- equations ------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False, eq=False)
class Equation:
    """An equation left = right, or the definition of the name on its left.

    `str` returns it as text, and a notebook shows it typeset.

    Attributes
    ----------
    title : str
        What it is, such as "mass matrix". Equations with the same title are printed together.
    left, right : Expr or Matrix
        The two sides. A definition has a symbol on the left.
    write : Typesetter
        Printer of the two sides.
    note : str
        A further line of text, or "".
    """

    title: str
    left: Expr
    right: Expr | MatrixBase
    write: Typesetter
    note: str = ""

    @property
    def is_definition(self) -> bool:
        """True if the left-hand side is a symbol."""
        return bool(self.left.is_Symbol)

    def entries(self) -> Iterator[Equation]:
        """Yield the equation itself, or, of a matrix that is too wide, those of its entries.

        Entries that are zero are left out, and of the mass matrix those below the diagonal.
        """
        value = self.right
        if not isinstance(value, MatrixBase) or self._matrix().width() <= WIDE:
            yield self
            return
        comma = "," if value.rows > 9 else ""
        for i in range(value.rows):
            for j in range(i if str(self.left) == "D" else 0, value.cols):
                if value[i, j] != 0:
                    place = f"{i + 1}{comma}{j + 1}" if value.cols > 1 else f"{i + 1}"
                    name = Symbol(f"{self.left}_{place}")
                    yield replace(self, left=name, right=value[i, j])

    def _matrix(self) -> prettyForm:
        """Return the matrix on the right as a block of Unicode text."""
        return self.write.text(self.write.sort_expression(self.write.internal(self.right)))

    def _right(self) -> list[Term]:
        return [] if self.right == 0 else self.write.terms(self.right)

    def text_lines(self) -> list[str]:
        """Return the equation as lines of Unicode text of at most WIDE columns."""
        note = [f"    {self.note}"] if self.note else []
        if isinstance(self.right, MatrixBase):
            name, value = self.write.text(self.write.internal(self.left)), self._matrix()
            block = _join_blocks(name, prettyForm(" = "), value)
            fits = block.width() <= WIDE
            return (_indent(block, 0) if fits else [f"{name} =", *_indent(value, 0)]) + note
        return self.write.text_lines(self.write.terms(self.left), self._right()) + note

    def latex_lines(self) -> list[str]:
        """Return the equation as lines of an align environment of LaTeX."""
        write, name = self.write, self.write.latex(self.write.internal(self.left))
        if isinstance(self.right, MatrixBase):
            return [f"  {name} &= {write.latex(write.sort_expression(write.internal(self.right)))}"]
        if self.is_definition:
            first, *more = write.latex_lines(write.terms(self.right))
            first = f"  {name} &= {first}"
        else:
            first, *more = write.latex_lines(write.terms(self.left), self._right())
            first = f"  & {first}"
        return [first, *(CONTINUATION + line for line in more)]

    def __repr__(self) -> str:
        left, right = map(self.write.line, (self.left, self.right))
        return f"<Equation {textwrap.shorten(f'{left} = {right}', 60, placeholder=' ...')}>"

    def __str__(self) -> str:
        return "\n".join(line for entry in self.entries() for line in entry.text_lines())

    def _repr_latex_(self) -> str:
        return write_latex([[self]])


class TypesetMatrix(sympy.ImmutableDenseMatrix):  # type: ignore[misc]
    """A matrix of the equations of motion, which a notebook shows typeset as they are."""

    equation: Equation | None = None  # of a result of a computation, which SymPy typesets

    @classmethod
    def define(cls, equation: Equation) -> TypesetMatrix:
        """Return the matrix on the right-hand side of an equation."""
        matrix: TypesetMatrix = cls(*equation.right.shape, [*equation.right])
        matrix.equation = equation
        return matrix

    def _repr_latex_(self) -> str:
        own = self.equation and write_latex([[self.equation]])
        return str(own or super()._repr_latex_())


def write_text(equations: Iterable[Equation]) -> list[str]:
    """Return equations as sections of Unicode text, one for each title."""
    parts = []
    for title, group in groupby(equations, key=lambda each: each.title):
        members = [*group]
        blank = [""] * (not members[-1].is_definition)
        lines = [line for each in members for line in (*str(each).splitlines(), *blank)]
        parts.append(section(title, lines[: len(lines) - len(blank)]))
    return parts


def write_latex(groups: Iterable[Sequence[Equation]]) -> str:
    """Return equations as LaTeX: one align* environment of amsmath, or several, for each group.

    An environment has at most MAX_ENVIRONMENT_LENGTH characters, unless one equation has more.
    """
    bodies: list[list[str]] = []
    for group in groups:
        bodies.append([])
        for entry in (entry for each in group for entry in each.entries()):
            lines = entry.latex_lines()
            if bodies[-1] and sum(map(len, bodies[-1] + lines)) > MAX_ENVIRONMENT_LENGTH:
                bodies.append([])
            bodies[-1] += lines
    return align(bodies)


def align(bodies: Iterable[Sequence[str]]) -> str:
    """Return an align* environment of LaTeX for each of several lists of lines."""
    return "\n".join(
        r"\begin{align*}" + "\n" + " \\\\\n".join(lines) + "\n" + r"\end{align*}"
        for lines in bodies
        if lines
    )


_FUNCTION = re.compile(r"<mi>(a?(?:sin|cos|tan)h?|exp|log|min|max|arg)</mi>")
_SPACED = r'<mo lspace="0.17em" rspace="0.17em">\1</mo>'


def write_mathml(equations: Iterable[Equation]) -> list[tuple[bool, Markup]]:
    """Return equations as lines of MathML, which browsers show without a script.

    Each line is a pair (continues, MathML), where continues is True if the line continues the
    equation of the previous line. latex2mathml makes them from LaTeX. Raises EomcError if it is not
    installed.
    """
    return [
        (line.startswith(CONTINUATION), _convert_to_mathml(line))
        for each in equations
        for entry in each.entries()
        for line in entry.latex_lines()
    ]


@cache
def _convert_to_mathml(line: str) -> Markup:
    try:
        from latex2mathml.converter import convert
    except ImportError:
        raise EomcError("equations in a page need latex2mathml: pip install latex2mathml") from None
    latex = line.removeprefix(CONTINUATION).replace("&", "", 1).strip()
    converted = convert(latex).replace('display="inline"', 'displaystyle="true"')
    return Markup(_FUNCTION.sub(_SPACED, converted))


def section(head: str, lines: list[str]) -> str:
    """Return `head` and a colon, followed by `lines` indented by four spaces, as one text."""
    return "\n".join([f"{head}:", *("    " + line if line else "" for line in lines)])


def wrap(words: str) -> str:
    """Return text wrapped to lines of WIDE columns; all lines but the first are indented."""
    return "\n    ".join(textwrap.wrap(words, WIDE, break_on_hyphens=False))


# --- numbers and names ----------------------------------------------------------------------------


def _ambiguous_names(definitions: Sequence[tuple[Symbol, Expr]]) -> dict[Symbol, str]:
    """Return upright LaTeX names for definitions that LaTeX would set like others: joint_y_."""
    many = Counter(tex(s.name) for s, _ in definitions)
    whole = (s for s, _ in definitions if many[tex(s.name)] > 1 and "" in s.name.split("_"))
    return {s: r"\mathrm{" + s.name.replace("_", r"\_") + "}" for s in whole}


def _decimal(e: Expr) -> bool:
    """True if a number is shown as a decimal, as in the scene: 0.028 rather than 7/250."""
    if not e.is_Rational or e.q < MIN_DECIMAL_DENOMINATOR:
        return False
    rest = e.q
    for prime in (2, 5):
        while rest % prime == 0:
            rest //= prime
    return bool(rest == 1)


def distribute_decimal(e: Expr) -> Expr:
    """Expand a product of a decimal number and a sum; return any other expression unchanged.

    A decimal number is a fraction that is printed as a decimal, such as 0.028 for 7/250.
    """
    if e.is_Mul and len(e.args) == 2 and _decimal(e.args[0]) and e.args[1].is_Add:
        return sympy.Add(*(e.args[0] * x for x in e.args[1].args))
    return e


def shorten_fractions(value: Expr) -> Expr:
    """Return an expression with decimals or short fractions in place of fractions of many digits.

    Such fractions arise from slanted axes, whose components have 50 digits. Numbers that agree to
    30 digits are merged, and factors below ZERO_TOLERANCE, which are rounding errors of zero, are
    removed.
    """
    if not _long_numbers(value):
        return value
    short = _round_numbers(sympy.expand(value))
    plain = _round_numbers(sympy.expand(short))  # each factor whole again
    return plain.xreplace(
        {x: simple_fraction(x) or sympy.Float(x, 15) for x in _long_numbers(plain)}
    )


def simple_fraction(x: Expr) -> sympy.Rational | None:
    """Return the fraction with at most three digits that rounds to the float64 of x, or None."""
    simple = Fraction(float(x)).limit_denominator(999)
    return sympy.Rational(simple) if float(simple) == float(x) else None


def _shown_number(e: Expr) -> Expr:
    """Return a number as it is printed: as a decimal, or as a fraction of few digits.

    A float of many digits is printed as the fraction that rounds to it, if there is one.
    """
    if e.is_Float and len(repr(float(e))) > MIN_LONG_DECIMAL:
        return simple_fraction(e) or e
    return sympy.Float(e, 15) if _decimal(e) else e


def _round_numbers(e: Expr) -> Expr:
    return e.xreplace(
        {
            x: sympy.Rational(str(sympy.Float(x, 30))) if abs(x) > ZERO_TOLERANCE else 0
            for x in _long_numbers(e)
        }
    )


def _long_numbers(e: Expr) -> set[sympy.Rational]:
    return {x for x in e.atoms(sympy.Rational) if max(abs(x.p), x.q) >= MAX_FRACTION_PART}


def _negate(e: Expr) -> Expr:
    factors = sympy.Mul.make_args(e)
    if factors[0].is_Number:
        return sympy.Mul(-factors[0], *factors[1:], evaluate=False) if factors[1:] else -e
    return sympy.Mul(-1, *factors, evaluate=False)


def _join_blocks(*blocks: prettyForm) -> prettyForm:
    return prettyForm(*stringPict.next(*blocks))


def _indent(block: prettyForm, by: int) -> list[str]:
    return [(" " * by + line).rstrip() for line in str(block).splitlines()]


def _dotted_name(name: str, dots: int) -> str:
    """Return the name of a time derivative: theta2 -> thetadot2, which SymPy prints with a dot."""
    if not dots:
        return name
    base = name.split("_")[0].rstrip("0123456789") or name
    return f"{base}{'d' * (dots - 1)}dot{name[len(base) :]}"


def _set_as_name(name: str) -> str:
    """Return a name with Unicode subscripts if all of them exist, else unchanged."""
    printed = str(pretty_symbol(name))
    return name if {" ", "_"} & {*printed} else printed


class _TextPrinter(PrettyPrinter):  # type: ignore[misc]
    """Prints blocks of Unicode text."""

    def __init__(self, names: dict[Symbol, Symbol], plain: dict[Symbol, str]) -> None:
        super().__init__(
            {"use_unicode": True, "wrap_line": False, "order": "none", "full_prec": False}
        )
        self._names, self._plain = names, plain

    def block(self, e: Expr) -> prettyForm:
        """Return an expression as a block of text, without a conversion to lines."""
        return self._print(e)

    def _print_Symbol(self, e: Symbol, bold_name: bool = False) -> prettyForm:
        return prettyForm(self._plain.get(e) or _set_as_name(self._names.get(e, e).name))

    def _print_dot(self, e: Expr) -> prettyForm:
        inside = prettyForm(*self._print(e.args[0]).parens())
        return prettyForm(*prettyForm("d/dt ").right(inside))


class _LinePrinter(StrPrinter):  # type: ignore[misc]
    """Prints one line of text: √(x + y), x^2."""

    def __init__(self, names: dict[Symbol, Symbol], plain: dict[Symbol, str]) -> None:
        super().__init__({"order": "none", "full_prec": False})
        self._names, self._plain = names, plain

    def _print_Symbol(self, e: Symbol) -> str:
        return self._plain.get(e) or _set_as_name(self._names.get(e, e).name)

    def _print_dot(self, e: Expr) -> str:
        return f"d/dt ({self._print(e.args[0])})"

    def doprint(self, e: Expr) -> str:
        printed: str = super().doprint(e)
        return printed.replace("**", "^").replace("*", "⋅").replace("sqrt(", "√(")


class _LatexPrinter(LatexPrinter):  # type: ignore[misc]
    """Prints LaTeX: upright words, thin spaces between factors that are words, sin θ bare."""

    def __init__(self, names: dict[Symbol, str], words: bool) -> None:
        settings = {"order": "none", "fold_func_brackets": True, "full_prec": False}
        super().__init__(settings | ({"mul_symbol": r" \, "} if words else {}))
        self._names = names

    def doprint(self, expr: Expr) -> str:
        # SymPy makes a subscript of a digit at the end of a name
        return str(super().doprint(expr)).replace("{expm}_{1}", "{expm1}")

    def _print_Symbol(self, e: Symbol, style: str = "plain") -> str:
        return self._names.get(e) or tex(e.name)
