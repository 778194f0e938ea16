"""Servos, fixed tendons and gravcomp of MJCF: reading, writing, and comparison with MuJoCo."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from support import mjcf
from support.mjcf import BODY, model, refused, reported

import eomc
from eomc.derive.lagrange import derive
from eomc.model.system import from_scene
from eomc.program import program
from eomc.program.ir import evaluate
from eomc.robots.edit import cut, joint_stops, lock
from eomc.robots.robot import Law, Robot
from eomc.robots.scene_text import prepare_for_scene, scene_text
from eomc.scene.read import parse

GENERAL = '<general gainprm="3 1 2" biasprm="1 2 -5"/>'
AFFINE = GENERAL.replace("/>", ' biastype="affine"/>')
SERVO = '<position kp="2" kv="3"/>'
# a class, an actuator of it, its gain and bias in MuJoCo 4
SHORTCUTS = [
    ("", '<position kp="4" kv="0.5"{}/>', (4, 0, 0), (0, -4, -0.5)),
    ("", '<velocity kv="4"{}/>', (4, 0, 0), (0, 0, -4)),
    ("", '<damper kv="4" ctrlrange="0 1"{}/>', (0, 0, -4), (0, 0, 0)),
    ("", '<cylinder diameter="2" bias="7 8 9"{}/>', (np.pi, 0, 0), (7, 8, 9)),
    ("", AFFINE.replace("/>", "{}/>"), (3, 0, 0), (1, 2, -5)),
    ("", '<general gaintype="affine" gainprm="1 2 3"{}/>', (1, 2, 3), (0, 0, 0)),
    (GENERAL, "<position{}/>", (3, 0, 0), (0, -3, -5)),
    (GENERAL, "<velocity{}/>", (3, 0, 0), (0, 0, -3)),
    (GENERAL, "<cylinder{}/>", (3, 0, 0), (1, 2, -5)),
    (GENERAL, '<general biastype="affine"{}/>', (3, 0, 0), (1, 2, -5)),
    (AFFINE.replace("/>", ' gaintype="affine"/>'), "<position{}/>", (1, 0, 0), (0, -1, 0)),
    (SERVO, "<position{}/>", (2, 0, 0), (0, -2, -3)),
    (SERVO, '<position kp="9"{}/>', (9, 0, 0), (0, -9, -3)),
    (SERVO, '<general biasprm="1"{}/>', (2, 0, 0), (1, -2, -3)),
    (SERVO, "<velocity{}/>", (1, 0, 0), (0, 0, -1)),
    (SERVO, '<intvelocity actrange="-1 1"{}/>', (1, 0, 0), (0, -1, 0)),
    ('<position kp="5"/><velocity kv="4"/>', "<position{}/>", (1, 0, 0), (0, -1, 0)),
    ('<damper kv="5"/>', '<damper ctrlrange="0 1"{}/>', (0, 0, -5), (0, 0, 0)),
]


def actuator_sections(tag: str, default: str) -> tuple[str, str]:
    """Return the sections before and after the bodies."""
    on = tag.format(' name="u" joint="j"')
    return f"<default>{default}</default>", f"<actuator>{on}</actuator>"


@pytest.mark.parametrize(("default", "tag", "gain", "bias"), SHORTCUTS)
def test_laws_of_actuators(
    default: str, tag: str, gain: tuple, bias: tuple, tmp_path: Path
) -> None:
    (drive,) = model(tmp_path, BODY, *actuator_sections(tag, default)).drives
    assert drive.law == Law(gain, bias)


@pytest.mark.slow  # runs in the tier that installs MuJoCo
def test_laws_of_actuators_equal_those_of_mujoco(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco", minversion="4")
    for default, tag, gain, bias in SHORTCUTS:
        model(tmp_path, BODY, *actuator_sections(tag, default))
        theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
        affine = theirs.actuator_gaintype[0] == mujoco.mjtGain.mjGAIN_AFFINE
        gains = theirs.actuator_gainprm[0, :3] * (1, affine, affine)
        np.testing.assert_allclose(gains, gain, rtol=1e-14, err_msg=f"{default} {tag}")
        np.testing.assert_array_equal(theirs.actuator_biasprm[0, :3], bias, f"{default} {tag}")


ARM = """
<body name="upper" pos="0.3 0 0">
  <joint name="a" axis="0 1 0" ref="0.5" springref="0.2" armature="0.1" range="-1 2"/>
  <geom size="0.1" pos="0.5 0 0"/>
  <body pos="1 0 0" name="fore" gravcomp="0.7">
    <joint name="b" axis="1 1 0"/><joint name="s" type="slide" axis="0 0 1"/>
    <geom size="0.1 0.2 0.1" type="box" pos="0.5 0 0"/>
    <body name="hand" gravcomp="1" euler="0.1 0.2 0.3"><joint name="c" axis="0 1 0"/>
      <geom size="0.1" pos="0.1 0.2 0"/></body>
  </body>
