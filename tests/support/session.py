"""What all test files share: compiled scenes, a scene with all features, tiers, programs."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import eomc
from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from support.cases import ROOT as ROOT
from support.cases import SCENES

# reused in later sessions
MODULES = ROOT / "build" / "tests" / "modules"
UNOPTIMISED = ROOT / "build" / "tests" / "unoptimised"

# Every function of the formula language, explicit time, friction, a part of K without velocities,
# an input that depends on the state, and names that are awkward in C and Python.
EVERYTHING = """
eomc = 1
name = "everything"
title = "Every function of the formula language"
[coordinates]
x     = { unit = "m", start = 0.3, rate = 0.2, note = "a note with */ in it and an é" }
theta = { unit = "rad", start = 0.4, rate = -0.1 }
q     = { start = 0.5, rate = 0.3 }
[parameters]
m      = 1.5
g      = 9.81
I      = 0.7
E      = 0.2
S      = 0.3
N      = 0.25
beta   = 0.4
gamma  = 0.15
zeta   = 0.05
values = 0.6
h      = 0.35
y0     = 0.45
index  = 0.55
[constants]
third = "1/3"
[inputs]
u    = { unit = "N", signal = "sin(2*t) + x/10" }
push = { unit = "N" }
[definitions]
px = "x*cos(theta) + tanh(q)*S + E*cos(3*t)"
py = "x*sin(theta) + N*sinh(q/4)*cosh(q/5)"
a  = "atan(q) + asin(q/4) + acos(q/5) + atan2(q + 2, x + 3)"
turning = "(I*theta_dot**2 + beta*q_dot**2*(2 + sin(theta)) + values*(theta_dot + h*x)**2)/2"
b  = "exp(-q**2) + log(2 + q**2) + sqrt(1 + x**2) + tan(q/7) + third"
c  = "erf(q) + erfc(x/2) + log1p(x**2) + expm1(theta/5) + hypot(x, q + 3) + cbrt(theta + 9)"
d  = "asinh(x) + acosh(2 + q**2) + atanh(sin(theta)/2)"
[energy]
kinetic     = "m*(dot(px)**2 + dot(py)**2)/2 + turning + y0*t*q_dot/10"
potential   = "m*g*py + gamma*(a**2 + c*d/9) + index*b + zeta*x**4 + (1 + x**2)**1.5/20"
dissipation = "zeta*theta_dot**2/2 + gamma*dot(py)**2/2"
[forces]
x     = "u - zeta*x_dot*abs(x_dot)"
theta = "-gamma*sign(theta_dot)/10 + push*heaviside(x) + pi/100"
q     = "min(x, theta, 0.3)/5 - max(q_dot, 0.1)/7"
[outputs]
tip   = { formula = "py + dot(px)", unit = "m" }
pull  = "m*(dot(dot(px)) + g) + theta_ddot*push"
whole = "energy + t"
[run]
h        = 0.01
duration = 2.0
"""


@cache
def _loaded(name: str) -> ModuleType:
    return _compiled(SCENES / f"{name}.toml", MODULES, None)


@cache
def _compiled_system(system: System, optimised: bool) -> ModuleType:
    """Build in a folder of its own, because tests may give two scenes the same name."""
    root, flags = (MODULES, None) if optimised else (UNOPTIMISED, "-O0")
    return _compiled(system, root / system.digest[:16], flags)


def _compiled(source: Path | System, root: Path, flags: str | None) -> ModuleType:
    """Build with these flags, or the default ones, regardless of the flags that a test has set."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("EOMC_CFLAGS", raising=False)
        if flags is not None:
            patch.setenv("EOMC_CFLAGS", flags)
        return eomc.load(source, root)


class Modules:
    """Compiled scenes, each built once per session and reused by the next session."""

    def __call__(self, name: str) -> ModuleType:
        """Return the module of scenes/<name>.toml."""
        return _loaded(name)

    def of_text(self, text: str) -> ModuleType:
        """Return the module of a scene given as text."""
        return _compiled_system(from_scene(parse(text, "test.toml")), True)

    def unoptimised(self, source: str | System) -> ModuleType:
        """Return the module of a text or a system, compiled without optimisation in half the
        time.
        """
        system = from_scene(parse(source, "test.toml")) if isinstance(source, str) else source
        return _compiled_system(system, False)


def tiers(values: Iterable[Any], *quick: Any) -> list[Any]:
    """Return parameters, marking as slow those whose first value is not one of `quick`."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=() if row[0] in quick else pytest.mark.slow) for row in rows]


def needs(compiler: str) -> str:
    """Return the path of a program, possibly installed by pip; skip the test if it is missing."""
    path = shutil.which(compiler) or shutil.which(compiler, path=str(Path(sys.executable).parent))
    if path is None:
        pytest.skip(f"{compiler} is not installed")
    return path
