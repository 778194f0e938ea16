"""csrc/lanes/: scalars and vectors of 16, 32 and 64 bytes, of double and of float."""

from __future__ import annotations

import ctypes
import re
import shutil
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
from support.lanes import (
    BUILDS,
    EXPONENTIALS,
    LANES,
    LARGEST_ERROR,
    MOST,
    VECTORS,
    bench,
    built,
    call,
    nearest_multiples,
    of_lane,
)
from support.session import ROOT, tiers

from eomc.emit.optimised.lanes import interleaved_index

pytestmark = pytest.mark.skipif(shutil.which(bench.compiler()) is None, reason="no C compiler")


@pytest.fixture(scope="module", params=tiers(["double", "float"], "double"))
def precision(request: pytest.FixtureRequest) -> Any:
    """Precision, as the benchmark describes it."""
    return {"double": bench.DOUBLE, "float": bench.SINGLE}[request.param]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lanes")


@pytest.fixture(scope="module")
def reference(precision: Any, folder: Path) -> ctypes.CDLL:
    """Library with sines in higher precision."""
    return bench.reference(folder, precision)


@pytest.fixture(scope="module", params=tiers(BUILDS, "native"))
def library(request: pytest.FixtureRequest, precision: Any, folder: Path) -> ctypes.CDLL:
    candidate = built(folder, precision, request.param)
    if candidate is None:
        pytest.skip(f"{bench.compiler()} does not build: {request.param}")
    return candidate


@pytest.fixture
def libraries(precision: Any, folder: Path) -> list[ctypes.CDLL]:
    """All libraries of this precision."""
    return [library for name in BUILDS if (library := built(folder, precision, name)) is not None]


