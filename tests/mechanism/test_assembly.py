"""Assembly: fixed values are unchanged, free ones move least, and contradictions are named."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import sympy
from scipy.spatial.transform import Rotation
from support import constraint_cases
from support.session import tiers

from eomc.base.errors import SceneError
from eomc.mechanism import ranks
from eomc.mechanism.assembly import assembled
from eomc.mechanism.manifold import Configuration, Manifold, random_walk
from eomc.model.constraints import find_wrong_rotations
from eomc.model.system import Constraint, System, from_scene, symbol, t
from eomc.scene.read import parse

NAMES = list(constraint_cases.cases())
SMALL = [name for name in NAMES if name not in ("iftomm_A02_four_bar_N40", "bricard_cube")]


def initial_positions(system: System) -> tuple[np.ndarray, np.ndarray]:
    q, qd = np.array([(c.start, c.rate) for c in system.coordinates]).T
    return q, qd


def refusal(system: System) -> str:
    with pytest.raises(SceneError) as error:
        assembled(system)
    return str(error.value)


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
    """Return a case assembled from its guess, with redundant rows unmarked."""
    return assembled(constraint_cases.system(name, "guess", redundant=False))


@pytest.mark.parametrize("name", tiers(NAMES, *SMALL))
def test_reference_initial_states_are_assembled_from_guesses(name: str) -> None:
    system = constraint_cases.system(name, "guess", redundant=False)
    assembled_system = assembled_case(name)
    q0, qd0 = constraint_cases.ends(name, "q0", "qd0")
    q, qd = initial_positions(assembled_system)
    np.testing.assert_allclose(q, q0, rtol=0, atol=2.3e-16 * max(1, np.max(np.abs(q0))))
    np.testing.assert_allclose(qd, qd0, rtol=0, atol=4.5e-16 * max(1, np.max(np.abs(qd0))))
    for before, after in zip(system.coordinates, assembled_system.coordinates, strict=True):
        assert not before.start_fixed or before.start == after.start
        assert not before.rate_fixed or before.rate == after.rate


@pytest.mark.parametrize("name", tiers(NAMES, *SMALL))
def test_ranks_and_degrees_of_freedom_agree_with_the_case(name: str) -> None:
    case, closure = constraint_cases.cases()[name], assembled_case(name).closure
    assert closure is not None
    rows = len(case["constraints"]) + len(case["velocity_constraints"])
    assert closure.rank == (case["redundant"] or {"rank": rows})["rank"]
    assert closure.freedoms == case["dof"]
    assert len(closure.redundant) == rows - closure.rank


@pytest.mark.slow
def test_bricard_drops_the_row_that_leaves_the_best_conditioned_four() -> None:
    system = assembled_case("bricard_cube")
    assert [c.redundant for c in system.constraints] == [False] * 4 + [True]
    assert system.closure is not None
    assert system.closure.ranks == (
        "rank 4 of 5: equation row_4 is redundant; "
        "the forces in row_0, row_1, row_2, row_3, row_4 are not unique"
    )
    assert any(system.closure.ranks in str(w) for w in system.warnings)


@pytest.mark.parametrize("name", tiers(SMALL, "four_bar_crank_rocker"))
def test_assembled_initial_state_is_not_assembled_again(name: str) -> None:
    system = assembled_case(name)
    assert assembled(system) is system
    again = assembled(replace(system, closure=None))
    for one, other in zip(initial_positions(system), initial_positions(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.constraints == system.constraints
    changed = assembled(
        system.with_parameters({system.parameters[0].name: system.parameters[0].value * 1.001})
    )
    assert changed.closure is not system.closure


def test_system_without_constraints_is_unchanged() -> None:
    system = System.make("free", {"x": 1.0}, "x_dot**2/2")
    assert assembled(system) is system


@pytest.mark.slow
def test_eighty_two_coordinates_are_assembled_in_seconds() -> None:
    began = time.process_time()
    assembled(constraint_cases.system("iftomm_A02_four_bar_N40", "guess", redundant=False))
    assert time.process_time() - began < 60


def test_free_values_move_least_in_the_metric_of_the_masses() -> None:
    """Two masses on a line, 1 kg and 3 kg: the heavier one moves a third as far."""
    system = scene(
        "a = { start = 0.0, guess = true }\nb = { start = 4.0, guess = true }", 'rod = "b - a - 2"'
    )
    system = replace(system, kinetic=system.kinetic + symbol("b_dot") ** 2)
    np.testing.assert_allclose(initial_positions(assembled(system))[0], [1.5, 3.5], rtol=1e-15)


def test_far_guess_is_projected_to_the_nearest_point_of_a_curve() -> None:
    system = scene(
        "x = { start = 3.0, guess = true }\ny = { start = 4.0, guess = true }",
        'rod = "x**2 + y**2/4 - 1"',
    )
    (x, y), _ = initial_positions(assembled(system))
    assert x**2 + y**2 / 4 == pytest.approx(1, rel=1e-15)
    tangent = np.array([y / 4, -x])  # tangent of the ellipse
    assert tangent @ [3.0 - x, 4.0 - y] == pytest.approx(0, abs=1e-7)


def test_free_velocities_are_consistent_and_fixed_ones_unchanged() -> None:
    system = scene(
        "x = { start = 0.6, rate = 1.0 }\ny = { start = 0.8, guess = true, rate = 5.0 }",
        'rod = "x**2 + y**2 - 1"',
    )
    _, qd = initial_positions(assembled(system))
    np.testing.assert_allclose(qd, [1.0, -0.75], rtol=1e-15)


def test_time_dependent_and_velocity_constraints_set_velocities() -> None:
    system = scene(
        "x = { guess = true }\npsi = { start = 0.3 }\ny = { start = 0.0 }",
        'drive = "x - sin(2*t) - 1"\nskate = "x_dot*sin(psi) - y_dot*cos(psi)"',
    )
    system = assembled(system)
    (x, _, _), (x_dot, _, y_dot) = initial_positions(system)
    assert (x, x_dot) == (1.0, 2.0)
    assert y_dot == pytest.approx(2 * np.tan(0.3), rel=1e-15)
    assert system.closure is not None and system.closure.freedoms == 1


@pytest.mark.parametrize("name", ["self", "qd", "q", "time", "name", "changed"])
def test_parameters_of_any_name_are_accepted(name: str) -> None:
    rows = f'c = "x - {name}*y"'
    system = assembled(scene("x = {}\ny = { start = 1 }", rows, f"[parameters]\n{name} = 2"))
    assert initial_positions(system)[0].tolist() == [2, 1]


def test_values_consistent_to_rounding_are_unchanged() -> None:
    system = scene(f"x = {{ start = {0.1 + 0.2!r} }}\ny = {{ start = 0.0 }}", 'a = "x - 0.3"')
    assert initial_positions(assembled(system))[0][0] == 0.1 + 0.2


def test_fixed_values_that_contradict_a_row_are_named_with_their_error() -> None:
    system = scene("x = { start = 0.7 }\ny = { start = 0.8 }", 'rod = "x**2 + y**2 - 1"')
    text = refusal(system)
    assert text.startswith(
        "made.toml:8:1: error: constraints.rod: cannot be satisfied with the fixed values "
        "x = 0.7, y = 0.8: "
    )
    assert "y would have to be 0.7141 (-0.086), or x would have to be 0.6 (-0.1)" in text
    assert "guess = true" in text


def test_fixed_values_that_contradict_jointly_are_named() -> None:
    system = scene("x = { start = 3.0 }\ny = { start = 4.0 }", 'rod = "x**2 + y**2 - 1"')
    assert "nor if one of them changes: x would have to be 0.6 (-2.4), y" in refusal(system)


def test_fixed_velocities_that_contradict_a_row_are_named() -> None:
    system = scene(
        "x = { start = 0.6, rate = 1.0 }\ny = { start = 0.8, rate = 1.0 }",
        'rod = "x**2 + y**2 - 1"',
    )
    text = refusal(system)
    assert (
        "constraints.rod: cannot be satisfied with the fixed velocities x_dot = 1, y_dot = 1"
        in text
    )
    assert "y_dot would have to be -0.75 (-1.8), or x_dot would have to be -1.333 (-2.3)" in text


def test_contradictory_rows_are_named() -> None:
    system = scene("x = { guess = true }\ny = {}", 'one = "x - 1"\ntwo = "x - 2"')
    text = refusal(system)
    assert (
        "constraints.one: contradicts two: the smallest residuals are one = 0.5, two = -0.5" in text
    )
    assert "Remove one of them, or correct a formula" in text


@pytest.mark.parametrize(
    "fixed_coordinates", ["x = { start = 0.6 }", "x = { guess = true, start = 0.6 }"]
)
def test_two_lengths_of_one_rod_are_contradictory(fixed_coordinates: str) -> None:
    rods = 'rod = "x**2 + y**2 - 1"\nrod2 = "x**2 + y**2 - 1.44"\nground = "z"'
    text = refusal(
        scene(f"{fixed_coordinates}\ny = {{ guess = true, start = -0.8 }}\nz = {{}}", rods)
    )
    assert "constraints.rod: contradicts rod2: the smallest residuals are rod = 0.2" in text
    assert "Remove one of them" in text and "ground" not in text and "x = 0.6" not in text


def test_only_contradictory_rows_are_named() -> None:
    rows = 'low = "z"\na = "x - 0.6"\nb = "y - 0.1"\nhigh = "z - y"\nc = "y - z + 1"'
    text = refusal(scene("x = {}\ny = {}\nz = {}", rows))
    assert "constraints.low: contradicts b, high: the smallest residuals are" in text
    assert "Remove one of them" in text


def test_rows_with_contradictory_velocities_are_named() -> None:
    two = refusal(scene("x = {}\ny = {}", 'one = "x - t"\ntwo = "x - 2*t"\nground = "y"'))
    assert "constraints.one: contradicts two: no velocities satisfy them. Remove one of them" in two
    rows = 'rod = "x**2 + y**2 - 1"\na = "x - 0.6"\nb = "y + 0.8 - 0.1*t"\nground = "z"'
    three = refusal(scene("x = { start = 0.6 }\ny = { start = -0.8 }\nz = {}", rows))
    assert (
        "constraints.rod: contradicts a, b: no velocities satisfy them. Remove one of them" in three
    )
    text = refusal(scene("x = { rate = 3.0 }", 'one = "x - t"\ntwo = "x - 2*t"'))
    assert "constraints.one: contradicts two: no velocities satisfy them" in text


def test_velocities_forbidden_by_a_singular_position_are_reported() -> None:
    rows = 'rod = "x**2 + y**2 - 1"\nlift = "y - 1 + 0.1*t"'
    text = refusal(scene("x = { start = 0.0 }\ny = { start = 1.0 }", rows))
    assert (
        "constraints.rod: cannot be satisfied together with lift by any initial velocities" in text
    )
    assert "the initial position is singular. Choose one nearby, or correct a formula" in text


@pytest.mark.parametrize("coupler", [0.6, 0.4])
def test_flat_initial_linkage_drops_no_row(coupler: float) -> None:
    """Only one of the directions that were tried had the length of a possible motion."""
    base = coupler + 0.2 - 0.2
    x = f"0.2*cos(p) + {coupler}*cos(p + q) - {base} - 0.2*cos(r)"
    y = f"0.2*sin(p) + {coupler}*sin(p + q) - 0.2*sin(r)"
    system = scene("p = {}\nq = {}\nr = {}", f'x = "{x}"\ny = "{y}"')
    result = assembled(system)
    assert result.closure.rank == 2 and not any(row.redundant for row in result.constraints)
    assert "singular position" in " ".join(map(str, result.warnings))


def test_loop_that_cannot_close_is_refused() -> None:
    """Two rods of 1 m link points at a distance of 3 m."""
    system = scene(
        "x = { start = 1.4, guess = true }\ny = { start = 0.1, guess = true }",
        'one = "x**2 + y**2 - 1"\ntwo = "(x - 3)**2 + y**2 - 1"',
    )
    assert (
        "constraints.one: cannot be satisfied together with two near the initial state"
        in refusal(system)
    )


def test_row_undefined_at_the_initial_position_is_refused() -> None:
    system = scene("x = { start = -1.0, guess = true }\ny = {}", 'root = "sqrt(x) - y"')
    text = refusal(system)
    assert (
        "constraints.root: has no value at x = -1, y = 0: choose an initial state where it has one"
        in text
    )


def test_row_without_a_gradient_at_the_initial_position_is_refused() -> None:
    system = scene("x = {}\ny = {}\nz = {}", 'root = "sqrt(x) - y"\nground = "z"')
    assert "constraints.root: has no derivative at x = 0, y = 0: choose an" in refusal(system)


def test_initial_position_with_undefined_energy_is_refused() -> None:
    system = scene("x = { start = -1.0 }\ny = {}", 'ground = "y"')
    system = replace(
        system, kinetic=system.kinetic + sympy.sqrt(symbol("x")) * symbol("x_dot") ** 2
    )
    assert "energy.kinetic: has no value at the initial state, x = -1, y = 0" in refusal(system)


def test_row_independent_of_coordinates_is_refused() -> None:
    x = symbol("x")
    system = System.make("idle", {x: 1.0}, symbol("x_dot") ** 2)
    system = replace(system, constraints=(Constraint("late", t - 1),))
    assert "constraints.late: depends on no coordinate: it can hold nothing" in refusal(system)


@pytest.mark.parametrize("formula", ["abs(x) + y", "y - max(x, 0)**2", "dot(min(x, y))"])
def test_nonsmooth_row_is_refused_by_name(formula: str) -> None:
    system = scene("x = {}\ny = {}\nz = {}", f'ground = "z"\nbent = "{formula}"')
    text = refusal(system)
    assert "constraints.bent: abs, min and max have corners, and constraints are diff" in text
    assert "ground" not in text and "energy" not in text


@pytest.mark.parametrize("start", ["guess = true, start = 0.6", "start = 0.0"])
@pytest.mark.parametrize(
    ("formula", "remedy"),
    [
        ("(x - y)**2", "write x - y in place of (x - y)**2"),
        pytest.param(
            "(x**2 - y)**3", "write x**2 - y in place of (x**2 - y)**3", marks=pytest.mark.slow
        ),
        ("x**2 - 2*x*y + y**2", "write x - y in place of x**2 - 2*x*y + y**2"),
    ],
)
def test_row_with_zero_gradient_where_it_is_satisfied_is_refused(
    start: str, formula: str, remedy: str, recwarn: pytest.WarningsRecorder
) -> None:
    rows = f'ground = "z"\nflat = "{formula}"'
    text = refusal(scene(f"x = {{ {start} }}\ny = {{ guess = true }}\nz = {{}}", rows))
    assert (
        f"constraints.flat: has a zero gradient where it is satisfied, so no force: {remedy}"
        in text
    )
    assert "ground" not in text and not recwarn


@pytest.mark.parametrize(
    ("formula", "remedy"),
    [
        ("(x - y)**2", "write x - y in place of (x - y)**2"),
        ("-3*(x - y)**2", "write x - y in place of -3*(x - y)**2"),
        ("(x - y)**2 + (z - 1)**4", "write an equation for each quantity that is zero"),
        ("gap", "write an equation for each quantity that is zero"),
        ("x*x - 2*x*y + y*y", "write x - y in place of x**2 - 2*x*y + y**2"),
        ("sin(x)**2 + 2*x*sin(y) - 2*x*sin(x) + x**2 - 2*sin(x)*sin(y) + sin(y)**2", "write "),
        ("x**3 - 3*x**2*y + 3*x*y**2 - y**3", "write x - y in place of x**3"),
    ],
)
def test_row_with_zero_gradient_is_refused_at_a_fixed_initial_position(
    formula: str, remedy: str
) -> None:
    fixed_coordinates = "x = { start = 1.0 }\ny = { start = 1.0 }\nz = { start = 1.0 }"
    more = '[definitions]\ngap = "(x - y)**2"' if formula == "gap" else ""
    text = refusal(scene(fixed_coordinates, f'rod = "{formula}"', more))
    assert (
        f"constraints.rod: has a zero gradient where it is satisfied, so no force: {remedy}" in text
    )


@pytest.mark.slow
def test_rows_singular_only_at_the_initial_position_are_accepted(
    recwarn: pytest.WarningsRecorder,
) -> None:
    for rows in ('a = "x*y"', 'a = "x**2*y + sin(x) - x"', 'a = "y**2 - x**3"'):
        system = assembled(scene("x = {}\ny = {}\nz = {}", rows))
        assert "singular position" in str(system.warnings[0])
    away = "x = { start = 1.0 }\ny = { start = 1.0 }\nz = {}"
    for rows in ('a = "(x - 1)*(y - 1)"', 'a = "(y - 1)**2 - (x - 1)**3"'):
        assert "singular position" in str(assembled(scene(away, rows)).warnings[0])
    small = 'a = "x**2 + y**2 - 1e-14"'
    system = assembled(scene("x = { start = 1e-7 }\ny = {}", small))
    assert system.closure is not None and system.closure.freedoms == 1 and not recwarn


def test_system_without_freedom_is_accepted_with_a_warning() -> None:
    system = assembled(scene("x = { guess = true }", 'wall = "x - 1"'))
    assert system.closure is not None and system.closure.freedoms == 0
    assert "nothing moves: a structure" in str(system.warnings[0])
    driven = assembled(scene("x = { guess = true }", 'drive = "x - sin(t)"'))
    assert [w.severity for w in driven.warnings] == ["note", "note"]
    assert "the constraints determine the motion in time" in str(driven.warnings[0])


def test_changed_initial_values_are_reported() -> None:
    system = assembled_case("four_bar_crank_rocker")
    (note,) = system.warnings
    assert note.severity == "note"
    assert "q2 = 0.59085 (guess 0.7), q3 = 1.21122 (guess 1.6)" in str(note)


def test_changes_by_rounding_are_not_reported() -> None:
    """At a right angle, rounded to a double, the second velocity is 6e-17 times the first."""
    rows = 'guide = "y - sin(x)"\ngear = "z - 2*x"'
    x = f"x = {{ start = {np.pi / 2!r}, rate = 3.0 }}"
    system = assembled(scene(f"{x}\ny = {{ start = 1.0 }}\nz = {{ start = {np.pi!r} }}", rows))
    assert 0 < system.coordinates[1].rate < 1e-15
    assert system.closure is not None and [m.name for m in system.closure.rate_moves] == ["z_dot"]
    small = assembled(scene("x = { rate = 3e-9 }\ny = {}", 'guide = "y - 1e-3*x"'))
    assert [str(w).count("y_dot = 3e-12") for w in small.warnings] == [1]


def test_repeated_row_is_redundant() -> None:
    system = assembled(
        scene(
            "x = { start = 0.6 }\ny = { guess = true, start = 0.7 }\nz = {}",
            'rod = "x**2 + y**2 - 1"\nagain = "3*y**2 + 3*x**2 - 3"\nground = "z"',
        )
    )
    assert [c.redundant for c in system.constraints] == [False, True, False]
    assert system.closure is not None
    assert system.closure.shared == ("rod", "again")
    assert system.closure.freedoms == 1


def test_rows_singular_only_at_the_initial_position_are_not_redundant() -> None:
    """In a flat parallelogram two rows have rank one there."""
    system = assembled(
        scene(
            "a = { start = 0.0 }\nb = { start = 0.0 }\nc = { start = 0.0 }",
            'x = "cos(a) + 2*cos(b) - cos(c) - 2"\ny = "sin(a) + 2*sin(b) - sin(c)"',
        )
    )
    assert system.closure is not None
    assert (system.closure.rank, system.closure.redundant) == (2, ())
    assert system.closure.start_sigma == 0
    assert "the start is a singular position" in "".join(map(str, system.warnings))


def test_coordinate_without_inertia_is_assembled() -> None:
    x, s = symbol("x"), symbol("s")
    system = System.make("massless", {x: 0.3, s: 5.0}, symbol("x_dot") ** 2, 9.81 * x)
    system = replace(
        system,
        constraints=(Constraint("drive", s - x - sympy.cos(t)),),
        coordinates=(system.coordinates[0], replace(system.coordinates[1], start_fixed=False)),
    )
    assert initial_positions(assembled(system))[0][1] == 1.3


@pytest.mark.parametrize("name", tiers(SMALL, "four_bar_crank_rocker", "pendulum_on_a_winch"))
def test_random_walk_satisfies_the_constraints(name: str) -> None:
    system = assembled_case(name)
    manifold = Manifold(system)
    configuration = manifold.configuration(initial_positions(system)[0])
    assert configuration is not None
    result = list(random_walk(manifold, configuration, ranks.SAMPLE_COUNT))
    assert len(result) == (ranks.SAMPLE_COUNT if system.closure and system.closure.freedoms else 0)
    for sample in result:
        assert np.max(np.abs(sample.phi)) < 1e-14 * (1 + np.max(np.abs(sample.q)))
    extent = np.ptp([p.q for p in result], axis=0)
    assert np.max(extent) > 0.1


@pytest.mark.parametrize("seed", range(6))
def test_singular_mass_matrix_with_regular_pivots_is_detected(seed: int) -> None:
    """Ranks are taken near a gimbal lock, where an error of NumPy once ended the build."""
    random = np.random.default_rng(seed)
    null_direction = np.append(random.normal(size=5), 1e-3)  # this direction moves no mass
    projector = np.eye(6) - np.outer(null_direction, null_direction) / (
        null_direction @ null_direction
    )
    B = random.normal(size=(6, 6))
    D = projector @ (B @ B.T + np.eye(6)) @ projector
    configuration = Configuration(np.zeros(6), 0.0, np.zeros(1), np.ones((1, 6)), D)
    assert configuration.singular and np.all(np.linalg.eigvalsh(configuration.metric) > 0)


def test_unconstrained_coordinates_without_inertia_are_named() -> None:
    """SymPy once raised "Invalid NaN comparison" here."""
    system = scene("x = {}\nv = {}\nw = {}", 'r = "v - w"')
    system = replace(system, kinetic=system.coordinates[0].qd ** 2 / 2)
    assert "coordinates.v: v, w can move together without moving mass or inertia" in refusal(system)
    assert assembled(replace(system, kinetic=sum(c.qd**2 for c in system.coordinates[:2]))).closure


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


def test_gradient_is_not_compared_with_distant_ones() -> None:
    """Compared with a gradient of e^100, the row's own was once taken for rounding."""
    closure = assembled(from_scene(parse(STEEP))).closure
    assert closure is not None and closure.rank == 1 and not closure.redundant


