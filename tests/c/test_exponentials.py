"""csrc/lanes/exp.h and tanh.h: vectors of 16, 32 and 64 bytes, of double and of float."""

from __future__ import annotations

import ctypes
import re
import shutil
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from support.lanes import BUILDS, EXPONENTIALS, MOST, VECTORS, bench, built, of_lane
from support.session import ROOT, tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.skipif(shutil.which(bench.compiler()) is None, reason="no C compiler")


@pytest.fixture(scope="module", params=tiers(["double", "float"], "double"))
def precision(request: pytest.FixtureRequest) -> Any:
    """Precision, as the benchmark describes it."""
    return {"double": bench.DOUBLE, "float": bench.SINGLE}[request.param]


@pytest.fixture(scope="module", params=tiers(BUILDS, "native"))
def library(
    request: pytest.FixtureRequest, precision: Any, tmp_path_factory: pytest.TempPathFactory
) -> ctypes.CDLL:
    candidate = built(tmp_path_factory.mktemp("lanes"), precision, request.param)
    if candidate is None:
        pytest.skip(f"{bench.compiler()} does not build: {request.param}")
    return candidate


def arguments(precision: Any, count: int) -> np.ndarray:
    """Return arguments of exp and tanh of all sizes, most of them where errors are largest."""
    random, end = np.random.default_rng(7), 745 if precision is bench.DOUBLE else 103
    ends = [(-1, 1), (-20, 20), (0.7, 0.84), (0.84, 1.1), (-end, end), (-end, 17 - end)]
    parts = [random.uniform(*both, count) for both in ends]
    sizes = np.exp2(random.uniform(precision.smallest, 5, count)) * random.choice([-1, 1], count)
    return np.concatenate([*parts, sizes]).astype(precision.dtype)


