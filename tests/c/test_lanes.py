"""csrc/lanes/: in one number and in vectors of 16, 32 and 64 bytes, of double and of float."""

from __future__ import annotations

import ctypes
import re
import shutil
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
from conftest import ROOT, tiers
from lane_source import BUILDS, EXPONENTIALS, LANES, MOST, VECTORS, built, call, of_lane
from sincos_bench import LARGEST_ERROR, bench, nearest_multiples

from eomc.emit.optimised.lanes import interleaved_index

pytestmark = pytest.mark.skipif(shutil.which(bench.compiler()) is None, reason="no C compiler")


@pytest.fixture(scope="module", params=tiers(["double", "float"], "double"))
def of(request: pytest.FixtureRequest) -> Any:
    """The precision, as the benchmark describes it."""
    return {"double": bench.DOUBLE, "float": bench.SINGLE}[request.param]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lanes")


@pytest.fixture(scope="module")
def judge(of: Any, folder: Path) -> ctypes.CDLL:
    """What knows better."""
    return bench.reference(folder, of)


@pytest.fixture(scope="module", params=tiers(BUILDS, "native"))
def library(request: pytest.FixtureRequest, of: Any, folder: Path) -> ctypes.CDLL:
    found = built(folder, of, request.param)
    if found is None:
        pytest.skip(f"{bench.compiler()} does not build: {request.param}")
    return found


@pytest.fixture
def made(of: Any, folder: Path) -> list[ctypes.CDLL]:
    """All libraries of this precision."""
    return [library for name in BUILDS if (library := built(folder, of, name)) is not None]


