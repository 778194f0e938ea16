"""MJCF files that are refused, and included files."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from support.mjcf import refused

from eomc.base.errors import EomcError, SceneError
from eomc.cli.main import main as cli
from eomc.robots import mjcf
from eomc.robots.robot import JointMotion


@pytest.mark.parametrize(
    ("inside", "before", "words"),
    [
        (
            '<body name="a"><joint/><geom name="g" type="mesh" mesh="m"/></body>',
            "",
            ['geom "g"', "a follows from a mesh", "<inertial>"],
        ),
        (
            '<body name="a"><joint/><inertial pos="0 0 0" mass="1"/><geom type="mesh"/></body>',
            '<compiler inertiafromgeom="true"/>',
            ['inertiafromgeom="auto"'],
        ),
        ('<body><joint name="j" axis="0 0 0"/></body>', "", ['joint "j"', "length zero"]),
        ('<body quat="0 0 0 0"/>', "", ["quat has the length zero", "1 0 0 0"]),
        ('<body pos="1 2"/>', "", ['pos="1 2" has 2 numbers; it takes 3']),
        ('<body pos="1 2 z"/>', "", ["not a number"]),
        ('<body pos="1 2 nan"/>', "", ["finite"]),
        ('<body pos="1 2 1e200"/>', "", ["more than 1e+100, which can't be meant"]),
        ('<body pos="1 2 1_0"/>', "", ["not a number"]),
        ('<body><geom size="1e90" density="1e90"/></body>', "", ["inertia overflows"]),
        ('<body quat="1 0 0 0" euler="1 2 3"/>', "", ["given twice, by quat and euler"]),
        (
            '<body name="a"><inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/></body>',
            "",
            ["triangle", "balanceinertia"],
        ),
        (
            '<body><inertial pos="0 0 0" mass="1" fullinertia="1 1 1 2 0 0"/></body>',
            "",
            ["principal moment", "boundinertia"],
        ),
        ('<body name="a"><inertial pos="0 0 0" mass="-1"/></body>', "", ["mass of a", "negative"]),
        ('<body name="a"><inertial mass="1"/></body>', "", ["needs pos and mass"]),
        ('<body><geom size="0 1"/></body>', "", ["size of a sphere is 1 positive"]),
        ('<body><geom type="box" size="1 1"/></body>', "", ["size of a box is 3 positive"]),
        ('<body><geom type="capsule" fromto="0 0 0 0 0 1"/></body>', "", ["needs a size"]),
        ('<body><geom type="cone" size="1"/></body>', "", ['type="cone" is not one of sphere']),
        ('<body><geom size="1" density="-1"/></body>', "", ["not be negative"]),
        ('<body><joint damping="-1"/></body>', "", ["damping must not be negative"]),
        (
            '<body><geom type="ellipsoid" size="1 2 3" shellinertia="true"/></body>',
            "",
            ["shell of an ellipsoid"],
        ),
        ('<body name="a"/><body name="a"/>', "", ["body", 'two called "a"', "rename"]),
        ("<body><body><freejoint/></body></body>", "", ["only a body in <worldbody>"]),
        ("<body><freejoint/><joint/></body>", "", ["no other joints"]),
        ("<joint/>", "", ["the world can't have this"]),
        ("", "", ["no <body>"]),
        ('<replicate count="2"><body/></replicate>', "", ["no <body>", "<replicate>", "to_xml"]),
        ('<body childclass="no"/>', "", ['no default class "no"']),
        ("<body/>", '<compiler coordinate="global"/>', ["global", "older MuJoCo"]),
        ("<body/>", '<compiler eulerseq="xyw"/>', ["three of x, y, z"]),
        ("<body/>", "<default><default/></default>", ["needs a name"]),
        ("<body/>", '<include file="part.xml"/>', ['"part.xml" is not opened', "--include"]),
    ],
)
def test_messages_name_the_place_the_problem_and_the_remedy(
    tmp_path: Path, inside: str, before: str, words: list[str]
) -> None:
    text = refused(tmp_path, inside, before)
    for word in [*words, "model.xml:"]:
        assert word in text


def test_all_faults_are_reported_with_their_lines(tmp_path: Path) -> None:
    text = refused(
        tmp_path,
        '\n<body name="a"><joint axis="0 0 0"/>\n<geom size="-1"/>\n</body>',
        after='<actuator>\n<motor joint="nowhere"/></actuator>',
    )
    lines = [line.split("model.xml:")[1].split(":")[0] for line in text.splitlines()]
    assert lines == ["3", "4", "7"]
    assert 'no joint "nowhere"' in text


def test_other_files_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "model.xml"
    for text, words in (
        ('<robot name="r"/>', "URDF"),
        ("<html/>", "not MJCF"),
        ("<mujoco>", "not XML"),
        ("", "empty"),
        ('<!DOCTYPE m [<!ENTITY a "b">]><mujoco model="&a;"/>', "entities"),
        ('<!DOCTYPE m SYSTEM "/etc/passwd"><mujoco/>', "document type"),
    ):
        file.write_text(text)
        with pytest.raises(EomcError, match=words):
            mjcf.read(file)
    with pytest.raises(EomcError, match="no such file"):
        mjcf.read(tmp_path / "none.xml")


def write(folder: Path, **files: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.xml").write_text(text)
    return folder / "main.xml"


def test_included_files_replace_include(tmp_path: Path) -> None:
    main = write(
        tmp_path,
        main="""<mujoco><include file="set.xml"/>
            <worldbody><include file="arm.xml"/></worldbody></mujoco>""",
        set="""<x><compiler angle="radian"/>
            <default><joint damping="2"/></default></x>""",
        arm='<x><body name="a"><include file="joint.xml"/><geom size="0.1"/></body></x>',
        joint='<x><joint ref="0.5"/></x>',
    )
    (motion,) = mjcf.read(main, include=True).motions
    assert motion == JointMotion("a_joint", "rad", start=0.5, damping=2)
    with pytest.raises(SceneError, match="is not opened"):
        mjcf.read(main)


def test_no_file_outside_the_models_folder_is_opened(tmp_path: Path) -> None:
    secret = tmp_path / "secret.xml"
    secret.write_text('<mujoco><worldbody><body name="x"/></worldbody></mujoco>')
    folder = tmp_path / "model"
    body = "<worldbody><body/></worldbody>"
    for name in ("../secret.xml", str(secret), "link.xml"):
        main = write(folder, main=f'<mujoco><include file="{name}"/>{body}</mujoco>')
        if name == "link.xml":
            (folder / name).symlink_to(secret)
        with pytest.raises(SceneError, match="outside the folder"):
            mjcf.read(main, include=True)


def test_refused_include_causes_no_further_faults(tmp_path: Path) -> None:
    joint = '<actuator><motor joint="of_the_part"/></actuator>'
    main = write(tmp_path, main=f'<mujoco><include file="../part.xml"/>{joint}</mujoco>')
    for include, words in ((True, "outside the folder"), (False, "is not opened")):
        with pytest.raises(SceneError, match=words) as fault:
            mjcf.read(main, include=include)
        assert "of_the_part" not in str(fault.value)


def test_part_of_a_model_is_refused_as_such(tmp_path: Path) -> None:
    main = write(tmp_path, main="<mujocoinclude><body/></mujocoinclude>")
    words = "import the file that includes it, with --include"
    with pytest.raises(SceneError, match=words):
        mjcf.read(main)
    assert words in CliRunner().invoke(cli, ["import", str(main)]).output


def test_missing_or_repeated_include_is_reported(tmp_path: Path) -> None:
    main = write(tmp_path, main='<mujoco><include file="none.xml"/></mujoco>')
    with pytest.raises(SceneError, match=r'no file "none.xml"'):
        mjcf.read(main, include=True)
    main = write(tmp_path, main='<mujoco><include file="main.xml"/></mujoco>')
    with pytest.raises(SceneError, match="a second time"):
        mjcf.read(main, include=True)
