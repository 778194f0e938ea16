"""Parse formulas to checked syntax trees, and evaluate trees in any algebra.

The text of a scene is data: it is parsed with `ast`, every node is checked against a whitelist, and
the tree is evaluated by `evaluate`; nothing is executed. The same tree gives a float with `NUMERIC`
and a SymPy expression with the algebra of `model/algebra.py`.
"""

from __future__ import annotations

import ast
import difflib
import keyword
import math
import operator
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

from eomc.base import names, texts
from eomc.runtime import mathematics
from eomc.scene import hints

MAX_LENGTH = 10_000
MAX_DEPTH = 150
MAX_EXPONENT = 64
MAX_DIGITS = 1_000  # of a literal
MAX_CANDIDATES = 1_000  # names that are compared for similarity
MAX_LOG10 = 300  # numbers in a formula, folded or written, must be below 1e300

# name -> (fewest, most) arguments
FUNCTIONS: Mapping[str, tuple[int, int]] = {
    **{f.name: f.argument_counts for f in mathematics.FUNCTIONS.values()},
    "dot": (1, 1),
}

_OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}

_ALLOWED = "numbers, names, + - * / **, parentheses and functions"
_ENOUGH = "17 are all that a double holds"
_TOO_DEEP = "the formula is nested too deeply: split it with [definitions]"


class FormulaError(ValueError):
    """An error in a formula.

    column: index of the first faulty character in the text of the formula. width: number of faulty
    characters.
    """

    def __init__(self, message: str, column: int = 0, width: int = 1) -> None:
        super().__init__(message)
        self.message = message
        self.column = column
        self.width = width


@dataclass(frozen=True)
class Formula:
    """A formula that contains only permitted syntax.

    text: the formula as written. tree: its Python syntax tree, which must not be changed.
    expression: the SymPy expression, if System.make was given one; `text` is then a print of it.
    """

    text: str
    tree: ast.expr
    expression: Any = None

    def __str__(self) -> str:
        return self.text

    @property
    def shown(self) -> str:
        """The text for messages, shortened to 80 characters."""
        return self.text if len(self.text) <= 80 else self.text[:79] + "…"

    def names(self) -> Iterator[ast.Name]:
        """Yield the syntax nodes of the names of quantities in the formula, from left to right.

        Names of functions and pi are left out. A name that occurs twice is yielded twice.
        """
        called = {id(n.func) for n in ast.walk(self.tree) if isinstance(n, ast.Call)}
        nodes = [n for n in ast.walk(self.tree) if isinstance(n, ast.Name) and id(n) not in called]
        yield from sorted((n for n in nodes if n.id != "pi"), key=lambda n: n.col_offset)

    def calls(self, *functions: str) -> Iterator[ast.Call]:
        """Yield the syntax nodes of the calls of functions with the given names."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                if node.func.id in functions:
                    yield node


Value = float | str | Formula  # an entry of a scene: a number, the text of a formula, a formula


def nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return the name in `known` that is most similar to `name`, or "" if none is similar.

    cutoff: smallest similarity, from 0 to 1, as in `difflib.get_close_matches`.
    """
    known = list(known)
    same = [k for k in known if k.lower() == name.lower()]
    with_prefix = [k for k in known if k.startswith(name)] if len(name) > 2 else []  # tol, dir
    if len(known) > MAX_CANDIDATES:  # difflib takes a tenth of a millisecond each
        known = [k for k in known if k[:1] == name[:1] and abs(len(k) - len(name)) < 2][
            :MAX_CANDIDATES
        ]
    close = same or difflib.get_close_matches(name, known, n=1, cutoff=cutoff)
    return next(iter(close or (with_prefix if len(with_prefix) == 1 else [])), "")


def suggest(name: str, known: Iterable[str]) -> str:
    """Return a suggestion for an unknown name, such as "; did you mean 'm_c'?".

    known: the names that can be suggested. Returns "" if none of them is similar to `name`.
    """
    near = nearest(name, known)
    return f"; did you mean '{texts.line(near)}'?" if near else ""


