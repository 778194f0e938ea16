"""Many at once: what a scene with batch = true promises."""

from __future__ import annotations

import _thread
import platform
import re
import shutil
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cases import fast_kit
from conftest import needs, tiers

import eomc

SCENES = Path(__file__).parents[2] / "scenes"
STEPS = 60


def module(name: str, **run: str) -> ModuleType:
    """A scene with batch = true, built under build/ and kept there from test to test."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    options = "".join(f"{k} = {v}\n" for k, v in {"batch": "true", **run}.items())
    many = "_".join(["many", name, *(value.strip('"') for value in run.values())])
    text = re.sub(r"^name\s*=.*", f'name = "{many}"', text, flags=re.M)
    text = text.replace("[run]\n", "[run]\n" + options)
    path = Path("build/tests") / f"{many}.toml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return eomc.load(path, path.parent / "modules")


def starts(m: ModuleType, count: int) -> tuple[Any, Any]:
    """`count` states around the scene's start."""
    random = np.random.default_rng(1)
    return tuple(x + 0.2 * random.standard_normal((count, len(x))) for x in m.start)  # type: ignore[return-value]


NAMES = ["cartpole", "cartpole_driven", "furuta_pendulum", "kapitza_pendulum", "foucault_pendulum"]


@pytest.mark.parametrize("name", tiers(NAMES, "cartpole_driven", "kapitza_pendulum"))
def test_each_instance_moves_as_it_would_alone(name: str) -> None:
    m = module(name)
    q0, qd0 = starts(m, 130)
    runs = m.simulate_batch(q0, qd0, steps=STEPS, every=7)
    for k in (0, 63, 64, 129):
        alone = m.simulate(q0[k], qd0[k], steps=STEPS, every=7)
        assert np.array_equal(runs.t, alone.t)
        # the same operations, contracted to FMA in other places
        scale = 1 + np.max(np.abs(alone.q))
        assert np.max(np.abs(runs.q[k] - alone.q)) < 1e-13 * scale
        assert np.max(np.abs(runs.qd[k] - alone.qd)) < 1e-11 * (1 + np.max(np.abs(alone.qd)))
    assert set(runs.status) == {"ok"} and set(runs.steps) == {STEPS}


def test_place_and_threads_change_no_bit() -> None:
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 1000)
    one = m.simulate_batch(q0, qd0, steps=STEPS, threads=1)
    many = m.simulate_batch(q0, qd0, steps=STEPS, threads=3)
    assert np.array_equal(one.q, many.q) and np.array_equal(one.qd, many.qd)
    part = m.simulate_batch(q0[501:540], qd0[501:540], steps=STEPS)
    assert np.array_equal(part.q, one.q[501:540])
    turned = m.simulate_batch(q0[::-1], qd0[::-1], steps=STEPS)
    assert np.array_equal(turned.q, one.q[::-1])


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", tiers(("cartpole", "cartpole_driven", "tumbling_box"), "cartpole"))
def test_how_many_there_are_changes_no_bit(name: str, real: str) -> None:
    """Tiles that are not full are taken by blocks: any number of instances, each as among many."""
    m = module(name, real=f'"{real}"')
    q0, qd0 = starts(m, 300)
    all_of_them = m.simulate_batch(q0, qd0, steps=5, every=2)
    assert (all_of_them.steps == 5).all()
    for count in (*range(1, 40), 56, 57, 63, 64, 65, 71, 127, 129):
        few = m.simulate_batch(q0[-count:], qd0[-count:], steps=5, every=2)
        assert np.array_equal(few.q, all_of_them.q[-count:])
        assert np.array_equal(few.qd, all_of_them.qd[-count:])
        assert (few.steps == 5).all() and set(few.status) == {"ok"}


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize(
    "name", tiers(("cartpole", "cartpole_driven", "double_pendulum"), "cartpole")
)
def test_a_fast_neighbour_changes_no_bit(name: str, real: str) -> None:
    """Sines are turned in slow instances and computed in fast ones, whatever is beside them."""
    m = module(name, real=f'"{real}"')
    q0, qd0 = starts(m, 192)
    q0, qd0 = q0.astype(m.dtype), qd0.astype(m.dtype)
    fast = np.random.default_rng(3).random(192) < 0.1
    fast[64:128] = np.arange(64) % 64 != 5  # a tile with one that is slow
    qd0[fast] *= 300
    h = 0.01
    mixed = m.simulate_batch(q0, qd0, h=h, steps=STEPS)
    for some in (fast, ~fast):
        apart = m.simulate_batch(q0[some], qd0[some], h=h, steps=STEPS)
        assert np.array_equal(apart.q, mixed.q[some]) and np.array_equal(apart.qd, mixed.qd[some])
    if name != "cartpole_driven":  # t0 + n h is rounded otherwise
        half = STEPS // 2
        begun = m.simulate_batch(q0, qd0, h=h, steps=half)
        ended = m.simulate_batch(begun.q[:, -1], begun.qd[:, -1], h=h, steps=half)
        assert np.array_equal(ended.q, mixed.q[:, half:])


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("h", [0.005, 0.02, 0.05, 0.2])
def test_turned_sines_are_as_good_as_computed_ones(h: float, real: str) -> None:
    """On both sides of the bounds: 1/8 for h/2 qd, 1/64 for h^2/2 qdd; for floats 1/4 and 1/16."""
    m = module("cartpole", real=f'"{real}"')
    q0, qd0 = (x.astype(m.dtype) for x in starts(m, 300))
    qd0[:, 1] = np.linspace(-20, 20, 300)
    runs = m.simulate_batch(q0, qd0, h=h, steps=1)
    some = 18 * np.finfo(m.dtype).eps
    for k in range(300):
        alone = m.simulate(q0[k], qd0[k], h=h, steps=1)
        assert np.max(np.abs(runs.q[k] - alone.q)) < some * (1 + 20 * h)
        assert np.max(np.abs(runs.qd[k] - alone.qd)) < some * (20 + 400 * h)


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("h", [0.1, 0.5])
def test_turns_by_accelerations_are_as_good_as_computed_sines(h: float, real: str) -> None:
    """At rest, from upright, where h^2/2 qdd is nothing, to where it is too much for a turn."""
    m = module("cartpole", real=f'"{real}"')
    q0, qd0 = np.zeros((500, 2), m.dtype), np.zeros((500, 2), m.dtype)
    q0[:, 1] = np.linspace(0, np.pi, 500)
    runs = m.simulate_batch(q0, qd0, h=h, steps=1)
    some = 18 * np.finfo(m.dtype).eps
    for k in range(500):
        alone = m.simulate(q0[k], qd0[k], h=h, steps=1)
        assert np.max(np.abs(runs.q[k] - alone.q)) < some * (1 + 20 * h)
        assert np.max(np.abs(runs.qd[k] - alone.qd)) < some * (1 + 20 * h)


