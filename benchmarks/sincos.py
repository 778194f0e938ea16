"""Derive constants of csrc/sincos/sincos.h and sincosf.h; measure error and speed against libm.

python benchmarks/sincos.py            error in ulp and time per call, two tables
python benchmarks/sincos.py --float    the same of sincosf.h, the error over every float
python benchmarks/sincos.py --derive   the constants, as they stand in the headers
"""

from __future__ import annotations

import argparse
import ctypes
import math
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

CSRC = Path(__file__).resolve().parent.parent / "csrc" / "sincos"

Array = NDArray[Any]  # of either precision


@dataclass(frozen=True)
class Precision:
    """One of the two headers.

    limit: the largest |x| of eomc_sincos_small; beyond it libm answers. last_multiple: the last n
    with n pi/2 <= limit. radius: the polynomials, of so many terms, are fitted on |r| <= radius:
    pi/4, and what the rounding of n adds. with_fma, without_fma: bits of the parts of pi/2.
    """

    suffix: str
    dtype: type[np.floating[Any]]
    bits: int
    limit: float
    last_multiple: int
    radius: str
    terms: int
    with_fma: tuple[int, ...]
    without_fma: tuple[int, ...]

    @property
    def header(self) -> Path:
        return CSRC / f"sincos{self.suffix}.h"

    @property
    def flags(self) -> tuple[str, ...]:
        """What makes the harness and the judge one of this type."""
        return ("-DSINGLE",) if self.suffix else ()

    @property
    def smallest(self) -> int:
        """log2 of the smallest number above 0."""
        return -149 if self.suffix else -1074


DOUBLE = Precision("", np.float64, 53, 2.0**20, 667543, "0.7854", 6, (53,) * 3, (33,) * 4)
SINGLE = Precision("f", np.float32, 24, 2.0**13, 5215, "0.7862", 3, (24,) * 3, (11, 11, 11, 11, 24))

# --- the constants -------------------------------------------------------------------------


@dataclass(frozen=True)
class Polynomial:
    """Coefficients from the lowest power of z = r^2 up, and log2 of the relative error."""

    coefficients: tuple[float, ...]
    log2_error: float


def derive(of: Precision) -> dict[str, Polynomial]:
    """P and Q of sin r = r + r^3 P(r^2) and cos r = 1 - r^2/2 + r^4 Q(r^2)."""
    with mpmath.workdps(40):
        return {
            "sin": _fit(of, lambda r: r, lambda r: r**3, mpmath.sin),
            "cos": _fit(of, lambda r: 1 - r * r / 2, lambda r: r**4, mpmath.cos),
        }


def _fit(
    of: Precision,
    head: Callable[[mpmath.mpf], mpmath.mpf],
    factor: Callable[[mpmath.mpf], mpmath.mpf],
    function: Callable[[mpmath.mpf], mpmath.mpf],
) -> Polynomial:
    """Fit function = head + factor P(r^2), rounding one coefficient after the other."""
    radius, nodes = mpmath.mpf(of.radius), 400
    zs = [
        radius**2 * (1 - mpmath.cos(mpmath.pi * (2 * j + 1) / (2 * nodes))) / 2
        for j in range(nodes)
    ]
    rs = [mpmath.sqrt(z) for z in zs]
    weights = [factor(r) / function(r) for r in rs]
    rest = [(function(r) - head(r)) / function(r) for r in rs]
    coefficients: list[float] = []
    for power in range(of.terms):
        fitted = _remez(zs, weights, rest, of.terms - power)
        with mpmath.workprec(of.bits):
            coefficients.append(float(+fitted[0]))
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


def parts_of_half_pi(of: Precision) -> dict[str, tuple[float, ...]]:
    """pi/2 as sums of numbers that are each cut (never rounded up) to so many bits."""
    return {"with FMA": _parts(of.with_fma), "without FMA": _parts(of.without_fma)}


def _parts(sizes: Sequence[int]) -> tuple[float, ...]:
    parts: list[float] = []
    with mpmath.workprec(400):
        rest = mpmath.pi / 2
        for bits in sizes:
            last_bit = mpmath.ldexp(1, int(mpmath.frexp(rest)[1]) - bits)
            parts.append(float(mpmath.floor(rest / last_bit) * last_bit))
            rest -= parts[-1]
    return tuple(parts)


