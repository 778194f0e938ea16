"""csrc/sincos/: quadrants.h has the bits of sincos.h, incremental.h adds one rounding."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

CSRC = Path(__file__).resolve().parents[2] / "csrc" / "sincos"
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")

LOOPS = """
#include "sincos$.h"
#include "quadrants$.h"
#include "incremental$.h"

void plain(long n, const real *x, real *s, real *c)
{
    for (long i = 0; i < n; i++)
        eomc_sincos$_small(x[i], &s[i], &c[i]);
}

void by_bits(long n, const real *x, real *s, real *c)
{
    for (long i = 0; i < n; i++)
        eomc_sincos$_by_bits(x[i], &s[i], &c[i]);
}

void rotate(long n, const real *d, real *s, real *c)
{
    for (long i = 0; i < n; i++)
        eomc_sincos$_rotate(d[i], s[i], c[i], &s[i], &c[i]);
}

void rotate_on(long n, const real *d, real *s, real *c)
{
    real back, back_too;

    for (long i = 0; i < n; i++)
        eomc_sincos$_rotate_both(d[i], s[i], c[i], &back, &back_too, &s[i], &c[i]);
}

void rotate_back(long n, const real *d, real *s, real *c)
{
    real on, on_too;

    for (long i = 0; i < n; i++)
        eomc_sincos$_rotate_both(-d[i], s[i], c[i], &s[i], &c[i], &on, &on_too);
}
"""
FLAGS = {"vector": ["-O3", "-march=native"], "scalar": ["-O1", "-fno-tree-vectorize"]}


@pytest.fixture(scope="module", params=[np.float64, np.float32])
def real(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(scope="module", params=list(FLAGS))
def library(request: pytest.FixtureRequest, real: Any, tmp_path_factory: Any) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("sines")
    suffix, name = ("", "double") if real is np.float64 else ("f", "float")
    source, built = folder / "loops.c", folder / "loops.so"
    source.write_text(LOOPS.replace("$", suffix).replace("real ", name + " "), encoding="utf-8")
    given = ["-std=gnu99", *FLAGS[request.param], f"-I{CSRC}", "-shared", "-fPIC"]
    assert COMPILER is not None
    subprocess.run([COMPILER, *given, str(source), "-o", str(built), "-lm"], check=True)
    return ctypes.CDLL(str(built))


def call(function: Any, x: np.ndarray, s: np.ndarray, c: np.ndarray) -> None:
    function(ctypes.c_long(len(x)), *(ctypes.c_void_p(a.ctypes.data) for a in (x, s, c)))


def test_sines_for_loops_are_those_of_one_bit_for_bit(library: ctypes.CDLL, real: Any) -> None:
    random = np.random.default_rng(5)
    limit = 2.0**20 if real is np.float64 else 2.0**13
    quadrants = np.arange(-300, 300) * (np.pi / 4)
    x = np.concatenate(
        [
            [0.0, -0.0, limit, -limit, np.finfo(real).tiny, -np.finfo(real).smallest_subnormal],
            quadrants,
            random.uniform(-10, 10, 20_000),
            random.uniform(-limit, limit, 20_000),
        ]
    ).astype(real)
    x = np.concatenate([x, np.nextafter(x, real(9)), np.nextafter(x, real(-9))])
    x = x[np.abs(x) <= limit]
    found = []
    for function in (library.plain, library.by_bits):
        s, c = np.empty_like(x), np.empty_like(x)
        call(function, x, s, c)
        found.append(s.tobytes() + c.tobytes())
    assert found[0] == found[1]


@pytest.mark.parametrize(("way", "widest"), [("rotate", 6), ("rotate_on", 3), ("rotate_back", 3)])
def test_rotating_costs_one_unit_of_rounding(
    library: ctypes.CDLL, real: Any, way: str, widest: int
) -> None:
    """Against sums of angles in long double; for float, against double."""
    exact = np.longdouble if real is np.float64 else np.float64
    random = np.random.default_rng(6)
    if real is np.float32:
        widest -= 2 if way == "rotate" else 1
    x = random.uniform(-4, 4, 50_000).astype(exact)
    d = (random.choice([-1, 1], len(x)) * 2.0 ** -random.uniform(widest, 40, len(x))).astype(real)
    d[:3] = 2.0**-widest, -(2.0**-widest), 0.0
    s, c = np.sin(x).astype(real), np.cos(x).astype(real)
    s0, c0 = s.astype(exact), c.astype(exact)
    call(getattr(library, way), d, s, c)
    sin_d, cos_d = np.sin(d.astype(exact)), np.cos(d.astype(exact))
    unit = np.finfo(real).eps / 2
    wanted = s0 * cos_d + c0 * sin_d, c0 * cos_d - s0 * sin_d
    error = max(float(np.max(np.abs(a - b))) for a, b in zip((s, c), wanted, strict=True))
    # two roundings of numbers up to 1 each, and the series' 2^-56 (float: 2^-27)
    assert 0.4 * unit < error <= 1.3 * unit
