"""Starts are assembled: held values stay, the rest moves least, what contradicts is named."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import constrained
import numpy as np
import pytest
import sympy
from conftest import tiers
from scipy.spatial.transform import Rotation

from eomc.base.errors import SceneError
from eomc.model import loops
from eomc.model.from_scene import from_scene
from eomc.model.system import Constraint, System, symbol, t
from eomc.program import ranks
from eomc.program.assembly import assembled
from eomc.program.manifold import Configuration, Manifold, random_walk
from eomc.scene.read import parse

NAMES = list(constrained.cases())
SMALL = [name for name in NAMES if name not in ("iftomm_A02_four_bar_N40", "bricard_cube")]


def start_of(system: System) -> tuple[np.ndarray, np.ndarray]:
    q, qd = np.array([(c.start, c.rate) for c in system.coordinates]).T
    return q, qd


def refusal(system: System) -> str:
    with pytest.raises(SceneError) as fault:
        assembled(system)
    return str(fault.value)


def scene(coordinates: str, constraints: str, more: str = "") -> System:
    names = [line.split("=")[0].strip() for line in coordinates.splitlines() if line.strip()]
    kinetic = " + ".join(f"{name}_dot**2/2" for name in names)
    return from_scene(
        parse(
            f'eomc = 1\nname = "made"\n[coordinates]\n{coordinates}\n{more}\n'
            f'[constraints]\n{constraints}\n[energy]\nkinetic = "{kinetic}"\n',
            "made.toml",
        )
    )


@cache
def assembled_case(name: str) -> System:
    """A case from its guess, its redundant rows not marked."""
    return assembled(constrained.system(name, "guess", redundant=False))


@pytest.mark.parametrize("name", tiers(NAMES, *SMALL))
def test_trusted_starts_are_found_from_their_guesses(name: str) -> None:
    given = constrained.system(name, "guess", redundant=False)
    made = assembled_case(name)
    q0, qd0 = constrained.ends(name, "q0", "qd0")
    q, qd = start_of(made)
    np.testing.assert_allclose(q, q0, rtol=0, atol=2.3e-16 * max(1, np.max(np.abs(q0))))
    np.testing.assert_allclose(qd, qd0, rtol=0, atol=4.5e-16 * max(1, np.max(np.abs(qd0))))
    for before, after in zip(given.coordinates, made.coordinates, strict=True):
        assert not before.start_fixed or before.start == after.start
        assert not before.rate_fixed or before.rate == after.rate


@pytest.mark.parametrize("name", tiers(NAMES, *SMALL))
def test_ranks_and_freedoms_are_those_of_the_case(name: str) -> None:
    case, closure = constrained.cases()[name], assembled_case(name).closure
    assert closure is not None
    rows = len(case["constraints"]) + len(case["velocity_constraints"])
    assert closure.rank == (case["redundant"] or {"rank": rows})["rank"]
    assert closure.freedoms == case["dof"]
    assert len(closure.redundant) == rows - closure.rank


@pytest.mark.slow
def test_of_bricard_s_rows_the_one_is_left_out_that_leaves_the_best_four() -> None:
    made = assembled_case("bricard_cube")
    assert [c.redundant for c in made.constraints] == [False] * 4 + [True]
    assert made.closure is not None
    assert made.closure.ranks == (
        "rank 4 of 5: row row_4 is redundant; the forces in row_0, row_1, row_2, row_3, row_4 are "
        "not unique"
    )
    assert any(made.closure.ranks in str(w) for w in made.warnings)


@pytest.mark.parametrize("name", tiers(SMALL, "four_bar_crank_rocker"))
def test_a_start_is_assembled_once(name: str) -> None:
    made = assembled_case(name)
    assert assembled(made) is made
    again = assembled(replace(made, closure=None))
    for one, other in zip(start_of(made), start_of(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.constraints == made.constraints
    changed = assembled(
        made.with_parameters({made.parameters[0].name: made.parameters[0].value * 1.001})
    )
    assert changed.closure is not made.closure


def test_a_system_without_constraints_is_left_alone() -> None:
    made = System.make("free", {"x": 1.0}, "x_dot**2/2")
    assert assembled(made) is made


@pytest.mark.slow
def test_eighty_two_coordinates_take_seconds() -> None:
    began = time.process_time()
    assembled(constrained.system("iftomm_A02_four_bar_N40", "guess", redundant=False))
    assert time.process_time() - began < 60


def test_what_is_not_held_moves_least_in_the_metric_of_the_masses() -> None:
    """Two masses on a line, 1 kg and 3 kg: the heavier moves a third as far."""
    made = scene(
        "a = { start = 0.0, guess = true }\nb = { start = 4.0, guess = true }", 'rod = "b - a - 2"'
    )
    made = replace(made, kinetic=made.kinetic + symbol("b_dot") ** 2)
    np.testing.assert_allclose(start_of(assembled(made))[0], [1.5, 3.5], rtol=1e-15)


def test_a_far_guess_ends_at_the_nearest_place_of_a_bent_row() -> None:
    made = scene(
        "x = { start = 3.0, guess = true }\ny = { start = 4.0, guess = true }",
        'rod = "x**2 + y**2/4 - 1"',
    )
    (x, y), _ = start_of(assembled(made))
    assert x**2 + y**2 / 4 == pytest.approx(1, rel=1e-15)
    along = np.array([y / 4, -x])  # of the ellipse
    assert along @ [3.0 - x, 4.0 - y] == pytest.approx(0, abs=1e-7)


def test_rates_follow_and_held_ones_stay() -> None:
    made = scene(
        "x = { start = 0.6, rate = 1.0 }\ny = { start = 0.8, guess = true, rate = 5.0 }",
        'rod = "x**2 + y**2 - 1"',
    )
    _, qd = start_of(assembled(made))
    np.testing.assert_allclose(qd, [1.0, -0.75], rtol=1e-15)


def test_rows_of_time_and_of_rates_set_rates() -> None:
    made = scene(
        "x = { guess = true }\npsi = { start = 0.3 }\ny = { start = 0.0 }",
        'drive = "x - sin(2*t) - 1"\nskate = "x_dot*sin(psi) - y_dot*cos(psi)"',
    )
    made = assembled(made)
    (x, _, _), (x_dot, _, y_dot) = start_of(made)
    assert (x, x_dot) == (1.0, 2.0)
    assert y_dot == pytest.approx(2 * np.tan(0.3), rel=1e-15)
    assert made.closure is not None and made.closure.freedoms == 1


@pytest.mark.parametrize("name", ["self", "qd", "q", "time", "name", "changed"])
def test_parameters_have_any_name(name: str) -> None:
    rows = f'c = "x - {name}*y"'
    made = assembled(scene("x = {}\ny = { start = 1 }", rows, f"[parameters]\n{name} = 2"))
    assert start_of(made)[0].tolist() == [2, 1]


def test_values_that_are_near_to_rounding_are_left_as_they_are() -> None:
    made = scene(f"x = {{ start = {0.1 + 0.2!r} }}\ny = {{ start = 0.0 }}", 'a = "x - 0.3"')
    assert start_of(assembled(made))[0][0] == 0.1 + 0.2


def test_held_values_that_contradict_a_row_are_named_with_how_far_they_are_off() -> None:
    made = scene("x = { start = 0.7 }\ny = { start = 0.8 }", 'rod = "x**2 + y**2 - 1"')
    text = refusal(made)
    assert text.startswith(
        "made.toml:8:1: error: constraints.rod: can't be zero with x = 0.7, y = 0.8 held: "
    )
    assert "y would have to be 0.7141 (-0.086), or x would have to be 0.6 (-0.1)" in text
    assert "guess = true" in text


def test_held_values_that_are_off_together_are_named() -> None:
    made = scene("x = { start = 3.0 }\ny = { start = 4.0 }", 'rod = "x**2 + y**2 - 1"')
    assert "nor with one of them let go: together x would have to be 0.6 (-2.4), y" in refusal(made)


def test_held_rates_that_contradict_a_row_are_named() -> None:
    made = scene(
        "x = { start = 0.6, rate = 1.0 }\ny = { start = 0.8, rate = 1.0 }",
        'rod = "x**2 + y**2 - 1"',
    )
    text = refusal(made)
    assert "constraints.rod: changes at the start, with x_dot = 1, y_dot = 1 held" in text
    assert "y_dot would have to be -0.75 (-1.8), or x_dot would have to be -1.333 (-2.3)" in text


def test_rows_that_contradict_each_other_are_named() -> None:
    made = scene("x = { guess = true }\ny = {}", 'one = "x - 1"\ntwo = "x - 2"')
    text = refusal(made)
    assert "constraints.one: contradicts two: where they are least, one is 0.5, two is -0.5" in text
    assert "None changes alone: leave one out, or correct a formula" in text


@pytest.mark.parametrize("held", ["x = { start = 0.6 }", "x = { guess = true, start = 0.6 }"])
def test_two_lengths_of_one_rod_contradict(held: str) -> None:
    rods = 'rod = "x**2 + y**2 - 1"\nrod2 = "x**2 + y**2 - 1.44"\nground = "z"'
    text = refusal(scene(f"{held}\ny = {{ guess = true, start = -0.8 }}\nz = {{}}", rods))
    assert "constraints.rod: contradicts rod2: where they are least, rod is 0.2" in text
    assert "leave one out" in text and "ground" not in text and "x = 0.6" not in text


def test_of_rows_that_are_apart_those_that_contradict_are_named() -> None:
    rows = 'low = "z"\na = "x - 0.6"\nb = "y - 0.1"\nhigh = "z - y"\nc = "y - z + 1"'
    text = refusal(scene("x = {}\ny = {}\nz = {}", rows))
    assert "constraints.low: contradicts b, high: where they are least" in text
    assert "None changes alone: leave one out" in text


def test_rows_that_contradict_as_time_passes_are_named() -> None:
    two = refusal(scene("x = {}\ny = {}", 'one = "x - t"\ntwo = "x - 2*t"\nground = "y"'))
    assert (
        "constraints.one: contradicts two: no rates keep them zero. None changes alone: leave one"
        in two
    )
    rows = 'rod = "x**2 + y**2 - 1"\na = "x - 0.6"\nb = "y + 0.8 - 0.1*t"\nground = "z"'
    three = refusal(scene("x = { start = 0.6 }\ny = { start = -0.8 }\nz = {}", rows))
    assert (
        "constraints.rod: contradicts a, b: no rates keep them zero. None changes alone: leave one"
        in three
    )
    held = refusal(scene("x = { rate = 3.0 }", 'one = "x - t"\ntwo = "x - 2*t"'))
    assert "constraints.one: contradicts two: no rates keep them zero" in held


def test_rates_that_a_singular_position_alone_forbids_are_told_so() -> None:
    rows = 'rod = "x**2 + y**2 - 1"\nlift = "y - 1 + 0.1*t"'
    text = refusal(scene("x = { start = 0.0 }\ny = { start = 1.0 }", rows))
    assert "constraints.rod: changes at the start together with lift, and no rates mend it" in text
    assert "the start is a singular position. Start beside it, or correct a formula" in text


@pytest.mark.parametrize("coupler", [0.6, 0.4])
def test_a_linkage_that_starts_flat_keeps_its_rows(coupler: float) -> None:
    """Of the headings that were tried one alone was of a length at which it could be a motion's."""
    base = coupler + 0.2 - 0.2
    x = f"0.2*cos(p) + {coupler}*cos(p + q) - {base} - 0.2*cos(r)"
    y = f"0.2*sin(p) + {coupler}*sin(p + q) - 0.2*sin(r)"
    made = scene("p = {}\nq = {}\nr = {}", f'x = "{x}"\ny = "{y}"')
    found = assembled(made)
    assert found.closure.rank == 2 and not any(row.redundant for row in found.constraints)
    assert "singular position" in " ".join(map(str, found.warnings))


