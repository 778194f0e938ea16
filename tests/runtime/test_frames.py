"""Poses, Jacobians, inverse dynamics and momenta of a compiled module."""

from __future__ import annotations

import pickle
import sys
from types import ModuleType

import numpy as np
import pytest
from support.session import Modules
from support.template_checks import runs as sine_checks

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify.comparison import Comparison, Measurement
from eomc.verify.equations import Formulas
from eomc.verify.sampling import State

SPACE = """eomc = 1
name = "crane3"
gravity = [0, 0, "-9.81"]
[coordinates]
x = { unit = "m", start = 0.1 }
phi = { unit = "rad", start = 0.5, rate = 0.3 }
psi = { unit = "rad", start = 0.2, rate = 1 }
[definitions]
w = "x*cos(phi)"
[[body]]
name = "cart"
joint = "prismatic"
axis = [1, 0, 0]
coordinates = "x"
mass = 2.0
center = [0.1, 0.2, 0]
rotation = [["z", 0.3], ["x", 0.7]]
[[body]]
name = "arm"
parent = "cart"
joint = "universal"
coordinates = ["phi", "psi"]
mass = 1.0
center = [0, 0, -0.5]
inertia = [0.1, 0.2, 0.15, 0.01, 0.02, -0.01]
armature = [0.1, 0.2]
[[point]]
name = "tip"
body = "arm"
place = [0.1, 0.2, -1]
rotation = [["y", 0.4]]
[[point]]
name = "base"
body = "world"
place = [0.3, 0, 0.1]
[[body]]
name = "bob"
position = ["w + 0.1*t", "sin(phi)", "-cos(psi)"]
rotation = [["z", "phi+t"], ["x", "psi"]]
mass = 0.7
inertia = [0.1, 0.2, 0.15, 0.01, 0.02, -0.01]
[run]
frames = true
inverse_dynamics = true
momentum = true
"""
PLANE = """eomc = 1
name = "twolink"
gravity = [0, "-g"]
[coordinates]
a = { unit = "rad", start = 0.5 }
b = { unit = "rad", start = 0.3 }
[parameters]
l = 0.7
m = 1.2
g = 9.81
[[body]]
name = "upper"
joint = "revolute"
coordinates = "a"
mass = "m"
center = ["l/2", 0]
inertia = "m*l**2/12"
[[body]]
name = "lower"
parent = "upper"
joint = "revolute"
coordinates = "b"
offset = ["l", 0]
mass = "m"
center = ["l/2", 0]
inertia = "m*l**2/12"
damping = 0.1
[[point]]
name = "tip"
body = "lower"
place = ["l", 0]
rotation = "pi/2"
[run]
frames = ["tip"]
inverse_dynamics = true
momentum = true
"""
Q, QD, QDD = np.array([0.4, -1.1]), np.array([0.7, 0.3]), np.array([-0.2, 1.9])


@pytest.fixture(scope="module")
def plane(modules: Modules) -> ModuleType:
    return modules.unoptimised(PLANE)


@pytest.fixture(scope="module")
def space(modules: Modules) -> ModuleType:
    return modules.unoptimised(SPACE)


def tip_position(q: np.ndarray, length: float = 0.7) -> np.ndarray:
    a, c = q[0], q[0] + q[1]
    return length * np.array([np.cos(a) + np.cos(c), np.sin(a) + np.sin(c)])


def test_two_link_arm_equals_closed_form(plane: ModuleType) -> None:
    m, length, c = plane, 0.7, Q[0] + Q[1]
    position, angle = m.pose(Q, "tip")
    assert position == pytest.approx(tip_position(Q), rel=1e-14)
    assert angle == pytest.approx(c + np.pi / 2, rel=1e-14)
    sa, ca, sc, cc = np.sin(Q[0]), np.cos(Q[0]), np.sin(c), np.cos(c)
    J = length * np.array([[-sa - sc, -sc], [ca + cc, cc], [1 / length, 1 / length]])
    assert m.jacobian(Q, "tip") == pytest.approx(J, rel=1e-14)
    assert m.frame_velocity(Q, QD, "tip") == pytest.approx(J @ QD, rel=1e-13)
    drift = m.frame_acceleration(Q, QD, frame="tip")
    total_rate = QD[0] + QD[1]
    centripetal = -length * (QD[0] ** 2 * np.array([ca, sa]) + total_rate**2 * np.array([cc, sc]))
    assert drift == pytest.approx([*centripetal, 0.0], rel=1e-13)
    assert m.frame_acceleration(Q, QD, QDD, "tip") == pytest.approx(J @ QDD + drift, rel=1e-13)
    longer = m.pose(Q, "tip", params={"l": 1.4}).position
    assert longer == pytest.approx(tip_position(Q, 1.4), rel=1e-14)


