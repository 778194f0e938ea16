"""Equality constraints of MJCF, compared with those of MuJoCo at random positions."""

import math
from pathlib import Path

import numpy as np
import pytest
import sympy
from support.mjcf import model, refused, reported

from eomc.base.errors import EomcError
from eomc.mechanism.assembly import assembled
from eomc.model.symbols import needed_definitions
from eomc.model.system import from_scene
from eomc.robots.edit import cut, lock
from eomc.robots.robot import body_pose
from eomc.robots.scene_text import prepare_for_scene, scene_text
from eomc.scene.read import parse

INSIDE = """
<body name="crank" pos="0 0 0.2" euler="10 20 0">
  <joint name="q1" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0.3" size="0.02"/>
  <body name="coupler" pos="0.4 0 0.3" euler="0 0 30">
    <joint name="q2" axis="0 1 1" pos="0.1 0 0.2" ref="20"/>
    <geom type="capsule" fromto="0 0 0 1 0 0.2" size="0.02"/>
    <frame pos="0.1 0 0" euler="0 30 0"><site name="end" pos="0.9 0 0.2" euler="40 0 0"/></frame>
  </body>
</body>
<body name="rocker" pos="0.9 0 0">
  <joint name="q3" axis="0 1 0" pos="0.1 0 -0.1"/>
  <joint name="slip" axis="0 1 0" type="slide" ref="0.3"/>
  <geom type="capsule" fromto="0 0 0 0.5 0 0.5" size="0.02"/>
  <site name="top" pos="0.5 0.1 0.5" euler="0 0 50"/>
</body>
<body name="wheel" pos="0 1 0"><joint name="g" axis="0 0 1" ref="15"/><joint name="h" axis="1 0 0"/>
  <joint name="k" axis="0 1 0" pos="0 0.1 0"/><geom size="0.1"/>
  <site name="hub" pos="0.1 0 0.1" euler="0 0 50"/></body>
"""
TENDONS = """
<tendon>
  <fixed name="belt"><joint joint="q1" coef="2"/><joint joint="g" coef="-1"/></fixed>
  <fixed name="chain"><joint joint="slip" coef="3"/></fixed>
  <spatial name="cable"><site site="end"/><site site="top"/></spatial>
</tendon>
"""
HARD = [
    '<connect name="pin" body1="coupler" body2="rocker" anchor="1 0 0.2"/>',
    '<connect body1="rocker" anchor="0.2 0.1 0"/>',
    '<connect site1="end" site2="top"/>',
    '<weld name="seam" body1="coupler" body2="wheel"/>',
    '<weld name="seam" body1="wheel" body2="coupler" anchor="0.1 0.2 0.3"/>',
    '<weld name="seam" body1="crank" body2="wheel" relpose="0.1 0.2 0.3 0.9 0.1 -0.2 0.4"/>',
    '<weld name="seam" site1="end" site2="hub"/>',
    '<joint joint1="g" joint2="q1" polycoef="0.1 2"/>',
    '<joint name="cubic" joint1="slip" joint2="q3" polycoef="0.01 0.1 0.5 -2 0.7"/>',
    '<joint joint1="slip"/>',
    '<joint joint1="g" polycoef="0.2"/>',
    '<tendon tendon1="belt"/>',
    '<tendon name="both" tendon1="belt" tendon2="chain" polycoef="0 1.5 0.5"/>',
    '<weld name="seam" body1="rocker" body2="wheel" anchor="0.2 -0.1 0.3" '
    'relpose="0.1 0.2 0.3 0.9 0.1 -0.2 0.4"/>',
    '<weld name="seam" body1="wheel" anchor="0.2 -0.1 0.3" relpose="0.1 0.2 0.3 1 0 0 0"/>',
    '<weld name="seam" body1="world" body2="wheel" anchor="0.2 0.1 0" relpose="1 2 3 0 0 1 1"/>',
    '<weld name="seam" body1="crank" body2="wheel" anchor="0.2 0.1 0" relpose="1 2 3 0 0 0 0"/>',
]


def scene_of(robot):
    """Write the scene of a robot and read it."""
    return from_scene(parse(scene_text(robot)))


def rows(system):
    """Return a function of the coordinates: the constraint residuals in the order of the file."""
    return numeric(system, [c.formula for c in system.constraints])


def numeric(system, expressions):
    """Return a function of the coordinates that evaluates the expressions."""
    for name, e in reversed(needed_definitions(system.definitions, expressions)):
        expressions = [x.xreplace({name: e}) for x in expressions]
    return sympy.lambdify([system.q], expressions)


def equality(*entries):
    return f"{TENDONS}<equality>{''.join(entries)}</equality>"