def test_a_loop_that_can_not_close_is_refused() -> None:
    """Two rods of 1 m between points 3 m apart."""
    made = scene(
        "x = { start = 1.4, guess = true }\ny = { start = 0.1, guess = true }",
        'one = "x**2 + y**2 - 1"\ntwo = "(x - 3)**2 + y**2 - 1"',
    )
    assert "constraints.one: can't be zero together with two near the start" in refusal(made)


def test_a_start_without_a_value_is_refused() -> None:
    made = scene("x = { start = -1.0, guess = true }\ny = {}", 'root = "sqrt(x) - y"')
    text = refusal(made)
    assert "constraints.root: has no value at x = -1, y = 0: start where it has one" in text


def test_a_start_without_a_slope_is_refused() -> None:
    made = scene("x = {}\ny = {}\nz = {}", 'root = "sqrt(x) - y"\nground = "z"')
    assert "constraints.root: has no slope at x = 0, y = 0: start where" in refusal(made)


def test_a_start_at_which_the_energy_has_no_value_is_refused() -> None:
    made = scene("x = { start = -1.0 }\ny = {}", 'ground = "y"')
    made = replace(made, kinetic=made.kinetic + sympy.sqrt(symbol("x")) * symbol("x_dot") ** 2)
    assert "energy.kinetic: has no value at the start, x = -1, y = 0" in refusal(made)


