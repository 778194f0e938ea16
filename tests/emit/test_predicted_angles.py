"""Test rotated sines, compensated sums, and runs in several calls."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import pytest
from support.cases import FMA, ODD, SCENES, fast_files, odd_system, scene_system
from support.session import MODULES, Modules, needs, tiers
from sympy import Rational, S

import eomc
from eomc.derive import lagrange
from eomc.integrators.tableaux import METHODS
from eomc.model import system
from eomc.program import program
from eomc.program.two_point import separate_angles
from eomc.scene import read as scene
from eomc.toolchain.files import write_files


def scene_with_odd_angles() -> program.Program:
    return program.build(lagrange.derive(odd_system()))


def textbook_state(module: ModuleType, h: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the state after one textbook step of RK4 with the accelerations of the module."""
    q, v = module.start
    a = module.acceleration
    for _ in range(steps):
        k1, w1 = v, a(q, v)
        k2, w2 = v + h / 2 * w1, a(q + h / 2 * k1, v + h / 2 * w1)
        k3, w3 = v + h / 2 * w2, a(q + h / 2 * k2, v + h / 2 * w2)
        k4, w4 = v + h * w3, a(q + h * k3, v + h * w3)
        q, v = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), v + h / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
    return q, v


def test_angles_linear_in_coordinates_are_detected() -> None:
    system = scene_with_odd_angles()
    angles, remainder = separate_angles(system["acceleration"], ["a", "b"])
    result = {(frozenset(angle.terms), angle.offset) for angle in angles}
    half = Rational(1, 2)
    one, two = S.One, S(2)
    differences = [frozenset({(one, "a"), (-one, "b")}), frozenset({(-one, "a"), (one, "b")})]
    assert (frozenset({(two, "a")}), S.Zero) in result
    assert (frozenset({(one, "b")}), half) in result
    assert any((d, S.Zero) in result for d in differences)
    assert len(result) == 3  # a + phase and a*b are computed where they are needed
    assert {name for a in angles for name in (a.sine, a.cosine)} & remainder.uses
    names = {a.name for a in remainder.body}
    assert not names & {name for a in angles for name in (a.sine, a.cosine)}


@pytest.mark.slow
@pytest.mark.parametrize("h", tiers((0.001, 0.02, 0.3), 0.02))
def test_short_and_long_steps_agree_with_textbook(h: float, modules: Modules) -> None:
    """Angles change by about 1e-6, 1e-4 and, above the limit of rotations, 1e-1."""
    links = range(1, 7)
    coordinates = "".join(f"a{k} = {{ start = {0.3 * k} }}\n" for k in links)
    energy = " + ".join(f"{k}*a{k}_dot**2/2" for k in links)
    springs = " + ".join(f"cos(a{k} - a{k + 1})" for k in links[:-1])
    many = f'eomc = 1\nname = "many"\n[coordinates]\n{coordinates}[energy]\n'
    many += f'kinetic = "{energy} + a1_dot*a2_dot*sin(a1)/5"\npotential = "{springs}"\n'
    both = scene_system("double_pendulum")
    built = [modules.unoptimised(text) for text in (ODD, many, both)]
    for module in (*built, modules("cartpole")):
        run = module.simulate(h=h, steps=20)
        for result, expected in zip(
            (run.q[-1], run.qd[-1]), textbook_state(module, h, 20), strict=True
        ):
            np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12)


def test_steps_leave_and_reenter_the_range_of_predictions(cartpole: ModuleType) -> None:
    """The angle of a falling pole is off by h^2 a/8; predictions are valid up to 2^-12.5."""
    h, steps = 0.016, 800
    run = cartpole.simulate(h=h, steps=steps)
    turns = h**2 / 8 * np.abs(cartpole.acceleration(run.q, run.qd)[:, 1])
    assert turns.max() > 1.2 * 2.0**-12.5 and turns.min() < 0.5 * 2.0**-12.5
    for result, expected in zip(
        (run.q[-1], run.qd[-1]), textbook_state(cartpole, h, steps), strict=True
    ):
        np.testing.assert_allclose(result, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "signal", tiers(("2*sin(3*t)", "2*cos(t)*a - a_dot", "0.7"), "2*cos(t)*a - a_dot")
)
def test_signals_and_constant_inputs_enter_predicted_steps(signal: str, modules: Modules) -> None:
    """Signals of time and of the state, constant signals, and inputs held over a step."""
    scene = ODD.replace("[energy]", f'[inputs]\nu = {{ signal = "{signal}" }}\n[energy]')
    text = scene.replace('name = "odd"', 'name = "pushed"') + '[forces]\nb = "u"\n'
    module = modules.unoptimised(text)
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
        for result, expected in zip((run.q[-1], run.qd[-1]), textbook(u), strict=True):
            np.testing.assert_allclose(result, expected, rtol=0, atol=1e-13)


def test_large_angle_is_passed_to_libm(modules: Modules) -> None:
    """After two million turns the motion is the same, up to the rounding error of the angle."""
    module = modules("simple_pendulum")
    q, qd = module.start
    far_run = module.simulate(q + 2e6 * 2 * np.pi, qd, h=0.01, steps=200)
    near_run = module.simulate(q, qd, h=0.01, steps=200)
    difference = far_run.q[-1] - 2e6 * 2 * np.pi - near_run.q[-1]
    assert np.abs(difference).max() < 1e-7


