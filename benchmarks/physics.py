"""The physics of the benchmark, written by hand once, for numbers of any kind.

Each acceleration takes q, v and the functions sin and cos, and uses +, - , * and / only; so floats,
CasADi's SX, heyoka's expressions and the `Text` below (which writes straight-line code for numba)
all go through the same lines. One sine and cosine an angle, differences of angles by the addition
theorem, LDL^T by scalars with reciprocals: what a careful user would write, parameters as numbers.
`derived` is what SymPy makes of the energies instead, for who does not want to write it by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy

from eomc.model.system import System
from eomc.verify import symbolic

Numbers = Sequence[Any]
Function = Callable[[Any], Any]
Matrices = Callable[[Numbers, Numbers, Function, Function], tuple[list[list[Any]], list[Any]]]


def cartpole(q: Numbers, v: Numbers, sin: Function, cos: Function) -> tuple[Any, Any]:
    """D (its lower half) and tau - bias of scenes/cartpole.toml: 2 kg, 2 kg, 2 m, 9.8 m/s^2."""
    s, c = sin(q[1]), cos(q[1])
    return [[4.0], [c * -2.0, 8.0 / 3.0]], [v[1] * v[1] * s * -2.0, s * 19.6]


def chain(q: Numbers, v: Numbers, sin: Function, cos: Function) -> tuple[Any, Any]:
    """The same of point masses of 1 kg on massless links of 1 m, absolute angles from hanging."""
    n = len(q)
    s, c, w = [sin(x) for x in q], [cos(x) for x in q], [x * x for x in v]
    D = [[float(n - i)] * (i + 1) for i in range(n)]
    tau = [s[i] * (-9.81 * (n - i)) for i in range(n)]
    for i in range(n):
        for j in range(i):
            across = (s[i] * c[j] - c[i] * s[j]) * D[i][j]
            tau[i] = tau[i] - across * w[j]
            tau[j] = tau[j] + across * w[i]
            D[i][j] = (s[i] * s[j] + c[i] * c[j]) * D[i][j]
    return D, tau


def derived(system: System) -> Matrices:
    """The same from K and P of a scene by SymPy: plain Euler-Lagrange, then cse."""
    made = symbolic.derive(system)
    values = {p.symbol: sympy.Float(p.value) for p in system.parameters}
    n = len(system.q)
    wanted = [made.D[i, j].xreplace(values) for i in range(n) for j in range(i + 1)]
    wanted += [(-made.bias[i]).xreplace(values) for i in range(n)]
    functions: dict[str, Function] = {}
    calls = {name: lambda y, name=name: functions[name](y) for name in ("sin", "cos")}
    evaluate = sympy.lambdify([*system.q, *system.qd], wanted, modules=[calls], cse=True)

    def matrices(q: Numbers, v: Numbers, sin: Function, cos: Function) -> tuple[Any, Any]:
        functions.update(sin=sin, cos=cos)
        entries = iter(evaluate(*q, *v))
        return [[next(entries) for _ in range(i + 1)] for i in range(n)], list(entries)

    return matrices


def solve(D: list[list[Any]], tau: list[Any]) -> list[Any]:
    """The solution of D a = tau by LDL^T, in scalars."""
    n = len(tau)
    L: list[list[Any]] = []
    inverse: list[Any] = []
    y: list[Any] = []
    for i in range(n):
        row, pivot, right = [], D[i][i], tau[i]
        for j in range(i):
            scaled = D[i][j]
            for k in range(j):
                scaled = scaled - row[k] * L[j][k]
            row.append(scaled)  # L_ij d_j, until the next line but one
        for j in range(i):
            scaled, row[j] = row[j], row[j] * inverse[j]
            pivot = pivot - scaled * row[j]
            right = right - row[j] * y[j]
        L.append(row)
        inverse.append(1.0 / pivot)
        y.append(right)
    a = [y[i] * inverse[i] for i in range(n)]
    for i in reversed(range(n)):
        for j in range(i):
            a[j] = a[j] - L[i][j] * a[i]
    return a


def acceleration(matrices: Matrices, x: Numbers, sin: Function, cos: Function) -> list[Any]:
    """The second half of dx/dt, x = [q; v]."""
    n = len(x) // 2
    return solve(*matrices(x[:n], x[n:], sin, cos))


def rk4(matrices: Matrices, x: Numbers, h: Any, sin: Function, cos: Function) -> list[Any]:
    """One step, since q' = v: q + h v + h^2/6 (a1 + a2 + a3), v + h/6 (a1 + 2 a2 + 2 a3 + a4)."""
    n = len(x) // 2
    q, v = x[:n], x[n:]
    half, square = h * 0.5, h * h
    quarter, sixth = square * 0.25, square * (1.0 / 6.0)

    def at(places: Numbers, rates: Numbers) -> list[Any]:
        return acceleration(matrices, [*places, *rates], sin, cos)

    both = list(zip(q, v, strict=True))
    a1 = at(q, v)
    a2 = at([y + half * w for y, w in both], [w + half * a for w, a in zip(v, a1, strict=True)])
    a3 = at(
        [y + half * w + quarter * a for (y, w), a in zip(both, a1, strict=True)],
        [w + half * a for w, a in zip(v, a2, strict=True)],
    )
    a4 = at(
        [y + h * w + square * 0.5 * a for (y, w), a in zip(both, a2, strict=True)],
        [w + h * a for w, a in zip(v, a3, strict=True)],
    )
    four = list(zip(a1, a2, a3, a4, strict=True))
    return [
        *(y + h * w + sixth * (a + b + c) for (y, w), (a, b, c, _) in zip(both, four, strict=True)),
        *(w + h / 6.0 * (a + 2.0 * (b + c) + d) for w, (a, b, c, d) in zip(v, four, strict=True)),
    ]


