"""Compare sines of rotated and of predicted angles with 40 digits, with and without FMA."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

import mpmath
import numpy as np
import pytest
from support.cases import FMA, fast_files, odd_system, scene_system
from support.session import Modules, needs, tiers

from eomc.derive import lagrange
from eomc.emit.common.c_expression import DOUBLE
from eomc.emit.common.c_names import Target
from eomc.emit.optimised.lanes import Accelerations
from eomc.program import program
from eomc.program.two_point import Angle
from eomc.toolchain.files import write_files


@cache
def optimised_c(name: str) -> tuple[Accelerations, dict[str, str]]:
    """Return the optimised C of the cart-pole or of the scene with odd angles."""
    own = odd_system() if name == "odd" else scene_system(name)
    derivation = program.build(lagrange.derive(own))
    return Accelerations(Target(derivation, DOUBLE)), fast_files(Modules().unoptimised(own))


def run_main(
    main: str, name: str, rows: Iterable[Sequence[float]], flags: Sequence[str], folder: Path
) -> list[list[float]]:
    """Return the numbers that a main() prints for each row of its input.

    It is compiled together with the optimised C of a scene.
    """
    write_files(optimised_c(name)[1], folder)
    source = (folder / f"{name}.c").read_text(encoding="utf-8")
    main = "#include <stdio.h>\n" + main.replace("eomc_", f"{name}_")
    main = main.replace("EOMC_", f"{name.upper()}_")
    (folder / "near.c").write_text(f"{source}\n{main}", encoding="utf-8")
    command = [needs("gcc"), *flags, "near.c", "-o", "near", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    lines = "\n".join(" ".join(repr(float(x)) for x in row) for row in rows)
    process = subprocess.run(
        ["./near"], cwd=folder, input=lines, capture_output=True, text=True, check=True
    )
    return [[float(x) for x in line.split()] for line in process.stdout.splitlines()]


# with FMA in one of them
BUILDS = {"narrow": ("-std=c99", "-O2"), "native": ("-std=gnu99", "-O3", "-march=native")}
UNIT = 2.0**-53


def largest_error(rows_of_sines: Iterable[tuple[float, float, mpmath.mpf]]) -> float:
    """Return the largest error of sines and cosines at exact angles, in units of rounding of 1."""
    with mpmath.workdps(40):
        return max(
            float(max(abs(s - mpmath.sin(x)), abs(c - mpmath.cos(x)))) / UNIT
            for s, c, x in rows_of_sines
        )


@pytest.mark.parametrize("build", tiers(BUILDS, "narrow"))
def test_rotated_sines_are_accurate(build: str, tmp_path: Path) -> None:
    """Sines are rotated from the middle of a step back and forth, then by the accelerations.

    Rotations are accurate up to their limits 2^-3 and 2^-6; beyond them the step fails.
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
    results = run_main(main, "cartpole", rows, BUILDS[build], tmp_path)
    assert [row[-2:] for row in results] == (
        [[0, 0]] * 600 + [[1, 0]] * 4 + [[0, 1]] * (len(beyond) - 4)
    )
    known: dict[str, list[tuple[float, float, mpmath.mpf]]] = {}
    with mpmath.workdps(40):
        for (x0, back, near, far), row in zip(rows[:600], results, strict=False):
            mid, d = mpmath.mpf(x0 + back), mpmath.mpf(back)
            places = {"begin": mid - d, "mid": mid, "end": mid + d, "on": mid + near}
            for k, (place, at) in enumerate((places | {"further": mid + d + far}).items()):
                known.setdefault(place, []).append((row[2 * k], row[2 * k + 1], at))
    worst = {place: largest_error(rows) for place, rows in known.items()}
    assert 0.5 < worst["mid"] < 1.4  # 1.6 units of the last place, of numbers up to 1
    assert all(0.5 < worst[place] < 1.4 + 1 for place in ("begin", "end", "on"))
    assert 0.5 < worst["further"] < 1.4 + 2


@pytest.mark.slow
@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.parametrize("name", ["cartpole", "odd"])
def test_sines_near_predictions_are_accurate(name: str, build: str, tmp_path: Path) -> None:
    """Errors are in units of rounding of 1, of one angle and of three in one register."""
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
    accelerations, _ = optimised_c(name)
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
    results = np.array(run_main(main, name, [*rows, *odd_rows], BUILDS[build], tmp_path))
    assert np.isnan(results[count:, [2, 3]]).all()  # NaN remains NaN
    assert np.isnan(results[-1, [4 * len(angles), -1]]).all()
    results = results[:count].reshape(count, 2, 4 * len(angles) + 1)
    near, far = results[:, :, :-1].reshape(count, 2, len(angles), 4), results[:, :, -1]
    distances = near[..., 1]
    np.testing.assert_array_equal(distances[:, 0, 0], d)
    np.testing.assert_allclose(far, (distances**2 / 2).sum(axis=2), rtol=1e-8)
    for k, angle in enumerate(angles):

        def project_angle(vector: np.ndarray, angle: Angle = angle) -> np.ndarray:
            return sum(float(w) * vector[:, names.index(n)] for w, n in angle.terms)

        for part, t in enumerate((mid, end)):
            x = (
                project_angle(q)
                + float(angle.offset)
                + project_angle(v) * t
                + project_angle(a) * t**2 / 2
            )
            size = np.abs(q).max(axis=1) + 3
            assert (np.abs(near[:, part, k, 0] - x) <= 8 * UNIT * size).all()
    with mpmath.workdps(40):
        known = [
            (s, c, mpmath.mpf(x) + mpmath.mpf(correction))
            for x, correction, s, c in near.reshape(-1, 4).tolist()
        ]
    fma = build == "native" and FMA
    assert 0.5 < largest_error(known) < (2 if fma else 2.4)


@pytest.mark.parametrize("build", tiers(BUILDS, "native"))
def test_steps_fail_beyond_the_range_of_predictions(build: str, tmp_path: Path) -> None:
    """The sum of four squared distances may be 2^-24, which an angle of 2^20 needs entirely.

    A step that fails leaves the state unchanged; other steps have the sines of their end.
    """
    main = r"""
    int main(void)
    {
        double x, shift, h, steps;

        while (scanf("%lf %lf %lf %lf", &x, &shift, &h, &steps) == 4) {
            const double predicted[2] = { 0.0, x + shift };
            eomc_rk4_state m = { 0 };
            eomc_constants c;
            eomc_options options = { .h = h };
            eomc_output output = { 0 };
            long done, next = LONG_MAX;
            int same;

            eomc_compute_constants(&c, &eomc_defaults);
            m.q[1] = x;
            m.qd[0] = 0.1, m.qd[1] = 0.2;
            eomc_sines_at(&m.s, m.q);
            eomc_accelerations(m.a, m.q, m.qd, &m.s, &c);
            eomc_predict(&m.next, predicted, m.qd, m.a, h/2, h);
            done = eomc_rk4_predicted(&m, 0, (long)steps, &options, &output, &next, &c);
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
    results = run_main(main, "cartpole", rows, BUILDS[build], tmp_path)
    assert [row[:2] for row in results[: len(close)]] == [[1, 0]] * len(close)
    assert [row[:2] for row in results[len(close) : len(close) + len(far)]] == [[0, 1]] * len(far)
    on = results[len(close) + len(far) :]
    assert [row[0] for row in on] == [40] * 50
    with mpmath.workdps(40):
        assert largest_error((s, c, mpmath.mpf(x)) for *_, x, s, c in on) < 8  # q is rounded, too
