"""Actuator limits of robot files as limits of inputs: units, gear, gain and signs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from support import mjcf

import eomc
from eomc.robots.robot import input_range, intersection

INERTIA = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""<robot name="pusher"><link name="rail"/>
<link name="cart"><inertial><mass value="2"/>{INERTIA}</inertial></link>
<link name="arm"><inertial><mass value="1"/>{INERTIA}</inertial></link>
<link name="tip"><inertial><mass value="1"/>{INERTIA}</inertial></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-0.4" upper="0.5" effort="80" velocity="1"/></joint>
<joint name="turn" type="continuous"><parent link="cart"/><child link="arm"/><axis xyz="1 0 0"/>
<limit effort="0" velocity="1"/></joint>
<joint name="end" type="continuous"><parent link="arm"/><child link="tip"/><axis xyz="1 0 0"/>
<limit effort="0.5" velocity="1"/></joint></robot>"""
HINGE = '<body><joint name="{name}" {more}/><geom size="0.1" mass="1"/></body>'
# gears, gains, control ranges, force ranges of actuators and joints; shared joints and servos
MOTORS = """
<motor name="geared" joint="a" gear="150" ctrlrange="-1 2"/>
<general name="gained" joint="b" gear="2" gainprm="-4" ctrlrange="-5 5" forcerange="-8 12"/>
<motor name="weak" joint="c" gear="-10" ctrlrange="-1 1"/>
<position name="servo" joint="d" kp="3" gear="2" ctrlrange="-1 1" forcerange="-7 7"/>
<motor name="first" joint="e" gear="3" ctrlrange="-1 1"/><motor name="second" joint="e"/>
<motor name="idle" joint="f" ctrlrange="-1 1" ctrllimited="false"/>
<motor name="odd" joint="g" ctrlrange="1 2" forcerange="-0.5 0.5"/>"""
LIMITS = {
    "geared": [-1, 2],  # of the control, before the gear
    "gained": [-3, 2],  # the force -4 u within -8 and 12
    "weak": [-0.4, 0.3],  # the joint takes -3 to 4 N m of the force -10 u
    "servo": [-1, 1],  # of its set point; force limits are part of its law
    "first": [-1, 1],  # and second; idle and odd have none
}


def motors_model(*joints: str) -> str:
    more = {"c": 'actuatorfrcrange="-3 4"', "e": 'actuatorfrcrange="-1 1"'}
    bodies = "".join(HINGE.format(name=name, more=more.get(name, "")) for name in joints)
    return (
        f'<mujoco model="motors"><option gravity="0 0 0"/><worldbody>{bodies}</worldbody>'
        f"<actuator>{MOTORS}</actuator></mujoco>"
    )


def import_scene(folder: Path, text: str, *words: str) -> tuple[str, dict]:
    """Import a robot; return the command's output and the parsed scene."""
    output, scene = mjcf.import_robot(folder, text, *words)
    return output, tomllib.loads(scene)


def input_limits(scene: dict) -> dict:
    return {name: u["limits"] for name, u in scene["inputs"].items() if "limits" in u}


def test_urdf_effort_limits_the_input(tmp_path: Path) -> None:
    output, scene = import_scene(tmp_path, URDF, "--limits")
    assert input_limits(scene) == {"slide_force": [-80, 80], "end_torque": [-0.5, 0.5]}
    assert "limits of drives: 2 of 3 inputs have them, and act within" in output
    assert "without are turn_torque" in output
    assert "limits of 3 joints, of position and speed: their values are in the notes" in output


def test_without_the_option_limits_are_notes(tmp_path: Path) -> None:
    output, scene = import_scene(tmp_path, URDF)
    assert not input_limits(scene) and "limits of 3 joints: their values" in output
    assert "at most 80 N" in scene["inputs"]["slide_force"]["note"]


def test_with_stops_only_speed_limits_are_notes(tmp_path: Path) -> None:
    output, scene = import_scene(tmp_path, URDF, "--limits", "--stops")
    assert "pushes back; those of speed are notes" in output and input_limits(scene)


def test_mjcf_limits_apply_before_the_gear(tmp_path: Path) -> None:
    output, scene = import_scene(tmp_path, motors_model(*"abcdefg"), "--limits")
    assert input_limits(scene) == LIMITS
    for words in (
        "limits of drives: 5 of 8 inputs have them, and act within; without are second, idle, odd",
        "limits of force on joints that several inputs, or tendons, drive: e",
        "ranges of actuators that exclude each other: odd",
    ):
        assert words in output, output
    assert "limits of actuators" not in output
    law = "servo_kp*(servo - 2*d)"
    assert scene["definitions"]["servo_force"] == f"min(max({law}, -7), 7)"
    (tmp_path / "free").mkdir()
    scene = import_scene(tmp_path / "free", motors_model(*"abcdefg"))[1]
    assert scene["definitions"]["servo_force"] == law and not input_limits(scene)


def test_joint_force_range_limits_its_servo(tmp_path: Path) -> None:
    text = motors_model("d").replace('name="d" ', 'name="d" actuatorfrcrange="-8 20"')
    servo = re.search("<position.*", MOTORS)[0]
    text = text.replace(MOTORS, servo)
    _, scene = import_scene(tmp_path, text, "--limits")
    assert scene["definitions"]["servo_force"] == "min(max(servo_kp*(servo - 2*d), -4), 7)"


@pytest.mark.parametrize("words", [("--no-drives",), ("--lock", "slide=0", "--lock", "end=0")])
def test_option_needs_an_input_with_limits(words: tuple[str, ...], tmp_path: Path) -> None:
    output, scene = import_scene(tmp_path, URDF, "--limits", *words)
    assert "--limits: no input of this robot has limits" in output and not scene


def test_intersection_of_ranges() -> None:
    assert input_range((-8, 12), -4) == (-3, 2) and input_range((-8, 12), 0) == (-np.inf, np.inf)
    assert intersection((-1, 2), (0, 5)) == (0, 2)
    assert intersection((0, 1), (1, 2)) is None


def test_input_limits_saturate_inputs(tmp_path: Path, quickly_compiled: None) -> None:
    import_scene(tmp_path, URDF, "--limits")
    m = eomc.load(tmp_path / "robot.toml", tmp_path)
    most, more = (m.acceleration([0, 0, 0], [0, 0, 0], u=[f, 0, 0]) for f in (80.0, 200.0))
    np.testing.assert_array_equal(most, more)
    assert most[0] == pytest.approx(80 / 4, rel=1e-12)


@pytest.mark.slow
def test_forces_equal_those_of_mujoco(tmp_path: Path, quickly_compiled: None) -> None:
    """Compare joint forces for controls within and beyond all ranges."""
    mujoco = pytest.importorskip("mujoco", reason="pip install '.[robots]'")
    text = motors_model(*"abcd").split('<motor name="first"')[0] + "</actuator></mujoco>"
    import_scene(tmp_path, text, "--limits")
    m = eomc.load(tmp_path / "robot.toml", tmp_path)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)
    for scale in (0.2, 1, 5, 20):
        for u, q in random.normal(0, scale, (20, 2, 4)):
            data.ctrl[:], data.qpos[:] = u, q
            mujoco.mj_forward(model, data)
            force = m.tau(q, np.zeros(4), u=u)
            np.testing.assert_allclose(force, data.qfrc_actuator, rtol=1e-12)
