"""Test degrees of freedom: M by the formula, numerical ranks, and reports of redundancy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from support.session import tiers

from eomc.base.errors import EomcError, SceneError
from eomc.cli.main import main
from eomc.mechanism import mobility, ranks
from eomc.mechanism.assembly import assembled
from eomc.mechanism.mobility import Mobility
from eomc.mechanism.ranks import ClosestSingularity
from eomc.model import kinematics
from eomc.model.system import from_scene
from eomc.scene.read import parse


def count_mobility(*parts: str, gravity: str = "[0, 0, -9.81]", coordinates: str = "") -> Mobility:
    """Count a scene of these parts; coordinates "q1 q2:m" are angles unless a unit follows."""
    entries = []
    for word in coordinates.split():
        name, _, unit = word.partition(":")
        entries.append(f'{name} = {{ unit = "{unit or "rad"}" }}')
    head = f'eomc = 1\nname = "scene_1"\ngravity = {gravity}\n[coordinates]\n'
    return mobility.compute_mobility(parse(head + "\n".join(entries) + "\n" + "\n".join(parts)))


def body(name: str, joint: str, coordinates: str = "", parent: str = "world", **keys: str) -> str:
    keys = {"mass": "1", "inertia": "[0.1, 0.1, 0.1]", **keys}
    lines = [f'[[body]]\nname = "{name}"\njoint = "{joint}"\nparent = "{parent}"']
    if coordinates:
        listed = ", ".join(f'"{c}"' for c in coordinates.split())
        lines.append(f"coordinates = [{listed}]")
    return "\n".join(lines + [f"{key} = {value}" for key, value in keys.items() if value]) + "\n"


@pytest.mark.parametrize(
    ("joint", "f", "keys"),
    [
        ("revolute", 1, {}),
        ("prismatic", 1, {"axis": "[0, 0.6, 0.8]"}),
        ("planar", 3, {}),
        ("cylindrical", 2, {}),
        ("universal", 2, {}),
        ("spherical", 3, {}),
        ("free", 6, {}),
    ],
)
def test_each_joint_has_its_degrees_of_freedom(joint: str, f: int, keys: dict[str, str]) -> None:
    names = [f"q{k}" for k in range(f)]
    # an offset centre distinguishes translations from rotations
    result = count_mobility(
        body("a", joint, " ".join(names), center="[0.3, 0.2, 0.1]", **keys),
        coordinates=" ".join(names),
    )
    assert (result.d, result.M, result.coordinates, result.rank) == (6, f, f, f)
    assert not result.remarks


def test_spatial_arm_and_its_table() -> None:
    result = count_mobility(
        body("base", "fixed"),
        body("upper", "revolute", "a", "base", axis="[0, 1, 0]", center="[0.5, 0, 0]"),
        body("lower", "revolute", "b", "upper", offset="[1, 0, 0]", axis="[0, 1, 0]"),
        body("slide", "prismatic", "s", "lower", axis="[1, 0, 0]"),
        coordinates="a b s:m",
    )
    assert (result.M, result.rank, result.bodies) == (3, 3, 4)
    table = result.table()
    assert "N = 5 links" in table and "M = d(N - 1 - j) + sum f = 6(5 - 1 - 4) + 3 = 3" in table
    assert "2 revolute (f = 1)" in table
    assert result.remarks == ("fixed (f = 0), moving as one with what they are fixed to: base",)


def test_planar_bodies_have_three_degrees_of_freedom() -> None:
    result = count_mobility(
        body("cart", "prismatic", "x", axis="[1, 0]", inertia=""),
        body("pole", "revolute", "theta", "cart", center="[0, 0.5]", inertia="0.1"),
        coordinates="x:m theta",
        gravity="[0, -9.81]",
    )
    assert (result.d, result.M, result.rank) == (3, 2, 2)


def test_revolute_joints_on_one_line_are_reported() -> None:
    result = count_mobility(
        body("a", "revolute", "p"),
        body("mount", "fixed", parent="a", offset="[0, 0, 1]", rotation='[["x", "pi"]]'),
        body("b", "revolute", "q", "mount"),
        coordinates="p q",
    )
    assert result.rank == 2
    assert any("'p' and 'q' turn about the same line" in remark for remark in result.remarks)
    # parallel lines at a distance are not the same line
    parallel = count_mobility(
        body("a", "revolute", "p"),
        body("b", "revolute", "q", "a", offset="[0.1, 0, 0]"),
        coordinates="p q",
    )
    assert not parallel.remarks


def test_prismatic_joints_along_one_direction_are_reported() -> None:
    result = count_mobility(
        body("a", "prismatic", "p", axis="[1, 0, 0]"),
        body("b", "prismatic", "q", "a", axis="[0, 1, 0]", rotation='[["z", "-pi/2"]]'),
        coordinates="p:m q:m",
    )
    assert any("'p' and 'q' slide along the same direction" in r for r in result.remarks)


def test_rotation_without_inertia_is_reported() -> None:
    """The rotation of a point mass on the axis of its joint has no kinetic energy."""
    result = count_mobility(
        body("arm", "revolute", "p", axis="[0, 1, 0]", center="[0.5, 0, 0]"),
        body("bob", "revolute", "spin", "arm", offset="[1, 0, 0]", axis="[1, 0, 0]", inertia=""),
        coordinates="p spin",
    )
    assert result.rank == 2
    assert any("without inertia: 'spin' moves nothing" in r and "D is singular" in r
               for r in result.remarks)  # fmt: skip
    rotor = count_mobility(
        body("bob", "revolute", "spin", axis="[1, 0, 0]", inertia="", armature="0.01"),
        coordinates="spin",
    )
    assert not rotor.remarks


def test_massless_body_between_coaxial_joints_is_reported() -> None:
    """Only p + q has inertia: the motion with p + q = 0 is named."""
    result = count_mobility(
        body("a", "revolute", "p", mass="", inertia=""),
        body("b", "revolute", "q", "a", center="[0.3, 0, 0]"),
        coordinates="p q",
    )
    reported = next(r for r in result.remarks if r.startswith("without inertia"))
    assert "p_dot = 1, q_dot = -1" in reported


def test_body_placed_by_formulas_has_their_degrees_of_freedom() -> None:
    bob = """
