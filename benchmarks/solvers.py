"""Integrators that choose their own steps, and mechanicsdsl's C++, for benchmarks/peers.py.

Adaptive ones are made for a tolerance: (matrices, n) -> (tolerance -> Run), compiled once.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import math
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import heyoka
import jitcode
import numba
import numpy as np
import physics
import symengine
from physics import Matrices
from runners import Array, Run, timed
from scipy.integrate import solve_ivp

from eomc.toolchain import compiler

Adaptive = Callable[[float], Run]


def heyoka_taylor(matrices: Matrices, n: int) -> Adaptive:
    """heyoka's adaptive Taylor integrator; its order hangs on the tolerance, so compiled anew."""
    x = heyoka.make_vars(*[f"x{i}" for i in range(2 * n)])
    rates = [*x[n:], *physics.acceleration(matrices, list(x), heyoka.sin, heyoka.cos)]
    system = list(zip(x, rates, strict=True))

    def make(tolerance: float) -> Run:
        integrator = heyoka.taylor_adaptive(system, np.zeros(2 * n), tol=tolerance)

        def run(x: Array, h: float, steps: int) -> Array:
            integrator.time = 0.0
            integrator.state[:] = x
            integrator.propagate_until(h * steps)
            return integrator.state.copy()

        return run

    return make


def scipy_dop853(matrices: Matrices, n: int) -> Adaptive:
    """solve_ivp's DOP853 on a right-hand side that numba compiled, with FMA as for us."""
    lines, results = physics.text(matrices, n)
    state = ", ".join(f"x{i}" for i in range(2 * n))
    rates = ", ".join([*(f"x{i}" for i in range(n, 2 * n)), *results])
    code = [f"def rate(t, x):\n {state} = x", *lines, f"return np.array(({rates}))"]
    names: dict[str, Any] = {"sin": math.sin, "cos": math.cos, "np": np}
    exec("\n ".join(code), names)  # text of our own making
    rate = numba.njit(fastmath={"contract"})(names["rate"])

    def make(tolerance: float) -> Run:
        def run(x: Array, h: float, steps: int) -> Array:
            span = (0.0, h * steps)
            return solve_ivp(rate, span, x, "DOP853", rtol=tolerance, atol=tolerance).y[:, -1]

        return run

    return make


def jitcode_dop853(matrices: Matrices, n: int) -> Adaptive:
    """JiTCODE: the right-hand side as compiled C, stepped by Hairer's DOP853."""
    x = [jitcode.y(i) for i in range(2 * n)]
    rates = [*x[n:], *physics.acceleration(matrices, x, symengine.sin, symengine.cos)]
    ode = jitcode.jitcode(rates, verbose=False)
    # setuptools, which compiles it, takes the folder that it runs in for the project
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        ode.compile_C(extra_compile_args=list(compiler.flags()))

    def make(tolerance: float) -> Run:
        def run(x: Array, h: float, steps: int) -> Array:
            ode.set_integrator("dop853", rtol=tolerance, atol=tolerance)
            ode.set_initial_value(x, 0.0)
            return np.array(ode.integrate(h * steps))

        return run

    return make


MECHANICSDSL = r"""
\system{cartpole}
\defvar{x}{Position}{m}
\defvar{theta}{Angle}{rad}
\parameter{mc}{2.0}{kg}
\parameter{mp}{2.0}{kg}
\parameter{l}{2.0}{m}
\parameter{g}{9.8}{m/s^2}
\lagrangian{\frac{1}{2} * mc * \dot{x}^2
  + \frac{1}{2} * mp * (\dot{x}^2 - l * \cos{theta} * \dot{x} * \dot{theta}
    + l^2 / 4 * \dot{theta}^2)
  + \frac{1}{24} * mp * l^2 * \dot{theta}^2 - mp * g * l / 2 * \cos{theta}}
\initial{x=0.0, x_dot=0.0, theta=1.5, theta_dot=0.0}
"""
MECHANICSDSL_DRIVER = """
extern "C" void run(double *x, double h, long steps)
{
    std::vector<double> y(x, x + DIM);
    for (long k = 0; k < steps; ++k)
        rk4_step(y, k * h, h);
    std::copy(y.begin(), y.end(), x);
}
"""


def mechanicsdsl_cartpole(root: Path) -> Run:
    """The C++ that mechanicsdsl writes of the cart-pole; its main made a loop without output.

    Compiled with our flags and with those of the CMake file it writes; the faster is kept."""
    from mechanics_dsl import PhysicsCompiler

    folder = Path(tempfile.mkdtemp(dir=root))
    logging.disable(logging.ERROR)
    made = PhysicsCompiler()
    assert made.compile_dsl(MECHANICSDSL)["success"]
    assert made.compile_to_cpp(str(folder / "cartpole.cpp"), compile_binary=False)
    logging.disable(logging.NOTSET)
    text = (folder / "cartpole.cpp").read_text(encoding="utf-8")
    assert "int main()" in text
    file = folder / "loop.cpp"
    file.write_text(text.replace("int main()", "int unused()") + MECHANICSDSL_DRIVER)
    runs = []
    for k, flags in enumerate((compiler.flags(), ("-O3", "-march=native", "-ffast-math"))):
        library = folder / f"loop{k}.so"
        command = ["c++", "-std=c++17", *flags, "-fPIC", "-shared", str(file), "-o", str(library)]
        subprocess.run(command, check=True)
        function = ctypes.CDLL(str(library)).run
        function.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_long]

        def run(x: Array, h: float, steps: int, function: Any = function) -> Array:
            y = np.ascontiguousarray(x.reshape(2, -1).T)  # q and its rate side by side
            function(y.ctypes.data, h, steps)
            return y.T.reshape(-1)

        runs.append(run)
    at = np.array([0.0, 1.5, 0.0, 0.0])
    return min(runs, key=lambda run: min(timed(run, at, 0.005, 1000)[0] for _ in range(9)))
