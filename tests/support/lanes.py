"""The C of csrc/lanes for vectors of every width, and benchmarks/sincos.py, which derives it."""

from __future__ import annotations

import ctypes
import importlib.util
import math
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import mpmath
import numpy as np

from support.session import ROOT

LARGEST_ERROR = 1.6  # ulp


def _benchmark() -> ModuleType:
    """Load benchmarks/sincos.py, which contains the derivation and the harness."""
    path = ROOT / "benchmarks" / "sincos.py"
    spec = importlib.util.spec_from_file_location("benchmark_sincos", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


bench = _benchmark()


def nearest_multiples(count: int, precision: Any) -> list[int]:
    """Return the n, up to the limit, for which a number is closest to n pi/2, in units of pi/2.

    A number 2^e m is close to n pi/2 if m/n is close to 2^-e pi/2: a convergent of its continued
    fraction. Multiples k (m, n) of a convergent are the next closest.
    """
    candidates: dict[int, mpmath.mpf] = {}
    with mpmath.workprec(400):
        for exponent in range(-precision.bits, math.frexp(precision.limit)[1] - precision.bits + 1):
            ratio = mpmath.ldexp(mpmath.pi / 2, -exponent)
            whole = int(mpmath.floor(ratio))
            rest = ratio - whole
            before, n = 0, 1
            while n <= precision.last_multiple:
                multiple = n * mpmath.pi / 2
                if 1 <= mpmath.ldexp(multiple, 1 - precision.bits - exponent) < 2:
                    m = mpmath.nint(n * ratio)
                    candidates[n] = abs(mpmath.ldexp(m, exponent) - multiple)
                rest = 1 / rest
                digit = int(mpmath.floor(rest))
                rest -= digit
                before, n = n, digit * n + before
    return sorted(candidates, key=lambda n: candidates[n])[:count]


VECTORS = {"_16": 16, "_32": 32, "_64": 64}  # bytes, by the suffix of names
LANES = ("", *VECTORS)
BUILDS = {
    "native": bench.SPEED,
    "native, no FMA": (*bench.SPEED, *bench.WITHOUT_FMA),
    "narrow registers": ("-O1",),
}
EXPONENTIALS = ("exp", "tanh")
MOST = 16  # numbers in the widest vector

ONE = """
typedef EOMC_REAL eomc_LANE_unaligned;
enum { EOMC_LANE_COUNT = 1 };

void exceeds(long n, const EOMC_REAL *x, const EOMC_REAL *most, int *told)
{
    for (long i = 0; i < n; i++)
        told[i] = eomc_exceeds(x[i], *most);
}
"""
ROTATING = """
void rotate_LANE(long n, const EOMC_REAL *d, EOMC_REAL *s, EOMC_REAL *c)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT) {
        eomc_LANE x = *(eomc_LANE_unaligned *)(s + i), y = *(eomc_LANE_unaligned *)(c + i);

        eomc_rotate_LANE(*(const eomc_LANE_unaligned *)(d + i), &x, &y);
        *(eomc_LANE_unaligned *)(s + i) = x;
        *(eomc_LANE_unaligned *)(c + i) = y;
    }
}

void rotate_both_LANE(long n, const EOMC_REAL *d, const EOMC_REAL *s0, const EOMC_REAL *c0,
    EOMC_REAL *s_back, EOMC_REAL *c_back, EOMC_REAL *s_on, EOMC_REAL *c_on)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT) {
        eomc_LANE s[2], c[2];

        eomc_rotate_both_LANE(*(const eomc_LANE_unaligned *)(d + i),
            *(const eomc_LANE_unaligned *)(s0 + i), *(const eomc_LANE_unaligned *)(c0 + i),
            &s[0], &c[0], &s[1], &c[1]);
        *(eomc_LANE_unaligned *)(s_back + i) = s[0];
        *(eomc_LANE_unaligned *)(c_back + i) = c[0];
        *(eomc_LANE_unaligned *)(s_on + i) = s[1];
        *(eomc_LANE_unaligned *)(c_on + i) = c[1];
    }
}
"""
SEVERAL = """
static void tell_LANE(int *told, const eomc_LANE_mask *failed)
{
    for (int i = 0; i < EOMC_LANE_COUNT; i++)
        told[i] = (*failed)[i] < 0;
}

void small_LANE(long n, const EOMC_REAL *x, EOMC_REAL *s, EOMC_REAL *c)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT) {
        const eomc_LANE angle = *(const eomc_LANE_unaligned *)(x + i);
        eomc_LANE sine, cosine;

        eomc_sincos_small_LANE(&angle, &sine, &cosine);
        *(eomc_LANE_unaligned *)(s + i) = sine;
        *(eomc_LANE_unaligned *)(c + i) = cosine;
    }
}

/* told: what has failed before, and then that and what fails now */
void sincos_LANE(long n, const EOMC_REAL *x, EOMC_REAL *s, EOMC_REAL *c, int *told)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT) {
        eomc_LANE_mask failed;
        eomc_LANE sine, cosine;

        for (int k = 0; k < EOMC_LANE_COUNT; k++)
            failed[k] = -told[i + k];
        eomc_sincos_LANE(*(const eomc_LANE_unaligned *)(x + i), &sine, &cosine, &failed);
        *(eomc_LANE_unaligned *)(s + i) = sine;
        *(eomc_LANE_unaligned *)(c + i) = cosine;
        tell_LANE(told + i, &failed);
    }
}

void exceeds_LANE(long n, const EOMC_REAL *x, const EOMC_REAL *most, int *told)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT) {
        eomc_LANE_mask failed = eomc_exceeds_LANE(*(const eomc_LANE_unaligned *)(x + i), *most);

        tell_LANE(told + i, &failed);
    }
}

void not_positive_LANE(long n, const EOMC_REAL *x, int *told)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT) {
        eomc_LANE_mask failed = eomc_not_positive_LANE(*(const eomc_LANE_unaligned *)(x + i));

        tell_LANE(told + i, &failed);
    }
}

void not_finite_LANE(long n, const EOMC_REAL *x, int *told)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT) {
        eomc_LANE_mask failed = eomc_not_finite_LANE(*(const eomc_LANE_unaligned *)(x + i));

        tell_LANE(told + i, &failed);
    }
}

int count_LANE(void)
{
    return EOMC_LANE_COUNT;
}

int any_LANE(const EOMC_INTEGER *bits)
{
    eomc_LANE_mask failed;

    for (int i = 0; i < EOMC_LANE_COUNT; i++)
        failed[i] = bits[i];
    return eomc_any_LANE(&failed);
}

void same_LANE(const EOMC_REAL *x, EOMC_REAL *to)
{
    *(eomc_LANE_unaligned *)to = eomc_same_LANE(*x);
}
"""
EACH = """
void NAME_LANE(long n, const EOMC_REAL *x, EOMC_REAL *y)
{
    for (long i = 0; i < n; i += EOMC_LANE_COUNT)
        *(eomc_LANE_unaligned *)(y + i) = eomc_NAME_LANE(*(const eomc_LANE_unaligned *)(x + i));
}
"""
FOUR = """
void put(const EOMC_REAL *x, EOMC_REAL *to)
{
    eomc_put(to, x[0], x[1], x[2], x[3]);
}

void interleave(const EOMC_REAL *x, const EOMC_REAL *y, EOMC_REAL *to)
{
    eomc_two both[4];

    eomc_interleave(both, x, y);
    for (int i = 0; i < 8; i++)
        to[i] = both[i/2][i % 2];
}
"""


def over(precision: Any, text: str, name: str = "", width: int = 0) -> str:
    """Return a text of csrc/lanes for vectors of `width` bytes, or for scalars."""
    real, double = ("float", False) if precision.suffix else ("double", True)
    for old, new in (
        ("EOMC_BITS_OF_SIZE", "0x7fffffffffffffff" if double else "0x7fffffff"),
        ("EOMC_INTEGER", "long long" if double else "int"),
        ("EOMC_LANE_ALIGNED", str(min(width, 16))),
        ("EOMC_LANE_BYTES", str(width)),
        ("EOMC_LANE_COUNT", f"EOMC_COUNT{name}"),
        ("fabs_REAL", f"fabs{precision.suffix}"),
        ("EOMC_REAL", real),
        ("eomc_LANE", f"eomc{name}" if name else real),
        ("_LANE", name),
    ):
        text = text.replace(old, new)
    assert not re.search("LANE|REAL|EOMC_(INTEGER|BITS)", text)
    return text


def source(precision: Any) -> str:
    """Return all of them, and functions that call them for arrays."""
    size = np.dtype(precision.dtype).itemsize

    def file(name: str) -> str:
        return (ROOT / "csrc" / "lanes" / f"{name}.h").read_text(encoding="utf-8")

    sincos, rotate = file(f"sincos{precision.suffix}"), file(f"rotate{precision.suffix}")
    texts = [over(precision, file("scalar") + rotate + ONE + ROTATING)]
    several = file("vector") + sincos + rotate + ROTATING + SEVERAL + file("select")
    several += file(f"exp{precision.suffix}") + file(f"tanh{precision.suffix}")
    several += "".join(EACH.replace("NAME", name) for name in EXPONENTIALS)
    texts += [over(precision, several, name, width) for name, width in VECTORS.items()]
    texts += [
        over(precision, file("vector"), f"_{n}", k * size) for n, k in (("two", 2), ("four", 4))
    ]
    return "\n".join(
        [bench.HARNESS, *texts, over(precision, file("four") + file("interleave") + FOUR)]
    )


@cache
def built(folder: Path, precision: Any, name: str) -> ctypes.CDLL | None:
    """Return the library; None if the compiler does not support the flags."""
    flags = ["-std=gnu99", "-Wno-psabi", *BUILDS[name], *precision.flags]
    try:
        return bench.build(
            source(precision), name.replace(" ", "_") + precision.suffix, folder, flags
        )
    except subprocess.CalledProcessError:
        if "-mno-fma" not in flags:
            raise
        return None


def call(library: ctypes.CDLL, function: str, *arrays: np.ndarray) -> None:
    """Call a function for all numbers of the arrays, whose length is that of the first."""
    assert not len(arrays[0]) % MOST
    getattr(library, function)(ctypes.c_long(len(arrays[0])), *map(bench.pointer, arrays))


def of_lane(library: ctypes.CDLL, function: str, x: np.ndarray) -> np.ndarray:
    """Return the values of a function of one number, for an array."""
    call(library, function, x, y := np.empty_like(x))
    return y
