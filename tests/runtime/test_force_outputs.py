"""Outputs from multipliers and reactions: lambda_rod, pin_force_x, lambda_x_sticks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sympy
from support.fmus import VERSIONS, Host, exported, needs_fmpy, plain, rows
from support.session import Modules

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.model.system import System, from_scene, symbol
from eomc.report import equations
from eomc.scene.read import parse
from eomc.verify.check import check

pytestmark = pytest.mark.usefixtures("unoptimised_file")
SCENES = Path(__file__).parents[2] / "scenes"
BALL = """eomc = 1
name = "ball_on_rod"
[coordinates]
x = { start = 0.6, rate = 0.3 }
y = { start = -0.8, guess = true }
[parameters]
m = 1.5
l = 1.0
[inputs]
F = { signal = "sin(3*t)", limits = [-0.5, 0.5] }
[definitions]
x_half = "x/2"
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "9.81*m*y"
[forces]
x = "F"
[constraints]
rod = "x**2 + y**2 - l**2"
[outputs]
tension = { formula = "-2*l*lambda_rod", unit = "N" }
apart = "m*(x_ddot*x + (y_ddot + 9.81)*y)/l - min(max(F, -0.5), 0.5)*x/l - 2*l*lambda_rod"
mixed = "lambda_rod*x_ddot + dot(dot(x_half))*y"
[run]
duration = 1.0
"""


def scene_with_outputs(scene: str, outputs: str, run: str = "") -> str:
    text = (SCENES / f"{scene}.toml").read_text(encoding="utf-8")
    text = text.replace(f'"{scene}"', f'"{scene}_forces"', 1).replace(
        "\n[run]\n", f"\n[run]\n{run}\n"
    )
    return text.replace("\n[parameters]\n", f"\n[outputs]\n{outputs}\n\n[parameters]\n", 1)


@pytest.mark.slow
def test_tension_equals_that_of_the_multiplier(modules: Modules) -> None:
    m = modules.unoptimised(BALL.replace("[run]", "[run]\nbatch = true"))
    run = m.simulate(h=0.001)
    tension, rod = run.outputs["tension"], run.multipliers["rod"]
    np.testing.assert_allclose(tension, -2 * rod, rtol=1e-14)
    np.testing.assert_allclose(run.outputs["apart"], 0, atol=1e-13)
    v2 = np.sum(run.qd**2, axis=1)  # centripetal force, weight and drive along the rod
    F = np.clip(np.sin(3 * run.t), -0.5, 0.5)
    expected = 1.5 * v2 - 9.81 * 1.5 * run.q[:, 1] + F * run.q[:, 0]
    np.testing.assert_allclose(tension, expected, rtol=1e-12)
    runs = m.simulate_batch([[0.6, -0.8], [0.5, -0.7]], h=0.001, steps=50, every=10)
    np.testing.assert_allclose(runs.outputs["tension"], -2 * runs.multipliers["rod"], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
def test_check_compares_both_forms_and_derivatives(real: str, tmp_path: Path) -> None:
    system = from_scene(parse(BALL + f'linearize = true\nreal = "{real}"\n', "test.toml"))
    fast, portable = (eomc.load(system, tmp_path, form=form) for form in ("fast", "plain"))
    report = check(system, fast, plain=portable, states=4)
    rows = {row.name: row for row in report.results if "outputs" in row.name}
    assert {*rows} == {"outputs", "outputs: C, D"}
    assert all(row.passed for row in rows.values()), rows


@pytest.mark.slow
def test_reactions_in_the_plane(modules: Modules) -> None:
    outputs = 'h = "pin_force_x"\nv = "pin_force_y"\nturn = "pin_moment + q1"\none = "lambda_pin_y"'
    run = modules.unoptimised(scene_with_outputs("four_bar", outputs)).simulate(steps=50)
    outputs_by_row = np.stack([run.outputs[name] for name in ("h", "v", "turn")], axis=1)
    expected = run.reactions["pin"] + np.outer(run.q[:, 0], [0, 0, 1])
    np.testing.assert_allclose(outputs_by_row, expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(run.outputs["one"], run.multipliers["pin_y"], rtol=1e-13)


@pytest.mark.slow
def test_reactions_in_space_and_of_redundant_constraints(modules: Modules) -> None:
    names = [f"hinge_{kind}_{k}" for kind in ("force", "moment") for k in "xyz"]
    outputs = "\n".join(f'o{k} = "{name}"' for k, name in enumerate(names))
    rows = [f'{k} = "lambda_hinge_{k}"' for k in ("ru", "rv")]
    run = modules.unoptimised(scene_with_outputs("bricard", "\n".join([outputs, *rows]))).simulate(
        steps=20
    )
    outputs_by_row = np.stack([run.outputs[f"o{k}"] for k in range(6)], axis=1)
    np.testing.assert_allclose(outputs_by_row, run.reactions["hinge"], rtol=1e-11, atol=1e-11)
    for k in ("ru", "rv"):
        np.testing.assert_allclose(run.outputs[k], run.multipliers[f"hinge_{k}"], atol=1e-11)


STICKS = """eomc = 1
name = "held_block"
[coordinates]
x = { start = 1.0, friction = 2 }
z = {}
[energy]
kinetic = "(x_dot**2 + z_dot**2)/2"
potential = "5*x**2"
[outputs]
holds = "lambda_x_sticks"
[run]
tolerance = 1e-9
friction = "stick"
duration = 5.0
"""


@pytest.mark.slow
def test_multiplier_of_sticking_friction_is_an_output(modules: Modules) -> None:
    run = modules.unoptimised(STICKS).simulate()
    assert run.q[-1, 2] == 0 and abs(run.outputs["holds"][-1]) > 0.1
    np.testing.assert_allclose(run.outputs["holds"], run.multipliers["x_sticks"], atol=1e-13)
    with pytest.raises(SceneError, match="reactions are called lambda_x_sticks"):
        parse(STICKS.replace("lambda_x_sticks", "lambda_z_sticks"), "test.toml")


@pytest.mark.slow
def test_systems_from_python_have_force_outputs(modules: Modules) -> None:
    x, y = (symbol(name) for name in "xy")
    for pull in ("-2*lambda_rod", -2 * sympy.Symbol("lambda_rod")):
        system = System.make(
            "ball_in_python", {x: 0.6, y: -0.8}, "(x_dot**2 + y_dot**2)/2", 9.81 * y,
            constraints={"rod": x**2 + y**2 - 1}, outputs={"pull": pull},
        )  # fmt: skip
        run = modules.unoptimised(system).simulate(steps=9)
        np.testing.assert_allclose(run.outputs["pull"], -2 * run.multipliers["rod"], rtol=1e-14)
    system = System.make(
        "rubbed",
        {x: 1.0},
        "x_dot**2/2",
        5 * x**2,
        friction={x: 2},
        outputs={"h": "lambda_x_sticks"},
    )
    run = modules.unoptimised(system).simulate()
    np.testing.assert_array_equal(run.outputs["h"], run.multipliers["x_sticks"])


def test_name_declared_in_the_scene_has_precedence() -> None:
    text = BALL.replace("[parameters]\n", "[parameters]\nlambda_rod = 4.0\n")
    (tension, *_) = from_scene(parse(text, "test.toml")).outputs
    assert {s.name for s in tension.formula.free_symbols} == {"l", "lambda_rod"}


@pytest.mark.parametrize(
    ("formula", "message"),
    [
        ("dot(lambda_rod)", "it holds forces of constraints, whose rate is not computed"),
        ("lambda_pin", "multipliers and reactions are called lambda_rod"),
        ("2*rod", "'rod' can't be used here: multipliers and reactions are called lambda_rod"),
    ],
)
def test_invalid_formula_is_refused(formula: str, message: str) -> None:
    with pytest.raises(SceneError) as error:
        parse(BALL.replace('"-2*l*lambda_rod"', f'"{formula}"'), "test.toml")
    assert message in str(error.value)


def test_other_formulas_cannot_use_multipliers() -> None:
    with pytest.raises(SceneError, match="'lambda_rod' is not declared"):
        parse(BALL.replace('x = "F"', 'x = "F - lambda_rod"'), "test.toml")
    x = symbol("x")
    options = {"constraints": {"rod": x - 1}, "outputs": {"rate": "dot(lambda_rod)"}}
    with pytest.raises(EomcError, match="holds forces of constraints, whose rate is not computed"):
        System.make("rate", {x: 1.0}, "x_dot**2/2", **options)


def test_equations_show_multipliers() -> None:
    system = from_scene(parse(BALL, "test.toml"))
    assert "tension = -2⋅λ_rod⋅l" in str(equations.derive(system))


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_fmus_have_force_outputs(version: int) -> None:
    needs_fmpy()
    host = Host(exported(BALL, version))
    host.start()
    run = plain(BALL).simulate(steps=30, u=[0.0])  # an importer supplies the inputs
    values = rows(host, ["tension"], 3 * run.h, 10)
    assert np.array_equal(values[:, 0], run.outputs["tension"][::3])
