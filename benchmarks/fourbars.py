"""The crank-rocker of tests/data/constrained.json by MuJoCo, Pinocchio and Exudyn.

All have the same rods, the same start and gravity along -y. MuJoCo and Pinocchio have a tree of
hinges and close it by a point; Exudyn has three free bodies in the plane and four hinges.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import exudyn
import mujoco
import numpy as np
import pinocchio
from exudyn import itemInterface as items  # noqa: N813
from searching import Array

SAMPLE = 200  # steps that are timed
ITERATIONS = 3  # most of Pinocchio's proximal solver
MU = 1e-8  # its regularization


@dataclass(frozen=True)
class Rods:
    """Lengths, masses, distance of the ground's hinges; angles from x, their rates; seconds."""

    lengths: list[float]
    masses: list[float]
    ground: float
    gravity: float
    q: Array
    qd: Array
    end: float

    @staticmethod
    def of(case: dict[str, Any]) -> Rods:
        p = {name: float(text) for name, text in case["parameters"].items()}
        return Rods(
            [p[x] for x in "abc"], [p[x] for x in ("m1", "m2", "m3")], p["d"], p["g"],
            np.array(case["q0"], float), np.array(case["qd0"], float), float(case["t_end"]),
        )  # fmt: skip

    def inertia(self, k: int) -> float:
        """Of rod k about its middle."""
        return self.masses[k] * self.lengths[k] ** 2 / 12

    @property
    def hinges(self) -> tuple[Array, Array]:
        """Angles and rates of the tree: the coupler's are relative to the crank."""
        lower = np.array([[1.0, 0, 0], [-1, 1, 0], [0, 0, 1]])
        return lower @ self.q, lower @ self.qd


@dataclass(frozen=True)
class Peer:
    """`run` makes a call of some steps of h, which returns the rods' angles (nan: it failed).

    step: a call of SAMPLE steps of h, where that is not `run`. most: steps that are tried.
    """

    name: str
    setting: str
    run: Callable[[float, int], Callable[[], Array]]
    most: int
    step: Callable[[float], Callable[[], object]] | None = None

    def sample(self, h: float) -> Callable[[], object]:
        return self.step(h) if self.step else self.run(h, SAMPLE)


def absolute(hinges: Array) -> Array:
    """The rods' angles from x."""
    return np.array([hinges[0], hinges[0] + hinges[1], hinges[2]])


# --- MuJoCo --------------------------------------------------------------------------------------

MJCF = """<mujoco><compiler angle="radian" autolimits="false"/>
<option gravity="0 {gravity!r} 0" solver="Newton" tolerance="1e-15" iterations="100"
 jacobian="dense"><flag contact="disable" autoreset="disable"/></option>
<worldbody>{crank}{rocker}</worldbody>
<equality><connect site1="end1" site2="end2" solimp="0.9999 0.9999 0.001 0.5 2"/></equality>
</mujoco>"""


def mujoco_peer(rods: Rods, integrator: str, most: int) -> Peer:
    """`connect` as its documentation advises: a time constant of 2 h, impedance near 1."""

    def rod(k: int, x: float, inner: str = "") -> str:
        l, J = rods.lengths[k], rods.inertia(k)  # noqa: E741
        return (
            f'<body pos="{x!r} 0 0"><joint axis="0 0 1"/><inertial pos="{l / 2!r} 0 0" '
            f'mass="{rods.masses[k]!r}" diaginertia="{J!r} {J!r} {J!r}"/>'
            f'<site name="end{k}" pos="{l!r} 0 0"/>{inner}</body>'
        )

    coupler = rod(1, rods.lengths[0])
    text = MJCF.format(
        gravity=-rods.gravity, crank=rod(0, 0.0, coupler), rocker=rod(2, rods.ground)
    )
    mujoco.set_mju_user_warning(lambda said: None)  # else a file of steps that are too long
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    q, qd = rods.hinges

    def run(h: float, steps: int) -> Callable[[], Array]:
        def call() -> Array:
            model.opt.timestep = h
            model.eq_solref[0] = (2 * h, 1)
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = q, qd
            mujoco.mj_step(model, data, nstep=steps)
            return absolute(data.qpos)

        return call

    return Peer("MuJoCo", integrator, run, most)


# --- Pinocchio -----------------------------------------------------------------------------------