</body>"""
BEFORE = """<compiler angle="radian"/><option gravity="1 -2 -9" integrator="RK4" timestep="0.001"/>
<default><default class="p"><position kp="7" gear="2" inheritrange="0.5"/></default></default>"""
AFTER = """
<tendon>
  <fixed name="sum" stiffness="10"><joint joint="a" coef="2"/><joint joint="b" coef="-1"/></fixed>
  <fixed name="a" stiffness="20" damping="2" springlength="-0.3 0.2" armature="0.3">
    <joint joint="b" coef="2"/><joint joint="s" coef="-1.5"/></fixed>
  <fixed name="idle"><joint joint="a" coef="1"/></fixed>
  <fixed name="pulled"><joint joint="a" coef="1"/><joint joint="s" coef="3"/></fixed>
  <spatial name="rope"/>
</tendon>
<actuator>
  <position name="p" joint="a" kp="3" dampratio="1" gear="2" armature="0.2" damping="0.4"
    forcerange="-1 2"/>
  <position name="q" tendon="sum" kp="5" dampratio="0.7" gear="-0.5" forcerange="-3 1"/>
  <position name="r" joint="a" class="p"/>
  <general name="g" joint="b" gear="-2" gaintype="affine" gainprm="2 1 3" biastype="affine"
    biasprm="0.3 1 -0.5"/>
  <velocity name="v" joint="s" kv="3" forcerange="-1 1" ctrlrange="-1 1"/>
  <damper name="d" joint="c" kv="2" ctrlrange="0 1"/>
  <motor name="m" tendon="pulled" gear="3"/>
  <intvelocity name="i" joint="c" kp="3" actrange="-1 1"/>
  <position name="lag" joint="b" kp="2" kv="0.3" timeconst="0.1"/>