def test_a_row_that_no_coordinate_moves_is_refused() -> None:
    x = symbol("x")
    made = System.make("idle", {x: 1.0}, symbol("x_dot") ** 2)
    made = replace(made, constraints=(Constraint("late", t - 1),))
    assert "constraints.late: depends on no coordinate: it can hold nothing" in refusal(made)


@pytest.mark.parametrize("formula", ["abs(x) + y", "y - max(x, 0)**2", "dot(min(x, y))"])
def test_a_row_with_a_corner_is_refused_by_its_name(formula: str) -> None:
    made = scene("x = {}\ny = {}\nz = {}", f'ground = "z"\nbent = "{formula}"')
    text = refusal(made)
    assert "constraints.bent: abs, min and max have corners, and constraints are diff" in text
    assert "ground" not in text and "energy" not in text


@pytest.mark.parametrize("start", ["guess = true, start = 0.6", "start = 0.0"])
@pytest.mark.parametrize(
    ("formula", "instead"),
    [
        ("(x - y)**2", "write x - y for (x - y)**2"),
        pytest.param("(x**2 - y)**3", "write x**2 - y for (x**2 - y)**3", marks=pytest.mark.slow),
        ("x**2 - 2*x*y + y**2", "write x - y for x**2 - 2*x*y + y**2"),
    ],
)
def test_a_row_without_a_slope_where_it_holds_is_refused(
    start: str, formula: str, instead: str, recwarn: pytest.WarningsRecorder
) -> None:
    rows = f'ground = "z"\nflat = "{formula}"'
    text = refusal(scene(f"x = {{ {start} }}\ny = {{ guess = true }}\nz = {{}}", rows))
    assert f"constraints.flat: has no slope where it holds, and so no force: {instead}" in text
    assert "ground" not in text and not recwarn


