"""Counting freedoms: M by the formula, ranks by numbers, and what is said of redundant ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from conftest import tiers

from eomc.base.errors import EomcError, SceneError
from eomc.cli.main import main
from eomc.model import kinematics, mobility
from eomc.model.from_scene import from_scene
from eomc.model.mobility import Mobility
from eomc.program import ranks
from eomc.program.assembly import assembled
from eomc.program.ranks import ClosestSingularity
from eomc.scene.read import parse


def count(*parts: str, gravity: str = "[0, 0, -9.81]", coordinates: str = "") -> Mobility:
    """Of a scene of these parts; coordinates: "q1 q2:m" and so on, angles unless it is said."""
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
def test_each_joint_has_its_freedoms(joint: str, f: int, keys: dict[str, str]) -> None:
    names = [f"q{k}" for k in range(f)]
    # an offset centre, so that slides and turns can't be mistaken for one another
    found = count(
        body("a", joint, " ".join(names), center="[0.3, 0.2, 0.1]", **keys),
        coordinates=" ".join(names),
    )
    assert (found.d, found.M, found.coordinates, found.rank) == (6, f, f, f)
    assert not found.remarks


def test_an_arm_in_space_and_its_table() -> None:
    found = count(
        body("base", "fixed"),
        body("upper", "revolute", "a", "base", axis="[0, 1, 0]", center="[0.5, 0, 0]"),
        body("lower", "revolute", "b", "upper", offset="[1, 0, 0]", axis="[0, 1, 0]"),
        body("slide", "prismatic", "s", "lower", axis="[1, 0, 0]"),
        coordinates="a b s:m",
    )
    assert (found.M, found.rank, found.bodies) == (3, 3, 4)
    table = found.table()
    assert "N = 5 links" in table and "M = d(N - 1 - j) + sum f = 6(5 - 1 - 4) + 3 = 3" in table
    assert "2 revolute (f = 1)" in table
    assert found.remarks == ("fixed (f = 0), moving as one with what they are fixed to: base",)


def test_the_plane_counts_three() -> None:
    found = count(
        body("cart", "prismatic", "x", axis="[1, 0]", inertia=""),
        body("pole", "revolute", "theta", "cart", center="[0, 0.5]", inertia="0.1"),
        coordinates="x:m theta",
        gravity="[0, -9.81]",
    )
    assert (found.d, found.M, found.rank) == (3, 2, 2)


def test_turns_about_the_same_line_are_reported() -> None:
    found = count(
        body("a", "revolute", "p"),
        body("mount", "fixed", parent="a", offset="[0, 0, 1]", rotation='[["x", "pi"]]'),
        body("b", "revolute", "q", "mount"),
        coordinates="p q",
    )
    assert found.rank == 2
    assert any("'p' and 'q' turn about the same line" in remark for remark in found.remarks)
    # beside one another, the lines are parallel but not the same
    apart = count(
        body("a", "revolute", "p"),
        body("b", "revolute", "q", "a", offset="[0.1, 0, 0]"),
        coordinates="p q",
    )
    assert not apart.remarks


def test_slides_along_the_same_direction_are_reported() -> None:
    found = count(
        body("a", "prismatic", "p", axis="[1, 0, 0]"),
        body("b", "prismatic", "q", "a", axis="[0, 1, 0]", rotation='[["z", "-pi/2"]]'),
        coordinates="p:m q:m",
    )
    assert any("'p' and 'q' slide along the same direction" in r for r in found.remarks)


def test_a_massless_spin_is_reported() -> None:
    """A point mass on the axis of a joint: its turn costs nothing."""
    found = count(
        body("arm", "revolute", "p", axis="[0, 1, 0]", center="[0.5, 0, 0]"),
        body("bob", "revolute", "spin", "arm", offset="[1, 0, 0]", axis="[1, 0, 0]", inertia=""),
        coordinates="p spin",
    )
    assert found.rank == 2
    assert any("without inertia: 'spin' moves nothing" in r and "D is singular" in r
               for r in found.remarks)  # fmt: skip
    rotor = count(
        body("bob", "revolute", "spin", axis="[1, 0, 0]", inertia="", armature="0.01"),
        coordinates="spin",
    )
    assert not rotor.remarks


def test_massless_between_the_same_lines() -> None:
    """Only p + q has inertia: the motion in which they cancel is named."""
    found = count(
        body("a", "revolute", "p", mass="", inertia=""),
        body("b", "revolute", "q", "a", center="[0.3, 0, 0]"),
        coordinates="p q",
    )
    reported = next(r for r in found.remarks if r.startswith("without inertia"))
    assert "p_dot = 1, q_dot = -1" in reported


def test_a_body_placed_by_formulas_has_the_freedoms_that_its_formulas_leave() -> None:
    bob = """
