"""csrc/sincos/sincos.h, sincosf.h: error, special values, equal bits of scalar and vector code."""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
from support.lanes import LARGEST_ERROR, bench, nearest_multiples
from support.session import needs, tiers

pytestmark = pytest.mark.skipif(shutil.which(bench.compiler()) is None, reason="no C compiler")


@pytest.fixture(scope="module", params=["double", "float"])
def precision(request: pytest.FixtureRequest) -> Any:
    """Precision, as the benchmark describes it."""
    return {"double": bench.DOUBLE, "float": bench.SINGLE}[request.param]


@cache
def built(folder: Path, precision: Any) -> dict[str, ctypes.CDLL]:
    return bench.builds(folder, precision)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sincos")


@pytest.fixture(scope="module")
def libraries(precision: Any, folder: Path) -> dict[str, ctypes.CDLL]:
    return built(folder, precision)


@pytest.fixture(params=["vector", "vector, no FMA"])
def library(request: pytest.FixtureRequest, libraries: dict[str, ctypes.CDLL]) -> ctypes.CDLL:
    if request.param not in libraries:
        pytest.skip(f"{bench.compiler()} does not build: {request.param}")
    return libraries[request.param]


def ulps(got: float, exact: mpmath.mpf, precision: Any) -> float:
    """Return |got - exact| in units in the last place of a number of exact's size."""
    exponent = max(int(mpmath.frexp(exact)[1]) - precision.bits, precision.smallest)
    return float(abs(mpmath.mpf(got) - exact) / mpmath.ldexp(1, exponent))


def assert_accurate(library: ctypes.CDLL, x: np.ndarray, precision: Any) -> None:
    assert x.dtype == precision.dtype
    s, c = bench.sincos(library, "small", x)
    with mpmath.workprec(200):
        for argument, sine, cosine in zip(x.tolist(), s.tolist(), c.tolist(), strict=True):
            exact_cosine, exact_sine = mpmath.cos_sin(mpmath.mpf(argument))
            assert ulps(sine, exact_sine, precision) <= LARGEST_ERROR, f"sin {argument!r}"
            assert ulps(cosine, exact_cosine, precision) <= LARGEST_ERROR, f"cos {argument!r}"


@pytest.mark.parametrize(
    ("attribute", "sine", "cosine"),
    tiers([("DOUBLE", "57.9", "63.9"), ("SINGLE", "27.9", "33.0")], "SINGLE"),
)
def test_header_contains_the_derived_constants(attribute: str, sine: str, cosine: str) -> None:
    precision = getattr(bench, attribute)
    text = precision.header.read_text()
    code = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    numbers = {float(x) for x in re.findall(r"(?<![\w.])\d+\.\d+(?:e-?\d+)?", code)}
    comment = re.sub(r"\s+\*?\s*", " ", text)
    derived = bench.derive(precision)
    expected = [float(2 / mpmath.pi), 1.5 * 2.0 ** (precision.bits - 1), precision.limit]
    expected += [part for parts in bench.parts_of_half_pi(precision).values() for part in parts]
    expected += [abs(c) for polynomial in derived.values() for c in polynomial.coefficients]
    assert {float(str(precision.dtype(x))) for x in expected} <= numbers
    for name, letter, bits in (("sin", "p", sine), ("cos", "q", cosine)):
        assert f"{-derived[name].log2_error:.1f}" == bits
        assert f"2^-{bits} in the" in comment
        assert [float(str(precision.dtype(c))) for c in derived[name].coefficients] == (
            in_pairs(code, letter) if precision is bench.DOUBLE else nested(code, letter)
        )
    assert f"|r| <= {precision.radius}" in comment
    # Rounding of 2/pi, and of its product with x, moves r beyond pi/4 by at most this.
    slack = abs(float(precision.dtype(2 / math.pi)) - 2 / math.pi) * precision.limit * math.pi / 2
    slack += float(np.spacing(precision.dtype(precision.last_multiple))) / 2 * math.pi / 2
    assert math.pi / 4 + slack < float(precision.radius)


def in_pairs(code: str, letter: str) -> list[float]:
    """Return the coefficients of a sum in pairs, from the lowest power up."""
    pairs = re.findall(rf"{letter}(\d)\d = eomc_mul_add\(z, (\S+), (\S+)\);", code)
    return [float(c) for _, second, first in sorted(pairs) for c in (first, second)]


def nested(code: str, letter: str) -> list[float]:
    """Return the coefficients of Horner's scheme, from the lowest power up."""
    inner = re.search(rf"{letter}12 = eomc_mul_addf\(z, (\S+)f, (\S+)f\);", code)
    outer = re.search(rf"{letter} = eomc_mul_addf\(z, {letter}12, (\S+)f\);", code)
    assert inner is not None and outer is not None
    return [float(outer[1]), float(inner[2]), float(inner[1])]


@pytest.mark.parametrize("count", tiers([500, 1500], 500))
def test_error_at_random_points(library: ctypes.CDLL, precision: Any, count: int) -> None:
    points = bench.random_points(count, np.random.default_rng(2), precision)
    assert_accurate(library, np.concatenate(list(points.values())), precision)


