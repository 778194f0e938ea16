"""Identification of inertial parameters: the inverse dynamics as a linear function of them.

For bodies on joints, the generalized forces are tau = Y(q, qd, qdd) pi. The regressor Y does not
depend on the parameters pi: mass, first moment and inertia of each moving body, and armature,
damping and friction of its joint. Y has linearly dependent columns; base parameters are the
combinations of parameters that determine tau.

References
----------
M. Gautier, "Numerical calculation of the base inertial parameters of robots", Proc. IEEE ICRA,
1990; W. Khalil and E. Dombre, Modeling, Identification and Control of Robots, 2002, ch. 9 and 12.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eomc import pipeline
from eomc.base import spatial, texts
from eomc.base.errors import EomcError
from eomc.model.tree import ZERO
from eomc.scene.scope import value_of

if TYPE_CHECKING:
    from sympy import Expr

    from eomc.model.system import System
    from eomc.scene.formulas import Formula
    from eomc.scene.scene import Assembly

Array = np.ndarray[Any, np.dtype[Any]]

PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
PLANE_PARAMETERS = ("m", "mx", "my", "Izz")
RANK_TOLERANCE = 1e-6  # residual of a dependent column of Y, relative to the column

# (a x b)_i = CROSS_ijk a_j b_k;  (I w)_i = TENSOR_ijk w_j (Ixx, Ixy, Iyy, Ixz, Iyz, Izz)_k
CROSS, TENSOR = np.zeros((3, 3, 3)), np.zeros((3, 3, 6))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    CROSS[_i, _j, _k], CROSS[_i, _k, _j] = 1, -1
for _k, (_i, _j) in enumerate(((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))):
    TENSOR[_i, _j, _k] = TENSOR[_j, _i, _k] = 1


def regressor(scene: Any, root: str | Path = "build") -> Regressor:
    """Return the regressor Y of a scene with bodies: tau = Y(q, qd, qdd) pi.

    Parameters
    ----------
    scene : path or System
        Scene without constraints. Its [run] needs no `frames` and `inverse_dynamics`.
    root : path
        Folder of built modules.

    Returns
    -------
    Regressor

    Raises
    ------
    EomcError
        If the scene has no moving bodies, or it has constraints or discrete variables, or a joint
        with armature, damping or friction depends nonlinearly on the coordinates.
    SceneError
        If the scene is invalid.
    """
    system: System = scene if hasattr(scene, "coordinates") else pipeline.read(scene)
    assembly = system.scene and system.scene.assembly
    if not assembly or all(b.joint == "fixed" for b in assembly.bodies):
        raise EomcError(f"regressor: {system.name} has no moving [[body]]")
    sticking = (system.coordinates[mode.at].name for mode in system.modes)
    if variables := [*system.discrete, *sticking]:
        raise EomcError(
            f"regressor: an event of {system.name} changes '{variables[0]}': remove the event, or "
            'write friction = "smooth" in [run]'
        )
    if system.constraints:
        raise EomcError(
            f"regressor: {system.name} has the constraint '{system.constraints[0].name}', and its "
            "drives also exert constraint forces: remove loops and constraints"
        )
    return Regressor(system, assembly, Path(root) / ".regressor")


@dataclass(frozen=True)
class JointTerm:
    """A joint force that is proportional to a parameter.

    name, value: those of the parameter. kind: "armature", "damping" or "friction". slopes: ds/dq,
    (nq,), of the joint's displacement s. width: velocity of smoothed friction.
    """

    name: str
    value: float
    kind: str
    slopes: Array
    width: float

    def column(self, qd: Array, qdd: Array) -> Array:
        """Return the generalized forces for a parameter of 1, (n, nq)."""
        if self.kind == "armature":
            force = qdd @ self.slopes
        elif self.kind == "damping":
            force = qd @ self.slopes
        else:
            force = np.tanh(qd @ self.slopes / self.width)
        return force[:, None] * self.slopes


class Regressor:
    """The regressor Y of a mechanism without constraints: tau = Y(q, qd, qdd) pi.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters. Those of each body are, in this order, `BODY.m`, its mass, kg;
        `BODY.mx`, `my`, `mz`, mass times centre of mass, kg m; `BODY.Ixx`, `Ixy`, `Iyy`, `Ixz`,
        `Iyz`, `Izz`, its inertia tensor about the origin of its frame, kg m^2. Vectors and tensors
        are along the axes of the body's frame, and include the bodies that are fixed to the body.
        Plane scenes have m, mx, my, Izz. Then follow `BODY.armature`, `BODY.damping` and
        `BODY.friction` of the joints for which the scene has such an entry.
    parameters : (np,) array
        Values of the parameters in the scene.
    module
        The compiled module, with `inverse_dynamics` and frames of all moving bodies.
    """

    def __init__(self, system: System, assembly: Assembly, root: Path) -> None:
        self._system = system
        self._bodies = [b for b in assembly.bodies if b.joint != "fixed"]
        self._values = {c.name: c.value for c in system.scene.constants} if system.scene else {}
        self._values |= {p.name: p.value for p in system.parameters}
        self._gravity = np.array([value_of(g, self._values)[0] for g in assembly.gravity])
        self._joints = tuple(self._joint_terms())
        kinds = PLANE_PARAMETERS if system.plane else PARAMETERS
        self._columns = [PARAMETERS.index(kind) for kind in kinds]
        values = [self._inertia(b.name)[self._columns] for b in self._bodies]
        self.parameters: Array = np.hstack([*values, [joint.value for joint in self._joints]])
        names = [f"{b.name}.{kind}" for b in self._bodies for kind in kinds]
        self.names = (*names, *(joint.name for joint in self._joints))
        run = replace(
            system.run, frames=tuple(b.name for b in self._bodies), inverse_dynamics=True,
            real="double", linearize=False, discretize=False,
        )  # fmt: skip
        self.module: Any = pipeline.load(replace(system, run=run), root)

    def _number(self, e: Expr) -> float:
        """Return the value of an expression of parameters in the scene."""
        return float(e.subs({s: self._values[s.name] for s in e.free_symbols}))

    def _inertia(self, name: str) -> Array:
        """Return the ten parameters of a body in its own frame."""
        (frame,) = (f for f in self._system.frames if f.name == name)
        if frame.link < 0 or self._system.tree is None:  # placed by formulas
            mass, moment, about = frame.mass, ZERO, frame.inertia
        else:
            link = self._system.tree.links[frame.link]
            back = spatial.transposed(frame.rotation)
            mass, moment = link.mass, spatial.apply(back, link.moment)
            about = spatial.rotated_inertia(back, link.inertia)
        xx, yy, zz, xy, xz, yz = about
        return np.array([*map(self._number, (mass, *moment, xx, xy, yy, xz, yz, zz))])

    def _joint_terms(self) -> Iterator[JointTerm]:
        """Yield the forces of the joints' armatures, dampings and frictions."""
        links = self._system.tree.links if self._system.tree else ()
        for body in self._bodies:
            displacements = [link.q for link in links if link.name == body.name]
            width = value_of(body.friction_width, self._values)[0] if body.friction_width else 1.0
            for kind in ("armature", "damping", "friction"):
                formulas: tuple[Formula, ...] = getattr(body, kind)
                for k, formula in enumerate(formulas):
                    value, _ = value_of(formula, self._values)
                    if value == 0 and not formula.names():
                        continue
                    which = f"_{k + 1}" if len(formulas) > 1 else ""
                    slopes = [displacements[k].diff(q) for q in self._system.q]
                    if any(not {s.name for s in e.free_symbols} <= {*self._values} for e in slopes):
                        raise EomcError(
                            f"regressor: body '{body.name}' moves by '{displacements[k]}', which "
                            f"is not linear in the coordinates: remove its {kind}"
                        )
                    yield JointTerm(
                        f"{body.name}.{kind}{which}", value, kind,
                        np.array([*map(self._number, slopes)]), width,
                    )  # fmt: skip

    def Y(self, q: Any, qd: Any, qdd: Any, t: Any = 0.0) -> Array:
        """Return the regressor: Y pi are the generalized forces that a motion requires.

        Parameters
        ----------
        q, qd, qdd : (nq,) or (n, nq) array_like
            States and accelerations.
        t : float or (n,) array_like, optional
            Time, s, for scenes that depend on it.

        Returns
        -------
        (nq, np) or (n, nq, np) array
            With one column for each entry of `names`.
        """
        single, plane, module = np.ndim(q) == 1, self._system.plane, self.module
        q, qd, qdd = (np.atleast_2d(np.asarray(x, float)) for x in (q, qd, qdd))
        R = module.pose(q, t=t).rotation
        R = _rotations_in_plane(R) if plane else R
        columns = np.concatenate(
            [
                module.frame_velocity(q, qd, t=t)[..., None],
                module.frame_acceleration(q, qd, qdd, t=t)[..., None],
                module.jacobian(q, t=t),
            ],
            axis=-1,
        )
        components = np.eye(6)[:, [0, 1, 5]] if plane else np.eye(6)
        twists = (components @ columns).reshape(*R.shape[:2], 2, 3, -1)
        twists[:, :, 0, :, 1] -= self._gravity
        twists = R.swapaxes(-1, -2)[:, :, None] @ twists  # along the axes of the bodies
        (_, a), (w, alpha) = (np.moveaxis(twists[:, :, k, :, :2], -1, 0) for k in (0, 1))
        wrenches = _body_regressor(w, a, alpha)[..., self._columns]
        J = twists[..., 2:].reshape(*R.shape[:2], 6, -1)
        bodies = (J.swapaxes(-1, -2) @ wrenches).swapaxes(1, 2).reshape(*q.shape, -1)
        joints = [joint.column(qd, qdd)[..., None] for joint in self._joints]
        Y = np.concatenate([bodies, *joints], axis=-1)
        return Y[0] if single else Y

    def forces(self, q: Any, qd: Any, qdd: Any, u: Any = None, t: Any = 0.0) -> Array:
        """Return the generalized forces tau that inputs exert, to be compared with Y pi.

        They are the forces of the inputs u less those that the motion requires of springs and of
        other forces than the ones of `names`, for which the scene's parameters are valid.

        Parameters
        ----------
        q, qd, qdd, t
            As for `Y`.
        u : (nu,) or (n, nu) array_like, optional
            Inputs; by default they follow the scene's signals.

        Returns
        -------
        (nq,) or (n, nq) array
            N or N m.
        """
        module = self.module
        required: Array = module.inverse_dynamics(q, qd, qdd, t=t)
        forces: Array = module.tau(q, qd, u=u, t=t) - required
        return self.Y(q, qd, qdd, t) @ self.parameters + forces

    def base_parameters(
        self, Y: Array | None = None, tolerance: float = RANK_TOLERANCE
    ) -> BaseParameters:
        """Return the base parameters: the combinations of parameters that determine tau.

        Column after column of Y is taken into the basis unless it depends linearly on those before
        it. The parameter of a dependent column is added to those of the basis (Gautier's method).

        Parameters
        ----------
        Y : (n, nq, np) array, optional
            Regressor of the motions of an experiment: the result are the combinations that this
            experiment determines. By default random states.
        tolerance : float, optional
            Largest residual of a dependent column, relative to the column.

        Returns
        -------
        BaseParameters

        Raises
        ------
        EomcError
            If Y does not have a column for each parameter.
        """
        if Y is None:
            draws, nq = np.random.default_rng(0), len(self._system.q)
            states = draws.uniform(-np.pi, np.pi, (3, 20 + 3 * len(self.names) // nq, nq))
            Y = self.Y(*states)
        if np.shape(Y)[-1:] != (len(self.names),):
            raise EomcError(
                f"base_parameters: Y is {np.shape(Y)}, but there are {len(self.names)} parameters: "
                "give the result of Y(q, qd, qdd)"
            )
        W = np.reshape(Y, (-1, len(self.names)))
        W = W[np.isfinite(W).all(axis=1)]
        sizes = np.linalg.norm(W, axis=0)
        sizes[sizes < RANK_TOLERANCE**2 * sizes.max()] = 0  # rounding errors
        W = W * (sizes > 0)
        basis, columns = np.zeros((len(W), 0)), []
        for k, size in enumerate(sizes):
            residual = W[:, k] - basis @ (basis.T @ W[:, k])
            residual -= basis @ (basis.T @ residual)  # once more, against rounding
            length = np.linalg.norm(residual)
            if length > tolerance * size:
                basis = np.column_stack([basis, residual / length])
                columns.append(k)
        scaled = W / np.where(sizes > 0, sizes, 1)
        weights = np.linalg.lstsq(scaled[:, columns], scaled)[0]
        weights[np.abs(weights) < RANK_TOLERANCE] = 0
        matrix = weights * sizes / sizes[columns, None]
        matrix[:, columns] = np.eye(len(columns))
        return BaseParameters(self.names, tuple(columns), matrix, matrix @ self.parameters)


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Base parameters (minimal parameters): pi_b = B pi with tau = Y[..., columns] pi_b.

    Attributes
    ----------
    parameters : tuple of str
        Names of all parameters pi.
    columns : tuple of int
        Indices of the independent columns of Y.
    matrix : (nb, np) array
        B; its columns `columns` are the unit matrix.
    values : (nb,) array
        Values of the base parameters in the scene.
    """

    parameters: tuple[str, ...]
    columns: tuple[int, ...]
    matrix: Array
    values: Array

    @property
    def names(self) -> tuple[str, ...]:
        """The combinations as text, such as "link1.Izz + 0.25*link2.m"."""
        sums = (
            " + ".join(f"{x:.6g}*{n}" for x, n in zip(row, self.parameters, strict=True) if x)
            for row in self.matrix
        )
        return tuple(f" {x}".replace("+ -", "- ").replace(" 1*", " ")[1:] for x in sums)

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Names of the parameters on which tau does not depend."""
        return tuple(n for n, x in zip(self.parameters, self.matrix.T, strict=True) if not x.any())

    def __str__(self) -> str:
        lines = [f"{len(self.columns)} base parameters of {len(self.parameters)} parameters"]
        lines += [f"{x:14.6g}  {n}" for n, x in zip(self.names, self.values, strict=True)]
        if self.without_effect:
            lines.append(f"  without effect: {texts.listed([*self.without_effect])}")
        return "\n".join(lines)


def _rotations_in_plane(angles: Array) -> Array:
    """Return rotation matrices about the z axis, (..., 3, 3)."""
    R = spatial.elementary_rotation(2, np.cos(angles), np.sin(angles))
    return np.moveaxis(np.array(R), (0, 1), (-2, -1))


def _body_regressor(w: Array, a: Array, alpha: Array) -> Array:
    """Return the force and the moment about its origin that move a body, by its ten parameters.

    All components are along the body's axes. w: angular velocity. a: acceleration of the origin
    less that of gravity. alpha: angular acceleration. The result is (..., 6, 10).
    """
    turn, rate, lever = (np.tensordot(v, CROSS, (-1, 1)) for v in (w, alpha, a))
    out = np.zeros((*w.shape[:-1], 6, len(PARAMETERS)))
    out[..., :3, 0] = a
    out[..., :3, 1:4] = rate + turn @ turn
    out[..., 3:, 1:4] = -lever
    inertia = [np.tensordot(v, TENSOR, (-1, 1)) for v in (w, alpha)]
    out[..., 3:, 4:] = inertia[1] + turn @ inertia[0]
    return out
