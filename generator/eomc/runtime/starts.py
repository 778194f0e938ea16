"""Starts that are formulas of parameters, where these have other values than in the scene."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np

from .arguments import Array
from .constrained import Constrained

_OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: operator.truediv, ast.Pow: operator.pow,
    ast.UAdd: operator.pos, ast.USub: operator.neg,
}  # fmt: skip
_FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos,
    "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp,
    "log": np.log, "sqrt": np.sqrt, "atan2": np.arctan2, "abs": np.abs, "sign": np.sign,
    "heaviside": lambda x: np.heaviside(x, 0.5),
    "min": lambda *x: reduce(np.minimum, x), "max": lambda *x: reduce(np.maximum, x),
}  # fmt: skip


def started(model: Constrained, q0: Any, qd0: Any, p: Array) -> tuple[Any, Any]:
    """(q0, qd0); in place of None (..., nq), where the scene starts at parameters (..., np).

    Raises ValueError where a formula has no finite value there.
    """
    many = p.shape[:-1]
    starts = (np.tile(x, (*many, 1)) for x in model._start)
    found = [own if x is None else x for x, own in zip((q0, qd0), starts, strict=True)]
    values = {name: p[..., k].astype(float) for k, name in enumerate(model.parameters)}
    for name, text in model._follows.items():
        half, at = divmod(model._states.index(name), model.nq)
        if (q0, qd0)[half] is not None:
            continue
        tree = ast.parse(text, mode="eval").body
        own = [n.id for n in ast.walk(tree) if isinstance(n, ast.Name)]
        which = [k for k, parameter in enumerate(model.parameters) if parameter in own]
        moved = (p[..., which] != model._p0[which]).any(axis=-1)
        with np.errstate(all="ignore"):
            value = np.broadcast_to(_value(tree, values | {"pi": np.pi}), many)
        if not np.isfinite(value[moved]).all():
            what = ("q0", "qd0")[half]
            raise ValueError(
                f"params: the start of {name}, {text}, is not finite there: give {what}"
            )
        found[half][..., at][moved] = value[moved]
    return found[0], found[1]


def _value(node: ast.expr, values: Mapping[str, Any]) -> Any:
    """A formula's value; eomc has compared each of its nodes with what formulas are made of."""
    match node:
        case ast.Constant(value=number):
            return np.float64(number)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return values[name]
        case ast.UnaryOp(op=op, operand=operand):
            return _OPERATORS[type(op)](_value(operand, values))
        case ast.BinOp(left=left, op=op, right=right):
            return _OPERATORS[type(op)](_value(left, values), _value(right, values))
        case ast.Call(func=ast.Name(id=name), args=args):
            return _FUNCTIONS[name](*(_value(arg, values) for arg in args))
    raise AssertionError(f"unchecked node {ast.dump(node)}")
