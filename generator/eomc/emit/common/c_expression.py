"""C99 text of programs: numbers, expressions and blocks of assignments."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import sympy
from sympy import Expr, S

from eomc.base.errors import EomcError
from eomc.derive.tape import Stage, is_negative
from eomc.program.ir import Call, Function, Operand, Product, Sum, Value, names_of_pair, rename
from eomc.runtime.mathematics import FUNCTIONS

MAX_INLINE_OPERATIONS = 5  # longer expressions get a name of their own
MIN_SIMD_ANGLES = 3  # angles from which on sines are computed in vector registers
FOUR = 4  # numbers in a vector register

# C names of the functions of a program
C_NAMES = {"pow": "pow", **{name: str(f.name_in("c")) for name, f in FUNCTIONS.items()}}
PIVOT = "pivot_inverse"  # defined in the generated code

_STAGE_COMMENTS = {
    Stage.TIME: "time and inputs",
    Stage.POSITION: "configuration",
    Stage.VELOCITY: "velocities",
}


@dataclass(frozen=True)
class Real:
    """A floating-point type of C and NumPy.

    Attributes
    ----------
    name, dtype
        Name in C and name in NumPy.
    suffix, function_suffix
        Suffix of C literals, and of functions of the C mathematics library.
    epsilon
        Distance from 1 to the next larger number.
    reach
        Largest angle (rad) for which the project's own sincos is valid; 0 if there is none.
    lane
        For vectors of numbers in a register, the suffix of C functions for them; otherwise "".
    """

    name: str
    suffix: str
    function_suffix: str
    dtype: str
    epsilon: float
    reach: float
    lane: str = ""

    def __str__(self) -> str:
        return self.name

    @property
    def epsilon_name(self) -> str:
        """The C macro for `epsilon`, of <float.h>."""
        return "FLT_EPSILON" if self.suffix else "DBL_EPSILON"

    def literal(self, value: float) -> str:
        """Return a C literal of this type, such as 0.5f."""
        text = repr(value)
        decimal = text if "." in text or "e" in text or "n" in text else text + ".0"
        return decimal + self.suffix

    def literals(self, values: Iterable[float]) -> tuple[str, ...]:
        """Return each value as a C literal of this type."""
        return tuple(map(self.literal, values))

    def function(self, name: str) -> str:
        """Return the name of a function of the C mathematics library for this type: fabsf, fabs."""
        return name + self.function_suffix


DOUBLE = Real("double", "", "", "float64", 2.0**-52, 2.0**20)
FLOAT = Real("float", "f", "f", "float32", 2.0**-23, 2.0**13)
REALS = {r.name: r for r in (DOUBLE, FLOAT)}
# gcc with libquadmath; for reference solutions only, since NumPy and most compilers lack it
QUAD = Real("__float128", "q", "q", "", 2.0**-112, 0.0)


@dataclass(frozen=True)
class Block:
    """C statements, in lines, with one comment above them ("" for none)."""

    comment: str
    lines: tuple[str, ...]


def number(value: Expr, real: Real = DOUBLE) -> str:
    """Return a C literal that rounds to the nearest number of the type `real`.

    Fractions without an exact decimal form become quotients, if numerator and denominator are
    small.

    >>> number(sympy.Rational(8, 3)), number(sympy.Rational(1, 100)), number(sympy.pi)
    ('(8.0/3.0)', '0.01', '3.141592653589793')
    """
    if real.name == QUAD.name:
        return _quad(value)
    if value.is_Rational:
        nearest = _nearest(value)
        text = _decimal(nearest)
        if sympy.Rational(text) != value and max(abs(value.p), value.q) < 2**24:
            return (
                f"({_decimal(float(value.p))}{real.suffix}/{_decimal(float(value.q))}{real.suffix})"
            )
        return text + real.suffix
    return _decimal(_nearest(value.evalf(25))) + real.suffix


def _nearest(value: Expr) -> float:
    """Return the nearest double. Raises EomcError on overflow."""
    try:
        nearest = float(value)
    except OverflowError:
        nearest = math.inf
    if not math.isfinite(nearest):
        raise EomcError(
            f"the equations hold a number of {value.evalf(2)}, more than a double can be: "
            "choose units in which numbers are nearer to 1"
        )
    return nearest


def _quad(value: Expr) -> str:
    """Return a literal with 40 digits, or a quotient of numbers of at most 113 bits."""
    if value.is_Rational and max(abs(value.p), value.q) < 2**113:
        return f"{value.p}.0q" if value.q == 1 else f"({value.p}.0q/{value.q}.0q)"
    text = str(value.evalf(40))
    return (text if "." in text or "e" in text else text + ".0") + "q"


def _decimal(value: float) -> str:
    """Return a decimal literal."""
    return DOUBLE.literal(value)


class Printer:
    """Translator of the values of one function of a program into C expressions.

    Parameters
    ----------
    prefix
        The scene's name, with which the names of generated C functions begin.
    real
        C type of the values.
    where
        The C expression of each variable that the function does not compute, by name.
    in_order
        Whether to keep the order of the terms of sums.
    """

    def __init__(
        self, prefix: str, real: Real, where: Mapping[str, str], in_order: bool = False
    ) -> None:
        self.prefix = prefix
        self.real = real
        self.in_order = in_order
        self.where = dict(where)
        self.inline: dict[str, tuple[str, int]] = {}

    def name(self, name: str, binding: int = 4) -> str:
        """Return the C expression of the variable `name`.

        The expression is in parentheses if it binds less strongly than `binding`: 1 for sums, 2 for
        products and 4 for names.
        """
        if name in self.inline:
            text, strength = self.inline[name]
            return text if strength >= binding else f"({text})"
        return self.where.get(name, name)

    def operand(self, o: Operand, binding: int = 1) -> str:
        """Return the C expression of an operand.

        An operand is a number, a variable, or a number times a variable. The expression is in
        parentheses if it binds less strongly than `binding`: 1 for sums, 2 for products and 4 for
        names.
        """
        if not o.name:
            return number(o.coefficient, self.real)
        if o.coefficient == 1:
            return self.name(o.name, binding)
        return self.value(Product(o.coefficient, (o.name,)), binding)[0]

    def value(self, value: Value, binding: int = 1) -> tuple[str, int]:
        """Return the right-hand side of an assignment as a C expression, and its binding strength.

        The strength is 1 for sums, 2 for products and 4 for names. An expression that binds less
        strongly than `binding` is put in parentheses.
        """
        if isinstance(value, Sum):
            text, strength = self._sum(value), 1
        elif isinstance(value, Product):
            text, strength = self._product(value)
        else:
            text, strength = self._call(value)
        return (text, strength) if strength >= binding else (f"({text})", 4)

    def _sum(self, value: Sum) -> str:
        """Return the text of a sum."""
        # A positive term comes first, if there is one and the order is free.
        terms = sorted(value.terms, key=lambda p: not self.in_order and is_negative(p[0]))
        text = ""
        if value.constant is not S.Zero and not is_negative(value.constant):
            text = number(value.constant, self.real)
        for weight, name in terms:
            sign = "-" if is_negative(weight) else "+"
            body = self.operand(Operand(abs(weight), name), 2)
            if not text:
                text = f"-{body}" if sign == "-" else body
            else:
                text += f" {sign} {body}"
        if is_negative(value.constant):
            text += f" - {number(-value.constant, self.real)}"
        return text

    def _product(self, value: Product) -> tuple[str, int]:
        """Return the text of a product and its binding strength."""
        factors = [self.name(f, 4) for f in value.factors]
        c = value.coefficient
        sign = "-" if is_negative(c) else ""
        if abs(c) != 1:
            factors.insert(0, number(abs(c), self.real))
        if len(factors) == 1:
            return sign + factors[0], 2 if sign else 4
        return sign + "*".join(factors), 2

    def _call(self, value: Call) -> tuple[str, int]:
        """Return the text of a call and its binding strength."""
        one = "1.0" + self.real.suffix
        if value.function == "reciprocal":
            return f"{one}/{self.operand(value.args[0], 4)}", 2
        if value.function in ("sign", "heaviside"):
            sign = self._sign(value.args[0])
            half = "0.5" + self.real.suffix
            return (sign, 4) if value.function == "sign" else (f"{half} + {half}*{sign}", 1)
        ours = value.function == PIVOT
        c_name = PIVOT if ours else C_NAMES[value.function] + self.real.function_suffix
        if self.real.lane:
            c_name = f"{self.prefix}_{c_name}_{self.real.lane}"
        elif ours:
            c_name = f"{self.prefix}_{c_name}"
        args = [self.vector_operand(a) for a in value.args]
        text = f"{c_name}({args[0]})" if len(args) == 1 else ""
        if ours:
            text = f"{c_name}({', '.join(args)})"
        if not text:  # min and max of several: pair by pair
            text = args[0]
            for arg in args[1:]:
                text = f"{c_name}({text}, {arg})"
        return text, 4

    def _sign(self, argument: Operand) -> str:
        """Return the text of the sign of an operand."""
        if self.real.lane:
            return f"{self.prefix}_sign_{self.real.lane}({self.vector_operand(argument)})"
        x = self.operand(argument, 4)
        return f"({self.real.name})(({x} > 0) - ({x} < 0))"

    def vector_operand(self, o: Operand) -> str:
        """Return the C expression of an operand as a vector, if values are vectors.

        A number is then broadcast to a vector. Otherwise the text is that of `operand`.
        """
        text = self.operand(o, 1)
        if self.real.lane and not o.name:
            return f"{self.prefix}_same_{self.real.lane}({text})"
        return text


@dataclass(frozen=True)
class CBody:
    """The C statements of a function in blocks, with its results as C expressions.

    Attributes
    ----------
    early, blocks
        Statements that depend on parameters only, and all others.
    results
        The results of the function.
    failures
        C conditions under which a factored matrix, such as D, is singular.
    sincos
        Whether the statements call the project's own sincos.
    """

    early: tuple[Block, ...]
    blocks: tuple[Block, ...]
    results: tuple[str, ...]
    failures: tuple[str, ...]
    sincos: bool

    @property
    def lines(self) -> tuple[str, ...]:
        """The lines of all C statements, without the comments of the blocks."""
        return tuple(line for block in (*self.early, *self.blocks) for line in block.lines)


@dataclass(frozen=True)
class CContext:
    """The C code in which statements stand: its names and its type of numbers.

    Attributes
    ----------
    prefix
        The scene's name, with which the names of all generated C functions begin.
    real
        C type of the numbers.
    reserved
        Names that no local variable may have.
    """

    prefix: str
    real: Real = DOUBLE
    reserved: frozenset[str] = frozenset()


def body(
    function: Function,
    context: CContext,
    where: Mapping[str, str],
    stored: Mapping[str, str] | None = None,
    pivots: int = 0,
    in_order: bool = False,
    together: bool = False,
) -> CBody:
    """Return a function of a program as C statements.

    Parameters
    ----------
    function
        The function, a list of elementary assignments.
    context
        The C code in which the statements stand.
    where
        The C expression of each variable that the function does not compute, by name. An example
        is `p->m_c` for the parameter m_c.
    stored
        C expressions, by name, of values that are assigned to them rather than to local variables.
    pivots
        Number of pivots that are tested in the whole function, if `function` is a part of it. The
        tolerance of these tests, which detect singular matrices, is proportional to it.
    in_order
        Whether to keep the order of the terms of sums.
    together
        Whether to compute the sines of several angles together in vector registers.
    """
    stored, real = stored or {}, context.real
    inline = _inlined(function)
    new = _numbered(function, inline, context.reserved)
    function = rename(function, new)
    inline = frozenset(new[n] for n in inline)
    # A value may have the same name as an argument that is not read here.
    uses = function.uses
    outside = {n: text for n, text in where.items() if n in uses}
    printer = Printer(context.prefix, real, outside | dict(stored), in_order)
    tolerance = 8 * real.epsilon * max(1, pivots, len(function.checks))

    def set_to(name: str, text: str) -> str:
        """Return the assignment of a value."""
        return f"{stored.get(name, f'const {real.name} {name}')} = {text};"

    angles: dict[tuple[Operand, ...], dict[str, str]] = {}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            angles.setdefault(a.value.args, {})[a.value.function] = a.name
    sincos = real.reach > 0 and bool(angles)
    side_by_side, numbers = group_angles(function) if together else {}, count(1)
    early = list[str]()
    lines: dict[Stage, list[str]] = {stage: [] for stage in _STAGE_COMMENTS}
    for a in (*function.early, *function.body):
        statements = lines.get(a.stage, early)
        if a.stage in lines and isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            group = side_by_side.get(a.value.args[0], ())
            if group and a.value.args in angles:
                taken = {angle: angles.pop((angle,)) for angle in group}
                statements += _sincos_several(printer, taken, set_to, numbers)
            elif names := angles.pop(a.value.args, None):
                statements += _sincos(printer, a.value.args[0], names, stored)
        elif a.name in inline:
            printer.inline[a.name] = printer.value(a.value)
        else:
            statements.append(set_to(a.name, printer.value(a.value)[0]))
    # positive constants can't fail
    checked = [(p, d) for p, d in function.checks if p.name or not (p == d and p.coefficient > 0)]
    failures = dict.fromkeys(_fails(printer, pair, tolerance) for pair in checked)
    return CBody(
        early=(Block("parameters alone", tuple(early)),) if early else (),
        blocks=tuple(Block(_STAGE_COMMENTS[s], tuple(text)) for s, text in lines.items() if text),
        results=tuple(printer.vector_operand(o) for o in function.outputs),
        failures=tuple(failures),
        sincos=sincos,
    )


def _fails(printer: Printer, pair: tuple[Operand, Operand], tolerance: float) -> str:
    """Return the C condition that a pivot is not larger than the rounding error of its diagonal.

    NaN passes: the resulting state is reported as not finite.
    """
    pivot, diagonal = pair
    limit = _decimal(float(f"{tolerance:.1e}")) + printer.real.suffix
    text = printer.operand(pivot, 2)
    if lane := printer.real.lane:
        text = printer.vector_operand(pivot)
        less = "" if pivot == diagonal else f" - {limit}*{printer.operand(diagonal, 4)}"
        return f"{printer.prefix}_not_positive_{lane}({text}{less})"
    if pivot == diagonal:
        return f"{text} <= 0"
    return f"{text} <= {limit}*{printer.operand(diagonal, 4)}"


def _sincos(
    printer: Printer,
    angle: Operand,
    names: Mapping[str, str],
    stored: Mapping[str, str],
) -> list[str]:
    """Return the statements for sine and cosine of one angle."""
    real = printer.real
    argument = printer.operand(angle)
    suffix = real.function_suffix
    if not real.reach:
        targets = {n: stored.get(n, f"const {real.name} {n}") for n in names.values()}
        return [f"{targets[n]} = {f}{suffix}({argument});" for f, n in names.items()]
    sine, cosine = names_of_pair(names)
    local = [n for n in (sine, cosine) if n not in stored]
    both = ", ".join(f"&{stored.get(n, n)}" for n in (sine, cosine))
    return [
        *([f"{real.name} {', '.join(local)};"] if local else []),
        f"{printer.prefix}_sincos_{real.lane}({argument}, {both}, &failed);"
        if real.lane
        else f"{printer.prefix}_sincos{suffix}({argument}, {both});",
    ]


def group_angles(function: Function) -> Mapping[Operand, Sequence[Operand]]:
    """Return the groups of angles whose sines can be computed together in vector registers.

    The result maps each angle of a group to all angles of its group. The angles are arguments of
    the function. Those of a group depend on the same kind of variables (time, position or
    velocity). A group has at least MIN_SIMD_ANGLES angles.
    """
    computed = {a.name for a in (*function.early, *function.body)}
    by_stage: dict[Stage, dict[Operand, None]] = {}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            (angle,) = a.value.args
            if angle.name and angle.name not in computed:
                by_stage.setdefault(a.stage, {})[angle] = None
    groups = [tuple(group) for group in by_stage.values() if len(group) >= MIN_SIMD_ANGLES]
    return {angle: group for group in groups for angle in group}


def _sincos_several(
    printer: Printer,
    angles: Mapping[Operand, Mapping[str, str]],
    set_to: Callable[[str, str], str],
    numbers: Iterator[int],
) -> list[str]:
    """Return the statements for sines of several angles.

    numbers: numbers for names of variables.
    """
    lane, lines, groups = f"{printer.prefix}_four", list[str](), list(angles.items())
    for first in range(0, len(groups), FOUR):
        group, j = groups[first : first + FOUR], next(numbers)
        x, s, c = (f"{quantity}{j}_" for quantity in ("angles", "sines", "cosines"))
        arguments = ", ".join(printer.operand(angle) for angle, _ in group)
        lines += [
            f"{lane} {x} = {{ {arguments} }}, {s}, {c};",
            f"{printer.prefix}_sincos_each_four(&{x}, &{s}, &{c});",
            *(
                set_to(name, f"{ {'sin': s, 'cos': c}[f] }[{k}]")
                for k, (_, names) in enumerate(group)
                for f, name in names.items()
            ),
        ]
    return lines


def _inlined(function: Function) -> frozenset[str]:
    """Return the names of values that are inserted into the expression that uses them.

    These are short, used once in their own stage, and have no name that is meaningful to readers.
    """
    uses: Counter[str] = Counter()
    stage_of_reader: dict[str, Stage] = {}
    assignments = (*function.early, *function.body)
    for a in assignments:
        twice = isinstance(a.value, Call) and a.value.function in ("sign", "heaviside")
        for name in a.value.names:
            uses[name] += 2 if twice else 1
            stage_of_reader[name] = a.stage
    last = max((a.stage for a in assignments), default=Stage.NUMBER)
    for o in function.outputs:
        uses[o.name] += 1
        stage_of_reader.setdefault(o.name, last)
    for pair in function.checks:
        uses.update(2 * [o.name for o in pair])  # read outside the statements
    inline: set[str] = set()
    weight: dict[str, int] = {}
    for a in assignments:
        operations = len(a.value.names) + (isinstance(a.value, Call))
        weight[a.name] = operations + sum(weight[n] for n in a.value.names if n in inline)
        sine = isinstance(a.value, Call) and a.value.function in ("sin", "cos", "reciprocal")
        same_stage = stage_of_reader.get(a.name) == a.stage
        if uses[a.name] == 1 and same_stage and not a.named and not sine:
            if weight[a.name] <= MAX_INLINE_OPERATIONS:
                inline.add(a.name)
    return frozenset(inline)


def _numbered(
    function: Function, inline: frozenset[str], reserved: frozenset[str]
) -> dict[str, str]:
    """Return new names of values by their present names.

    Values without meaningful names become w1, w2, ...; inlined values get a leading "_".
    """
    assignments = (*function.early, *function.body)
    plain = [a.name for a in assignments if not a.named and a.name not in inline]
    used = function.uses | reserved | {a.name for a in assignments if a.named}
    fresh = (w for k in count(1) if (w := f"w{k}") not in used)
    return dict(zip(plain, fresh, strict=False)) | {name: f"_{name}" for name in inline}


def indent(lines: Iterable[str], width: int = 4) -> str:
    """Return lines of C as one text, indented by `width` spaces.

    Long lines are broken after operators.
    """
    all_lines = [line for text in lines for line in break_line(text, 100 - width)]
    return "\n".join((" " * width + line).rstrip() for line in all_lines)


def break_line(text: str, width: int = 100) -> Sequence[str]:
    """Return a C statement or prototype, broken into lines of at most `width` characters.

    A line is longer where it cannot be broken.
    """
    lines = []
    while len(text) > width:
        separators = (
            ", ",
            " + ",
            " - ",
            " || ",
            " && ",
            " ? ",
            " : ",
            "*",
            " | ",
            "; ",
            " = ",
            "(",
        )
        position = next((k for m in separators if (k := text.rfind(m, 12, width)) > 0), 0)
        if not position:
            break
        position += 1 if text[position] in ",;(" else 0
        lines.append(text[:position])
        text = "    " + text[position:].lstrip()
    return [*lines, text]