def pinocchio_peer(rods: Rods, alpha: float, most: int) -> Peer:
    """RK4 in Python; a step's time is that of four calls of constraintDynamics, nothing besides."""
    model = pinocchio.Model()
    model.gravity.linear = np.array([0, -rods.gravity, 0])

    def at(x: float) -> Any:
        return pinocchio.SE3(np.eye(3), np.array([x, 0, 0]))

    def add(parent: int, k: int, x: float) -> int:
        joint = model.addJoint(parent, pinocchio.JointModelRZ(), at(x), f"joint{k}")
        middle, J = np.array([rods.lengths[k] / 2, 0, 0]), np.eye(3) * rods.inertia(k)
        body = pinocchio.Inertia(rods.masses[k], middle, J)
        model.appendBodyToJoint(joint, body, pinocchio.SE3.Identity())
        return int(joint)

    coupler = add(add(0, 0, 0.0), 1, rods.lengths[0])
    rocker = add(0, 2, rods.ground)
    point = pinocchio.RigidConstraintModel(
        pinocchio.ContactType.CONTACT_3D, model, coupler, at(rods.lengths[1]), rocker,
        at(rods.lengths[2]),
    )  # fmt: skip
    gains = pinocchio.BaumgarteCorrectorParameters(alpha**2, 2 * alpha)
    point.setBaumgarteCorrectorParameters(gains)
    data = model.createData()
    rows, found = pinocchio.StdVec_RigidConstraintModel(), pinocchio.StdVec_RigidConstraintData()
    rows.append(point)
    found.append(point.createData())
    pinocchio.initConstraintDynamics(model, data, rows, found)
    solver = pinocchio.ProximalSettings(1e-12, MU, ITERATIONS)
    none, start = np.zeros(3), rods.hinges
    dynamics = pinocchio.constraintDynamics

    def a(q: Array, v: Array) -> Array:
        return dynamics(model, data, q, v, none, rows, found, solver).copy()

    def run(h: float, steps: int) -> Callable[[], Array]:
        def call() -> Array:
            q, v = start
            for _ in range(steps):
                a1 = a(q, v)
                a2 = a(q + h / 2 * v, v + h / 2 * a1)
                a3 = a(q + h / 2 * v + h * h / 4 * a1, v + h / 2 * a2)
                a4 = a(q + h * v + h * h / 2 * a2, v + h * a3)
                q = q + h * v + h * h / 6 * (a1 + a2 + a3)
                v = v + h / 6 * (a1 + 2 * (a2 + a3) + a4)
            return absolute(q)

        return call

    def step(h: float) -> Callable[[], object]:
        def call() -> None:
            for _ in range(4 * SAMPLE):
                dynamics(model, data, *start, none, rows, found, solver)

        return call

    return Peer("Pinocchio", f"RK4, Baumgarte {alpha:g}/s", run, most, step)


# --- Exudyn --------------------------------------------------------------------------------------


def exudyn_peer(rods: Rods, radius: float | None, most: int) -> Peer:
    """Generalized alpha of this spectral radius, index 3; None: trapezoidal rule, index 2."""
    exudyn.SetWriteToConsole(False)
    system = exudyn.SystemContainer().AddSystem()
    nodes, marks = [], []
    end = rods.lengths[0] * np.array([math.cos(rods.q[0]), math.sin(rods.q[0])])
    moving = rods.qd[0] * np.array([-end[1], end[0]])
    base, still = np.array([rods.ground, 0]), np.zeros(2)
    for k, (p, v) in enumerate(((still, still), (end, moving), (base, still))):
        half = rods.lengths[k] / 2 * np.array([math.cos(rods.q[k]), math.sin(rods.q[k])])
        speed = v + rods.qd[k] * np.array([-half[1], half[0]])
        node = system.AddNode(items.NodeRigidBody2D(
            initialCoordinates=[*(p + half), rods.q[k]], initialVelocities=[*speed, rods.qd[k]]
        ))  # fmt: skip
        body = system.AddObject(
            items.ObjectRigidBody2D(mass=rods.masses[k], inertia=rods.inertia(k), nodeNumber=node)
        )
        mass = system.AddMarker(items.MarkerBodyMass(bodyNumber=body))
        system.AddLoad(
            items.LoadMassProportional(markerNumber=mass, loadVector=[0, -rods.gravity, 0])
        )
        nodes.append(node)
        marks.append([mark(system, body, s * rods.lengths[k] / 2) for s in (-1, 1)])
    world = system.AddObject(items.ObjectGround())
    left, right = mark(system, world, 0.0), mark(system, world, rods.ground)
    crank, coupler, rocker = marks
    for pair in (
        (left, crank[0]), (crank[1], coupler[0]), (coupler[1], rocker[1]), (right, rocker[0]),
    ):  # fmt: skip
        system.AddObject(items.ObjectJointRevolute2D(markerNumbers=list(pair)))
    system.Assemble()

    def run(h: float, steps: int) -> Callable[[], Array]:
        settings = exudyn_settings(h * steps, steps, radius)

        def call() -> Array:
            try:
                system.SolveDynamic(settings, storeSolver=False)
            except exudyn.SolverError:
                return np.full(3, np.nan)
            what = exudyn.OutputVariableType.Coordinates
            return np.array([system.GetNodeOutput(node, what)[2] for node in nodes])

        return call

    method = f"generalized alpha, {radius:g}" if radius else "trapezoidal, index 2"
    return Peer("Exudyn", method, run, most)


def mark(system: Any, body: Any, x: float) -> Any:
    """A point on a body's x axis."""
    return system.AddMarker(items.MarkerBodyPosition(bodyNumber=body, localPosition=[x, 0.0, 0.0]))


def exudyn_settings(end: float, steps: int, radius: float | None) -> Any:
    """Fixed steps, a tight Newton iteration, nothing written."""
    settings = exudyn.SimulationSettings()
    settings.solution.file.write = False
    how = settings.timeIntegration
    how.endTime, how.numberOfSteps, how.adaptiveStep = end, steps, False
    how.newton.useModifiedNewton = True
    how.newton.absoluteTolerance, how.newton.relativeTolerance = 1e-10, 1e-8
    alpha = how.generalizedAlpha
    alpha.useIndex2Constraints = alpha.useNewmark = radius is None
    if radius:
        alpha.spectralRadius = radius
    return settings


def peers(rods: Rods) -> list[list[Peer]]:
    """Of each simulator and method its settings."""
    return [
        [mujoco_peer(rods, "RK4", 40_000)],
        [mujoco_peer(rods, "implicitfast", 100_000)],
        [pinocchio_peer(rods, alpha, 10_000) for alpha in (0.0, 5.0, 20.0)],
        [exudyn_peer(rods, radius, 20_000) for radius in (0.9, 0.5, None)],
    ]
