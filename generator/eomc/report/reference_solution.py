"""Reference solutions in __float128, from the scene's generated C and a Gauss method of order 40.

Each solution is computed twice, with different orders and steps, and its accuracy is the agreement
of both. For small scenes, the reference equations of `symbolic` are also evaluated with mpmath: the
accelerations along the motion and, for a few seconds of computing time, the motion itself by
extrapolation. That check shares neither program, arithmetic nor method with the first computation.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import cache, cached_property
from operator import mul
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray

from eomc import pipeline
from eomc.base.errors import EomcError, FolderError
from eomc.derive import lagrange
from eomc.emit import portable
from eomc.emit.common.c_expression import QUAD
from eomc.emit.common.c_names import Target, rename_for_c
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.templates import show
from eomc.integrators.tableaux import gauss
from eomc.model.algebra import compile_function
from eomc.model.hybrid import with_constant_parameters
from eomc.model.mechanics import nonsmooth_functions
from eomc.model.system import System
from eomc.model.system import t as time_symbol
from eomc.program import program
from eomc.runtime.atomic_write import atomic_write
from eomc.toolchain import cache as builds
from eomc.verify import symbolic
from eomc.verify.reference import Vector

Text = NDArray[Any]  # of str

# (stages, largest of the last two Legendre coefficients of the accelerations)
METHODS_COMPARED = ((20, 1e-17), (16, 3e-18))
MAX_DIGITS = 33.0  # the 34 of __float128 less the rounding of sums
MAX_SECONDS = 120.0  # computing time of each of the two solutions
MAX_PLAIN_SECONDS = 2.0  # computing time of the motion in mpmath
PLAIN_DIGITS = 40
PLAIN_STATES = 5
MIN_PLAIN_DIGITS = 26.0  # of accelerations: with fewer, the equations differ


@dataclass(frozen=True)
class ReferenceSolution:
    """A reference solution: coordinates `q` and velocities `qd` (n, nq) at times `t` (n,) in s.

    Attributes
    ----------
    t
        Times in s.
    q, qd
        Coordinates and velocities, as decimal texts of 37 digits.
    digits
        Array (n,): number of digits to which two independent computations agree up to each time,
        relative to the largest value of each coordinate.
    plain
        Agreement with a third computation, in which mpmath evaluates the symbolic equations: a
        tuple (digits of the accelerations, digits of the motion, last compared time in s). None if
        these equations are too large.
    """

    t: Vector
    q: Text
    qd: Text
    digits: Vector
    plain: tuple[float, float, float] | None

    @cached_property
    def halves(self) -> tuple[Vector, Vector]:
        """The states x = [q; q̇] as two arrays of doubles (high, low), each (n, 2 nq).

        The exact state is high + low; `high` is the state rounded to double precision.
        """
        x = np.hstack([self.q, self.qd])
        high = x.astype(float)
        exact = (Fraction(text) - Fraction(h) for text, h in zip(x.flat, high.flat, strict=True))
        return high, np.array([float(rest) for rest in exact]).reshape(x.shape)

    @property
    def scale(self) -> Vector:
        """Largest magnitude of each component of x = [q; q̇] over time, (2 nq,); 1 instead of 0."""
        size = np.max(np.abs(self.halves[0]), axis=0)
        return np.where(size > 0, size, 1.0)

    def error_of(self, q: Vector, qd: Vector, rows: Any = slice(None)) -> Vector:
        """Return the error of the states [q; q̇], states minus reference, of shape (n, 2 nq).

        q, qd: coordinates and velocities (n, nq) of a run. rows: the indices, in `t` of the
        reference, of the times of these states; by default all times. The difference is accurate
        to rounding.
        """
        high, low = self.halves
        return np.asarray((np.hstack([q, qd]) - high[rows]) - low[rows])


def solve(
    scene: System | str | os.PathLike[str],
    duration: float | None = None,
    rows: int = 256,
    root: str | os.PathLike[str] = "build",
) -> ReferenceSolution:
    """Compute the reference solution of a scene from its initial state.

    The inputs follow their default signals.

    Parameters
    ----------
    scene : System or path
        A system, or the path of a scene file.
    duration : float, optional
        Duration in s; that of the scene by default.
    rows : int, optional
        Number of equal intervals between the rows + 1 times of the solution; a power of two, so
        that steps of h = duration/2^k end at these times.
    root : path, optional
        Build directory. The solution is cached in `root`/<name>/.

    Returns
    -------
    ReferenceSolution

    Raises
    ------
    EomcError
        If gcc with libquadmath is missing, D becomes singular, or the computation takes longer than
        MAX_SECONDS.

    Notes
    -----
    Parameters, initial values and duration are doubles; numbers in formulas are exact.
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    span = system.run.duration if duration is None else float(duration)
    if rows < 1 or rows & (rows - 1):
        raise EomcError(f"rows = {rows}: give a power of two, so that steps meet them exactly")
    if not (math.isfinite(span) and span > 0):
        raise EomcError(f"duration = {duration!r}: give a number of seconds above 0")
    start = [x for c in system.coordinates for x in (c.start, c.rate)]
    inputs = [span, rows, *start, *(p.value for p in system.parameters)]
    key = builds.key(system.digest, f"reference {inputs!r}")
    file = Path(root) / system.name / f"reference_{span!r}_{rows}.json"
    try:
        stored = json.loads(file.read_text(encoding="utf-8"))
        if stored["key"] == key:
            return _from_json(stored)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    solution = _compute(system, span, rows)
    stored = {name: np.asarray(value).tolist() for name, value in vars(solution).items()}
    stored["key"] = key
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file, cached=True) as new:
            new.write_text(json.dumps(stored) + "\n", encoding="utf-8")
    except OSError as fault:
        raise FolderError(f"{file}: can't be written ({fault.strerror})") from None
    return solution