def ulps(precision: Any, computed: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest error in units in the last place."""
    exponents = np.maximum(np.frexp(exact)[1] - precision.bits, precision.smallest)
    errors = np.ldexp(np.abs(computed - exact), -exponents)
    return float(
        np.max(np.where(np.isinf(computed) & np.isinf(exact.astype(precision.dtype)), 0, errors))
    )


@pytest.mark.parametrize("count", tiers((16_000, 1_600_000), 16_000))
@pytest.mark.parametrize("name", EXPONENTIALS)
def test_error_of_exponentials_is_as_documented(
    library: ctypes.CDLL, precision: Any, name: str, count: int
) -> None:
    """Require the documented error and equal bits at every vector width and position."""
    x = arguments(precision, count)
    with np.errstate(over="ignore", invalid="ignore"):
        exact = getattr(np, name)(x.astype(np.float64 if precision.suffix else np.longdouble))
        results = [of_lane(library, f"{name}{lane}", x) for lane in VECTORS]
        error = ulps(precision, results[0], exact)
    assert 0.8 < error <= {"exp": 0.9, "tanh": 1.1}[name]
    assert len({y.tobytes() for y in results}) == 1
    for shift in range(1, MOST):
        moved = of_lane(library, f"{name}_64", np.roll(x[: 64 * MOST], shift))
        assert np.roll(moved, -shift).tobytes() == results[0][: 64 * MOST].tobytes()


@pytest.mark.parametrize("lane", VECTORS)
def test_exponentials_of_special_values(library: ctypes.CDLL, precision: Any, lane: str) -> None:
    info = np.finfo(precision.dtype)
    smallest, largest = info.smallest_subnormal, info.max
    tiny = np.array([0.0, smallest, 1000 * smallest, info.tiny, bench.TINY], precision.dtype)
    huge = np.array([20.0, 1000.0, largest, np.inf], precision.dtype)
    room = np.full(MOST - 9, np.nan, precision.dtype)
    x = np.concatenate([tiny, huge, room])
    for sign in (1, -1):
        y = of_lane(library, f"tanh{lane}", sign * x)
        assert y[:5].tobytes() == (sign * tiny).tobytes()  # includes the sign of -0.0
        assert (y[5:9] == sign).all() and np.isnan(y[9:]).all()
        y = of_lane(library, f"exp{lane}", sign * x)
        assert (y[:4] == 1).all() and np.isnan(y[9:]).all()
        assert (y[6:9] == (np.inf if sign > 0 else 0)).all()

    def last(limit: float) -> list[float]:
        """Return the largest argument below a limit, and the next one."""
        near = precision.dtype(float(limit))
        below = near if near < limit else np.nextafter(near, precision.dtype(-np.inf))
        return [below, np.nextafter(below, precision.dtype(np.inf))]

    with mpmath.workdps(40):
        over = last(mpmath.log(2) * info.maxexp)
        under = last(mpmath.log(2) * (precision.smallest - 1))
    x = np.array([*over, *under, *[0] * (MOST - 4)], precision.dtype)
    y = of_lane(library, f"exp{lane}", x)
    assert np.isfinite(y[0]) and np.isinf(y[1]) and y[2] == 0 and y[3] == smallest


def test_constants_of_exponentials_are_as_documented(precision: Any) -> None:
    """Check ln 2 in two parts, the Chebyshev series and the convergents against their comments."""

    def constants(name: str) -> list[float]:
        text = (ROOT / "csrc" / "lanes" / f"{name}{precision.suffix}.h").read_text(encoding="utf-8")
        text = re.sub(r"/\*.*?\*/", "", text, flags=re.S)
        numbers = re.findall(r"(?<![\w.])(\d+\.\d+(?:e-\d+)?)f?\b", text)
        return [float(precision.dtype(x)) for x in numbers]

    values = constants("exp")
    terms, bits = (6, 15) if precision.suffix else (11, 41)
    with mpmath.workdps(40):
        ln2, radius = mpmath.log(2), mpmath.mpf("0.3466")
        high = mpmath.floor(mpmath.ldexp(ln2, bits)) / 2**bits
        assert high in values and float(precision.dtype(float(ln2 - high))) in values
        assert float(precision.dtype(float(1 / ln2))) in values

        def remainder(r: mpmath.mpf) -> mpmath.mpf:
            """Return (e^r - 1 - r)/r^2."""
            return sum(r**k / mpmath.factorial(k + 2) for k in range(30))

        series = [
            float(precision.dtype(float(c)))
            for c in mpmath.chebyfit(remainder, [-radius, radius], terms)
        ]
        assert set(series) <= set(values)
        for k in range(-50, 51):
            r = radius * k / 50
            e = 1 + r + r * r * mpmath.polyval(series, r)
            assert abs(e / mpmath.exp(r) - 1) < mpmath.mpf(2) ** -(30 if precision.suffix else 61)

        numbers = constants("tanh")
        z, depth = sympy.Symbol("z"), 6 if precision.suffix else 9
        fraction = sympy.Integer(2 * depth - 1)
        for k in range(2 * depth - 3, 0, -2):
            fraction = k + z / fraction
        top, bottom = (sympy.Poly(p, z) for p in sympy.fraction(sympy.together(1 / fraction)))
        difference = bottom - top
        needed = [*bottom.all_coeffs(), *difference.all_coeffs()[:-1]]
        assert difference.all_coeffs()[-1] == 0
        assert {float(x) for x in needed if x != 1} <= set(numbers)
        for k in range(1, 51):
            x = mpmath.mpf("0.84") * k / 50
            t = x * _evaluate(top, x * x) / _evaluate(bottom, x * x)
            assert abs(t / mpmath.tanh(x) - 1) < mpmath.mpf(2) ** -(33 if precision.suffix else 57)


def _evaluate(polynomial: sympy.Poly, z: mpmath.mpf) -> mpmath.mpf:
    return mpmath.polyval([int(c) for c in polynomial.all_coeffs()], z)


SCENE = """
eomc = 1
name = "exponentials"
[coordinates]
x = { start = 0.3 }
y = { start = -0.2 }
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "POTENTIAL"
[forces]
x = "FORCE"
[run]
h = 0.01
real = "REAL"
batch = true
"""


def system(potential: str, force: str, real: str = "double") -> Any:
    text = SCENE.replace("POTENTIAL", potential).replace("FORCE", force).replace("REAL", real)
    return from_scene(parse(text, "exponentials.toml"))


def test_exponentials_are_included_only_if_a_scene_needs_them() -> None:
    for potential, force, exp, tanh in (
        ("(x - y)**2", "-x_dot", False, False),
        ("exp(x - y) + exp(y - x)", "-x_dot", True, False),
        ("(x - y)**2", "-tanh(x_dot/0.1)", True, True),
    ):
        files = eomc.sources(system(potential, force)).embeddable
        fast, plain = files["fast/exponentials.c"], files["exponentials.c"]
        assert ("exponentials_exp_wide(" in fast, "_tanh_wide(" in fast) == (exp, tanh)
        assert "_wide(" not in plain


@pytest.mark.slow
@pytest.mark.parametrize("real", tiers(["double", "float"], "double"))
def test_batch_equals_separate_runs(real: str, tmp_path: Path) -> None:
    module = eomc.load(system("exp(x - y) + exp(y - x)", "-tanh(x_dot/0.1)", real), tmp_path)
    q = np.random.default_rng(3).uniform(-2, 2, (37, 2))
    many = module.simulate_batch(q, -q, steps=100, every=100).q[:, -1]
    alone = [module.simulate(x, -x, steps=100, every=100).q[-1] for x in q]
    assert np.abs(many - alone).max() <= 50 * np.finfo(many.dtype).eps
    same = module.simulate_batch(q[[0] * 37], -q[[0] * 37], steps=100, every=100).q[:, -1]
    assert (same == many[0]).all()