def test_inverse_dynamics_equals_forces_of_a_motion(plane: ModuleType) -> None:
    m, wrench = plane, [3.0, -1.0, 0.2]
    tau = m.D(Q) @ QDD + m.bias(Q, QD)
    assert m.inverse_dynamics(Q, QD, QDD) == pytest.approx(tau, rel=1e-13)
    J = m.jacobian(Q, "tip")
    assert m.frame_forces(Q, {"tip": wrench}) == pytest.approx(J.T @ wrench, rel=1e-13)
    result = m.inverse_dynamics(Q, QD, QDD, {"tip": wrench})
    assert result == pytest.approx(tau - J.T @ wrench, rel=1e-13)
    # the inverse of the acceleration yields the applied forces
    qdd = m.acceleration(Q, QD)
    assert m.inverse_dynamics(Q, QD, qdd) == pytest.approx(m.tau(Q, QD), abs=1e-12)


def test_momenta_equal_closed_form(plane: ModuleType) -> None:
    momentum = plane.momentum(Q, QD)
    c, half = Q[0] + Q[1], 0.35
    center_1 = half * np.array([np.cos(Q[0]), np.sin(Q[0])])
    center_2 = tip_position(Q) - half * np.array([np.cos(c), np.sin(c)])
    assert momentum.mass == pytest.approx(2.4)
    assert momentum.center == pytest.approx((center_1 + center_2) / 2, rel=1e-14)
    h = 1e-6
    ends = [plane.momentum(Q + s * h * QD, QD).center for s in (1, -1)]
    assert momentum.linear / momentum.mass == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-8)
    v1 = QD[0] * np.array([-center_1[1], center_1[0]])
    v2 = 2 * momentum.linear / momentum.mass - v1
    spin = 1.2 * 0.7**2 / 12 * (2 * QD[0] + QD[1])
    orbital = sum(
        1.2 * (r[0] * v[1] - r[1] * v[0])
        for r, v in ((center_1 - center_2, v1), (center_2 - center_1, v2))
    )
    assert momentum.angular == pytest.approx(spin + orbital / 2, rel=1e-13)


