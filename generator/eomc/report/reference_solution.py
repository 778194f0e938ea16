"""The reference solution of any scene: its own C in __float128, by a method of order 40.

Computed twice, with other stages and other steps, and trusted as far as both agree. Where the
plain equations of `symbolic` are small, they are evaluated with mpmath as well: accelerations
along the motion, and the motion itself, by extrapolation, over as much of it as some seconds
allow. That shares neither program, arithmetic nor method with the first way.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass, replace
from decimal import Decimal
from fractions import Fraction
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray

from eomc import pipeline
from eomc.base.errors import EomcError, FolderError
from eomc.derive import lagrange
from eomc.emit.c_expression import QUAD
from eomc.emit.c_identifiers import rename_for_c
from eomc.emit.c_names import Target
from eomc.emit.functions import Functions
from eomc.emit.plain import steppers as plain
from eomc.emit.render import show
from eomc.emit.views import Quad
from eomc.model.corners import corners
from eomc.model.discrete import constant
from eomc.model.numeric import compiled
from eomc.model.system import System
from eomc.model.system import t as time_symbol
from eomc.program import program
from eomc.runtime.written import replacing
from eomc.toolchain import cache as builds
from eomc.verify import symbolic
from eomc.verify.oracle import Vector

Text = NDArray[Any]  # of str

# (stages, largest of the last two Legendre coefficients of the accelerations)
WAYS = ((20, 1e-17), (16, 3e-18))
MOST_DIGITS = 33.0  # of __float128, 34, less what adding up rounds
SECONDS = 120.0  # of either way
PLAIN_SECONDS = 2.0  # of the plain equations in mpmath
PLAIN_DIGITS = 40
PLAIN_STATES = 5
PLAIN_AGREES = 26.0  # digits of accelerations; fewer says that the equations are not the same


@dataclass(frozen=True)
class Reference:
    """q, qd of shape (n, nq) at the times t (n,), as decimal texts of 37 digits.

    digits (n,): to how many both ways agree, relative to each coordinate's largest value so far.
    plain: digits to which the plain equations agree, and until when their motion was compared:
    (digits of accelerations, digits of the motion, t); None where they are too large.
    """

    t: Vector
    q: Text
    qd: Text
    digits: Vector
    plain: tuple[float, float, float] | None

    @cached_property
    def halves(self) -> tuple[Vector, Vector]:
        """x = [q; qd] as sums of two doubles each, (n, 2 nq) high and low."""
        x = np.hstack([self.q, self.qd])
        high = x.astype(float)
        exact = (Fraction(text) - Fraction(h) for text, h in zip(x.flat, high.flat, strict=True))
        return high, np.array([float(rest) for rest in exact]).reshape(x.shape)

    @property
    def scale(self) -> Vector:
        """The largest value of each of x = [q; qd] along the motion, (2 nq,); 1 where it is 0."""
        size = np.max(np.abs(self.halves[0]), axis=0)
        return np.where(size > 0, size, 1.0)

    def off(self, q: Vector, qd: Vector, rows: Any = slice(None)) -> Vector:
        """States minus this at those rows, (n, 2 nq), right to the last bit of the difference."""
        high, low = self.halves
        return np.asarray((np.hstack([q, qd]) - high[rows]) - low[rows])


def of(
    scene: System | str | os.PathLike[str],
    duration: float | None = None,
    rows: int = 256,
    root: str | os.PathLike[str] = "build",
) -> Reference:
    """The motion from the scene's start, parameters and signals, at rows + 1 times up to duration.

    Parameters, start and duration are the doubles that they are, numbers in formulas exact. rows
    is a power of two, so that runs with h = duration/2^k meet the same times. Kept in
    `root`/<name>/. Raises EomcError where gcc with libquadmath is missing, where the motion meets
    a singular D, or where it takes longer than SECONDS.
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    span = system.run.duration if duration is None else float(duration)
    if rows < 1 or rows & (rows - 1):
        raise EomcError(f"rows = {rows}: give a power of two, so that steps meet them exactly")
    if not (math.isfinite(span) and span > 0):
        raise EomcError(f"duration = {duration!r}: give a number of seconds above 0")
    start = [x for c in system.coordinates for x in (c.start, c.rate)]
    made_of = [span, rows, *start, *(p.value for p in system.parameters)]
    wanted = builds.key(system.digest, f"reference {made_of!r}")
    file = Path(root) / system.name / f"reference_{span!r}_{rows}.json"
    try:
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["key"] == wanted:
            return _from_json(kept)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    made = _computed(system, span, rows)
    kept = {name: np.asarray(value).tolist() for name, value in vars(made).items()}
    kept["key"] = wanted
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file, cached=True) as new:
            new.write_text(json.dumps(kept) + "\n", encoding="utf-8")
    except OSError as fault:
        raise FolderError(f"{file}: can't be written ({fault.strerror})") from None
    return made


