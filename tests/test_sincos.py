"""csrc/sincos.h: its error, its special values, and the same bits from scalar and vector code."""

from __future__ import annotations

import ctypes
import importlib.util
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
HEADER = ROOT / "csrc" / "sincos.h"
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
pytestmark = pytest.mark.skipif(shutil.which(bench.compiler()) is None, reason="no C compiler")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ctypes.CDLL]:
    return bench.builds(tmp_path_factory.mktemp("sincos"))


@pytest.fixture(params=["vector", "vector, no FMA"])
def library(request: pytest.FixtureRequest, made: dict[str, ctypes.CDLL]) -> ctypes.CDLL:
    if request.param not in made:
        pytest.skip(f"{bench.compiler()} does not build: {request.param}")
    return made[request.param]


def ulps(got: float, exact: mpmath.mpf) -> float:
    """|got - exact| in units of the last place of a double of exact's size."""
    exponent = max(int(mpmath.frexp(exact)[1]) - 53, -1074)
    return float(abs(mpmath.mpf(got) - exact) / mpmath.ldexp(1, exponent))


def assert_accurate(library: ctypes.CDLL, x: np.ndarray) -> None:
    s, c = bench.sincos(library, "small", x)
    with mpmath.workprec(200):
        for argument, sine, cosine in zip(x.tolist(), s.tolist(), c.tolist(), strict=True):
            exact_cosine, exact_sine = mpmath.cos_sin(mpmath.mpf(argument))
            assert ulps(sine, exact_sine) <= LARGEST_ERROR, f"sin {argument!r}"
            assert ulps(cosine, exact_cosine) <= LARGEST_ERROR, f"cos {argument!r}"


def nearest_multiples(count: int) -> list[int]:
    """The n for which a double lies closest to n pi/2, measured in pi/2, from all up to 2^20.

    A double 2^e m is close to n pi/2 when m/n is close to 2^-e pi/2: a convergent of its
    continued fraction.  Multiples k (m, n) of a convergent are the runners-up.
    """
    candidates: dict[int, mpmath.mpf] = {}
    with mpmath.workprec(400):
        for exponent in range(-53, -31):
            ratio = mpmath.ldexp(mpmath.pi / 2, -exponent)
            whole = int(mpmath.floor(ratio))
            rest = ratio - whole
            before, n = 0, 1
            while n <= bench.LAST_MULTIPLE:
                multiple = n * mpmath.pi / 2
                if 2**52 <= mpmath.ldexp(multiple, -exponent) < 2**53:
                    m = mpmath.nint(n * ratio)
                    candidates[n] = abs(mpmath.ldexp(m, exponent) - multiple)
                rest = 1 / rest
                digit = int(mpmath.floor(rest))
                rest -= digit
                before, n = n, digit * n + before
    return sorted(candidates, key=lambda n: candidates[n])[:count]


def test_header_has_the_derived_constants() -> None:
    numbers = {float(x) for x in re.findall(r"-?\d+\.\d+(?:e-?\d+)?", HEADER.read_text())}
    for parts in bench.parts_of_half_pi().values():
        assert all(part in numbers or -part in numbers for part in parts)
    derived = bench.derive()
    text = HEADER.read_text()
    for letter, name, bits in (("p", "sin", "57.9"), ("q", "cos", "63.9")):
        polynomial = derived[name]
        assert f"{-polynomial.log2_error:.1f}" == bits
        assert f"2^-{bits} in the" in re.sub(r"\s+\*?\s*", " ", text)
        written: list[float] = []
        for k in range(0, bench.TERMS, 2):
            line = re.search(rf"{letter}{k}{k + 1} = eomc_mul_add\(z, (\S+), (\S+)\);", text)
            assert line is not None
            written += [float(line[2]), float(line[1])]
        assert tuple(written) == polynomial.coefficients


def test_error_at_random_points(library: ctypes.CDLL) -> None:
    points = bench.random_points(1500, np.random.default_rng(2))
    assert_accurate(library, np.concatenate(list(points.values())))


def test_error_next_to_multiples_of_half_pi(library: ctypes.CDLL) -> None:
    hardest = nearest_multiples(40)
    assert 29 in hardest  # 2^-60.3 away: the closest of all up to 2^20
    some = np.random.default_rng(3).integers(1, bench.LAST_MULTIPLE, 500).tolist()
    last = [bench.LAST_MULTIPLE - 1, bench.LAST_MULTIPLE]
    x = bench.neighbours_of_multiples([*hardest, *range(1, 100), *some, *last])
    assert_accurate(library, np.concatenate([x, -x]))


def test_error_between_quadrants(library: ctypes.CDLL) -> None:
    odd = np.arange(1, 2000, 2) * (math.pi / 4)
    x = np.concatenate([odd, np.nextafter(odd, 0.0), np.nextafter(odd, np.inf)])
    assert_accurate(library, np.concatenate([x, -x, [bench.LIMIT, -bench.LIMIT]]))


