"""benchmarks/sincos.py as tests use it."""

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
    """benchmarks/sincos.py, where the derivation and the harness are."""
    path = ROOT / "benchmarks" / "sincos.py"
    spec = importlib.util.spec_from_file_location("benchmark_sincos", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


bench = _benchmark()


def nearest_multiples(count: int, of: Any) -> list[int]:
    """The n for which a number lies closest to n pi/2, measured in pi/2, from all up to the limit.

    A number 2^e m is close to n pi/2 when m/n is close to 2^-e pi/2: a convergent of its
    continued fraction.  Multiples k (m, n) of a convergent are the runners-up.
    """
    candidates: dict[int, mpmath.mpf] = {}
    with mpmath.workprec(400):
        for exponent in range(-of.bits, math.frexp(of.limit)[1] - of.bits + 1):
            ratio = mpmath.ldexp(mpmath.pi / 2, -exponent)
            whole = int(mpmath.floor(ratio))
            rest = ratio - whole
            before, n = 0, 1
            while n <= of.last_multiple:
                multiple = n * mpmath.pi / 2
                if 1 <= mpmath.ldexp(multiple, 1 - of.bits - exponent) < 2:
                    m = mpmath.nint(n * ratio)
                    candidates[n] = abs(mpmath.ldexp(m, exponent) - multiple)
                rest = 1 / rest
                digit = int(mpmath.floor(rest))
                rest -= digit
                before, n = n, digit * n + before
    return sorted(candidates, key=lambda n: candidates[n])[:count]