[[body]]
name = "bob"
position = ["sin(theta)", "-cos(theta)"]
rotation = "theta"
mass = 1.0
inertia = 0.1
"""
    result = count_mobility(bob, coordinates="theta", gravity="[0, -9.81]")
    assert (result.M, result.rank) == (3, 1)
    assert any("the formulas fix 2 of the 3, which leaves 1" in r for r in result.remarks)


def test_redundant_coordinates_are_named() -> None:
    bob = """
[definitions]
along = "a + 2*b"
[[body]]
name = "bob"
position = ["along", "along**2", "c"]
mass = 1.0
"""
    result = count_mobility(bob, coordinates="a:m b:m c:m")
    assert (result.coordinates, result.rank) == (3, 2)
    reported = next(r for r in result.remarks if r.startswith("redundant"))
    assert "a_dot = 1, b_dot = -0.5" in reported and "D is singular" in reported


def test_coordinate_that_moves_no_body_is_reported() -> None:
    rest = '[energy]\nkinetic = "lone_dot**2/2"\n'
    result = count_mobility(rest, body("a", "revolute", "p"), coordinates="p lone")
    assert (result.M, result.coordinates, result.rank) == (1, 2, 1)
    assert "redundant: 'lone' moves no body; D is singular unless [energy]" in result.remarks[0]


def test_singular_initial_position_is_reported() -> None:
    """In polar coordinates at the centre the angle moves nothing."""
    bob = """