def parse(text: str) -> Formula:
    """Parse the text of a formula, check that it has only permitted syntax, and return it.

    Raises FormulaError, which contains the place of the error in the text, its length and a remedy.
    """
    # newlines are layout in a multi-line TOML string, as inside parentheses
    line = text.replace("\n", " ").replace("\t", " ").strip(" ")
    if len(line) > MAX_LENGTH:
        raise FormulaError(
            f"the formula has {len(line)} characters, more than {MAX_LENGTH}: "
            "split it with [definitions]"
        )
    if not line:
        raise FormulaError("the formula is empty: write 0 if nothing is meant")
    for at, c in enumerate(line):
        if c in hints.CHARACTERS:
            raise _character_error(line, at)
        if not " " <= c <= "~":
            raise FormulaError(f"'{c}' is not used in formulas: only {_ALLOWED}", at)
    try:
        # Python remarks on odd literals, such as 1or 2
        with warnings.catch_warnings(action="ignore"):
            tree = ast.parse(line, mode="eval").body
    except SyntaxError as fault:
        raise _explain_syntax(line, fault) from None
    except (RecursionError, MemoryError, ValueError):
        raise FormulaError(_TOO_DEEP) from None
    formula = Formula(line, tree)
    _check(formula, tree, 0)
    return formula


def _character_error(line: str, at: int) -> FormulaError:
    """Return the error for the character at `at`; the remedy depends on the text before it."""
    before = line[max(at - 40, 0) : at]
    if line[at] == "°" and (number := re.search(r"(?<![\w.])[\d.]+(?= *$)", before)):
        start = at - len(before) + number.start()
        message = f"angles are in radians: write {number[0]}*pi/180"
        return FormulaError(message, start, at + 1 - start)
    word = re.search(r"[A-Za-z_]\w*$", before)
    name = word[0] if word else "theta"
    power = re.match(r"\^(\d)\(", line[at : at + 3])
    if power and name in FUNCTIONS:
        message = f"write powers behind the function: {name}(...)**{power[1]}"
        return FormulaError(message, at - len(name), len(name) + 2)
    return FormulaError(hints.CHARACTERS[line[at]].format(name), at)


# 2m, then m g, then )m
_PRODUCT = re.compile(
    r"(?<![\w.])(?!0[xob])(\d[\d.]*)(?![eE][+-]?\d)([A-Za-z_]\w*)|([\w.]+) +([\w.]+)|(\)) *([\w.]+)"
)


def _explain_syntax(text: str, fault: SyntaxError) -> FormulaError:
    if "too many nested" in fault.msg:
        return FormulaError(_TOO_DEEP)
    if long := re.search(rf"\d{{{MAX_DIGITS},}}", text):
        message = f"a number has more than {MAX_DIGITS:,} digits: {_ENOUGH}"
        return FormulaError(message, long.start(), len(long[0]))
    for word in re.finditer(r"[A-Za-z_]\w*", text):
        if keyword.iskeyword(word[0]) and word[0] not in ("if", "else", "and", "or", "not"):
            why = names.fault(word[0]) or ""
            return FormulaError(why, word.start(), len(word[0]))
    product = _PRODUCT.search(text)
    if product and not {"if", "else", "and", "or", "not", "in", "is"} & set(product.groups()):
        left, right = (group for group in product.groups() if group)
        place = product.start(), len(product[0])
        if right in ("deg", "degree", "degrees") and left[:1].isdigit():
            return FormulaError(f"angles are in radians: write {left}*pi/180", *place)
        if left in FUNCTIONS:
            return FormulaError(f"'{left}' is a function: write {left}({right})", *place)
        return FormulaError(
            f"write products with '*': '{left}*{right}', not '{product[0]}'", *place
        )
    at = min(max((fault.offset or 1) - 1, 0), len(text) - 1)
    around = text[max(at - 12, 0) : at + 12].strip()
    return FormulaError(f"not a formula near '{around}' ({fault.msg.split(' (')[0]})", at)


def _fault(node: ast.expr, message: str) -> FormulaError:
    width = max((node.end_col_offset or 0) - node.col_offset, 1)
    return FormulaError(message, node.col_offset, width)