def tutorial(matrices: Matrices, x: np.ndarray, h: float, steps: int) -> np.ndarray:
    """The loop of the tutorial: np.array, np.linalg.solve, RK4 on whole arrays."""
    n = len(x) // 2

    def rate(x: np.ndarray) -> np.ndarray:
        lower, tau = matrices(x[:n], x[n:], math.sin, math.cos)
        D = np.array([[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)])
        return np.concatenate([x[n:], np.linalg.solve(D, np.array(tau))])

    for _ in range(steps):
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        k4 = rate(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


class Text:
    """A number that writes down what is done with it, a line an operation."""

    def __init__(self, name: str, lines: list[str]) -> None:
        self.name, self.lines = name, lines

    def _line(self, right: str) -> Text:
        name = f"r{len(self.lines)}"
        self.lines.append(f"{name} = {right}")
        return Text(name, self.lines)

    def call(self, function: str) -> Text:
        return self._line(f"{function}({self.name})")

    def __add__(self, other: Any) -> Text:
        return self._line(f"{self.name} + {_name(other)}")

    def __radd__(self, other: Any) -> Text:
        return self._line(f"{_name(other)} + {self.name}")

    def __sub__(self, other: Any) -> Text:
        return self._line(f"{self.name} - {_name(other)}")

    def __rsub__(self, other: Any) -> Text:
        return self._line(f"{_name(other)} - {self.name}")

    def __mul__(self, other: Any) -> Text:
        return self._line(f"{self.name} * {_name(other)}")

    __rmul__ = __mul__

    def __neg__(self) -> Text:
        return self._line(f"-{self.name}")

    def __pow__(self, power: int) -> Text:
        assert power == 2
        return self * self

    def __truediv__(self, other: Any) -> Text:
        return self._line(f"{self.name} / {_name(other)}")

    def __rtruediv__(self, other: Any) -> Text:
        return self._line(f"{_name(other)} / {self.name}")


def _name(value: Any) -> str:
    return value.name if isinstance(value, Text) else repr(value)


def text(matrices: Matrices, n: int) -> tuple[list[str], list[str]]:
    """Straight-line code of the acceleration at x0, x1, …: its lines, and the results' names."""
    lines: list[str] = []
    x = [Text(f"x{i}", lines) for i in range(2 * n)]
    a = acceleration(matrices, x, lambda y: y.call("sin"), lambda y: y.call("cos"))
    return lines, [value.name for value in a]
