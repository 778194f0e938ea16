"""Regressors: inverse dynamics for any parameters, base parameters of known robots, estimates."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import trees
from support.cases import SCENES

import eomc
from eomc.base.errors import EomcError

pytestmark = [pytest.mark.usefixtures("quickly_compiled")]

VALUES = ("m", "cx", "cy", "cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
MASSES = ("base", "slide", "tool", "finger", "spool", "satellite", "block")


def body(name: str, joint: str, coordinates: Any = (), **more: Any) -> dict[str, Any]:
    """Return a body whose mass, centre and inertia are parameters."""
    mass, *rest = (f"{name}_{value}" for value in VALUES)
    own = {"name": name, "mass": mass, "inertia": rest[3:]}
    if joint:
        own |= {"joint": joint, "center": rest[:3]}
    return {**own, **({"coordinates": coordinates} if coordinates else {}), **more}


BODIES = (
    {"name": "shelf", "joint": "fixed", "mass": 2, "offset": [0, 0, 1], "rotation": [["y", 0.3]]},
    body("base", "revolute", "a", parent="shelf", axis=[1, 2, -2], armature="rotor",
         damping="loss", friction="drag", friction_width=0.2),
    body("slide", "prismatic", "x", parent="base", axis=[0, -1, 0], offset=[0.1, "l", 0]),
    body("tool", "fixed", parent="slide", offset=[0, 0.2, 0.1], rotation=[["x", 0.7]]),
    body("finger", "revolute", "0.5*a - l*x + 0.2", parent="tool", axis=[0, 1, 0], damping=0.3,
         offset=[0, 0, "l"]),
    body("spool", "cylindrical", ["b", "p"], parent="base", axis=[0, 0, -1], armature=[0.1, 0.2]),
    body("satellite", "free", ["sx", "sy", "sz", "yaw", "pitch", "roll"]),
    body("block", "", position=["x*cos(a) + l*sin(2*t)", "b", "x*sin(a)"],
         rotation=[["z", "a + t"], ["x", "p"]]),
)  # fmt: skip
DEFAULTS = {"g": 9.81, "l": 0.4, "rotor": 0.2, "loss": 0.7, "drag": 1.5} | {
    f"{name}_{value}": round(0.1 + ((7 * k + 3 * i) % 11) / 10 + 5 * (4 <= i < 7), 3)
    for k, name in enumerate(MASSES)
    for i, value in enumerate(VALUES)
}
SCENE = trees.text(BODIES, [0.5, 0.2, "-g"], DEFAULTS)


def ten(p: Mapping[str, float], name: str) -> np.ndarray:
    """Return the parameters of a body about the origin of its frame, in the documented order."""
    m, x, y, z, xx, yy, zz, xy, xz, yz = (p[f"{name}_{value}"] for value in VALUES)
    c = np.array([x, y, z]) * (name != "block")  # its origin is its centre of mass
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    tensor += m * (c @ c * np.eye(3) - np.outer(c, c))
    return np.hstack([m, m * c, tensor[np.tril_indices(3)]])


def moved(values: np.ndarray, r: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the ten parameters in a frame in which their own frame is at r, rotated by R."""
    m, h, tensor = values[0], R @ values[1:4], np.zeros((3, 3))
    tensor[np.tril_indices(3)] = values[4:]
    tensor = R @ (tensor + np.tril(tensor, -1).T) @ R.T
    cross = 2 * h @ r * np.eye(3) - np.outer(h, r) - np.outer(r, h)
    tensor += cross + m * (r @ r * np.eye(3) - np.outer(r, r))
    return np.hstack([m, h + m * r, tensor[np.tril_indices(3)]])


def write(folder: Path, text: str) -> Path:
    file = folder / "scene.toml"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("regressor")


def parameters(p: Mapping[str, float]) -> np.ndarray:
    """Return all parameters of SCENE, with the tool that is fixed to the slide."""
    c, s = np.cos(0.7), np.sin(0.7)
    tool = moved(
        ten(p, "tool"), np.array([0, 0.2, 0.1]), np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    )
    bodies = [ten(p, name) + (name == "slide") * tool for name in MASSES if name != "tool"]
    return np.hstack([*bodies, p["rotor"], p["loss"], p["drag"], 0.3, 0.1, 0.2])


@pytest.mark.slow
def test_regressor_gives_the_inverse_dynamics_for_any_parameters(folder: Path) -> None:
    """Joints of all kinds, fixed and coupled bodies, bodies placed by formulas, drives."""
    regressor = eomc.regressor(write(folder, SCENE), folder)
    module, random = regressor.module, np.random.default_rng(5)
    names = dict.fromkeys(name.partition(".")[0] for name in regressor.names)
    assert [*names] == [b["name"] for b in BODIES if b["name"] not in ("shelf", "tool")]
    joints = ["base.armature", "base.damping", "base.friction", "finger.damping",
              "spool.armature_1", "spool.armature_2"]  # fmt: skip
    assert list(regressor.names[-6:]) == joints
    np.testing.assert_allclose(regressor.parameters, parameters(DEFAULTS), rtol=1e-14, atol=1e-15)
    q, qd, qdd = random.uniform(-1, 1, (3, 9, len(module.coordinates)))
    t = random.uniform(0, 3, len(q))
    Y = regressor.Y(q, qd, qdd, t)
    np.testing.assert_array_equal(regressor.Y(q[3], qd[3], qdd[3], t[3]), Y[3])
    for _ in range(5):
        p = {k: x if k in "gl" else x * random.uniform(-2, 3) for k, x in DEFAULTS.items()}
        required = module.inverse_dynamics(q, qd, qdd, t=t, params=p)
        drives = required - module.tau(q, qd, t=t, params=p)
        error = np.abs(Y @ parameters(p) - drives).max()
        assert error < 1e-12 * np.abs(drives).max()
        assert np.abs(required - drives).max() > 1e-3 * np.abs(drives).max()