[[body]]
name = "bob"
position = ["sin(theta)", "-cos(theta)"]
rotation = "theta"
mass = 1.0
inertia = 0.1
"""
    found = count(bob, coordinates="theta", gravity="[0, -9.81]")
    assert (found.M, found.rank) == (3, 1)
    assert any("the formulas fix 2 of the 3, which leaves 1" in r for r in found.remarks)


def test_redundant_coordinates_are_named() -> None:
    bob = """
[definitions]
along = "a + 2*b"
[[body]]
name = "bob"
position = ["along", "along**2", "c"]
mass = 1.0
"""
    found = count(bob, coordinates="a:m b:m c:m")
    assert (found.coordinates, found.rank) == (3, 2)
    reported = next(r for r in found.remarks if r.startswith("redundant"))
    assert "a_dot = 1, b_dot = -0.5" in reported and "D is singular" in reported


def test_a_coordinate_that_moves_no_body() -> None:
    rest = '[energy]\nkinetic = "lone_dot**2/2"\n'
    found = count(rest, body("a", "revolute", "p"), coordinates="p lone")
    assert (found.M, found.coordinates, found.rank) == (1, 2, 1)
    assert "redundant: 'lone' moves no body; D is singular unless [energy]" in found.remarks[0]


def test_a_singular_start_is_reported() -> None:
    """Polar coordinates at the centre: the angle moves nothing there."""
    bob = """
[[body]]
name = "bob"
position = ["r*cos(phi)", "r*sin(phi)"]
mass = 1.0
"""
    found = count(bob, coordinates="r:m phi", gravity="[0, 0]")
    assert found.rank == 2
    assert any("singular start" in r and "phi" in r for r in found.remarks)


def test_gimbal_lock_at_the_start_is_reported() -> None:
    head = 'eomc = 1\nname = "top_1"\ngravity = [0, 0, 0]\n[coordinates]\nyaw = {}\n'
    head += 'pitch = { start = "pi/2" }\nroll = {}\n'
    found = mobility.compute_mobility(parse(head + body("a", "spherical", "yaw pitch roll")))
    assert found.rank == 3 and any("singular start" in r and "yaw" in r for r in found.remarks)


def test_the_mass_matrix_behind_the_ranks_is_that_of_a_pendulum() -> None:
    text = (
        'eomc = 1\nname = "p_1"\ngravity = [0, 0, 0]\n[coordinates]\nq = { unit = "rad" }\n'
        + body("a", "revolute", "q", mass="2", center="[0.5, 0, 0]", inertia="[0.1, 0.2, 0.3]",
               armature="0.05")
    )  # fmt: skip
    checked = parse(text)
    assert checked.assembly
    at = kinematics.Kinematics(checked, checked.assembly).jacobian(np.array([0.4]), 0.0)
    assert at is not None
    # I + m l^2 + armature; a few roundings
    assert (at.weighs.T @ at.weighs)[0, 0] == pytest.approx(0.3 + 2 * 0.25 + 0.05, rel=1e-14)


def test_the_mass_matrix_behind_the_ranks_has_the_signs_of_a_cart_pole() -> None:
    """D = [[M + m, m l cos q], [m l cos q, m l^2 + J]], the pole hanging down, x to the right."""
    text = (
        'eomc = 1\nname = "p_1"\ngravity = [0, 0]\n[coordinates]\nx = {}\nq = {}\n'
        + body("cart", "prismatic", "x", axis="[1, 0]", mass="3", inertia="")
        + body("pole", "revolute", "q", "cart", mass="2", center="[0, -0.5]", inertia="0.1")
    )
    checked = parse(text)
    assert checked.assembly
    at = kinematics.Kinematics(checked, checked.assembly).jacobian(np.array([0.2, 0.4]), 0.0)
    assert at is not None
    across = 2 * 0.5 * np.cos(0.4)
    right = [[5, across], [across, 2 * 0.25 + 0.1]]
    np.testing.assert_allclose(at.weighs.T @ at.weighs, right, rtol=1e-14)  # a few roundings


def test_a_joint_behind_a_fixed_body_is_followed_through_its_frame() -> None:
    """The mount stands turned about the first axis: what it offsets sideways, it offsets."""
    for offset, same in (("[0, 0, 0.5]", False), ("[0.5, 0, 0]", True)):
        found = count(
            body("a", "revolute", "p"),
            body("mount", "fixed", parent="a", rotation='[["y", "pi/2"]]'),
            body("b", "revolute", "q", "mount", offset=offset, axis="[-1, 0, 0]"),
            coordinates="p q",
        )
        reported = any("turn about the same line" in remark for remark in found.remarks)
        assert reported is same


def suspended(start: str, rest: str) -> str:
    """A bob on a spring and a damper that hang at the origin, and a body placed by a formula."""
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
        ("1", '"l"', ["spring.1", "damper.1", "damper.2"]),  # zero, but it may be set
        ("1", "0", ["damper.1", "damper.2"]),
    ],
)
def test_ends_that_meet_at_the_start_are_reported(
    start: str, rest: str, reported: list[str]
) -> None:
    made = parse(suspended(start, rest))
    found = mobility.find_coincident_ends(made)
    assert [problem.key for problem in found] == reported
    warnings = from_scene(made).warnings[len(made.warnings) :]
    assert [problem.key for problem in warnings] == reported
    remarks = [
        r for r in mobility.compute_mobility(made).remarks if "its ends meet at the start" in r
    ]
    assert [r.partition(":")[0] for r in remarks] == reported


@pytest.mark.parametrize("last", tiers([400, 1500], 400))
def test_thousands_of_bodies_take_seconds(last: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where joints can be eliminated one by one, no matrix as wide as the scene is made."""
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
    found = mobility.compute_mobility(parse(text))
    assert (found.M, found.rank) == (last + 1, last + 1) and not found.remarks