@pytest.mark.parametrize("function", ["small", "any"])
def test_tiny_arguments_and_signed_zero(library: ctypes.CDLL, function: str) -> None:
    tiny = np.array([0.0, 5e-324, 1e-320, 2.2250738585072014e-308, 1e-300, 1e-160, 1e-20])
    x = np.concatenate([tiny, -tiny])
    s, c = bench.sincos(library, function, x)
    assert s.tobytes() == x.tobytes()  # the sign of -0.0 as well
    assert (c == 1.0).all()


def test_libm_takes_over(library: ctypes.CDLL) -> None:
    beyond = math.nextafter(bench.LIMIT, math.inf)
    x = np.array([beyond, -beyond, 1e7, -1e22, 1.7976931348623157e308])
    x = np.concatenate([x, np.linspace(beyond, 2 * beyond, 1000)])
    s, c = bench.sincos(library, "any", x)
    assert s.tolist() == [math.sin(v) for v in x]
    assert c.tolist() == [math.cos(v) for v in x]
    s, c = bench.sincos(library, "any", np.array([math.inf, -math.inf, math.nan]))
    assert np.isnan(s).all() and np.isnan(c).all()
    inside = np.array([bench.LIMIT, -bench.LIMIT, 1.0])
    assert_same_bits(bench.sincos(library, "any", inside), bench.sincos(library, "small", inside))


def assert_same_bits(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> None:
    for a, b in zip(one, other, strict=True):
        assert np.array_equal(a.view(np.uint64), b.view(np.uint64))


@pytest.mark.parametrize("fma", ["", ", no FMA"])
def test_vector_and_scalar_code_agree_bit_for_bit(
    made: dict[str, ctypes.CDLL], tmp_path: Path, fma: str
) -> None:
    if f"vector{fma}" not in made:
        pytest.skip("the compiler does not take -mno-fma")
    x = np.concatenate(list(bench.random_points(15_000, np.random.default_rng(4)).values()))
    expected = bench.sincos(made[f"vector{fma}"], "small", x)
    assert_same_bits(expected, bench.sincos(made[f"scalar{fma}"], "small", x))
    target = ["-march=native"] + (["-mno-fma"] if fma else [])
    for optimisation in ("-O0", "-O2"):
        for contraction in ("-ffp-contract=off", "-ffp-contract=fast"):
            flags = [*target, optimisation, contraction]
            plain = bench.build(bench.HARNESS, f"plain{optimisation}{contraction}", tmp_path, flags)
            assert_same_bits(expected, bench.sincos(plain, "small", x))


def test_gcc_vectorises(tmp_path: Path) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    source = tmp_path / "loop.c"
    source.write_text(bench.HARNESS)
    command = ["gcc", *bench.SPEED, "-fopt-info-vec-optimized", f"-I{HEADER.parent}", "-c"]
    done = subprocess.run(
        [*command, str(source), "-o", str(tmp_path / "loop.o")],
        check=True,
        capture_output=True,
        text=True,
    )
    if "clang" not in subprocess.run(["gcc", "-v"], capture_output=True, text=True).stderr:
        assert "loop vectorized" in done.stderr


STRICT = (
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion"),
    *("-Wdouble-promotion", "-Wshadow", "-Werror"),
)


@pytest.mark.parametrize(
    "command", ["gcc -std=c99", "clang -std=c99", "g++ -std=c++11 -x c++", "clang++ -x c++"]
)
@pytest.mark.parametrize("target", [[], ["-march=native"]], ids=["baseline", "native"])
def test_compiles_without_a_warning(command: str, target: list[str], tmp_path: Path) -> None:
    name, *flags = command.split()
    if shutil.which(name) is None:
        pytest.skip(f"no {name}")
    source = tmp_path / "use.c"
    source.write_text(
        f'#include "{HEADER}"\n'
        "void use(double x, double *s, double *c);\n"
        "void use(double x, double *s, double *c) { eomc_sincos(x, s, c); }\n"
    )
    out = ["-o", str(tmp_path / "use.o")]
    done = subprocess.run(
        [name, *flags, *STRICT, *target, "-O2", "-c", str(source), *out],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_prefix_can_be_replaced(tmp_path: Path) -> None:
    text = HEADER.read_text().replace("eomc_", "cartpole_").replace("EOMC_", "CARTPOLE_")
    use = "double f(double x) { double s, c; cartpole_sincos(x, &s, &c); return s + c; }\n"
    library = bench.build(text + use, "cartpole", tmp_path, ["-std=c99", *STRICT[:3]])
    library.f.restype = ctypes.c_double
    assert library.f(ctypes.c_double(0.0)) == 1.0


def test_fast_math_is_refused(tmp_path: Path) -> None:
    with pytest.raises(subprocess.CalledProcessError) as failure:
        bench.build(bench.HARNESS, "fast", tmp_path, ["-ffast-math"])
    assert "breaks the argument reduction" in failure.value.stderr
