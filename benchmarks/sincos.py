"""Derive the constants of csrc/sincos.h, and measure its error and its speed beside libm's.

python benchmarks/sincos.py            error in ulp and time per call, two tables
python benchmarks/sincos.py --derive   the constants, as they stand in the header
"""

from __future__ import annotations

import argparse
import ctypes
import math
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mpmath
import numpy as np
from numpy.typing import NDArray

CSRC = Path(__file__).resolve().parent.parent / "csrc"
LIMIT = 2.0**20
"""eomc_sincos_small holds up to here; beyond it libm answers."""
LAST_MULTIPLE = 667543
"""The last n with n pi/2 <= LIMIT."""

Array = NDArray[np.float64]

# --- the constants -------------------------------------------------------------------------

RADIUS = "0.7854"
"""The polynomials are fitted on |r| <= RADIUS, a little more than pi/4."""
TERMS = 6


@dataclass(frozen=True)
class Polynomial:
    """Coefficients from the lowest power of z = r^2 up, and log2 of the relative error."""

    coefficients: tuple[float, ...]
    log2_error: float


def derive() -> dict[str, Polynomial]:
    """P and Q of sin r = r + r^3 P(r^2) and cos r = 1 - r^2/2 + r^4 Q(r^2)."""
    with mpmath.workdps(40):
        return {
            "sin": _fit(lambda r: r, lambda r: r**3, mpmath.sin),
            "cos": _fit(lambda r: 1 - r * r / 2, lambda r: r**4, mpmath.cos),
        }


def _fit(
    head: Callable[[mpmath.mpf], mpmath.mpf],
    factor: Callable[[mpmath.mpf], mpmath.mpf],
    function: Callable[[mpmath.mpf], mpmath.mpf],
) -> Polynomial:
    """Fit function = head + factor P(r^2), rounding one coefficient after the other."""
    radius, nodes = mpmath.mpf(RADIUS), 400
    zs = [
        radius**2 * (1 - mpmath.cos(mpmath.pi * (2 * j + 1) / (2 * nodes))) / 2
        for j in range(nodes)
    ]
    rs = [mpmath.sqrt(z) for z in zs]
    weights = [factor(r) / function(r) for r in rs]
    rest = [(function(r) - head(r)) / function(r) for r in rs]
    coefficients: list[float] = []
    for power in range(TERMS):
        fitted = _remez(zs, weights, rest, TERMS - power)
        coefficients.append(float(fitted[0]))
        rest = [t - w * coefficients[-1] for t, w in zip(rest, weights, strict=True)]
        weights = [w * z for w, z in zip(weights, zs, strict=True)]
    error = max(abs(t) for t in rest)
    return Polynomial(tuple(coefficients), float(mpmath.log(error, 2)))