def test_elimination_does_not_judge_what_may_be_rounding() -> None:
    """A pivot of nothing but rounding, and one that is small but there: J = 1e-9 m l^2."""
    for inertia, regular in (("", False), ("[1e-9, 1e-9, 1e-9]", True)):
        text = (
            'eomc = 1\nname = "p_1"\ngravity = [0, 0, 0]\n[coordinates]\np = {}\nq = {}\n'
            + body("arm", "revolute", "p", axis="[0.3, 0.5, 0.7]", center="[0.5, 0, 0]")
            + body("bob", "revolute", "q", "arm", offset="[1, 0.3, 0]", axis="[0.2, 0.3, 0.7]",
                   center="[0.2, 0.3, 0.7]", inertia=inertia)
        )  # fmt: skip
        checked = parse(text)
        assert checked.assembly
        found = kinematics.Kinematics(checked, checked.assembly)
        assert found.is_regular(np.array([0.4, 1.0])) is regular


@pytest.mark.parametrize(("center", "regular"), [("-0.3", False), ("0.3", True)])
def test_elimination_knows_where_a_mass_is(center: str, regular: bool) -> None:
    """A point mass beside a joint's axis, or on it, in the frame of a body that stands apart."""
    text = (
        'eomc = 1\nname = "p_1"\ngravity = [0, 0, 0]\n[coordinates]\np = {}\n'
        + body("post", "revolute", "p", mass="", inertia="")
        + body("bob", "fixed", "", "post", offset="[0.3, 0, 1]", center=f"[{center}, 0, 0]",
               inertia="")
    )  # fmt: skip
    checked = parse(text)
    assert checked.assembly
    found = kinematics.Kinematics(checked, checked.assembly)
    assert found.is_regular(np.array([0.4])) is regular


def test_a_long_chain_has_all_its_freedoms() -> None:
    n = 30
    parts = [
        body(f"link{k}", "revolute", f"q{k}", f"link{k - 1}" if k else "world",
             offset="[0.2, 0, 0]", axis="[0, 0.6, 0.8]", center="[0.1, 0, 0]")
        for k in range(n)
    ]  # fmt: skip
    found = count(*parts, coordinates=" ".join(f"q{k}" for k in range(n)))
    assert (found.M, found.rank) == (n, n) and not found.remarks


def test_scenes_without_bodies_are_reported_so() -> None:
    text = 'eomc = 1\nname = "s_1"\n[coordinates]\nx = {}\n[energy]\nkinetic = "x_dot**2"\n'
    with pytest.raises(EomcError, match=r"no \[\[body\]\], .* each coordinate is a freedom, x$"):
        mobility.compute_mobility(parse(text))


