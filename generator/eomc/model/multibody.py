"""From bodies and joints to energies, forces and a tree of elementary joints.

Energies are written as a textbook does, over the world coordinates of centres of mass and the
entries of rotation matrices: that is what the reference and the Lagrangian route start from. The
tree says the same body by body, for the recursive routes (derive/newton_euler.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import sympy
from sympy import Add, Expr, S, Symbol

from eomc.base import spatial
from eomc.base.spatial import apply, plus, product, scaled, transposed
from eomc.model.constraints import End, LoopEquations, derive_gear_equation, derive_loop_equations
from eomc.model.hybrid import Friction
from eomc.model.symbols import dot, symbol
from eomc.model.tree import (
    ONE,
    ZERO,
    BodyFrame,
    Chains,
    Link,
    Matrix,
    Named,
    Step,
    Tree,
    Vector,
    aligned_with,
    rotation_about,
    rotation_about_vector,
    rounded_matrix,
    rounded_number,
    rounded_vector,
    unit_vector,
)
from eomc.scene.formulas import Formula
from eomc.scene.joints import JOINTS, MotionSubspace
from eomc.scene.scene import WORLD, Assembly, Damper, Force, LoopJoint, RigidBody, Spring

Value = Callable[[str, Formula], Expr]  # (key in the scene, formula) -> SymPy expression


@dataclass
class Terms:
    """Terms that bodies, springs, dampers and forces add to a system.

    Attributes
    ----------
    definitions
        Definitions (symbol, expression) that the user's formulas may use.
    later
        Definitions (symbol, expression) that may use the user's definitions.
    tree_kinetic, tree_potential
        Energies of bodies with joints, as terms of sums.
    kinetic, potential
        Energies of bodies placed by formulas; the potential includes springs.
    dissipation
        Rayleigh's dissipation function of dampers and joint damping.
    forces
        Generalized forces by name of the coordinate.
    applied
        Forces F at positions y, as pairs (y, F).
    links, frames
        Elementary joints with the bodies that they move, and frames of bodies.
    closed
        Constraint equations and reaction of each loop.
    frictions
        Stick-slip friction in joints, as pairs (joint position, friction).
    rates
        Dict from the symbol of each coordinate that moves a joint to the symbol of its velocity.
    fixed_moment
        First moment of the masses that are fixed in the world, in kg m.
    gravity
        Acceleration of gravity, in m/s^2.
    """

    definitions: list[tuple[Symbol, Expr]] = field(default_factory=list)
    later: list[tuple[Symbol, Expr]] = field(default_factory=list)
    tree_kinetic: list[Expr] = field(default_factory=list)  # terms of a sum
    tree_potential: list[Expr] = field(default_factory=list)
    kinetic: Expr = S.Zero  # of bodies placed by formulas
    potential: Expr = S.Zero  # of these bodies and of springs
    dissipation: Expr = S.Zero
    forces: dict[str, Expr] = field(default_factory=dict)
    applied: list[tuple[Expr, Expr]] = field(default_factory=list)  # forces at positions
    links: list[Link] = field(default_factory=list)
    frames: list[BodyFrame] = field(default_factory=list)
    closed: list[LoopEquations] = field(default_factory=list)  # one for each loop
    frictions: list[tuple[Expr, Friction]] = field(
        default_factory=list
    )  # positions and stick-slip friction
    rates: dict[Symbol, Symbol] = field(default_factory=dict)  # of the coordinates of joints
    fixed_moment: Vector = ZERO
    gravity: Vector = ZERO

    def tree(self, kinetic: Expr, potential: Expr) -> Tree | None:
        """Return the tree of bodies with joints, or None if there are none.

        kinetic, potential: energies that the scene gives as formulas. They are stored in the tree's
        `other_kinetic` and `other_potential`, together with the energies of springs and of bodies
        placed by formulas.
        """
        if not self.links:
            return None
        return Tree(
            tuple(self.links),
            tuple(self.rates.items()),
            self.gravity,
            self.fixed_moment,
            kinetic + self.kinetic,
            potential + self.potential,
        )


@dataclass(frozen=True)
class _Place:
    """The pose of a body's frame, relative to its link and, as expressions, in the world."""

    link: int
    offset: Vector  # in the link's frame
    rotation: Matrix
    at: Vector  # in the world
    R: Matrix
    angle: Expr = S.Zero  # in the plane


