"""MJCF flags that disable forces, in one or several <option> elements, as in MuJoCo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.mjcf import model, refused, reported

from eomc.robots.robot import UNLIMITED, Robot

# kp and kv of a servo, a spring and a damper of a joint and of a tendon, half gravity compensation
INSIDE = """<body name="a" gravcomp="0.5"><joint name="j" axis="0 1 0" stiffness="2" damping="3"
  frictionloss="0.4" range="-1 1" limited="true" springref="20"/><geom size=".1" pos=".3 0 0"/>
  <body name="b" pos="0 0 .4"><joint name="k" axis="1 0 0" damping="0.2" springdamper="0.5 0.8"/>
  <geom size=".1" pos="0 .2 0"/></body></body>"""
AFTER = """<actuator><position name="s" joint="j" kp="3" kv="1" ctrlrange="-1 1" ctrllimited="true"
  armature="0.2" damping="0.3" group="2"/><motor name="m" tendon="t" gear="2" damping="0.1"
  group="4"/></actuator>
  <tendon><fixed name="t" stiffness="5" damping="6" armature="1"><joint joint="j" coef="1"/>
  <joint joint="k" coef="-2"/></fixed></tendon>
  <equality><joint joint1="j" joint2="k"/></equality>"""


def disable(*flags: str) -> str:
    """Return an <option> that disables the flags."""
    return "<option><flag " + " ".join(f'{flag}="disable"' for flag in flags) + "/></option>"


def enable(flag: str) -> str:
    return disable(flag).replace("disable", "enable")


def option(words: str) -> str:
    return f"<option {words}/>"


def group(numbers: str) -> str:
    return option(f'actuatorgroupdisable="{numbers}"')


SETTINGS = '<compiler autolimits="false" angle="radian"/>'


def read(folder: Path, *options: str) -> Robot:
    return model(folder, INSIDE, SETTINGS + "".join(options), AFTER)


def test_flag_remains_until_a_later_option_enables_it(tmp_path: Path) -> None:
    no, yes, vector = disable("gravity"), enable("gravity"), option('gravity="0 0 -2"')
    for options, gravity in (
        ((no,), 0.0), ((no, vector), 0.0), ((vector, no), 0.0), ((no, vector, yes), -2.0),
        ((vector, no, yes), -2.0), ((yes, vector, disable("spring")), -2.0), ((no, yes), -9.81),
    ):  # fmt: skip
        assert read(tmp_path, *options).gravity == (0, 0, gravity), options


def test_flags_disable_forces_of_joints_and_tendons(tmp_path: Path) -> None:
    plain = read(tmp_path)
    (j, k), (tendon,) = plain.motions, plain.tendons
    assert 0 not in (j.stiffness, j.friction, k.stiffness, tendon.stiffness, tendon.damping)
    assert j.limits == (-1, 1) and plain.bodies[0].lifted == 0.5
    assert len(plain.drives) == 2 and plain.couplings
    spring = read(tmp_path, disable("spring"))
    assert [m.stiffness for m in (*spring.motions, *spring.tendons)] == [0, 0, 0]
    assert [m.damping for m in spring.motions] == [m.damping for m in plain.motions]
    damper = read(tmp_path, disable("damper"))
    assert [m.damping for m in (*damper.motions, *damper.tendons)] == [0, 0, 0]
    assert [m.stiffness for m in damper.motions] == [m.stiffness for m in plain.motions]
    assert damper.drives == plain.drives  # kv belongs to the actuator's force
    assert damper.bodies[0].lifted == 0.5
    for both in ((disable("passive"),), (disable("spring"), disable("damper"))):
        passive = read(tmp_path, *both)
        assert not any(m.stiffness or m.damping for m in (*passive.motions, *passive.tendons))
        assert passive.bodies[0].lifted == 0
    assert read(tmp_path, disable("frictionloss")).motions[0].friction == 0
    limit = read(tmp_path, disable("limit"))
    assert limit.motions[0].limits == UNLIMITED and not limit.motions[0].note
    assert not read(tmp_path, disable("equality")).couplings
    constraint = read(tmp_path, disable("constraint"))
    assert not constraint.couplings and constraint.motions[0].limits == UNLIMITED
    assert constraint.motions[0].friction == 0
    clamp = read(tmp_path, disable("clampctrl"))
    assert plain.drives[0].limits == (-1, 1) and clamp.drives[0].limits == UNLIMITED


def test_disabled_actuators_keep_armature_and_damping(tmp_path: Path) -> None:
    plain = read(tmp_path)
    for options, left in (
        ((disable("actuation"),), []),
        ((group("2 4"),), []),
        ((group("2"), group("3")), ["m"]),
        ((group("4"), enable("actuation")), ["s"]),
    ):
        robot = read(tmp_path, *options)
        assert [d.name for d in robot.drives] == left, options
        assert robot.motions == plain.motions and robot.tendons == plain.tendons
        assert reported(robot, "actuators that the file disables")


def test_disabled_forces_are_reported(tmp_path: Path) -> None:
    robot = read(tmp_path, disable("spring", "limit", "equality"), disable("contact"))
    assert reported(robot, "switched off by <flag> of the file", "spring, equality, limit")
    assert reported(robot, "equality constraints that the file disables", "joint_j_k")
    assert reported(robot, "joints whose limits the file disables", ": j")
    assert reported(robot, "flags of MuJoCo's simulation", "contact=disable")
    assert not any("switched off" in words for words in read(tmp_path, enable("spring")).left_out)
    wrong = disable("spring").replace("disable", "off")
    assert 'spring="off" is not one of enable, disable' in refused(tmp_path, INSIDE, wrong, AFTER)


FLAGS = [
    (), (disable("spring"),), (disable("damper"),), (disable("spring", "damper"),),
    (disable("actuation"),), (disable("clampctrl"),),
    (disable("gravity"), option('gravity="0 0 -2"')),
    (group("2"),), (group("2"), group("4")),
]  # fmt: skip


@pytest.mark.slow  # runs in the tier that installs MuJoCo
@pytest.mark.parametrize("flags", FLAGS, ids=" ".join)
def test_accelerations_equal_those_of_mujoco(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: tuple[str, ...]
) -> None:
    mujoco = pytest.importorskip("mujoco", minversion="4")
    from test_robots_mujoco import in_python

    from eomc.robots import scene_text
    from eomc.robots.edit import with_input_limits

    after = AFTER[: AFTER.index("<equality>")]
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working folder
    inside = INSIDE.replace('frictionloss="0.4"', "").replace('limited="true"', 'limited="false"')
    robot = model(tmp_path, inside, SETTINGS + "".join(flags), after)
    text = scene_text.scene_text(
        with_input_limits(robot) if "limits" in str(robot.left_out) else robot
    )
    theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(theirs)
    data.qpos[:], data.qvel[:], u = (0.5, -0.3), (0.7, 0.9), {"s": 2.0, "m": 0.4}
    data.ctrl[:] = [*u.values()]
    mujoco.mj_forward(theirs, data)
    inputs = [u[d.name] for d in robot.drives]
    if robot.drives and robot.drives[0].limits != UNLIMITED:
        inputs[0] = min(inputs[0], 1.0)  # the stepper of the scene applies this limit
    ours = in_python(text)("acceleration", data.qpos, data.qvel, np.array(inputs))
    assert np.allclose(ours, data.qacc, rtol=1e-10, atol=0)
