"""benchmarks/sincos.py, as used by tests."""

from __future__ import annotations

import importlib.util
import math
import sys
from types import ModuleType
from typing import Any

import mpmath
from conftest import ROOT

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