def _check(formula: Formula, node: ast.expr, depth: int, power: float = 1) -> None:
    """Check `node` against the whitelist; `power` is the product of the exponents around it."""
    if depth > MAX_DEPTH:
        raise FormulaError(
            f"the formula is nested more than {MAX_DEPTH} deep, each term of a sum counted: "
            "split it with [definitions]",
            node.col_offset,
        )
    match node:
        case ast.Constant(value=bool() | complex() as value):
            raise _fault(node, f"'{value}' is not a real number")
        case ast.Constant(value=int() | float()) if len(_literal_of(formula, node)) > MAX_DIGITS:
            raise _fault(node, f"a number has more than {MAX_DIGITS:,} digits: {_ENOUGH}")
        case ast.Constant(value=int() | float() as value):
            written = re.fullmatch(r"[\d.]+e([+-]?\d+)", _literal_of(formula, node))
            # 0e999999999 too, whose exact value costs what it says
            if not _in_range(value) or (written and abs(float(written[1])) > MAX_LOG10):
                raise _fault(node, f"numbers lie between 1e-{MAX_LOG10} and 1e{MAX_LOG10} in size")
        case ast.Name(id=name):
            if name in FUNCTIONS:
                raise _fault(node, f"'{name}' is a function: write {name}(...)")
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            _check(formula, operand, depth + 1, power)
        case ast.BinOp(
            left=ast.Name(id=name),
            op=ast.Pow(),
            right=ast.Call(func=ast.Constant(value=int(raised))),
        ) if name in FUNCTIONS:
            raise _fault(node, f"write powers behind the function: {name}(...)**{raised}")
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            _check(formula, right, depth + 1)
            exponent = _number(formula, right)
            if exponent is not None:
                power = _exponent_product(right, exponent, power)
            _check(formula, left, depth + 1, power)
            _check_value(formula, node)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            _check(formula, left, depth + 1, power)
            _check(formula, right, depth + 1, power)
            if isinstance(op, ast.Div) and _number(formula, right) == 0:
                raise _fault(right, "divides by zero")
            _check_value(formula, node)
        case ast.Call(func=ast.Name(id=name) as func, args=args, keywords=[]):
            _check_call(func, node)
            for arg in args:
                _check(formula, arg, depth + 1, power)
            _check_value(formula, node)
        case ast.Call(func=ast.Attribute(attr=name) as func) if name in FUNCTIONS:
            raise _fault(func, f"functions stand by themselves: write {name}(...)")
        case ast.Call(func=ast.Attribute() | ast.Lambda() as func):
            raise _fault(func, hints.SYNTAX[type(func)])
        case ast.Call(func=func) if not isinstance(func, ast.Name):
            raise _fault(func, "write products with '*': a parenthesis follows without one")
        case ast.Tuple(elts=[first, *_]):
            raise FormulaError(
                "a comma stands outside a function call: a decimal point is written '.'",
                formula.text.index(",", first.end_col_offset),
            )
        case _:
            kinds = (type(node), type(getattr(node, "op", None)))
            remedy = next((hints.SYNTAX[k] for k in kinds if k in hints.SYNTAX), None)
            raise _fault(node, remedy or f"only {_ALLOWED} are used here")


def unknown_function(name: str) -> str:
    """Return the message, with a remedy, for the name of a function that formulas do not have."""
    if name in hints.FUNCTIONS:
        return f"'{name}' is not used in formulas: {hints.FUNCTIONS[name]}"
    alias = hints.FUNCTION_ALIASES.get(name)
    near = f"; did you mean '{alias}'?" if alias else suggest(name, FUNCTIONS)
    known = f": write {texts.line(name)}*(...) for a product; functions are {', '.join(FUNCTIONS)}"
    return f"'{name}' is not a function{near or known}"


def _check_call(func: ast.Name, call: ast.Call) -> None:
    name, argument_count = func.id, len(call.args)
    if name not in FUNCTIONS:
        raise _fault(func, unknown_function(name))
    minimum, maximum = FUNCTIONS[name]
    if not minimum <= argument_count <= maximum:
        count = str(minimum) if minimum == maximum else f"{minimum} to {maximum}"
        plural = "" if count == "1" else "s"
        raise _fault(call, f"{name}() takes {count} argument{plural}, here {argument_count}")


def _in_range(value: float) -> bool:
    return value == 0 or (abs(value) < math.inf and abs(math.log10(abs(value))) < MAX_LOG10)


