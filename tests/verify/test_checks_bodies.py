"""Energies of bodies, checked with point masses: correct for every tree; errors are detected."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import sympy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.cases import SCENES
from support.fake_module import FakeModule
from support.session import tiers
from support.trees import SHAPES, trees

from eomc.model import hybrid, tree
from eomc.model import multibody as building
from eomc.model.system import from_scene
from eomc.scene.joints import JOINTS
from eomc.scene.read import parse, read
from eomc.verify import bodies
from eomc.verify.comparison import Comparison
from eomc.verify.sampling import State
from eomc.verify.taylor import Dual, TaylorReference

NAMES = ("kinetic_energy", "potential_energy", "power")


def energy_errors(text: str, states: int = 4) -> dict[str, float]:
    """Return the deviation of the reference's energies from those of point masses."""
    system = from_scene(parse(text, "test.toml"))
    assert system.scene is not None
    module = FakeModule(TaylorReference(system))  # has the same interface
    check = Comparison(system, module, np.random.default_rng(0), states)
    assert check.expected
    return {name: max(bodies.energy_error(name, check, e) for e in check.few(8)) for name in NAMES}


@pytest.mark.slow
@pytest.mark.parametrize("plane", [True, False])
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_energies_of_trees_equal_those_of_point_masses(plane: bool, data: Any) -> None:
    shape = data.draw(st.sampled_from([s for s in SHAPES if len(s) < 3]))
    off = energy_errors(data.draw(trees(shape, plane)))
    assert max(off.values()) < bodies.RELATIVE_LIMIT, off


KINDS = """
eomc = 1
name = "kinds"
gravity = [0.3, "-g", -2]
[coordinates]
a = { start = 0.3 }
b = { start = -0.4 }
c = { start = 0.5, rate = 0.3 }
d = { start = 0.2 }
e = { start = -0.3 }
f = { start = 0.7 }
[parameters]
m = 1.3
g = 9.81
[definitions]
y = "b0_x*sin(a) + t**2/7"
[energy]
kinetic = "m*dot(y)**2/2"
dissipation = "dot(y)**2/9"
[[body]]
name = "b0"
joint = "KIND"
coordinates = [COORDINATES]
mass = "m"
center = [0.1, 0.2, 0.3]
inertia = [0.5, 0.6, 0.7, 0.02, -0.03, 0.04]
rotation = [["x", 0.4], ["z", -0.9]]
offset = [0.2, -0.1, 0.4]
[[body]]
name = "placed"
mass = 0.7
inertia = [0.1, 0.2, 0.25]
position = ["y", "sin(c)", "t/3 + a"]
rotation = [["y", "b/2"], ["x", "a*t"]]
[[body]]
name = "rest"
mass = 1
inertia = [1, 1, 1]
position = ["d", "e + a", "f"]
rotation = [["z", "c + b"]]
[[spring]]
bodies = ["b0", "placed"]
points = [[0.1, 0, 0], [0, 0.5, 0.2]]
stiffness = 20
length = 0.4
[[damper]]
bodies = ["b0", "placed"]
points = [[0.1, 0, 0], [0, 0.5, 0.2]]
damping = 2
"""


def test_every_kind_of_joint_is_covered() -> None:
    assert bodies._MOTIONS.keys() == JOINTS.keys()


def kinds(kind: str, coordinates: str) -> str:
    quoted = ", ".join(f'"{c}"' for c in coordinates)
    return KINDS.replace("KIND", kind).replace("COORDINATES", quoted)


def single() -> str:
    """Return one body on a spherical joint, with a spring and a damper to the world."""
    head, rest = kinds("spherical", "abc").split("[definitions]")
    body = rest.split("[[body]]")[1]
    ends = rest.split("[[spring]]")[1].replace("placed", "world")
    head = "".join(line for line in head.splitlines(True) if line[:3] not in ("d =", "e =", "f ="))
    return f"{head}[[body]]{body}[[spring]]{ends}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, coordinates", tiers((("spherical", "abc"), ("free", "abcdef")), "spherical")
)
def test_joints_of_three_angles_and_bodies_placed_by_formulas(kind: str, coordinates: str) -> None:
    off = energy_errors(kinds(kind, coordinates), 3)
    assert max(off.values()) < bodies.RELATIVE_LIMIT, off


def wrong_rotation(axis: int, angle: Any) -> Any:
    return building_rotation(axis, -angle if axis == 1 else angle)


building_rotation = tree.rotation_about


