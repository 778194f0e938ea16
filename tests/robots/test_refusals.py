"""Refused robots: the message lists the ignored elements of the file, which may be the cause."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.mjcf import import_robot

NOTE = "not read of this file, which may be the cause:"
BALL = '<geom size=".1" pos=".3 0 0"/>'
PART = f'<body name="f"><joint name="k" axis="0 1 0"/>{BALL}</body>'
ONE = '<body name="a"><joint name="h" axis="0 1 0"/>{}</body>'
LINK = (
    '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    "</link>"
)
MOTOR = '<actuator><motor joint="k0"/></actuator>'
CASES = [  # a world with * in place of an ignored element, sections, the fault
    (f'<body name="s">{BALL}</body>*', "", "nothing moves"),
    (ONE.format("*"), "", "moves nothing that has inertia"),
    (ONE.format(f"{BALL}*"), MOTOR, 'there is no joint "k0"'),
    ("*", "", "there is no <body> in <worldbody>"),
]
MAKERS = ['replicate count="2"', 'attach model="m" prefix="p_"', 'composite type="cable"']


@pytest.mark.parametrize(("world", "sections", "fault"), CASES)
@pytest.mark.parametrize("maker", MAKERS)
def test_ignored_elements_that_create_others_are_named(
    tmp_path: Path, world: str, sections: str, fault: str, maker: str
) -> None:
    kind = maker.split()[0]
    inside = world.replace("*", f"<{maker}>{PART}</{kind}>")
    file = f"<mujoco><worldbody>{inside}</worldbody>{sections}</mujoco>"
    output, scene = import_robot(tmp_path, file)
    assert not scene and fault in output and NOTE in output
    listed = output[output.index(NOTE) :]
    assert f"  - <{kind}> and all that it adds, joints and masses too" in listed
    assert "let MuJoCo write the model as one file (MjSpec.to_xml)" in listed


def test_joints_of_other_namespaces_are_named(tmp_path: Path) -> None:
    joint = '<{0}joint name="j" type="screw"><parent link="a"/><child link="b"/></{0}joint>'
    links = LINK.format("a") + LINK.format("b")
    for prefix in ("drake:", "my_"):
        file = f'<robot name="r" xmlns:drake="d">{links}{joint.format(prefix)}</robot>'
        output, scene = import_robot(tmp_path, file)
        assert not scene and "2 links have no parent" in output
        assert f"; <{prefix}joint> is not read, only <joint> is" in output
        assert f"  - elements that URDF does not have: {prefix}joint in robot" in output
    output, scene = import_robot(tmp_path, f'<robot name="r">{links}</robot>')
    assert not scene and "only <joint> is" not in output and NOTE not in output


def test_options_that_name_ignored_elements_are_refused_with_the_list(tmp_path: Path) -> None:
    inside = ONE.format(f'{BALL}<replicate count="2">{PART}</replicate>')
    file = f"<mujoco><worldbody>{inside}</worldbody></mujoco>"
    for words in (("--lock", "k0=1"), ("--root", "f0"), ("--tip", "f1")):
        output, scene = import_robot(tmp_path, file, *words)
        assert not scene and NOTE in output and "<replicate>" in output
    output, scene = import_robot(tmp_path, file, "--name", "no name")
    assert not scene and NOTE not in output
    output, scene = import_robot(tmp_path, file)
    assert scene and NOTE not in output and "<replicate>" in output