def _from_json(stored: dict[str, Any]) -> ReferenceSolution:
    plain = tuple(stored["plain"]) if stored["plain"] else None
    arrays = {name: np.array(stored[name]) for name in ("t", "q", "qd", "digits")}
    return ReferenceSolution(**arrays, plain=plain)


# --- the program in __float128 ------------------------------------------------------------------


def _compute(system: System, span: float, rows: int) -> ReferenceSolution:
    with tempfile.TemporaryDirectory(prefix="eomc-reference-") as folder:
        executable = _compile(system, Path(folder))
        one, other = (_run(executable, system, span, rows, *way) for way in METHODS_COMPARED)
    n = len(system.coordinates)
    digits = _agreement(one[:, : 2 * n], other[:, : 2 * n])
    return ReferenceSolution(
        t=np.asarray(np.arange(rows + 1) * (span / rows), float),
        q=one[:, :n],
        qd=one[:, n : 2 * n],
        digits=digits,
        plain=_compare_plain(system, one[: 1 + np.sum(digits > MIN_PLAIN_DIGITS)], span / rows),
    )


def _compile(system: System, folder: Path) -> Path:
    """Compile the scene's C in __float128 with the integrator; return the executable."""
    system = replace(system, run=replace(system.run, methods=("rk4",), batch=False, real="double"))
    lowered = rename_for_c(program.build(lagrange.derive(system)))[0]
    shown = portable.files(lowered, QUAD)
    functions = SceneFunctions(Target(lowered, QUAD))
    call = functions.acceleration.function.call(
        qdd="a", u="NULL", p=f"(const {system.name}_params *)p"
    )
    main = show(
        "report/reference_solution.c", prefix=system.name, PREFIX=system.name.upper(),
        parameters=len(system.parameters), call=call,
    )  # fmt: skip
    for name, text in (*shown.items(), ("quad.c", main)):
        (folder / name).write_text("#include <quadmath.h>\n" + text, encoding="utf-8")
    missing = (
        f"{system.name}: the reference solution needs gcc with libquadmath "
        "(Debian: apt install gcc; x86-64 and POWER have it)"
    )
    gcc = shutil.which("gcc")
    if gcc is None:
        raise EomcError(missing)
    command = [gcc, "-std=gnu99", "-O1", "-w", "quad.c", "-o", "quad", "-lquadmath", "-lm"]
    completed = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if completed.returncode:
        raise EomcError(f"{missing}; {gcc} said:\n{completed.stderr.rstrip()[:2000]}")
    return folder / "quad"


def _run(
    executable: Path, system: System, span: float, rows: int, stages: int, target: float
) -> Text:
    """Run the executable and return the rows [q, qd, qdd] as texts, (rows + 1, 3 nq)."""
    numbers: tuple[float, ...] = (span, float(rows), target, MAX_SECONDS)
    numbers += tuple(c.start for c in system.coordinates)
    numbers += tuple(c.rate for c in system.coordinates)
    numbers += tuple(p.value for p in system.parameters)
    # Decimal writes a double as the number that it is
    exact = " ".join(str(Decimal(x)) for x in numbers)
    standard_input = f"{gauss_coefficients(stages)} {exact}\n"
    completed = subprocess.run(
        [executable], input=standard_input, capture_output=True, text=True, check=False
    )
    lines = [line.split()[:-1] for line in completed.stdout.splitlines()]
    reached = max(0, len(lines) - 1) * span / rows
    if completed.returncode == 3:
        raise EomcError(
            f"{system.name}: the reference solution got to t = {reached:.6g} s of {span:g} s in "
            f"{MAX_SECONDS:g} s of computing: ask for a shorter duration"
        )
    if completed.returncode and (jumps := nonsmooth_functions(system)):
        raise EomcError(
            f"{system.name}: no reference solution beyond t = {reached:.6g} s: a force that jumps "
            f"({jumps}) holds the motion there; write it smooth, such as tanh(v/0.001) for "
            "sign(v), or ask for a shorter duration"
        )
    if completed.returncode:
        raise EomcError(
            f"{system.name}: no reference solution beyond t = {reached:.6g} s: D is singular there "
            "or a state is not finite; ask for a shorter duration"
        )
    return np.array(lines)