def print_constants(of: Precision) -> None:
    def text(x: float) -> str:
        return f"{of.dtype(x)!s}{of.suffix}"

    print(f"{of.header.name}\n2/pi  {text(float(2 / mpmath.pi))}")
    print(f"magic {text(1.5 * 2.0 ** (of.bits - 1))}")
    for which, parts in parts_of_half_pi(of).items():
        print(f"pi/2 {which}: {', '.join(map(text, parts))}")
    for name, polynomial in derive(of).items():
        print(f"{name}: relative error 2^{polynomial.log2_error:.1f} on |r| <= {of.radius}")
        for k, coefficient in enumerate(polynomial.coefficients):
            print(f"  {'p' if name == 'sin' else 'q'}{k} {text(coefficient)}")


# --- building ------------------------------------------------------------------------------

HARNESS = """\
#ifdef SINGLE
#include "sincosf.h"
#define FAST_FMA EOMC_FAST_FMAF
#define SMALL eomc_sincosf_small
#define ANY eomc_sincosf
#define SIN sinf
#define COS cosf
typedef float real;
#else
#include "sincos.h"
#define FAST_FMA EOMC_FAST_FMA
#define SMALL eomc_sincos_small
#define ANY eomc_sincos
#define SIN sin
#define COS cos
typedef double real;
#endif
int fast_fma(void) { return FAST_FMA; }
void small(long n, const real *restrict x, real *restrict s, real *restrict c)
{
    for (long i = 0; i < n; i++) SMALL(x[i], s + i, c + i);
}
void any(long n, const real *restrict x, real *restrict s, real *restrict c)
{
    for (long i = 0; i < n; i++) ANY(x[i], s + i, c + i);
}
void libm(long n, const real *restrict x, real *restrict s, real *restrict c)
{
    for (long i = 0; i < n; i++) { s[i] = SIN(x[i]); c[i] = COS(x[i]); }
}
typedef void loop(long, const real *restrict, real *restrict, real *restrict);
void often(long times, loop *f, long n, const real *x, real *s, real *c)
{
    while (times-- > 0) f(n, x, s, c);
}
double any_chain(long n, const real *offset)
{
    real x = 0, s, c;
    for (long i = 0; i < n; i++) { ANY(x, &s, &c); x = offset[i] + (real)0.5 * s + (real)0.25 * c; }
    return x;
}
double libm_chain(long n, const real *offset)
{
    real x = 0;
    for (long i = 0; i < n; i++) x = offset[i] + (real)0.5 * SIN(x) + (real)0.25 * COS(x);
    return x;
}
"""

REFERENCE = """\
#ifdef SINGLE
#include <math.h>
typedef float real;
typedef double wide;
#define BITS 24
#define LOWEST -125
#define SIN sin
#define COS cos
#define FREXP frexp
#define LDEXP ldexp
#else
typedef double real;
#define BITS 53
#define LOWEST -1021
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
#endif
int wide_bytes(void) { return sizeof(wide); }
static void widen(double *worst, wide exact, real got)
{
    int e;
    FREXP(exact, &e);
    if (e < LOWEST) e = LOWEST;
    double error = (double)LDEXP(got - exact, BITS - e);
    if (error < 0) error = -error;
    if (!(error <= *worst)) *worst = error;
}
void errors(long n, const real *x, long sets, const real *s, const real *c, double *worst)
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

WITHOUT_FMA = ("-mno-fma", "-mno-fma4", "-mno-avx512f")
"""No multiply-add at all: AVX-512 and AMD's FMA4 have their own, into which clang contracts."""


def compiler() -> str:
    return os.environ.get("CC", "cc")


def build(source: str, name: str, folder: Path, flags: Sequence[str]) -> ctypes.CDLL:
    """Compile and load; subprocess.CalledProcessError carries the compiler's words."""
    text, library = folder / f"{name}.c", folder / f"{name}.so"
    text.write_text(source)
    command = [compiler(), "-shared", "-fPIC", f"-I{CSRC}", str(text), "-o", str(library)]
    subprocess.run([*command, *flags, "-lm"], check=True, capture_output=True, text=True)
    loaded = ctypes.CDLL(str(library))
    for name in ("any_chain", "libm_chain"):
        if hasattr(loaded, name):
            getattr(loaded, name).restype = ctypes.c_double
    return loaded