@pytest.mark.parametrize("real", ["double", "float"])
def test_turns_by_velocities_are_as_good_as_computed_sines(real: str, tmp_path: Path) -> None:
    """A heavy rotor turns evenly, by up to 2.4 rad a step, and pushes a mass by its sine."""
    (tmp_path / "rotor.toml").write_text(
        "eomc = 1\nname = 'rotor'\n[coordinates]\nx = {}\ntheta = {}\n[energy]\n"
        "kinetic = 'x_dot**2/2 + 100*theta_dot**2'\npotential = 'x*sin(theta)'\n"
        f"[run]\nbatch = true\nreal = '{real}'\n",
        encoding="utf-8",
    )
    m = eomc.load(tmp_path / "rotor.toml", tmp_path)
    q0, qd0 = (x.astype(m.dtype) for x in starts(m, 400))
    qd0[:, 1] = np.linspace(0, 2.4, 400)
    runs = m.simulate_batch(q0, qd0, h=1.0, steps=1)
    for k in range(400):
        alone = m.simulate(q0[k], qd0[k], h=1.0, steps=1)
        # of numbers up to 3
        assert np.max(np.abs(runs.q[k] - alone.q)) < 8 * np.finfo(m.dtype).eps
        assert np.max(np.abs(runs.qd[k] - alone.qd)) < 8 * np.finfo(m.dtype).eps


def test_parameters_and_inputs_of_its_own() -> None:
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 70)
    masses = np.linspace(0.5, 4.0, 70)
    table = np.random.default_rng(2).standard_normal((70, STEPS, 1))
    runs = m.simulate_batch(q0, qd0, steps=STEPS, params={"m_c": masses, "l": 1.5}, u=table)
    k = 69
    alone = m.simulate(q0[k], qd0[k], steps=STEPS, params={"m_c": masses[k], "l": 1.5}, u=table[k])
    assert np.max(np.abs(runs.q[k] - alone.q)) < 1e-12
    constant = m.simulate_batch(q0, qd0, steps=STEPS, u=[3.0])
    alone = m.simulate(q0[k], qd0[k], steps=STEPS, u=[3.0])
    assert np.max(np.abs(constant.q[k] - alone.q)) < 1e-12