@cache
def gauss_coefficients(stages: int) -> str:
    """Return the coefficients of the Gauss method with `stages` stages as text, to 40 digits.

    The text contains the number of stages, c, A, A A, b, b A and weights, separated by blanks. The
    weights (2k + 1) b_j P_k(c_j) give the Legendre coefficients of the accelerations.
    """
    method = gauss(stages, "reference")
    with localcontext(prec=50):
        c, b, *A = (decimals(row) for row in (method.c, method.b, *method.a))
        columns = [*zip(*A, strict=True)]
        products = [sum(map(mul, row, column)) for row in (*A, b) for column in columns]
        weights = [x for k in range(stages) for x in decimals(method.legendre(k))]
        AA, bA = products[: stages**2], products[stages**2 :]
        numbers = [*c, *(x for row in A for x in row), *AA, *b, *bA, *weights]
        return " ".join([f"{stages}", *(f"{x:.40e}" for x in numbers)])


def decimals(numbers: Iterable[Fraction]) -> list[Decimal]:
    """Return fractions as decimal numbers."""
    return [Decimal(x.numerator) / x.denominator for x in numbers]


def _agreement(one: Text, other: Text) -> Vector:
    """Return the digits to which two arrays agree, by row, relative to the largest value so far.

    The result never increases along the rows: solutions that have diverged may cross by chance.
    """
    size = np.maximum.accumulate(np.abs(one.astype(float)), axis=0)
    differences = [
        abs(float(Fraction(a) - Fraction(b))) for a, b in zip(one.flat, other.flat, strict=True)
    ]
    error = np.array(differences).reshape(one.shape)
    worst = np.max(np.where(error > 0, error / np.where(size > 0, size, 1.0), 0.0), axis=1)
    digits = -np.log10(np.maximum(worst, 10.0**-MAX_DIGITS))
    return np.asarray(np.minimum.accumulate(np.maximum(digits, 0.0)))


# --- the plain equations in arbitrary precision -------------------------------------------------


def _compare_plain(system: System, rows: Text, spacing: float) -> tuple[float, float, float] | None:
    """Compare the rows with the plain equations in mpmath; return `ReferenceSolution.plain`.

    Raises EomcError if the accelerations disagree, since then one of both is wrong.
    """
    if len(rows) < 2 or not symbolic.is_small(system):
        return None
    n = len(system.coordinates)
    with mpmath.workdps(PLAIN_DIGITS):
        states = [[mpmath.mpf(text) for text in row] for row in rows]
        plain = _PlainEquations(system)
        size = np.max(np.abs(rows[:, 2 * n :].astype(float)), axis=0)
        digits = MAX_DIGITS
        for k in sorted(set(np.linspace(0, len(rows) - 1, PLAIN_STATES).astype(int).tolist())):
            a = plain.acceleration(states[k][:n], states[k][n : 2 * n], mpmath.mpf(spacing) * k)
            for i in range(n):
                digits = min(digits, _digits(a[i] - states[k][2 * n + i], size[i]))
        if digits < MIN_PLAIN_DIGITS and not nonsmooth_functions(system):
            raise EomcError(
                f"{system.name}: accelerations in __float128 and those of the plain equations "
                f"agree to {digits:.0f} digits only: please report it, with the scene"
            )
        motion, until = MAX_DIGITS, 0.0
        deadline = time.monotonic() + MAX_PLAIN_SECONDS
        x = states[0][: 2 * n]
        sizes = np.max(np.abs(rows[:, : 2 * n].astype(float)), axis=0)
        for k in range(1, len(rows)):
            after = plain.advance(x, mpmath.mpf(spacing) * (k - 1), mpmath.mpf(spacing), deadline)
            if after is None:
                break
            x, until = after, spacing * k
            for i in range(2 * n):
                motion = min(motion, _digits(x[i] - states[k][i], sizes[i]))
        return digits, motion if until else 0.0, until


def _digits(difference: Any, size: float) -> float:
    if difference == 0:
        return MAX_DIGITS
    return min(MAX_DIGITS, float(-mpmath.log10(abs(difference) / (size or 1.0))))


