"""Flags of an MJCF file that switch forces off, over one or several <option>, as in MuJoCo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mjcf_text import model, refused, reported

from eomc.robots.robot import UNLIMITED, Robot

# kp and kv of a servo, a spring and a damper of a joint and of a tendon, a weight half compensated
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


def off(*flags: str) -> str:
    """An <option> that disables."""
    return "<option><flag " + " ".join(f'{flag}="disable"' for flag in flags) + "/></option>"


def on(flag: str) -> str:
    return off(flag).replace("disable", "enable")


def option(words: str) -> str:
    return f"<option {words}/>"


def group(numbers: str) -> str:
    return option(f'actuatorgroupdisable="{numbers}"')


SETTINGS = '<compiler autolimits="false" angle="radian"/>'


def read(folder: Path, *options: str) -> Robot:
    return model(folder, INSIDE, SETTINGS + "".join(options), AFTER)


def test_a_flag_outlasts_later_options_until_another_enables_it(tmp_path: Path) -> None:
    no, yes, vector = off("gravity"), on("gravity"), option('gravity="0 0 -2"')
    for options, gravity in (
        ((no,), 0.0), ((no, vector), 0.0), ((vector, no), 0.0), ((no, vector, yes), -2.0),
        ((vector, no, yes), -2.0), ((yes, vector, off("spring")), -2.0), ((no, yes), -9.81),
    ):  # fmt: skip
        assert read(tmp_path, *options).gravity == (0, 0, gravity), options


def test_flags_switch_off_what_acts_along_joints_and_tendons(tmp_path: Path) -> None:
    plain = read(tmp_path)
    (j, k), (tendon,) = plain.motions, plain.tendons
    assert 0 not in (j.stiffness, j.friction, k.stiffness, tendon.stiffness, tendon.damping)
    assert j.limits == (-1, 1) and plain.bodies[0].lifted == 0.5
    assert len(plain.drives) == 2 and plain.couplings
    spring = read(tmp_path, off("spring"))
    assert [m.stiffness for m in (*spring.motions, *spring.tendons)] == [0, 0, 0]
    assert [m.damping for m in spring.motions] == [m.damping for m in plain.motions]
    damper = read(tmp_path, off("damper"))
    assert [m.damping for m in (*damper.motions, *damper.tendons)] == [0, 0, 0]
    assert [m.stiffness for m in damper.motions] == [m.stiffness for m in plain.motions]
    assert damper.drives == plain.drives  # kv is the actuator's force
    assert damper.bodies[0].lifted == 0.5
    for both in ((off("passive"),), (off("spring"), off("damper"))):
        passive = read(tmp_path, *both)
        assert not any(m.stiffness or m.damping for m in (*passive.motions, *passive.tendons))
        assert passive.bodies[0].lifted == 0
    assert read(tmp_path, off("frictionloss")).motions[0].friction == 0
    limit = read(tmp_path, off("limit"))
    assert limit.motions[0].limits == UNLIMITED and not limit.motions[0].note
    assert not read(tmp_path, off("equality")).couplings
    constraint = read(tmp_path, off("constraint"))
    assert not constraint.couplings and constraint.motions[0].limits == UNLIMITED
    assert constraint.motions[0].friction == 0
    clamp = read(tmp_path, off("clampctrl"))
    assert plain.drives[0].limits == (-1, 1) and clamp.drives[0].limits == UNLIMITED


def test_actuators_that_are_switched_off_leave_their_armature_and_damping(tmp_path: Path) -> None:
    plain = read(tmp_path)
    for options, left in (
        ((off("actuation"),), []),
        ((group("2 4"),), []),
        ((group("2"), group("3")), ["m"]),
        ((group("4"), on("actuation")), ["s"]),
    ):
        robot = read(tmp_path, *options)
        assert [d.name for d in robot.drives] == left, options
        assert robot.motions == plain.motions and robot.tendons == plain.tendons
        assert reported(robot, "actuators that the file disables")


def test_what_a_file_switches_off_is_reported(tmp_path: Path) -> None:
    robot = read(tmp_path, off("spring", "limit", "equality"), off("contact"))
    assert reported(robot, "switched off by <flag> of the file", "spring, equality, limit")
    assert reported(robot, "equality constraints that the file disables", "joint_j_k")
    assert reported(robot, "joints whose limits the file disables", ": j")
    assert reported(robot, "flags of MuJoCo's simulation", "contact=disable")
    assert not any("switched off" in words for words in read(tmp_path, on("spring")).left_out)
    wrong = off("spring").replace("disable", "off")
    assert 'spring="off" is not one of enable, disable' in refused(tmp_path, INSIDE, wrong, AFTER)


FLAGS = [
    (), (off("spring"),), (off("damper"),), (off("spring", "damper"),),
    (off("actuation"),), (off("clampctrl"),), (off("gravity"), option('gravity="0 0 -2"')),
    (group("2"),), (group("2"), group("4")),
]  # fmt: skip


@pytest.mark.slow  # in the tier that installs MuJoCo
@pytest.mark.parametrize("flags", FLAGS, ids=" ".join)
def test_accelerations_are_those_of_mujoco(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: tuple[str, ...]
) -> None:
    mujoco = pytest.importorskip("mujoco", minversion="4")
    from test_robots_mujoco import in_python

    from eomc.robots import scene_text
    from eomc.robots.limits import with_input_limits

    after = AFTER[: AFTER.index("<equality>")]
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its warnings
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
    given = [u[d.name] for d in robot.drives]
    if robot.drives and robot.drives[0].limits != UNLIMITED:
        given[0] = min(given[0], 1.0)  # which the scene's stepper does
    ours = in_python(text)("acceleration", data.qpos, data.qvel, np.array(given))
    assert np.allclose(ours, data.qacc, rtol=1e-10, atol=0)