def test_equal_parameters_of_its_own_change_no_bit() -> None:
    """What all share is compiled apart from what each has."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 130)
    for u in (None, [0.5]):
        shared = m.simulate_batch(q0, qd0, steps=STEPS, params={"l": 1.5}, u=u)
        own = m.simulate_batch(q0, qd0, steps=STEPS, params={"l": np.full(130, 1.5)}, u=u)
        assert np.array_equal(shared.q, own.q) and np.array_equal(shared.qd, own.qd)


def test_every_group_has_its_own_parameters_and_inputs() -> None:
    """One thread takes all 600 at once, three take 128 each time; one table may serve all."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 600)
    params = np.tile(list(m.defaults.values()), (600, 1))
    params[:, m.parameters.index("m_c")] = np.linspace(0.5, 4.0, 600)
    table = np.random.default_rng(4).standard_normal((600, STEPS, 1))
    for u in (table, table[:, 0], table[:1]):
        one, many = (
            m.simulate_batch(q0, qd0, steps=STEPS, params=params, u=u, threads=threads)
            for threads in (1, 3)
        )
        assert np.array_equal(one.q, many.q) and np.array_equal(one.qd, many.qd)
        k = 599
        mine = np.broadcast_to(u if u.ndim == 3 else u[:, None], table.shape)[k]
        alone = m.simulate(q0[k], qd0[k], steps=STEPS, params=params[k], u=mine)
        assert np.max(np.abs(many.q[k] - alone.q)) < 1e-12


def test_a_batch_is_the_same_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look at Ctrl-C behind each step: time, rows and inputs go on, who stopped stays there."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 70)
    table = np.random.default_rng(5).standard_normal((70, STEPS, 1))
    table[41, 33] = 1e300  # too much for the square of what it makes of theta_dot

    def runs() -> list[Any]:
        how = {"steps": STEPS, "every": 7, "t0": 0.5}
        return [m.simulate_batch(q0, qd0, u=u, **how) for u in (None, table, table[:1])]

    whole = runs()
    for name in ("_FIRST", "_SECONDS"):
        monkeypatch.setattr(sys.modules[f"{m.__name__}.batch_work"], name, 0.0)
    for one, other in zip(whole, runs(), strict=True):
        for name in ("t", "q", "qd", "steps"):
            assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
        assert np.array_equal(one.status, other.status)
    assert (whole[1].status[41], whole[1].status[40]) == ("not finite", "ok")
    assert 33 <= whole[1].steps[41] < STEPS
    alone = m.simulate(q0[3], qd0[3], steps=STEPS, every=7, t0=0.5)
    assert np.array_equal(whole[0].t, alone.t) and alone.t[0] == 0.5
    assert np.max(np.abs(whole[0].q[3] - alone.q)) < 1e-12


def test_starts_of_any_layout_are_read_and_left_alone() -> None:
    m = module("cartpole")
    q0, qd0 = starts(m, 300)
    wanted = m.simulate_batch(q0, qd0, steps=STEPS)
    wide = np.empty((2, 2, 600))
    wide[0, :, ::2], wide[1, :, ::2] = q0.T, qd0.T
    strided = wide[0, :, ::2].T, wide[1, :, ::2].T
    runs = m.simulate_batch(*strided, steps=STEPS)
    assert np.array_equal(runs.q, wanted.q) and np.array_equal(runs.qd, wanted.qd)
    assert np.array_equal(strided[0], q0) and np.array_equal(strided[1], qd0)
    from_one = m.simulate_batch(q0[0], qd0, steps=STEPS)
    assert np.array_equal(from_one.q[:, 0], np.tile(q0[0], (300, 1)))
    table = np.zeros(300, [("q", float, 2), ("one", "b"), ("qd", float, 2)])  # numbers not aligned
    table["q"], table["qd"] = q0, qd0
    for at, moving in ((table["q"], table["qd"]), (q0[::-1].copy()[::-1], qd0.astype(">f8"))):
        runs = m.simulate_batch(at, moving, steps=STEPS)
        assert np.array_equal(runs.q, wanted.q) and np.array_equal(runs.qd, wanted.qd)


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("real", ["double", "float"])
def test_starts_that_are_not_finite_are_refused_before_any_moves(real: str, threads: int) -> None:
    """Wherever they are; nobody waits for the others' hours first."""
    m = module("cartpole", real=f'"{real}"')
    calls: list[int] = []
    for name, (row, column), number in (
        ("q0", (7, 1), np.nan), ("qd0", (19_999, 0), np.inf), ("q0", (12_000, 0), -np.inf),
        *([("qd0", (3, 1), 1e300)] if real == "float" else []),  # no float is that large
    ):  # fmt: skip
        given = dict(zip(("q0", "qd0"), starts(m, 20_000), strict=True))
        given[name][row, column] = number
        for order in ("C", "F"):
            given[name] = np.array(given[name], order=order)  # type: ignore[call-overload]
            with pytest.raises(ValueError, match=rf"^{name}\[{row}, {column}\]: .* is not finite"):
                m.simulate_batch(
                    **given,
                    steps=STEPS,
                    threads=threads,
                    progress=lambda done, _: calls.append(done),
                )
    assert not calls


