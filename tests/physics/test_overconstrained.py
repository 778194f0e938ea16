"""Spatial loops with redundant constraints: Bennett's linkage; a four-bar on a turntable."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
import pytest
from support.session import Modules, tiers

from eomc.mechanism.assembly import assembled
from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from eomc.verify.check import check

# Four hinges; sin(alpha)/a = sin(beta)/b makes the linkage movable, with tan(q1/2) tan(q2/2) =
# const and q3 = -q1.
A, B, ALPHA = 1.0, 1.4, 0.7
BETA = math.asin(B * math.sin(ALPHA) / A)
LINK = """
[[body]]
name = "{name}"
parent = "{parent}"
joint = "revolute"
coordinates = "{q}"
axis = [{axis}]
offset = {offset}
rotation = {turns}
mass = 1
center = {center}
inertia = {inertia}
"""


def link(
    name: str, parent: str, q: str, axis: str, offset: object, center: object, turn: float = 0.0
) -> str:
    turns = f'[["x", "{turn!r}"]]' if turn else "[]"
    text = LINK.format(
        name=name, parent=parent, q=q, axis=axis, offset=offset, turns=turns, center=center,
        inertia=[0.01, 0.1, 0.1],
    )  # fmt: skip
    lines = [x for x in text.splitlines() if x not in ("rotation = []", 'parent = ""')]
    return "\n".join(lines) + "\n"


def scene(name: str, coordinates: str, bodies: str, loop: str) -> str:
    return (
        f'eomc = 1\nname = "{name}"\ngravity = [0, 0, -9.81]\n[coordinates]\n{coordinates}{bodies}'
        f'[[loop]]\nname = "pin"\njoint = "revolute"\n{loop}\n[run]\nh = 0.002\nduration = 3.0\n'
        'tolerance = 1e-10\nmethod = ["rk4", "gauss8"]\n'
    )


BENNETT = scene(
    "bennett",
    'q1 = { unit = "rad", start = 1.0, rate = 1.0 }\n'
    'q2 = { unit = "rad", start = 2.0, guess = true }\n'
    'q3 = { unit = "rad", start = -0.8, guess = true }\n',
    link("one", "", "q1", "0, 0, 1", [0, 0, 0], [A / 2, 0, 0])
    + link("two", "one", "q2", "0, 0, 1", [A, 0, 0], [B / 2, 0, 0], ALPHA)
    + link("three", "two", "q3", "0, 0, 1", [B, 0, 0], [A / 2, 0, 0], BETA),
    f'bodies = ["world", "three"]\npoints = [[{-B}, 0, 0], [{A}, 0, 0]]\n'
    f"axis = [[0, {math.sin(BETA)!r}, {math.cos(BETA)!r}], "
    f"[0, {-math.sin(ALPHA)!r}, {math.cos(ALPHA)!r}]]",
)
FOUR_BAR = (
    'q1 = { unit = "rad", start = 1.0, rate = 2.0 }\n'
    'q2 = { unit = "rad", start = -0.5, guess = true }\n'
    'q3 = { unit = "rad", start = 1.5, guess = true }\n'
)
PINNED = 'bodies = ["coupler", "rocker"]\npoints = [[1, 0, 0], [0.8, 0, 0]]\naxis = [0, 1, 0]'


def four_bar(parent: str) -> str:
    return (
        link("crank", parent, "q1", "0, -1, 0", [0.1, 0, 0.5], [0.15, 0, 0])
        + link("coupler", "crank", "q2", "0, -1, 0", [0.3, 0, 0], [0.5, 0, 0])
        + link("rocker", parent, "q3", "0, -1, 0", [1.1, 0, 0.5], [0.4, 0, 0])
    )


TURNTABLE = scene(
    "turntable",
    's = { unit = "rad", start = 0, rate = 1 }\n' + FOUR_BAR,
    link("table", "", "s", "0, 0, 1", [0, 0, 0], [0, 0, 0]) + four_bar("table"),
    PINNED,
)
STANDING = scene("standing", FOUR_BAR, four_bar(""), PINNED)
DRIVEN = BENNETT.replace("[[loop]]", '[constraints]\ndrive = "q1 - 1 - t"\n[[loop]]')


def tilted() -> str:
    """Return a four-bar in a plane whose normal is given in doubles; its points lie on that
    normal.
    """
    c, s = math.cos(0.7), math.sin(0.7)

    def point(x: float) -> list[float]:
        return [x * math.cos(0.4), x * math.sin(0.4) * c, x * math.sin(0.4) * s]

    axis = f"0, {-s!r}, {c!r}"
    crank = link("crank", "", "q1", axis, point(0.1), point(0.15))
    coupler = link("coupler", "crank", "q2", axis, point(0.3), point(0.5))
    rocker = link("rocker", "", "q3", axis, point(1.1), point(0.4))
    pinned = f'bodies = ["coupler", "rocker"]\npoints = [{point(1)}, {point(0.8)}]\naxis = [{axis}]'
    return scene("tilted", FOUR_BAR, crank + coupler + rocker, pinned)


def locked(angle: float) -> str:
    """Return a joint about z that a perpendicular hinge locks at an angle."""
    c, s = math.cos(angle), math.sin(angle)
    return scene(
        "locked",
        f"q1 = {{ start = 0.3, rate = 1.0 }}\nq2 = {{ start = {angle}, guess = true }}\n",
        link("arm", "", "q1", "0, 0, 1", [0, 0, 0], [0.2, 0, 0])
        + link("hand", "arm", "q2", "0, 0, 1", [0.5, 0, 0], [0.2, 0, 0]),
        f'bodies = ["arm", "hand"]\npoints = [[0.5, 0.2, 0], [{0.2 * s}, {0.2 * c}, 0]]\n'
        f"axis = [[0.6, 0.3, 0.8], [{0.6 * c + 0.3 * s}, {0.3 * c - 0.6 * s}, 0.8]]",
    )


def read(text: str) -> System:
    return assembled(from_scene(parse(text, "linkage.toml")))


@pytest.fixture(scope="module")
def bennett(modules: Modules) -> ModuleType:
    return modules.unoptimised(BENNETT)


def constant(q: np.ndarray) -> np.ndarray:
    """Return the invariant of Bennett's linkage as sine and cosine of an angle, which stay
    finite.
    """
    one, two = q[:, 0] / 2, q[:, 1] / 2
    return np.arctan2(np.sin(one) * np.sin(two), np.cos(one) * np.cos(two))


@pytest.mark.slow
def test_dependent_constraints_are_replaced_by_sums() -> None:
    """No two of Bennett's five constraints suffice everywhere; two sums of them do."""
    closure = read(BENNETT).closure
    assert closure is not None and closure.rank == 2 and closure.freedoms == 1
    assert closure.redundant == () and len(closure.sums) == 2 and len(closure.shared) == 5
    assert "solved as 2 linear combinations" in closure.ranks


