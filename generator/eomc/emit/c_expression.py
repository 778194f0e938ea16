"""Programs as C99 text: numbers, expressions and blocks of assignments."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import sympy
from sympy import Expr, S

from eomc.base.errors import EomcError
from eomc.derive.atoms import is_negative
from eomc.derive.tape import Stage
from eomc.program.ir import Call, Function, Operand, Product, Sum, Value, rename
from eomc.program.trig import names_of_pair

MOST_INLINE = 5  # operations; longer expressions get a name of their own
SEVERAL = 3  # angles from which on sines are taken side by side
FOUR = 4  # numbers that are taken or stored at once

# what C calls the functions of a program
C_NAMES = {
    "abs": "fabs",
    **{n: n for n in ("tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh")},
    **{n: n for n in ("exp", "log", "sqrt", "pow", "sin", "cos")},
    "min": "fmin",
    "max": "fmax",
}
PIVOT = "pivot_inverse"  # a function of ours

_STAGE_COMMENTS = {
    Stage.TIME: "time and inputs",
    Stage.POSITION: "configuration",
    Stage.VELOCITY: "velocities",
}


@dataclass(frozen=True)
class Real:
    """A floating-point type: its name in C and Python, the suffix of its literals and functions.

    reach: the largest angle that the sincos of csrc/ takes; 0 where there is none for the type.
    lane: where it is a vector of numbers, what its functions' names end in.
    """

    name: str
    suffix: str
    function_suffix: str
    dtype: str
    epsilon: float
    reach: float
    lane: str = ""


DOUBLE = Real("double", "", "", "float64", 2.0**-52, 2.0**20)
FLOAT = Real("float", "f", "f", "float32", 2.0**-23, 2.0**13)
REALS = {r.name: r for r in (DOUBLE, FLOAT)}
# gcc's, with libquadmath; for references only, since NumPy and most compilers don't know it
QUAD = Real("__float128", "q", "q", "", 2.0**-112, 0.0)


@dataclass(frozen=True)
class Block:
    """Statements with one comment above them."""

    comment: str
    lines: tuple[str, ...]


def number(value: Expr, real: Real = DOUBLE) -> str:
    """A literal that rounds to the nearest `real`: 0.5, 9.81, (8.0/3.0), 3.1415926535897931.

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
    """The nearest double. Raises EomcError where there is none."""
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
    """A literal of 40 digits, or a quotient of numbers that 113 bits hold."""
    if value.is_Rational and max(abs(value.p), value.q) < 2**113:
        return f"{value.p}.0q" if value.q == 1 else f"({value.p}.0q/{value.q}.0q)"
    text = str(value.evalf(40))
    return (text if "." in text or "e" in text else text + ".0") + "q"


def _decimal(value: float) -> str:
    text = repr(value)
    return text if "." in text or "e" in text else text + ".0"


class Printer:
    """Prints one function's values; `where` says how a name from outside is written in C."""

    def __init__(
        self, prefix: str, real: Real, where: Mapping[str, str], in_order: bool = False
    ) -> None:
        self.prefix = prefix
        self.real = real
        self.in_order = in_order
        self.where = dict(where)
        self.inline: dict[str, tuple[str, int]] = {}

    def name(self, name: str, binding: int = 4) -> str:
        """A name as it is written, in parentheses where it binds less than `binding`."""
        if name in self.inline:
            text, strength = self.inline[name]
            return text if strength >= binding else f"({text})"
        return self.where.get(name, name)

    def operand(self, o: Operand, binding: int = 1) -> str:
        """A number times a name."""
        if not o.name:
            return number(o.coefficient, self.real)
        if o.coefficient == 1:
            return self.name(o.name, binding)
        return self.value(Product(o.coefficient, (o.name,)), binding)[0]

    def value(self, value: Value, binding: int = 1) -> tuple[str, int]:
        """The text of a right-hand side and how strongly it binds: 1 sums, 2 products, 4 names."""
        if isinstance(value, Sum):
            text, strength = self._sum(value), 1
        elif isinstance(value, Product):
            text, strength = self._product(value)
        else:
            text, strength = self._call(value)
        return (text, strength) if strength >= binding else (f"({text})", 4)

    def _sum(self, value: Sum) -> str:
        # a positive term first, where there is one and their order is free
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
        factors = [self.name(f, 4) for f in value.factors]
        c = value.coefficient
        sign = "-" if is_negative(c) else ""
        if abs(c) != 1:
            factors.insert(0, number(abs(c), self.real))
        if len(factors) == 1:
            return sign + factors[0], 2 if sign else 4
        return sign + "*".join(factors), 2

    def _call(self, value: Call) -> tuple[str, int]:
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
        args = [self.in_lane(a) for a in value.args]
        text = f"{c_name}({args[0]})" if len(args) == 1 else ""
        if ours:
            text = f"{c_name}({', '.join(args)})"
        if not text:  # min and max of several: pair by pair
            text = args[0]
            for arg in args[1:]:
                text = f"{c_name}({text}, {arg})"
        return text, 4

    def _sign(self, argument: Operand) -> str:
        if self.real.lane:
            return f"{self.prefix}_sign_{self.real.lane}({self.in_lane(argument)})"
        x = self.operand(argument, 4)
        return f"({self.real.name})(({x} > 0) - ({x} < 0))"

    def in_lane(self, o: Operand) -> str:
        """An operand; a number alone in every lane."""
        text = self.operand(o, 1)
        if self.real.lane and not o.name:
            return f"{self.prefix}_same_{self.real.lane}({text})"
        return text