@pytest.mark.parametrize(
    ("method", "power"), [("rk4", 20), ("dp8", 18), ("gauss8", 15), ("gauss16", 15)]
)
def test_sums_are_compensated(method: str, power: int, tmp_path: Path) -> None:
    """The reference is the power of the linear map R(h J) of a step of an oscillator, in 40 digits.

    With plain sums the error is 1e-13 and more, and nearly as large with rounded weights.
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
        errors = [abs(mpmath.mpf(float(a)) - b) for a, b in zip(run.x[-1], exact, strict=True)]
    assert max(errors) < (5e-15 if FMA or method != "rk4" else 2e-13)  # the error of h/6


@pytest.mark.parametrize(
    ("h", "name"),
    tiers([(0.005, "cartpole"), (0.016, "cartpole"), (0.004, "double_pendulum")], 0.016),
)
def test_run_in_several_calls_is_bitwise_the_same(
    name: str, h: float, tmp_path: Path, modules: Modules
) -> None:
    """The workspace must persist between calls. Without it, compensated sums restart."""
    write_files(fast_files(modules(name)), tmp_path)
    main = r"""
        #include "NAME.h"
        #include <stdio.h>

        int main(void)
        {
            for (int way = 0; way < 3; way++) {
                double q[2] = { 0.0, 1.5 }, qd[2] = { 0.0, 0.0 };
                NAME_memory memory = { 0 };
                NAME_options options = { .h = H };
                NAME_output output = { .memory = way < 2 ? &memory : 0 };
                long part[3] = { 2000, 0, 0 };

                if (way > 0)
                    part[0] = 1, part[1] = 700, part[2] = 1299;
                for (long k = 0; k < 3; k++) {
                    options.steps = part[k];
                    NAME_integrate(q, qd, &NAME_defaults, &options, &output);
                }
                printf("%.17g %.17g %.17g %.17g\n", q[0], q[1], qd[0], qd[1]);
            }
            return 0;
        }
        """
    (tmp_path / "cut.c").write_text(main.replace("NAME", name), encoding="utf-8")
    subprocess.run(
        [needs("gcc"), "-std=c99", "-O1", f"-DH={h}", "cut.c", f"{name}.c", "-o", "cut", "-lm"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    process = subprocess.run(["./cut"], cwd=tmp_path, capture_output=True, text=True, check=True)
    whole, cut, forgotten = process.stdout.splitlines()
    assert whole == cut
    assert whole != forgotten
    states = [np.array(line.split(), float) for line in (whole, forgotten)]
    np.testing.assert_allclose(*states, rtol=0, atol=1e-12)


METHODS_OF_MEMORY = ("rk4", "dp8", "gauss8", "gauss16")
BY_HAND = r"""
static void METHOD_by_hand(void)
{
    for (int way = 0; way < 2; way++) {
        double q[2] = { 0.0, 0.5 }, qd[2] = { 0.0, 0.0 };
        cartpole_memory memory = { 0 };
        cartpole_options options = { .method = CARTPOLE_METHOD_UPPER, .h = 0.005, .steps = 17 };
        cartpole_output output = { .memory = &memory };

        cartpole_integrate(q, qd, &cartpole_defaults, &options, &output);
        q[1] += 1e-5;
        options.steps = 1;
        output.memory = way ? &memory : 0;
        cartpole_integrate(q, qd, &cartpole_defaults, &options, &output);
        printf("%.17g %.17g %.17g %.17g\n", q[0], q[1], qd[0], qd[1]);
    }
}
"""


def test_workspace_of_another_state_is_ignored(tmp_path: Path, modules: Modules) -> None:
    """A state that changes between two calls is integrated as without a workspace."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    text = text.replace("[run]\n", f"[run]\nmethod = {list(METHODS_OF_MEMORY)}\n")
    cartpole = system.from_scene(scene.parse(text, "cartpole.toml"))
    for file, written in fast_files(modules.unoptimised(cartpole)).items():
        (tmp_path / file).write_text(written, encoding="utf-8")
    functions = "".join(
        BY_HAND.replace("UPPER", m.upper()).replace("METHOD_by_hand", f"{m}_by_hand")
        for m in METHODS_OF_MEMORY
    )
    calls = " ".join(f"{m}_by_hand();" for m in METHODS_OF_MEMORY)
    main = f'#include "cartpole.h"\n#include <stdio.h>\n{functions}\nint main(void) {{ {calls} }}\n'
    (tmp_path / "hand.c").write_text(main, encoding="utf-8")
    subprocess.run(
        ["cc", "-std=c99", "-O0", "hand.c", "cartpole.c", "-o", "hand", "-lm"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    process = subprocess.run(["./hand"], cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = process.stdout.splitlines()
    assert len(lines) == 2 * len(METHODS_OF_MEMORY)
    for method, without, with_workspace in zip(
        METHODS_OF_MEMORY, lines[::2], lines[1::2], strict=True
    ):
        assert with_workspace == without, method