@pytest.mark.parametrize(
    ("formula", "instead"),
    [
        ("(x - y)**2", "write x - y for (x - y)**2"),
        ("-3*(x - y)**2", "write x - y for -3*(x - y)**2"),
        ("(x - y)**2 + (z - 1)**4", "write each thing that is zero by itself"),
        ("gap", "write each thing that is zero by itself"),
        ("x*x - 2*x*y + y*y", "write x - y for x**2 - 2*x*y + y**2"),
        ("sin(x)**2 + 2*x*sin(y) - 2*x*sin(x) + x**2 - 2*sin(x)*sin(y) + sin(y)**2", "write "),
        ("x**3 - 3*x**2*y + 3*x*y**2 - y**3", "write x - y for x**3"),
    ],
)
def test_a_row_without_a_slope_is_refused_where_the_held_start_obeys_it(
    formula: str, instead: str
) -> None:
    held = "x = { start = 1.0 }\ny = { start = 1.0 }\nz = { start = 1.0 }"
    more = '[definitions]\ngap = "(x - y)**2"' if formula == "gap" else ""
    text = refusal(scene(held, f'rod = "{formula}"', more))
    assert f"constraints.rod: has no slope where it holds, and so no force: {instead}" in text


@pytest.mark.slow
def test_rows_that_fade_out_at_a_start_and_nowhere_else_are_allowed(
    recwarn: pytest.WarningsRecorder,
) -> None:
    for rows in ('a = "x*y"', 'a = "x**2*y + sin(x) - x"', 'a = "y**2 - x**3"'):
        made = assembled(scene("x = {}\ny = {}\nz = {}", rows))
        assert "singular position" in str(made.warnings[0])
    away = "x = { start = 1.0 }\ny = { start = 1.0 }\nz = {}"
    for rows in ('a = "(x - 1)*(y - 1)"', 'a = "(y - 1)**2 - (x - 1)**3"'):
        assert "singular position" in str(assembled(scene(away, rows)).warnings[0])
    small = 'a = "x**2 + y**2 - 1e-14"'
    made = assembled(scene("x = { start = 1e-7 }\ny = {}", small))
    assert made.closure is not None and made.closure.freedoms == 1 and not recwarn