def evaluate_check(library: ctypes.CDLL, function: str, *arrays: np.ndarray) -> list[bool]:
    """Return the result of a check for each number; it must not depend on the position in a
    register.
    """
    count = len(arrays[0])
    results = []
    for shift in range(MOST):
        room = -(-(count + shift) // MOST) * MOST
        shifted = [
            a if len(a) < count else np.concatenate([np.ones(shift), a, np.ones(room)])[:room]
            for a in arrays
        ]
        out = np.full(room, 7, np.intc)
        call(library, function, *(a.astype(arrays[0].dtype) for a in shifted), out)
        results.append(out[shift : shift + count].tolist())
    assert all(row == results[0] for row in results)
    assert set(results[0]) <= {0, 1}
    return [bool(x) for x in results[0]]


def points(precision: Any) -> np.ndarray:
    """Return angles of all sizes up to the limit, near multiples of pi/2 and between quadrants."""
    random = np.random.default_rng(5)
    some = random.integers(1, precision.last_multiple, 2000).tolist()
    hardest = [
        *nearest_multiples(40, precision),
        *range(1, 300),
        precision.last_multiple - 1,
        precision.last_multiple,
    ]
    odd = (np.arange(1, 2000, 2) * (np.pi / 4)).astype(precision.dtype)
    x = [
        *bench.random_points(6_000, random, precision).values(),
        bench.neighbours_of_multiples([*hardest, *some], precision),
        *(odd, np.nextafter(odd, precision.dtype(0)), np.nextafter(odd, precision.dtype(np.inf))),
        np.array(
            [precision.limit, np.nextafter(precision.dtype(precision.limit), precision.dtype(0))],
            precision.dtype,
        ),
    ]
    x = np.concatenate([*x, *(-part for part in x)])
    assert x.dtype == precision.dtype and np.abs(x).max() == precision.limit
    return np.concatenate([x, np.zeros(-len(x) % MOST, precision.dtype)])


def test_sines_of_vectors_are_accurate(
    library: ctypes.CDLL, precision: Any, reference: ctypes.CDLL
) -> None:
    """The error is that of scalar code, at every width."""
    x = points(precision)
    results = [bench.sincos(library, f"small{lane}", x) for lane in VECTORS]
    s, c = (np.concatenate(part) for part in zip(*results, strict=True))
    worst = np.zeros((len(results), 2))
    arrays = (bench.pointer(a) for a in (s, c, worst))
    reference.errors(ctypes.c_long(x.size), bench.pointer(x), ctypes.c_long(len(results)), *arrays)
    assert (worst > 1.3).all() and (worst <= LARGEST_ERROR).all(), worst


def test_sines_of_vectors_equal_scalar_sines(library: ctypes.CDLL, precision: Any) -> None:
    """Equal bits; with FMA, where scalar code uses other parts of pi/2, within one unit."""
    x = points(precision)
    one = bench.sincos(library, "small", x)
    lanes = [bench.sincos(library, f"small{lane}", x) for lane in VECTORS]
    for a, b in zip(one, lanes[0], strict=True):
        assert (np.abs(a - b) <= np.spacing(np.abs(a))).all()
        if not library.fast_fma():
            assert a.tobytes() == b.tobytes()
    for lane in lanes:
        assert [a.tobytes() for a in lane] == [a.tobytes() for a in lanes[0]]


@pytest.mark.parametrize("lane", VECTORS)
def test_tiny_angles_and_signed_zero(library: ctypes.CDLL, precision: Any, lane: str) -> None:
    info = np.finfo(precision.dtype)
    tiny = [0.0, info.smallest_subnormal, 1000 * info.smallest_subnormal, info.tiny, 1e-20]
    tiny = np.array([*tiny, 2.0 ** (precision.smallest // 2), bench.TINY, 0.0], precision.dtype)
    x = np.concatenate([tiny, -tiny])
    s, c = bench.sincos(library, f"small{lane}", x)
    assert s.tobytes() == x.tobytes()  # includes the sign of -0.0
    assert (c == 1.0).all()


@pytest.mark.parametrize("lane", VECTORS)
def test_angles_beyond_the_limit_do_not_affect_other_lanes(
    library: ctypes.CDLL, precision: Any, lane: str
) -> None:
    """NaN gives NaN; other elements are unchanged, and an earlier failure stays recorded."""
    beyond = np.nextafter(precision.dtype(precision.limit), precision.dtype(np.inf))
    largest = np.finfo(precision.dtype).max
    far = np.array(
        [beyond, -beyond, 3e9, -largest, np.inf, -np.inf, np.nan, -np.nan], precision.dtype
    )
    good = np.linspace(-precision.limit, precision.limit, len(far) * 63).astype(precision.dtype)
    x = np.concatenate([far[:, None], good.reshape(-1, 63)], axis=1)
    x = np.stack([np.roll(row, 5 * k) for k, row in enumerate(x)]).ravel()
    s, c, failed = np.empty_like(x), np.empty_like(x), np.zeros(x.shape, np.intc)
    call(library, f"sincos{lane}", x, s, c, failed)
    inside = np.abs(x) <= precision.limit
    assert inside.sum() == len(good) and set(good) == set(x[inside])
    assert not failed[inside].any()
    assert (failed.astype(bool) | np.isnan(s) & np.isnan(c))[~inside].all()
    assert failed[np.abs(x) > precision.limit].all()  # includes infinite angles
    expected = bench.sincos(library, f"small{lane}", np.where(inside, x, precision.dtype(0)))
    for computed, reference_part in zip((s, c), expected, strict=True):
        assert computed[inside].tobytes() == reference_part[inside].tobytes()
    before = (np.arange(x.size) % 3 == 0).astype(np.intc)
    call(library, f"sincos{lane}", x, s, c, both := before.copy())
    assert both.tolist() == (before | failed).tolist()


def errors(computed: tuple[np.ndarray, ...], *expected: np.ndarray) -> float:
    return max(float(np.max(np.abs(a - b))) for a, b in zip(computed, expected, strict=True))


def turns(precision: Any, widest: int) -> tuple[np.ndarray, ...]:
    """Return d up to 2^-widest, s, c in this precision; sin d, cos d, s, c in the highest
    precision.
    """
    exact = np.float64 if precision.suffix else np.longdouble
    random = np.random.default_rng(6)
    x = random.uniform(-4, 4, 48_000).astype(exact)
    sizes = 2.0 ** -random.uniform(widest, 40, len(x))
    sizes[::4] = random.uniform(0.5, 1, len(x) // 4) * 2.0**-widest
    d = (random.choice([-1, 1], len(x)) * sizes).astype(precision.dtype)
    d[:3] = 2.0**-widest, -(2.0**-widest), 0.0
    s, c = np.sin(x).astype(precision.dtype), np.cos(x).astype(precision.dtype)
    wide = d.astype(exact)
    return d, s, c, np.sin(wide), np.cos(wide), s.astype(exact), c.astype(exact)


@pytest.mark.parametrize("lane", LANES)
def test_rotation_error_is_about_one_unit(library: ctypes.CDLL, precision: Any, lane: str) -> None:
    """Compare with sums of angles in long double; for float, in double.

    The bound covers two roundings of numbers up to 1 each, and 2^-56 of the series (float: 2^-27).
    """
    unit = np.finfo(precision.dtype).eps / 2
    d, s, c, sin_d, cos_d, s0, c0 = turns(precision, 4 if precision.suffix else 6)
    call(library, f"rotate{lane}", d, s, c)
    error = errors((s, c), s0 * cos_d + c0 * sin_d, c0 * cos_d - s0 * sin_d)
    assert 0.4 * unit < error <= 1.3 * unit
    assert (s[2], c[2]) == (s0[2], c0[2])  # rotation by zero

    d, s, c, sin_d, cos_d, s0, c0 = turns(precision, 2 if precision.suffix else 3)
    back, on = [np.empty((2, len(d)), precision.dtype) for _ in range(2)]
    call(library, f"rotate_both{lane}", d, s, c, *back, *on)
    for rotated, sine in ((back, -sin_d), (on, sin_d)):
        error = errors(tuple(rotated), s0 * cos_d + c0 * sine, c0 * cos_d - s0 * sine)
        assert 0.4 * unit < error <= 1.3 * unit
        assert tuple(rotated[:, 2]) == (s0[2], c0[2])


@pytest.mark.parametrize("both", [False, True], ids=["in place", "both"])
def test_error_of_small_angle_series_is_as_documented(precision: Any, both: bool) -> None:
    """Evaluate exactly, so that only the rounding of the coefficients counts."""
    text = (ROOT / "csrc" / "lanes" / f"rotate{precision.suffix}.h").read_text(encoding="utf-8")
    name = "eomc_rotate_both_LANE" if both else "eomc_rotate_LANE"
    body = text[text.index(name) :].partition("}")[0]
    sums = re.findall(r"\b(z|a23|b12|a|b|sin_d|less) = ([^,;]+)[,;]", body)
    widest = 2.0 ** -((2 if precision.suffix else 3) if both else (4 if precision.suffix else 6))
    most = 0.0
    with mpmath.workdps(40):
        for k in range(1, 401):
            d = mpmath.mpf(widest * k / 400)
            known = {"d": d, "number": lambda x: mpmath.mpf(float(precision.dtype(x)))}
            for value, formula in sums:
                exact = re.sub(r"(?<![\w.])(\d\.\d+(?:e-\d+)?)f?", r"number('\1')", formula)
                known[value] = eval(exact, {}, known)
            most = max(most, abs(known["sin_d"] - mpmath.sin(d)))
            most = max(most, abs(known["less"] - (mpmath.cos(d) - 1)))
        assert most <= mpmath.mpf(2) ** (-27 if precision.suffix else -56.7)


def test_rotation_gives_equal_bits_in_every_lane(library: ctypes.CDLL, precision: Any) -> None:
    """Compare the bytes of all lanes."""
    results = set()
    for lane in LANES:
        d, s, c, *_ = turns(precision, 4 if precision.suffix else 6)
        both = np.empty((4, len(d)), precision.dtype)
        call(library, f"rotate_both{lane}", d, s, c, *both)
        call(library, f"rotate{lane}", d, s, c)
        results.add(both.tobytes() + s.tobytes() + c.tobytes())
    assert len(results) == 1


@pytest.mark.slow
def test_builds_without_fma_agree_bit_for_bit(libraries: list[ctypes.CDLL], precision: Any) -> None:
    x, results = points(precision), []
    for library in libraries:
        d, s, c, *_ = turns(precision, 4 if precision.suffix else 6)
        call(library, "rotate_32", d, s, c)
        exponentials = [of_lane(library, f"{name}_32", d) for name in EXPONENTIALS]
        arrays = (*bench.sincos(library, "small_32", x), s, c, *exponentials)
        if not library.fast_fma():
            results.append(b"".join(a.tobytes() for a in arrays))
    if len(results) < 2:
        pytest.skip("the compiler does not take -mno-fma")
    assert len(set(results)) == 1


@pytest.mark.parametrize("lane", LANES)
@pytest.mark.parametrize("most", [0.125, 0.0, 2.0**20])
def test_check_for_values_above_a_limit(
    library: ctypes.CDLL, precision: Any, lane: str, most: float
) -> None:
    limit, info = precision.dtype(most), np.finfo(precision.dtype)
    beyond = np.nextafter(limit, precision.dtype(np.inf))
    below = np.nextafter(limit, precision.dtype(0))
    fits = [0.0, -0.0, below, -below, limit, -limit]
    far = [beyond, -beyond, info.max, -info.max, np.inf, -np.inf]
    x = np.array([*fits, *far], precision.dtype)
    expected = [False] * len(fits) + [True] * len(far)
    assert evaluate_check(library, f"exceeds{lane}", x, np.array([limit])) == expected
    if not lane:  # vectors leave this case to the scalars computed from them
        odd = np.array([np.nan, -np.nan], precision.dtype)
        assert evaluate_check(library, "exceeds", odd, np.array([limit])) == [True, True]


@pytest.mark.parametrize("lane", VECTORS)
def test_check_for_values_that_are_not_positive(
    library: ctypes.CDLL, precision: Any, lane: str
) -> None:
    info = np.finfo(precision.dtype)
    sizes = [info.smallest_subnormal, info.tiny, 1e-20, 1.0, info.max, np.inf]
    none = [0.0, -0.0, *(-size for size in sizes)]
    x = np.array([*sizes, np.nan, -np.nan, *none], precision.dtype)
    expected = [False] * (len(sizes) + 2) + [True] * len(none)
    assert evaluate_check(library, f"not_positive{lane}", x) == expected


@pytest.mark.parametrize("lane", VECTORS)
def test_check_for_values_that_are_not_finite(
    library: ctypes.CDLL, precision: Any, lane: str
) -> None:
    info = np.finfo(precision.dtype)
    finite = [0.0, -0.0, 1.0, info.max, -info.max, info.tiny, -info.smallest_subnormal]
    x = np.array([*finite, np.inf, -np.inf, np.nan, -np.nan], precision.dtype)
    assert evaluate_check(library, f"not_finite{lane}", x) == [False] * len(finite) + [True] * 4


@pytest.mark.parametrize("lane", VECTORS)
def test_failure_mask_depends_on_sign_bits_only(
    library: ctypes.CDLL, precision: Any, lane: str
) -> None:
    integer = np.int32 if precision.suffix else np.int64
    least, most = np.iinfo(integer).min, np.iinfo(integer).max
    count = getattr(library, f"count{lane}")()
    assert count == VECTORS[lane] // np.dtype(precision.dtype).itemsize
    failed = getattr(library, f"any{lane}")
    for rest in (0, 1, most):
        bits = np.full(count, rest, integer)
        assert not failed(bench.pointer(bits))
        for place in range(count):
            for value in (-1, least):
                bits[place] = value
                assert failed(bench.pointer(bits))
            bits[place] = rest
    assert failed(bench.pointer(np.full(count, -1, integer)))


@pytest.mark.parametrize("lane", VECTORS)
def test_broadcast_of_one_number(library: ctypes.CDLL, precision: Any, lane: str) -> None:
    for number in (1.5, -0.0, 0.0, np.inf, np.finfo(precision.dtype).smallest_subnormal):
        x = np.array([number], precision.dtype)
        to = np.full(VECTORS[lane] // x.itemsize + 1, 7, precision.dtype)
        getattr(library, f"same{lane}")(bench.pointer(x), bench.pointer(to))
        assert to.tobytes() == x.tobytes() * (len(to) - 1) + precision.dtype(7).tobytes()


def test_four_numbers_are_stored_at_any_position(library: ctypes.CDLL, precision: Any) -> None:
    """No other element changes; two points are interleaved as the generator defines it."""
    x, y = np.arange(1, 14, dtype=precision.dtype), -np.arange(1, 14, dtype=precision.dtype)
    for at in range(8):
        to = np.zeros(16, precision.dtype)
        library.put(bench.pointer(x[at : at + 4]), bench.pointer(to[at : at + 4]))
        assert to.tolist() == [0] * at + x[at : at + 4].tolist() + [0] * (12 - at)
        both = np.zeros((4, 2), precision.dtype)
        from_x, from_y = x[at : at + 4], y[9 - at : 13 - at]
        library.interleave(*map(bench.pointer, (from_x, from_y, both)))
        places = [interleaved_index(k) for k in range(4)]
        assert [tuple(both[k]) for k in places] == list(zip(from_x, from_y, strict=True))