def builds(folder: Path, of: Precision = DOUBLE) -> dict[str, ctypes.CDLL]:
    """The builds that this machine can run: vectorised or not, with FMA and without."""
    variants = {
        "vector": [*SPEED],
        "scalar": [*SPEED, "-fno-tree-vectorize"],
        "vector, no FMA": [*SPEED, *WITHOUT_FMA],
        "scalar, no FMA": [*SPEED, *WITHOUT_FMA, "-fno-tree-vectorize"],
    }
    made: dict[str, ctypes.CDLL] = {}
    for name, flags in variants.items():
        try:
            library = name.replace(", ", "_").replace(" ", "_") + of.suffix
            made[name] = build(HARNESS, library, folder, [*flags, *of.flags])
        except subprocess.CalledProcessError as error:
            if "-mno-fma" not in flags:
                print(error.stderr)
                raise
            print(f"left out: {name} ({compiler()} does not take -mno-fma here)")
    return made


def pointer(array: Array) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


def sincos(library: ctypes.CDLL, function: str, x: Array) -> tuple[Array, Array]:
    """(sin x, cos x) by one of the harness's loops: small, any or libm; x of the library's type."""
    s, c = np.empty_like(x), np.empty_like(x)
    getattr(library, function)(ctypes.c_long(x.size), pointer(x), pointer(s), pointer(c))
    return s, c


# --- error ---------------------------------------------------------------------------------


def neighbours_of_multiples(ns: Sequence[int], of: Precision = DOUBLE) -> Array:
    """The numbers on both sides of n pi/2: those that lose most digits in the reduction."""
    with mpmath.workprec(400):
        half_pi = int(mpmath.floor(mpmath.ldexp(mpmath.pi / 2, 300)))
    points: list[float] = []
    for n in ns:
        multiple = n * half_pi
        shift = multiple.bit_length() - of.bits
        below = multiple >> shift
        points += [math.ldexp(below, shift - 300), math.ldexp(below + 1, shift - 300)]
    return np.array(points, of.dtype)


def random_points(count: int, rng: np.random.Generator, of: Precision = DOUBLE) -> dict[str, Array]:
    """Random arguments of both signs, in ranges of |x| and where the error is largest."""

    def spread(low: float, high: float) -> Array:
        return rng.uniform(low, high, count)

    def multiples() -> Array:
        n = np.floor(np.exp2(rng.uniform(0.0, math.log2(of.last_multiple), count)))
        return n * (math.pi / 2)

    sign = rng.choice([-1.0, 1.0], count)
    points = {
        f"2^{of.smallest} to 2^-30": np.exp2(spread(of.smallest, -30.0)),
        "2^-30 to pi/4": np.exp2(spread(-30.0, math.log2(math.pi / 4))),
        "pi/4 to 2 pi": spread(math.pi / 4, 2 * math.pi),
        "2 pi to 1000": spread(2 * math.pi, 1000.0),
        f"1000 to {_power(of.limit)}": spread(1000.0, of.limit),
        "r in [1/2, pi/6]": multiples() + spread(0.5, math.pi / 6),
        "r in [0.7, pi/4]": multiples() + spread(0.7, math.pi / 4),
    }
    return {name: (np.minimum(x, of.limit) * sign).astype(of.dtype) for name, x in points.items()}


def _power(x: float) -> str:
    return f"2^{math.log2(x):.0f}"


TINY = 2.0**-30
"""Below it sin x = x (1 - 2^-62) and cos x = 1 - 2^-61, which must come out as x and 1."""


def every_float(block: int = 2**20) -> dict[str, Iterator[Array]]:
    """All floats from TINY to the limit by ranges, those above 0, in blocks."""

    def bits(x: float) -> int:
        return int(np.float32(x).view(np.uint32))

    def blocks(first: int, end: int) -> Iterator[Array]:
        for at in range(first, end, block):
            yield np.arange(at, min(at + block, end), dtype=np.uint32).view(np.float32)

    ends = {"2^-30": TINY, "pi/4": math.pi / 4, "2 pi": 2 * math.pi, "1000": 1000.0}
    names = [*ends, _power(SINGLE.limit)]
    marks = [*map(bits, ends.values()), bits(SINGLE.limit) + 1]
    return {
        f"{low} to {high}": blocks(first, end)
        for low, high, first, end in zip(names, names[1:], marks, marks[1:], strict=False)
    }


