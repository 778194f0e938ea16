"""Rules of Taylor arithmetic: value and derivatives of an operation from those of its arguments.

The names of derivatives are explained in `taylor`, whose lists of operations these rules evaluate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy

from eomc.verify.reference import Vector

Jet = dict[str, Any]  # value and derivatives, rows by states; what is zero is left out
Fields = frozenset[str]


PAIRS = ("vv", "vvs", "N")  # the (nq, nq) ones

# what of a sum's, a product's or a function's arguments, and of e, makes a derivative of dot(e)
FEEDS: Mapping[str, Mapping[str, str]] = {
    "product": {
        "value": "value",
        "s": "value s",
        "x": "value x",
        "v": "value v",
        "xs": "value s x xs",
        "vs": "value s v vs",
        "vv": "value v vv",
        "vvs": "value s v vs vv vvs",
        "N": "value x v N",
    },
    "dot": {"value": "s", "s": "xs", "x": "xs", "v": "x", "vs": "xs"},
}


@dataclass(frozen=True)
class Op:
    """One operation: a rule that is applied to the results of earlier operations.

    Attributes
    ----------
    kind : str
        Its rule, a key of RULES.
    args : tuple of int
        Indices of the operations whose results are its arguments.
    data : object
        A number, index or function that the rule needs.
    degree : float
        Degree in the velocities; inf if it is not a polynomial in them.
    moves : int
        2 if it depends on q, 1 if it depends on t only, else 0.
    rate, has_inputs : bool
        Whether it depends on a time derivative dot(...), and on an input.
    """

    kind: str
    args: tuple[int, ...] = ()
    data: Any = None
    degree: float = 0
    moves: int = 0
    rate: bool = False
    has_inputs: bool = False


@dataclass(frozen=True)
class Point:
    """The b states at which operations are evaluated.

    q, qd: coordinates and velocities, (b, nq). t: time, s. u: inputs. values: parameters. The time
    and each input and parameter are one number or a column (b, 1).
    """

    q: Vector
    qd: Vector
    t: Any
    u: Any
    values: Any

    @cached_property
    def d(self) -> Vector:
        """Time derivative (q̇, 1) of x = (q, t), (b, nq + 1)."""
        return np.concatenate([self.qd, np.ones((len(self.qd), 1))], axis=1)

    def unit(self, i: int, more: int) -> Vector:
        """Return the unit vector along entry i, as a matrix with one row, (1, nq + more).

        more: number of entries after the nq coordinates, such as 1 for the time.
        """
        row = np.zeros((1, self.q.shape[1] + more))
        row[0, i] = 1
        return row


def _weighted(*terms: tuple[Any, Any]) -> Any:
    """Return the sum of w z over pairs (w, z); None counts as zero."""
    total = None
    for w, z in terms:
        if w is None or z is None:
            continue
        part = (w[..., None] if z.ndim == 3 and isinstance(w, np.ndarray) else w) * z
        total = part if total is None else total + part
    return total


def _plus(total: Any, part: Any) -> Any:
    return part if total is None else total if part is None else total + part


def _outer(a: Any, b: Any) -> Any:
    return None if a is None or b is None else a[:, :, None] * b[:, None, :]


def _with_transpose(a: Any, sign: int = 1) -> Any:
    return None if a is None else a + a.swapaxes(1, 2) if sign > 0 else a - a.swapaxes(1, 2)


def _without_none(jet: Jet) -> Jet:
    return {name: part for name, part in jet.items() if part is not None}


def _leaf(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    match op.kind:
        case "number":
            return {"value": op.data}
        case "parameter":
            return {"value": at.values[op.data]}
        case "u":
            return {"value": at.u[op.data]}
        case "t":
            return {"value": at.t, "s": np.ones((1, 1)), "x": at.unit(-1, 1)}
        case "q":
            i = op.data
            return {"value": at.q[:, i, None], "s": at.qd[:, i, None], "x": at.unit(i, 1)}
    return {"value": at.qd[:, op.data, None], "v": at.unit(op.data, 0)}


def _sum(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    out: Jet = {}
    for name in fields:
        total, mine = None, False
        for weight, a in zip(op.data, args, strict=True):
            if name in a:
                part = a[name] if weight == 1 else weight * a[name]
                if total is None:
                    total = part
                elif name in PAIRS and mine and total.shape == part.shape:
                    total += part
                else:
                    total, mine = total + part, True
        if total is not None:
            out[name] = total
    return out


def _product(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    return _times(args[0], args[1], fields)


def _times(a: Jet, b: Jet, fields: Fields) -> Jet:
    """Return the derivatives of a product (Leibniz's rule)."""
    x, y, g, h = a["value"], b["value"], a.get, b.get
    if len(a) == 1:  # a number, or what hangs on parameters alone
        large = x[..., None] if isinstance(x, np.ndarray) else x
        return {n: (large if n in PAIRS else x) * z for n, z in b.items() if n in fields}
    out: Jet = {}
    for name in fields:
        if name == "value":
            out[name] = x * y
            continue
        terms = [(x, h(name)), (y, g(name))]
        if name in ("xs", "vs"):
            terms += [(g("s"), h(name[0])), (h("s"), g(name[0]))]
        elif name == "vvs":
            terms += [(g("s"), h("vv")), (h("s"), g("vv"))]
        total = _weighted(*terms)
        if name == "vv":
            total = _plus(total, _with_transpose(_outer(g("v"), h("v"))))
        elif name == "vvs":
            mixed = _plus(_outer(g("v"), h("vs")), _outer(g("vs"), h("v")))
            total = _plus(total, _with_transpose(mixed))
        elif name == "N":
            mixed = _plus(
                _outer(g("v"), _without_time(h("x"))), _outer(h("v"), _without_time(g("x")))
            )
            total = _plus(total, _with_transpose(mixed, -1))
        out[name] = total
    return _without_none(out)


def _without_time(x: Any) -> Any:
    """Return a row without its entry for t."""
    return None if x is None else x[:, :-1]


def _chain(f: tuple[Any, Any, Any], a: Jet, fields: Fields) -> Jet:
    """Return the value and derivatives of f(a) by the chain rule, from f, f' and f'' at a."""
    value, slope, bend = f
    g = a.get
    out: Jet = {}
    for name in fields:
        if name == "value":
            out[name] = value
        elif name in ("s", "x", "v"):
            out[name] = _weighted((slope, g(name)))
        elif name in ("xs", "vs"):
            turn = None if g("s") is None else bend * g("s")
            out[name] = _weighted((slope, g(name)), (turn, g(name[0])))
        else:  # of K alone, which is a polynomial in the velocities
            raise AssertionError(name)
    return _without_none(out)


def _function(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    return _chain(op.data(args[0]["value"]), args[0], fields)


def _power(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    """Return a^b, as exp(b log a) if b is not constant."""
    a, b = args
    x, y = np.asarray(a["value"]), b["value"]
    value = x**y
    if len(b) == 1:
        slope = _falling(y, x, y - 1)
        return _chain((value, slope, _falling(y * (y - 1), x, y - 2)), a, fields)
    inside = frozenset(f for name in fields for f in FEEDS["product"][name].split())
    exponent = _times(b, _chain(FUNCTIONS[sympy.log](x), a, inside), inside)
    return _chain((value, value, value), exponent, fields)


def _falling(factor: Any, x: Any, y: Any) -> Any:
    """Return factor x^y, or 0 where the factor is 0."""
    return np.where(np.asarray(factor) == 0, 0.0, factor * x**y)


def _atan2(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    """Return the angle of (x, y), by atan in a frame rotated so that y is 0 at this point."""
    inside = frozenset(f for name in fields for f in FEEDS["product"][name].split())
    y, x = args
    r = np.hypot(x["value"], y["value"])
    c, s = x["value"] / r, y["value"] / r
    across, along = (
        _without_none({n: _weighted((i, y.get(n)), (j, x.get(n))) for n in inside - {"value"}})
        for i, j in ((c, -s), (s, c))
    )
    slope = _chain((1 / r, -1 / r**2, 2 / r**3), along | {"value": r}, inside)
    angle = _times(across | {"value": 0 * r}, slope, inside)  # atan' = 1 and atan'' = 0 at 0
    return {n: z for n, z in angle.items() if n in fields} | {
        "value": np.arctan2(y["value"], x["value"])
    }


def _extreme(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    """Return the larger or smaller of two; their mean where they are equal."""
    a, b = args
    larger, x, y = op.data, np.asarray(a["value"]), b["value"]
    first = np.heaviside(x - y if larger else y - x, 0.5)
    corner = _corner(x - y)
    out: Jet = {"value": np.maximum(x, y) if larger else np.minimum(x, y)}
    for name in fields - {"value"}:
        out[name] = _weighted((first, a.get(name)), (1 - first, b.get(name)))
        if name in ("xs", "vs") and out[name] is not None:
            out[name] = out[name] + corner
    return _without_none(out)


def _rate(op: Op, args: list[Jet], fields: Fields, at: Point) -> Jet:
    """Return d/dt, from the derivatives along d = (qd, 1)."""
    (e,) = args
    xs = e.get("xs")
    out: Jet = {
        "value": e.get("s", 0.0),
        "x": xs,
        "v": _without_time(e.get("x")),
        "vs": _without_time(xs),
    }
    if "s" in fields and xs is not None:
        out["s"] = np.sum(xs * at.d, axis=1, keepdims=True)
    return {name: part for name, part in out.items() if name in fields and part is not None}


RULES: Mapping[str, Callable[[Op, list[Jet], Fields, Point], Jet]] = {
    **dict.fromkeys(("number", "parameter", "u", "t", "q", "qd"), _leaf),
    "sum": _sum,
    "product": _product,
    "function": _function,
    "power": _power,
    "atan2": _atan2,
    "extreme": _extreme,
    "dot": _rate,
}


# --- functions: value, first and second derivative ------------------------------------------------

Three = tuple[Any, Any, Any]


def _corner(x: Any) -> Any:
    """Return nan at 0, where the derivative does not exist."""
    return np.where(np.asarray(x) == 0, math.nan, 0.0)


def _asin(x: Any) -> Three:
    slope = 1 / np.sqrt((1 - x) * (1 + x))
    return np.arcsin(x), slope, x * slope**3


def step_at(at_zero: float) -> Callable[[Any], Three]:
    """Return a function of x that computes the step function and its first two derivatives.

    at_zero: value of the step function at x = 0, where the derivatives are nan.
    """
    return lambda x: (np.heaviside(x, at_zero), _corner(x), _corner(x))


FUNCTIONS: Mapping[Any, Callable[[Any], Three]] = {
    sympy.sin: lambda x: (f := np.sin(x), np.cos(x), -f),
    sympy.cos: lambda x: (f := np.cos(x), -np.sin(x), -f),
    sympy.tan: lambda x: (f := np.tan(x), g := 1 + f**2, 2 * f * g),
    sympy.asin: _asin,
    sympy.acos: lambda x: (np.arccos(x), *(-g for g in _asin(x)[1:])),
    sympy.atan: lambda x: (np.arctan(x), g := 1 / (1 + x**2), -2 * x * g**2),
    sympy.sinh: lambda x: (f := np.sinh(x), np.cosh(x), f),
    sympy.cosh: lambda x: (f := np.cosh(x), np.sinh(x), f),
    sympy.tanh: lambda x: (f := np.tanh(x), g := 1 / np.cosh(x) ** 2, -2 * f * g),
    sympy.exp: lambda x: (f := np.exp(x), f, f),
    sympy.log: lambda x: (np.log(x), 1 / x, -1 / x**2),
    sympy.Abs: lambda x: (np.abs(x), np.sign(x), _corner(x)),
    sympy.sign: lambda x: (np.sign(x), _corner(x), _corner(x)),
}