def test_long_rows_start_where_they_should(tmp_path: Path) -> None:
    """Nine masses in a row, on springs."""
    names = [f"x{k}" for k in range(9)]
    springs = " + ".join(f"({a} - {b})**2" for a, b in pairwise(["1", *names, "2"]))
    lines = ["eomc = 1", 'name = "row"', "[coordinates]", *(f"{x} = {{}}" for x in names)]
    lines += ["[energy]", f'kinetic = "{" + ".join(f"{x}_dot**2" for x in names)}"']
    lines += [f'potential = "{springs}"', "[run]", "batch = true"]
    (tmp_path / "row.toml").write_text("\n".join(lines), encoding="utf-8")
    m = eomc.load(tmp_path / "row.toml", tmp_path)
    q0, qd0 = starts(m, 20)
    for given in (q0, q0.astype(np.float32)):
        runs = m.simulate_batch(given, qd0, h=0.01, steps=3)
        assert np.array_equal(runs.q[:, 0], given) and np.array_equal(runs.qd[:, 0], qd0)
        for k in (0, 7, 19):
            alone = m.simulate(given[k], qd0[k], h=0.01, steps=3)
            np.testing.assert_allclose(runs.q[k], alone.q, rtol=0, atol=1e-15)


def test_a_bad_instance_leaves_the_others_alone() -> None:
    m = module("kepler_orbit")
    q0, qd0 = np.tile(m.start[0], (100, 1)), np.tile(m.start[1], (100, 1))
    good = m.simulate_batch(q0, qd0, steps=STEPS, every=7)
    q0[41] = 0.0  # at the centre, where the force is infinite
    runs = m.simulate_batch(q0, qd0, steps=STEPS, every=7)
    assert runs.status[41] == "not finite" and runs.steps[41] == 0
    assert np.array_equal(runs.q[41, 0], q0[41]) and np.isnan(runs.q[41, 1:]).all()
    others = np.arange(100) != 41
    assert set(runs.status[others]) == {"ok"}
    assert np.array_equal(runs.q[others], good.q[others])


@pytest.mark.parametrize("m_c", [-1.0, -3.0])
def test_a_singular_instance_is_reported_though_its_numbers_are_finite(m_c: float) -> None:
    """A cart of -1 kg and a pole of 2 kg: D is indefinite, and elimination goes through.

    Of -3 kg: its first pivot is negative, whatever the state; the second one is positive then.
    """
    m = module("cartpole")
    q0, qd0 = starts(m, 70)
    masses = np.full(70, m.defaults["m_c"])
    q0[41, 1], masses[41] = 0.3, m_c
    with pytest.warns(RuntimeWarning, match="D is not positive definite"):
        alone = m.simulate(q0[41], qd0[41], steps=STEPS, params={"m_c": masses[41]})
    runs = m.simulate_batch(q0, qd0, steps=STEPS, params={"m_c": masses})
    assert (runs.status[41], runs.steps[41]) == (alone.status, alone.steps) == ("singular", 0)
    assert np.array_equal(runs.q[41, 0], q0[41]) and np.isnan(runs.q[41, 1:]).all()
    others = np.arange(70) != 41
    apart = m.simulate_batch(q0[others], qd0[others], steps=STEPS, params={"m_c": masses[others]})
    assert set(runs.status[others]) == {"ok"}
    assert np.array_equal(runs.q[others], apart.q) and np.array_equal(runs.qd[others], apart.qd)
    shared = m.simulate_batch(q0[41], qd0[40:43], steps=STEPS, params={"m_c": m_c})
    assert shared.status[1] == "singular" and not shared.steps[1]
    assert m_c > -2 or (set(shared.status), shared.steps.any()) == ({"singular"}, False)


@pytest.mark.parametrize("method", ["rk4", "dp8"])
def test_positions_and_velocities_overflow_each_alone(method: str, tmp_path: Path) -> None:
    """Under a force, near the largest double; what the other makes of it is finite."""
    (tmp_path / "push.toml").write_text(
        "eomc = 1\nname = 'push'\n[coordinates]\nx = {}\n[parameters]\nf = 1e299\n[energy]\n"
        "kinetic = 'x_dot**2/2'\npotential = '-f*x'\n"
        f"[run]\nh = 0.01\nbatch = true\nmethod = '{method}'\n",
        encoding="utf-8",
    )
    m = eomc.load(tmp_path / "push.toml", tmp_path)
    largest = np.finfo(float).max
    q0, qd0 = np.zeros((9, 1)), np.zeros((9, 1))
    qd0[2] = largest
    q0[5], qd0[5] = largest, 1e300
    runs = m.simulate_batch(q0, qd0, steps=3)
    assert runs.steps.tolist() == [3, 3, 0, 3, 3, 0, 3, 3, 3]
    for k in (2, 5):
        with pytest.warns(RuntimeWarning, match="no longer be finite"):
            alone = m.simulate(q0[k], qd0[k], steps=3)
        assert runs.status[k] == alone.status == "not finite"
        assert runs.q[k, 0] == q0[k] and runs.qd[k, 0] == qd0[k] and np.isnan(runs.q[k, 1:]).all()