</actuator>
<keyframe><key name="home" qpos="0.1 0.2 0.3 0.4" act="0.1 0.2" ctrl="1 2 3 4 5 6 7 0 9"/>
</keyframe>"""
ROPE = '<spatial name="rope"/>'  # MuJoCo refuses it without sites


def arm(folder: Path) -> dict:
    return tomllib.loads(scene_text(model(folder, ARM, BEFORE, AFTER)))


def test_servos_have_set_points_gains_and_forces(tmp_path: Path) -> None:
    scene = arm(tmp_path)
    assert {name: scene["definitions"][f"{name}_force"] for name in "qrgvdi"} == {
        "q": "q_kp*(q + 0.5*sum_) + 0.5*q_kv*dot(sum_)".replace("sum_", "sum"),
        "r": "r_kp*(r - 2*a)",
        "g": "2*g - 2*b*g - 6*b_dot*g + 2*g_kp*b + 2*g_kv*b_dot + 0.3",
        "v": "v_kv*(v - s_dot)",
        "d": "-2*c_dot*d",
        "i": "i_kp*(i - c)",
    }
    assert scene["parameters"]["lag_kv"] == {"value": 0.3, "unit": "N m s/rad"}
    assert scene["inputs"]["v"] == {
        "unit": "m/s", "signal": 5,
        "note": "set point of the rate of s; input from -1 to 1; force from -1 to 1",
    }  # fmt: skip
    bodies = {body["name"]: body for body in scene["body"]}
    assert bodies["upper"]["actuator"] == "2*p_force - q_force + 2*r_force + 3*m"
    assert bodies["fore"]["actuator"] == "v_force + 9*m"


def test_key_frame_home_sets_controls_and_activations(tmp_path: Path) -> None:
    robot = model(tmp_path, ARM, BEFORE, AFTER)
    assert [d.start for d in robot.drives] == [1, 2, 3, 4, 5, 6, 7, 0.1, 9]
    assert reported(robot, "besides positions and controls: act")  # of the actuator "lag"
    short = model(tmp_path, ARM, BEFORE, AFTER.replace(" 7 0 9", " 7"))
    assert reported(short, "the ctrl of the key frame home", "9 numbers")
    assert [d.start for d in short.drives] == [0, 0, 0, 0, 0, 0, 0, 0.1, 0]


def test_damping_ratio_refers_to_the_moving_mass(tmp_path: Path) -> None:
    """For a block on a free sledge m = 1*3/(1 + 3), divided by the gear squared."""
    inside = """<body name="sledge"><joint name="x" type="slide"/><geom size="0.1" mass="3"/>
      <body><joint name="y" type="slide"/><geom size="0.1" mass="1"/></body></body>"""
    servo = '<position joint="y" kp="12" gear="2" dampratio="0.5"/>'
    (drive,) = model(tmp_path, inside, after=f"<actuator>{servo}</actuator>").drives
    assert drive.law and drive.law.kv == pytest.approx(2 * 0.5 * (12 * 0.75 / 4) ** 0.5, rel=1e-14)
    assert drive.note == "a damping ratio of 0.5"


def test_unsupported_actuators_are_reported(tmp_path: Path) -> None:
    robot = model(tmp_path, ARM, BEFORE, AFTER)
    assert reported(robot, "activations of actuators", "i (integrator), lag (filterexact)")
    assert reported(robot, "tendons (2): fixed idle, spatial rope")
    actuators = """<actuator><pid name="pid" joint="j" ctrlrange="0 1"/>
      <general name="own" joint="j" dyntype="user"/><motor name="rope" tendon="rope"/></actuator>
      <tendon><spatial name="rope"/><fixed name="t" frictionloss="1" range="0 1" damping="1 2">
      <joint joint="j" coef="1"/></fixed></tendon>"""
    robot = model(tmp_path, BODY, after=actuators)
    for words in (
        ("laws of actuators", "pid (pid), own (general)"),
        ("limits of controls that are no inputs here", "pid"),
        ("actuators on tendons through space", "rope"),
        ("friction of tendons", ": t"),
        ("limits of length of tendons", ": t"),
        ("damping in the square and cube of tendons", ": t"),
    ):
        assert reported(robot, *words), (words, robot.left_out)


def test_tendons_and_gravity_compensation_are_energies(tmp_path: Path) -> None:
    scene = arm(tmp_path)
    assert scene["definitions"]["a_2"] == "2*b - 1.5*s"  # a joint has that name
    assert "idle" not in scene["definitions"]
    assert scene["energy"]["kinetic"] == "0.3*dot(a_2)**2/2"
    assert scene["energy"]["dissipation"] == "2*dot(a_2)**2/2"
    springs = "10*(sum - 0.4)**2/2 + 20*(max(0, a_2 - 0.2)**2 + max(0, -a_2 - 0.3)**2)/2".split()
    assert scene["energy"]["potential"].split()[: len(springs)] == springs
    assert (
        "fore_z" in scene["energy"]["potential"] and "upper_z" not in scene["energy"]["potential"]
    )


@pytest.mark.slow
def test_sum_of_many_weights_can_be_parsed(tmp_path: Path) -> None:
    bodies = '<body name="a" gravcomp="1" pos="1 0 0"><joint/><geom size="0.1"/>'.replace(
        ' name="a"', ""
    )
    robot = model(tmp_path, bodies * 200 + "</body>" * 200)
    text = tomllib.loads(scene_text(robot))["energy"]["potential"]
    assert text.count("_z") == 200 and max(map(len, text.splitlines())) <= 100
    eomc.scene.read.parse(scene_text(robot))


def test_repeated_preparation_changes_no_names(tmp_path: Path) -> None:
    robot = prepare_for_scene(model(tmp_path, ARM, BEFORE, AFTER))
    assert prepare_for_scene(robot) == robot


def equations(robot: Robot, state: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return D, bias and tau of a robot, from the program that becomes C."""
    system = from_scene(parse(scene_text(robot), "robot.toml"))
    known = {**dict.fromkeys((x.name for x in system.u), 0.0), **state, "t": 0.0}
    known |= {p.name: p.value for p in system.parameters}
    functions = program.build(derive(system)).functions
    out = {name: np.array(evaluate(functions[name], known)[0]) for name in ("D", "bias", "tau")}
    return {**out, "D": out["D"].reshape(len(out["bias"]), -1)}


