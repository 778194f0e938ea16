"""Scenes with discontinuous or non-smooth forces, and the final values of their motions.

The final values come from formulas in this file. Without a closed form, the motion between two
kinks, whose times are known, is extrapolated from midpoint steps (Hairer, Norsett & Wanner, Solving
ODEs I, sec. II.9), accurate to about 1e-13.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

State = list[float]
Slope = Callable[[State, float], State]

G = 9.81
PENDULUM = """eomc = 1
name = "limited_pendulum"
[coordinates]
a = { start = 1.0 }
[inputs]
u = { signal = "-20*sin(3*t)", limits = [-1.5, 1.5] }
[energy]
kinetic = "a_dot**2/2"
potential = "-9.81*cos(a)"
[forces]
a = "u"
[run]
tolerance = 1e-9
duration = 5
"""
SWITCHED = """eomc = 1
name = "switched_pendulums"
[coordinates]
a = { start = 0.4 }
b = { start = -0.2 }
[inputs]
u = { signal = "2*heaviside(t - 0.731) - 3*heaviside(t - 1.377) + heaviside(t - 2.6)" }
[energy]
kinetic = "a_dot**2/2 + b_dot**2/2 + 0.3*a_dot*b_dot*cos(a - b)"
potential = "-9.81*cos(a) - 6*cos(b)"
[forces]
a = "u"
[run]
tolerance = 1e-9
duration = 5
"""
RUBBED = """eomc = 1
name = "rubbed_spring"
[coordinates]
x = { start = 1.0 }
[parameters]
mu = 0.3
[energy]
kinetic = "x_dot**2/2"
potential = "8*x**2"
[forces]
x = "-mu*sign(x_dot)"
[run]
tolerance = 1e-9
duration = 3
"""
BOUNCING = """eomc = 1
name = "bouncing_spring"
[coordinates]
x = { start = 0.5 }
[energy]
kinetic = "x_dot**2/2"
potential = "9.81*x"
[forces]
x = "1000*max(0, -x)"
[run]
batch = true
tolerance = 1e-9
duration = 5
"""


def extrapolated(slope: Slope, y: State, t: float, span: float) -> State:
    """Return the state after a short smooth interval."""
    table: list[list[State]] = []
    for k in range(1, 9):
        h = span / (2 * k)
        before, now = y, [a + h * b for a, b in zip(y, slope(y, t), strict=True)]
        for j in range(1, 2 * k):
            rate = slope(now, t + j * h)
            before, now = now, [a + 2 * h * b for a, b in zip(before, rate, strict=True)]
        row = [now]
        for j in range(1, k):
            ratio = (k / (k - j)) ** 2 - 1
            old = table[-1][j - 1]
            row.append([a + (a - b) / ratio for a, b in zip(row[-1], old, strict=True)])
        table.append(row)
    return table[-1][-1]


def through(slopes: Callable[[float], Slope], y: State, times: Sequence[float]) -> State:
    """Return the state at the last time; slopes(t) is the right-hand side of the piece around t."""
    for low, high in pairwise(times):
        parts = math.ceil((high - low) / 0.1)
        h = (high - low) / parts
        for n in range(parts):
            y = extrapolated(slopes((low + high) / 2), y, low + n * h, h)
    return y


def pendulum(a: float) -> float:
    """Return the final angle of a pendulum with kinks where 20 |sin 3 t| = 1.5."""
    width = math.asin(1.5 / 20) / 3
    corners = [k * math.pi / 3 + side * width for k in range(6) for side in (-1, 1)]
    times = [0.0, *(t for t in corners if 0 < t < 5), 5.0]

    def slopes(middle: float) -> Slope:
        command = -20 * math.sin(3 * middle)
        saturated = math.copysign(1.5, command) if abs(command) > 1.5 else None

        def slope(y: State, t: float) -> State:
            u = -20 * math.sin(3 * t) if saturated is None else saturated
            return [y[1], u - G * math.sin(y[0])]

        return slope

    return through(slopes, [a, 0.0], times)[0]


def switched(a: float) -> float:
    """Return the final value with discontinuities at three times."""

    def slopes(middle: float) -> Slope:
        u = 2 * (middle > 0.731) - 3 * (middle > 1.377) + (middle > 2.6)

        def slope(y: State, _: float) -> State:
            a, b, va, vb = y
            c, s = 0.3 * math.cos(a - b), 0.3 * math.sin(a - b)
            fa = u - G * math.sin(a) - s * vb * vb
            fb = s * va * va - 6 * math.sin(b)
            D = 1 - c * c
            return [va, vb, (fa - c * fb) / D, (fb - c * fa) / D]

        return slope

    return through(slopes, [a, -0.2, 0.0, 0.0], [0.0, 0.731, 1.377, 2.6, 5.0])[0]


def rubbed(x: float, mu: float = 0.3) -> float:
    """Return the final value after half oscillations of pi/4 s about +-mu/16."""
    left, side = 3.0, 1.0
    while left > math.pi / 4:
        x, left, side = 2 * side * mu / 16 - x, left - math.pi / 4, -side
    c = side * mu / 16
    return c + (x - c) * math.cos(4 * left)


def bouncing(x: float) -> float:
    """Return the final value of parabolas and arcs of the spring, x'' = -1000 x - g."""
    fall, w, sag = math.sqrt(2 * x / G), math.sqrt(1000), G / 1000
    fast = G * fall
    touch = (math.pi + 2 * math.atan(G / (fast * w))) / w
    left = (5.0 - fall) % (touch + 2 * fall)
    if left < touch:
        return sag * (math.cos(w * left) - 1) - fast / w * math.sin(w * left)
    left -= touch
    return fast * left - G * left * left / 2


@dataclass(frozen=True)
class Case:
    """A scene, the smallest and largest initial value of its first coordinate, and its final
    value.
    """

    text: str
    starts: tuple[float, float]
    end: Callable[[float], float]


CASES = {
    "limits": Case(PENDULUM, (-2.0, 2.0), pendulum),
    "heaviside": Case(SWITCHED, (-1.0, 1.0), switched),
    "sign": Case(RUBBED, (0.5, 2.0), rubbed),
    "max": Case(BOUNCING, (0.2, 1.0), bouncing),
}
