"""Independent reference for large systems, by automatic differentiation with dual numbers.

No formula is expanded or differentiated. A dual number is a value x with a tangent x', the
derivative of x by something; the rules of differentiation are its arithmetic (Griewank & Walther,
*Evaluating Derivatives*, 2nd ed., ch. 13). Value and tangent are arrays with a row for each state,
or dual numbers again, which gives higher derivatives. Formulas are evaluated along the definitions,
in their order, from coordinates that are dual numbers. The reference starts from the `System` and
has nothing else in common with the compiler, which differentiates formulas backwards.

The equations of motion are those of Lagrange in Nielsen's form, with T = K - a·q̇ (a·q̇ is the linear
potential):

    bias = ∂(dT/dt)/∂q̇ - 2 ∂T/∂q + ∂P/∂q,  dT/dt at q̈ = 0
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

import numpy as np
import sympy
from numpy.typing import ArrayLike
from sympy import Expr

from eomc.model.algebra import CLASSES, compile_function
from eomc.model.symbols import needed_definitions
from eomc.model.system import System, dot, t
from eomc.runtime.mathematics import ANALYTIC, MathFunction, numpy_functions
from eomc.scene import formulas
from eomc.verify.reference import SCALARS, ReferenceModel, Values, Vector

BLOCK = 2**16  # entries of the (nq, nq) matrices of all states evaluated at once, for the cache


# --- dual numbers ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Dual:
    """A value and its tangent, a derivative; None stands for a tangent of zero.

    Both are numbers, arrays or dual numbers. Other numbers and arrays are constants. In one
    calculation, all dual numbers are nested equally deep, so that each level has one meaning.
    """

    value: Any
    tangent: Any = None
    __array_ufunc__ = None  # NumPy leaves products of arrays and dual numbers to this class

    def __add__(self, other: Any) -> Any:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, _plus(self.tangent, other.tangent))
        return Dual(self.value + other, self.tangent)

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, Dual):
            tangent = _plus(_times(self.value, other.tangent), _times(other.value, self.tangent))
            return Dual(self.value * other.value, tangent)
        return Dual(self.value * other, _times(other, self.tangent))

    def __matmul__(self, other: Any) -> Any:
        if isinstance(other, Dual):
            tangent = None if other.tangent is None else self.value @ other.tangent
            if self.tangent is not None:
                tangent = _plus(tangent, self.tangent @ other.value)
            return Dual(self.value @ other.value, tangent)
        return Dual(self.value @ other, None if self.tangent is None else self.tangent @ other)

    def __rmatmul__(self, other: Any) -> Any:
        return Dual(other @ self.value, None if self.tangent is None else other @ self.tangent)

    @property
    def T(self) -> Dual:
        """The transpose."""
        return Dual(self.value.T, None if self.tangent is None else self.tangent.T)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Dual:
        return Dual(-self.value, _times(-1.0, self.tangent))

    def __sub__(self, other: Any) -> Any:
        return self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return other + (-self)

    def __truediv__(self, other: Any) -> Any:
        return self * (1 / other)

    def __rtruediv__(self, other: Any) -> Any:
        inverse = 1 / self.value
        return Dual(other * inverse, _times(-other * inverse * inverse, self.tangent))

    def __pow__(self, exponent: Any) -> Any:
        if isinstance(exponent, Dual):
            return exponent.raise_base(self)
        if self.tangent is None:
            return Dual(self.value**exponent)
        # x^0 has the slope 0 at x = 0, too
        less = exponent - 1 if np.all(exponent) else np.where(exponent == 0, 0.0, exponent - 1)
        return Dual(self.value**exponent, exponent * self.value**less * self.tangent)

    def __rpow__(self, base: Any) -> Any:
        return self.raise_base(Dual(base))

    def raise_base(self, base: Dual) -> Dual:
        """Return base^x, as exp(x log base)."""
        x, y = base.value, self.value
        slope = _times(FUNCTIONS["log"](x), self.tangent)
        return Dual(power := x**y, _times(power, _plus(slope, _times(y / x, base.tangent))))


def _plus(a: Any, b: Any) -> Any:
    return b if a is None else a if b is None else a + b


def _times(a: Any, b: Any) -> Any:
    return None if b is None else a * b


def differentiable(evaluate: Callable[..., Any], slopes: Sequence[Callable[..., Any]]) -> Any:
    """Return a function of numbers, arrays and dual numbers.

    evaluate: the function of numbers and arrays. slopes: its derivatives with respect to each
    argument, as functions of the same arguments.
    """

    def apply(*args: Any) -> Any:
        if not any(isinstance(x, Dual) for x in args):
            return evaluate(*args)
        base = [x.value if isinstance(x, Dual) else x for x in args]
        tangents = [
            slope(*base) * x.tangent
            for x, slope in zip(args, slopes, strict=False)
            if isinstance(x, Dual) and x.tangent is not None
        ]
        return Dual(apply(*base), reduce(_plus, tangents, None))

    return apply


def _slopes(f: MathFunction) -> list[Callable[..., Any]]:
    """Return the derivatives of a function, from the formulas in its row of the table."""

    def slope(text: str) -> Callable[..., Any]:
        formula = formulas.parse(text)

        def evaluate(*args: Any) -> Any:
            known = dict(zip(f.arguments, args, strict=True))
            return formulas.evaluate(formula, ALGEBRA, known.__getitem__)

        return evaluate

    return [slope(text) for text in f.derivatives]


def _corner(x: Any, *_: Any) -> Any:
    """Return nan at 0, where the derivative does not exist, and 0 elsewhere."""
    while isinstance(x, Dual):
        x = x.value
    return np.where(np.asarray(x) == 0, math.nan, 0.0)


def time_derivative(x: Any, levels: int = 1) -> Any:
    """Return dx/dt, if the outermost levels of dual numbers are derivatives by time."""
    if not isinstance(x, Dual) or x.tangent is None:
        return 0.0
    return Dual(x.tangent, time_derivative(x.tangent, levels - 1) if levels > 1 else None)


_ARRAYS = numpy_functions()
_STEP = differentiable(np.heaviside, [_corner])
_SIGN = differentiable(np.sign, [_corner])


def _extreme(name: str) -> Callable[..., Any]:
    """Return min or max; where two arguments are equal, the derivative is the mean of theirs."""

    def share(x: Any, y: Any) -> Any:
        return _STEP(x - y if name == "max" else y - x, 0.5)

    slopes = [share, lambda x, y: share(y, x)]
    two = differentiable(_ARRAYS[name], slopes)
    return lambda *args: reduce(two, args)


FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    **{f.name: differentiable(_ARRAYS[f.name], _slopes(f)) for f in ANALYTIC},
    "abs": differentiable(np.abs, [_SIGN]),
    "sign": _SIGN,
    "heaviside": _STEP,
    "min": _extreme("min"),
    "max": _extreme("max"),
}
ALGEBRA: Mapping[str, Any] = {"number": float, "pi": math.pi, **FUNCTIONS}
# by the names of SymPy; it prints sign(x) as a comparison, unless it is a function unknown to SymPy
_JUMP = sympy.Function("jump")
COMPILED = {
    **{CLASSES[name].__name__: f for name, f in FUNCTIONS.items() if name in CLASSES},
    "sqrt": FUNCTIONS["sqrt"],
    "jump": _SIGN,
    "dot": time_derivative,
}


def compile_formulas(
    arguments: Sequence[Any],
    expressions: Sequence[Any],
    definitions: Sequence[tuple[Any, Expr]],
    levels: int = 1,
) -> Callable[..., list[Any]]:
    """Return a function that evaluates expressions with numbers, arrays or dual numbers.

    levels: number of levels of derivatives by time, of which dot(...) takes one.
    """

    def printable(e: Any) -> Expr:
        return sympy.sympify(e).replace(sympy.sign, _JUMP)

    known = [(name, printable(e)) for name, e in needed_definitions(definitions, expressions)]
    functions = {**COMPILED, "dot": partial(time_derivative, levels=levels)}
    return compile_function(arguments, [*map(printable, expressions)], [functions], known)


def nested_rates(expressions: Iterable[Expr], definitions: Iterable[tuple[Expr, Expr]]) -> int:
    """Return how many time derivatives dot(...) are nested in expressions and definitions."""
    known: dict[Expr, int] = {}

    def find(e: Expr) -> int:
        if e not in known:
            known[e] = max(map(find, e.args), default=0) + isinstance(e, dot)
        return known[e]

    for name, body in definitions:
        known[name] = find(body)
    return max(map(find, expressions), default=0)


# --- the reference --------------------------------------------------------------------------------


@dataclass(frozen=True)
class StateVariables:
    """Coordinates, velocities and the time at b states, as arrays (b, 1) or as dual numbers."""

    q: Sequence[Any]
    qd: Sequence[Any]
    t: Any

    def with_tangents(
        self, q: Iterable[Any] | None = None, qd: Iterable[Any] | None = None, t: Any = None
    ) -> StateVariables:
        """Return the variables with a level of tangents: those of q, qd and t; None for zero."""
        return StateVariables(
            [*map(Dual, self.q, q)] if q is not None else [*map(Dual, self.q)],
            [*map(Dual, self.qd, qd)] if qd is not None else [*map(Dual, self.qd)],
            Dual(self.t, t),
        )

    @property
    def in_time(self) -> StateVariables:
        """The variables with their derivatives by time at q̈ = 0 as tangents."""
        return self.with_tangents(q=self.qd, t=1.0)


def part_of(x: Any, *levels: str) -> Any:
    """Return a part of a dual number: "value" or "tangent" of each level, the outermost first."""
    for level in levels:
        x = getattr(x, level) if isinstance(x, Dual) else x if level == "value" else None
    return 0.0 if x is None else x


class TaylorReference(ReferenceModel):
    """Reference that evaluates equations of motion with dual numbers instead of formulas.

    A reference is the independent evaluation of a system in Python, with which modules are
    compared. The quantities have the same meaning as in `symbolic.derive`.

    D is ∂²T/∂q̇². With J = ∂bias/∂q̇, C = (J(q̇) + J(0))/2: this is the sum of Christoffel's terms,
    the gyroscopic terms and the explicit ∂D/∂t. There are no difference quotients: each value is
    exact up to a few roundings of its largest terms.
    """

    def __init__(self, system: System) -> None:
        self.system = s = system
        holonomic = [c.formula for c in s.constraints if c.holonomic]
        self.formulas: dict[str, list[Expr]] = {
            "K": [s.kinetic],
            "T": [s.kinetic - s.linear_potential],
            "P": [s.potential],
            "R": [s.dissipation],
            "Q": [*(s.forces or (sympy.S.Zero,) * len(s.q))],
            "u": [i.signal for i in s.inputs],
            "y": [y for y, _ in s.applied],
            "F": [force for _, force in s.applied],
            "phi": holonomic,
            "psi": [c.formula for c in s.constraints if not c.holonomic],
        }
        self._functions: dict[str, tuple[Callable[..., Any], bool]] = {}

    def value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        """Return the value of `name`; see `ReferenceModel.value`."""
        inputs = None if u is None else np.asarray(u, float)
        if q.ndim == 1:
            row = None if inputs is None else inputs[None]
            return self._rows(name, q[None], qd[None], t, row, values)[0][()]
        step = max(1, BLOCK // q.shape[1] ** 2)
        blocks = []
        for part in (slice(k, k + step) for k in range(0, len(q), step)):
            time, us, *each = (z[part] if np.ndim(z) else z for z in (t, inputs, *values))
            blocks.append(self._rows(name, q[part], qd[part], time, us, each))
        return np.concatenate(blocks)

    def _rows(
        self, name: str, q: Vector, qd: Vector, t: Any, u: Any, values: Sequence[Any]
    ) -> Vector:
        """Return the value of `name` at b states: q, qd (b, nq), u (b, nu) or None."""
        if name == "signals" or not self.system.inputs:
            u = np.zeros((1, len(self.system.inputs)))
        elif u is None:
            u = self._rows("signals", q, qd, t, None, values)
        axes = 2 if name in ("D", "C") else 1  # beside the one of the states

        def column(z: Any) -> Any:
            return np.asarray(z, float).reshape(-1, *[1] * axes) if np.ndim(z) else np.float64(z)

        at = StateVariables([*map(column, q.T)], [*map(column, qd.T)], column(t))
        constants = [column(z) for z in (*u.T, *values)]
        with np.errstate(all="ignore"):
            result = np.array(_Evaluation(self, at, constants, len(q)).value(name))
        result[~np.isfinite(result.reshape(len(result), -1)).all(axis=1)] = math.nan
        return result[:, 0] if name in SCALARS else result

    def evaluate_formulas(
        self, root: str, x: StateVariables, constants: Sequence[Any]
    ) -> list[Any]:
        """Return the values of the formulas of `root`, such as "K", at some states.

        constants: values of the inputs and of the parameters.
        """
        if root not in self._functions:
            s, exprs = self.system, [*map(sympy.sympify, self.formulas[root])]
            symbols = (*s.q, *s.qd, t, *s.u, *(p.symbol for p in s.parameters))
            has_rates = nested_rates(exprs, s.definitions) > 0
            function = compile_formulas(symbols, exprs, s.definitions)
            self._functions[root] = function, has_rates
        function, has_rates = self._functions[root]
        x = x.in_time if has_rates else x
        values = function(*x.q, *x.qd, x.t, *constants)
        return [part_of(y, "value") for y in values] if has_rates else values


@dataclass(frozen=True)
class _Evaluation:
    """Evaluation of quantities at b states; the results have a row for each state.

    at: the states; each number has one axis more, or two for D and C, along which gradients lie.
    constants: values of the inputs and of the parameters.
    """

    reference: TaylorReference
    at: StateVariables
    constants: Sequence[Any]
    b: int

    def value(self, name: str) -> Vector:
        """Return the value of a quantity, such as "D" or "power"."""
        match name:
            case "D":
                return self.mass_matrix()
            case "C":
                slopes = (
                    self.inertial_forces(at, "tangent") for at in (self.at, self.state_at_rest)
                )
                return np.swapaxes(sum(slopes), 1, 2) / 2
            case "bias":
                return self.inertial_forces(self.at) + self.gradient("P", q=self.units)
            case "g":
                return self.inertial_forces(self.state_at_rest) + self.gradient("P", q=self.units)
            case "tau":
                return self.forces()
            case "kinetic":
                return self.columns("K")
            case "potential":
                return self.columns("P")
            case "energy":
                return self.columns("K") + self.columns("P")
            case "jacobi":
                momenta = self.gradient("T", qd=self.units)
                return self.power(momenta) - self.columns("T") + self.columns("P")
            case "power":
                T, P = (self.gradient(name, 1, t=1.0) for name in "TP")
                return self.power(self.forces()) - T + P
            case "signals":
                return self.columns("u")
        return self.constraints(name)

    @property
    def state_at_rest(self) -> StateVariables:
        """The states with velocities of zero."""
        return StateVariables(self.at.q, [0 * v for v in self.at.qd], self.at.t)

    @property
    def units(self) -> Vector:
        """Unit vectors (nq, 1, nq) along the last axis."""
        return np.eye(len(self.at.q))[:, None, :]

    def formulas(self, name: str, at: StateVariables) -> list[Any]:
        """Return the values of some formulas, such as "Q"."""
        return self.reference.evaluate_formulas(name, at, self.constants)

    def array(self, x: Any, *shape: int, levels: Sequence[str] = ()) -> Vector:
        """Return a part of a dual number as an array (b, *shape)."""
        return np.broadcast_to(part_of(x, *levels), (self.b, *shape))

    def columns(self, name: str) -> Vector:
        """Return the values of formulas, (b, k)."""
        columns = [self.array(x, 1) for x in self.formulas(name, self.at)]
        return np.concatenate([np.zeros((self.b, 0)), *columns], axis=1)

    def gradient(self, name: str, size: int = 0, **by: Any) -> Vector:
        """Return the derivatives of a scalar, (b, size); by default nq of them."""
        (x,) = self.formulas(name, self.at.with_tangents(**by))
        return self.array(x, size or len(self.at.q), levels=["tangent"])

    def power(self, forces: Vector) -> Vector:
        """Return the power (b, 1) of forces (b, nq)."""
        qd = np.concatenate(self.at.qd, axis=1)
        return np.asarray(np.sum(forces * qd, axis=1, keepdims=True))

    def forces(self) -> Vector:
        """Return τ = Q - ∂R/∂q̇ + Σ F ∂y/∂q, (b, nq)."""
        forces = self.columns("Q") - self.gradient("R", qd=self.units)
        lengths = self.formulas("y", self.at.with_tangents(q=self.units))
        for y, force in zip(lengths, self.formulas("F", self.at), strict=True):
            forces = forces + force * self.array(y, len(self.at.q), levels=["tangent"])
        return forces

    def inertial_forces(self, at: StateVariables, *further: str) -> Vector:
        """Return f = ∂(dT/dt)/∂q̇ - 2 ∂T/∂q, (b, nq); or ∂f_j/∂q̇_i, (b, nq, nq).

        further: "tangent" for the derivatives, which need states with two more axes.
        """
        n, ones = len(at.q), [1] * len(further)
        units = np.eye(2 * n).reshape(2 * n, 1, *ones, 2 * n)
        x = at.with_tangents(q=units[:n], qd=units[n:])
        if further:
            x = x.with_tangents(qd=np.eye(n)[:, None, :, None])
        (T,) = self.formulas("T", x.in_time)
        rate, slope = (
            self.array(T, *[n] * len(further), 2 * n, levels=[part, *further, "tangent"])
            for part in ("tangent", "value")
        )
        return np.asarray(rate[..., n:] - 2 * slope[..., :n])

    def mass_matrix(self) -> Vector:
        """Return D, (b, nq, nq); states have two more axes."""
        units = np.eye(n := len(self.at.q))
        x = self.at.with_tangents(qd=units[:, None, None, :])
        (T,) = self.formulas("T", x.with_tangents(qd=units[:, None, :, None]))
        return self.array(T, n, n, levels=["tangent", "tangent"])

    def constraints(self, name: str) -> Vector:
        """Return values of the constraints: (b, m), or (b, m, nq) for the Jacobian A."""
        at, rates = self.at, self.at.in_time
        by_q, by_qd = at.with_tangents(q=self.units), at.with_tangents(qd=self.units)
        positions, velocities, size = {
            "constraints": ((at, 0), (at, 0), 1),
            "constraint_jacobian": ((by_q, 1), (by_qd, 1), len(at.q)),
            "constraint_rates": ((rates, 1), (at, 0), 1),
            "gamma": ((rates.in_time, 2), (rates, 1), 1),
        }[name]
        rows = [
            self.array(row, size, levels=["tangent"] * order)
            for name, (x, order) in (("phi", positions), ("psi", velocities))
            for row in self.formulas(name, x)
        ]
        return np.stack(rows, axis=1) if positions[0] is by_q else np.concatenate(rows, axis=1)