@pytest.mark.slow
def test_planar_mechanism_closes_in_a_plane_with_a_rounded_normal() -> None:
    """Constraints across the plane are rounding and are dropped; one of the others is redundant."""
    flat, there = read(STANDING), read(tilted())
    assert [c.name for c in there.constraints] == ["pin_x", "pin_y", "pin_z"]
    for one, other in zip(flat.coordinates, there.coordinates, strict=True):
        assert (other.start, other.rate) == pytest.approx((one.start, one.rate), abs=1e-14)


@pytest.mark.parametrize("name", tiers(["bennett", "tilted"], "tilted"))
def test_redundant_constraints_with_rounded_coefficients_are_dropped(name: str) -> None:
    """With all constraints each step was reported as singular, and Bennett's linkage was locked."""
    drive = '[constraints]\ndrive = "q1 - 1 - 2*t"\n[run]'
    text = {"bennett": DRIVEN, "tilted": tilted().replace("[run]", drive)}[name]
    closure = read(text).closure
    assert closure is not None and closure.rank == 3 and not closure.freedoms
    assert len(closure.redundant) == len(closure.rows) - 3
    assert not any("far from singular" in remark for remark in closure.remarks)


@pytest.mark.parametrize("angle", tiers([0.0, 0.4], 0.0))  # exact numbers, or doubles
def test_implied_constraint_without_gradient_is_dropped(angle: float) -> None:
    """Such a constraint was refused, or weighted in a sum by the inverse of its rounding error."""
    closure = read(locked(angle)).closure
    assert closure is not None and closure.rank == 1 and closure.freedoms == 1
    assert "pin_y" in closure.redundant
    assert np.abs(closure.sums).max(initial=0) < 1e3


@pytest.mark.slow
def test_bennett_linkage_is_driven_around(modules: Modules) -> None:
    run = modules.unoptimised(DRIVEN).simulate(method="rk4")
    assert run.status == "ok" and run.singular_steps == 0
    assert run.q[-1, 0] == pytest.approx(4) and np.abs(run.q[:, 2] + run.q[:, 0]).max() < 1e-11