def _from_json(kept: dict[str, Any]) -> Reference:
    plain = tuple(kept["plain"]) if kept["plain"] else None
    arrays = {name: np.array(kept[name]) for name in ("t", "q", "qd", "digits")}
    return Reference(**arrays, plain=plain)


# --- the program in __float128 ------------------------------------------------------------------


def _computed(system: System, span: float, rows: int) -> Reference:
    with tempfile.TemporaryDirectory(prefix="eomc-reference-") as folder:
        executable = _compiled(system, Path(folder))
        one, other = (_run(executable, system, span, rows, *way) for way in WAYS)
    n = len(system.coordinates)
    digits = _agreement(one[:, : 2 * n], other[:, : 2 * n])
    return Reference(
        t=np.asarray(np.arange(rows + 1) * (span / rows), float),
        q=one[:, :n],
        qd=one[:, n : 2 * n],
        digits=digits,
        plain=_plainly(system, one[: 1 + np.sum(digits > PLAIN_AGREES)], span / rows),
    )


def _compiled(system: System, folder: Path) -> Path:
    """The program in __float128 with its integrator, as an executable."""
    system = replace(system, run=replace(system.run, methods=("rk4",), batch=False, real="double"))
    made = rename_for_c(program.build(lagrange.derive(system)))[0]
    shown = plain.files(made, show, QUAD)
    functions = Functions(Target(made, QUAD))
    call = functions.acceleration.function.call(
        qdd="a", u="NULL", p=f"(const {system.name}_params *)p"
    )
    main = show(Quad(system.name, system.name.upper(), len(system.parameters), call))
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
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise EomcError(f"{missing}; {gcc} said:\n{done.stderr.rstrip()[:2000]}")
    return folder / "quad"


def _run(
    executable: Path, system: System, span: float, rows: int, stages: int, target: float
) -> Text:
    """The rows [q, qd, qdd] as texts, (rows + 1, 3 nq)."""
    numbers: tuple[float, ...] = (span, float(rows), target, SECONDS)
    numbers += tuple(c.start for c in system.coordinates)
    numbers += tuple(c.rate for c in system.coordinates)
    numbers += tuple(p.value for p in system.parameters)
    # Decimal writes a double as the number that it is
    exact = " ".join(str(Decimal(x)) for x in numbers)
    given = f"{gauss(stages)} {exact}\n"
    done = subprocess.run([executable], input=given, capture_output=True, text=True, check=False)
    found = [line.split()[:-1] for line in done.stdout.splitlines()]
    reached = max(0, len(found) - 1) * span / rows
    if done.returncode == 3:
        raise EomcError(
            f"{system.name}: the reference solution got to t = {reached:.6g} s of {span:g} s in "
            f"{SECONDS:g} s of computing: ask for a shorter duration"
        )
    if done.returncode and (jumps := corners(system)):
        raise EomcError(
            f"{system.name}: no reference solution beyond t = {reached:.6g} s: a force that jumps "
            f"({jumps}) holds the motion there; write it smooth, such as tanh(v/0.001) for "
            "sign(v), or ask for a shorter duration"
        )
    if done.returncode:
        raise EomcError(
            f"{system.name}: no reference solution beyond t = {reached:.6g} s: D is singular there "
            "or a state is not finite; ask for a shorter duration"
        )
    return np.array(found)


@cache
def gauss(stages: int) -> str:
    """c, A, A A, b, b A and the Legendre weights of the Gauss method, as decimals of 40 digits.

    Nodes are the zeros of the Legendre polynomial P_s on [0, 1], a_ij = int_0^c_i l_j, by the
    exact rule l_j = b_j sum_k (2k + 1) P_k(c_j) P_k (Hairer & Wanner, Solving ODEs II, sec. IV.5).
    The weights give a's Legendre coefficients, (2k + 1) b_j P_k(c_j).
    """
    with mpmath.workdps(60):
        n = stages
        x = [
            mpmath.findroot(lambda z: mpmath.legendre(n, z), mpmath.mpf(float(near)))
            for near in np.polynomial.legendre.leggauss(n)[0]
        ]
        P = [[mpmath.legendre(k, z) for z in x] for k in range(n + 1)]
        # P_n'(x) = n P_{n-1}(x)/(1 - x^2) at a zero of P_n; weights on [0, 1]
        b = [(1 - z**2) / (n * P[n - 1][j]) ** 2 for j, z in enumerate(x)]
        c = [(1 + z) / 2 for z in x]

        def integral(k: int, i: int) -> Any:
            """int_0^c_i of P_k(2 tau - 1)."""
            if k == 0:
                return c[i]
            return (P[k + 1][i] - P[k - 1][i]) / (2 * (2 * k + 1))

        A = mpmath.matrix(n, n)
        for i in range(n):
            for j in range(n):
                A[i, j] = b[j] * sum((2 * k + 1) * P[k][j] * integral(k, i) for k in range(n))
        AA, row = A * A, mpmath.matrix([b])
        bA = row * A
        weights = [(2 * k + 1) * b[j] * P[k][j] for k in range(n) for j in range(n)]
        everything = [mpmath.mpf(n), *c, *A, *AA, *b, *bA, *weights]
        return " ".join(mpmath.nstr(each, 40, min_fixed=0, max_fixed=0) for each in everything)


