"""A mechanical system in SymPy: from a scene (`from_scene`) or from Python (`System.make`)."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any, Never

import sympy
from sympy import Expr, Symbol

from eomc.base.errors import Problem, SceneError
from eomc.model import algebra, constraints
from eomc.model.constraints import LoopEquations
from eomc.model.from_sympy import SystemArguments
from eomc.model.hybrid import Friction, add_hybrid_dynamics
from eomc.model.mechanics import Mechanics, NotLinearError, split_potential
from eomc.model.multibody import Builder, Terms
from eomc.model.symbols import (
    Constraint,
    Coordinate,
    Event,
    Input,
    Output,
    Parameter,
    Reaction,
    dot,
    multiplier_of,
    symbol,
    t,
)
from eomc.scene import hints
from eomc.scene.formulas import Formula, FormulaError, fold_values, suggest
from eomc.scene.scene import Scene, SceneCoordinate
from eomc.scene.scope import ENERGIES

__all__ = [
    "Constraint", "Coordinate", "Event", "Input", "Output", "Parameter", "Reaction", "System",
    "dot", "from_scene", "symbol", "t",
]  # fmt: skip


class System(Mechanics):
    """A mechanical system in SymPy symbols: d/dt dL/dqd - dL/dq + dR/dqd = Q with L = K - P - a.qd.

    It is read from a scene by `eomc.read`, or made from expressions by `System.make`. Its
    attributes are those of `Mechanics`.
    """

    def __repr__(self) -> str:
        return f"<System {self.name}: {self.size}>"

    @property
    def size(self) -> str:
        """Text with the numbers of coordinates, inputs and parameters."""
        counts = {
            "coordinate": self.coordinates, "input": self.inputs, "parameter": self.parameters,
        }  # fmt: skip
        return ", ".join(f"{len(x)} {what}{'s' * (len(x) != 1)}" for what, x in counts.items())

    @classmethod
    def make(
        cls,
        name: str,
        coordinates: Sequence[Any] | Mapping[Any, Any],
        kinetic: Any = None,
        potential: Any = 0,
        *,
        parameters: Mapping[Any, float] | None = None,
        dissipation: Any = 0,
        forces: Mapping[Any, Any] | None = None,
        inputs: Mapping[Any, Any] | Sequence[Any] = (),
        definitions: Mapping[Any, Any] | None = None,
        outputs: Mapping[str, Any] | None = None,
        constraints: Mapping[str, Any] | None = None,
        guess: Sequence[Any] = (),
        units: Mapping[Any, str] | None = None,
        title: str = "",
        h: float = 0.001,
        duration: float = 10.0,
        methods: Sequence[str] = ("rk4",),
        real: str = "double",
        batch: bool = False,
        linearize: bool | str = False,
        discretize: bool = False,
        inverse_dynamics: bool = False,
        limits: Mapping[Any, Sequence[Any]] | None = None,
        events: Mapping[str, Any] | None = None,
        tolerance: float | None = None,
        picture: Mapping[str, Any] | None = None,
        friction: Mapping[Any, Any] | None = None,
        **unknown: Never,
    ) -> System:
        r"""Make a system from SymPy expressions and return it.

        Names as text may replace symbols, and formulas in the syntax of scenes may replace
        expressions. The velocity of a symbol `theta` is the symbol `theta_dot`; the velocity of a
        dynamicsymbol is `theta.diff()`. Units are SI units and radians.

        Parameters
        ----------
        name
            Name of the system, of its Python module and of its C files.
        coordinates
            Symbols or dynamicsymbols, or a mapping from these to initial values or to pairs
            (value, velocity). Initial values are numbers or formulas of parameters.
        kinetic, dissipation
            Kinetic energy and Rayleigh's dissipation function.
        potential
            Potential energy. It may have terms linear in the velocities, such as
            e*B*(y*x_dot - x*y_dot)/2 of a charge in a magnetic field, which are not part of the
            energy.
        parameters
            Mapping from symbols to numbers.
        forces
            Mapping from coordinates to generalized forces (N or N m).
        inputs
            Symbols, or a mapping from symbols to default values.
        definitions
            Mapping from symbols to expressions.
        outputs
            Mapping from names to expressions. The acceleration of `theta` in them is `theta_ddot`,
            or the second derivative of a dynamicsymbol.
        constraints
            Mapping from names to expressions that are zero. They depend on coordinates and t, or
            are linear in the velocities.
        guess
            Coordinates whose initial values may be changed to satisfy the constraints, as those of
            coordinates without an initial value are.
        units
            Mapping from symbols or names to units, for display.
        title
            Title for display; by default the name.
        h, duration
            Default step size and duration of a run in s.
        methods
            Names of the methods with fixed steps to generate, or "auto" for adaptive steps.
        real, batch, linearize, discretize, inverse_dynamics
            Settings of the generated code, as in the table [run] of a scene.
        limits
            Mapping from inputs to saturation limits (lower, upper); None for no limit.
        events
            Mapping from names to event functions, or to dicts as [[event]] in a scene:
            {"when": y, "direction": "falling", "action": "jump", y_dot: -e*y_dot}.
        tolerance
            Tolerance of adaptive steps. By default 1e-9 (larger in single precision) for systems
            with events, friction or the method "auto"; other systems then have fixed steps only.
        picture
            Dict as the table [picture] in a scene: {"lines": [[[0, 0], [x, -l]]]}.
        friction
            Mapping from coordinates to Coulomb friction (N or N m) with stick-slip transitions.

        Returns
        -------
        System
            The system. Names that are invalid in C (`\theta`, `lambda`) are replaced in it, as
            listed in its attribute `renamed`.

        Raises
        ------
        EomcError
            If an argument is invalid or an expression has an undeclared name.
        TypeError
            If there is no argument of a given name.

        Examples
        --------
        >>> from sympy.physics.mechanics import dynamicsymbols
        >>> theta, (m, l, g) = dynamicsymbols("theta"), sympy.symbols("m l g")
        >>> System.make("pendulum", {theta: 0.5}, m*l**2*theta.diff()**2/2,
        ...             -m*g*l*sympy.cos(theta), parameters={m: 1, l: 1, g: 9.81}).qd
        (theta_dot,)
        """
        arguments = {key: x for key, x in locals().items() if key not in ("cls", "unknown")}
        _check_names(unknown, arguments)
        checked = SystemArguments(arguments)
        system = from_scene(checked.scene())
        compared = [getattr(system, f.name) for f in fields(system) if f.compare]
        whole = sympy.srepr(compared) + checked.picture_text()
        return replace(
            system,
            digest=hashlib.sha256(whole.encode()).hexdigest(),
            renamed=tuple(checked.renamed),
            own_symbols=checked.own_symbols,
            again=partial(cls.make, **arguments),
        )


def _check_names(unknown: Iterable[str], known: Collection[str]) -> None:
    """Raise TypeError if a user passed keyword arguments that System.make does not have.

    unknown: the names of these keyword arguments; nothing is raised if there are none. known: names
    of the valid arguments, of which the message suggests the most similar one.
    """
    for name in unknown:
        if name in hints.LAGRANGIANS:
            why = f": {hints.GIVE_ENERGIES}"
        else:
            why = suggest(hints.ARGUMENTS.get(name, name), known)
        remedy = why or f": it has {', '.join(known)}"
        raise TypeError(f"System.make has no argument '{name}'{remedy}")


# --- from a scene ---------------------------------------------------------------------------------


class _Formulas:
    """Converter of the formulas of a scene to SymPy expressions; it collects their problems."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.known: dict[str, Expr] = {"t": t}
        for c in scene.coordinates:
            self.known |= {n: symbol(n) for n in (c.name, f"{c.name}_dot")}
        names = [*(p.name for p in scene.parameters), *(i.name for i in scene.inputs)]
        self.known |= {name: symbol(name) for name in names}
        self.problems: list[Problem] = []
        self.doubts: list[Problem] = []
        self.sizes: dict[str, algebra.DigitBound] = {}  # of constants and definitions

    def value(self, key: str, formula: Formula) -> Expr:
        """Convert a formula to a SymPy expression and return it.

        If the formula has no valid value, append an error to `problems` and return 0. key: key of
        the formula in the scene, such as "energy.kinetic".
        """
        name = key.partition(".")[2] if key.startswith(("constants.", "definitions.")) else ""
        try:
            self.sizes[name] = algebra.VARIES
            if formula.expression is None:  # else SymPy has its numbers already
                self.sizes[name] = algebra.bound(formula, self.sizes)
            return algebra.expression(formula, self.known)
        except (FormulaError, ArithmeticError, ValueError, TypeError) as fault:
            message = f"'{formula.shown}' {fault}"
            self.problems.append(self.scene.problem(key, message, formula))
            return sympy.S.Zero

    def definitions(self) -> tuple[list[tuple[Symbol, Expr]], Terms]:
        """Return the definitions of the system and the terms that bodies add to the system.

        The definitions are pairs (symbol, expression), each over the symbols before it: those of
        the scene and those that the bodies need. The constants of the scene are evaluated too.
        """
        scene, known = self.scene, self.known
        for constant in scene.constants:
            known[constant.name] = self.value(f"constants.{constant.name}", constant.formula)
        declared = [*known, *(name for name, _ in scene.definitions)]
        rates = {symbol(c.name): symbol(f"{c.name}_dot") for c in scene.coordinates}
        builder, definitions = None, []
        if scene.assembly:
            sticks = scene.run.friction == "stick"
            builder = Builder(scene.assembly, self.value, rates, declared, sticks)
        if builder:
            builder.build_tree()
            definitions += builder.terms.definitions
            known |= {name.name: name for name, _ in definitions}
        for name, formula in scene.definitions:
            definitions.append((symbol(name), self.value(f"definitions.{name}", formula)))
            known[name] = symbol(name)
        if builder:
            builder.build_rest()
            builder.add_forces()
            definitions += builder.terms.later
        return definitions, builder.terms if builder else Terms()

    def potential(self, definitions: Sequence[tuple[Symbol, Expr]]) -> tuple[Expr, Expr]:
        """Return the potential of the table [energy] as a pair of expressions.

        The first is the part without velocities, the second the part that is linear in the
        velocities. definitions: pairs (symbol, expression), each over the symbols before it.
        """
        key, formula = "energy.potential", self.scene.potential
        whole = self.value(key, formula)
        if self.problems:  # a formula without a value is 0
            return whole, sympy.S.Zero
        velocities = [symbol(f"{c.name}_dot") for c in self.scene.coordinates]
        try:
            return split_potential(whole, definitions, velocities)
        except NotLinearError as fault:
            self.problems.append(self.scene.problem(key, str(fault), formula))
            return whole, sympy.S.Zero

    def inputs(self) -> Iterator[Input]:
        """Yield the inputs of the scene with signals and limits as SymPy expressions."""
        for i in self.scene.inputs:
            signal = self.value(f"inputs.{i.name}.signal", i.signal)
            ends = (f and self.value(f"inputs.{i.name}.limits", f) for f in i.limits)
            yield Input(i.name, i.unit, signal, i.note, tuple(ends))

    def frictions(self, more: Terms) -> tuple[dict[str, Expr], list[Friction]]:
        """Return the Coulomb friction of the scene as a pair (smooth, sticking).

        smooth: dict from the name of a coordinate to its smooth friction force, without friction
        that is declared at joints. sticking: list of all friction that switches between sticking
        and sliding. more: the terms that the bodies add, which contain the sticking friction of
        joints.
        """
        smooth, sticks = dict[str, Expr](), list[Friction]()
        for c in self.scene.coordinates:
            if c.friction is not None and c.friction_width is not None:
                key = f"coordinates.{c.name}.friction"
                size = self.value(key, c.friction)
                if self.scene.run.friction == "stick":
                    sticks.append(Friction(c.name, size, key))
                else:
                    width = self.value(f"{key}_width", c.friction_width)
                    smooth[c.name] = -size * sympy.tanh(symbol(f"{c.name}_dot") / width)
        for q, friction in more.frictions:
            if q in more.rates:
                sticks.append(friction)
            else:
                why = (
                    "friction that sticks needs a joint with a coordinate of its own, no formula: "
                    'write friction = "smooth" in [run], or close the mechanism by a [[loop]]'
                )
                self.problems.append(self.scene.problem(friction.key, why))
        return smooth, sticks

    def events(self) -> Iterator[Event]:
        """Yield the events of the scene; their jumps are pairs (name, new value)."""
        for k, e in enumerate(self.scene.events, start=1):
            when = self.value(f"event.{k}.when", e.when)
            jump = ((name, self.value(f"event.{k}.{name}", formula)) for name, formula in e.jump)
            yield Event(e.name, when, e.direction, e.action, tuple(jump), note=e.note)

    def constraints(
        self,
        coordinates: Sequence[Coordinate],
        definitions: Sequence[tuple[Symbol, Expr]],
        closed: Iterable[LoopEquations],
    ) -> tuple[tuple[Constraint, ...], tuple[Reaction, ...]]:
        """Return the constraint equations of the scene, holonomic ones first, and loop reactions.

        closed: constraint equations and reaction of each loop. The reactions are the forces and
        moments that the loop joints exert.
        """
        written = {c.name: c.formula for c in self.scene.constraints}

        def problem(row: Constraint, message: str, severity: str) -> Problem:
            if row.loop:
                return self.scene.problem(f"loop.{row.loop}", message, severity=severity)
            key, formula = f"constraints.{row.name}.formula", written[row.name]
            return self.scene.problem(key, f"'{formula.shown}' {message}", formula, severity)

        rows = [
            Constraint(
                c.name, self.value(f"constraints.{c.name}.formula", c.formula), True, c.unit, c.note
            )
            for c in self.scene.constraints
        ]
        if self.problems:  # a formula without a value is 0
            return (), ()
        values = {p.name: p.value for p in self.scene.parameters}
        checks = constraints.ConstraintChecker(
            coordinates,
            definitions,
            {symbol(name): value for name, value in values.items()},
            lambda row, message: self.problems.append(problem(row, message, "error")),
            lambda row, message: self.doubts.append(problem(row, message, "warning")),
        )
        loops = [checks.without_constant_rows(loop) for loop in closed]
        rows += [row for loop in loops for row in loop.rows]
        return checks.classify(rows), tuple(r for loop in loops for r in loop.reactions)

    def outputs(
        self, kinetic: Expr, potential: Expr, forces: Mapping[str, Expr]
    ) -> Iterator[Output]:
        """Yield the outputs of the scene with their formulas as SymPy expressions.

        The formulas may use accelerations, the energies `kinetic` and `potential`, and constraint
        forces. forces: dict from the name of each Lagrange multiplier and each component of a
        reaction, as outputs call them, to its expression.
        """
        accelerations = (f"{c.name}_ddot" for c in self.scene.coordinates)
        energies = (kinetic, potential, kinetic + potential)
        self.known = {
            **dict(zip(ENERGIES, energies, strict=True)),
            **{name: symbol(name) for name in accelerations},
            **forces,
            **self.known,
        }
        for o in self.scene.outputs:
            if missing := [n.id for n in o.formula.names() if n.id not in self.known]:
                why = f"'{missing[0]}' is of a coordinate without friction that sticks"
                key = f"outputs.{o.name}.formula"
                self.problems.append(self.scene.problem(key, why, o.formula))
                continue
            yield Output(o.name, self.value(f"outputs.{o.name}.formula", o.formula), o.unit, o.note)


