"""Imported forces that are too stiff for the default step size of a scene."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.mjcf import model
from support.session import Modules

from eomc.derive.lagrange import derive
from eomc.model.system import from_scene
from eomc.program import program
from eomc.robots import edit, stiffness, urdf
from eomc.robots.robot import Robot
from eomc.robots.scene_text import prepare_for_scene, scene_text
from eomc.scene.read import parse

WRIST = """<robot name="wrist">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.2 0 0.1"/><mass value="1.0"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
  <link name="hand"><inertial><origin xyz="0.02 0.01 0" rpy="1 2 3"/><mass value="0.05"/>
    <inertia ixx="1e-5" ixy="0" ixz="0" iyy="2e-5" iyz="0" izz="2e-5"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <origin rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/><dynamics damping="0.5" friction="0.2"/></joint>
  <joint name="pitch" type="{kind}"><parent link="upper"/><child link="hand"/>
    <origin xyz="0.4 0 0" rpy="0.4 0 0"/><axis xyz="0 1 1"/><limit lower="-1" upper="1"/>
    <dynamics friction="{friction}"/>{more}</joint>
</robot>"""


def wrist(folder: Path, friction: float, kind: str = "continuous", more: str = "") -> Robot:
    file = folder / "wrist.urdf"
    file.write_text(WRIST.format(friction=friction, kind=kind, more=more), encoding="utf-8")
    return urdf.read(file)


def reported(robot: Robot) -> str:
    return "\n".join(words for words in prepare_for_scene(robot).left_out if "friction" in words)


def test_stiff_friction_selects_adaptive_steps_and_is_named(tmp_path: Path) -> None:
    robot = wrist(tmp_path, 0.02)
    scene = tomllib.loads(scene_text(robot))
    assert scene["run"] == {"method": "auto"}
    assert "stiff: friction of pitch: at the start velocities decay" in reported(robot)
    assert 'friction = "stick"' in reported(robot)
    assert "friction_width" not in scene["body"][2]
    once = prepare_for_scene(robot)
    assert prepare_for_scene(once) == once


@pytest.mark.parametrize("friction", [0.0, 1e-5])
def test_friction_resolved_by_fixed_steps_changes_nothing(friction: float, tmp_path: Path) -> None:
    robot = wrist(tmp_path, friction)
    assert "run" not in tomllib.loads(scene_text(robot))
    assert not reported(robot)


def test_friction_too_stiff_for_adaptive_steps_is_smoothed_more(tmp_path: Path) -> None:
    robot = wrist(tmp_path, 50.0)
    upper, hand = tomllib.loads(scene_text(robot))["body"][1:]
    assert "friction_width" not in upper
    assert 0.01 < hand["friction_width"] < 10
    assert f"pitch ({hand['friction_width']:g} rad/s)" in reported(robot)


@pytest.mark.parametrize("more", ["", '<mimic joint="shoulder" multiplier="3" offset="0.2"/>'])
@pytest.mark.parametrize("kind", ["continuous", "prismatic"])
@pytest.mark.parametrize("free", [False, True])
def test_mass_matrix_equals_that_of_the_scene(
    kind: str, more: str, free: bool, tmp_path: Path
) -> None:
    robot = wrist(tmp_path, 0.0, kind, more)
    if free:
        robot = edit.with_base(robot, free=True)
    starts = iter((0.3, -0.4, 0.5, 0.6, -0.7, 0.8, 0.9, -0.2))
    bodies = tuple(
        replace(b, motions=tuple(replace(m, start=next(starts)) for m in b.motions))
        for b in robot.bodies
    )
    robot = replace(robot, bodies=bodies)
    if more:  # its joint stands at the value of its mimic
        *rest, hand = robot.bodies
        by_name = {m.name: m.start for m in robot.motions}
        (m,) = hand.motions
        assert m.mimics
        hand = replace(
            hand, motions=(replace(m, start=m.mimics.joint_position(by_name["shoulder"])),)
        )
        robot = replace(robot, bodies=(*rest, hand))
    rows = [m.name for m in robot.motions]
    computed = stiffness.mass_matrix(robot, rows)
    system = from_scene(parse(scene_text(robot), "wrist.toml"))
    state = {x.name: c.start for x, c in zip(system.q, system.coordinates, strict=True)}
    values = {**state, **dict.fromkeys((x.name for x in system.qd), 0.0), "t": 0.0}
    expected = program.matrix(program.build(derive(system)), "D", values)
    np.testing.assert_allclose(computed, expected, rtol=1e-12, atol=1e-14)


LIGHT = """<body name="arm">
<joint name="heavy" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body>
<body name="finger"><joint name="light" axis="0 1 0" damping="{damping}"/>
<geom size="0.01" pos="0.01 0 0"/></body>"""


def test_stiff_servos_and_dampers_select_adaptive_steps(tmp_path: Path) -> None:
    after = '<actuator><position name="lift" joint="light" kp="100" kv="0.5"/></actuator>'
    robot = prepare_for_scene(model(tmp_path, LIGHT.format(damping=0), after=after))
    assert robot.method == "auto"
    assert robot.left_out[-1].startswith("stiff: servo lift: ")
    assert "friction" not in robot.left_out[-1]
    robot = prepare_for_scene(model(tmp_path, LIGHT.format(damping=0.1)))
    assert robot.left_out[-1].startswith("stiff: damping of light: ")


def test_light_body_coupled_to_a_heavy_one_is_not_stiff(tmp_path: Path) -> None:
    after = '<equality><joint joint1="light" joint2="heavy" polycoef="0 2"/></equality>'
    assert not prepare_for_scene(model(tmp_path, LIGHT.format(damping=0.1), after=after)).method
    after = '<equality><weld body1="arm" body2="finger"/></equality>'
    assert not prepare_for_scene(model(tmp_path, LIGHT.format(damping=0.1), after=after)).method


@pytest.mark.slow
def test_run_of_an_imported_robot_with_stiff_friction_is_accurate(
    tmp_path: Path, modules: Modules
) -> None:
    run = modules.of_text(scene_text(wrist(tmp_path, 1.0))).simulate()
    assert run.status == "ok"
    assert run.estimate().resolved
