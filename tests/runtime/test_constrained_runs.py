"""Runs under constraints: projection, multipliers, locked and singular states."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support.cases import fast_files
from support.session import Modules, tiers

import eomc
from eomc.cli.main import main
from eomc.model.system import Constraint, Reaction, System

pytestmark = pytest.mark.usefixtures("unoptimised_file")
EPS = 2.0**-52


def system(name: str, starts: Any, K: str, P: str, rows: dict[str, str], **options: Any) -> System:
    """A system with holonomic constraints from formulas; only its first coordinate is fixed."""
    unconstrained = System.make(name, starts, K, P, outputs=rows, **options)
    constraints = tuple(Constraint(o.name, o.formula) for o in unconstrained.outputs)
    first, *rest = unconstrained.coordinates
    free = (first, *(replace(c, start_fixed=False, rate_fixed=False) for c in rest))
    return replace(unconstrained, outputs=(), constraints=constraints, coordinates=free)


@pytest.fixture(scope="module")
def rod(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    """A pendulum in x and y that a force may push, by RK4 and dp8, as a batch too."""
    pendulum = system(
        "rod_xy", {"x": (0.6, 0.4), "y": (-0.8, 0.3)}, "m*(x_dot**2 + y_dot**2)/2", "9.81*m*y",
        {"rod": "x**2 + y**2 - l**2"}, parameters={"m": 2.0, "l": 1.0}, methods=("rk4", "dp8"),
        inputs=["f"], forces={"x": "f"}, linearize=True, batch=True, h=0.005, duration=3.0,
    )  # fmt: skip
    return eomc.load(pendulum, tmp_path_factory.mktemp("rod"))


@pytest.mark.parametrize("method", ["rk4", "dp8"])
def test_steps_end_on_the_constraints(rod: ModuleType, method: str) -> None:
    run = rod.simulate(method=method)
    assert np.abs(run.constraints["rod"]).max() <= 8 * EPS
    rates = rod.constraint_rates(run.q, run.qd)
    assert np.abs(rates).max() <= 64 * EPS
    assert np.ptp(run.energy) < (1e-6 if method == "rk4" else 1e-12)
    assert run.singular_steps == 0 and np.isnan(run.first_singular)


def test_multiplier_is_the_force_in_the_rod(rod: ModuleType) -> None:
    run = rod.simulate()
    x, y = run.q.T
    # A^T lambda along the rod: m (v^2 + g.r)/l^2 is twice lambda r
    speed2 = (run.qd**2).sum(axis=1)
    tension = 2.0 * (speed2 - 9.81 * y)
    np.testing.assert_allclose(-2 * run.multipliers["rod"], tension, rtol=1e-12, atol=1e-9)
    a = np.array([rod.acceleration(q, qd) for q, qd in zip(run.q, run.qd, strict=True)])
    A = rod.constraint_jacobian(run.q)[:, 0]
    force = np.stack([np.zeros_like(x), np.full_like(x, -9.81 * 2.0)], axis=1)
    np.testing.assert_allclose(
        2.0 * a, force + run.multipliers["rod"][:, None] * A, rtol=1e-12, atol=1e-10
    )


def test_batch_ends_on_the_constraints(rod: ModuleType) -> None:
    angles = np.linspace(0.1, 3.0, 21)
    q0 = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    batch = rod.simulate_batch(q0, np.zeros_like(q0), every=10)
    assert (batch.status == "ok").all()
    assert np.abs((batch.q**2).sum(axis=-1) - 1).max() <= 8 * EPS
    single = rod.simulate(q0[7], np.zeros(2), every=10)
    np.testing.assert_allclose(batch.q[7], single.q, atol=1e-11)


def test_start_is_assembled_with_fixed_values_unchanged(rod: ModuleType) -> None:
    q, qd = rod.project([0.5, -0.9], [1.0, 0.0], fixed=["x", "x_dot"])
    assert q[0] == 0.5 and qd[0] == 1.0
    np.testing.assert_allclose(q[1], -np.sqrt(0.75), rtol=1e-15)
    np.testing.assert_allclose(qd[1], 0.5 / np.sqrt(0.75), rtol=1e-14)
    projected, _ = rod.project([0.5, -0.9], [0.0, 0.0])  # the smallest change is along the rod
    np.testing.assert_allclose(projected, np.array([0.5, -0.9]) / np.hypot(0.5, 0.9), rtol=1e-14)
    with pytest.raises(rod.MotionError, match="with x as given: leave one free") as error:
        rod.project([1.5, -0.9], [0.0, 0.0], fixed="x")
    assert error.value.status == "locked"
    long_run = rod.simulate([0.0, -1.9], [0.0, 0.0], params={"l": 2.0}, steps=1)
    assert long_run.q[0].tolist() == [0.0, -2.0]


@pytest.mark.parametrize("form", tiers(["plain", "fast"], "fast"))
def test_run_that_cannot_satisfy_its_constraints_is_locked(tmp_path: Path, form: Any) -> None:
    """A wall drives a slider until its rod is stretched, at 0.5 s.

    With h = 0.01 a step ends there, where one constraint depends on the other but not its rate.
    If the scene's own duration is shorter, no path reaches the wall, which saves seconds.
    """
    options: dict[str, Any] = {"duration": 1.0}
    stretched = system(
        "stretched", {"x": (0.5, 1.0), "y": (0.8660254037844386, 0.0)},
        "(x_dot**2 + y_dot**2)/2", "0", {"rod": "x**2 + y**2 - 1", "drive": "x - 0.5 - t"},
        h=0.01, duration=1.0 if form == "plain" else 0.4, methods=("rk4", "dp8"),
        batch=form == "fast",
    )  # fmt: skip
    module = eomc.load(stretched, tmp_path, form=form)
    for method in ("rk4", "dp8"):
        with pytest.warns(RuntimeWarning, match="obeys the constraints"):
            run = module.simulate(method=method, **options)
        assert run.status == "locked" and run.t[-1] == pytest.approx(0.49)
        assert run.singular_steps == 0
        rates = [
            module.constraint_rates(*state) for state in zip(run.q, run.qd, run.t, strict=True)
        ]
        assert np.abs(rates).max() < 64 * EPS
        with pytest.warns(RuntimeWarning, match="obeys the constraints"):
            assert module.simulate(method=method, h=0.007, **options).status == "locked"
        if form == "fast":
            batch = module.simulate_batch(
                np.tile(run.q[0], (9, 1)), every=1, method=method, **options
            )
            assert set(batch.status) == {"locked"} and set(batch.steps) == {49}


def four_bars() -> System:
    """A parallelogram, or other lengths; a spring may act on the first bar."""
    bars = system(
        "four_bar", {"a": (-3 / 64, 1.0), "b": (-3 / 64, 1.0), "c": (0.0, 0.0)},
        "(a_dot**2 + n*b_dot**2 + m*c_dot**2)/2", "k*(a - 0.9)**2 + g*(2*sin(a) + n*sin(b)/2)",
        {"along": "r*cos(a) + s*cos(b) + l*cos(c) - d", "across": "r*sin(a) + s*sin(b) + l*sin(c)"},
        parameters={"r": 1, "s": -1, "l": 1, "d": 1, "n": 1, "m": 1, "k": 0, "g": 0},
        h=1 / 64, duration=6 / 64,
    )  # fmt: skip
    free = tuple(replace(c, start_fixed=False) for c in bars.coordinates)
    return replace(bars, coordinates=free)


@pytest.fixture(scope="module")
def four_bar(modules: Modules) -> ModuleType:
    return modules.unoptimised(four_bars())


def test_steps_that_end_where_constraints_are_dependent_are_counted(four_bar: ModuleType) -> None:
    """The third step of a parallelogram ends in its flat position; then it goes on as one."""
    with warnings.catch_warnings(record=True) as warnings_:
        warnings.simplefilter("always")
        run = four_bar.simulate()
    assert run.status == "ok" and run.singular_steps == 1 and run.first_singular == 3 / 64
    np.testing.assert_allclose(run.q[-1], [3 / 64, 3 / 64, 0.0], atol=1e-14)
    assert "a step ends where a constraint depends on others" in str(warnings_[0].message)


def test_steps_compute_the_sines_of_three_angles_in_one_register(four_bar: ModuleType) -> None:
    """At the midpoint, rotated from it, and without known sines."""
    source = fast_files(four_bar)["four_bar.c"]
    for name in ("rk4_begin", "rk4_rotate", "rk4_rotate_end", "sines_at"):
        body = source.split(f" four_bar_{name}(")[1].split("\n}\n")[0]
        calls = re.findall(r"four_bar_((?:sincos|rotate)\w*)\(", body)
        assert calls and all(f.endswith("_four") for f in calls)


@pytest.mark.parametrize("index", range(3))
def test_angle_too_wide_for_the_register_leaves_the_others_unchanged(
    index: int, four_bar: ModuleType
) -> None:
    """Beyond 2^20 by full turns, where doubles are 2e-10 apart."""
    wide = np.array([0.4, 0.9, -0.6])
    wide[index] += 2**18 * math.tau
    q = wide.copy()
    q[index] = math.remainder(wide[index], math.tau)
    a, b, c = q
    bars = {"r": 1.0, "s": -1.5, "l": (1.5 * math.sin(b) - math.sin(a)) / math.sin(c)}
    bars |= {"d": math.cos(a) - 1.5 * math.cos(b) + bars["l"] * math.cos(c), "g": 9.81}
    expected, run = (four_bar.simulate(start, np.zeros(3), params=bars) for start in (q, wide))
    assert expected.status == run.status == "ok" and np.abs(expected.q[-1] - q).min() > 1e-3
    np.testing.assert_allclose(run.q[-1] - wide, expected.q[-1] - q, atol=1e-8)


def test_reduced_linearization_equals_that_of_minimal_coordinates(
    rod: ModuleType,
) -> None:
    """For a hanging pendulum in x and y: w^2 = g/l."""
    x0, options = (np.array([0.0, -0.5]), np.zeros(2)), {"params": {"l": 0.5}}
    A, B = rod.linearize(*x0, u=[0.0], **options)
    T = rod.tangent(*x0, **options)
    assert T.shape == (4, 2)
    np.testing.assert_allclose(T.T @ T, np.eye(2), atol=1e-15)
    reduced = T.T @ A @ T
    assert sorted(np.linalg.eigvals(reduced).imag) == pytest.approx(
        [-np.sqrt(19.62), np.sqrt(19.62)]
    )
    # no component leaves the tangent space
    np.testing.assert_allclose(A @ T, T @ reduced, atol=1e-13)
    assert np.abs(T.T @ B).max() == pytest.approx(0.5)
    moving = rod.project([0.3, -0.4], [1.0, 0.0], **options)
    tangent = rod.tangent(*moving, **options)
    size = 1e-6
    for z in tangent.T:  # these changes satisfy the constraints, to the first order
        q, qd = moving[0] + size * z[:2], moving[1] + size * z[2:]
        assert np.abs(rod.constraints(q, qd, **options)).max() < 4 * size**2
        assert np.abs(rod.constraint_rates(q, qd, **options)).max() < 4 * size**2


def test_reactions_along_a_run_use_the_times_of_its_rows(tmp_path: Path) -> None:
    """A mass between a driven wall and the ground: the reaction follows the wall."""
    driven = system(
        "driven", {"x": (0.0, 1.0)}, "x_dot**2/2", "0", {"wall": "x - sin(t)"}, h=0.01,
        duration=1.0,
    )  # fmt: skip
    wall = driven.constraints[0]
    driven = replace(
        driven,
        plane=True,
        reactions=(Reaction("hold", (wall.multiplier, 0 * wall.multiplier, 0 * wall.multiplier)),),
    )
    module = eomc.load(driven, tmp_path)
    run = module.simulate(every=10)
    np.testing.assert_allclose(run.reactions["hold"][:, 0], -np.sin(run.t), atol=1e-12)
    separate = [
        module.reactions(q, qd, t)["hold"] for q, qd, t in zip(run.q, run.qd, run.t, strict=True)
    ]
    np.testing.assert_array_equal(run.reactions["hold"], separate)


@pytest.mark.slow
@pytest.mark.slow
def test_start_with_dependent_constraints_is_unchanged(tmp_path: Path) -> None:
    """A four-bar in its flat position, where the constraint residuals are rounding."""
    flat = system(
        "lies_flat", {"a": (0.0, 0.0), "b": (0.0, 0.0), "c": (0.0, 0.0)},
        "(a_dot**2 + b_dot**2 + c_dot**2)/2", "0",
        {"along": "0.3*cos(a) + 0.9*cos(b) - 0.5*cos(c) - 0.7",
         "across": "0.3*sin(a) + 0.9*sin(b) - 0.5*sin(c)"},
        h=0.01, duration=0.1,
    )  # fmt: skip
    module = eomc.load(flat, tmp_path)
    q, qd = module.project(np.zeros(3), np.zeros(3), fixed=["a"])
    assert not q.any() and not qd.any()


SCALED = """eomc = 1
name = "scaled"
[coordinates]
x = { unit = "m" }
y = { unit = "m" }
z = { unit = "m" }
w = { unit = "m" }
[parameters]
a = 1.0
b = 1.0
c = 1.0
k = 2.0
[energy]
kinetic = "(x_dot**2 + 2*y_dot**2 + z_dot**2 + w_dot**2)/2 + x_dot*y_dot/3"
[constraints]
one = "a*(1.1*x + 2.3*y - 3.7*z - 1)"
two = "b*(k*1.1*x + 2.3*y - 3.7*z - 1)"
three = "c*(x - y + 2*z + 5*w)"
[run]
h = 0.01
duration = 0.1
"""


@pytest.mark.parametrize("k", [2.0, 1.0])  # with 1, `two` equals `one`
def test_projection_scales_each_constraint_by_itself(modules: Modules, k: float) -> None:
    """Constraints that differ by 1e40, in any order; mutants of the norm in projection.c fail."""
    module, draw = modules.unoptimised(SCALED), np.random.default_rng(1)
    D = np.array([[1, 1 / 3, 0, 0], [1 / 3, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    A = np.array([[1.1, 2.3, -3.7, 0], [1.1 * k, 2.3, -3.7, 0], [1, -1, 2, 5]])
    independent = [0, 1, 2] if k != 1 else [0, 2]
    A, constants = A[independent], np.array([-1, -1, 0])[independent]
    projector = np.linalg.solve(D, A.T) @ np.linalg.inv(A @ np.linalg.solve(D, A.T))
    for scales in permutations((1e-20, 1.0, 1e20)):
        q, qd = draw.normal(size=(2, 4))
        params = dict(zip("abc", scales, strict=True), k=k)
        projected = module.project(q, qd, params=params)
        expected = q - projector @ (A @ q + constants), qd - projector @ (A @ qd)
        np.testing.assert_allclose(projected, expected, atol=1e-12)


NEAR_ZERO = """eomc = 1
name = "assembled_at_zero"
[coordinates]
a = { unit = "rad" }
b = { unit = "rad" }
c = { unit = "rad" }
[energy]
kinetic = "a_dot**2 + b_dot**2 + c_dot**2 + a_dot*b_dot*cos(a - b)"
[constraints]
along = "cos(a + 1) + cos(b + 2) - cos(c + 1/2) - cos(1) - cos(2) + cos(1/2)"
across = "sin(a + 1) + sin(b + 2) - sin(c + 1/2) - sin(1) - sin(2) + sin(1/2)"
"""


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-10, 1e-7, 1e-4])
def test_projection_near_zero_demands_no_more_than_rounding(modules: Modules, size: float) -> None:
    """Rounding of the constraints is relative to the lengths, however small the angles are."""
    module, draw = modules.unoptimised(NEAR_ZERO), np.random.default_rng(7)
    for _ in range(100):
        q, qd = size * draw.normal(size=(2, 3))
        q_projected, qd_projected = module.project(q, qd)
        assert np.abs(q_projected - q).max() < 10 * size
        assert np.abs(module.constraints(q_projected, qd_projected)).max() < 1e-15


def test_projection_does_not_jump_by_full_turns(four_bar: ModuleType) -> None:
    """With nearly vanishing gradients, a full Newton step would be about 1e9 rad."""
    folded = {"params": {"r": 0.5, "s": 1.0, "l": -0.5}}
    for deviation in (0.0, 1e-9):
        q, _ = four_bar.project([1.0, -1.0 + deviation, 1e-9], np.zeros(3), **folded)
        assert np.abs(q).max() < 20
        assert np.abs(four_bar.constraints(q, np.zeros(3), **folded)).max() < 1e-14


@pytest.mark.slow
def test_equilibrium_balances_forces_and_multipliers(rod: ModuleType) -> None:
    """The rod hangs, or stands if the guess is close to that; a bad guess also converges."""
    q, _, u = rod.equilibrium()
    np.testing.assert_allclose(q, [0, -1], atol=1e-14)
    assert u is not None and u.tolist() == [0]
    q = rod.equilibrium([0.1, 2.0], params={"l": 1.5}).q
    np.testing.assert_allclose(q, [0, 1.5], atol=1e-14)
    with pytest.raises(ArithmeticError, match="a force of"):
        rod.equilibrium([0.6, -0.8], free=["y"])


def test_equilibrium_of_a_linkage_with_a_spring(four_bar: ModuleType) -> None:
    """A torsion spring acts on its crank: no acceleration, and the constraints are satisfied."""
    m, options = (
        four_bar,
        {"params": {"s": 3, "l": -2, "d": 2.5, "n": 3, "m": 2, "k": 4, "g": 9.81}},
    )
    start, _ = m.project([0.7, 0.3, 1.2], np.zeros(3), fixed=["a"], **options)
    q, _, u = m.equilibrium(start, **options)
    assert u is None
    assert np.abs(m.constraints(q, 0 * q, **options)).max() < 1e-14
    assert np.abs(m.acceleration(q, 0 * q, **options)).max() < 1e-12
    assert np.abs(q - start).max() > 1e-3


def test_equilibrium_of_a_structure_that_cannot_move(rod: ModuleType) -> None:
    """No coordinate is free, and the rod carries only forces along it."""
    q = rod.equilibrium([0.0, -1.0], free=["y"]).q
    np.testing.assert_array_equal(q, [0, -1])


LATER = """eomc = 1
name = "later"
[coordinates]
x = { start = 0.6 }
y = { start = -0.8 }
[energy]
kinetic = "x_dot**2 + y_dot**2"
potential = "9.81*y"
[constraints]
rod = "x**2 + y**2 - 1"
a = "x - 0.6"
b = "y + 0.8 - 0.1*t**2"
[run]
h = 0.01
duration = 2
"""


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_compiled")
def test_constraints_that_contradict_each_other_later_are_reported(tmp_path: Path) -> None:
    """The start satisfies all constraints and their rates; no motion does."""
    (tmp_path / "later.toml").write_text(LATER, encoding="utf-8")
    scene_system = eomc.read(tmp_path / "later.toml")
    messages = " ".join(map(str, scene_system.warnings))
    assert "no position satisfies the constraints shortly after the start" in messages
    module = eomc.load(scene_system, tmp_path / "build")
    with pytest.warns(RuntimeWarning, match="constraints: they contradict one another"):
        assert module.simulate().status == "locked"
    arguments = ["run", str(tmp_path / "later.toml"), "--build", str(tmp_path / "build")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1 and "they contradict one another" in result.output


DEPENDENT = ["sin(x) + 0.7*y*y", "0.7*y*y - 2*sin(x)"]


@pytest.mark.slow
@pytest.mark.parametrize("formula", tiers(DEPENDENT, DEPENDENT[0]))
def test_constraint_dependent_on_the_fixed_values_is_redundant(
    formula: str, tmp_path: Path
) -> None:
    """With z fixed, the second is a multiple of the first up to rounding: no new direction."""
    modules = list[ModuleType]()
    for name, second in (("one_row", {}), ("two_rows", {"other": f"3.3*({formula}) + 7*z"})):
        scene_system = system(
            name, {"x": (0.0, 0.0), "y": (0.0, 0.0), "z": (0.0, 0.0)},
            "x_dot**2/2 + 1.5*y_dot**2 + z_dot**2", "0", {"one": f"{formula} + 5*z", **second},
            h=0.01, duration=0.1,
        )  # fmt: skip
        modules.append(eomc.load(scene_system, tmp_path))
    for x, y in np.random.default_rng(7).uniform(-0.5, -0.1, (20, 2)):
        (expected, _), (q, _) = (
            module.project([x, y, 0.0], np.zeros(3), fixed=["z"]) for module in modules
        )
        np.testing.assert_allclose(q, expected, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_compiled")
def test_redundant_constraint_that_is_violated_later_is_reported(tmp_path: Path) -> None:
    """Initially it depends on the others; steps satisfy only these."""
    scene = LATER.replace("*t**2", "*t**40").replace("duration = 2", "duration = 1")
    (tmp_path / "later.toml").write_text(scene, encoding="utf-8")
    scene_system = eomc.read(tmp_path / "later.toml")
    assert sum(c.redundant for c in scene_system.constraints) == 1
    module = eomc.load(scene_system, tmp_path / "build")
    with pytest.warns(RuntimeWarning, match=r"is 0\.\d+ at the end, not 0: constraints contradict"):
        module.simulate()
    assert module.simulate(steps=0).status == "ok"  # the run has a single row