def _forces(
    scene: Scene, rows: Sequence[Constraint], reactions: Sequence[Reaction],
    sticks: Sequence[Friction],
) -> dict[str, Expr]:  # fmt: skip
    """Return multipliers and components of reactions by their names in outputs."""
    expressions: dict[str, Expr] = {}
    if scene.assembly:
        plane = scene.assembly.plane
        entries = {r.name: r.values for r in reactions}
        for loop in scene.assembly.loops:
            # zero for constant equations, which have no multiplier
            expressions |= {f"lambda_{row}": sympy.S.Zero for row in loop.rows(plane).values()}
            names = loop.reactions(plane)
            expressions |= dict(zip(names, entries.get(loop.name, ()), strict=bool(names)))
    expressions |= {f"lambda_{row.name}": row.multiplier for row in rows}
    sticking = (f"{friction.coordinate}_sticks" for friction in sticks)
    return expressions | {f"lambda_{name}": multiplier_of(name) for name in sticking}


def from_scene(scene: Scene) -> System:
    """Convert a checked scene to a System of SymPy expressions and return it.

    Raises SceneError, which lists all problems of the formulas.
    """
    scene_formulas = _Formulas(scene)
    value = scene_formulas.value
    definitions, more = scene_formulas.definitions()
    kinetic = value("energy.kinetic", scene.kinetic)
    potential, linear_potential = scene_formulas.potential(definitions)
    start, rate = scene.start()
    forces = {name: value(f"forces.{name}", formula) for name, formula in scene.forces.items()}
    zero = sympy.S.Zero
    kinetic_energy = sympy.Add(kinetic, more.kinetic, *more.tree_kinetic)
    potential_energy = sympy.Add(potential, more.potential, *more.tree_potential)
    rubs, sticks = scene_formulas.frictions(more)
    coordinates = tuple(
        Coordinate(
            c.name,
            c.unit,
            q,
            qd,
            c.note,
            c.start_fixed,
            c.rate_fixed,
            *_parameter_formulas(scene, c),
        )
        for c, q, qd in zip(scene.coordinates, start, rate, strict=True)
    )
    rows, reactions = scene_formulas.constraints(coordinates, definitions, more.closed)
    multipliers = _forces(scene, rows, reactions, sticks)
    system = System(
        name=scene.name,
        coordinates=coordinates,
        kinetic=kinetic_energy,
        potential=potential_energy,
        linear_potential=linear_potential,
        dissipation=value("energy.dissipation", scene.dissipation) + more.dissipation,
        forces=tuple(
            sympy.Add(*(some.get(c.name, zero) for some in (more.forces, forces, rubs)))
            for c in scene.coordinates
        ),
        applied=tuple(more.applied),
        tree=more.tree(kinetic, potential),
        frames=tuple(more.frames),
        plane=bool(scene.assembly and scene.assembly.plane),
        parameters=tuple(Parameter(p.name, p.value, p.unit, p.note) for p in scene.parameters),
        inputs=tuple(scene_formulas.inputs()),
        definitions=tuple(definitions),
        events=tuple(scene_formulas.events()),
        constraints=rows,
        reactions=reactions,
        outputs=tuple(scene_formulas.outputs(kinetic_energy, potential_energy, multipliers)),
        run=scene.run,
        title=scene.title,
        note=scene.note,
        file=scene.file,
        digest=scene.digest,
        warnings=(*scene.warnings, *scene_formulas.doubts, *_start_warnings(scene)),
        place=scene.problem,
        scene=scene,
    )
    if faults := scene_formulas.problems or system.beyond_float():
        raise SceneError(faults)
    return add_hybrid_dynamics(system, sticks)


def _parameter_formulas(scene: Scene, c: SceneCoordinate) -> Iterator[str]:
    """Yield the formulas of start and rate that depend on parameters, "" for others."""
    constants = {one.name: one.value for one in scene.constants}
    for formula in (c.start, c.rate):
        free = {name.id for name in formula.names()}.isdisjoint(p.name for p in scene.parameters)
        yield "" if free else fold_values(formula, constants)


def _start_warnings(scene: Scene) -> list[Problem]:
    """Return warnings on springs and dampers of zero length at the start."""
    assembly = scene.assembly
    if not assembly or not any(
        [*(s.points for s in assembly.springs), *(d.points for d in assembly.dampers)]
    ):
        return []
    from eomc.model import kinematics  # imports NumPy, which few scenes need here

    return kinematics.find_coincident_ends(scene)