def test_no_freedom_is_told_but_allowed() -> None:
    made = assembled(scene("x = { guess = true }", 'wall = "x - 1"'))
    assert made.closure is not None and made.closure.freedoms == 0
    assert "nothing moves: a structure" in str(made.warnings[0])
    driven = assembled(scene("x = { guess = true }", 'drive = "x - sin(t)"'))
    assert [w.severity for w in driven.warnings] == ["note", "note"]
    assert "the rows alone decide the motion in time" in str(driven.warnings[0])


def test_what_has_moved_is_told() -> None:
    made = assembled_case("four_bar_crank_rocker")
    (note,) = made.warnings
    assert note.severity == "note"
    assert "q2 = 0.59085 (guess 0.7), q3 = 1.21122 (guess 1.6)" in str(note)


def test_what_has_moved_by_a_rounding_is_not_told() -> None:
    """At a right angle, which no double is, the second rate is 6e-17 times the first."""
    rows = 'guide = "y - sin(x)"\ngear = "z - 2*x"'
    x = f"x = {{ start = {np.pi / 2!r}, rate = 3.0 }}"
    made = assembled(scene(f"{x}\ny = {{ start = 1.0 }}\nz = {{ start = {np.pi!r} }}", rows))
    assert 0 < made.coordinates[1].rate < 1e-15
    assert made.closure is not None and [m.name for m in made.closure.rate_moves] == ["z_dot"]
    small = assembled(scene("x = { rate = 3e-9 }\ny = {}", 'guide = "y - 1e-3*x"'))
    assert [str(w).count("y_dot = 3e-12") for w in small.warnings] == [1]


def test_a_row_that_is_said_twice_is_redundant() -> None:
    made = assembled(
        scene(
            "x = { start = 0.6 }\ny = { guess = true, start = 0.7 }\nz = {}",
            'rod = "x**2 + y**2 - 1"\nagain = "3*y**2 + 3*x**2 - 3"\nground = "z"',
        )
    )
    assert [c.redundant for c in made.constraints] == [False, True, False]
    assert made.closure is not None
    assert made.closure.shared == ("rod", "again")
    assert made.closure.freedoms == 1