def test_error_of_float_sines_at_a_sample_of_all_floats(folder: Path) -> None:
    """Check one float in 307; `benchmarks/sincos.py --float` checks every one."""
    bits = [int(np.float32(x).view(np.uint32)) for x in (bench.TINY, bench.SINGLE.limit)]
    x = np.arange(bits[0], bits[1] + 1, 307, dtype=np.uint32).view(np.float32)
    judge = bench.reference(folder, bench.SINGLE)
    for name, library in built(folder, bench.SINGLE).items():
        s, c = bench.sincos(library, "small", x)
        worst = np.zeros(2)
        arrays = (bench.pointer(y) for y in (s, c, worst))
        judge.errors(ctypes.c_long(x.size), bench.pointer(x), ctypes.c_long(1), *arrays)
        assert (worst > 1.3).all() and (worst <= LARGEST_ERROR).all(), (name, worst)


def test_error_next_to_multiples_of_half_pi(library: ctypes.CDLL, precision: Any) -> None:
    hardest = nearest_multiples(40, precision)
    # 2^-60.3 and 2^-28.5 quadrants away: the closest of all doubles and floats
    assert hardest[0] == (29 if precision is bench.DOUBLE else 161)
    some = np.random.default_rng(3).integers(1, precision.last_multiple, 500).tolist()
    last = [precision.last_multiple - 1, precision.last_multiple]
    x = bench.neighbours_of_multiples([*hardest, *range(1, 100), *some, *last], precision)
    assert_accurate(library, np.concatenate([x, -x]), precision)


@pytest.mark.parametrize("last", tiers([500, 2000], 500))
def test_error_between_quadrants(library: ctypes.CDLL, precision: Any, last: int) -> None:
    odd = (np.arange(1, last, 2) * (math.pi / 4)).astype(precision.dtype)
    ends = np.array([precision.limit, -precision.limit], precision.dtype)
    below, above = (np.nextafter(odd, precision.dtype(x)) for x in (0.0, np.inf))
    x = np.concatenate([odd, below, above])
    assert_accurate(library, np.concatenate([x, -x, ends]), precision)