def test_an_instance_that_fails_on_the_way_keeps_its_last_state() -> None:
    m = module("mass_spring")
    k = np.full(9, m.defaults["k"])
    k[4] *= 1e6  # far beyond the stability limit: it grows until it overflows
    with pytest.warns(RuntimeWarning, match="not finite|no longer be finite"):
        alone = m.simulate(steps=400, every=5, params={"k": k[4]})
    runs = m.simulate_batch(steps=400, every=5, params={"k": k})
    assert 5 < alone.steps < 400 and runs.status[4] == alone.status == "not finite"
    assert runs.steps[4] == alone.steps
    rows = len(alone.t)
    assert np.allclose(runs.q[4, :rows], alone.q, rtol=1e-9)
    assert np.isnan(runs.q[4, rows:]).all() and np.isfinite(runs.q[5]).all()


@pytest.mark.parametrize(("real", "wide"), [("double", 3e6), ("float", 3e4)])
def test_wide_angles_are_reduced_as_in_a_single_run(real: str, wide: float) -> None:
    m = module("cartpole", real=f'"{real}"')
    q0 = np.array([[0.0, wide], [0.0, 1.0]])
    runs = m.simulate_batch(q0, steps=5)
    assert np.isfinite(runs.q).all()
    ulp = np.spacing(m.start[0].dtype.type(wide))
    np.testing.assert_allclose(runs.q[0], m.simulate(q0[0], steps=5).q, rtol=0, atol=5 * ulp)


@pytest.mark.parametrize(("real", "wide"), [("double", 2e16), ("float", 4e7)])
def test_angles_of_which_vectors_make_nonsense_go_to_libm(real: str, wide: float) -> None:
    """They are too wide to move; the cart moves by their sines and cosines."""
    m = module("cartpole", real=f'"{real}"')
    q0 = np.stack([np.zeros(9), np.linspace(1, 3, 9) * wide], axis=1).astype(m.dtype)
    qd0 = np.tile([0.3, 0.5], (9, 1)).astype(m.dtype)
    runs = m.simulate_batch(q0, qd0, steps=STEPS)
    for k in range(9):
        alone = m.simulate(q0[k], qd0[k], steps=STEPS)
        assert (runs.q[k, :, 1] == q0[k, 1]).all()
        # whether it has turned by h^2 a inside a step its numbers do not tell
        np.testing.assert_allclose(runs.qd[k], alone.qd, rtol=0, atol=1e-4)


def test_step_batch_in_place_and_into_out() -> None:
    m = module("cartpole")
    q0, qd0 = starts(m, 80)
    q, qd = q0.copy(), qd0.copy()
    for _ in range(3):
        assert not m.step_batch(q, qd, h=0.01).any()
    runs = m.simulate_batch(q0, qd0, h=0.01, steps=3)
    assert np.array_equal(q, runs.q[:, -1]) and np.array_equal(qd, runs.qd[:, -1])
    out = np.empty_like(q0), np.empty_like(qd0)
    m.step_batch(q0, qd0, h=0.01, out=out)
    assert np.array_equal(out[0], runs.q[:, 1])
    with pytest.raises(ValueError, match="qd: lies in the memory of q"):
        m.step_batch(q, q, h=0.01)