def check_tiny_and_negative(made: dict[str, ctypes.CDLL]) -> None:
    """Every float below TINY, and every negative one: what sine and cosine are exactly or by sign.

    AssertionError where it is not so.
    """
    tiny = np.arange(int(np.float32(TINY).view(np.uint32)), dtype=np.uint32).view(np.float32)
    for name in [name for name in made if name.startswith("vector")]:
        for x in np.array_split(tiny, 800):
            for signed in (x, -x):
                s, c = sincos(made[name], "small", signed)
                assert s.tobytes() == signed.tobytes() and (c == 1).all(), name
        for x in chain.from_iterable(every_float().values()):
            (s, c), (minus, same) = (sincos(made[name], "small", y) for y in (x, -x))
            assert (-s).tobytes() == minus.tobytes() and c.tobytes() == same.tobytes(), name
    print("\nbelow 2^-30: sin x = x and cos x = 1; negative: sin -x = -sin x, cos -x = cos x")


def reference(folder: Path, of: Precision = DOUBLE) -> ctypes.CDLL:
    """The judge of doubles: __float128 of libquadmath, or else long double; of floats: double."""
    if of is SINGLE:
        return build(REFERENCE, "reference_float", folder, ["-O2", *of.flags])
    try:
        flags = ["-O2", "-DUSE_QUADMATH", "-lquadmath"]
        return build(REFERENCE, "reference_quad", folder, flags)
    except subprocess.CalledProcessError:
        judge = build(REFERENCE, "reference_long", folder, ["-O2"])
        if judge.wide_bytes() <= 8:
            raise SystemExit("no reference: set CC to gcc with libquadmath") from None
        print("libquadmath is missing: the reference is long double")
        return judge


def print_errors(
    made: dict[str, ctypes.CDLL], points: dict[str, Iterator[Array]], judge: ctypes.CDLL
) -> None:
    """points: blocks of arguments, by what they are called."""
    columns = [name for name in made if name.startswith("vector")]
    print("\nlargest error in ulp" + "".join(f"{name:>24}" for name in [*columns, "libm"]))
    print(f"{'range of |x|':20}" + f"{'sin':>16}{'cos':>8}" * (len(columns) + 1))
    for title, blocks in points.items():
        worst = np.zeros((len(columns) + 1, 2))
        for x in blocks:
            results = [sincos(made[name], "small", x) for name in columns]
            results.append(sincos(made["vector"], "libm", x))
            s = np.concatenate([result[0] for result in results])
            c = np.concatenate([result[1] for result in results])
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


def print_times(made: dict[str, ctypes.CDLL], rng: np.random.Generator, of: Precision) -> None:
    """Shortest of 200 interleaved rounds; arguments within +-10, quadrants at random."""
    x, offset = (rng.uniform(-10.0, 10.0, n).astype(of.dtype) for n in (1024, 16384))
    times = offset.size // x.size
    s, c = np.empty_like(x), np.empty_like(x)

    def dependent(library: ctypes.CDLL, name: str) -> Callable[[], float]:
        function = getattr(library, name)
        return lambda: function(ctypes.c_long(offset.size), pointer(offset))

    def loop(library: ctypes.CDLL, name: str) -> Callable[[], None]:
        function = ctypes.cast(getattr(library, name), ctypes.c_void_p)
        sizes = ctypes.c_long(times), function, ctypes.c_long(x.size)
        return lambda: library.often(*sizes, pointer(x), pointer(s), pointer(c))

    work: dict[str, Callable[[], object]] = {
        "dependent chain, libm": dependent(made["vector"], "libm_chain"),
        "array, libm": loop(made["vector"], "libm"),
    }
    for name, library in made.items():
        if name.startswith("scalar"):
            work[f"dependent chain, {name}"] = dependent(library, "any_chain")
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
    parser.add_argument("--float", action="store_true", help="sincosf.h instead of sincos.h")
    parser.add_argument(
        "--points", type=int, default=2_000_000, help="random points a range, of doubles"
    )
    options = parser.parse_args()
    if options.derive:
        print_constants(DOUBLE)
        print_constants(SINGLE)
        return
    of = SINGLE if options.float else DOUBLE
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = builds(folder, of)
        print(f"built with {compiler()}; FMA is used: {bool(made['vector'].fast_fma())}")
        print_times(made, rng, of)
        judge = reference(folder, of)
        if of is SINGLE:
            print_errors(made, every_float(), judge)
            check_tiny_and_negative(made)
            return
        points = random_points(options.points, rng)
        points["next to n pi/2"] = neighbours_of_multiples(range(1, of.last_multiple + 1))
        print_errors(made, {title: iter([x]) for title, x in points.items()}, judge)


if __name__ == "__main__":
    main()