@dataclass(frozen=True)
class Body:
    """A function's statements in blocks, and its results and checks as C expressions."""

    early: tuple[Block, ...]
    blocks: tuple[Block, ...]
    results: tuple[str, ...]
    failures: tuple[str, ...]  # conditions under which D can't be inverted
    sincos: bool  # whether some angle is reduced by our own code

    @property
    def lines(self) -> tuple[str, ...]:
        """Every statement, comments left out."""
        return tuple(line for block in (*self.early, *self.blocks) for line in block.lines)


def body(
    function: Function,
    prefix: str,
    where: Mapping[str, str],
    real: Real = DOUBLE,
    stored: Mapping[str, str] | None = None,
    pivots: int = 0,
    in_order: bool = False,
    reserved: frozenset[str] = frozenset(),
    together: bool = False,
) -> Body:
    """The statements of a function.

    where: how each name from outside is written (`m_c` -> `p->m_c`).
    stored: where values go that are no locals. pivots: how many the whole has, if this is a part.
    in_order: terms of sums stay in their order. reserved: names that no value gets. together: the
    sines of several angles are computed side by side.
    """
    stored = stored or {}
    inline = _inlined(function)
    new = _numbered(function, inline, reserved)
    function = rename(function, new)
    inline = frozenset(new[n] for n in inline)
    # a value may bear the name of something outside that is not read here
    uses = function.uses
    outside = {n: text for n, text in where.items() if n in uses}
    printer = Printer(prefix, real, outside | dict(stored), in_order)
    tolerance = 8 * real.epsilon * max(1, pivots, len(function.checks))

    def set_to(name: str, text: str) -> str:
        return f"{stored.get(name, f'const {real.name} {name}')} = {text};"

    early_lines = []
    for a in function.early:
        text, strength = printer.value(a.value)
        if a.name in inline:
            printer.inline[a.name] = (text, strength)
        else:
            early_lines.append(set_to(a.name, text))
    angles: dict[tuple[Operand, ...], dict[str, str]] = {}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            angles.setdefault(a.value.args, {})[a.value.function] = a.name
    sincos = real.reach > 0 and bool(angles)
    side_by_side, numbers = several(function) if together else {}, count(1)
    lines: dict[Stage, list[str]] = {stage: [] for stage in _STAGE_COMMENTS}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            group = side_by_side.get(a.value.args[0], ())
            if group and a.value.args in angles:
                taken = {angle: angles.pop((angle,)) for angle in group}
                lines[a.stage] += _sincos_several(printer, taken, set_to, numbers)
            elif names := angles.pop(a.value.args, None):
                lines[a.stage] += _sincos(printer, a.value.args[0], names, stored)
            continue
        text, strength = printer.value(a.value)
        if a.name in inline:
            printer.inline[a.name] = (text, strength)
        else:
            lines[a.stage].append(set_to(a.name, text))
    return Body(
        early=(Block("parameters alone", tuple(early_lines)),) if early_lines else (),
        blocks=tuple(Block(_STAGE_COMMENTS[s], tuple(text)) for s, text in lines.items() if text),
        results=tuple(printer.in_lane(o) for o in function.outputs),
        failures=_failures(printer, function.checks, tolerance),
        sincos=sincos,
    )


def _failures(
    printer: Printer, pairs: Iterable[tuple[Operand, Operand]], tolerance: float
) -> tuple[str, ...]:
    """Conditions under which a pivot fails, each once; a positive number always is."""
    asked = [(p, d) for p, d in pairs if p.name or not (p == d and p.coefficient > 0)]
    return tuple(dict.fromkeys(_fails(printer, pair, tolerance) for pair in asked))