@pytest.mark.parametrize("count", [5, 2500])
def test_a_step_of_many_is_the_first_of_their_run(count: int) -> None:
    """Parameters and inputs of each instance's own, and shared ones; C takes 1,024 at once."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, count)
    masses, forces = np.linspace(1.0, 3.0, count), np.linspace(-1.0, 1.0, count)[:, None]
    for how in ({}, {"params": {"m_c": masses}}, {"u": forces}, {"u": 0.5, "params": {"l": 1.5}}):
        q, qd = q0.copy(), qd0.copy()
        status = m.step_batch(q, qd, **how)
        assert status.shape == (count,) and not status.any()
        runs = m.simulate_batch(q0, qd0, steps=1, **how)
        assert np.array_equal(q, runs.q[:, 1])
        assert np.array_equal(qd, runs.qd[:, 1])


def test_a_step_of_very_many_is_that_of_few() -> None:
    """From 20,000 on there are threads, and looks at Ctrl-C; who can not go on stays as it was."""
    m = module("cartpole_driven")
    q0, qd0 = starts(m, 20_000)
    masses = np.full(20_000, m.defaults["m_c"])
    masses[12_345] = -3.0
    q, qd = q0.copy(), qd0.copy()
    status = m.step_batch(q, qd, t=0.5, params={"m_c": masses})
    assert status.nonzero()[0].tolist() == [12_345]
    assert m.STATUS[status[12_345]] == "singular" and m.STATUS[0] == "ok"
    assert np.array_equal(q[12_345], q0[12_345]) and np.array_equal(qd[12_345], qd0[12_345])
    few = slice(12_300, 12_400)
    some, moving = q0[few].copy(), qd0[few].copy()
    assert np.array_equal(
        m.step_batch(some, moving, t=0.5, params={"m_c": masses[few]}), status[few]
    )
    assert np.array_equal(some, q[few]) and np.array_equal(moving, qd[few])


def test_tables_that_do_not_fit_are_refused_by_name() -> None:
    """C would read on behind them, or compute with what is no number."""
    m = module("cartpole_driven")
    (q0, qd0), nan = starts(m, 5), np.nan
    wrong = np.tile(list(m.defaults.values()), (5, 1))
    wrong[3, 1] = nan
    tries = {
        "qd: 4 instances where q has 5": lambda: m.step_batch(q0, qd0[:4].copy()),
        "params: 3 instances where": lambda: m.step_batch(q0, qd0, params={"l": np.ones(3)}),
        "u: 4 instances where q has 5": lambda: m.step_batch(q0, qd0, u=np.zeros((4, 1))),
        "params: not all numbers are": lambda: m.step_batch(q0, qd0, params=wrong),
        "u: not all numbers are finite": lambda: m.step_batch(q0, qd0, u=[nan]),
        "u: 'push' is not an array of": lambda: m.step_batch(q0, qd0, u="push"),
        "u: {'force': 1} is not an array": lambda: m.step_batch(q0, qd0, u={"force": 1}),
        "u: 20 instances where q0 has 5: a table over time": lambda: m.simulate_batch(
            q0, qd0, steps=20, u=np.zeros((20, 1))
        ),
        "q: an array of float32, shape (5, 2); moved in place": lambda: m.step_batch(
            q0.astype(np.float32), qd0
        ),
        "qd: an array of float64, shape (5, 2), not C-contiguous; moved": lambda: m.step_batch(
            q0, np.asfortranarray(qd0)
        ),
        "q: an array of float64, shape (2,); moved in place, it has": lambda: m.step_batch(
            q0[0], qd0[0]
        ),
        "q: a list; moved in place": lambda: m.step_batch(q0.tolist(), qd0),
        "qd: lies in the memory of q": lambda: m.step_batch(q0[:4], q0[1:]),
        "lies in the memory of q, where": lambda: m.step_batch(q0, q0),
        "u: shape (5, 3, 1), expected": lambda: m.simulate_batch(
            q0, qd0, steps=4, u=np.zeros((5, 3, 1))
        ),
    }
    for words, call in tries.items():
        with pytest.raises(ValueError, match=re.escape(words)):
            call()


def test_no_instances_in_c_read_nothing(tmp_path: Path) -> None:
    """No parameters are there either: a NULL that is followed would end the program."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    (tmp_path / "cartpole.toml").write_text(
        text.replace("[run]\n", "[run]\nbatch = true\n"), encoding="utf-8"
    )
    for file, made in fast_kit(eomc.sources(eomc.read(tmp_path / "cartpole.toml"))).items():
        (tmp_path / file).write_text(made, encoding="utf-8")
    call = "cartpole_rk4_batch(0, 0, 0, 0.01, 0, 5, 0, 0, 0, 0, 0, 1, 0, 0);"
    (tmp_path / "none.c").write_text(
        f'#include "cartpole.h"\nint main(void)\n{{\n    {call}\n    return 0;\n}}\n',
        encoding="utf-8",
    )
    subprocess.run(
        ["cc", "-std=c99", "none.c", "cartpole.c", "-o", "none", "-lm"], cwd=tmp_path, check=True
    )
    assert subprocess.run(["./none"], cwd=tmp_path).returncode == 0


def test_ctrl_c_stops_within_a_second_and_keeps_what_was_done() -> None:
    m = module("kepler_orbit")
    q0, qd0 = np.tile(m.start[0], (300, 1)), np.tile(m.start[1], (300, 1))
    threading.Timer(0.3, _thread.interrupt_main).start()
    begun = time.perf_counter()
    with pytest.raises(m.Interrupted) as stop:
        m.simulate_batch(q0, qd0, steps=10**9, every=10**8)
    assert time.perf_counter() - begun < 1.3
    assert stop.value.run.steps.sum() > 0 and "interrupted" in stop.value.run.message


@pytest.mark.parametrize("threads", [1, 2])
def test_instances_that_ctrl_c_came_before_are_at_their_start(threads: int) -> None:
    m = module("kepler_orbit")
    count = 30_000  # more than a thread takes at once
    q0 = np.tile(m.start[0], (count, 1)) * np.linspace(0.9, 1.1, count)[:, None]
    qd0 = np.tile(m.start[1], (count, 1))
    threading.Timer(0.3, _thread.interrupt_main).start()
    with pytest.raises(m.Interrupted) as stop:
        m.simulate_batch(q0, qd0, steps=10**6, every=10**6, threads=threads)
    run = stop.value.run
    assert run.steps[0] > 0 and run.steps[-1] == 0
    assert np.array_equal(run.q[-1, 0], q0[-1]) and np.isnan(run.q[-1, 1]).all()
    assert np.array_equal(run.qd[:, 0], qd0)


