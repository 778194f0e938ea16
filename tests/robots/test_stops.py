"""Joint limits of robot files as stops: their force and their restitution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.mjcf import import_robot
from support.session import tiers

import eomc

# a slide with range -0.4 to 0.5 m and an effort of 80 N, and a hinge without limits
URDF = """<robot name="pusher"><link name="rail"/>
<link name="cart"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-0.4" upper="0.5" effort="80" velocity="1"/></joint>
<joint name="turn" type="continuous"><parent link="cart"/><child link="arm"/><axis xyz="1 0 0"/>
</joint></robot>"""
MJCF = """<mujoco model="swing"><compiler angle="radian"/><option gravity="0 0 -10"/><worldbody>
<body name="bob"><joint name="q" axis="0 1 0" range="-0.5 0.7" limited="true"/>
<geom size="0.1" pos="0 0 -1" mass="3"/></body></worldbody></mujoco>"""

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def test_full_effort_pushes_a_joint_into_its_stop_by_the_stop_depth(tmp_path: Path) -> None:
    output, scene = import_robot(tmp_path, URDF, "--stops")
    assert (
        "at limits of positions [forces] pushes back" in output
        and "limits of 1 joint" not in output
    )
    assert "turn " not in scene.split("\n[forces]\n")[1].split("[[body]]")[0]
    m = eomc.load(eomc.read(tmp_path / "robot.toml"), tmp_path)
    depth = m.defaults["stop_depth_slide"]
    pulled = m.acceleration([0.5 + depth, 0.0], [-5.0, 0.0], u={"slide_force": 0, "turn_torque": 0})
    np.testing.assert_array_equal(pulled, 0)  # it leaves the stop faster than the stop pushes
    for at, force in ((0.5 + depth, 80.0), (-0.4 - depth, -80.0), (0.2, 0.0)):
        a = m.acceleration([at, 0.0], [0.0, 0.0], u={"slide_force": force, "turn_torque": 0})
        np.testing.assert_allclose(a, 0, atol=1e-9)


@pytest.mark.parametrize("side", tiers([1, -1], 1))
def test_restitution_of_a_stop_decreases_with_speed(side: int, tmp_path: Path) -> None:
    """Hunt and Crossley: 1 - 2/3 d v for the speed v, to first order, for any mass and k."""
    import_robot(tmp_path, URDF, "--stops")
    m = eomc.load(eomc.read(tmp_path / "robot.toml"), tmp_path)
    for v, d in ((0.1, 0.1), (0.1, 0.3), (0.02, 1.0)):
        run = m.simulate(
            q0=[0, 0], qd0=[side * v, 0], params={"stop_damping_slide": d}, h=1e-4,
            duration=0.6 / v,
        )  # fmt: skip
        back = -side * run.qd[-1, 0] / v
        assert back == pytest.approx(1 - 2 / 3 * d * v, abs=(d * v) ** 2)


def test_without_an_effort_the_weight_is_used(tmp_path: Path) -> None:
    """3 kg at 10 m/s^2 on a lever of 1 m: at speed v a bob enters by v sqrt(I/k)."""
    motor = '<actuator><motor joint="q" gear="50"/></actuator></mujoco>'  # without limits
    output, scene = import_robot(tmp_path, MJCF.replace("</mujoco>", motor), "--stops")
    assert "effort is not known" in output and "from weights: q (30 N m)" in output
    assert "from weights: q (30 N m)" in scene.replace("\n#", "")
    assert 'q = "30/stop_depth_turn*(max(0, -0.5 - q)' in scene and "max(0, q - 0.7)" in scene
    m = eomc.load(eomc.read(tmp_path / "robot.toml"), tmp_path)
    run = m.simulate(q0=[0.6], qd0=[3.0], h=1e-4, duration=3.0, u=0.0)
    assert run.status == "ok" and run.q.min() < -0.5
    inertia = float(np.squeeze(m.D([0.0])))
    assert 0.7 < run.q.max() < 0.7 + 3 * np.sqrt(inertia * 0.01 / 30)


@pytest.mark.parametrize(
    ("actuators", "of_joint", "effort"),
    [
        ('<motor joint="q" gear="50" ctrlrange="-1 1" ctrllimited="true"/>', "", 50),
        ('<motor joint="q" gear="-50" ctrlrange="-2 1" ctrllimited="true"/>' * 2, "", 200),
        (
            '<motor joint="q" gear="50" ctrlrange="-1 1" ctrllimited="true"/>',
            'actuatorfrcrange="-20 20" actuatorfrclimited="true"', 20,
        ),
    ],
    ids=["one", "two", "joint"],
)  # fmt: skip
@pytest.mark.parametrize("more", [[], ["--limits"]], ids=["notes", "acting"])
def test_effort_is_the_force_of_the_motors(
    actuators: str, of_joint: str, effort: float, more: list[str], tmp_path: Path
) -> None:
    text = MJCF.replace("<joint ", f"<joint {of_joint} ")
    text = text.replace("</mujoco>", f"<actuator>{actuators}</actuator></mujoco>")
    output, scene = import_robot(tmp_path, text, "--stops", *more)
    assert "effort is not known" not in output
    assert f"{effort}/stop_depth_turn*(max(0, -0.5 - q)" in scene


def test_effort_of_a_servo_is_its_force_range(tmp_path: Path) -> None:
    servo = '<position joint="q" kp="40" ctrlrange="-1 1" ctrllimited="true"/>'
    text = MJCF.replace("</mujoco>", f"<actuator>{servo}</actuator></mujoco>")
    for more, weight_is_used in (("", True), (' forcerange="-7 7" forcelimited="true"', False)):
        output, scene = import_robot(tmp_path, text.replace("/></act", f"{more}/></act"), "--stops")
        assert ("from weights: q (30 N m)" in output) == weight_is_used
        assert f"{30 if weight_is_used else 7}/stop_depth_turn*(max" in scene
        (tmp_path / "robot.toml").unlink()


def test_stops_need_limits(tmp_path: Path) -> None:
    output, scene = import_robot(
        tmp_path, MJCF.replace('limited="true"', 'limited="false"'), "--stops"
    )
    assert "no joint of this robot has limits" in output and not scene