def test_row_with_zero_gradient_at_some_parameters_is_preserved() -> None:
    """It was once dropped for all parameters."""
    rows = assembled(from_scene(parse(SLOPING))).constraints
    assert [row.name for row in rows] == ["pin_x", "pin_y"]


def test_rounding_estimate_covers_terms_and_intermediate_values() -> None:
    manifold = Manifold(
        scene("x = {}\ny = {}", 'r = "3*x + 1e6*sin(y) - 1e6*y + 2e3*cos(x) - 2e3"')
    )
    at = np.array([0.0, 1.0])
    result = manifold.rounding(at, 0 * at, 0.0)[0] / 2.0**-52
    # the terms, and the effect of rounding y and sin(y)
    terms = 1e6 * np.sin(1) + 1e6 + 4e3
    expected = terms + 1e6 * np.sin(1) + 1e6 * abs(np.cos(1) - 1) + 2e3
    assert result == pytest.approx(expected, rel=0.01)
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
    """Write the free body welded to the world, rotated by an angle about an axis."""
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
def test_weld_is_closed_in_its_only_orientation(degrees: float, axis: Sequence[float]) -> None:
    """It was once refused at a quarter turn and closed in a wrong rotation from a distant guess."""
    system = assembled(from_scene(parse(welded(axis, np.radians(degrees)))))
    q = initial_positions(system)[0]
    assert find_wrong_rotations(system)(q.tolist(), 0.0, {}) == []
    quaternion = Rotation.from_euler("ZYX", q[3:]).as_quat()
    expected = Rotation.from_rotvec(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis))
    assert abs(quaternion @ expected.as_quat()) == pytest.approx(1, abs=1e-14)


def test_hinge_is_closed_with_axes_in_the_same_direction() -> None:
    text = f'{FREE}joint = "revolute"\naxis = [[0, 0, 1], [0.95, 0, -0.31]]\n'
    system = assembled(from_scene(parse(text)))
    assert find_wrong_rotations(system)(initial_positions(system)[0].tolist(), 0.0, {}) == []


def test_initially_singular_angles_are_named() -> None:
    """The message once asked for a mass."""
    message = refusal(from_scene(parse(welded([0, 1, 0], np.pi / 2))))
    assert "the mass matrix is singular, but not nearby" in message and "quaternion" in message