def test_base_parameters_of_a_planar_chain(folder: Path) -> None:
    """The mass of the second link acts as a point mass on the first."""
    regressor = eomc.regressor(write(folder, trees.chain(2)), folder)
    base = regressor.base_parameters()
    assert base.names == (
        "link1.mx + 0.7*link2.m", "link1.my", "link1.Izz + 0.49*link2.m",
        "link2.mx", "link2.my", "link2.Izz",
    )  # fmt: skip
    m, l = 1.3, 0.7  # noqa: E741
    about_end = m * l**2 / 3
    expected = [m * l / 2 + l * m, 0, about_end + l**2 * m, m * l / 2, 0, about_end]
    np.testing.assert_allclose(base.values, expected, rtol=1e-12, atol=1e-12)
    assert base.without_effect == ("link1.m",)
    assert "6 base parameters of 8 parameters" in str(base)
    assert "without effect: link1.m" in str(base)
    # what only a motion of the first joint would determine
    states = np.random.default_rng(2).uniform(-1, 1, (3, 30, 2)) * [0, 1]
    assert "link1.Izz" in regressor.base_parameters(regressor.Y(*states)).without_effect
    with pytest.raises(EomcError, match=r"Y is \(2, 6\), but there are 8 parameters: give"):
        regressor.base_parameters(np.zeros((2, 6)))
    # a column that depends on another one up to noise
    Y = np.random.default_rng(1).standard_normal((50, 2, 8))
    Y[..., 5] = 2 * Y[..., 1] + 5e-3 * Y[..., 0] + 1e-3 * Y[..., 5]
    Y[..., 6] *= 1e-5
    assert len(regressor.base_parameters(Y).columns) == 8
    base = regressor.base_parameters(Y, tolerance=1e-2)
    assert base.columns == (0, 1, 2, 3, 4, 6, 7)
    assert abs(base.matrix[0, 5] - 5e-3) < 1e-3
    assert base.names[1] == f"link1.mx + {base.matrix[1, 5]:.6g}*link2.mx"
    assert abs(base.matrix[1, 5] - 2) < 1e-3


def with_axes(axes: str, vertical: bool) -> str:
    """Return an arm whose joints turn about the axes x, y or z, with general bodies.

    It is mounted at an angle, so that its regressor has rounding errors in place of zeros.
    vertical: whether its own z axis is.
    """
    gravity = ["0" if vertical else "3", "9*sin(0.7)", "-9*cos(0.7)"]
    bodies = [
        body(f"link{k}", "revolute", f"q{k}", axis=[float(axis == x) for x in "xyz"],
             offset=[0.1 * k, 0.2, 0.3], parent=f"link{k - 1}" if k else "world",
             **({} if k else {"rotation": [["x", 0.7]]}))
        for k, axis in enumerate(axes)
    ]  # fmt: skip
    tens = dict(zip(VALUES, (1, 0.1, -0.2, 0.3, 2, 3, 4, 0.1, 0.2, 0.3), strict=True))
    values = {f"link{k}_{v}": x for k in range(len(axes)) for v, x in tens.items()}
    return trees.text(bodies, gravity, values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axes", "vertical", "count"),
    [("zx", True, 8), ("zx", False, 10), ("xx", True, 6), ("zz", True, 4), ("zzx", True, 11),
     ("xxz", True, 13), ("zxxy", True, 22), ("zxxzxz", True, 36)],
)  # fmt: skip
def test_number_of_base_parameters_of_serial_arms(
    axes: str, vertical: bool, count: int, folder: Path
) -> None:
    """7 n - 4 b, less 2 if the first axis is vertical; the first b axes are parallel.

    H. Mayeda, K. Yoshida and K. Osuka, "Base parameters of manipulator dynamic models", IEEE
    Trans. Robotics and Automation 6(3), 1990.
    """
    regressor = eomc.regressor(write(folder, with_axes(axes, vertical)), folder)
    base = regressor.base_parameters()
    parallel = len(axes) - len(axes.lstrip(axes[0]))
    above = axes[0] == "z" and vertical
    assert len(base.columns) == count == 7 * len(axes) - 4 * parallel - 2 * above
    assert "link0.m" in base.without_effect
    assert ("link0.mx" in base.without_effect) == (above or axes[0] == "x")
    states = np.random.default_rng(3).uniform(-2, 2, (3, 200, len(axes)))
    Y = regressor.Y(*states)
    assert np.linalg.matrix_rank(Y.reshape(-1, Y.shape[-1])) == count
    B, columns = base.matrix, [*base.columns]
    np.testing.assert_allclose(Y, Y[..., columns] @ B, atol=1e-12 * np.abs(Y).max())
    np.testing.assert_array_equal(B[:, columns], np.eye(count))
    np.testing.assert_allclose(base.values, B @ regressor.parameters)
    assert np.abs(B[B != 0]).min() > 1e-6