def test_rows_that_fade_out_at_the_start_alone_are_not_redundant() -> None:
    """A parallelogram that lies flat: two rows of rank one, there."""
    made = assembled(
        scene(
            "a = { start = 0.0 }\nb = { start = 0.0 }\nc = { start = 0.0 }",
            'x = "cos(a) + 2*cos(b) - cos(c) - 2"\ny = "sin(a) + 2*sin(b) - sin(c)"',
        )
    )
    assert made.closure is not None
    assert (made.closure.rank, made.closure.redundant) == (2, ())
    assert made.closure.start_sigma == 0
    assert "the start is a singular position" in "".join(map(str, made.warnings))


def test_a_coordinate_without_inertia_is_assembled() -> None:
    x, s = symbol("x"), symbol("s")
    made = System.make("massless", {x: 0.3, s: 5.0}, symbol("x_dot") ** 2, 9.81 * x)
    made = replace(
        made,
        constraints=(Constraint("drive", s - x - sympy.cos(t)),),
        coordinates=(made.coordinates[0], replace(made.coordinates[1], start_fixed=False)),
    )
    assert start_of(assembled(made))[0][1] == 1.3


@pytest.mark.parametrize("name", tiers(SMALL, "four_bar_crank_rocker", "pendulum_on_a_winch"))
def test_a_walk_stays_on_the_rows(name: str) -> None:
    made = assembled_case(name)
    manifold = Manifold(made)
    place = manifold.configuration(start_of(made)[0])
    assert place is not None
    found = list(random_walk(manifold, place, ranks.SAMPLE_COUNT))
    assert len(found) == (ranks.SAMPLE_COUNT if made.closure and made.closure.freedoms else 0)
    for there in found:
        assert np.max(np.abs(there.phi)) < 1e-14 * (1 + np.max(np.abs(there.q)))
    far = np.ptp([p.q for p in found], axis=0)
    assert np.max(far) > 0.1


@pytest.mark.parametrize("seed", range(6))
def test_a_singular_mass_matrix_is_known_where_its_pivots_hide_it(seed: int) -> None:
    """As at a gimbal lock that ranks are taken near: NumPy's error ended the build."""
    random = np.random.default_rng(seed)
    still = np.append(random.normal(size=5), 1e-3)  # what moves no mass, hardly the last one
    across = np.eye(6) - np.outer(still, still) / (still @ still)
    B = random.normal(size=(6, 6))
    D = across @ (B @ B.T + np.eye(6)) @ across
    place = Configuration(np.zeros(6), 0.0, np.zeros(1), np.ones((1, 6)), D)
    assert place.singular and np.all(np.linalg.eigvalsh(place.metric) > 0)


def test_what_moves_without_inertia_and_no_row_holds_is_named() -> None:
    """It ended in SymPy's error, "Invalid NaN comparison"."""
    made = scene("x = {}\nv = {}\nw = {}", 'r = "v - w"')
    made = replace(made, kinetic=made.coordinates[0].qd ** 2 / 2)
    assert "coordinates.v: v, w can move together without moving anything that has" in refusal(made)
    assert assembled(replace(made, kinetic=sum(c.qd**2 for c in made.coordinates[:2]))).closure


STEEP = """eomc = 1
name = "steep"
[coordinates]
x = {}
y = { guess = true }
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
[constraints]
diode = "exp(x/0.01) - exp(2*y/0.01)"
"""
SLOPING = """eomc = 1
name = "sloping"
gravity = [0, -9.81]
[coordinates]
x = { rate = 1.0 }
s = { guess = true }
[parameters]
w = 0.0
[[body]]
name = "cart"
mass = 1
inertia = 1
position = ["x", "w*x"]
[[body]]
name = "rod"
mass = 1
inertia = 1
position = ["s", "0"]
[[loop]]
name = "pin"
joint = "revolute"
bodies = ["cart", "rod"]
points = [[0, 0], [0, 0]]
"""


def test_a_row_that_is_far_steeper_elsewhere_has_a_slope() -> None:
    """Beside a slope of e^100 its own was taken for rounding, and the scene was refused."""
    closure = assembled(from_scene(parse(STEEP))).closure
    assert closure is not None and closure.rank == 1 and not closure.redundant


