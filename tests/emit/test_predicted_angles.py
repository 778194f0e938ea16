"""Sines that are rotated from stage to stage, sums that are compensated, runs that are cut."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import pytest
from cases import SCENES, fast_kit, scene_system
from conftest import MODULES, Modules, needs, tiers
from sympy import Rational, S

import eomc
from eomc.derive import lagrange
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_names import Target
from eomc.emit.fast.lanes import Accelerations
from eomc.integrators.tableaux import METHODS
from eomc.model import from_scene as system
from eomc.model.system import System
from eomc.program import program
from eomc.program.trig import Angle, apart
from eomc.scene import read as scene

ODD = """
eomc = 1
name = "odd"
[coordinates]
a = { start = 0.4 }
b = { start = -0.7 }
[parameters]
phase = 0.3
[energy]
kinetic = "a_dot**2/2 + b_dot**2/2 + a_dot*b_dot*cos(a - b)/3"
potential = "cos(2*a) + sin(b + 1/2) + cos(a + phase)/2 + sin(a*b)/4 + cos(a - b)/5"
"""


def odd_system() -> System:
    return system.from_scene(scene.parse(ODD, "odd.toml"))


def odd() -> program.Program:
    return program.build(lagrange.derive(odd_system()))


def stepped(module: ModuleType, h: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """RK4 as a textbook has it, over the module's accelerations."""
    q, v = module.start
    a = module.acceleration
    for _ in range(steps):
        k1, w1 = v, a(q, v)
        k2, w2 = v + h / 2 * w1, a(q + h / 2 * k1, v + h / 2 * w1)
        k3, w3 = v + h / 2 * w2, a(q + h / 2 * k2, v + h / 2 * w2)
        k4, w4 = v + h * w3, a(q + h * k3, v + h * w3)
        q, v = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), v + h / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
    return q, v


def test_angles_that_are_linear_in_coordinates_are_found() -> None:
    made = odd()
    angles, rest = apart(made["acceleration"], ["a", "b"])
    found = {(frozenset(angle.terms), angle.offset) for angle in angles}
    half = Rational(1, 2)
    one, two = S.One, S(2)
    differences = [frozenset({(one, "a"), (-one, "b")}), frozenset({(-one, "a"), (one, "b")})]
    assert (frozenset({(two, "a")}), S.Zero) in found
    assert (frozenset({(one, "b")}), half) in found
    assert any((d, S.Zero) in found for d in differences)
    assert len(found) == 3  # a + phase and a*b are computed where they are needed
    assert {name for a in angles for name in (a.sine, a.cosine)} & rest.uses
    names = {a.name for a in rest.body}
    assert not names & {name for a in angles for name in (a.sine, a.cosine)}