[[body]]
name = "bob"
position = ["r*cos(phi)", "r*sin(phi)"]
mass = 1.0
"""
    result = count_mobility(bob, coordinates="r:m phi", gravity="[0, 0]")
    assert result.rank == 2
    assert any("singular start" in r and "phi" in r for r in result.remarks)


def test_initial_gimbal_lock_is_reported() -> None:
    head = 'eomc = 1\nname = "top_1"\ngravity = [0, 0, 0]\n[coordinates]\nyaw = {}\n'
    head += 'pitch = { start = "pi/2" }\nroll = {}\n'
    result = mobility.compute_mobility(parse(head + body("a", "spherical", "yaw pitch roll")))
    assert result.rank == 3 and any("singular start" in r and "yaw" in r for r in result.remarks)


def test_mass_matrix_of_the_ranks_is_that_of_a_pendulum() -> None:
    text = (
        'eomc = 1\nname = "p_1"\ngravity = [0, 0, 0]\n[coordinates]\nq = { unit = "rad" }\n'
        + body("a", "revolute", "q", mass="2", center="[0.5, 0, 0]", inertia="[0.1, 0.2, 0.3]",
               armature="0.05")
    )  # fmt: skip
    checked = parse(text)
    assert checked.assembly
    at = kinematics.Kinematics(checked, checked.assembly).jacobian(np.array([0.4]), 0.0)
    assert at is not None
    # I + m l^2 + armature, to a few ulp
    assert (at.weighs.T @ at.weighs)[0, 0] == pytest.approx(0.3 + 2 * 0.25 + 0.05, rel=1e-14)


def test_mass_matrix_of_the_ranks_has_the_signs_of_a_cart_pole() -> None:
    """D = [[M + m, m l cos q], [m l cos q, m l^2 + J]]; the pole hangs down and x points right."""
    text = (
        'eomc = 1\nname = "p_1"\ngravity = [0, 0]\n[coordinates]\nx = {}\nq = {}\n'
        + body("cart", "prismatic", "x", axis="[1, 0]", mass="3", inertia="")
        + body("pole", "revolute", "q", "cart", mass="2", center="[0, -0.5]", inertia="0.1")
    )
    checked = parse(text)
    assert checked.assembly
    at = kinematics.Kinematics(checked, checked.assembly).jacobian(np.array([0.2, 0.4]), 0.0)
    assert at is not None
    coupling = 2 * 0.5 * np.cos(0.4)
    expected = [[5, coupling], [coupling, 2 * 0.25 + 0.1]]
    np.testing.assert_allclose(at.weighs.T @ at.weighs, expected, rtol=1e-14)  # a few ulp


def test_joint_on_a_fixed_body_uses_the_frame_of_the_body() -> None:
    """The rotation of the mount about the first axis turns its lateral offset."""
    for offset, same in (("[0, 0, 0.5]", False), ("[0.5, 0, 0]", True)):
        result = count_mobility(
            body("a", "revolute", "p"),
            body("mount", "fixed", parent="a", rotation='[["y", "pi/2"]]'),
            body("b", "revolute", "q", "mount", offset=offset, axis="[-1, 0, 0]"),
            coordinates="p q",
        )
        reported = any("turn about the same line" in remark for remark in result.remarks)
        assert reported is same


def suspended(start: str, rest: str) -> str:
    """Write a bob on a spring and a damper fixed at the origin, and a body placed by a formula."""
    ends = 'bodies = ["world", "bob"]\npoints = [[1, 0], [0, 0]]\n'
    return (
        'eomc = 1\nname = "s_1"\ngravity = [0, 0]\n[parameters]\nl = 0\n[coordinates]\n'
        f"x = {{ start = {start} }}\n"
        + body("bob", "prismatic", "x", axis="[1, 0]", inertia="")
        + f"[[spring]]\n{ends}stiffness = 1\nlength = {rest}\n"
        + f"[[damper]]\n{ends}damping = 1\n"
        + '[[body]]\nname = "lamp"\nposition = ["2*x", 0]\nmass = 1\n'
        + '[[damper]]\nbodies = ["bob", "lamp"]\npoints = [[1, 0], [0, 0]]\ndamping = 1\n'
    )


@pytest.mark.parametrize(
    ("start", "rest", "reported"),
    [
        ("0.2", "0.1", []),
        ("1", "0.1", ["spring.1", "damper.1", "damper.2"]),
        ("1", '"l"', ["spring.1", "damper.1", "damper.2"]),  # zero, but a parameter
        ("1", "0", ["damper.1", "damper.2"]),
    ],
)
def test_initially_coincident_ends_are_reported(start: str, rest: str, reported: list[str]) -> None:
    document = parse(suspended(start, rest))
    result = kinematics.find_coincident_ends(document)
    assert [problem.key for problem in result] == reported
    warnings = from_scene(document).warnings[len(document.warnings) :]
    assert [problem.key for problem in warnings] == reported
    remarks = [
        r for r in mobility.compute_mobility(document).remarks if "its ends meet at the start" in r
    ]
    assert [r.partition(":")[0] for r in remarks] == reported


@pytest.mark.parametrize("last", tiers([400, 1500], 400))
def test_thousands_of_bodies_are_counted_in_seconds(
    last: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where joints can be eliminated one by one, no matrix has the width of the scene."""
    text = f"""
eomc = 1
name = "chain"
gravity = [0, -9.81]
[coordinates]
"q[i]" = {{ repeat = "i = 0..{last}" }}
[[body]]
name = "link[0]"
joint = "revolute"
coordinates = "q[0]"
mass = 1
center = [1, 0]
[[body]]
repeat = "i = 1..{last}"
name = "link[i]"
parent = "link[i-1]"
joint = "revolute"
coordinates = "q[i]"
offset = [1, 0]
mass = 1
center = [1, 0]
"""
    monkeypatch.delattr(kinematics, "null_space")
    result = mobility.compute_mobility(parse(text))
    assert (result.M, result.rank) == (last + 1, last + 1) and not result.remarks