def _exponent_product(node: ast.expr, exponent: float, power: float) -> float:
    """Return the product of the exponents. Raises FormulaError if it is too large."""
    if not abs(exponent) <= MAX_EXPONENT:
        raise _fault(node, f"an exponent lies between -{MAX_EXPONENT} and {MAX_EXPONENT}")
    if abs(power * exponent) > MAX_EXPONENT:
        raise _fault(node, f"the exponents of a power of a power pass {MAX_EXPONENT} together")
    return power * max(abs(exponent), 1)


def _check_value(formula: Formula, node: ast.expr) -> None:
    value = _number(formula, node)
    if value is not None and not abs(value) < math.inf:
        why = domain_advice(replace(formula, tree=node), dict[str, Any]().__getitem__)
        raise _fault(node, f"has no real, finite value{why}")


def _number(formula: Formula, node: ast.expr) -> float | None:
    """Return the value of a subtree; nan if not real and finite, None if it has names."""
    names_used = (n.id for n in ast.walk(node) if isinstance(n, ast.Name))
    if any(name not in FUNCTIONS and name != "pi" for name in names_used):
        return None
    try:
        value = _walk(formula, node, _CONSTANT_ALGEBRA, _CONSTANT_ALGEBRA.__getitem__)
        return float(value) if isinstance(value, (int, float)) else math.nan
    except (ArithmeticError, ValueError, TypeError):
        return math.nan


def evaluate(formula: Formula, algebra: Mapping[str, Any], lookup: Callable[[str], Any]) -> Any:
    """Evaluate a formula with the given functions and values, and return its value.

    algebra: dict from the name of each function to a callable. It also maps "pi" to a value and
    "number" to a callable that converts the text of a number. Use `NUMERIC` to compute with floats.
    lookup: function that returns the value of any other name. Exceptions that these callables raise
    are not caught.
    """
    return _walk(formula, formula.tree, algebra, lookup)


def domain_advice(formula: Formula, lookup: Callable[[str], Any]) -> str:
    """Return ": log(x) is real where x > 0" if a function is evaluated outside its domain, or "".

    lookup: function that returns the value of a name.
    """
    advice = ""
    for call in formula.calls(*(f.name for f in mathematics.ANALYTIC if f.domain)):
        f = mathematics.FUNCTIONS[ast.unparse(call.func)]
        try:
            _walk(formula, call, _CONSTANT_ALGEBRA, lookup)
        except (ArithmeticError, ValueError, TypeError, KeyError):  # inner calls come last
            advice = f": {f.name}({', '.join(f.arguments)}) is real where {f.domain}"
    return advice


def fold_values(formula: Formula, values: Mapping[str, float]) -> str:
    """Return the text of a formula in which the names in `values` are replaced by their values."""

    class Folded(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.expr:
            if node.id not in values:
                return node
            number = ast.Constant(abs(values[node.id]))
            return ast.UnaryOp(ast.USub(), number) if values[node.id] < 0 else number

    return ast.unparse(Folded().visit(deepcopy(formula.tree)))


def _walk(
    formula: Formula, node: ast.expr, algebra: Mapping[str, Any], lookup: Callable[[str], Any]
) -> Any:
    match node:
        case ast.Constant():
            return algebra["number"](_literal_of(formula, node))
        case ast.Name(id="pi"):
            return algebra["pi"]
        case ast.Name(id=name):
            return lookup(name)
        case ast.UnaryOp(op=op, operand=operand):
            return _OPERATORS[type(op)](_walk(formula, operand, algebra, lookup))
        case ast.BinOp(left=left, op=op, right=right):
            return _OPERATORS[type(op)](
                _walk(formula, left, algebra, lookup), _walk(formula, right, algebra, lookup)
            )
        case ast.Call(func=ast.Name(id=name), args=args):
            return algebra[name](*(_walk(formula, arg, algebra, lookup) for arg in args))
    raise AssertionError(f"unchecked node {ast.dump(node)}")


def _literal_of(formula: Formula, node: ast.Constant) -> str:
    """Return the text of a number as written, so that 0.1 may stay exact."""
    return formula.text[node.col_offset : node.end_col_offset].replace("_", "").lower()


def _literal(text: str) -> float:
    return float(int(text, 0)) if text[:2] in ("0x", "0o", "0b") else float(text)


NUMERIC: Mapping[str, Any] = {"number": _literal, "pi": math.pi, **mathematics.DOUBLES}
_CONSTANT_ALGEBRA = {**NUMERIC, "dot": lambda _: 0.0}  # numbers have no rate