@pytest.mark.parametrize("h", tiers((0.001, 0.02, 0.3), 0.02))
@pytest.mark.usefixtures("quickly_compiled")
def test_steps_short_and_long_are_those_of_the_textbook(
    h: float, tmp_path: Path, modules: Modules
) -> None:
    """Turns of some 1e-6, 1e-4 and, beyond what is rotated, 1e-1."""
    (tmp_path / "odd.toml").write_text(ODD, encoding="utf-8")
    links = range(1, 7)
    coordinates = "".join(f"a{k} = {{ start = {0.3 * k} }}\n" for k in links)
    energy = " + ".join(f"{k}*a{k}_dot**2/2" for k in links)
    springs = " + ".join(f"cos(a{k} - a{k + 1})" for k in links[:-1])
    many = f'eomc = 1\nname = "many"\n[coordinates]\n{coordinates}[energy]\n'
    many += f'kinetic = "{energy} + a1_dot*a2_dot*sin(a1)/5"\npotential = "{springs}"\n'
    (tmp_path / "many.toml").write_text(many, encoding="utf-8")
    own = (tmp_path / "odd.toml", tmp_path / "many.toml")
    built = [eomc.load(path, tmp_path) for path in own]
    for module in (*built, modules("cartpole"), modules("double_pendulum")):
        run = module.simulate(h=h, steps=20)
        for found, expected in zip((run.q[-1], run.qd[-1]), stepped(module, h, 20), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_steps_leave_their_predictions_and_come_back(cartpole: ModuleType) -> None:
    """A pole that falls: it turns by h^2 a/8 from the predicted angles, up to 2^-12.5 is close."""
    h, steps = 0.016, 800
    run = cartpole.simulate(h=h, steps=steps)
    turns = h**2 / 8 * np.abs(cartpole.acceleration(run.q, run.qd)[:, 1])
    assert turns.max() > 1.2 * 2.0**-12.5 and turns.min() < 0.5 * 2.0**-12.5
    for found, expected in zip((run.q[-1], run.qd[-1]), stepped(cartpole, h, steps), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "signal", tiers(("2*sin(3*t)", "2*cos(t)*a - a_dot", "0.7"), "2*cos(t)*a - a_dot")
)
@pytest.mark.usefixtures("quickly_compiled")
def test_signals_and_held_inputs_reach_steps_near_predictions(signal: str, tmp_path: Path) -> None:
    """Signals of time, of the state and constant ones; and inputs held over a step each."""
    scene = ODD.replace("[energy]", f'[inputs]\nu = {{ signal = "{signal}" }}\n[energy]')
    text = scene.replace('name = "odd"', 'name = "pushed"') + '[forces]\nb = "u"\n'
    (tmp_path / "pushed.toml").write_text(text, encoding="utf-8")
    module = eomc.load(tmp_path / "pushed.toml", tmp_path)
    h, steps, acceleration = 0.004, 60, module.acceleration

    def textbook(u: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        q, v = module.start
        for n in range(steps):
            now = None if u is None else u[n]
            t = n * h
            k1, w1 = v, acceleration(q, v, t=t, u=now)
            k2 = v + h / 2 * w1
            w2 = acceleration(q + h / 2 * k1, k2, t=t + h / 2, u=now)
            k3 = v + h / 2 * w2
            w3 = acceleration(q + h / 2 * k2, k3, t=t + h / 2, u=now)
            k4 = v + h * w3
            w4 = acceleration(q + h * k3, k4, t=t + h, u=now)
            q, v = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), v + h / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
        return q, v

    for u in (None, np.random.default_rng(2).standard_normal((steps, 1))):
        run = module.simulate(h=h, steps=steps, u=u)
        for found, expected in zip((run.q[-1], run.qd[-1]), textbook(u), strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_a_wide_angle_goes_to_libm(tmp_path: Path) -> None:
    """Two million turns on it is the same motion, but for what rounding leaves of the angle."""
    module = eomc.load(SCENES / "simple_pendulum.toml", tmp_path)
    q, qd = module.start
    there = module.simulate(q + 2e6 * 2 * np.pi, qd, h=0.01, steps=200)
    here = module.simulate(q, qd, h=0.01, steps=200)
    apart = there.q[-1] - 2e6 * 2 * np.pi - here.q[-1]
    assert np.abs(apart).max() < 1e-7


@cache
def fast(name: str) -> tuple[Accelerations, dict[str, str]]:
    """Of the cart-pole or of the odd scene."""
    own = odd_system() if name == "odd" else scene_system(name)
    made = program.build(lagrange.derive(own))
    return Accelerations(Target(made, DOUBLE)), fast_kit(eomc.sources(own))


def made_with(
    main: str, name: str, rows: Iterable[Sequence[float]], flags: Sequence[str], folder: Path
) -> list[list[float]]:
    """What a main() behind the fast C of a scene tells of rows of numbers."""
    for file, text in fast(name)[1].items():
        (folder / file).write_text(text, encoding="utf-8")
    source = (folder / f"{name}.c").read_text(encoding="utf-8")
    main = "#include <stdio.h>\n" + main.replace("eomc_", f"{name}_")
    main = main.replace("EOMC_", f"{name.upper()}_")
    (folder / "near.c").write_text(f"{source}\n{main}", encoding="utf-8")
    command = [needs("gcc"), *flags, "near.c", "-o", "near", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    lines = "\n".join(" ".join(repr(float(x)) for x in row) for row in rows)
    done = subprocess.run(
        ["./near"], cwd=folder, input=lines, capture_output=True, text=True, check=True
    )
    return [[float(x) for x in line.split()] for line in done.stdout.splitlines()]


BUILDS = [("-std=c99", "-O2"), ("-std=gnu99", "-O3", "-march=native")]  # FMA in one of them
FMA = "fma" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
UNIT = 2.0**-53


def worst_of(found: Iterable[tuple[float, float, mpmath.mpf]]) -> float:
    """The largest error of sines and cosines at exact angles, in units of rounding of 1."""
    with mpmath.workdps(40):
        return max(
            float(max(abs(s - mpmath.sin(x)), abs(c - mpmath.cos(x)))) / UNIT for s, c, x in found
        )


@pytest.mark.parametrize("flags", BUILDS, ids=["narrow", "native"])
def test_a_turned_sine_is_a_sine(flags: tuple[str, ...], tmp_path: Path) -> None:
    """Of a step without predictions: from its middle back and on, then by the accelerations.

    Up to the bounds 2^-3 and 2^-6 of what is rotated; beyond them the step has failed.
    """
    main = r"""
    int main(void)
    {
        double x, d, on, further;

        while (scanf("%lf %lf %lf %lf", &x, &d, &on, &further) == 4) {
            const double q[2] = { 0.0, x }, qd[2] = { 0.0, d };
            eomc_rk4_stages w;
            int failed;

            w.failed = 0;
            eomc_rk4_begin(&w, q, qd, 2.0); /* its half step turns by qd */
            failed = w.failed;
            printf("%.17g %.17g %.17g %.17g %.17g %.17g ", w.begin.s[0], w.begin.c[0], w.mid.s[0],
                w.mid.c[0], w.end.s[0], w.end.c[0]);
            w.failed = 0;
            w.a[0][1] = on;
            w.a[1][1] = further/2;
            eomc_rk4_rotate(&w, 2.0);
            printf("%.17g %.17g %.17g %.17g %d %d\n", w.mid.s[0], w.mid.c[0], w.end.s[0],
                w.end.c[0], failed != 0, w.failed != 0);
        }
        return 0;
    }
    """
    random = np.random.default_rng(8)

    def spread(widest: int) -> np.ndarray:
        d = random.choice([-1, 1], 600) * 2.0 ** -random.uniform(widest, 40, 600)
        d[::3] = random.uniform(-1, 1, 200) * 2.0**-widest
        d[:4] = 0.0, 2.0**-widest, -(2.0**-widest), 2.0**-40
        return d

    x, d, on, further = random.uniform(-10, 10, 600), spread(3), spread(6), spread(6)
    rows = [tuple(map(float, row)) for row in zip(x, d, on, further, strict=True)]
    large, more, nan = 2.0**-3 * (1 + 2.0**-52), 2.0**-6 * (1 + 2.0**-52), float("nan")
    beyond = [(d, 0.0, 0.0) for d in (large, -large, 1.0, nan)]
    beyond += [(0.0, d, 0.0) for d in (more, -more, nan)]
    beyond += [(0.0, 0.0, d) for d in (more, -more, 1e300, nan)]
    rows += [(0.5, *row) for row in beyond]
    found = made_with(main, "cartpole", rows, flags, tmp_path)
    assert [row[-2:] for row in found] == (
        [[0, 0]] * 600 + [[1, 0]] * 4 + [[0, 1]] * (len(beyond) - 4)
    )
    known: dict[str, list[tuple[float, float, mpmath.mpf]]] = {}
    with mpmath.workdps(40):
        for (x0, back, near, far), row in zip(rows[:600], found, strict=False):
            mid, d = mpmath.mpf(x0 + back), mpmath.mpf(back)
            places = {"begin": mid - d, "mid": mid, "end": mid + d, "on": mid + near}
            for k, (place, at) in enumerate((places | {"further": mid + d + far}).items()):
                known.setdefault(place, []).append((row[2 * k], row[2 * k + 1], at))
    worst = {place: worst_of(rows) for place, rows in known.items()}
    assert 0.5 < worst["mid"] < 1.4  # 1.6 units of the last place, of numbers up to 1
    assert all(0.5 < worst[place] < 1.4 + 1 for place in ("begin", "end", "on"))
    assert 0.5 < worst["further"] < 1.4 + 2


@pytest.mark.parametrize("flags", BUILDS, ids=["narrow", "native"])
@pytest.mark.parametrize("name", ["cartpole", "odd"])
def test_sines_near_predictions_are_sines(
    name: str, flags: tuple[str, ...], tmp_path: Path
) -> None:
    """In units of rounding of 1, of one angle and of three in one register, up to their bounds."""
    main = r"""
    int main(void)
    {
        enum { N = ANGLES };
        double q[2], v[2], a[2], mid, end, d[N];

        while (scanf("%lf %lf %lf %lf %lf %lf %lf %lf %lf", &q[0], &q[1], &v[0], &v[1], &a[0],
            &a[1], &mid, &end, &d[0]) == 9) {
            eomc_predicted f;

            for (int k = 1; k < N; k++)
                d[k] = -0.5*d[k - 1];
            eomc_predict(&f, q, v, a, mid, end);
            for (int from = 0; from < 2*N; from += N) {
                eomc_sines to;
                const double far = eomc_near(&f, from, d, &to);

                for (int k = 0; k < N; k++)
                    printf("%.17g %.17g %.17g %.17g ", f.x[from + k], d[k], to.s[k], to.c[k]);
                printf("%.17g ", far);
            }
            printf("\n");
        }
        return 0;
    }
    """
    accelerations, _ = fast(name)
    names, angles = accelerations.target.names, accelerations.angles
    assert len(angles) == (1 if name == "cartpole" else 3)
    random, count = np.random.default_rng(9), 600
    q = np.where(random.random((count, 2)) < 0.5, 1, 1e4) * random.uniform(-10, 10, (count, 2))
    q[:40] = np.pi / 2 * np.arange(-40, 40).reshape(40, 2)
    v, a = random.normal(size=(2, count, 2))
    mid, end = random.uniform(0, 0.1, (2, count))
    mid[:40] = 0.0
    d = random.choice([-1, 1], count) * 2.0 ** -random.uniform(12, 40, count)
    d[:3] = 2.0**-12, -(2.0**-12), 0.0
    rows = [*zip(*q.T, *v.T, *a.T, mid, end, d, strict=True)]
    nan = float("nan")
    odd_rows = [(0.1, 0.1, nan, nan, 0, 0, 0.1, 0.1, 0.0), (0.1, 0.1, 0, 0, 0, 0, 0.1, 0.1, nan)]
    main = main.replace("ANGLES", str(len(angles)))
    found = np.array(made_with(main, name, [*rows, *odd_rows], flags, tmp_path))
    assert np.isnan(found[count:, [2, 3]]).all()  # what is no number stays none
    assert np.isnan(found[-1, [4 * len(angles), -1]]).all()
    found = found[:count].reshape(count, 2, 4 * len(angles) + 1)
    near, far = found[:, :, :-1].reshape(count, 2, len(angles), 4), found[:, :, -1]
    distances = near[..., 1]
    np.testing.assert_array_equal(distances[:, 0, 0], d)
    np.testing.assert_allclose(far, (distances**2 / 2).sum(axis=2), rtol=1e-8)
    for k, angle in enumerate(angles):

        def along(vector: np.ndarray, angle: Angle = angle) -> np.ndarray:
            return sum(float(w) * vector[:, names.index(n)] for w, n in angle.terms)

        for part, t in enumerate((mid, end)):
            x = along(q) + float(angle.offset) + along(v) * t + along(a) * t**2 / 2
            size = np.abs(q).max(axis=1) + 3
            assert (np.abs(near[:, part, k, 0] - x) <= 8 * UNIT * size).all()
    with mpmath.workdps(40):
        known = [
            (s, c, mpmath.mpf(x) + mpmath.mpf(by)) for x, by, s, c in near.reshape(-1, 4).tolist()
        ]
    fma = "-march=native" in flags and FMA
    assert 0.5 < worst_of(known) < (2 if fma else 2.4)


@pytest.mark.parametrize("flags", BUILDS, ids=["narrow", "native"])
def test_steps_end_where_predictions_do(flags: tuple[str, ...], tmp_path: Path) -> None:
    """Four distances, whose squares may be 2^-24 together; an angle of 2^20 takes all of that.

    What was not done leaves the state as it was, what was done has the sines of its end.
    """
    main = r"""
    int main(void)
    {
        double x, shift, h, steps;

        while (scanf("%lf %lf %lf %lf", &x, &shift, &h, &steps) == 4) {
            const double predicted[2] = { 0.0, x + shift };
            eomc_rk4_state m = { 0 };
            eomc_constants c;
            long done;
            int same;

            eomc_compute_constants(&c, &eomc_defaults);
            m.q[1] = x;
            m.qd[0] = 0.1, m.qd[1] = 0.2;
            eomc_sines_at(&m.s, m.q);
            eomc_accelerations(m.a, m.q, m.qd, &m.s, &c);
            eomc_predict(&m.next, predicted, m.qd, m.a, h/2, h);
            done = eomc_rk4_predicted(&m, h, 0, 0, (long)steps, 0, 0, 0, &c);
            same = m.q[0] == 0 && (m.q[1] == x || x != x) && m.qd[0] == 0.1 && m.qd[1] == 0.2;
            printf("%ld %d %.17g %.17g %.17g\n", done, same, m.q[1], m.s.s[0], m.s.c[0]);
        }
        return 0;
    }
    """
    h, limit = 2.0**-30, 2.0**20
    close = [(x, s) for x in (0.3, -9.0) for s in (0.0, 2.0**-13.01, -(2.0**-13.01))]
    close += [(limit - 1, 0.0), (-limit + 1, 0.0), (limit / 2, 2.0**-13.3)]
    far = [(0.3, 2.0**-12.99), (0.3, -(2.0**-12.99)), (0.3, 2.0**-12), (0.3, 1.0)]
    far += [(limit + 1, 0.0), (-limit - 1, 0.0), (limit / 2, 2.0**-13.1)]
    far += [(float(x), 0.0) for x in ("nan", "inf", "-inf")] + [(0.3, float("nan"))]
    rows = [(x, shift, h, 1) for x, shift in (*close, *far)]
    rows += [(x, 0.0, 0.005, 40) for x in np.linspace(-3, 3, 50)]
    found = made_with(main, "cartpole", rows, flags, tmp_path)
    assert [row[:2] for row in found[: len(close)]] == [[1, 0]] * len(close)
    assert [row[:2] for row in found[len(close) : len(close) + len(far)]] == [[0, 1]] * len(far)
    on = found[len(close) + len(far) :]
    assert [row[0] for row in on] == [40] * 50
    with mpmath.workdps(40):
        assert worst_of((s, c, mpmath.mpf(x)) for *_, x, s, c in on) < 8  # q, too, is rounded


@pytest.mark.parametrize(
    ("method", "power"), [("rk4", 20), ("dp8", 18), ("gauss8", 15), ("gauss16", 15)]
)
def test_sums_are_compensated(method: str, power: int, tmp_path: Path) -> None:
    """A step of an oscillator is a linear map R(h J): its power in 40 digits is the answer.

    With plain sums 1e-13 and more, and nearly as much with weights as they are rounded.
    """
    text = (SCENES / "mass_spring.toml").read_text(encoding="utf-8")
    names = '["rk4", "dp8", "gauss8", "gauss16"]'
    (tmp_path / "mass_spring.toml").write_text(
        text.replace("[run]\n", f"[run]\nmethod = {names}\n").replace('"mass_spring"', '"sums"'),
        encoding="utf-8",
    )
    module = eomc.load(tmp_path / "mass_spring.toml", MODULES)
    (x,), (v,) = module.start
    m, h, steps = METHODS[method], 2.0 ** (10 - power), 2**power
    with mpmath.workdps(50):
        hj = mpmath.matrix([[0, 1], [-4, 0]]) * mpmath.mpf(h)
        s, one = m.stages, mpmath.eye(2)
        a = [[mpmath.mpf(c.numerator) / c.denominator for c in row] for row in m.a]
        b = [mpmath.mpf(c.numerator) / c.denominator for c in m.b]
        big, ones = mpmath.eye(2 * s), mpmath.zeros(2 * s, 2)
        for i in range(s):
            for k, c in enumerate(a[i]):
                big[2 * i : 2 * i + 2, 2 * k : 2 * k + 2] -= c * hj
            ones[2 * i : 2 * i + 2, :] = one
        stages = big**-1 * ones
        step = one + sum((b[i] * hj * stages[2 * i : 2 * i + 2, :] for i in range(s)), 0 * one)
        exact = step**steps * mpmath.matrix([x, v])
        run = module.simulate(
            h=h, steps=steps, every=steps, params={"k": 4.0, "m": 1.0}, method=method
        )
        off = [abs(mpmath.mpf(float(a)) - b) for a, b in zip(run.x[-1], exact, strict=True)]
    assert max(off) < (5e-15 if FMA or method != "rk4" else 2e-13)  # for what h/6 lacks


@pytest.mark.parametrize(
    ("name", "h"), [("cartpole", 0.005), ("cartpole", 0.016), ("double_pendulum", 0.004)]
)
def test_a_run_cut_in_c_is_the_same_to_the_last_bit(name: str, h: float, tmp_path: Path) -> None:
    """With the memory handed on; without it, sums begin anew. Near what was predicted, and not."""
    for file, text in fast_kit(eomc.sources(eomc.read(SCENES / f"{name}.toml"))).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    main = r"""
        #include "NAME.h"
        #include <stdio.h>

        int main(void)
        {
            for (int way = 0; way < 3; way++) {
                double q[2] = { 0.0, 1.5 }, qd[2] = { 0.0, 0.0 };
                NAME_rk4_memory memory;
                NAME_status status;
                long part[3] = { 2000, 0, 0 };

                if (way > 0)
                    part[0] = 1, part[1] = 700, part[2] = 1299;
                memory.warm = 0;
                for (long k = 0, n = 0; k < 3; n += part[k++])
                    NAME_rk4_run(q, qd, H, n, part[k], 0, 0, 0, &NAME_defaults,
                        way < 2 ? &memory : 0, &status);
                printf("%.17g %.17g %.17g %.17g\n", q[0], q[1], qd[0], qd[1]);
            }
            return 0;
        }
        """
    (tmp_path / "cut.c").write_text(main.replace("NAME", name), encoding="utf-8")
    subprocess.run(
        [needs("gcc"), "-std=c99", "-O2", f"-DH={h}", "cut.c", f"{name}.c", "-o", "cut", "-lm"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    done = subprocess.run(["./cut"], cwd=tmp_path, capture_output=True, text=True, check=True)
    whole, cut, forgotten = done.stdout.splitlines()
    assert whole == cut
    assert whole != forgotten
    near = [np.array(line.split(), float) for line in (whole, forgotten)]
    np.testing.assert_allclose(*near, rtol=0, atol=1e-12)


@pytest.mark.parametrize("method", ["rk4", "dp8", "gauss8", "gauss16"])
def test_a_memory_of_another_state_is_not_believed(method: str, tmp_path: Path) -> None:
    """A state changed by hand between two calls moves on as it would with no memory at all."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    (tmp_path / "cartpole.toml").write_text(
        text.replace("[run]\n", f'[run]\nmethod = "{method}"\n'), encoding="utf-8"
    )
    for file, made in fast_kit(eomc.sources(eomc.read(tmp_path / "cartpole.toml"))).items():
        (tmp_path / file).write_text(made, encoding="utf-8")
    main = r"""
        #include "cartpole.h"
        #include <stdio.h>

        int main(void)
        {
            for (int way = 0; way < 2; way++) {
                double q[2] = { 0.0, 0.5 }, qd[2] = { 0.0, 0.0 };
                cartpole_METHOD_memory memory = { 0 };
                cartpole_status status;

                cartpole_METHOD_run(q, qd, 0.005, 0, 17, 0, 0, 0, &cartpole_defaults, &memory,
                    &status);
                q[1] += 1e-5;
                cartpole_METHOD_run(q, qd, 0.005, 17, 1, 0, 0, 0, &cartpole_defaults,
                    way ? &memory : 0, &status);
                printf("%.17g %.17g %.17g %.17g\n", q[0], q[1], qd[0], qd[1]);
            }
            return 0;
        }
        """
    (tmp_path / "hand.c").write_text(main.replace("METHOD", method), encoding="utf-8")
    subprocess.run(
        ["cc", "-std=c99", "-O2", "hand.c", "cartpole.c", "-o", "hand", "-lm"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    done = subprocess.run(["./hand"], cwd=tmp_path, capture_output=True, text=True, check=True)
    without, kept = done.stdout.splitlines()
    assert kept == without