def test_elimination_leaves_pivots_near_rounding_undecided() -> None:
    """One pivot is rounding error only; another is small but significant: J = 1e-9 m l^2."""
    for inertia, regular in (("", False), ("[1e-9, 1e-9, 1e-9]", True)):
        text = (
            'eomc = 1\nname = "p_1"\ngravity = [0, 0, 0]\n[coordinates]\np = {}\nq = {}\n'
            + body("arm", "revolute", "p", axis="[0.3, 0.5, 0.7]", center="[0.5, 0, 0]")
            + body("bob", "revolute", "q", "arm", offset="[1, 0.3, 0]", axis="[0.2, 0.3, 0.7]",
                   center="[0.2, 0.3, 0.7]", inertia=inertia)
        )  # fmt: skip
        checked = parse(text)
        assert checked.assembly
        result = kinematics.Kinematics(checked, checked.assembly)
        assert result.is_regular(np.array([0.4, 1.0])) is regular


@pytest.mark.parametrize(("center", "regular"), [("-0.3", False), ("0.3", True)])
def test_elimination_detects_a_mass_on_the_axis(center: str, regular: bool) -> None:
    """A point mass off a joint's axis, or on it, in the frame of a displaced body."""
    text = (
        'eomc = 1\nname = "p_1"\ngravity = [0, 0, 0]\n[coordinates]\np = {}\n'
        + body("post", "revolute", "p", mass="", inertia="")
        + body("bob", "fixed", "", "post", offset="[0.3, 0, 1]", center=f"[{center}, 0, 0]",
               inertia="")
    )  # fmt: skip
    checked = parse(text)
    assert checked.assembly
    result = kinematics.Kinematics(checked, checked.assembly)
    assert result.is_regular(np.array([0.4])) is regular


def test_long_chain_has_all_its_degrees_of_freedom() -> None:
    n = 30
    parts = [
        body(f"link{k}", "revolute", f"q{k}", f"link{k - 1}" if k else "world",
             offset="[0.2, 0, 0]", axis="[0, 0.6, 0.8]", center="[0.1, 0, 0]")
        for k in range(n)
    ]  # fmt: skip
    result = count_mobility(*parts, coordinates=" ".join(f"q{k}" for k in range(n)))
    assert (result.M, result.rank) == (n, n) and not result.remarks


def test_scene_without_bodies_is_reported() -> None:
    text = 'eomc = 1\nname = "s_1"\n[coordinates]\nx = {}\n[energy]\nkinetic = "x_dot**2"\n'
    with pytest.raises(
        EomcError, match=r"no \[\[body\]\], .* each coordinate is a degree of freedom, x$"
    ):
        mobility.compute_mobility(parse(text))


def test_dof_command_prints_the_table(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(
        'eomc = 1\nname = "arm"\ngravity = [0, 0, -9.81]\n[coordinates]\nq = { unit = "rad" }\n'
        + body("a", "revolute", "q"),
        encoding="utf-8",
    )
    result = CliRunner().invoke(main, ["dof", str(path)])
    assert result.exit_code == 0 and "arm: 1 degree of freedom in space" in result.output
    reported = json.loads(CliRunner().invoke(main, ["dof", str(path), "--json"]).output)
    assert (reported["M"], reported["rank"], reported["joints"]) == (1, 1, {"revolute": 1})


FOUR_BAR = """
eomc = 1
name = "four_bar"
gravity = [0, -9.81]

[coordinates]
q1 = { unit = "rad", start = "pi/3" }
q2 = { unit = "rad", start = -0.6 }
q3 = { unit = "rad", start = 1.4 }
"""
BARS = (
    body("crank", "revolute", "q1", inertia="0.1", center="[0.5, 0]"),
    body("coupler", "revolute", "q2", "crank", inertia="0.5", offset="[1, 0]"),
    body("rocker", "revolute", "q3", inertia="0.4", offset="[3.5, 0]"),
    '[[loop]]\nname = "pin"\njoint = "revolute"\nbodies = ["coupler", "rocker"]\n'
    "points = [[3, 0], [2.5, 0]]\n",
)


def test_loops_and_constraint_rows_are_counted():
    result = mobility.compute_mobility(parse(FOUR_BAR + "\n".join(BARS)))
    assert (result.M, result.coordinates, dict(result.loops)) == (1, 3, {"revolute": 1})
    assert "in loops 1 revolute (f = 1)" in result.table()
    row = '\n[constraints]\ndrive = "q1 - t"\n'
    driven = mobility.compute_mobility(parse(FOUR_BAR + row + "\n".join(BARS)))
    assert driven.M == 0
    assert "M = d(N - 1 - j) + sum f - constraints = 3(4 - 1 - 4) + 4 - 1 = 0" in driven.table()


def test_dof_prints_rank_and_assembled_initial_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranks, "MAX_CONFIGURATIONS", 50)  # that many steps cover the whole circle
    file = tmp_path / "four_bar.toml"
    file.write_text(FOUR_BAR.replace("1.4 }", "1.4, guess = true }") + "\n".join(BARS))
    result = CliRunner().invoke(main, ["dof", str(file), "--json"])
    assert result.exit_code == 2  # q2 is fixed
    assert "q2" in result.output
    file.write_text(file.read_text().replace("-0.6 }", "-0.6, guess = true }"))
    result = CliRunner().invoke(main, ["dof", str(file), "--json"])
    report = json.loads(result.output)
    assert (report["M"], report["constraints"]["rank"], report["constraints"]["freedoms"]) == (
        1,
        2,
        1,
    )
    q = report["constraints"]["q"]
    ends = [
        np.exp(1j * q["q1"]) + 3 * np.exp(1j * (q["q1"] + q["q2"])),
        3.5 + 2.5 * np.exp(1j * q["q3"]),
    ]
    assert abs(ends[0] - ends[1]) < 1e-14
    closest = ClosestSingularity(**report["constraints"]["nearest_singular"])
    monkeypatch.setattr(ranks, "closest_singularity", lambda _: closest)  # no second search
    shown = CliRunner().invoke(main, ["dof", str(file)]).output
    assert str(closest) in shown
    assert "2 constraint equations on 3 coordinates, rank 2 of 2" in shown
    assert "assembled initial state: q1 = 1.04719755, q2 = " in shown