def test_the_command(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(
        'eomc = 1\nname = "arm"\ngravity = [0, 0, -9.81]\n[coordinates]\nq = { unit = "rad" }\n'
        + body("a", "revolute", "q"),
        encoding="utf-8",
    )
    done = CliRunner().invoke(main, ["dof", str(path)])
    assert done.exit_code == 0 and "arm: 1 freedom in space" in done.output
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


def test_loops_and_rows_count():
    found = mobility.compute_mobility(parse(FOUR_BAR + "\n".join(BARS)))
    assert (found.M, found.coordinates, dict(found.loops)) == (1, 3, {"revolute": 1})
    assert "in loops 1 revolute (f = 1)" in found.table()
    row = '\n[constraints]\ndrive = "q1 - t"\n'
    driven = mobility.compute_mobility(parse(FOUR_BAR + row + "\n".join(BARS)))
    assert driven.M == 0
    assert "M = d(N - 1 - j) + sum f - constraints = 3(4 - 1 - 4) + 4 - 1 = 0" in driven.table()


def test_dof_tells_rank_and_the_assembled_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranks, "MAX_CONFIGURATIONS", 50)  # as many steps lead all round
    file = tmp_path / "four_bar.toml"
    file.write_text(FOUR_BAR.replace("1.4 }", "1.4, guess = true }") + "\n".join(BARS))
    done = CliRunner().invoke(main, ["dof", str(file), "--json"])
    assert done.exit_code == 2  # q2 is held
    assert "q2" in done.output
    file.write_text(file.read_text().replace("-0.6 }", "-0.6, guess = true }"))
    done = CliRunner().invoke(main, ["dof", str(file), "--json"])
    found = json.loads(done.output)
    assert (found["M"], found["constraints"]["rank"], found["constraints"]["freedoms"]) == (1, 2, 1)
    q = found["constraints"]["q"]
    ends = [
        np.exp(1j * q["q1"]) + 3 * np.exp(1j * (q["q1"] + q["q2"])),
        3.5 + 2.5 * np.exp(1j * q["q3"]),
    ]
    assert abs(ends[0] - ends[1]) < 1e-14
    near = ClosestSingularity(**found["constraints"]["nearest_singular"])
    monkeypatch.setattr(ranks, "closest_singularity", lambda _: near)  # not sought again
    shown = CliRunner().invoke(main, ["dof", str(file)]).output
    assert str(near) in shown
    assert "2 rows of constraints on 3 coordinates, rank 2 of 2" in shown
    assert "assembled start: q1 = 1.04719755, q2 = " in shown


def test_dof_of_a_scene_without_bodies(tmp_path: Path) -> None:
    file = tmp_path / "rod.toml"
    file.write_text(
        'eomc = 1\nname = "rod"\n[coordinates]\nx = { start = 0.6 }\n'
        "y = { start = -1, guess = true }\n"
        '[energy]\nkinetic = "x_dot**2 + y_dot**2"\n[constraints]\nrod = "x**2 + y**2 - 1"\n'
    )
    shown = CliRunner().invoke(main, ["dof", str(file)]).output
    assert shown.startswith("1 row of constraints on 2 coordinates, rank 1 of 1\n  1 freedom left")


def warnings(written):
    return assembled(from_scene(parse(written))).warnings


def test_a_loop_is_closed_by_the_rotation_that_is_meant():
    """From 2.9 it was closed half a turn off, where its rows hold too, with a warning."""
    written = (
        'eomc = 1\nname = "welded"\ngravity = [0, -9.81]\n[coordinates]\n'
        "x = { guess = true }\ny = { guess = true }\n"
        'a = { unit = "rad", start = ANGLE, guess = true }\nb = { unit = "rad", start = 0.2 }\n'
        + body("plate", "planar", "x y a", inertia="0.1")
        + body("arm", "revolute", "b", inertia="0.1")
        + '[[loop]]\nname = "seam"\njoint = "weld"\nbodies = ["arm", "plate"]\n'
        "points = [[1, 0], [0, 0]]\n"
    )
    for angle in ("2.9", "0.9"):
        made = assembled(from_scene(parse(written.replace("ANGLE", angle))))
        assert [w.key for w in made.warnings if w.severity == "warning"] == []
        assert made.coordinates[2].start == pytest.approx(0.2, abs=1e-14)
    held = written.replace("ANGLE, guess = true", "ANGLE").replace("ANGLE", "3.2")
    with pytest.raises(SceneError, match=r"with a = 3\.2, b = 0\.2 held: a would have to be 0\.2"):
        assembled(from_scene(parse(held)))


def test_a_loop_that_stands_in_a_wrong_rotation_wherever_it_moves_is_refused():
    """Its rows of axes are zero all the same, and left out."""
    written = (
        'eomc = 1\nname = "reversed"\ngravity = [0, 0, -9.81]\n[coordinates]\n'
        "x = {}\ny = {}\na = {}\n" + body("plate", "planar", "x y a") + '[[loop]]\nname = "pin"\n'
        'bodies = ["world", "plate"]\npoints = [[0, 0, 0], [0, 0, 0]]\n'
    )
    for rest in (
        'joint = "revolute"\naxis = [[0, 0, 1], [0, 0, -1]]',
        'joint = "weld"\nrotation = [["x", "pi"]]',
    ):
        with pytest.raises(SceneError, match=r"loop\.pin: can't close as is meant"):
            assembled(from_scene(parse(written + rest)))
