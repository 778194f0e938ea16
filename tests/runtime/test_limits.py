"""Limits of inputs: saturation wherever inputs are used, and its report in runs."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support.session import Modules, tiers

import eomc
from eomc.base.errors import EomcError
from eomc.cli.main import main
from eomc.model.system import System, from_scene
from eomc.runtime.package import model_of
from eomc.scene.read import parse
from eomc.verify import equations
from eomc.verify.comparison import Comparison

SCENE = """eomc = 1
name = "limited"
[coordinates]
x = { unit = "m" }
theta = { unit = "rad", start = 0.3 }
[parameters]
most = 2.0
[inputs]
force = { unit = "N", signal = "20*theta + 3*theta_dot", limits = ["-most", "most*3/2"] }
push = { unit = "N", signal = "sin(9*t)", limits = [0, inf] }
free = { unit = "N m", signal = "cos(t)" }
[definitions]
both = "force + push"
[energy]
kinetic = "x_dot**2 + x_dot*theta_dot*cos(theta) + theta_dot**2"
potential = "9.81*cos(theta)"
[forces]
x = "both"
theta = "free"
[outputs]
pull = "force*x_dot"
[run]
linearize = true
h = 0.01
duration = 2.0
"""
BATCH = SCENE + 'batch = true\nmethod = ["rk4", "dp8", "euler"]\n'
IMPLICIT = SCENE + 'method = ["gauss4", "gauss8", "gauss16"]\n'
pytestmark = pytest.mark.usefixtures("unoptimised_file")
LOWER, UPPER = np.array([-2.0, 0.0, -np.inf]), np.array([3.0, np.inf, np.inf])
TABLE = np.random.default_rng(3).uniform(-9, 9, (200, 3))


@pytest.fixture(scope="module")
def limited(modules: Modules) -> ModuleType:
    return modules.unoptimised(BATCH)


def test_limits_are_returned_by_name(limited: ModuleType, cartpole: ModuleType) -> None:
    expected = {"force": (-2.0, 3.0), "push": (0.0, np.inf), "free": (-np.inf, np.inf)}
    assert limited.limits() == expected and cartpole.limits() == {}
    with pytest.raises(ValueError, match="params: 'mass' is not one of m_c, m_p"):
        cartpole.limits(params={"mass": 1.0})
    assert limited.limits({"most": 4.0}) == expected | {"force": (-4.0, 6.0)}
    assert all(type(x) is float for pair in limited.limits().values() for x in pair)
    with pytest.raises(ValueError, match="params: 'least' is not one of most"):
        limited.limits({"least": 1.0})


def test_equilibrium_beyond_limits_is_refused_and_names_them(limited: ModuleType) -> None:
    """The force that balances the pole exceeds its limits; one within them is solved for."""
    for options in (
        {"u": [0.0, 4.0, 0.0], "free": "force"},
        {"u": [9.0, 0.0, 0.0], "free": "free"},
    ):
        with pytest.raises(limited.MotionError, match=r"left on x, with force beyond its limits;"):
            limited.equilibrium([0.0, 0.0], **options)
    u = limited.equilibrium([0.0, 0.0], u=[0.0, 1.0, 0.0], free=["theta", "force"]).u
    assert u == pytest.approx([-1.0, 1.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("form", tiers(["fast", "plain"], "plain"))
@pytest.mark.parametrize("text", tiers([BATCH, IMPLICIT], BATCH), ids=lambda t: t[-30:-1])
def test_input_beyond_its_limit_acts_as_the_limit(text: str, form: str, tmp_path: Path) -> None:
    """Bit for bit, in every method, for constant inputs and a row per step."""
    module = eomc.load(from_scene(parse(text, "test.toml")), tmp_path, form=form)
    q, qd = module.start
    assert not np.array_equal(np.clip(TABLE, LOWER, UPPER), TABLE)
    for method in module.methods:
        for u in (TABLE, TABLE[1]):
            run = module.simulate(u=u, method=method)
            expected = module.simulate(u=np.clip(u, LOWER, UPPER), method=method)
            assert run.status == "ok" and np.array_equal(run.x, expected.x)
            assert np.array_equal(run.u, expected.u) and not expected.saturated.any()
            assert np.array_equal(run.outputs["pull"], expected.outputs["pull"])
    for name in ("acceleration", "tau", "power", "output", "applied"):
        call = getattr(module, name)
        assert np.array_equal(call(q, qd, u=[-7, -1, 9]), call(q, qd, u=[-2, 0, 9]))


def test_signals_are_limited_at_every_stage(modules: Modules, limited: ModuleType) -> None:
    by_hand = SCENE.replace("[energy]", 'a = "min(max(force, -most), 3*most/2)"\n[energy]')
    by_hand = by_hand.replace(', limits = ["-most", "most*3/2"]', "").replace(
        "force + push", "push"
    )
    by_hand = by_hand.replace(", limits = [0, inf]", "").replace('"push"', '"max(push, 0)"')
    reference = modules.unoptimised(by_hand.replace('x = "both"', 'x = "a + both"'))
    run, expected = limited.simulate(), reference.simulate()
    assert run.x == pytest.approx(expected.x, rel=1e-11, abs=1e-11)
    signals = np.array([20 * run.theta + 3 * run.theta_dot, np.sin(9 * run.t), np.cos(run.t)]).T
    assert run.u == pytest.approx(np.clip(signals, LOWER, UPPER), abs=1e-12)
    beyond = (signals < LOWER) | (signals > UPPER)
    assert np.array_equal(run.saturated, beyond) and beyond.any(axis=0).tolist() == [
        True,
        True,
        False,
    ]
    assert np.array_equal(run["force"], run.u[:, 0])


@pytest.mark.parametrize("u", [None, TABLE[:20][None], TABLE[0], TABLE[:60].reshape(3, 20, 3)])
def test_batch_uses_the_limits_of_each_instance(limited: ModuleType, u: Any) -> None:
    upper_limits = np.array([0.1, 2.0, 50.0])
    runs = limited.simulate_batch(
        np.tile(limited.start[0], (3, 1)), steps=20, params={"most": upper_limits}, u=u
    )
    for k in range(3):
        inputs = u if u is None or u.ndim == 1 else u[k % len(u)]
        run = limited.simulate(steps=20, params={"most": upper_limits[k]}, u=inputs)
        assert runs.q[k] == pytest.approx(run.q, rel=1e-12, abs=1e-12)
        assert runs.u[k] == pytest.approx(run.u, rel=1e-12, abs=1e-12)
        assert np.array_equal(runs.saturated[k], run.saturated)
    assert runs.saturated.shape == runs.u.shape and runs.saturated.any()
    assert not runs.saturated.all()


@pytest.mark.filterwarnings("ignore:.*Python function")
def test_saved_runs_store_inputs_and_saturation(limited: ModuleType, tmp_path: Path) -> None:
    run = limited.simulate(u=lambda t, q, qd: [30 * q[1], -1, 0], steps=40, every=7)
    assert run.saturated[:, 1].all() and run.u[:, 0].max() == 3.0
    run.save(tmp_path / "run.npz")
    for loaded in (limited.load_run(tmp_path / "run.npz"), pickle.loads(pickle.dumps(run))):
        assert np.array_equal(loaded.u, run.u) and np.array_equal(loaded.saturated, run.saturated)


def test_derivatives_are_zero_beyond_limits(limited: ModuleType) -> None:
    q, qd = limited.start
    B_within = limited.linearize(q, qd, u=[1, 1, 0])[1]
    B_beyond = limited.linearize(q, qd, u=[4, -1, 0])[1]
    assert np.all(B_within[2:] != 0) and np.all(B_beyond[:, :2] == 0)
    assert np.array_equal(B_beyond[:, 2], B_within[:, 2])


@pytest.mark.slow
def test_command_reports_saturation(tmp_path: Path) -> None:
    (tmp_path / "limited.toml").write_text(SCENE, encoding="utf-8")
    output = (
        CliRunner()
        .invoke(main, ["run", str(tmp_path / "limited.toml"), "--build", str(tmp_path)])
        .output
    )
    assert "push is saturated in 4" in output, output
    assert "free beyond" not in output


def test_scene_without_limits_has_none_of_their_code(
    limited: ModuleType, driven: ModuleType
) -> None:
    assert model_of(limited).functions.has_limits
    assert (
        not model_of(driven).functions.has_limits and not driven.simulate(steps=3).saturated.any()
    )
    q, qd = driven.start
    assert np.array_equal(driven.applied(q, qd, 0.3), driven.signal(q, qd, 0.3))
    assert driven.applied(q, qd, u=[1e9]).tolist() == [1e9]
    sources = eomc.sources(eomc.read("scenes/cartpole_driven.toml")).files
    assert not any(
        "applied(" in text or "fmin" in text for n, text in sources.items() if n[-1] in "ch"
    )


def test_systems_from_python_can_have_limits() -> None:
    options: dict[str, Any] = {
        "parameters": {"m": 1.0}, "inputs": {"F": "sin(t)", "G": 0}, "forces": {"x": "F + G"},
    }  # fmt: skip

    def system(limits: Any) -> System:
        return System.make("cart", ["x"], "m*x_dot**2/2", limits=limits, **options)

    limited = system({"F": ("-m", 2), "G": (None, np.inf)})
    assert str(limited.inputs[0].limited) == "Min(2, Max(F, -m))"
    assert limited.inputs[1].limited == limited.inputs[1].symbol
    assert str(limited.forces[0]) == "F_limited + G"
    for limits, message in (
        ({"H": (0, 1)}, "limits.H: 'H' is not among the inputs"),
        ({"F": 1}, "limits.F: must be the least and the largest value, .*, here 1"),
        ({"F": (2, "m")}, "the least value, 2, is not below the largest"),
        (
            {"F": ("x", 1)},
            "'x' can't be used here: 'limits' is made of numbers, constants and parameters",
        ),
    ):
        with pytest.raises(EomcError, match=message):
            system(limits)


class PerturbedModule:
    """Wrap the module; accelerations use slightly larger inputs."""

    def __init__(self, module: ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    def acceleration(self, *state: Any, u: Any, **options: Any) -> Any:
        return self._module.acceleration(*state, u=u, **options) + 1e-15 * np.max(u)


@pytest.mark.parametrize("perturbed", [False, True])
def test_check_detects_violated_limits(limited: ModuleType, perturbed: bool) -> None:
    module: Any = PerturbedModule(limited) if perturbed else limited
    comparison = Comparison(
        from_scene(parse(BATCH, "test.toml")), module, np.random.default_rng(0), 4
    )
    (row,) = comparison.report(equations.limit_checks)
    assert row.name == "limits of inputs" and row.passed is not perturbed, row


def test_batches_limit_a_whole_register_at_once() -> None:
    """Number by number took three to six times as long as the whole step."""
    files = eomc.sources(from_scene(parse(BATCH, "test.toml"))).files
    assert "limited_fmax_wide(" in files["fast/limited.c"]
    assert "fmax(x[i]" not in files["fast/limited.c"]