def _fails(printer: Printer, pair: tuple[Operand, Operand], tolerance: float) -> str:
    """Whether a pivot is not positive, or no more than what rounding leaves of a diagonal entry.

    Not a number passes: the state behind it is reported as not finite.
    """
    pivot, diagonal = pair
    limit = _decimal(float(f"{tolerance:.1e}")) + printer.real.suffix
    text = printer.operand(pivot, 2)
    if lane := printer.real.lane:
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
    real = printer.real
    argument = printer.operand(angle)
    suffix = real.function_suffix
    if not real.reach:
        made = {n: stored.get(n, f"const {real.name} {n}") for n in names.values()}
        return [f"{made[n]} = {f}{suffix}({argument});" for f, n in names.items()]
    one, other = names_of_pair(names)
    local = [n for n in (one, other) if n not in stored]
    both = ", ".join(f"&{stored.get(n, n)}" for n in (one, other))
    return [
        *([f"{real.name} {', '.join(local)};"] if local else []),
        f"{printer.prefix}_sincos_{real.lane}({argument}, {both}, &failed);"
        if real.lane
        else f"{printer.prefix}_sincos{suffix}({argument}, {both});",
    ]


def several(function: Function) -> Mapping[Operand, Sequence[Operand]]:
    """Angles that come from outside, each with those of its stage, where they are SEVERAL."""
    made = {a.name for a in (*function.early, *function.body)}
    by_stage: dict[Stage, dict[Operand, None]] = {}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            (angle,) = a.value.args
            if angle.name and angle.name not in made:
                by_stage.setdefault(a.stage, {})[angle] = None
    groups = [tuple(group) for group in by_stage.values() if len(group) >= SEVERAL]
    return {angle: group for group in groups for angle in group}


def _sincos_several(
    printer: Printer,
    angles: Mapping[Operand, Mapping[str, str]],
    set_to: Callable[[str, str], str],
    numbers: Iterator[int],
) -> list[str]:
    """Their statements; numbers: of what is still to be named in this function."""
    lane, lines, groups = f"{printer.prefix}_four", list[str](), list(angles.items())
    for first in range(0, len(groups), FOUR):
        some, j = groups[first : first + FOUR], next(numbers)
        x, s, c = (f"{what}{j}_" for what in ("angles", "sines", "cosines"))
        arguments = ", ".join(printer.operand(angle) for angle, _ in some)
        lines += [
            f"{lane} {x} = {{ {arguments} }}, {s}, {c};",
            f"{printer.prefix}_sincos_each_four(&{x}, &{s}, &{c});",
            *(
                set_to(name, f"{ {'sin': s, 'cos': c}[f] }[{k}]")
                for k, (_, names) in enumerate(some)
                for f, name in names.items()
            ),
        ]
    return lines


def _inlined(function: Function) -> frozenset[str]:
    """Short values that are read once, at their own stage, and whose name says nothing."""
    uses: Counter[str] = Counter()
    stage_of_reader: dict[str, Stage] = {}
    everything = (*function.early, *function.body)
    for a in everything:
        twice = isinstance(a.value, Call) and a.value.function in ("sign", "heaviside")
        for name in a.value.names:
            uses[name] += 2 if twice else 1
            stage_of_reader[name] = a.stage
    last = max((a.stage for a in everything), default=Stage.NUMBER)
    for o in function.outputs:
        uses[o.name] += 1
        stage_of_reader.setdefault(o.name, last)
    for pair in function.checks:
        uses.update(2 * [o.name for o in pair])  # read outside the statements
    inline: set[str] = set()
    weight: dict[str, int] = {}
    for a in everything:
        own = len(a.value.names) + (isinstance(a.value, Call))
        weight[a.name] = own + sum(weight[n] for n in a.value.names if n in inline)
        sine = isinstance(a.value, Call) and a.value.function in ("sin", "cos", "reciprocal")
        same = stage_of_reader.get(a.name) == a.stage
        if uses[a.name] == 1 and same and not a.named and not sine:
            if weight[a.name] <= MOST_INLINE:
                inline.add(a.name)
    return frozenset(inline)


def _numbered(
    function: Function, inline: frozenset[str], reserved: frozenset[str]
) -> dict[str, str]:
    """w1, w2, ... counted anew over the values that keep a name."""
    everything = (*function.early, *function.body)
    plain = [a.name for a in everything if not a.named and a.name not in inline]
    taken = function.uses | reserved | {a.name for a in everything if a.named}
    fresh = (w for k in count(1) if (w := f"w{k}") not in taken)
    return dict(zip(plain, fresh, strict=False)) | {name: f"_{name}" for name in inline}


def indent(lines: Iterable[str], width: int = 4) -> str:
    """Lines of one block, indented; long ones broken after operators."""
    whole = [line for text in lines for line in broken(text, 100 - width)]
    return "\n".join((" " * width + line).rstrip() for line in whole)


def broken(text: str, width: int = 100) -> Sequence[str]:
    """A statement or a prototype over several lines, each at most `width` long where it can be."""
    lines = []
    while len(text) > width:
        marks = (", ", " + ", " - ", " || ", "*", " | ", "; ", " = ", "(")
        at = next((k for m in marks if (k := text.rfind(m, 12, width)) > 0), 0)
        if not at:
            break
        at += 1 if text[at] in ",;(" else 0
        lines.append(text[:at])
        text = "    " + text[at:].lstrip()
    return [*lines, text]