@pytest.mark.parametrize("how", [{"tol": 1e-10}, {"method": "rk4"}, {"method": "gauss8"}])
@pytest.mark.slow
def test_bennett_linkage_turns_through_singular_positions(
    bennett: ModuleType, how: dict[str, object]
) -> None:
    """The motion passes positions in which all links are collinear."""
    run = bennett.simulate(**how)
    assert run.status == "ok" and run.singular_steps == 0
    assert run.q[:, 0].min() < -3.2 and run.q[0, 0] == 1
    keeps = np.exp(1j * 2 * constant(run.q))
    assert np.abs(keeps - keeps[0]).max() < 1e-11
    assert np.abs(run.q[:, 2] + run.q[:, 0]).max() < 1e-11
    assert np.abs(run.energy - run.energy[0]).max() < 2e-8
    for x in run.constraints.values():
        assert np.abs(x).max() < 1e-13


@pytest.mark.slow
def test_multipliers_belong_to_the_constraints_of_the_scene(bennett: ModuleType) -> None:
    run = bennett.simulate(tol=1e-10, times=[0.0, 0.4, 1.1, 2.0])
    for q, qd in zip(run.q, run.qd, strict=True):
        x = bennett.multipliers(q, qd)
        force = bennett.D(q) @ bennett.acceleration(q, qd) + bennett.bias(q, qd)
        along = bennett.constraint_jacobian(q).T @ x
        assert along == pytest.approx(force, abs=1e-11 * np.abs(force).max())


@pytest.mark.slow
def test_projection_onto_redundant_constraints(bennett: ModuleType) -> None:
    q, qd = bennett.project([1.0, 2.7, -0.9], [1.0, 0.0, -1.0], fixed=["q1", "q1_dot"])
    assert q[0] == 1 and qd[0] == 1 and q[2] == pytest.approx(-1, abs=1e-14)
    assert qd[2] == pytest.approx(-1, abs=1e-14)


@pytest.mark.slow
def test_check_passes_for_sums_of_constraints(modules: Modules) -> None:
    text = BENNETT.replace(', "gauss8"', "")  # far start values violate constraints
    report = check(read(text), modules.unoptimised(text))
    assert report.passed, report.table()


@pytest.mark.slow
def test_constraints_do_not_depend_on_the_motion_of_a_common_ancestor(modules: Modules) -> None:
    """A four-bar on a turntable: constraints across its plane vanish for every angle of the
    table.
    """
    system = read(TURNTABLE)
    assert [c.name for c in system.constraints] == ["pin_x", "pin_z"]
    assert system.closure is not None and system.closure.rank == 2
    turning, standing = (modules.unoptimised(x) for x in (TURNTABLE, STANDING))
    run = turning.simulate(tol=1e-11)
    assert run.status == "ok" and np.abs(run.energy - run.energy[0]).max() < 1e-8
    momentum = np.array([turning.D(q) @ qd for q, qd in zip(run.q, run.qd, strict=True)])[:, 0]
    assert momentum == pytest.approx(momentum[0], rel=1e-9)
    # Without rotation the table acts as ground, and the pin force rotates with it.
    times = [0.1, 0.5]
    ground_run = standing.simulate(tol=1e-11, times=times)
    for angle in (0.0, 0.7, math.pi / 2):
        heavy = turning.simulate(
            [angle, *standing.start[0]], [0.0, *standing.start[1]], tol=1e-11, times=times
        )
        if angle == 0:
            assert heavy.q[:, 0] == pytest.approx(0, abs=1e-12)
        assert heavy.q[:, 1:] == pytest.approx(ground_run.q, abs=1e-9)
        force = ground_run.reactions["pin"][:, :3]
        c, s = math.cos(angle), math.sin(angle)
        turned = np.stack([c * force[:, 0], s * force[:, 0], force[:, 2]], axis=1)
        assert heavy.reactions["pin"][:, :3] == pytest.approx(turned, abs=1e-7)


@pytest.mark.slow
def test_closing_rods_may_be_massless(modules: Modules) -> None:
    """The crank of a four-bar moves as if it were alone; massless bodies used to be refused."""
    crank, rods = STANDING.split('name = "coupler"')
    rods = rods.replace("mass = 1\n", "mass = 0\n").replace("[0.01, 0.1, 0.1]", "[0, 0, 0]")
    linkage = modules.unoptimised(crank + 'name = "coupler"' + rods.replace(', "gauss8"', ""))
    q, qd = linkage.start
    alone = -9.81 * 0.15 * np.cos(q[0]) / (0.1 + 0.15**2)
    assert linkage.acceleration(q, qd)[0] == pytest.approx(alone, rel=1e-13)
    assert linkage.reactions(q, qd)["pin"] == pytest.approx(0, abs=1e-13)