class Builder:
    """Converter of the bodies, joints, springs and forces of a scene to terms of a system.

    The result is collected in the attribute `terms`. Call `build_tree` first. Call `build_rest` and
    `add_forces` after the user's definitions have been evaluated.

    Parameters
    ----------
    assembly
        Bodies, joints, springs, dampers and forces of the scene.
    value
        Function that converts a formula to an expression; called with (key in the scene, formula).
    coordinates
        Dict from the symbol of each coordinate to the symbol of its velocity.
    taken
        Names that are in use, so that new definitions cannot have them.
    sticks
        Whether friction in joints is stick-slip friction rather than smooth.
    """

    def __init__(
        self,
        assembly: Assembly,
        value: Value,
        coordinates: Mapping[Symbol, Symbol],
        taken: Sequence[str],
        sticks: bool,
    ) -> None:
        self.assembly = assembly
        self.value = value
        self.coordinates = coordinates  # with their velocities
        self.taken = set(taken)
        self.sticks = sticks
        self.terms = Terms()
        self.moved: dict[str, list[Expr]] = {}  # of each body the motions of its joint
        self.chains = Chains(assembly.plane)
        self.places: dict[str, _Place] = {WORLD: _Place(-1, ZERO, ONE, ZERO, ONE)}
        self.loads: dict[str, tuple[Expr, tuple[Expr, ...]]] = {}  # of bodies placed by formulas
        self.terms.gravity = self._vector("gravity", assembly.gravity)

    # --- the tree --------------------------------------------------------------------------------

    def build_tree(self) -> None:
        """Add the bodies with joints, their energies and their definitions to `terms`."""
        for body in self.assembly.bodies:
            if body.joint:
                self._add_body_on_joint(body)

    def _add_body_on_joint(self, body: RigidBody) -> None:
        key = f"body.{body.name}"
        parent = self.places[body.parent]
        offset = self._vector(f"{key}.offset", body.offset) if body.offset else ZERO
        rotation = self._rotation(f"{key}.rotation", body)
        angle = parent.angle
        if self.assembly.plane:
            angle += sum(self.value(f"{key}.rotation", turn.angle) for turn in body.rotation)
        at = self._define_position(f"{body.name}_joint", plus(parent.at, apply(parent.R, offset)))
        R = product(parent.R, rotation)
        place = _Place(
            parent.link,
            plus(parent.offset, apply(parent.rotation, rounded_vector(offset))),
            rounded_matrix(product(parent.rotation, rounded_matrix(rotation))),
            at,
            R,
            angle,
        )
        armature = [self.value(f"{key}.armature", a) for a in body.armature]
        pitch = self.value(f"{key}.pitch", body.pitch) if body.pitch else S.Zero
        subspaces = JOINTS[body.joint].subspaces(body.axes, pitch)
        by = [self._coordinate(key, c) for c in body.coordinates]
        for k, motion in enumerate(zip(subspaces, by, strict=True)):
            place = self._add_elementary_joint(
                body.name, place, *motion, armature[k] if armature else S.Zero
            )
        moved = zip(subspaces, self.moved.get(body.name, ()), strict=True)
        turned = sum((self.value(f"{key}.rotation", x.angle) for x in body.rotation), S.Zero)
        self.chains.steps[body.name] = Step(body.parent, offset, rotation, turned, tuple(moved))
        if not self.assembly.plane and body.joint != "fixed":
            R = self._define_matrix(body.name, place.R)
            place = replace(place, R=R)
        self.places[body.name] = place
        self._add_mass(body, place)

    def _coordinate(self, key: str, formula: Formula) -> Expr:
        """Return a joint position over coordinates, and record their velocities."""
        moved = self.value(f"{key}.coordinates", formula)
        by = sorted(self.coordinates.keys() & moved.free_symbols, key=str)
        self.terms.rates |= {q: self.coordinates[q] for q in by}
        return moved

    def _add_elementary_joint(
        self, name: str, place: _Place, motion: MotionSubspace, moved: Expr, armature: Expr
    ) -> _Place:
        """Return the pose after one more elementary joint, which becomes a link."""
        terms = self.terms
        q = self._define(f"{name}_q", moved)
        self.moved.setdefault(name, []).append(q)
        terms.tree_kinetic.append(armature * self.terms.rates.get(q, _rate(q)) ** 2 / 2)
        axis, angular, linear = motion
        k, aligned = aligned_with(axis)
        rotation = rounded_matrix(product(place.rotation, aligned))
        terms.links.append(
            Link(
                name, place.link, k, S(angular), S(linear), moved, place.offset, rotation,
                armature=armature,
            )
        )  # fmt: skip
        way = scaled(apply(place.R, unit_vector(axis)), S(linear) * q)
        at = self._define_position(f"{name}_joint", plus(place.at, way))
        R, angle = place.R, place.angle
        if angular and self.assembly.plane:
            angle = self._define(f"{name}_angle", angle + q)
            R = rotation_about(2, angle)
        elif angular:
            R = self._define_matrix(name, product(R, rotation_about_vector(axis, q)))
        return _Place(len(terms.links) - 1, ZERO, transposed(aligned), at, R, angle)

    def _add_mass(self, body: RigidBody, place: _Place) -> None:
        """Add the body's mass to its link and to the energies."""
        key, terms = f"body.{body.name}", self.terms
        mass = self.value(f"{key}.mass", body.mass)
        inertia = [self.value(f"{key}.inertia", entry) for entry in body.inertia]
        center = self._vector(f"{key}.center", body.center)
        middle = plus(place.at, apply(place.R, center))
        position = self._position(body.name, middle)
        m, c = rounded_vector((mass, S.Zero, S.Zero))[0], rounded_vector(center)
        moment = scaled(plus(place.offset, apply(place.rotation, c)), m)
        if place.link < 0:
            terms.fixed_moment = plus(terms.fixed_moment, moment)
        else:
            about = spatial.rotated_inertia(place.rotation, [rounded_number(x) for x in inertia])
            arm = plus(place.offset, apply(place.rotation, c))
            about = spatial.moved_inertia([rounded_number(x) for x in about], m, arm)
            link = terms.links[place.link]
            terms.links[place.link] = replace(
                link,
                mass=link.mass + m,
                moment=plus(link.moment, moment),
                inertia=tuple(a + b for a, b in zip(link.inertia, about, strict=True)),
            )
            terms.tree_kinetic += self.kinetic_terms(mass, inertia, position, place)
        terms.tree_potential.append(self.gravity_potential(mass, position))

    def add_forces(self) -> None:
        """Add the damping, friction and actuator forces of the joints to `terms`."""
        terms = self.terms
        for body in self.assembly.bodies:
            key, width = f"body.{body.name}", S.One
            if body.friction_width:
                width = self.value(f"{key}.friction_width", body.friction_width)
            for k, q in enumerate(self.moved.get(body.name, ())):
                rate = terms.rates.get(q, _rate(q))
                if body.damping:
                    terms.dissipation += self.value(f"{key}.damping", body.damping[k]) * rate**2 / 2
                force = S.Zero
                if body.friction:
                    friction = self.value(f"{key}.friction", body.friction[k])
                    if self.sticks and friction != 0:
                        terms.frictions.append((q, Friction(str(q), friction, f"{key}.friction")))
                    else:
                        force -= friction * sympy.tanh(rate / width)
                if body.actuator:
                    force += self.value(f"{key}.actuator", body.actuator[k])
                if force != 0 and q in terms.rates:
                    terms.forces[q.name] = terms.forces.get(q.name, S.Zero) + force
                elif force != 0:
                    terms.applied.append((q, force))

    # --- bodies placed by formulas, springs and dampers ------------------------------------------

    def build_rest(self) -> None:
        """Add to `terms` the elements of the scene whose formulas may use the user's definitions.

        These elements are bodies placed by formulas, frames, springs, dampers, forces and loops.
        """
        for body in self.assembly.bodies:
            if not body.joint:
                self._add_body_by_formulas(body)
        for body in sorted(self.assembly.bodies, key=lambda body: body.point):
            self.terms.frames.append(self._frame(body.name, self.places[body.name]))
        for k, spring in enumerate(self.assembly.springs):
            self._add_spring(f"spring.{k + 1}", spring)
        for k, damper in enumerate(self.assembly.dampers):
            self.add_damper(f"damper.{k + 1}", damper)
        for k, force in enumerate(self.assembly.forces):
            self._add_force(f"force.{k + 1}", force)
        for loop in self.assembly.loops:
            self.terms.closed.append(self._close_loop(f"loop.{loop.name}", loop))

    def _frame(self, name: str, place: _Place) -> BodyFrame:
        if name in self.loads:
            return BodyFrame(name, -1, place.at, place.R, place.angle, *self.loads[name])
        return BodyFrame(name, place.link, place.offset, place.rotation, place.angle)

    def _add_force(self, key: str, force: Force) -> None:
        """Add a force at a point of a body, or a torque; virtual work is F.dp + tau.(dR R^T)."""
        place, applied = self.places[force.body], self.terms.applied
        F, torque = (
            self._vector(f"{key}.{name}", getattr(force, name)) for name in ("force", "torque")
        )
        if force.in_body:
            F, torque = (apply(place.R, x) for x in (F, torque))
        point = plus(place.at, apply(place.R, self._vector(f"{key}.point", force.point)))
        applied += zip(point, F, strict=True)
        if self.assembly.plane:
            applied.append((place.angle, torque[2]))
        else:
            for axis in range(3):
                row, other = place.R[(axis + 2) % 3], place.R[(axis + 1) % 3]
                applied += ((y, torque[axis] * x) for y, x in zip(row, other, strict=True))
        applied[:] = [(y, f) for y, f in applied if f != 0 and y.free_symbols]

    def _close_loop(self, key: str, loop: LoopJoint) -> LoopEquations:
        """Add a joint that closes a loop, or a gear."""
        if loop.ratio and loop.offset:
            ratio = self.value(f"{key}.ratio", loop.ratio)
            return derive_gear_equation(loop, ratio, self.value(f"{key}.offset", loop.offset))
        ends, base = [], self.chains.common(*loop.bodies)
        for name, position in zip(loop.bodies, loop.points, strict=True):
            place, point = self.places[name], self._vector(f"{key}.points", position)
            at, R = place.at, place.R
            if base != WORLD:
                at, R = self.chains.relative_pose(name, base, self._pose_definer(f"{loop.name}_"))
            ends.append(End(plus(at, apply(R, point)), R))
        length = self.value(f"{key}.length", loop.length) if loop.length else S.Zero
        turned = self._rotation(f"{key}.rotation", loop)
        R = self.places[base].R
        return derive_loop_equations(
            loop, self.assembly.plane, (ends[0], ends[1]), turned, length, R
        )

    def _add_body_by_formulas(self, body: RigidBody) -> None:
        assert body.position is not None
        key, terms = f"body.{body.name}", self.terms
        mass = self.value(f"{key}.mass", body.mass)
        inertia = [self.value(f"{key}.inertia", entry) for entry in body.inertia]
        at = self._vector(f"{key}.position", body.position)
        position = self._position(body.name, at, later=True)
        R, angle = self._rotation(f"{key}.rotation", body), S.Zero
        if self.assembly.plane:
            angle = sum((self.value(f"{key}.rotation", t.angle) for t in body.rotation), S.Zero)
            angle = self._define(f"{body.name}_angle", angle, later=True)
            R = rotation_about(2, angle)
        else:
            R = self._define_matrix(body.name, R, later=True)
        place = _Place(-1, ZERO, ONE, position, R, angle)
        self.places[body.name] = place
        self.loads[body.name] = mass, tuple(inertia)
        terms.kinetic += Add(*self.kinetic_terms(mass, inertia, position, place))
        terms.potential += self.gravity_potential(mass, position)

    def _add_spring(self, key: str, spring: Spring) -> None:
        stiffness = self.value(f"{key}.stiffness", spring.stiffness)
        rest = self.value(f"{key}.length", spring.length)
        self.terms.potential += stiffness * (self.length(key, spring, rest == 0) - rest) ** 2 / 2

    def add_damper(self, key: str, damper: Damper) -> None:
        """Add d/2 (dl/dt)^2 to the dissipation, with the length l of the damper."""
        damping = self.value(f"{key}.damping", damper.damping)
        self.terms.dissipation += damping * dot(self.length(key, damper, False)) ** 2 / 2

    def length(self, key: str, end: Spring | Damper, square: bool) -> Expr:
        """Return the length of a spring or damper. square: only the squared length is needed."""
        if end.coordinate:
            return symbol(end.coordinate)
        assert end.bodies is not None
        one, other = (self.places[name] for name in end.bodies)
        name = f"{key.replace('.', '')}_length"
        if end.turning:
            return self._define(name, other.angle - one.angle, later=True)
        assert end.points is not None
        a, b = (
            plus(place.at, apply(place.R, self._vector(f"{key}.points", point)))
            for place, point in zip((one, other), end.points, strict=True)
        )
        length = sympy.sqrt(sum((x - y) ** 2 for x, y in zip(b, a, strict=True)))
        return length if square else self._define(name, length, later=True)

    # --- pieces ----------------------------------------------------------------------------------

    def kinetic_terms(
        self, mass: Expr, inertia: Sequence[Expr], position: Vector, place: _Place
    ) -> list[Expr]:
        """Return the kinetic energy of a body as terms of a sum.

        m/2 |dc/dt|^2 + 1/2 sum_ab J_ab sum_k dR_ka/dt dR_kb/dt with J = tr(I)/2 - I
        """
        energy = [mass * _rate(x) ** 2 / 2 for x in position]
        if self.assembly.plane:
            return [*energy, inertia[2] * _rate(place.angle) ** 2 / 2]
        xx, yy, zz, xy, xz, yz = inertia
        second = {
            (0, 0): (yy + zz - xx) / 2, (1, 1): (xx + zz - yy) / 2, (2, 2): (xx + yy - zz) / 2,
            (0, 1): -2 * xy, (0, 2): -2 * xz, (1, 2): -2 * yz,
        }  # fmt: skip
        rates = [[_rate(entry) for entry in row] for row in place.R]
        turning = [
            J * row[a] * row[b] / 2 for (a, b), J in second.items() if J != 0 for row in rates
        ]
        return energy + turning

    def gravity_potential(self, mass: Expr, position: Vector) -> Expr:
        """Return -m g . c of a body with this mass (kg) and position (m) of its centre."""
        return -mass * spatial.dot(self.terms.gravity, position)

    def _vector(self, key: str, formulas: Sequence[Formula]) -> Vector:
        x, y, z = (self.value(key, formula) for formula in formulas)
        return (x, y, z)

    def _rotation(self, key: str, turned: RigidBody | LoopJoint) -> Matrix:
        R = ONE
        for turn in turned.rotation:
            angle = self.value(key, turn.angle)
            R = product(R, rotation_about("xyz".index(turn.axis), angle))
        return R

    def _position(self, name: str, at: Vector, later: bool = False) -> Vector:
        """Return the centre of mass as the symbols that formulas may use."""
        symbols = [S.Zero] * 3
        for k, x in enumerate(at[:2] if self.assembly.plane else at):
            wish = f"{name}_{'xyz'[k]}"
            if later:
                symbols[k] = self._define(wish, x, later)
            else:  # the symbol is defined even if it is a number
                symbols[k] = symbol(wish) if x.free_symbols else x
                self.terms.definitions.append((symbol(wish), x))
        x, y, z = symbols
        return (x, y, z)

    def _define_position(self, name: str, at: Vector, later: bool = False) -> Vector:
        named = zip("xyz", at, strict=True)
        x, y, z = (self._define(f"{name}_{letter}", e, later) for letter, e in named)
        return (x, y, z)

    def _pose_definer(self, begin: str) -> Named:
        """Return the function that names a body's pose, after the user's definitions."""

        def named(body: str, at: Vector, R: Matrix) -> tuple[Vector, Matrix]:
            R = R if self.assembly.plane else self._define_matrix(begin + body, R, later=True)
            return self._define_position(begin + body, at, later=True), R

        return named

    def _define_matrix(self, name: str, R: Matrix, later: bool = False) -> Matrix:
        rows = enumerate(R, start=1)
        return spatial.matrix(
            [self._define(f"{name}_r{i}{j}", e, later) for j, e in enumerate(row, start=1)]
            for i, row in rows
        )

    def _define(self, wish: str, e: Expr, later: bool = False) -> Expr:
        """Return a definition of `e`, unless it is a number, a symbol or its negative."""
        if e.is_number or e.is_Symbol or (-e).is_Symbol:
            return e
        name = wish
        while name in self.taken:
            name += "_"
        self.taken.add(name)
        where = self.terms.later if later else self.terms.definitions
        where.append((symbol(name), e))
        return symbol(name)


def _rate(e: Expr) -> Expr:
    return dot(e) if e.free_symbols else S.Zero