@pytest.mark.slow  # runs in the tier that installs MuJoCo
@pytest.mark.parametrize("entry", HARD)
def test_constraints_equal_those_of_mujoco(
    entry: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working folder
    system = scene_of(model(tmp_path, INSIDE, after=equality(entry)))
    theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(theirs)
    values = rows(system)
    assert [c.name for c in system.coordinates] == ["q1", "q2", "q3", "slip", "g", "h", "k"]
    for q in np.random.default_rng(0).uniform(-1, 1, (5, 7)):
        data.qpos[:] = q
        mujoco.mj_forward(theirs, data)
        equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        expected, computed = data.efc_pos[equal], np.array(values(q))
        assert len(computed) == len(expected)
        np.testing.assert_allclose(np.abs(computed[:3]), np.abs(expected[:3]), atol=1e-12)
    if "weld" in entry:  # Rotation constraints are formulated differently: both vanish together.
        (reaction,) = system.reactions
        q = _closed(values, numeric(system, reaction.branches), len(system.q))
        data.qpos[:] = q
        mujoco.mj_forward(theirs, data)
        np.testing.assert_allclose(data.efc_pos[3:6], 0, atol=1e-10)


def _closed(values, branches, n):
    """Solve the rotation constraints by the Gauss-Newton method."""
    rows_of = slice(3, 6)
    for start in np.random.default_rng(1).uniform(-1, 1, (100, n)):
        q = start
        for _ in range(50):
            slopes = [
                (np.array(values(q + 1e-6 * e)) - values(q - 1e-6 * e))[rows_of] / 2e-6
                for e in np.eye(n)
            ]
            q = q - np.linalg.lstsq(np.array(slopes).T, np.array(values(q))[rows_of], rcond=None)[0]
        if np.abs(np.array(values(q))[rows_of]).max() < 1e-13 and min(branches(q)) > 0.5:
            return q
    raise AssertionError("not closed")


@pytest.mark.slow
def test_constraints_are_satisfied_in_the_pose_of_the_file(tmp_path: Path) -> None:
    hard = [e for e in HARD if "site" not in e and "relpose" not in e and "0.1 2" not in e]
    hard = [e for e in hard if 'polycoef="0.2"' not in e and "0.01" not in e]
    system = scene_of(model(tmp_path, INSIDE, after=equality(*hard)))
    assert np.abs(rows(system)([c.start for c in system.coordinates])).max() < 1e-14
    assert not any(c.start_fixed for c in system.coordinates)


@pytest.mark.parametrize(
    ("ends", "points"),
    [
        ('body1="world" body2="a"', ((1, 2, 3), (0.1, 0.2, 0.3))),
        ('body1="a"', ((1, 2, 3), (0.1, 0.2, 0.3))),
        ('body1="hinged" body2="a"', ((0.5, 2, 3), (0.1, 0.2, 0.3))),
        ('body1="a" body2="hinged"', ((1, 2, 3), (-0.4, 0.2, 0.3))),
    ],
)
def test_relpose_is_relative_to_the_anchor_of_the_second_body(
    ends: str, points: object, tmp_path: Path
) -> None:
    """MuJoCo: x1 + R1 relpos = x2 + R2 anchor, and R2 = R1 R(relquat)."""
    bodies = (
        '<body name="a" pos="4 5 6" euler="10 20 30"><freejoint/><geom size="0.1"/></body>'
        '<body name="hinged"><joint pos="0.5 0 0"/><geom size="0.1"/></body>'
    )
    entry = f'<weld {ends} anchor="0.1 0.2 0.3" relpose="1 2 3 0 1 0 0"/>'
    (loop,) = model(tmp_path, bodies, after=equality(entry).replace(TENDONS, "")).loops
    assert loop.points == points
    np.testing.assert_allclose(loop.rotation, np.diag([1, -1, -1]), atol=1e-15)


def test_linear_coupling_of_two_joints_is_a_gear(tmp_path: Path) -> None:
    text = scene_text(model(tmp_path, INSIDE, after=equality(HARD[7])))
    assert 'joint       = "gear"\ncoordinates = ["q1", "g"]\nratio       = 2\n' in text


def test_ignored_constraints_are_reported(tmp_path: Path) -> None:
    robot = model(
        tmp_path, INSIDE, "<default><equality active='false'/></default>",
        equality(
            '<connect name="off" body1="rocker" anchor="0 0 0"/>',
            '<tendon name="on_cable" tendon1="cable" active="true"/>',
            '<connect name="soft" body1="rocker" anchor="0 0 0" solref="0.1 1" active="true"/>',
            '<flex name="cloth" flex="x"/>',
        ),
    )  # fmt: skip
    assert [loop.name for loop in robot.loops] == ["soft"]
    assert reported(robot, "not active", "off")
    assert reported(robot, "tendons through space", "on_cable")
    assert reported(robot, "solref, solimp", "soft")
    assert reported(robot, "of other kinds", "cloth")


FIXED_BODY = '<body name="{}" pos="0 {} 0"><geom size="0.1"/></body>'


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        ('<weld body1="left" body2="right"/>', "weld_left_right"),
        ('<weld body1="left"/>', "weld_left"),
        ('<connect body1="left" body2="right" anchor="0 0 0.1"/>', "connect_left_right"),
        ('<connect body1="rocker" body2="flange" anchor="0 0 0"/>', "connect_rocker_flange"),
        ('<connect body1="crank" anchor="0 0 0"/>', "connect_crank"),  # a point on its axis
        ('<joint joint1="q1" joint2="q1"/>', "joint_q1_q1"),
        ('<weld body1="left" body2="right" relpose="0 0 1 1 0 0 0"/>',
         "weld_left_right (open by 2.24 m)"),
    ],
)  # fmt: skip
def test_constant_constraints_are_left_out(entry: str, reason: str, tmp_path: Path) -> None:
    flange = '<body name="flange" euler="0 0 90"><geom size="0.1"/></body></body>'
    inside = INSIDE.replace('</body>\n<body name="wheel"', f'{flange}\n<body name="wheel"')
    inside += FIXED_BODY.format("left", 1) + FIXED_BODY.format("right", 3)
    robot = prepare_for_scene(model(tmp_path, inside, after=equality(entry, HARD[0])))
    assert [loop.name for loop in robot.loops] == ["pin"]
    assert not robot.couplings
    assert reported(robot, "constraints that no motion changes", reason)
    assert prepare_for_scene(robot) == robot