@pytest.mark.parametrize("function", ["small", "any"])
def test_tiny_arguments_and_signed_zero(
    library: ctypes.CDLL, precision: Any, function: str
) -> None:
    small = np.finfo(precision.dtype)
    # Half the exponent of the smallest number: the square is 0 or has few digits.
    tiny = [0.0, small.smallest_subnormal, 1000 * small.smallest_subnormal, small.tiny, 1e-20]
    tiny = np.array([*tiny, 2.0 ** (precision.smallest // 2)], precision.dtype)
    x = np.concatenate([tiny, -tiny])
    s, c = bench.sincos(library, function, x)
    assert s.tobytes() == x.tobytes()  # includes the sign of -0.0
    assert (c == 1.0).all()


def test_libm_is_used_beyond_the_limit(library: ctypes.CDLL, precision: Any) -> None:
    beyond = float(np.nextafter(precision.dtype(precision.limit), precision.dtype(np.inf)))
    largest = float(np.finfo(precision.dtype).max)
    x = np.array([beyond, -beyond, 1e7, -1e22, largest], precision.dtype)
    x = np.concatenate([x, np.linspace(beyond, 2 * beyond, 1000, dtype=precision.dtype)])
    s, c = bench.sincos(library, "any", x)
    if precision is bench.DOUBLE:
        assert s.tolist() == [math.sin(v) for v in x]
        assert c.tolist() == [math.cos(v) for v in x]
    else:  # Python has no sinf; those of C libraries are accurate to 1 ulp
        for got, exact in ((s, np.sin), (c, np.cos)):
            error = np.abs(got - exact(x.astype(np.float64)))
            assert (error <= np.spacing(np.abs(got))).all()
    s, c = bench.sincos(library, "any", np.array([math.inf, -math.inf, math.nan], precision.dtype))
    assert np.isnan(s).all() and np.isnan(c).all()
    inside = np.array([precision.limit, -precision.limit, 1.0], precision.dtype)
    assert_same_bits(bench.sincos(library, "any", inside), bench.sincos(library, "small", inside))


def assert_same_bits(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> None:
    for a, b in zip(one, other, strict=True):
        assert a.dtype == b.dtype and a.tobytes() == b.tobytes()


@pytest.mark.parametrize("precision", tiers(["double", "float"], "double"), indirect=True)
@pytest.mark.parametrize("fma", tiers(["", ", no FMA"], ""))
def test_vector_and_scalar_code_agree_bit_for_bit(
    libraries: dict[str, ctypes.CDLL], precision: Any, tmp_path: Path, fma: str
) -> None:
    if f"vector{fma}" not in libraries:
        pytest.skip("the compiler does not take -mno-fma")
    x = np.concatenate(
        list(bench.random_points(15_000, np.random.default_rng(4), precision).values())
    )
    expected = bench.sincos(libraries[f"vector{fma}"], "small", x)
    assert_same_bits(expected, bench.sincos(libraries[f"scalar{fma}"], "small", x))
    target = ["-march=native", *(bench.WITHOUT_FMA if fma else ())]
    for optimisation in ("-O0", "-O2"):
        for contraction in ("-ffp-contract=off", "-ffp-contract=fast"):
            flags = [*target, optimisation, contraction, *precision.flags]
            plain = bench.build(bench.HARNESS, f"plain{optimisation}{contraction}", tmp_path, flags)
            assert_same_bits(expected, bench.sincos(plain, "small", x))


@pytest.mark.parametrize("precision", tiers(["double", "float"], "double"), indirect=True)
@pytest.mark.parametrize("compiler", tiers(["gcc", "clang"], "clang"))
@pytest.mark.parametrize("fma", tiers(["", ", no FMA"], ""))
def test_compilers_agree_bit_for_bit(
    libraries: dict[str, ctypes.CDLL],
    precision: Any,
    tmp_path: Path,
    fma: str,
    compiler: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if f"vector{fma}" not in libraries:
        pytest.skip("the compiler does not take -mno-fma")
    monkeypatch.setenv("CC", needs(compiler))
    target = ["-march=native", *(bench.WITHOUT_FMA if fma else ())]
    x = np.concatenate(
        list(bench.random_points(15_000, np.random.default_rng(5), precision).values())
    )
    expected = bench.sincos(libraries[f"vector{fma}"], "small", x)
    for optimisation in ("-O0", "-O3"):
        flags = [*target, optimisation, *precision.flags]
        other = bench.build(bench.HARNESS, compiler + optimisation, tmp_path, flags)
        assert_same_bits(expected, bench.sincos(other, "small", x))


def test_without_fma_flags_disable_fma(libraries: dict[str, ctypes.CDLL]) -> None:
    """The flags also disable FMA of AVX-512, with which a compiler would select the other
    reduction.
    """
    if "vector, no FMA" not in libraries:
        pytest.skip("the compiler does not take -mno-fma")
    assert not libraries["vector, no FMA"].fast_fma() and not libraries["scalar, no FMA"].fast_fma()


def test_gcc_vectorises_the_loop(precision: Any, tmp_path: Path) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    source = tmp_path / "loop.c"
    source.write_text(bench.HARNESS)
    folder = precision.header.parent
    command = [
        "gcc",
        *bench.SPEED,
        *precision.flags,
        "-fopt-info-vec-optimized",
        f"-I{folder}",
        "-c",
    ]
    process = subprocess.run(
        [*command, str(source), "-o", str(tmp_path / "loop.o")],
        check=True,
        capture_output=True,
        text=True,
    )
    if "clang" not in subprocess.run(["gcc", "-v"], capture_output=True, text=True).stderr:
        assert "loop vectorized" in process.stderr


STRICT = (
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion"),
    *("-Wdouble-promotion", "-Wshadow", "-Werror"),
)


TARGETS = {"baseline": (), "native": ("-march=native",)}


@pytest.mark.parametrize(
    "command", ["gcc -std=c99", "clang -std=c99", "g++ -std=c++11 -x c++", "clang++ -x c++"]
)
@pytest.mark.parametrize("target", tiers(["baseline", "native"], "native"))
def test_headers_compile_without_warnings(
    command: str, target: str, precision: Any, tmp_path: Path
) -> None:
    name, *flags = command.split()
    if shutil.which(name) is None:
        pytest.skip(f"no {name}")
    source = tmp_path / "use.c"
    real = "float" if precision.suffix else "double"
    use = f"void use({real} x, {real} *s, {real} *c)"
    body = f"{{ eomc_sincos{precision.suffix}(x, s, c); }}"
    source.write_text(f'#include "{precision.header}"\n{use};\n{use} {body}\n')
    out = ["-o", str(tmp_path / "use.o")]
    process = subprocess.run(
        [name, *flags, *STRICT, *TARGETS[target], "-O2", "-c", str(source), *out],
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr


def test_prefix_can_be_replaced(precision: Any, tmp_path: Path) -> None:
    text = precision.header.read_text().replace("eomc_", "cartpole_").replace("EOMC_", "CARTPOLE_")
    real = "float" if precision.suffix else "double"
    call = f"{real} s, c; cartpole_sincos{precision.suffix}(({real})x, &s, &c); return s + c;"
    use = f"double f(double x) {{ {call} }}\n"
    library = bench.build(text + use, "cartpole", tmp_path, ["-std=c99", *STRICT[:3]])
    library.f.restype = ctypes.c_double
    assert library.f(ctypes.c_double(0.0)) == 1.0


def test_fast_math_is_refused(precision: Any, tmp_path: Path) -> None:
    with pytest.raises(subprocess.CalledProcessError) as failure:
        bench.build(bench.HARNESS, "fast", tmp_path, ["-ffast-math", *precision.flags])
    assert "breaks the argument reduction" in failure.value.stderr
