"""The picture of a system made in Python, as [picture] of a scene.

The result is a scene of the system's names and its picture only, with expressions as formulas.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.printing.str import StrPrinter

from eomc.base.errors import SceneError
from eomc.model import api_arguments
from eomc.model.symbols import Coordinate, Parameter
from eomc.scene import read
from eomc.scene.scene import Scene

_EXAMPLE = '{"points": {"tip": ["l*sin(theta)", "-l*cos(theta)"]}, "lines": [[[0, 0], "tip"]]}'
_WORDS = (  # phrases of messages, for TOML and for Python
    ('lines = [["cart", "tip"]]', '"lines": [["cart", "tip"]]'),
    ("[picture.points], such as tip = [", '"points", such as "tip": ['),
    (
        'a table, such as { tip = ["x", "l*cos(theta)"] }',
        'a dict, such as {"tip": ["x", "l*cos(theta)"]}',
    ),
    ("a list of tables with", "a list of dicts with"),
    ('[{ at = "cart", size = [0.4, 0.2] }]', '[{"at": "cart", "size": [0.4, 0.2]}]'),
    ('[{ at = "wheel", radius = 0.1 }]', '[{"at": "wheel", "radius": 0.1}]'),
    (", here a table", ", here a dict"),
    (", here true", ", here True"),
    (", here false", ", here False"),
)
_NAMES = {"Abs": "abs", "Max": "max", "Min": "min"}


def picture_scene(
    picture: Any, expression: Callable[[Any, str], Expr], coordinates: Iterable[Coordinate],
    parameters: Iterable[Parameter], inputs: Iterable[str],
    definitions: Sequence[tuple[Symbol, Expr]],
) -> tuple[Scene, str]:  # fmt: skip
    """Return a scene with the picture of a system made in Python, and the picture as JSON text.

    Parameters
    ----------
    picture
        The argument `picture` of System.make.
    expression
        Function that converts a user's expression; called with (expression, description of it for
        messages).
    coordinates, parameters, inputs
        Quantities that the picture may use; the scene declares all of them.
    definitions
        Pairs (symbol, expression) that the picture may use; the scene contains those that it needs.

    Raises
    ------
    EomcError
        If the picture is invalid.
    """
    if not isinstance(picture, Mapping):
        raise api_arguments.fault("picture", f"give a dict, such as {_EXAMPLE}, here {picture!r}")
    table = _written(picture, expression)
    coordinates = [*coordinates]
    tree: dict[str, Any] = {
        "eomc": 1,
        "name": "pictured",
        "coordinates": {c.name: _metres(c) for c in coordinates},
        "parameters": {p.name: {"value": p.value, **_metres(p)} for p in parameters},
        "inputs": {name: {} for name in inputs},
        "definitions": _used(table, definitions),
        "energy": {"kinetic": f"{coordinates[0].name}_dot**2"},  # required in a scene; not drawn
        "picture": table,
    }
    try:
        scene = read.check_tree(tree, "System.make")
    except SceneError as wrong:
        problems = [replace(p, message=in_python(p.message)) for p in wrong.problems]
        raise SceneError(problems) from None
    return scene, json.dumps(table, sort_keys=True, default=str)


def in_python(message: str) -> str:
    """Return a message about the table [picture] with Python syntax in place of TOML syntax."""
    for toml, python in _WORDS:
        message = message.replace(toml, python)
    return message


def _metres(one: Coordinate | Parameter) -> dict[str, str]:
    """Return the unit if it is a length, the only one that pictures use."""
    return {"unit": "m"} if one.unit == "m" else {}


def _written(value: Any, expression: Callable[[Any, str], Expr]) -> Any:
    """Convert a value to that of a scene: expressions to formulas, sequences to lists."""
    if isinstance(value, Mapping):
        return {str(key): _written(entry, expression) for key, entry in value.items()}
    if isinstance(value, sympy.MatrixBase):
        value = value.flat()
    if hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_written(entry, expression) for entry in value]
    if isinstance(value, Expr):
        return text(expression(value, "picture"))
    return value


def _used(table: Any, definitions: Sequence[tuple[Symbol, Expr]]) -> dict[str, str]:
    """Return the definitions on which a picture depends, in their order."""
    names = {*re.findall(r"[A-Za-z_]\w*", json.dumps(table, default=str))}
    used: dict[str, str] = {}
    for name, expr in reversed(definitions):
        if name.name in names:
            names |= {s.name for s in expr.free_symbols if isinstance(s, Symbol)}
            used[name.name] = text(expr)
    return dict(reversed(used.items()))


class _Formula(StrPrinter):  # type: ignore[misc]  # SymPy has no types
    """Printer of SymPy expressions as formulas of scenes."""

    def _print_Function(self, expr: Any) -> str:
        name = type(expr).__name__
        return f"{_NAMES.get(name, name)}({self.stringify(expr.args, ', ')})"

    _print_Max = _print_Min = _print_Abs = _print_Function

    def _print_Heaviside(self, expr: Any) -> str:
        return f"heaviside({self._print(expr.args[0])})"

    def _print_Float(self, expr: Any) -> str:
        return repr(float(expr))

    def _print_Exp1(self, expr: Any) -> str:
        return "exp(1)"

    def _print_NumberSymbol(self, expr: Any) -> str:
        return repr(float(expr))

    def _print_Pi(self, expr: Any) -> str:
        return "pi"


def text(expr: Expr) -> str:
    """Return a SymPy expression as a formula in the syntax of scenes.

    >>> x = Symbol("x")
    >>> text(sympy.Abs(x) ** 2 / 2 + sympy.exp(1) * sympy.Max(x, 0))
    'exp(1)*max(0, x) + abs(x)**2/2'
    """
    return str(_Formula().doprint(expr))