@pytest.mark.parametrize(("joint", "row"), [("s", 2), ("a", 0)])
def test_locked_joint_is_a_constant_in_tendons(joint: str, row: int, tmp_path: Path) -> None:
    """The other coordinates have the equations of the whole robot at the locked value, at rest."""
    robot = model(tmp_path, ARM, BEFORE, AFTER)
    locked = lock(robot, {joint: 0.15})
    assert [t.name for t in locked.tendons] == [t.name for t in robot.tendons]
    state = {"a": 0.3, "b": -0.7, "s": 0.4, "c": 0.5, joint: 0.15}
    state |= {f"{q}_dot": v for q, v in zip("absc", (0.8, 1.2, 0.6, -0.9), strict=True)}
    state |= {f"{joint}_dot": 0.0, "p": 0.5, "q": 1.0, "g": 0.3, "m": 2.0}
    whole, reduced = equations(robot, state), equations(locked, state)
    whole["D"] = np.delete(whole["D"], row, axis=1)
    for name, value in whole.items():
        np.testing.assert_allclose(reduced[name], np.delete(value, row, axis=0), rtol=1e-12)


def test_tendon_of_locked_joints_is_left_out(tmp_path: Path) -> None:
    locked = lock(model(tmp_path, ARM, BEFORE, AFTER), {"s": 0.1, "b": 0.2})
    assert "tendons of what is cut off or locked: a_2" in locked.left_out
    assert [(t.name, t.terms, t.offset) for t in locked.tendons] == [
        ("sum", ((2.0, "a"),), -0.2),
        ("pulled", ((1.0, "a"),), pytest.approx(0.3)),
    ]
    assert [d.name for d in locked.drives] == ["p", "q", "r", "d", "m", "i"]


def test_joints_below_the_new_root_are_constants_in_tendons(tmp_path: Path) -> None:
    after = AFTER.replace('joint="s" coef="3"', 'joint="c" coef="3"')
    robot = cut(model(tmp_path, ARM, BEFORE, after), "fore")
    ((name, terms, offset),) = [(t.name, t.terms, t.offset) for t in robot.tendons]
    assert (name, terms, offset) == ("pulled", ((3.0, "c"),), 0.1)  # the initial value of a is 0.1