class _PlainEquations:
    """D, bias, tau, constraints and signals of the symbolic reference, evaluated with mpmath."""

    def __init__(self, system: System) -> None:
        core = with_constant_parameters(system)
        r = symbolic.derive(core)
        symbols = (*system.q, *system.qd, time_symbol, *system.u)
        symbols += tuple(p.symbol for p in system.parameters)
        rows, matrix, level = system.solved, r.D, []
        if rows:  # D qdd - A^T lambda = tau - bias, A qdd = -gamma
            sums = sympy.zeros(len(rows), len(system.constraints))
            for k, row in enumerate(rows):
                for at, weight in row:
                    sums[k, at] = sympy.Rational(weight)
            A, level = sums * r.constraint_jacobian, [*(-sums * sympy.Matrix([*r.gamma]))]
            whole = sympy.BlockMatrix([[r.D, -A.T], [A, sympy.zeros(len(rows))]])
            matrix = whole.as_explicit()
        parts = [*matrix, *(r.tau - r.bias), *level]
        self.size = len(core.coordinates) + len(rows)
        names = [c.name for c in system.coordinates]
        self.own = [names.index(c.name) for c in core.coordinates]
        # Floats are the doubles that they are
        exact = [e.xreplace({f: sympy.Rational(f) for f in e.atoms(sympy.Float)}) for e in parts]
        self.n, self.m = len(system.coordinates), len(system.inputs)
        self.parameters = [mpmath.mpf(p.value) for p in system.parameters]
        self.values = compile_function(symbols, exact, "mpmath")
        self.signals = compile_function(symbols, list(r.signals), "mpmath")

    def acceleration(self, q: list[Any], qd: list[Any], t: Any) -> list[Any]:
        """Solve D q̈ = τ - bias + Aᵀλ for the accelerations q̈ at (q, q̇, t); return them as a list.

        All numbers are mpmath numbers.
        """
        u = [mpmath.mpf(0)] * self.m
        if self.m:
            u = self.signals(*q, *qd, t, *u, *self.parameters)
        v = self.values(*q, *qd, t, *u, *self.parameters)
        n = self.size
        matrix = mpmath.matrix([v[i * n : (i + 1) * n] for i in range(n)])
        solution, accelerations = (
            mpmath.lu_solve(matrix, mpmath.matrix(v[n * n :])),
            [mpmath.mpf(0)] * self.n,
        )
        for i, k in enumerate(self.own):
            accelerations[k] = solution[i]
        return accelerations

    def advance(self, x: list[Any], t: Any, span: Any, deadline: float) -> list[Any] | None:
        """Integrate from the state x = [q; q̇] at time `t` over `span` (s); return the final state.

        The method is the extrapolated midpoint rule. Returns None if the clock `time.monotonic`
        passes `deadline`.
        """
        parts = 1
        while (state := self._extrapolated_step(x, t, span / parts, deadline)) is None:
            if time.monotonic() > deadline or parts > 1000:
                return None
            parts *= 2
        for k in range(1, parts):
            state = self._extrapolated_step(state, t + k * span / parts, span / parts, deadline)
            if state is None:
                return None
        return state

    def _extrapolated_step(self, x: list[Any], t: Any, H: Any, deadline: float) -> list[Any] | None:
        """Return one extrapolation of 2, 4, ... midpoint steps; None if it does not converge.

        Gragg, Bulirsch & Stoer: Hairer, Norsett & Wanner, Solving ODEs I, sec. II.9.
        """
        n = self.n

        def slope(y: list[Any], at: Any) -> list[Any]:
            return [*y[n:], *self.acceleration(y[:n], y[n:], at)]

        first = slope(x, t)
        table: list[list[Any]] = []
        for k in range(1, 17):
            if time.monotonic() > deadline:
                return None
            h = H / (2 * k)
            before, now = x, [a + h * b for a, b in zip(x, first, strict=True)]
            for j in range(1, 2 * k):
                rate = slope(now, t + j * h)
                before, now = now, [a + 2 * h * b for a, b in zip(before, rate, strict=True)]
            row = [now]
            for j in range(1, k):
                ratio = mpmath.mpf(k * k) / (k - j) ** 2 - 1
                old = table[-1][j - 1]
                row.append([a + (a - b) / ratio for a, b in zip(row[-1], old, strict=True)])
            table.append(row)
            if k > 2:
                worst = max(
                    abs(a - b) / (abs(a) + mpmath.mpf("1e-6"))
                    for a, b in zip(row[-1], row[-2], strict=True)
                )
                if worst < mpmath.mpf("1e-34"):
                    return row[-1]
        return None
