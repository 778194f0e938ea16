"""Initial states: values by name, and the scene's formulas of parameters."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np

from .arguments import Array, as_number, by_name, not_one_of
from .interfaces import CompiledModel

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


def is_by_name(q0: Any, qd0: Any) -> bool:
    """Return True if the initial positions q0 or velocities qd0 are a mapping by name."""
    return hasattr(q0, "keys") or hasattr(qd0, "keys")


def initial_state_for_parameters(
    model: CompiledModel, q0: Any, qd0: Any, p: Array, many_values: bool = False
) -> tuple[Any, Any]:
    """Return the initial state (q0, qd0), completed by the scene's initial values.

    An initial value of the scene may be a formula of parameters; it is evaluated for the parameters
    p.

    Parameters
    ----------
    q0, qd0 : array, mapping or None
        Arrays are returned unchanged. Mappings give values by the names of coordinates; all other
        values are those of the scene. None: all values are those of the scene.
    p : (np,) or (n, np) array
        Parameters; with (n, np) the completed arrays are (n, nq).
    many_values : bool
        Whether values of the mappings may be (n,), one for each instance.

    Returns
    -------
    q0, qd0 : (nq,) or (n, nq) arrays

    Raises
    ------
    ValueError
        For unknown names, or if a formula has no finite value.
    """
    mappings = [values_by_name(model, x, half, many_values) for half, x in enumerate((q0, qd0))]
    many = _instances(mappings, p.shape[:-1])
    p = np.broadcast_to(p, (*many, p.shape[-1]))
    result = [
        x if named_values is None else np.tile(own, (*many, 1))
        for x, own, named_values in zip((q0, qd0), model.info.initial_state, mappings, strict=True)
    ]
    for x, named_values in zip(result, mappings, strict=True):
        for name, value in (named_values or {}).items():
            x[..., model.info.coordinates.index(name)] = value
    values = {name: p[..., k].astype(float) for k, name in enumerate(model.info.parameters)}
    for name, text in model.info.start_formulas.items():
        half, at = divmod(model.info.states.index(name), model.info.nq)
        named_values = mappings[half]
        if named_values is None or model.info.coordinates[at] in named_values:
            continue
        tree = ast.parse(text, mode="eval").body
        own = [n.id for n in ast.walk(tree) if isinstance(n, ast.Name)]
        which = [k for k, parameter in enumerate(model.info.parameters) if parameter in own]
        changed = (p[..., which] != model.info.p0[which]).any(axis=-1)
        with np.errstate(all="ignore"):
            value = np.broadcast_to(_value(tree, values | {"pi": np.pi}), many)
        if not np.isfinite(value[changed]).all():
            what = ("q0", "qd0")[half]
            raise ValueError(
                f"params: the start of {name}, {text}, is not finite there: give {what}"
            )
        result[half][..., at][changed] = value[changed]
    return result[0], result[1]


def _instances(
    mappings: list[dict[str, Array] | None], of_parameters: tuple[int, ...]
) -> tuple[int, ...]:
    """Return the leading shape of the initial state, from the parameters or the values by name."""
    result = {of_parameters: "params"} if of_parameters != (1,) else {}
    for what, values in zip(("q0", "qd0"), mappings, strict=True):
        for name, value in (values or {}).items():
            if value.size > 1:
                result.setdefault(value.shape, f"{what}: {name}")
    if len(result) > 1:
        (one, whose), (other, its) = list(result.items())[:2]
        raise ValueError(f"{its}: {other[0]} instances where {whose} has {one[0]}")
    return next(iter(result), of_parameters)


def values_by_name(
    model: CompiledModel, x: Any, half: int, many: bool = False
) -> dict[str, Array] | None:
    """Check a mapping of initial values by coordinate name and return it as a dict of arrays.

    x: the user's argument q0 or qd0. half: 0 if x are positions, 1 if they are velocities, whose
    names may end with "_dot". many: values may be (n,), one for each instance. Returns {} if x is
    None, and None if x is an array. Raises ValueError for unknown names.
    """
    if x is None:
        return {}
    if not hasattr(x, "keys"):
        return None
    what, result = ("q0", "qd0")[half], dict[str, Array]()
    moving = [
        name for name in model.info.coordinates if name not in model.info.discrete_coordinates
    ]
    known = moving if half else model.info.coordinates
    for key, value in by_name(x).items():
        name = key.removesuffix("_dot") if half and key not in known else key
        if name not in known:
            if not half and key.removesuffix("_dot") in moving:
                raise ValueError(f"q0: '{key}' is a velocity: give it in qd0")
            raise ValueError(not_one_of(what, key, known))
        if name in result:
            raise ValueError(f"{what}: '{name}' is given twice, as '{name}' and as '{name}_dot'")
        if many and np.ndim(value) == 1:
            result[name] = model.arguments.numbers(value, f"{what}: {name}")
            if not np.isfinite(result[name]).all():
                raise ValueError(f"{what}: {name}: not all numbers are finite")
        else:
            result[name] = np.array(as_number(value, f"{what}: {name}"))
    return result


def _value(node: ast.expr, values: Mapping[str, Any]) -> Any:
    """Evaluate a formula; eomc has checked each of its nodes when the module was built."""
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
