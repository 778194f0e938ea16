"""Formula text to a checked syntax tree, and a tree to a value in any algebra.

Scene text is data: it is parsed with `ast`, every node is held against a whitelist, and the
tree is walked by `evaluate`; nothing is ever executed. The same tree gives a float with
`NUMERIC` and a SymPy expression with the table in `system.py`.
"""

from __future__ import annotations

import ast
import difflib
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

MAX_LENGTH = 10_000
MAX_DEPTH = 150
MAX_EXPONENT = 64
MAX_LOG10 = 300  # no number in a formula, folded or written, may pass 1e300

# name -> (fewest, most) arguments
FUNCTIONS: Mapping[str, tuple[int, int]] = {
    **dict.fromkeys(("sin", "cos", "tan", "asin", "acos", "atan"), (1, 1)),
    **dict.fromkeys(("sinh", "cosh", "tanh", "exp", "log", "sqrt"), (1, 1)),
    **dict.fromkeys(("abs", "sign", "heaviside", "dot"), (1, 1)),
    "atan2": (2, 2),
    "min": (2, 32),
    "max": (2, 32),
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

# what people write instead, and the remedy
_FOREIGN: Mapping[type, str] = {
    ast.BitXor: "'^' is not a power here: write '**'",
    ast.FloorDiv: "'//' is not used in formulas: write '/'",
    ast.Mod: "'%' is not used in formulas",
    ast.Compare: "comparisons are not used in formulas: write heaviside(a - b), min or max",
    ast.IfExp: "'if' is not used in formulas: write heaviside(a - b), min or max",
    ast.BoolOp: "'and' and 'or' are not used in formulas: write heaviside, min or max",
    ast.Attribute: "'.' is not used in formulas: names are plain, velocities end in _dot",
    ast.Subscript: "'[...]' is not used in formulas: give each quantity a name of its own",
    ast.Tuple: "a comma stands outside a function call: a decimal point is written '.'",
    ast.Lambda: "'lambda' is not used in formulas",
}


class FormulaError(ValueError):
    """What is wrong with a formula, and where: `column` and `width` count characters of its text."""

    def __init__(self, message: str, column: int = 0, width: int = 1) -> None:
        super().__init__(message)
        self.message = message
        self.column = column
        self.width = width


@dataclass(frozen=True)
class Formula:
    """A formula that has passed the whitelist. `tree` is never changed after it is made."""

    text: str
    tree: ast.expr

    def names(self) -> Iterator[ast.Name]:
        """The names used as values (not functions, not pi), in reading order."""
        called = {id(n.func) for n in ast.walk(self.tree) if isinstance(n, ast.Call)}
        found = [n for n in ast.walk(self.tree) if isinstance(n, ast.Name) and id(n) not in called]
        yield from sorted((n for n in found if n.id != "pi"), key=lambda n: n.col_offset)

    def calls(self, *functions: str) -> Iterator[ast.Call]:
        """The calls of the given functions."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                if node.func.id in functions:
                    yield node

    def part(self, node: ast.expr) -> Formula:
        """The sub-formula that `node` is."""
        return Formula(ast.get_source_segment(self.text, node) or self.text, node)


def suggest(name: str, known: Iterable[str]) -> str:
    """`"; did you mean 'm_c'?"` where a known name is close, else the empty string."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"; did you mean '{near[0]}'?" if near else ""


def parse(text: str) -> Formula:
    """Check `text` and return its tree. Raises FormulaError with the place of the first fault."""
    if len(text) > MAX_LENGTH:
        raise FormulaError(
            f"the formula has {len(text)} characters, more than {MAX_LENGTH}: "
            "split it with [definitions]"
        )
    if not text.strip():
        raise FormulaError("the formula is empty: write 0 if nothing is meant")
    shift = len(text) - len(text.lstrip())
    # newlines are layout in a multi-line TOML string, as inside parentheses
    line = text.strip().replace("\r", " ").replace("\n", " ").replace("\t", " ")
    if not line.isascii():
        at = next(i for i, c in enumerate(line) if not c.isascii())
        raise FormulaError(
            f"'{line[at]}' is not ASCII: write Greek letters out (theta), powers as **, "
            "products as *",
            at + shift,
        )
    try:
        tree = ast.parse(line, mode="eval").body
    except SyntaxError as fault:
        at = max((fault.offset or 1) - 1, 0)
        raise FormulaError(_explain_syntax(line, fault.msg, at), min(at, len(line)) + shift) from None
    except (RecursionError, MemoryError, ValueError):
        raise FormulaError(
            "the formula is nested too deeply: split it with [definitions]"
        ) from None
    formula = Formula(line, tree)
    try:
        _check(formula, tree, 0)
    except FormulaError as fault:
        fault.column += shift
        raise
    return formula


def _explain_syntax(text: str, message: str, at: int) -> str:
    around = text[max(at - 12, 0) : at + 12]
    if "'" in text:
        return "a prime is not a derivative here: write theta_dot for the velocity, dot(e) for de/dt"
    if "=" in text:
        return "'=' is not used in formulas: the name stands left of the TOML '='"
    for i, (a, b) in enumerate(zip(text, text[1:], strict=False)):
        alone = i == 0 or not (text[i - 1].isalnum() or text[i - 1] in "_.")
        if a.isdigit() and b.isalpha() and alone and b not in "eE":
            return f"write products with '*': '{a}*{b}', not '{a}{b}'"
    return f"not a formula near '{around.strip()}' ({message.split(' (')[0]})"


def _fault(formula: Formula, node: ast.expr, message: str) -> FormulaError:
    width = max((node.end_col_offset or 0) - node.col_offset, 1)
    return FormulaError(message, node.col_offset, width)


def _check(formula: Formula, node: ast.expr, depth: int) -> None:
    if depth > MAX_DEPTH:
        raise _fault(
            formula,
            node,
            f"the formula is nested more than {MAX_DEPTH} deep: split it with [definitions]",
        )
    match node:
        case ast.Constant(value=bool()) | ast.Constant(value=complex()):
            raise _fault(formula, node, f"'{node.value}' is not a real number")
        case ast.Constant(value=int() | float() as value):
            if not _in_range(value):
                raise _fault(formula, node, f"the number is larger than 1e{MAX_LOG10}")
        case ast.Name(id=name):
            if name in FUNCTIONS:
                raise _fault(formula, node, f"'{name}' is a function: write {name}(...)")
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            _check(formula, operand, depth + 1)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            _check(formula, left, depth + 1)
            _check(formula, right, depth + 1)
            if isinstance(op, ast.Pow):
                _check_power(formula, left, right)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            if name not in FUNCTIONS:
                raise _fault(
                    formula, node.func, f"'{name}' is not a function{suggest(name, FUNCTIONS)}"
                    + (f" ({', '.join(sorted(FUNCTIONS))})" if not suggest(name, FUNCTIONS) else "")
                )
            least, most = FUNCTIONS[name]
            if not least <= len(args) <= most:
                wanted = str(least) if least == most else f"{least} to {most}"
                plural = "" if wanted == "1" else "s"
                raise _fault(
                    formula, node, f"{name}() takes {wanted} argument{plural}, here {len(args)}"
                )
            for arg in args:
                _check(formula, arg, depth + 1)
        case _:
            kinds = [type(node), type(getattr(node, "op", None))]
            told = next((_FOREIGN[k] for k in kinds if k in _FOREIGN), None)
            raise _fault(
                formula,
                node,
                told or "only numbers, names, + - * / **, parentheses and functions are used here",
            )


def _in_range(value: float) -> bool:
    return value == 0 or math.log10(abs(value)) < MAX_LOG10 if abs(value) != math.inf else False


def _check_power(formula: Formula, base: ast.expr, exponent: ast.expr) -> None:
    power = _number(formula, exponent)
    if power is not None and not abs(power) <= MAX_EXPONENT:
        raise _fault(formula, exponent, f"an exponent is at most {MAX_EXPONENT} in size")
    number = _number(formula, base)
    if number is not None and power is not None and number != 0:
        if not abs(power * math.log10(abs(number))) < MAX_LOG10:
            raise _fault(formula, base, f"the power is larger than 1e{MAX_LOG10}")


def _number(formula: Formula, node: ast.expr) -> float | None:
    """The value of a subtree without names, None if it has names; inf where it can't be had."""
    if any(isinstance(n, ast.Name) and n.id not in FUNCTIONS for n in ast.walk(node)):
        return None
    try:
        value = _walk(formula, node, NUMERIC, {}.__getitem__)
    except (ArithmeticError, ValueError, TypeError):
        return math.inf
    return float(value) if isinstance(value, (int, float)) else math.inf


def evaluate(formula: Formula, algebra: Mapping[str, Any], lookup: Callable[[str], Any]) -> Any:
    """The value of the formula.

    `algebra` maps function names, "pi" and "number" (text of a literal -> value) to callables and
    values; `lookup` gives the value of every other name. Raises what these raise.
    """
    return _walk(formula, formula.tree, algebra, lookup)


def _walk(
    formula: Formula, node: ast.expr, algebra: Mapping[str, Any], lookup: Callable[[str], Any]
) -> Any:
    match node:
        case ast.Constant():
            text = ast.get_source_segment(formula.text, node) or repr(node.value)
            return algebra["number"](text.replace("_", ""))
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


def _literal(text: str) -> float:
    return float(int(text, 0)) if text[:2].lower() in ("0x", "0o", "0b") else float(text)


NUMERIC: Mapping[str, Any] = {
    "number": _literal,
    "pi": math.pi,
    **{name: getattr(math, name) for name in ("sin", "cos", "tan", "asin", "acos", "atan")},
    **{name: getattr(math, name) for name in ("sinh", "cosh", "tanh", "exp", "log", "sqrt")},
    "atan2": math.atan2,
    "abs": abs,
    "sign": lambda x: float((x > 0) - (x < 0)),
    "heaviside": lambda x: 0.5 * ((x > 0) - (x < 0)) + 0.5,
    "min": min,
    "max": max,
}