def test_loop_between_locked_bodies_is_left_out(tmp_path: Path) -> None:
    robot = model(tmp_path, INSIDE, after=equality(HARD[0]))
    locked = prepare_for_scene(lock(robot, {"q1": 0, "q2": 0.5, "q3": 0, "slip": 0}))
    assert not locked.loops
    assert reported(locked, "constraints that no motion changes", "pin (open by")


def test_used_sites_are_read(tmp_path: Path) -> None:
    robot = model(tmp_path, INSIDE, after=equality(HARD[2]))
    assert [line for line in robot.left_out if line.startswith("site")] == ["sites: hub"]


def test_coupling_to_a_locked_joint_fixes_the_other(tmp_path: Path) -> None:
    robot = model(tmp_path, INSIDE, after=equality(HARD[7], HARD[8]))
    q1 = 0.1
    g = math.radians(15) + 0.1 + 2 * q1
    for values in ({"q1": q1}, {"g": g}, {"g": g, "q1": q1}):
        locked = lock(robot, values)
        assert [m.name for m in locked.motions] == ["q2", "q3", "slip", "h", "k"]
        assert [c.name for c in locked.couplings] == ["cubic"]
        assert not [words for words in locked.left_out if words.startswith("constraints")]
        turned, whole = (poses_in_parents(r, {"q1": q1, "g": g}) for r in (locked, robot))
        for name, pose in whole.items():
            np.testing.assert_allclose(turned[name][1], pose[1], atol=1e-15)
    assert (
        lock(robot, {"q1": q1}).left_out[0]
        == f"fixed by couplings to what is locked: g at {g:g} rad"
    )
    with pytest.raises(EomcError, match="break the coupling joint_g_q1 by"):
        lock(robot, {"g": g - 0.2, "q1": q1})


def poses_in_parents(robot, values):
    """Return the pose of each body in its parent."""
    return {
        b.name: body_pose(b, [values.get(m.name, 0.0) for m in b.motions]) for b in robot.bodies
    }


def test_locked_joint_is_the_root_of_a_polynomial_closest_to_the_initial_value(
    tmp_path: Path,
) -> None:
    robot = model(tmp_path, INSIDE, after=equality(HARD[8]))  # slip is a polynomial of q3
    value = 0.3 + np.polynomial.Polynomial([0.01, 0.1, 0.5, -2, 0.7])(0.2)
    (body,) = [b for b in lock(robot, {"slip": value}).bodies if "q3" in b.note]
    assert "joint q3 stands at 0.2 rad" in body.note
    with pytest.raises(EomcError, match="coupling cubic: no value of 'q3' fulfils it while slip"):
        lock(robot, {"slip": -9.0})


