"""Reading MJCF: frames, joints, defaults, actuators, and what is left out."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from support.mjcf import BALL, BODY, CLOSE, PI, model, refused, reported

from eomc.robots.geometry import IDENTITY
from eomc.robots.robot import JointMotion, Law

# ---- frames and joints


def test_angles_are_degrees_unless_the_compiler_says_radian(tmp_path: Path) -> None:
    joint = '<joint range="-90 45" ref="30" springref="60" stiffness="2"/>'
    body = f'<body euler="0 0 90">{joint}{BALL}</body>'
    (a,) = model(tmp_path, body).bodies
    assert a.motions[0].start == pytest.approx(PI / 6, rel=CLOSE)
    assert a.motions[0].rest == pytest.approx(PI / 3, rel=CLOSE)
    assert a.motions[0].stiffness == 2  # always per radian
    assert a.motions[0].note == "from -1.5708 to 0.785398 rad"
    body = body.replace("90", "1").replace("30", "0.5")
    (b,) = model(tmp_path, body, '<compiler angle="radian"/>').bodies
    assert b.motions[0].start == 0.5
    assert b.rotation[0][0] == pytest.approx(math.cos(0.5), rel=CLOSE)


def test_five_notations_of_one_orientation_are_equal(tmp_path: Path) -> None:
    # A quarter turn about z, then one about the new x: x to y, y to z, z to x.
    orientations = [
        'quat="1 1 1 1"',
        'euler="90 0 90"',
        'axisangle="2 2 2 120"',
        'xyaxes="0 1 0 0 5 1"',
    ]
    compiler = '<compiler eulerseq="zyx"/>'
    for way in orientations:
        (a,) = model(tmp_path, f"<body {way}><joint/>{BALL}</body>", compiler).bodies
        assert np.array(a.rotation) == pytest.approx(
            np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), abs=1e-15
        ), way
    (a,) = model(tmp_path, f'<body zaxis="3 0 0"><joint/>{BALL}</body>').bodies
    assert a.rotation == ((0, 0, 1), (0, 1, 0), (-1, 0, 0))


def test_capitals_in_eulerseq_are_fixed_axes(tmp_path: Path) -> None:
    body = f'<body euler="10 20 30"><joint/>{BALL}</body>'
    (a,) = model(tmp_path, body, '<compiler eulerseq="XYZ"/>').bodies
    back = body.replace("10 20 30", "30 20 10")
    (b,) = model(tmp_path, back, '<compiler eulerseq="zyx"/>').bodies
    assert np.array(a.rotation) == pytest.approx(np.array(b.rotation), abs=1e-15)


def test_joint_position_moves_the_body_frame(tmp_path: Path) -> None:
    child = f'<body name="b" pos="0 0 1">{BALL}</body>'
    parts = '<joint pos="0 0 0.25"/><geom size="0.1" pos="0 0 0.5"/>'
    a, b = model(tmp_path, f'<body name="a" pos="1 0 0">{parts}{child}</body>').bodies
    assert a.offset == (1, 0, 0.25)
    assert a.center == (0, 0, 0.25)
    assert b.offset == (0, 0, 0.75)
    assert "(0, 0, 0.25)" in a.note


def test_ref_is_the_coordinate_at_the_pose_of_the_file(tmp_path: Path) -> None:
    hinge = f'<body name="a"><joint name="j" axis="0 0 1" ref="90"/>{BALL}</body>'
    slide = '<joint name="k" type="slide" axis="0 3 4" ref="5"/>'
    a, b = model(tmp_path, f'{hinge}<body name="b" pos="1 0 0">{slide}{BALL}</body>').bodies
    # At j = 0 the body is rotated by -90 degrees; at k = 0 it is 5 m behind along the axis.
    assert a.rotation == ((0, 1, 0), (-1, 0, 0), (0, 0, 1))
    assert a.motions[0].start == pytest.approx(PI / 2, rel=CLOSE)
    assert b.offset == pytest.approx((1, -3, -4), rel=CLOSE)
    assert b.axes == ((0, 0.6, 0.8),)
    assert b.motions[0].start == 5


def test_several_joints_of_a_body_become_a_chain_in_order(tmp_path: Path) -> None:
    joints = (
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>'
        '<joint name="y" axis="0 1 0" pos="0 0 1"/>'
    )
    child = f'<body name="b"><joint name="k"/>{BALL}</body>'
    robot = model(tmp_path, f'<body name="a" pos="0 0 3">{joints}{BALL}{child}</body>')
    assert [(b.name, b.parent, b.joint) for b in robot.bodies] == [
        ("a_x", "world", "prismatic"),
        ("a_z", "a_x", "prismatic"),
        ("a", "a_z", "revolute"),
        ("b", "a", "revolute"),
    ]
    assert [b.mass > 0 for b in robot.bodies] == [False, False, True, True]
    assert [b.offset for b in robot.bodies] == [(0, 0, 3), (0, 0, 0), (0, 0, 1), (0, 0, -1)]
    assert [m.name for m in robot.motions] == ["x", "z", "y", "k"]


def test_free_joint_starts_at_the_pose_of_the_body(tmp_path: Path) -> None:
    text = f'<body pos="1 2 3" euler="0 0 30"><freejoint name="root"/>{BALL}</body>'
    (a,) = model(tmp_path, text).bodies
    assert (a.joint, a.offset, a.rotation) == ("free", (0, 0, 0), IDENTITY)
    assert [m.name for m in a.motions] == ["x", "y", "z", "yaw", "pitch", "roll"]
    starts = [m.start for m in a.motions]
    assert starts == pytest.approx([1, 2, 3, PI / 6, 0, 0], abs=1e-15)


def test_coordinates_of_several_free_and_ball_joints_contain_joint_names(tmp_path: Path) -> None:
    free = f'<body><freejoint name="p"/>{BALL}</body><body><freejoint name="q"/>{BALL}</body>'
    ball = f'<body><joint name="b" type="ball" range="0 60"/>{BALL}</body>'
    robot = model(tmp_path, free + ball)
    assert [m.name for m in robot.motions][5:8] == ["roll_p", "x_q", "y_q"]
    assert [m.name for m in robot.bodies[2].motions] == ["yaw_b", "pitch_b", "roll_b"]
    assert "1.0472 rad at most" in robot.bodies[2].motions[0].note
    assert len({m.name for m in robot.motions}) == 15


def test_armature_of_a_free_joint_adds_mass_and_inertia(tmp_path: Path) -> None:
    text = '<body><joint type="free" armature="0.5"/><geom size="1" mass="5"/></body>'
    (a,) = model(tmp_path, text).bodies
    assert [m.armature for m in a.motions] == [0.5] * 3 + [0] * 3
    assert a.inertia == pytest.approx((2.5, 2.5, 2.5, 0, 0, 0), rel=CLOSE)
    assert "0.5" in a.note


def test_approximations_for_ball_joints_are_reported(tmp_path: Path) -> None:
    ball = f'<body><joint name="b" type="ball" armature="2" damping="3"/>{BALL}</body>'
    robot = model(tmp_path, f'<body name="a"><joint name="j"/>{BALL}{ball}</body>')
    assert [(m.armature, m.damping) for m in robot.bodies[1].motions] == [(2, 3)] * 3
    assert reported(robot, "damping of whole turns", "b")
    assert reported(robot, "exact armature of ball joints", "b")
    robot = model(tmp_path, ball)  # attached to the world: the armature is exact
    assert not reported(robot, "armature")
    assert robot.bodies[0].inertia[0] > 2


# ---- defaults


DEFAULTS = """<default>
  <joint damping="1" armature="2"/> <geom type="capsule" size="0.1 0.4" mass="1"/>
  <default class="a"> <joint damping="3"/>
    <default class="b"> <joint frictionloss="4"/> </default>
  </default>