def _remez(
    zs: Sequence[mpmath.mpf],
    weights: Sequence[mpmath.mpf],
    targets: Sequence[mpmath.mpf],
    terms: int,
) -> list[mpmath.mpf]:
    """Minimise max |target - weight (c0 + c1 z + ...)| over the nodes by Remez' exchange.

    At the optimum the error takes its largest size at terms + 1 nodes, with alternating signs.
    """
    reference = [len(zs) * (2 * i + 1) // (2 * (terms + 1)) for i in range(terms + 1)]
    for _ in range(50):
        system = mpmath.matrix(terms + 1, terms + 1)
        for row, j in enumerate(reference):
            for k in range(terms):
                system[row, k] = weights[j] * zs[j] ** k
            system[row, terms] = (-1) ** row
        solution = mpmath.lu_solve(system, mpmath.matrix([targets[j] for j in reference]))
        fitted = list(solution[:terms])
        error = [
            t - w * mpmath.polyval(fitted[::-1], z)
            for t, w, z in zip(targets, weights, zs, strict=True)
        ]
        extrema: list[int] = []
        for j, e in enumerate(error):
            if extrema and (e > 0) == (error[extrema[-1]] > 0):
                if abs(e) > abs(error[extrema[-1]]):
                    extrema[-1] = j
            else:
                extrema.append(j)
        while len(extrema) > terms + 1:
            extrema.pop(0 if abs(error[extrema[0]]) < abs(error[extrema[-1]]) else -1)
        if extrema == reference:
            return fitted
        reference = extrema
    raise ArithmeticError("the Remez exchange did not settle in 50 rounds")


def parts_of_half_pi() -> dict[str, tuple[float, ...]]:
    """pi/2 as sums of doubles, each cut (never rounded up) to 53 or to 33 bits."""
    return {"with FMA": _parts(3, 53), "without FMA": _parts(4, 33)}


def _parts(count: int, bits: int) -> tuple[float, ...]:
    parts: list[float] = []
    with mpmath.workprec(400):
        rest = mpmath.pi / 2
        for _ in range(count):
            last_bit = mpmath.ldexp(1, int(mpmath.frexp(rest)[1]) - bits)
            parts.append(float(mpmath.floor(rest / last_bit) * last_bit))
            rest -= parts[-1]
    return tuple(parts)


def print_constants() -> None:
    print(f"2/pi  {float(2 / mpmath.pi)!r}")
    print(f"magic {1.5 * 2.0**52!r}")
    for which, parts in parts_of_half_pi().items():
        print(f"pi/2 {which}: {', '.join(map(repr, parts))}")
    for name, polynomial in derive().items():
        print(f"{name}: relative error 2^{polynomial.log2_error:.1f} on |r| <= {RADIUS}")
        for k, coefficient in enumerate(polynomial.coefficients):
            print(f"  {'p' if name == 'sin' else 'q'}{k} {coefficient!r}")


# --- building ------------------------------------------------------------------------------

HARNESS = """\
#include "sincos.h"
int fast_fma(void) { return EOMC_FAST_FMA; }
void small(long n, const double *restrict x, double *restrict s, double *restrict c)
{
    for (long i = 0; i < n; i++) eomc_sincos_small(x[i], s + i, c + i);
}
void any(long n, const double *restrict x, double *restrict s, double *restrict c)
{
    for (long i = 0; i < n; i++) eomc_sincos(x[i], s + i, c + i);
}
void libm(long n, const double *restrict x, double *restrict s, double *restrict c)
{
    for (long i = 0; i < n; i++) { s[i] = sin(x[i]); c[i] = cos(x[i]); }
}
typedef void loop(long, const double *restrict, double *restrict, double *restrict);
void often(long times, loop *f, long n, const double *x, double *s, double *c)
{
    while (times-- > 0) f(n, x, s, c);
}
double any_chain(long n, const double *offset)
{
    double x = 0.0, s, c;
    for (long i = 0; i < n; i++) { eomc_sincos(x, &s, &c); x = offset[i] + 0.5 * s + 0.25 * c; }
    return x;
}
double libm_chain(long n, const double *offset)
{
    double x = 0.0;
    for (long i = 0; i < n; i++) x = offset[i] + 0.5 * sin(x) + 0.25 * cos(x);
    return x;
}
"""

REFERENCE = """\
#ifdef USE_QUADMATH
#include <quadmath.h>
typedef __float128 wide;
#define SIN sinq
#define COS cosq
#define FREXP frexpq
#define LDEXP ldexpq
#else
#include <math.h>
typedef long double wide;
#define SIN sinl
#define COS cosl
#define FREXP frexpl
#define LDEXP ldexpl
#endif
int wide_bytes(void) { return sizeof(wide); }
static void widen(double *worst, wide exact, double got)
{
    int e;
    FREXP(exact, &e);
    if (e < -1021) e = -1021;
    double error = (double)LDEXP(got - exact, 53 - e);
    if (error < 0) error = -error;
    if (!(error <= *worst)) *worst = error;
}
void errors(long n, const double *x, long sets, const double *s, const double *c, double *worst)
{
    for (long i = 0; i < n; i++) {
        const wide sine = SIN(x[i]), cosine = COS(x[i]);
        for (long k = 0; k < sets; k++) {
            widen(&worst[2 * k], sine, s[k * n + i]);
            widen(&worst[2 * k + 1], cosine, c[k * n + i]);
        }
    }
}
"""

SPEED = (
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-tree-slp-vectorize",
)
"""The flags of a generated project."""


def compiler() -> str:
    return os.environ.get("CC", "cc")


def build(source: str, name: str, folder: Path, flags: Sequence[str]) -> ctypes.CDLL:
    """Compile and load; subprocess.CalledProcessError carries the compiler's words."""
    text, library = folder / f"{name}.c", folder / f"{name}.so"
    text.write_text(source)
    command = [compiler(), "-shared", "-fPIC", f"-I{CSRC}", str(text), "-o", str(library)]
    subprocess.run([*command, *flags, "-lm"], check=True, capture_output=True, text=True)
    loaded = ctypes.CDLL(str(library))
    for chain in ("any_chain", "libm_chain"):
        if hasattr(loaded, chain):
            getattr(loaded, chain).restype = ctypes.c_double
    return loaded


def builds(folder: Path) -> dict[str, ctypes.CDLL]:
    """The builds that this machine can run: vectorised or not, with FMA and without."""
    variants = {
        "vector": [*SPEED],
        "scalar": [*SPEED, "-fno-tree-vectorize"],
        "vector, no FMA": [*SPEED, "-mno-fma"],
        "scalar, no FMA": [*SPEED, "-mno-fma", "-fno-tree-vectorize"],
    }
    made: dict[str, ctypes.CDLL] = {}
    for name, flags in variants.items():
        try:
            made[name] = build(HARNESS, name.replace(", ", "_").replace(" ", "_"), folder, flags)
        except subprocess.CalledProcessError as error:
            if "-mno-fma" not in flags:
                print(error.stderr)
                raise
            print(f"left out: {name} ({compiler()} does not take -mno-fma here)")
    return made


def pointer(array: Array) -> ctypes.c_void_p:
    assert array.dtype == np.float64 and array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


def sincos(library: ctypes.CDLL, function: str, x: Array) -> tuple[Array, Array]:
    """(sin x, cos x) by one of the harness's loops: small, any or libm."""
    s, c = np.empty_like(x), np.empty_like(x)
    getattr(library, function)(ctypes.c_long(x.size), pointer(x), pointer(s), pointer(c))
    return s, c


# --- error ---------------------------------------------------------------------------------


def neighbours_of_multiples(ns: Sequence[int]) -> Array:
    """The doubles on both sides of n pi/2: those that lose most digits in the reduction."""
    with mpmath.workprec(400):
        half_pi = int(mpmath.floor(mpmath.ldexp(mpmath.pi / 2, 300)))
    points: list[float] = []
    for n in ns:
        multiple = n * half_pi
        shift = multiple.bit_length() - 53
        below = multiple >> shift
        points += [math.ldexp(below, shift - 300), math.ldexp(below + 1, shift - 300)]
    return np.array(points)


def random_points(count: int, rng: np.random.Generator) -> dict[str, Array]:
    """Random arguments of both signs, in ranges of |x| and where the error is largest."""

    def spread(low: float, high: float) -> Array:
        return rng.uniform(low, high, count)

    def multiples() -> Array:
        n = np.floor(np.exp2(rng.uniform(0.0, math.log2(LAST_MULTIPLE), count)))
        return n * (math.pi / 2)

    sign = rng.choice([-1.0, 1.0], count)
    points = {
        "2^-1074 to 2^-30": np.exp2(spread(-1074.0, -30.0)),
        "2^-30 to pi/4": np.exp2(spread(-30.0, math.log2(math.pi / 4))),
        "pi/4 to 2 pi": spread(math.pi / 4, 2 * math.pi),
        "2 pi to 1000": spread(2 * math.pi, 1000.0),
        "1000 to 2^20": spread(1000.0, LIMIT),
        "r in [1/2, pi/6]": multiples() + spread(0.5, math.pi / 6),
        "r in [0.7, pi/4]": multiples() + spread(0.7, math.pi / 4),
    }
    return {name: np.minimum(x, LIMIT) * sign for name, x in points.items()}


def reference(folder: Path) -> ctypes.CDLL:
    """The high-precision judge: __float128 of libquadmath, or else long double."""
    try:
        flags = ["-O2", "-DUSE_QUADMATH", "-lquadmath"]
        return build(REFERENCE, "reference_quad", folder, flags)
    except subprocess.CalledProcessError:
        judge = build(REFERENCE, "reference_long", folder, ["-O2"])
        if judge.wide_bytes() <= 8:
            raise SystemExit("no reference: set CC to gcc with libquadmath") from None
        print("libquadmath is missing: the reference is long double")
        return judge


def print_errors(made: dict[str, ctypes.CDLL], points: dict[str, Array], folder: Path) -> None:
    judge = reference(folder)
    columns = [name for name in made if name.startswith("vector")]
    print("\nlargest error in ulp" + "".join(f"{name:>24}" for name in [*columns, "libm"]))
    print(f"{'range of |x|':20}" + f"{'sin':>16}{'cos':>8}" * (len(columns) + 1))
    for title, x in points.items():
        results = [sincos(made[name], "small", x) for name in columns]
        results.append(sincos(made["vector"], "libm", x))
        s = np.concatenate([result[0] for result in results])
        c = np.concatenate([result[1] for result in results])
        worst = np.zeros((len(results), 2))
        judge.errors(
            ctypes.c_long(x.size),
            pointer(x),
            ctypes.c_long(len(results)),
            pointer(s),
            pointer(c),
            pointer(worst),
        )
        print(f"{title:20}" + "".join(f"{es:16.3f}{ec:8.3f}" for es, ec in worst), flush=True)


# --- time ----------------------------------------------------------------------------------


def print_times(made: dict[str, ctypes.CDLL], rng: np.random.Generator) -> None:
    """Shortest of 200 interleaved rounds; arguments within +-10, quadrants at random."""
    x, offset = rng.uniform(-10.0, 10.0, 1024), rng.uniform(-10.0, 10.0, 16384)
    times = offset.size // x.size
    s, c = np.empty_like(x), np.empty_like(x)

    def chain(library: ctypes.CDLL, name: str) -> Callable[[], float]:
        function = getattr(library, name)
        return lambda: function(ctypes.c_long(offset.size), pointer(offset))

    def loop(library: ctypes.CDLL, name: str) -> Callable[[], None]:
        function = ctypes.cast(getattr(library, name), ctypes.c_void_p)
        sizes = ctypes.c_long(times), function, ctypes.c_long(x.size)
        return lambda: library.often(*sizes, pointer(x), pointer(s), pointer(c))

    work: dict[str, Callable[[], object]] = {
        "dependent chain, libm": chain(made["vector"], "libm_chain"),
        "array, libm": loop(made["vector"], "libm"),
    }
    for name, library in made.items():
        if name.startswith("scalar"):
            work[f"dependent chain, {name}"] = chain(library, "any_chain")
        work[f"array, {name}"] = loop(library, "small")
    best = dict.fromkeys(work, math.inf)
    for _ in range(200):
        for title, call in work.items():
            start = time.perf_counter()
            call()
            best[title] = min(best[title], (time.perf_counter() - start) / offset.size)
    print("\ntime per sine and cosine      ns   libm takes")
    for title, seconds in sorted(best.items()):
        ratio = best[f"{title.split(', ')[0]}, libm"] / seconds
        print(f"{title:32}{seconds * 1e9:6.2f}{ratio:8.1f} x")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--derive", action="store_true", help="print the constants and stop")
    parser.add_argument("--points", type=int, default=2_000_000, help="random points a range")
    options = parser.parse_args()
    if options.derive:
        print_constants()
        return
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = builds(folder)
        print(f"built with {compiler()}; FMA is used: {bool(made['vector'].fast_fma())}")
        print_times(made, rng)
        points = random_points(options.points, rng)
        points["next to n pi/2"] = neighbours_of_multiples(range(1, LAST_MULTIPLE + 1))
        print_errors(made, points, folder)


if __name__ == "__main__":
    main()