def test_progress_reaches_the_end() -> None:
    m = module("cartpole")
    seen: list[tuple[int, int]] = []
    q0, qd0 = starts(m, 64)
    m.simulate_batch(q0, qd0, steps=STEPS, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (64 * STEPS, 64 * STEPS)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"params": {"mass": [1.0, 2.0]}}, "params: 'mass'"),
        ({"params": {"m_c": [1.0, float("nan")]}}, "params: m_c"),
        ({"u": [1.0]}, "u: this scene has no inputs"),
        ({"q0": np.zeros((2, 3))}, "q0"),
        ({"q0": np.zeros((3, 2)), "params": {"m_c": [1.0, 2.0]}}, "params: 2 instances"),
        ({"q0": np.zeros((0, 2)), "qd0": np.zeros((0, 2))}, "q0: no instances"),
        ({"q0": np.zeros((3, 2)), "qd0": np.zeros((4, 2))}, "qd0: 4 instances where q0 has 3"),
        ({"params": {"m_c": "1"}}, "params: m_c: '1' is not an array of numbers"),
        ({"params": [{"m_c": 1}] * 2}, "params: [{'m_c': 1}, {'m_c': 1}] is not an array"),
        ({"every": 0}, "every"),
        ({"threads": 0}, "threads: 0 is not a whole number, 1 or more"),
        ({"threads": 1.5}, "threads: 1.5 is not"),
        ({"progress": 3}, "progress: 3 is not a function"),
        ({"method": "euler"}, "method"),
    ],
)
def test_wrong_arguments_are_named(given: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=re.escape(named)):
        module("cartpole").simulate_batch(steps=2, **given)


def test_only_scenes_that_ask_have_it() -> None:
    plain = eomc.sources(eomc.read(SCENES / "cartpole.toml"))
    assert "batch" not in plain.files["fast/cartpole.c"] and "batch.py" not in plain.files


def test_single_precision() -> None:
    m = module("double_pendulum", real='"float"')
    assert m.dtype == np.float32
    q0, qd0 = starts(m, 10)
    runs = m.simulate_batch(q0, qd0, steps=STEPS)
    assert runs.q.dtype == np.float32
    exact = module("double_pendulum").simulate_batch(q0, qd0, steps=STEPS)
    error = np.max(np.abs(runs.q - exact.q))
    assert 1e-9 < error < 1e-4  # that of single precision, no more and no less


@pytest.mark.skipif(
    shutil.which("gcc") is None or platform.system() != "Linux" or platform.machine() != "x86_64",
    reason="asks gcc about AVX2",
)
def test_single_precision_is_taken_at_full_width(tmp_path: Path) -> None:
    """Nothing is wider than a float and nothing is called from a tile's loop."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    file = tmp_path / "cartpole.toml"
    file.write_text(text.replace("[run]\n", '[run]\nreal = "float"\nbatch = true\n'))
    for name, content in fast_kit(eomc.sources(eomc.read(file))).items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    said = subprocess.run(
        ["gcc", "-std=c99", "-O3", "-mavx2", "-mfma", "-fno-math-errno", "-fno-trapping-math",
         "-fno-tree-slp-vectorize", "-fopt-info-vec-optimized", "-Wdouble-promotion",
         "-Wconversion", "-Werror", "-c", "cartpole.c"],
        cwd=tmp_path, check=True, capture_output=True, text=True,
    ).stderr  # fmt: skip
    lines = (tmp_path / "cartpole.c").read_text(encoding="utf-8").splitlines()
    at = next(k for k, line in enumerate(lines) if "_rk4_stages(" in line)
    end = lines.index("}", at)
    loops = [k for k, line in enumerate(lines[:end], 1) if k > at and "for (int i" in line]
    assert len(loops) == 10  # four of angles, four stages, the end, and who was no good
    for k in loops:
        assert re.search(rf"cartpole\.c:{k}:\d+: optimized: loop vectorized using 32 byte", said)


def test_no_loop_over_a_tile_has_a_rest(tmp_path: Path) -> None:
    """gcc sees that they end at a multiple of a block; where it can't it writes one."""
    scene = tmp_path / "cartpole.toml"
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    scene.write_text(text.replace("[run]\n", "[run]\nbatch = true\n"), encoding="utf-8")
    sources = eomc.sources(eomc.read(scene))
    for file, content in fast_kit(sources).items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    text = fast_kit(sources)[f"{sources.name}.c"]
    rounded = "used = (int)(m + CARTPOLE_BLOCK - 1) & -CARTPOLE_BLOCK"
    assert rounded in text
    (tmp_path / "blind.c").write_text(text.replace(rounded, "used = (int)m"), encoding="utf-8")
    sizes = []
    for file in (f"{sources.name}.c", "blind.c"):
        subprocess.run(
            [needs("gcc"), "-std=gnu99", "-O3", "-mavx2", "-mfma", "-fno-math-errno",
             "-fno-trapping-math", "-fno-tree-slp-vectorize", "-c", file, "-o", "made.o"],
            cwd=tmp_path, check=True,
        )  # fmt: skip
        sizes.append((tmp_path / "made.o").stat().st_size)
    assert sizes[0] < 0.9 * sizes[1]


