"""Elements and attributes outside the format, or ignored by eomc, are reported by name."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring, tostring

import pytest
from support.mjcf import model

from eomc.base.errors import SceneError
from eomc.robots import mjcf, urdf, xml
from eomc.robots.mjcf.file import ACTUATORS, SCHEMA

BEFORE = """<compiler angel="radian"><x/></compiler>
  <option gravty="0 0 -1"><flag gravitty="disable"/><flags/></option>
  <default clas="x"><joint dampng="1"/><Joint damping="3"/><tendon damp="1"/><position Kd="1"/>
  <default class="inner"><equality solreff="1"/></default></default><sensors/>"""
INSIDE = """<Body/><body name="a"><joint name="j"><limit/></joint><geom size=".1" weight="1"/>
  <inertial pos="0 0 0" mass="1"><com/></inertial><site name="s" pso="1 0 0"/>
  <frame sep="x"><geom size=".1" colour="1"/>1 2 3</frame></body>"""
AFTER = """<tendon><fixed name="t" stifness="1"><joint joint="j" coeff="2"/><Joint/></fixed>
  </tendon>  <equality><joint name="e" joint1="j" polycoeff="1"/><couple/></equality>
  <actuator><position name="el" joint="j" Kp="40" kv="3"/><servo/>
  <motor name="m" joint="j" forcerage="-1 1" kp="3"/></actuator>
  <keyframe><key name="home" ctr="1"/></keyframe><WORLD/>
  <contact foo="1"><pair any="1"/></contact>"""
ATTRIBUTES = [
    "foo of contact", "angel of compiler",
    "gravty of option", "gravitty of flag in option", "clas of default",
    "dampng of joint in default", "damp of tendon in default", "Kd of position in default",
    "solreff of equality in default in default", 'stifness of fixed "t"', 'kp of motor "m"',
    'coeff of joint in fixed "t"', 'polycoeff of joint "e"', 'Kp of position "el"',
    'forcerage of motor "m"', 'ctr of key "home"', 'weight of geom in body "a"',
    'pso of site "s"', 'sep of frame in body "a"', 'colour of geom in frame in body "a"',
]  # fmt: skip
ELEMENTS = [
    "x in compiler", "flags in option", "Joint in default", "sensors in mujoco",
    "Body in worldbody", 'limit in joint "j"', 'com in inertial in body "a"', 'Joint in fixed "t"',
    "couple in equality", "servo in actuator", "WORLD in mujoco",
]  # fmt: skip


def entries(left_out: tuple[str, ...], head: str) -> list[str]:
    """Return the entries of the line that begins with `head`, sorted."""
    lines = [words.partition(": ")[2] for words in left_out if words.startswith(head)]
    return sorted(lines[0].split(", ")) if lines else []


def test_elements_unknown_to_mjcf_are_reported_at_any_depth(tmp_path: Path) -> None:
    left = model(tmp_path, INSIDE, BEFORE, AFTER).left_out
    assert entries(left, "attributes that MJCF") == sorted(ATTRIBUTES)
    assert entries(left, "elements that MJCF") == sorted(ELEMENTS)
    assert entries(left, "text between tags") == ['<frame> in body "a"']
    assert not any(words.startswith(("options of", "flags of")) for words in left)


URDF = """<robot name="r" axis="1"><Link name="c"/><link name="base"/><link name="a" mass="2">
  <inertial mass="2"><com xyz="1 0 0"/><orgin xyz="1 0 0"/><mass value="2" unit="kg"/>
  <origin xyz="0 0 0"><rpy/></origin><inertia ixx="1" iyy="1" izz="1" iyx="2"/></inertial>
  <visual><anything at="all">1</anything></visual><colision/></link>
  <joint name="j" type="continuous" damping="3"><parent link="base" joint="x"/><child link="a"/>
  <axis xzy="0 0 1">0 0 1</axis><dynamics K="2"/><limits effort="1"/><dynamic/></joint>
  <joint name="k" type="fixed" damping="3"><parent link="a"/><child link="b"/></joint>
  <link name="b"/><drake:joint xmlns:drake="d" name="s"/><gazebo a="1"><b/>text</gazebo></robot>"""


def test_elements_unknown_to_urdf_are_reported_at_any_depth(tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(URDF, encoding="utf-8")
    left = urdf.read(file).left_out
    assert entries(left, "attributes that URDF") == sorted([
        "axis of robot", 'mass of link "a"', 'mass of inertial in link "a"',
        'unit of mass in inertial in link "a"', 'iyx of inertia in inertial in link "a"',
        'damping of joint "j" (and 1 more)', 'joint of parent in joint "j"',
        'xzy of axis in joint "j"', 'K of dynamics in joint "j"',
    ])  # fmt: skip
    assert entries(left, "elements that URDF") == sorted([
        "Link in robot", 'com in inertial in link "a"', 'orgin in inertial in link "a"',
        'rpy in origin in inertial in link "a"', 'colision in link "a"', 'limits in joint "j"',
        'dynamic in joint "j"', "drake:joint in robot",
    ])  # fmt: skip
    assert entries(left, "text between tags") == ['<axis> in joint "j"']


def test_groups_and_depths_of_an_outline() -> None:
    schema = xml.parse_format("a: x @g\n b: *\n c: y\n  d:\n b2: z", {"g": "u v"})
    assert schema.attributes == {"x", "u", "v"} and [*schema.children] == ["b", "c", "b2"]
    assert schema.children["b"].skipped and [*schema.children["c"].children] == ["d"]


# One of each element whose attributes affect the motion. Each value below changes what MuJoCo
# computes, so that the robot, or the report about it, must change.
WHOLE = """<mujoco><compiler/><option><flag/></option><default><default class="c">
<joint damping="9"/><geom density="9"/><general gear="9"/><equality active="false"/>
<tendon armature="9"/></default></default>
<worldbody><site name="w"/><body name="a"><joint name="j" stiffness="1" range="-1 1"/>
<geom size=".1 .2 .2"/><body name="b" pos="0 .1 .2" gravcomp=".1">
<inertial pos="0 0 0" mass="1" diaginertia="1 2 2.5"/><geom size=".1"/>
<joint name="k" axis="1 0 0"/><joint name="l"/><site name="s"/><body name="e" pos="0 .1 .2">
<frame><geom type="box" size=".1 .2 .3" euler="9 9 9"/></frame></body></body></body>
<body name="f"><freejoint/><geom size=".1"/></body></worldbody>
<tendon><fixed name="t" stiffness="1" range="0 1"><joint joint="j" coef="2"/></fixed></tendon>
<equality><connect body1="b" anchor="0 0 1"/><weld body1="b" body2="e"/>
<joint joint1="j" joint2="k"/><tendon tendon1="t"/></equality>
<actuator><general joint="k" gainprm="1 2" biasprm="1 1 1" ctrlrange="-1 1" actrange="-2 2"/>
<position joint="k" kp="5" forcerange="-9 9"/></actuator>
<keyframe><key name="home" qpos="0 0 0 0 0 0 1 0 0 0"/></keyframe></mujoco>"""
POSE = {
    "pos": "1 2 3", "quat": "1 1 0 0", "axisangle": "1 0 0 10", "euler": "10 20 30",
    "xyaxes": "0 1 0 1 0 0", "zaxis": "0 1 1",
}  # fmt: skip
RANGES = {"limited": "false", "range": "-3 3", "actuatorfrcrange": "-4 4"}
SOFT = {"class": "c", "active": "false"}  # softness is always reported
# by the path to an element
VALUES = {
    "compiler": {
        "angle": "radian", "eulerseq": "zyx", "inertiafromgeom": "true", "boundmass": "5",
        "inertiagrouprange": "3 4", "boundinertia": "5", "settotalmass": "7", "autolimits": "false",
        "alignfree": "true", "coordinate": "global",
    },
    "option": {
        "gravity": "0 0 1", "density": "1", "viscosity": "1", "wind": "1 0 0", "timestep": "1",
        "actuatorgroupdisable": "0", "integrator": "RK4",
    },
    "option/flag": dict.fromkeys(
        "gravity spring damper passive actuation clampctrl equality limit constraint contact "
        "frictionloss".split(),
        "disable",
    ),
    ".//body[@name='b']": {**POSE, "childclass": "c", "gravcomp": "1", "mocap": "true"},
    ".//frame": {**POSE, "childclass": "c"},
    ".//inertial": {**POSE, "mass": "2", "diaginertia": "2 2 2", "fullinertia": "1 1 1 0 0 0"},
    ".//body/joint[@name='j']": {
        **RANGES, "class": "c", "pos": "1 2 3", "type": "slide", "axis": "0 1 0", "armature": "1",
        "springdamper": "1 1", "stiffness": "2", "damping": "2", "ref": "1", "springref": "1",
        "springyield": "1", "frictionloss": "1", "actuatorgravcomp": "true",
        "solreffriction": "1 1", "solimpfriction": ".9 .9 .01",
    },
    ".//freejoint": {"align": "true"},
    ".//frame/geom": {
        **POSE, "class": "c", "type": "ellipsoid", "size": ".2 .2 .2", "mass": "2", "density": "2",
        "shellinertia": "true", "fromto": "0 0 0 0 0 1", "mesh": "m", "group": "9",
    },
    "tendon/fixed": {
        "limited": "false", "actuatorfrcrange": "-4 4",
        "class": "c", "frictionloss": "1", "springlength": "1", "springyield": "1",
        "stiffness": "2", "damping": "2", "armature": "1",
    },
    "tendon/fixed/joint": {"joint": "k", "coef": "3"},
    "equality/connect": {**SOFT, "body1": "e", "body2": "a", "anchor": "0 1 0", "site1": "s"},
    "equality/weld": {
        **SOFT, "body1": "a", "body2": "f", "anchor": "0 1 0", "relpose": "1 1 1 1 0 0 0",
        "site1": "s",
    },
    "equality/joint": {**SOFT, "joint1": "l", "joint2": "l", "polycoef": "0 2"},
    "equality/tendon": {**SOFT, "tendon1": "x", "tendon2": "t", "polycoef": "2"},
    "actuator/general": {
        "class": "c", "ctrlrange": "0 1", "forcerange": "0 1", "gear": "2", "joint": "l",
        "armature": "1", "damping": "1", "delay": "1", "dyntype": "integrator",
        "gaintype": "affine", "biastype": "affine", "gainprm": "2", "ctrllimited": "false",
    },
    "actuator/position": {
        "kp": "2", "kv": "2", "dampratio": ".5", "timeconst": "1", "inheritrange": "1",
        "forcelimited": "false",
    },
    "keyframe/key": {
        "qpos": "1 0 0 0 0 0 1 0 0 0", "ctrl": "1 0", "qvel": "1", "mpos": "1", "mquat": "1",
        "plastic": "1",
    },
}  # fmt: skip
# Attributes that affect contacts, drawings, meshes (refused), solvers, limits (which are notes),
# actuators whose laws are left out as a whole, or nothing without another attribute.
NO_EFFECT = {
    "compiler": """fusestatic discardvisual fitaabb assetdir meshdir texturedir strippath usethread
        savecanonical savecompiled saveinertial passthrough conflict convexhull exactmeshinertia
        balanceinertia""",
    ".//body[@name='b']": "sleep simple fuse",
    ".//body/joint[@name='j']": "group actuatorfrclimited margin solreflimit solimplimit",
    ".//freejoint": "group",
    ".//frame/geom": """contype conaffinity condim priority material friction solmix solref solimp
        margin gap surfacevel adhesion hfield fitscale rgba castshadow fluidshape fluidcoef""",
    "tendon/fixed": """range group actuatorfrclimited margin solreflimit solimplimit solreffriction
        solimpfriction""",
    "equality/connect": "site2 solref solimp",
    "equality/weld": "torquescale site2 solref solimp",
    "equality/joint": "solref solimp",
    "equality/tendon": "solref solimp",
    "actuator/general": """group nsample interp lengthrange cranklength cranksite slidersite refsite
        actdim actearly actlimited actrange forcelimited dynprm biasprm input ffrange velrange
        inheritrange tendon site body jointinparent""",
    "keyframe/key": "time act",
}


def read_tree(file: Path, root: Element) -> object:
    """Return the robot of a tree, or its faults."""
    file.write_bytes(tostring(root))
    try:
        return mjcf.read(file)
    except SceneError as fault:
        return str(fault)


@pytest.mark.parametrize("path", VALUES)
def test_attributes_that_affect_the_motion_are_read_or_reported(tmp_path: Path, path: str) -> None:
    file = tmp_path / "model.xml"
    plain, silent = read_tree(file, fromstring(WHOLE)), []
    for key, value in VALUES[path].items():
        root = fromstring(WHOLE)
        element = root.find(path)
        assert element is not None
        element.set(key, value)
        if read_tree(file, root) == plain:
            silent.append(key)
    assert not silent


@pytest.mark.parametrize("path", sorted({*VALUES, *NO_EFFECT} - {"option", "option/flag"}))
def test_every_attribute_of_read_elements_is_listed(path: str) -> None:
    places = re.sub(r"\[.*?\]", "", path).replace(".//", "worldbody/").split("/")
    element = SCHEMA
    for kind in places:
        below = element.children
        element = below[kind] if kind in below else below["body"].children[kind]
    general = SCHEMA.children["actuator"].children["general"].attributes
    known = {*VALUES[path], *NO_EFFECT.get(path, "").split(), "name", "user"}
    rest = element.attributes - known - (general if places[-1] == "position" else set())
    assert not rest


NAMES = 28  # the column in which MuJoCo's schema begins to list attributes
# Attributes of MuJoCo before 4, and of actuators and frames, which have all of them or are not
# checked.
OLDER = set(
    """apirate collision mpr_iterations mpr_tolerance passive sensornoise convexhull
    exactmeshinertia ls_iterations ls_tolerance""".split()
)


@pytest.mark.slow  # runs in the tier that installs MuJoCo
def test_schema_equals_that_of_mujoco() -> None:
    mujoco = pytest.importorskip("mujoco", minversion="4")
    path: list[tuple[str, xml.ElementSchema | None]] = []
    unknown, theirs = [], dict[int, set[str]]()
    elements: dict[int, tuple[str, xml.ElementSchema]] = {}
    for line in mujoco.mj_printSchema(False, False).splitlines():
        depth = (len(line) - len(line.lstrip())) // 3
        names = line.split()
        if 3 * depth < NAMES - 3 and names:
            kind, _, *names = names
            del path[depth:]
            kind = "worldbody" if kind == "(world)body" else kind
            around = path[-1][1] if path else xml.ElementSchema(children={"mujoco": SCHEMA})
            if kind == "worldbody":  # bodies have the elements of the world
                around = xml.ElementSchema(children={kind: SCHEMA.children[kind].children["body"]})
            element = (
                around.children.get(kind)
                if around and not (around.skipped or around.is_open)
                else None
            )
            if element is None and around and not (around.skipped or around.is_open):
                unknown.append(f"{kind} in {path[-1][0]}")
            path.append((kind, element))
        kind, element = path[-1] if path else ("", None)
        if element and not element.skipped:
            elements[id(element)] = kind, element
            theirs.setdefault(id(element), set()).update(names)
    for k, (kind, element) in elements.items():
        unknown += [f"{name} of {kind}" for name in theirs[k] - element.attributes]
        if kind not in ACTUATORS:
            unknown += [
                f"{name} of {kind}: more" for name in element.attributes - theirs[k] - OLDER
            ]
    assert not unknown
    compared = {kind for kind, _ in elements.values()}
    assert {*"option flag position dcmotor fixed weld key geom site inertial".split()} <= compared