def with_wrong(method: str, by: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    right = getattr(building.Builder, method)

    def patch(monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(
            building.Builder, method, lambda self, *a, **how: by(right(self, *a, **how))
        )

    return patch


# The error in multibody.py, and the energy that shows it.
WRONG = {
    "the sign of gravity": (with_wrong("gravity_potential", lambda P: -P), "potential_energy"),
    "a term of K": (with_wrong("kinetic_terms", lambda terms: terms[:-1]), "kinetic_energy"),
    "a factor in K": (with_wrong("kinetic_terms", lambda K: [2 * K[0], *K[1:]]), "kinetic_energy"),
    "the length of a spring": (with_wrong("length", lambda x: 2 * x), "potential_energy"),
    "the sense of a rotation": (
        lambda monkeypatch: monkeypatch.setattr(tree, "rotation_about", wrong_rotation),
        "kinetic_energy",
    ),
    "products of inertia": (
        lambda monkeypatch: monkeypatch.setattr(
            building.Builder, "kinetic_terms",
            lambda self, m, inertia, *place: RIGHT(self, m, [*inertia[:3], *(-sympy.S(x) for x in
                                                   inertia[3:])], *place),
        ),
        "kinetic_energy",
    ),
}  # fmt: skip
RIGHT = building.Builder.kinetic_terms


@pytest.mark.parametrize("what", tiers(WRONG, "products of inertia"))
def test_errors_in_energies_of_bodies_are_detected(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    patch, name = WRONG[what]
    patch(monkeypatch)
    assert energy_errors(single())[name] > 1e3 * bodies.RELATIVE_LIMIT


def test_missing_damper_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building.Builder, "add_damper", lambda *line: None)
    assert energy_errors(single())["power"] > 1e3 * bodies.RELATIVE_LIMIT


LIMITED = """
eomc = 1
name = "limited"
gravity = [0, -9.81]
[coordinates]
a = { start = 0.3, rate = 0.5 }
b = { start = -0.4 }
[parameters]
most = 1.5
[inputs]
u = { signal = "5*sin(t)", limits = [-1, "most"] }
v = { signal = "3 + t - slow", limits = [2.0, inf] }
[[body]]
name = "arm"
joint = "revolute"
coordinates = "a"
actuator = "u"
mass = 1
center = [0.2, 0]
inertia = 0.02
[[body]]
name = "slide"
parent = "arm"
joint = "prismatic"
axis = [1, 0]
coordinates = "b"
mass = 1
inertia = 0.02
[definitions]
push = "2*v"
slow = "3*a"
[forces]
b = "push"
"""


def test_inputs_are_saturated_at_their_limits() -> None:
    off = energy_errors(LIMITED, 12)
    assert max(off.values()) < bodies.RELATIVE_LIMIT, off


def test_missing_limits_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hybrid, "saturate_inputs", lambda system: system)
    assert energy_errors(LIMITED, 12)["power"] > 1e3 * bodies.RELATIVE_LIMIT


def test_terms_linear_in_velocities_are_not_part_of_the_energy() -> None:
    potential = '[energy]\npotential = "a*b + 0.3*arm_x*dot(arm_y) + way"\n'
    text = LIMITED.replace("[forces]", f'way = "0.2*a_dot*sin(b)"\n{potential}[forces]')
    off = energy_errors(text, 4)
    assert max(off.values()) < bodies.RELATIVE_LIMIT, off


def test_rotations_agree_with_scipy() -> None:
    random = np.random.default_rng(3)
    frame, rotation = bodies.MovingFrame(np.zeros(3), np.eye(3), 0.0), Rotation.identity()
    for axis, angle in zip(random.normal(size=(5, 3)), random.normal(size=5), strict=True):
        axis = axis / np.linalg.norm(axis)
        frame, rotation = frame.turned(angle, axis), rotation * Rotation.from_rotvec(angle * axis)
        np.testing.assert_allclose(frame.turn, rotation.as_matrix(), atol=1e-14)
    turning = frame.turned(Dual(0.0, 2.0), np.array([0.0, 0.6, 0.8]))
    expected = rotation.apply([0, 1.2, 1.6])
    np.testing.assert_allclose(bodies.angular_velocity(turning.turn), expected, atol=1e-14)


def test_point_masses_reproduce_the_inertia_of_the_body() -> None:
    system = from_scene(read(SCENES / "tumbling_box.toml"))
    assert system.scene is not None and system.scene.assembly is not None
    start = State(*np.array([(c.start, c.rate) for c in system.coordinates]).T)
    line = bodies.BodyMotion(system.scene, start)
    (body,) = [b for b in system.scene.assembly.bodies if b.joint]
    masses, points = zip(*line.points(body), strict=True)
    m, x = np.array(masses), np.array(points)
    assert math.isclose(m.sum(), float(line.evaluate(body.mass)))
    centre = m @ x / m.sum()
    np.testing.assert_allclose(centre, line.vector(body.center), atol=1e-12)
    r = x - centre
    tensor = sum(w * (y @ y * np.eye(3) - np.outer(y, y)) for w, y in zip(m, r, strict=True))
    np.testing.assert_allclose(
        tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
        [float(line.evaluate(entry)) for entry in body.inertia], atol=1e-12,
    )  # fmt: skip