def _agreement(one: Text, other: Text) -> Vector:
    """Digits to which two arrays of texts agree, row by row, relative to the largest value so far.

    The fewest so far: what has drifted apart does not become right by meeting again.
    """
    size = np.maximum.accumulate(np.abs(one.astype(float)), axis=0)
    apart = [
        abs(float(Fraction(a) - Fraction(b))) for a, b in zip(one.flat, other.flat, strict=True)
    ]
    off = np.array(apart).reshape(one.shape)
    worst = np.max(np.where(off > 0, off / np.where(size > 0, size, 1.0), 0.0), axis=1)
    found = -np.log10(np.maximum(worst, 10.0**-MOST_DIGITS))
    return np.asarray(np.minimum.accumulate(np.maximum(found, 0.0)))


# --- the plain equations in arbitrary precision -------------------------------------------------


def _plainly(system: System, rows: Text, spacing: float) -> tuple[float, float, float] | None:
    """Digits of accelerations and motion to which the plain equations agree, and until which t.

    Raises EomcError where the accelerations are others: then one of both is wrong.
    """
    if len(rows) < 2 or not symbolic.is_small(system):
        return None
    n = len(system.coordinates)
    with mpmath.workdps(PLAIN_DIGITS):
        found = [[mpmath.mpf(text) for text in row] for row in rows]
        plain = _Plain(system)
        size = np.max(np.abs(rows[:, 2 * n :].astype(float)), axis=0)
        digits = MOST_DIGITS
        for k in sorted(set(np.linspace(0, len(rows) - 1, PLAIN_STATES).astype(int).tolist())):
            a = plain.acceleration(found[k][:n], found[k][n : 2 * n], mpmath.mpf(spacing) * k)
            for i in range(n):
                digits = min(digits, _digits(a[i] - found[k][2 * n + i], size[i]))
        if digits < PLAIN_AGREES and not corners(system):
            raise EomcError(
                f"{system.name}: accelerations in __float128 and those of the plain equations "
                f"agree to {digits:.0f} digits only: please report it, with the scene"
            )
        motion, until = MOST_DIGITS, 0.0
        deadline = time.monotonic() + PLAIN_SECONDS
        x = found[0][: 2 * n]
        sizes = np.max(np.abs(rows[:, : 2 * n].astype(float)), axis=0)
        for k in range(1, len(rows)):
            after = plain.over(x, mpmath.mpf(spacing) * (k - 1), mpmath.mpf(spacing), deadline)
            if after is None:
                break
            x, until = after, spacing * k
            for i in range(2 * n):
                motion = min(motion, _digits(x[i] - found[k][i], sizes[i]))
        return digits, motion if until else 0.0, until


def _digits(off: Any, size: float) -> float:
    if off == 0:
        return MOST_DIGITS
    return min(MOST_DIGITS, float(-mpmath.log10(abs(off) / (size or 1.0))))


class _Plain:
    """The reference's D, bias, tau, constraints and signals with mpmath numbers."""

    def __init__(self, system: System) -> None:
        core = constant(system)
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
        self.values = compiled(symbols, exact, "mpmath")
        self.signals = compiled(symbols, list(r.signals), "mpmath")

    def acceleration(self, q: list[Any], qd: list[Any], t: Any) -> list[Any]:
        """Qdd from D qdd = tau - bias + A^T lambda."""
        u = [mpmath.mpf(0)] * self.m
        if self.m:
            u = self.signals(*q, *qd, t, *u, *self.parameters)
        v = self.values(*q, *qd, t, *u, *self.parameters)
        n = self.size
        matrix = mpmath.matrix([v[i * n : (i + 1) * n] for i in range(n)])
        found, whole = mpmath.lu_solve(matrix, mpmath.matrix(v[n * n :])), [mpmath.mpf(0)] * self.n
        for i, k in enumerate(self.own):
            whole[k] = found[i]
        return whole

    def over(self, x: list[Any], t: Any, span: Any, deadline: float) -> list[Any] | None:
        """The state after `span`, by extrapolated midpoint steps; None where time is up."""
        parts = 1
        while (found := self._extrapolated(x, t, span / parts, deadline)) is None:
            if time.monotonic() > deadline or parts > 1000:
                return None
            parts *= 2
        for k in range(1, parts):
            found = self._extrapolated(found, t + k * span / parts, span / parts, deadline)
            if found is None:
                return None
        return found

    def _extrapolated(self, x: list[Any], t: Any, H: Any, deadline: float) -> list[Any] | None:
        """One step by Gragg, Bulirsch & Stoer with 2, 4, ... midpoint steps; None: not settled.

        Hairer, Norsett & Wanner, Solving ODEs I, sec. II.9.
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