@pytest.mark.parametrize("name", tiers(("cartpole", "kepler_orbit", "furuta_pendulum"), "cartpole"))
@pytest.mark.parametrize("real", ["double", "float"])
def test_strict_compilers_have_no_complaint(name: str, real: str, tmp_path: Path) -> None:
    """With angles that are turned and without, steppers by stages and by rates."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    run = f'[run]\nreal = "{real}"\nbatch = true\nmethod = ["rk4", "dp8"]\n'
    (tmp_path / "strict.toml").write_text(text.replace("[run]\n", run), encoding="utf-8")
    for file, content in fast_kit(eomc.sources(eomc.read(tmp_path / "strict.toml"))).items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    warnings = "-Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Werror".split()
    for compiler in filter(shutil.which, ("gcc", "clang")):
        given = [compiler, "-std=c99", *warnings, "-c", f"{name}.c", "-o", "out.o"]
        subprocess.run(given, cwd=tmp_path, check=True)


@pytest.mark.parametrize("inputs", [True, False])
def test_a_scene_without_parameters(tmp_path: Path, inputs: bool) -> None:
    file = tmp_path / "bare.toml"
    given = "[inputs]\nf = { signal = 0.5 }\n[forces]\nx = 'f'\n" if inputs else ""
    file.write_text(
        "eomc = 1\nname = 'bare'\n[coordinates]\nx = { start = 1.0 }\n"
        f"{given}[energy]\nkinetic = 'x_dot**2/2'\npotential = 'x**2/2'\n[run]\nbatch = true\n"
    )
    bare = eomc.load(file, tmp_path)
    runs = bare.simulate_batch([[1.0], [2.0]], [[0.0], [0.0]], h=0.01, steps=100, every=100)
    alone = bare.simulate([2.0], [0.0], h=0.01, steps=100, every=100)
    np.testing.assert_allclose(runs.q[1, -1], alone.q[-1], rtol=1e-14)


def test_instances_that_end_one_after_another_leave_the_last_alone() -> None:
    """Copies take the places of those that ended, and may have to be replaced themselves."""
    m = module("mass_spring")
    k = np.full(70, m.defaults["k"])
    k[:63] *= np.geomspace(
        1e6, 1e9, 63
    )  # the stiffer, the sooner it overflows; one of a tile stays
    k[66] *= 1e8
    runs = m.simulate_batch(steps=400, every=5, params={"k": k})
    stays = np.setdiff1d(np.arange(63, 70), [66])
    assert set(runs.status[stays]) == {"ok"} and len(set(runs.steps[:63])) > 10
    for at in (0, 31, 62, 66):
        with pytest.warns(RuntimeWarning):
            alone = m.simulate(steps=400, every=5, params={"k": k[at]})
        assert (runs.status[at], runs.steps[at]) == (alone.status, alone.steps)
        assert np.allclose(runs.q[at, : len(alone.t)], alone.q, rtol=1e-9)
    undisturbed = m.simulate_batch(steps=400, every=5, params={"k": k[stays]})
    assert np.array_equal(runs.q[stays], undisturbed.q)


def test_masked_numbers_are_refused_by_name() -> None:
    """They have no value; where nothing is masked, a masked array is as good as any."""
    many = module("cartpole")
    q, qd = (np.tile(x, (2, 1)) for x in many.start)
    masked = np.ma.array(q, mask=[[0, 1], [0, 0]])
    tries = {
        "q0": lambda: many.simulate_batch(masked, qd, steps=1),
        "q": lambda: many.step_batch(masked, qd),
        "qd": lambda: many.step_batch(q, masked, out=(q.copy(), qd.copy())),
        "params: m_c": lambda: many.step_batch(
            q, qd, params={"m_c": np.ma.array([1.0, 2.0], mask=[0, 1])}
        ),
        "params": lambda: many.step_batch(q, qd, params=np.ma.array(np.ones((2, 4)), mask=True)),
    }
    for name, call in tries.items():
        with pytest.raises(ValueError, match=rf"^{name}: \d of \d numbers are masked"):
            call()
    plain = many.simulate_batch(np.ma.array(q), qd, steps=3)
    assert np.array_equal(plain.q, many.simulate_batch(q, qd, steps=3).q)