def test_poses_and_momenta_are_unpickled_without_the_module(
    plane: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = plane.pose([0.3, 0.2]), plane.momentum([0.3, 0.2], [0.1, 0.4])
    pickled = pickle.dumps(values)
    for name in [m for m in sys.modules if m.startswith("_eomc_")]:
        monkeypatch.delitem(sys.modules, name)
    for loaded, value in zip(pickle.loads(pickled), values, strict=True):
        assert repr(loaded) == repr(value)


def test_many_states_equal_single_states(space: ModuleType) -> None:
    m, random = space, np.random.default_rng(0)
    assert m.frames == ("cart", "arm", "bob", "tip", "base")
    q, qd, qdd = random.normal(size=(3, 7, 3))
    t = np.linspace(0, 1, 7)
    w = random.normal(size=(7, 5, 6))
    for k in range(7):
        state, options = (q[k], qd[k]), {"t": t[k]}
        for name in ("position", "rotation"):
            assert np.array_equal(
                getattr(m.pose(q, t=t), name)[k], getattr(m.pose(q[k], **options), name)
            )
        assert np.array_equal(m.jacobian(q, t=t)[k], m.jacobian(q[k], **options))
        assert np.array_equal(m.jacobian(q, "tip", t=t)[k], m.jacobian(q[k], **options)[3])
        assert np.array_equal(m.frame_velocity(q, qd, t=t)[k], m.frame_velocity(*state, **options))
        row = m.frame_acceleration(q, qd, qdd, t=t)[k]
        assert np.array_equal(row, m.frame_acceleration(*state, qdd[k], **options))
        row = m.inverse_dynamics(q, qd, qdd, w, t=t)[k]
        assert np.array_equal(row, m.inverse_dynamics(*state, qdd[k], w[k], **options))
        assert np.array_equal(
            m.momentum(q, qd, t=t).angular[k], m.momentum(*state, **options).angular
        )
    shared = m.inverse_dynamics(q, qd, qdd[0], {"tip": w[0, 0]}, t=0.5)
    single = m.inverse_dynamics(q[3], qd[3], qdd[0], {"tip": w[0, 0]}, t=0.5)
    assert np.array_equal(shared[3], single)


def test_more_rows_than_one_call_computes(space: ModuleType) -> None:
    q = np.random.default_rng(1).normal(size=(5000, 3))
    forces = space.inverse_dynamics(q, q, q)
    assert np.array_equal(forces[4321], space.inverse_dynamics(*[q[4321]] * 3))


@pytest.mark.slow
def test_frame_accelerations_are_second_derivatives(modules: Modules) -> None:
    """Of a point's position, thus of all velocity terms, dJ/dt qd at qdd = 0."""
    places = [f"tip_{x}" for x in "xyz"] + [f"arm_{x}" for x in "xyz"]
    outputs = "\n".join(f'a_{name} = "dot(dot({name}))"' for name in places)
    center = '\n[[point]]\nname = "middle"\nbody = "arm"\nplace = [0, 0, -0.5]\n'
    text = SPACE.replace("crane3", "crane5").replace(
        "[run]", f"{center}[outputs]\n{outputs}\n[run]"
    )
    module, formulas = modules.unoptimised(text), Formulas(from_scene(parse(text, "test.toml")))
    random = np.random.default_rng(3)
    for _ in range(3):
        q, qd, qdd = random.uniform(-1, 1, (3, 3))
        for accelerations in (qdd, 0 * qdd):
            expected = formulas.evaluate(State(q, qd, 0.4), accelerations)
            result = [
                module.frame_acceleration(q, qd, accelerations, name, t=0.4)[:3]
                for name in ("tip", "middle")
            ]
            assert np.hstack(result) == pytest.approx(expected, abs=1e-14)


def test_frame_fixed_to_the_world(space: ModuleType) -> None:
    pose = space.pose([1.0, 2.0, 3.0], "base")
    assert pose.position.tolist() == [0.3, 0, 0.1]
    assert pose.rotation.tolist() == np.eye(3).tolist()
    assert not space.jacobian([1.0, 2.0, 3.0], "base").any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.pose(Q, "tipp"), "frame: 'tipp' is not one of tip; did you mean 'tip'?"),
        (lambda m: m.pose(Q, "upper"), "frame: 'upper' is not one of tip"),
        (lambda m: m.frame_forces(Q, {"tpi": [1, 2, 3]}), "wrenches: 'tpi' is not one of tip"),
        (lambda m: m.frame_forces(Q, {"tip": [1, 2]}), r"wrenches: tip: shape \(2,\), expected"),
        (lambda m: m.inverse_dynamics(Q, QD, [1.0]), r"qdd: shape \(1,\), expected \(2,\)"),
        (lambda m: m.inverse_dynamics(Q, QD, [np.nan, 0]), "qdd: not all numbers are finite"),
        (lambda m: m.inverse_dynamics(Q, [1.0], QDD), "qd: shape"),
    ],
)
def test_invalid_arguments_are_refused(plane: ModuleType, call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(plane)


def test_functions_that_were_not_built_are_refused_with_advice(cartpole: ModuleType) -> None:
    with pytest.raises(AttributeError, match=r"pose: not built: build it with \[run\] frames"):
        _ = cartpole.pose
    with pytest.raises(AttributeError, match=r"\[run\] inverse_dynamics = true"):
        _ = cartpole.inverse_dynamics


@pytest.mark.slow
def test_rounding_of_a_sum_is_not_taken_for_a_wrong_sine(modules: Modules) -> None:
    """Entries of a body placed by formulas cancel; no entry is one sine times something."""
    system = from_scene(parse(SPACE, "crane3.toml"))
    comparison = Comparison(system, modules.of_text(SPACE), np.random.default_rng(0), None)
    error = sine_checks.largest_error_near_zeros(comparison)
    assert isinstance(error, Measurement) or error <= sine_checks.VANISHING_LIMIT


def test_wrenches_without_frames_are_refused(modules: Modules) -> None:
    module = modules.unoptimised(f"{PLANE.partition('[run]')[0]}[run]\ninverse_dynamics = true\n")
    with pytest.raises(ValueError, match=r"f_ext acts at frames: .* \[run\] frames = true"):
        module.inverse_dynamics(Q, QD, QDD, {"tip": [1.0, 2.0, 3.0]})


def test_scenes_without_these_options_have_none_of_their_code() -> None:
    bare = eomc.sources(from_scene(parse(PLANE.partition("[run]")[0], "bare.toml")))
    full = eomc.sources(from_scene(parse(PLANE, "some.toml")))
    fragments = ("frame_", "_NF", "momentum", "inverse_dynamics")
    for name in ("twolink.h", "twolink.c"):
        assert not any(fragment in bare.files[name] for fragment in fragments)
        assert all(fragment in full.files[name] for fragment in fragments)