def test_chained_couplings_fix_each_other(tmp_path: Path) -> None:
    chain = equality(HARD[7], '<joint joint1="h" joint2="g"/>', '<joint joint1="k" joint2="g"/>')
    assert [m.name for m in lock(model(tmp_path, INSIDE, after=chain), {"k": 0.1}).motions] == [
        "q2", "q3", "slip",
    ]  # fmt: skip


def test_locked_joint_is_a_constant_in_a_sum_of_joints(tmp_path: Path) -> None:
    robot = model(tmp_path, INSIDE, after=equality(HARD[12]))
    (row,) = lock(robot, {"g": 0.5}).couplings
    (whole,) = robot.couplings
    assert row.first == ((2.0, "q1"),)
    rest = {"q1": 0.3, "slip": 0.4}
    assert row.residual(rest) == pytest.approx(whole.residual({**rest, "g": 0.5}))
    (row,) = lock(robot, {"slip": 0.5}).couplings
    assert row.residual({**rest, "g": 1}) == pytest.approx(
        whole.residual({"q1": 0.3, "slip": 0.5, "g": 1})
    )
    scene_of(lock(robot, {"slip": 0.5}))


def test_coupling_to_a_joint_below_the_new_root_fixes_the_other(tmp_path: Path) -> None:
    entry = '<joint joint1="k" joint2="g" polycoef="0.1 2"/>'
    robot = cut(model(tmp_path, INSIDE, after=equality(entry)), "wheel_h")
    assert not robot.motions
    assert robot.left_out[0] == "fixed by couplings to what is locked: k at 0.1 rad"


def test_constraints_of_removed_bodies_are_reported(tmp_path: Path) -> None:
    robot = model(tmp_path, INSIDE, after=equality(HARD[0], HARD[7], HARD[8]))
    without = cut(robot, root="crank")
    assert not without.loops
    assert "cubic, joint_g_q1, pin" in without.left_out[0]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('<connect body1="rocker"/>', 'it needs an anchor="x y z"'),
        ('<connect body1="rocker" anchor="1 2"/>', "takes 3"),
        ('<connect anchor="1 2 3"/>', "it needs body1"),
        ('<connect body1="x" anchor="1 2 3"/>', 'there is no body "x"'),
        ('<connect body1="rockr" anchor="1 2 3"/>', "\"rockr\"; did you mean 'rocker'?"),
        ('<connect body1="crank" body2="crank" anchor="1 2 3"/>', 'holds body "crank" to itself'),
        ('<connect site1="end"/>', "it needs site2"),
        ('<weld site1="end" site2="tip"/>', 'there is no site "tip"'),
        ('<weld body1="rocker" relpose="1 2 3"/>', "takes 7"),
        ("<joint/>", "it needs joint1"),
        ('<joint joint1="x"/>', 'there is no joint "x"'),
        ('<joint joint1="g" joint2="x"/>', 'there is no joint "x"'),
        ('<tendon tendon1="x"/>', 'there is no tendon "x"'),
        ('<joint joint1="g" polycoef="1 2 3 4 5 6"/>', "it takes 1 to 5"),
        ('<joint joint1="g" active="maybe"/>', "is not one of false, true"),
    ],
)  # fmt: skip
def test_faults(entry: str, message: str, tmp_path: Path) -> None:
    assert message in refused(tmp_path, INSIDE, after=equality(entry))


FOUR_BAR = """<body name="base" pos="0 0 0.9116" quat="1 0 0 -1">
<body name="crank" pos="0 {} {}"><joint name="q1" axis="1 0 0"/><geom size="0.01"/>
<body name="coupler" pos="0 {} {}"><joint name="q2" axis="1 0 0"/><geom size="0.01"/></body></body>
<body name="rocker" pos="0 {} {}"><joint name="q3" axis="1 0 0"/><geom size="0.01"/>
<body name="follower" pos="0 {} {}"><joint name="q4" axis="1 0 0" pos="0 {} {}"/>
<geom size="0.01"/></body></body></body>"""


@pytest.mark.parametrize("size", [0.1, 1.0])
def test_linkage_closed_to_rounding_is_assembled(size: float, tmp_path: Path) -> None:
    """The second point of `connect` follows from the pose of the file, in doubles."""
    connect = '<connect name="pin" body1="coupler" body2="follower" anchor="0 0 0"/>'
    for seed in (0, 5, 7):
        lengths = size * (np.random.default_rng(seed).normal(size=10) / 2).round(3)
        robot = model(tmp_path, FOUR_BAR.format(*lengths), after=equality(connect)[len(TENDONS) :])
        system = assembled(scene_of(robot))
        assert max(abs(c.start) for c in system.coordinates) < 1e-12