def test_dof_of_a_scene_without_bodies_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "rod.toml"
    file.write_text(
        'eomc = 1\nname = "rod"\n[coordinates]\nx = { start = 0.6 }\n'
        "y = { start = -1, guess = true }\n"
        '[energy]\nkinetic = "x_dot**2 + y_dot**2"\n[constraints]\nrod = "x**2 + y**2 - 1"\n'
    )
    shown = CliRunner().invoke(main, ["dof", str(file)]).output
    assert shown.startswith(
        "1 constraint equation on 2 coordinates, rank 1 of 1\n  remaining: 1 degree of freedom"
    )


def warnings(text):
    return assembled(from_scene(parse(text))).warnings


def test_loop_is_closed_by_the_nearest_rotation():
    """From 2.9 it was once closed half a turn off, where its rows are zero too, with a warning."""
    text = (
        'eomc = 1\nname = "welded"\ngravity = [0, -9.81]\n[coordinates]\n'
        "x = { guess = true }\ny = { guess = true }\n"
        'a = { unit = "rad", start = ANGLE, guess = true }\nb = { unit = "rad", start = 0.2 }\n'
        + body("plate", "planar", "x y a", inertia="0.1")
        + body("arm", "revolute", "b", inertia="0.1")
        + '[[loop]]\nname = "seam"\njoint = "weld"\nbodies = ["arm", "plate"]\n'
        "points = [[1, 0], [0, 0]]\n"
    )
    for angle in ("2.9", "0.9"):
        system = assembled(from_scene(parse(text.replace("ANGLE", angle))))
        assert [w.key for w in system.warnings if w.severity == "warning"] == []
        assert system.coordinates[2].start == pytest.approx(0.2, abs=1e-14)
    fixed_text = text.replace("ANGLE, guess = true", "ANGLE").replace("ANGLE", "3.2")
    with pytest.raises(
        SceneError, match=r"with the fixed values a = 3\.2, b = 0\.2: a would have to be 0\.2"
    ):
        assembled(from_scene(parse(fixed_text)))


def test_loop_with_a_wrong_rotation_in_every_position_is_refused():
    """Its axis rows are zero and dropped all the same."""
    text = (
        'eomc = 1\nname = "reversed"\ngravity = [0, 0, -9.81]\n[coordinates]\n'
        "x = {}\ny = {}\na = {}\n" + body("plate", "planar", "x y a") + '[[loop]]\nname = "pin"\n'
        'bodies = ["world", "plate"]\npoints = [[0, 0, 0], [0, 0, 0]]\n'
    )
    for rest in (
        'joint = "revolute"\naxis = [[0, 0, 1], [0, 0, -1]]',
        'joint = "weld"\nrotation = [["x", "pi"]]',
    ):
        with pytest.raises(SceneError, match=r"loop\.pin: can't close as described"):
            assembled(from_scene(parse(text + rest)))