def test_a_row_that_is_level_at_these_parameters_alone_stays() -> None:
    """It was left out for good, and nothing held it at others."""
    rows = assembled(from_scene(parse(SLOPING))).constraints
    assert [row.name for row in rows] == ["pin_x", "pin_y"]


def test_rounding_is_that_of_the_terms_and_the_intermediate_values() -> None:
    made = Manifold(scene("x = {}\ny = {}", 'r = "3*x + 1e6*sin(y) - 1e6*y + 2e3*cos(x) - 2e3"'))
    at = np.array([0.0, 1.0])
    found = made.rounding(at, 0 * at, 0.0)[0] / 2.0**-52
    # the terms, and what one rounding of y and of sin(y) does
    terms = 1e6 * np.sin(1) + 1e6 + 4e3
    expected = terms + 1e6 * np.sin(1) + 1e6 * abs(np.cos(1) - 1) + 2e3
    assert found == pytest.approx(expected, rel=0.01)
    nowhere = Manifold(scene("x = {}", 'r = "log(x)"'))
    assert nowhere.rounding(np.zeros(1), np.zeros(1), 0.0) == [0.0]


FREE = """eomc = 1
name = "free_body"
gravity = [0, 0, -9.81]
[coordinates]
x = {}
y = {}
z = {}
yaw = {}
pitch = {}
roll = {}
[[body]]
name = "a"
joint = "free"
coordinates = ["x", "y", "z", "yaw", "pitch", "roll"]
mass = 1
center = [0.1, 0, 0]
inertia = [0.1, 0.2, 0.25]
[[loop]]
name = "pin"
bodies = ["world", "a"]
points = [[0, 0, 1], [0.1, 0, 0]]
"""


def welded(axis: Sequence[float], angle: float) -> str:
    """The free body welded to the world, turned by an angle about an axis."""
    x, y, z = np.array(axis) / np.linalg.norm(axis) * np.sin(angle / 2)
    w = np.cos(angle / 2)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = np.arcsin(2 * (w * y - x * z))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return f'{FREE}joint = "weld"\nrotation = [["z", {yaw}], ["y", {pitch}], ["x", {roll}]]\n'


@pytest.mark.parametrize(
    ("degrees", "axis"),
    [
        (70, (1, 1, 1)), (90, (1, 0, 0)), (180, (1, 0, 0)),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                (90, (0, 0, 1)), (90, (1, 2, 3)), (150, (1, 2, -1)), (180, (0, 0, 1)),
                (180, (0, 1, 0)), (180, (-1, 2, 0.3)),
            ]
        ),
    ],
)  # fmt: skip
def test_a_weld_is_closed_in_its_one_orientation(degrees: float, axis: Sequence[float]) -> None:
    """It was refused at a quarter turn, and closed in a wrong rotation from far away."""
    made = assembled(from_scene(parse(welded(axis, np.radians(degrees)))))
    q = start_of(made)[0]
    assert loops.find_wrong_rotations(made)(q.tolist(), 0.0, {}) == []
    turned = Rotation.from_euler("ZYX", q[3:]).as_quat()
    expected = Rotation.from_rotvec(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis))
    assert abs(turned @ expected.as_quat()) == pytest.approx(1, abs=1e-14)


def test_a_hinge_whose_axes_are_far_apart_is_closed_with_axes_alike() -> None:
    text = f'{FREE}joint = "revolute"\naxis = [[0, 0, 1], [0.95, 0, -0.31]]\n'
    made = assembled(from_scene(parse(text)))
    assert loops.find_wrong_rotations(made)(start_of(made)[0].tolist(), 0.0, {}) == []


def test_a_start_at_which_angles_are_singular_is_named() -> None:
    """It was told to give what moves a mass."""
    said = refusal(from_scene(parse(welded([0, 1, 0], np.pi / 2))))
    assert "the mass matrix is singular, though it is not nearby" in said and "quaternion" in said