def told(library: ctypes.CDLL, function: str, *arrays: np.ndarray) -> list[bool]:
    """What a check finds of each number, in whichever place of a register it stands."""
    count = len(arrays[0])
    found = []
    for shift in range(MOST):
        room = -(-(count + shift) // MOST) * MOST
        shifted = [
            a if len(a) < count else np.concatenate([np.ones(shift), a, np.ones(room)])[:room]
            for a in arrays
        ]
        out = np.full(room, 7, np.intc)
        call(library, function, *(a.astype(arrays[0].dtype) for a in shifted), out)
        found.append(out[shift : shift + count].tolist())
    assert all(row == found[0] for row in found)
    assert set(found[0]) <= {0, 1}
    return [bool(x) for x in found[0]]


def points(of: Any) -> np.ndarray:
    """Angles of all sizes up to the limit, next to multiples of pi/2 and between quadrants."""
    random = np.random.default_rng(5)
    some = random.integers(1, of.last_multiple, 2000).tolist()
    hardest = [*nearest_multiples(40, of), *range(1, 300), of.last_multiple - 1, of.last_multiple]
    odd = (np.arange(1, 2000, 2) * (np.pi / 4)).astype(of.dtype)
    x = [
        *bench.random_points(6_000, random, of).values(),
        bench.neighbours_of_multiples([*hardest, *some], of),
        *(odd, np.nextafter(odd, of.dtype(0)), np.nextafter(odd, of.dtype(np.inf))),
        np.array([of.limit, np.nextafter(of.dtype(of.limit), of.dtype(0))], of.dtype),
    ]
    x = np.concatenate([*x, *(-part for part in x)])
    assert x.dtype == of.dtype and np.abs(x).max() == of.limit
    return np.concatenate([x, np.zeros(-len(x) % MOST, of.dtype)])


def test_sines_of_a_lane_are_sines(library: ctypes.CDLL, of: Any, judge: ctypes.CDLL) -> None:
    """As good as those of one number, in every width."""
    x = points(of)
    found = [bench.sincos(library, f"small{lane}", x) for lane in VECTORS]
    s, c = (np.concatenate(part) for part in zip(*found, strict=True))
    worst = np.zeros((len(found), 2))
    arrays = (bench.pointer(a) for a in (s, c, worst))
    judge.errors(ctypes.c_long(x.size), bench.pointer(x), ctypes.c_long(len(found)), *arrays)
    assert (worst > 1.3).all() and (worst <= LARGEST_ERROR).all(), worst


def test_sines_of_a_lane_are_those_of_one_number(library: ctypes.CDLL, of: Any) -> None:
    """Bit for bit; with FMA, where one number is reduced by other parts of pi/2, to one unit."""
    x = points(of)
    one = bench.sincos(library, "small", x)
    lanes = [bench.sincos(library, f"small{lane}", x) for lane in VECTORS]
    for a, b in zip(one, lanes[0], strict=True):
        assert (np.abs(a - b) <= np.spacing(np.abs(a))).all()
        if not library.fast_fma():
            assert a.tobytes() == b.tobytes()
    for lane in lanes:
        assert [a.tobytes() for a in lane] == [a.tobytes() for a in lanes[0]]


@pytest.mark.parametrize("lane", VECTORS)
def test_tiny_angles_and_signed_zero(library: ctypes.CDLL, of: Any, lane: str) -> None:
    info = np.finfo(of.dtype)
    tiny = [0.0, info.smallest_subnormal, 1000 * info.smallest_subnormal, info.tiny, 1e-20]
    tiny = np.array([*tiny, 2.0 ** (of.smallest // 2), bench.TINY, 0.0], of.dtype)
    x = np.concatenate([tiny, -tiny])
    s, c = bench.sincos(library, f"small{lane}", x)
    assert s.tobytes() == x.tobytes()  # the sign of -0.0 as well
    assert (c == 1.0).all()


@pytest.mark.parametrize("lane", VECTORS)
def test_angles_beyond_the_limit_fail_alone(library: ctypes.CDLL, of: Any, lane: str) -> None:
    """And not a number gives none; what stands beside them is as ever, what failed has failed."""
    beyond = np.nextafter(of.dtype(of.limit), of.dtype(np.inf))
    largest = np.finfo(of.dtype).max
    far = np.array([beyond, -beyond, 3e9, -largest, np.inf, -np.inf, np.nan, -np.nan], of.dtype)
    good = np.linspace(-of.limit, of.limit, len(far) * 63).astype(of.dtype)
    x = np.concatenate([far[:, None], good.reshape(-1, 63)], axis=1)
    x = np.stack([np.roll(row, 5 * k) for k, row in enumerate(x)]).ravel()
    s, c, failed = np.empty_like(x), np.empty_like(x), np.zeros(x.shape, np.intc)
    call(library, f"sincos{lane}", x, s, c, failed)
    inside = np.abs(x) <= of.limit
    assert inside.sum() == len(good) and set(good) == set(x[inside])
    assert not failed[inside].any()
    assert (failed.astype(bool) | np.isnan(s) & np.isnan(c))[~inside].all()
    assert failed[np.abs(x) > of.limit].all()  # infinite ones too
    expected = bench.sincos(library, f"small{lane}", np.where(inside, x, of.dtype(0)))
    for found, sure in zip((s, c), expected, strict=True):
        assert found[inside].tobytes() == sure[inside].tobytes()
    before = (np.arange(x.size) % 3 == 0).astype(np.intc)
    call(library, f"sincos{lane}", x, s, c, both := before.copy())
    assert both.tolist() == (before | failed).tolist()


def errors(found: tuple[np.ndarray, ...], *wanted: np.ndarray) -> float:
    return max(float(np.max(np.abs(a - b))) for a, b in zip(found, wanted, strict=True))


def turns(of: Any, widest: int) -> tuple[np.ndarray, ...]:
    """d up to 2^-widest, s, c of the precision; sin d, cos d, s, c as precise as there is."""
    exact = np.float64 if of.suffix else np.longdouble
    random = np.random.default_rng(6)
    x = random.uniform(-4, 4, 48_000).astype(exact)
    sizes = 2.0 ** -random.uniform(widest, 40, len(x))
    sizes[::4] = random.uniform(0.5, 1, len(x) // 4) * 2.0**-widest
    d = (random.choice([-1, 1], len(x)) * sizes).astype(of.dtype)
    d[:3] = 2.0**-widest, -(2.0**-widest), 0.0
    s, c = np.sin(x).astype(of.dtype), np.cos(x).astype(of.dtype)
    wide = d.astype(exact)
    return d, s, c, np.sin(wide), np.cos(wide), s.astype(exact), c.astype(exact)


@pytest.mark.parametrize("lane", LANES)
def test_rotating_costs_one_unit_of_rounding(library: ctypes.CDLL, of: Any, lane: str) -> None:
    """Against sums of angles in long double; for float, against double.

    Two roundings of numbers up to 1 each, and the series' 2^-56 (float: 2^-27).
    """
    unit = np.finfo(of.dtype).eps / 2
    d, s, c, sin_d, cos_d, s0, c0 = turns(of, 4 if of.suffix else 6)
    call(library, f"rotate{lane}", d, s, c)
    error = errors((s, c), s0 * cos_d + c0 * sin_d, c0 * cos_d - s0 * sin_d)
    assert 0.4 * unit < error <= 1.3 * unit
    assert (s[2], c[2]) == (s0[2], c0[2])  # by no angle

    d, s, c, sin_d, cos_d, s0, c0 = turns(of, 2 if of.suffix else 3)
    back, on = [np.empty((2, len(d)), of.dtype) for _ in range(2)]
    call(library, f"rotate_both{lane}", d, s, c, *back, *on)
    for found, sine in ((back, -sin_d), (on, sin_d)):
        error = errors(tuple(found), s0 * cos_d + c0 * sine, c0 * cos_d - s0 * sine)
        assert 0.4 * unit < error <= 1.3 * unit
        assert tuple(found[:, 2]) == (s0[2], c0[2])


@pytest.mark.parametrize("both", [False, True], ids=["in place", "both"])
def test_series_of_small_angles(of: Any, both: bool) -> None:
    """As far off as the comments say, without a rounding but that of the coefficients."""
    text = (ROOT / "csrc" / "lanes" / f"rotate{of.suffix}.h").read_text(encoding="utf-8")
    name = "eomc_rotate_both_LANE" if both else "eomc_rotate_LANE"
    body = text[text.index(name) :].partition("}")[0]
    sums = re.findall(r"\b(z|a23|b12|a|b|sin_d|less) = ([^,;]+)[,;]", body)
    widest = 2.0 ** -((2 if of.suffix else 3) if both else (4 if of.suffix else 6))
    most = 0.0
    with mpmath.workdps(40):
        for k in range(1, 401):
            d = mpmath.mpf(widest * k / 400)
            known = {"d": d, "number": lambda x: mpmath.mpf(float(of.dtype(x)))}
            for value, formula in sums:
                exact = re.sub(r"(?<![\w.])(\d\.\d+(?:e-\d+)?)f?", r"number('\1')", formula)
                known[value] = eval(exact, {}, known)
            most = max(most, abs(known["sin_d"] - mpmath.sin(d)))
            most = max(most, abs(known["less"] - (mpmath.cos(d) - 1)))
        assert most <= mpmath.mpf(2) ** (-27 if of.suffix else -56.7)


def test_rotating_is_the_same_in_every_lane(library: ctypes.CDLL, of: Any) -> None:
    """Bit for bit."""
    found = set()
    for lane in LANES:
        d, s, c, *_ = turns(of, 4 if of.suffix else 6)
        both = np.empty((4, len(d)), of.dtype)
        call(library, f"rotate_both{lane}", d, s, c, *both)
        call(library, f"rotate{lane}", d, s, c)
        found.add(both.tobytes() + s.tobytes() + c.tobytes())
    assert len(found) == 1


@pytest.mark.slow
def test_builds_without_fma_agree_bit_for_bit(made: list[ctypes.CDLL], of: Any) -> None:
    x, found = points(of), []
    for library in made:
        d, s, c, *_ = turns(of, 4 if of.suffix else 6)
        call(library, "rotate_32", d, s, c)
        exponentials = [of_lane(library, f"{name}_32", d) for name in EXPONENTIALS]
        arrays = (*bench.sincos(library, "small_32", x), s, c, *exponentials)
        if not library.fast_fma():
            found.append(b"".join(a.tobytes() for a in arrays))
    if len(found) < 2:
        pytest.skip("the compiler does not take -mno-fma")
    assert len(set(found)) == 1


@pytest.mark.parametrize("lane", LANES)
@pytest.mark.parametrize("most", [0.125, 0.0, 2.0**20])
def test_what_exceeds(library: ctypes.CDLL, of: Any, lane: str, most: float) -> None:
    limit, info = of.dtype(most), np.finfo(of.dtype)
    beyond = np.nextafter(limit, of.dtype(np.inf))
    below = np.nextafter(limit, of.dtype(0))
    fits = [0.0, -0.0, below, -below, limit, -limit]
    far = [beyond, -beyond, info.max, -info.max, np.inf, -np.inf]
    x = np.array([*fits, *far], of.dtype)
    expected = [False] * len(fits) + [True] * len(far)
    assert told(library, f"exceeds{lane}", x, np.array([limit])) == expected
    if not lane:  # vectors leave it to the numbers that become of it
        odd = np.array([np.nan, -np.nan], of.dtype)
        assert told(library, "exceeds", odd, np.array([limit])) == [True, True]


@pytest.mark.parametrize("lane", VECTORS)
def test_what_is_not_positive(library: ctypes.CDLL, of: Any, lane: str) -> None:
    info = np.finfo(of.dtype)
    sizes = [info.smallest_subnormal, info.tiny, 1e-20, 1.0, info.max, np.inf]
    none = [0.0, -0.0, *(-size for size in sizes)]
    x = np.array([*sizes, np.nan, -np.nan, *none], of.dtype)
    expected = [False] * (len(sizes) + 2) + [True] * len(none)
    assert told(library, f"not_positive{lane}", x) == expected


@pytest.mark.parametrize("lane", VECTORS)
def test_what_is_not_finite(library: ctypes.CDLL, of: Any, lane: str) -> None:
    info = np.finfo(of.dtype)
    finite = [0.0, -0.0, 1.0, info.max, -info.max, info.tiny, -info.smallest_subnormal]
    x = np.array([*finite, np.inf, -np.inf, np.nan, -np.nan], of.dtype)
    assert told(library, f"not_finite{lane}", x) == [False] * len(finite) + [True] * 4


@pytest.mark.parametrize("lane", VECTORS)
def test_any_sign_bit_counts_and_nothing_else(library: ctypes.CDLL, of: Any, lane: str) -> None:
    integer = np.int32 if of.suffix else np.int64
    least, most = np.iinfo(integer).min, np.iinfo(integer).max
    count = getattr(library, f"count{lane}")()
    assert count == VECTORS[lane] // np.dtype(of.dtype).itemsize
    failed = getattr(library, f"any{lane}")
    for rest in (0, 1, most):
        bits = np.full(count, rest, integer)
        assert not failed(bench.pointer(bits))
        for place in range(count):
            for found in (-1, least):
                bits[place] = found
                assert failed(bench.pointer(bits))
            bits[place] = rest
    assert failed(bench.pointer(np.full(count, -1, integer)))


@pytest.mark.parametrize("lane", VECTORS)
def test_the_same_number_everywhere(library: ctypes.CDLL, of: Any, lane: str) -> None:
    for number in (1.5, -0.0, 0.0, np.inf, np.finfo(of.dtype).smallest_subnormal):
        x = np.array([number], of.dtype)
        to = np.full(VECTORS[lane] // x.itemsize + 1, 7, of.dtype)
        getattr(library, f"same{lane}")(bench.pointer(x), bench.pointer(to))
        assert to.tobytes() == x.tobytes() * (len(to) - 1) + of.dtype(7).tobytes()


def test_four_numbers_are_put_anywhere(library: ctypes.CDLL, of: Any) -> None:
    """And nowhere else; two points are interleaved as the generator has it."""
    x, y = np.arange(1, 14, dtype=of.dtype), -np.arange(1, 14, dtype=of.dtype)
    for at in range(8):
        to = np.zeros(16, of.dtype)
        library.put(bench.pointer(x[at : at + 4]), bench.pointer(to[at : at + 4]))
        assert to.tolist() == [0] * at + x[at : at + 4].tolist() + [0] * (12 - at)
        both = np.zeros((4, 2), of.dtype)
        from_x, from_y = x[at : at + 4], y[9 - at : 13 - at]
        library.interleave(*map(bench.pointer, (from_x, from_y, both)))
        places = [interleaved_index(k) for k in range(4)]
        assert [tuple(both[k]) for k in places] == list(zip(from_x, from_y, strict=True))