DRIVEN = trees.text(
    [{"name": f"link{k}", "joint": "revolute", "coordinates": f"q{k}", "mass": f"m{k}",
      "center": ["c", 0.05], "inertia": f"J{k}", "damping": f"d{k}", "friction": f"F{k}",
      "friction_width": 0.1, "actuator": f"{k}*u{k}",
      **({"parent": "link1", "offset": [0.6, 0]} if k == 2 else {})} for k in (1, 2)],
    [0, -9.81],
    truth := {"m1": 2.0, "m2": 1.5, "c": 0.3, "J1": 0.1, "J2": 0.07, "d1": 0.3, "d2": 0.1,
              "F1": 0.4, "F2": 0.2},
    [("[inputs]", {"u1": {"signal": "8*sin(2*t) + 5*sin(5.3*t)"},
                   "u2": {"signal": "4*sin(3.1*t)"}}),
     ("[[spring]]", {"coordinate": "q1", "stiffness": 6.0, "length": 0.5}),
     ("[run]", {"h": 0.002})],
)  # fmt: skip
GUESS = {"m1": 1.0, "m2": 0.5, "J2": 0.2, "d1": 0.0, "F2": 0.1}


@pytest.mark.slow
def test_least_squares_recover_the_base_parameters_from_a_simulation(folder: Path) -> None:
    """The scene has wrong values; its spring and its gear are right."""
    text = DRIVEN
    for name, value in GUESS.items():
        text = text.replace(f"{name} = {truth[name]}\n", f"{name} = {value}\n")
    regressor = eomc.regressor(write(folder, text), folder)
    module, base = regressor.module, regressor.base_parameters()
    run = module.simulate(duration=10, every=5, params=truth)
    u = np.stack([8 * np.sin(2 * run.t) + 5 * np.sin(5.3 * run.t), 4 * np.sin(3.1 * run.t)], -1)
    qdd = module.acceleration(run.q, run.qd, u=u, params=truth)
    tau = regressor.forces(run.q, run.qd, qdd, u)
    W = regressor.Y(run.q, run.qd, qdd)[..., list(base.columns)].reshape(-1, len(base.columns))
    m1, m2 = truth["m1"], truth["m2"]
    arm, square = (0.3, 0.05), 0.3**2 + 0.05**2
    expected = [m1 * arm[0] + 0.6 * m2, m1 * arm[1], truth["J1"] + m1 * square + 0.36 * m2,
                m2 * arm[0], m2 * arm[1], truth["J2"] + m2 * square,
                truth["d1"], truth["F1"], truth["d2"], truth["F2"]]  # fmt: skip
    assert np.abs(base.values - expected).max() > 0.1
    exact = np.linalg.lstsq(W, tau.ravel())[0]
    np.testing.assert_allclose(exact, expected, rtol=1e-9)
    noisy = tau.ravel() + 0.1 * np.random.default_rng(4).standard_normal(tau.size)
    errors = 0.1 * np.sqrt(np.diag(np.linalg.inv(W.T @ W)))
    deviations = (np.linalg.lstsq(W, noisy)[0] - expected) / errors
    assert np.abs(deviations).max() < 4
    assert np.abs(deviations).max() > 0.3


def test_scenes_without_a_regressor_are_refused(tmp_path: Path) -> None:
    stuck = DRIVEN.replace("[run]\n", '[run]\nfriction = "stick"\n')
    gear = {"name": "cam", "joint": "prismatic", "coordinates": "sin(q1)", "mass": 1,
            "damping": 2, "axis": [1, 0]}  # fmt: skip
    crank = {"name": "crank", "joint": "revolute", "coordinates": "q1", "mass": 1, "inertia": 1}
    event = '[[event]]\nname = "turn"\nwhen = "q1 - 9"\naction = "jump"\nm1 = "2*m1"\n'
    counted = DRIVEN.replace("[run]\n", f"{event}[run]\ntolerance = 1e-9\n")
    for scene, message in {
        (SCENES / "cartpole.toml").read_text(): r"cartpole has no moving \[\[body\]\]",
        (SCENES / "four_bar.toml").read_text(): "constraint 'pin_x'.* remove loops and constraints",
        stuck: 'changes .*: remove the event, or write friction = "smooth"',
        counted: "an event of tree changes 'm1': remove the event",
        trees.text([crank, gear], [0, -9.81], {}): "'cam' moves by .* not linear .* its damping",
    }.items():
        with pytest.raises(EomcError, match=message):
            eomc.regressor(write(tmp_path, scene), tmp_path)