</default>"""


def test_classes_inherit_and_childclass_applies_to_all_descendants(tmp_path: Path) -> None:
    geom = "<geom/>"
    text = (
        f"<body><joint/>{geom}</body>"
        f'<body childclass="a"><joint/>{geom}'
        f'<body><joint class="b"/>{geom}</body><body childclass="b"><joint damping="5"/>{geom}'
        f'<frame childclass="main"><body><joint/>{geom}</body></frame></body></body>'
        f"<body><freejoint/>{geom}</body>"
    )
    robot = model(tmp_path, text, DEFAULTS)
    numbers = [(m.damping, m.armature, m.friction) for m in robot.motions]
    assert numbers == [(1, 2, 0), (3, 2, 0), (3, 2, 4), (5, 2, 4), (1, 2, 0)] + [(0, 0, 0)] * 6


def test_element_overrides_leading_numbers_and_any_orientation(tmp_path: Path) -> None:
    defaults = '<default><geom type="box" size="0.1 0.2 0.3" mass="3" euler="90 0 0"/></default>'
    text = '<body><joint/><geom size="0.2"/></body><body><joint/><geom quat="1 0 0 0"/></body>'
    a, b = model(tmp_path, text, defaults).bodies
    assert a.inertia[:3] == pytest.approx((0.13, 0.08, 0.13), rel=CLOSE)  # rotated: x, z, y
    assert b.inertia[:3] == pytest.approx((0.13, 0.10, 0.05), rel=CLOSE)


# ---- actuators, key frames, what is left out


def test_motors_become_drives_with_their_gear(tmp_path: Path) -> None:
    actuators = """<actuator>
      <motor name="m" joint="j" gear="150" ctrlrange="-1 1" forcerange="-9 9"/> <motor joint="j"/>
      <general name="g" joint="j" gear="2" gainprm="3"/>
      <muscle name="p" joint="j" gear="4"/> <motor name="t" site="t"/>
    </actuator>"""
    robot = model(tmp_path, BODY, after=actuators)
    assert [(d.name, d.coordinate, d.gear) for d in robot.drives] == [
        ("m", "j", 150),
        ("j_motor", "j", 1),
        ("g", "j", 6),
        ("p", "j", 4),
    ]
    assert robot.drives[0].note == "input from -1 to 1; force from -9 to 9"
    assert "limits of actuators, kept as notes: m" in robot.left_out
    assert reported(robot, "laws of actuators", "p (muscle)")
    assert reported(robot, "actuators on sites", ": t")


def test_armature_and_damping_of_actuators_scale_with_gear_squared(tmp_path: Path) -> None:
    body = BODY.replace('name="j"', 'name="j" armature="1" damping="2"')
    motor = '<actuator><motor joint="j" gear="-3" armature="0.1" damping="0.2"/></actuator>'
    (motion,) = model(tmp_path, body, after=motor).motions
    assert (motion.armature, motion.damping) == pytest.approx((1.9, 3.8), rel=CLOSE)


def test_actuator_shortcut_does_not_inherit_the_law_of_another(tmp_path: Path) -> None:
    defaults = '<default><position kp="7" gear="5"/></default>'
    actuators = '<actuator><motor name="m" joint="j"/><general name="g" joint="j"/></actuator>'
    robot = model(tmp_path, BODY, defaults, actuators)
    assert [d.gear for d in robot.drives] == [5, 5]
    assert [d.law for d in robot.drives] == [None, Law((7, 0, 0), (0, -7, 0))]


HOME = """<keyframe> <key name="other" qpos="1"/>
  <key name="home" qpos="0.1 0.2 0.3 1 0 0 1 0.5 1 0 1 0 -0.25"/> </keyframe>"""


def test_key_frame_home_is_the_initial_state(tmp_path: Path) -> None:
    text = f"""<body name="a" pos="9 9 9"><freejoint/>{BALL}
      <body><joint name="h"/>{BALL}<body><joint name="b" type="ball"/>{BALL}
      <body><joint name="s" type="slide"/>{BALL}</body></body></body></body>"""
    with_short = model(tmp_path, text, after=HOME.replace(" -0.25", ""))
    assert reported(with_short, "key frame home", "13 numbers")
    assert with_short.motions[0].start == 9
    robot = model(tmp_path, text, after=HOME)
    starts = [m.start for m in robot.motions]
    assert starts == pytest.approx(
        [0.1, 0.2, 0.3, PI / 2, 0, 0, 0.5, 0, PI / 2, 0, -0.25], abs=1e-15
    )
    assert reported(robot, "key frames", "other")
    assert reported(robot, "singular at the start", "b")
    assert not reported(robot, "besides positions")
    moving = HOME.replace('"home"', '"home" qvel="0 1" ctrl="0 0"')
    assert reported(model(tmp_path, text, after=moving), "home has besides positions", ": qvel")


def test_ignored_elements_are_reported(tmp_path: Path) -> None:
    inside = """<light/><camera name="cam"/><site name="s1"/><site name="s2"/>
      <geom name="floor" type="plane" size="1 1 1"/>
      <body name="a" gravcomp="1"><joint name="j" stiffness="1 2" range="0 9"/>
        <geom name="ball" size="0.1" contype="0" conaffinity="0" colour="red"/>
        <composite type="cable"/><replicate count="2"><geom size="1"/></replicate><wheel/></body>
      <body name="m" mocap="true"><geom size="0.1"/></body>"""
    before = """<size nstack="3"/><option viscosity="1" timestep="0.1"><flag contact="disable"/>
      </option><asset><mesh file="deep/hand.stl"/></asset><nonsense/>"""
    after = """<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
      <equality><joint joint1="j" active="false"/></equality>
      <contact><exclude body1="a" body2="m"/></contact><sensor><clock name="c"/></sensor>"""
    robot = model(tmp_path, inside, before, after)
    for words in (
        ("lights",),
        ("cameras", "cam"),
        ("sites (2)", "s1, s2"),
        ("contacts of geoms", "floor"),
        ("shapes of geoms without contact", "ball"),
        ("stiffness in the square", "j"),
        ("limits of joints", "j"),
        ("attributes that MJCF does not have", 'colour of geom "ball"'),
        ("<composite>",),
        ("<replicate>",),
        ("elements that MJCF does not have", 'wheel in body "a"', "nonsense in mujoco"),
        ("mocap", "m"),
        ("fluid", "viscosity"),
        ("options", "timestep"),
        ("flags", "contact=disable"),
        ("assets", "mesh deep/hand.stl"),
        ("tendons", "t"),
        ("equality", "not active", "joint_j"),
        ("contact pairs", "exclude a and m"),
        ("sensors", "c"),
        ("settings", "size"),
    ):
        assert reported(robot, *words), words


def test_springdamper_gives_stiffness_and_damping_for_the_moving_mass(tmp_path: Path) -> None:
    """A ball of 2 kg about its center has 0.008 kg m^2: k = m/(t r)^2, d = 2 m/t."""
    ball = '<geom size="0.1" mass="2"/>'
    own = 'springdamper="0.2 1.5" stiffness="7" damping="7" armature="0.5"'

    def motions(joint: str, before: str = "", after: str = "") -> tuple[JointMotion, ...]:
        return model(tmp_path, f"<body>{joint}{ball}</body>", before, after).motions

    for joint, m in (
        ('<joint springdamper="0.2 1.5"/>', 0.008),
        ('<joint type="slide" springdamper="0.2 1.5"/>', 2.0),
        ('<joint type="ball" springdamper="0.2 1.5"/>', 0.008),
        ('<joint type="free" springdamper="0.2 1.5"/>', 2 / (1 / 0.008 + 1 / 2)),  # a mean value
        (f"<joint {own}/>", 0.508),
    ):
        for motion in motions(joint):
            assert motion.stiffness == pytest.approx(m / 0.3**2, rel=1e-12)
            assert motion.damping == pytest.approx(2 * m / 0.2, rel=1e-12)
    driven = '<actuator><motor joint="j" armature="0.25" gear="2" damping="0.5"/></actuator>'
    (motion,) = motions('<joint name="j" springdamper="1 1"/>', after=driven)
    assert motion.stiffness == pytest.approx(1.008) and motion.damping == pytest.approx(4.016)
    default = '<default><joint springdamper="0.2 1.5"/></default>'
    assert motions("<joint/>", default)[0].stiffness == pytest.approx(0.008 / 0.09)
    whole = model(tmp_path, f'<body><joint type="ball" springdamper="1 1"/>{ball}</body>')
    assert reported(whole, "damping and stiffness of whole turns")
    for wrong in ("0.2 0", "-1 1"):
        words = refused(tmp_path, f'<body><joint springdamper="{wrong}"/>{ball}</body>')
        assert "a time constant and a damping ratio, both positive" in words


def test_ignored_attributes_of_joints_actuators_and_couplings_are_reported(tmp_path: Path) -> None:
    inside = f"""<body name="a"><freejoint name="fly" align="true"/>{BALL}
      <body name="b"><joint name="turn" type="ball" damping="1" armature="0.1"/>{BALL}
      <body name="c"><joint name="j" springyield="2" actuatorfrcrange="-3 3"/>{BALL}
      <body name="d" sort="1"><joint name="k"/><frame tint="1">{BALL}</frame></body>
      </body></body></body>"""
    after = """<actuator><motor name="late" joint="j" delay="0.1"/> <lever joint="j"/>
        <motor name="slow" joint="j" damping="0 1"/> <motor name="spin" joint="turn"/></actuator>
      <tendon><spatial name="rope"/><fixed name="sum"><joint joint="k" coef="1"/></fixed></tendon>
      <equality><flex name="cloth"/><joint name="tied" joint1="turn" joint2="j"/>
        <joint name="held" joint1="k"/>
        <tendon name="wound" tendon1="rope" tendon2="sum"/></equality>"""
    robot = model(tmp_path, inside, after=after)
    for words in (
        ("attributes that MJCF does not have", 'sort of body "d"', "tint of frame"),
        ("alignfree", "fly"),
        ("damping of whole turns", "turn"),
        ("yield of the springs", "j"),
        ("force on joints, kept as notes", "j"),
        ("delays of actuators", "late"),
        ("elements that MJCF does not have", "lever in actuator"),
        ("damping in the square and cube of actuators", "slow"),
        ("actuators on free and ball joints", "spin"),
        ("equality constraints of other kinds", "flex cloth"),
        ("couplings of free and ball joints", "tied"),
        ("softness of equality constraints", "held"),
        ("couplings of tendons through space", "wound"),
    ):
        assert reported(robot, *words), (words, robot.left_out)


def test_long_lists_of_names_are_shortened_and_counted(tmp_path: Path) -> None:
    sites = "".join(f'<site name="s{i}"/>' for i in range(30))
    robot = model(tmp_path, BODY + sites)
    assert reported(robot, "sites (30): s0, s1", "s11 and 18 more")


def test_gravity(tmp_path: Path) -> None:
    assert model(tmp_path, BODY).gravity == (0, 0, -9.81)
    assert model(tmp_path, BODY, '<option gravity="1 2 3"/>').gravity == (1, 2, 3)
    off = '<option gravity="1 2 3"><flag gravity="disable"/></option>'
    assert model(tmp_path, BODY, off).gravity == (0, 0, 0)


def test_names_come_from_the_file_or_from_the_position(tmp_path: Path) -> None:
    text = f'<body><joint/>{BALL}</body><body name="body3"><joint/><joint/>{BALL}</body><body/>'
    robot = model(tmp_path, text)
    assert [b.name for b in robot.bodies] == ["body1", "body3_body3_joint", "body3", "body3_2"]
    names = [m.name for m in robot.motions]
    assert names == ["body1_joint", "body3_joint", "body3_joint_2"]


def test_thousand_nested_bodies_are_read(tmp_path: Path) -> None:
    deep = 1000
    text = "<body pos='1 0 0'><joint/><geom size='1'/>" * deep + "</body>" * deep
    assert len(model(tmp_path, text).bodies) == deep