def test_effort_of_stops_includes_servos_and_tendons(tmp_path: Path) -> None:
    inside = """<body><joint name="j" range="-1 1"/><geom size="0.1"/>
      <body><joint name="k" range="-1 1"/><geom size="0.1" pos="1 0 0"/></body></body>"""
    after = """<tendon><fixed name="t"><joint joint="j" coef="-0.5"/><joint joint="k" coef="3"/>
      </fixed></tendon><actuator><position joint="j" gear="2" kp="9" forcerange="-7 5"/>
      <motor tendon="t" gear="10" ctrlrange="-1 1"/></actuator>"""
    stops = joint_stops(model(tmp_path, inside, after=after))
    assert [stop.effort for stop in stops] == [2 * 7 + 0.5 * 10, 3 * 10]


def test_without_drives_no_tendon_is_reported_as_idle(tmp_path: Path) -> None:
    text = f"<mujoco>{BEFORE}<worldbody>{ARM}</worldbody>{AFTER}</mujoco>"
    _, scene = mjcf.import_robot(tmp_path, text, "--no-drives")
    assert list(tomllib.loads(scene)["definitions"]) == ["sum", "a_2"]


@pytest.mark.parametrize(
    ("after", "message"),
    [
        ('<actuator><position joint="j" kp="x"/></actuator>', 'kp="x"'),
        ('<actuator><motor tendon="t"/></actuator>', 'there is no tendon "t"'),
        ('<tendon><fixed name="t"><joint joint="k"/></fixed></tendon>', 'there is no joint "k"'),
        ('<tendon><fixed name="t"><joint/></fixed></tendon>', "it needs joint"),
        ('<tendon><fixed name="t" damping="-1"><joint joint="j"/></fixed></tendon>', "negative"),
    ],
)
def test_faults(after: str, message: str, tmp_path: Path) -> None:
    fault = refused(tmp_path, BODY, after=after)
    assert message in fault and fault.count("error") == 1


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("--limits",)])
def test_motion_of_arms_agrees_with_mujoco(
    words: tuple[str, ...], tmp_path: Path, quickly_compiled: None
) -> None:
    """Compare accelerations at random states, and a run from the key frame with its controls."""
    mujoco = pytest.importorskip("mujoco", minversion="4")
    text = f"<mujoco>{BEFORE}<worldbody>{ARM}</worldbody>{AFTER}</mujoco>".replace(ROPE, "")
    mjcf.import_robot(tmp_path, text, *words)
    m = eomc.load(tmp_path / "robot.toml", tmp_path)
    theirs = mujoco.MjModel.from_xml_string(text)
    off = mujoco.mjtDisableBit
    theirs.opt.disableflags |= off.mjDSBL_CONSTRAINT
    if not words:
        theirs.opt.disableflags |= off.mjDSBL_CLAMPCTRL
        theirs.actuator_forcelimited[:] = False
    data, random = mujoco.MjData(theirs), np.random.default_rng(0)

    def put(u):
        data.ctrl[:] = u
        data.act[:] = u[theirs.actuator_actadr >= 0]
        if words:
            data.act[0] = np.clip(data.act[0], -1, 1)

    for q, qd, u in zip(*(random.normal(0, 1, (20, n)) for n in (4, 4, 9)), strict=True):
        data.qpos[:], data.qvel[:] = q, qd
        put(u)
        mujoco.mj_forward(theirs, data)
        computed = m.acceleration(q, qd, u=u)
        np.testing.assert_allclose(computed, data.qacc, atol=1e-12 * np.abs(data.qacc).max())
    mujoco.mj_resetDataKeyframe(theirs, data, 0)
    u = np.array([1, 2, 3, 4, 5, 6, 7, 0.1, 9])  # the signals of the scene
    data.ctrl[:] = np.where(np.arange(9) == 7, 0, u)  # the activation 0.1 of the integrator stays
    data.act[:] = u[7:]
    for _ in range(300):
        mujoco.mj_step(theirs, data)
    run = m.simulate(h=0.001, duration=0.3)
    np.testing.assert_allclose(run.q[-1], data.qpos, rtol=1e-9)
    np.testing.assert_allclose(run.qd[-1], data.qvel, rtol=1e-9)
