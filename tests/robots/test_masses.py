"""Masses of imported robots as parameters, and payloads at their tips."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from support.mjcf import import_robot, model

from eomc.derive.lagrange import derive
from eomc.model.system import from_scene
from eomc.program import program
from eomc.program.ir import evaluate
from eomc.robots.edit import with_masses
from eomc.robots.robot import Robot
from eomc.robots.scene_text import scene_text
from eomc.scene.read import parse

ARM = """
<body name="base"><geom size="0.2"/>
  <body name="upper" pos="0.1 0 0.2" euler="10 20 30">
    <joint name="a" axis="0 1 0" armature="0.1"/>
    <geom type="capsule" size="0.05" fromto="0 0 0 0.5 0 0.1"/>
    <body name="fore" pos="0.5 0 0.1" gravcomp="0.7"><joint name="b" axis="0 1 1"/>
      <geom type="box" size="0.1 0.2 0.3" euler="20 30 40" pos="0.1 0 0"/>
      <body name="tool" pos="0.2 0.1 0" euler="0 30 0">{more}</body>
    </body>
  </body>
</body>"""
BALL = """<body name="ball"><joint type="ball" armature="0.3"/>
<geom size="0.1" pos="0 0 0.2" mass="2"/></body>"""
TWO = '<body name="{}" pos="0 {} 0"><joint/><geom size="0.1" pos="0.2 0 0"/></body>'


def equations(robot: Robot, q: list[float], qd: list[float], values: Mapping[str, float]) -> dict:
    """Return D and bias at the given parameter values."""
    system = from_scene(parse(scene_text(robot), "robot.toml"))
    known = {p.name: p.value for p in system.parameters}
    assert values.keys() <= known.keys()
    known |= {**values, "t": 0.0}
    known |= dict(zip([x.name for x in (*system.q, *system.qd)], [*q, *qd], strict=True))
    functions = program.build(derive(system)).functions
    result = {name: np.array(evaluate(functions[name], known)[0]) for name in ("D", "bias")}
    return {"D": result["D"].reshape(len(q), len(q)), "bias": result["bias"]}


def test_masses_and_the_payload_are_parameters(tmp_path: Path) -> None:
    text = f"<mujoco><worldbody>{ARM.format(more='')}</worldbody></mujoco>"
    _, scene = import_robot(tmp_path, text, "--parameters", "masses")
    parsed = tomllib.loads(scene)
    assert list(parsed["parameters"]) == ["mass_upper", "mass_fore", "payload"]
    assert parsed["parameters"]["payload"] == {
        "value": 0, "unit": "kg", "note": "payload at tool",
    }  # fmt: skip
    mass = parsed["parameters"]["mass_fore"]["value"]
    bodies = {body["name"]: body for body in parsed["body"]}
    assert bodies["fore"]["mass"] == "mass_fore"
    assert all(e.endswith(f"*mass_fore/{mass!r}") for e in bodies["fore"]["inertia"])
    assert isinstance(bodies["base"]["mass"], float)  # it is fixed
    assert bodies["load"]["parent"] == "tool"


def test_equations_at_default_masses_equal_those_without_parameters(tmp_path: Path) -> None:
    robot = model(tmp_path, ARM.format(more=""))
    q, qd = [0.3, -0.4], [1.0, 0.8]
    plain, parametrized = equations(robot, q, qd, {}), equations(with_masses(robot), q, qd, {})
    for name, value in plain.items():
        np.testing.assert_allclose(parametrized[name], value, rtol=1e-12, atol=1e-14)


def test_armature_does_not_follow_the_mass(tmp_path: Path) -> None:
    robot = with_masses(model(tmp_path, BALL))
    (ball,) = (b for b in tomllib.loads(scene_text(robot))["body"] if b["name"] == "ball")
    own = 2 * 2 / 5 * 0.1**2
    for entry in ball["inertia"]:
        rotor, part = entry.split(" + ")
        assert float(rotor) == 0.3
        assert float(part.removesuffix("*mass_ball/2")) == pytest.approx(own, rel=1e-12)


@pytest.mark.parametrize(
    ("more", "tip", "names"),
    [
        ("", "", {"payload": "tool"}),
        ("", "upper", {"payload": "upper"}),
        (TWO.format("left", 1) + TWO.format("right", -1), "",
         {"payload_left": "left", "payload_right": "right"}),
        ('<body name="flange"/><body name="load"/>', "", {"payload": "load"}),
    ],
)  # fmt: skip
def test_positions_of_payloads(more: str, tip: str, names: dict[str, str], tmp_path: Path) -> None:
    robot = with_masses(model(tmp_path, ARM.format(more=more)), tip)
    loads = {b.parameter: b.parent for b in robot.bodies if b.parameter.startswith("payload")}
    assert loads == names
    parsed = tomllib.loads(scene_text(robot))
    assert loads.keys() <= parsed["parameters"].keys()
    parse(scene_text(robot), "robot.toml")


def test_parameter_names_avoid_collisions(tmp_path: Path) -> None:
    robot = with_masses(model(tmp_path, ARM.format(more="").replace('"a"', '"payload"')))
    assert {"payload_2", "mass_fore"} <= tomllib.loads(scene_text(robot))["parameters"].keys()


@pytest.mark.slow  # runs in the tier that installs MuJoCo
def test_changed_masses_agree_with_mujoco(tmp_path: Path) -> None:
    """Scale masses and inertias of the bodies, and add the payload to one body."""
    mujoco = pytest.importorskip("mujoco")
    robot = with_masses(model(tmp_path, ARM.format(more="")))
    masses = {b.parameter: b.mass for b in robot.bodies if b.parameter}
    load = '<body><inertial pos="0 0 0" mass="1.7" diaginertia="1e-12 1e-12 1e-12"/></body>'
    file = tmp_path / "loaded.xml"
    file.write_text(f"<mujoco><worldbody>{ARM.format(more=load)}</worldbody></mujoco>")
    theirs = mujoco.MjModel.from_xml_path(str(file))
    values = {"payload": 1.7}
    for name, factor in (("upper", 0.6), ("fore", 2.5)):
        theirs.body(name).mass[:] *= factor
        theirs.body(name).inertia[:] *= factor
        values[f"mass_{name}"] = masses[f"mass_{name}"] * factor
    data = mujoco.MjData(theirs)
    mujoco.mj_setConst(theirs, data)
    for q, qd in np.random.default_rng(2).uniform(-1.5, 1.5, (4, 2, 2)):
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(theirs, data)
        M = np.zeros((2, 2))
        mujoco.mj_fullM(theirs, data, M)
        computed = equations(robot, list(q), list(qd), values)
        np.testing.assert_allclose(computed["D"], M, rtol=1e-10)
        expected = data.qfrc_bias - data.qfrc_gravcomp
        np.testing.assert_allclose(computed["bias"], expected, rtol=1e-10, atol=1e-10)
