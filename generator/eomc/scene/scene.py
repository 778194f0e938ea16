"""A checked scene as data, with the place of each entry in its file. Independent of SymPy and C."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from eomc.base.errors import EomcError, Problem
from eomc.scene.assembly import Assembly, Turn, Vector
from eomc.scene.formulas import Formula
from eomc.scene.scope import Path, value_of
from eomc.scene.source_map import SourceMap


@dataclass(frozen=True)
class SceneCoordinate:
    """A generalized coordinate of a scene.

    start: initial value in `unit`. rate: initial velocity in unit/s. The velocity has the name
    `<name>_dot` in formulas. start_fixed, rate_fixed: True if the initial value or velocity must
    not be changed to satisfy the constraints. friction: Coulomb friction in N or N m.
    friction_width: width w of the smoothed friction, friction*tanh(velocity/w).
    """

    name: str
    unit: str
    start: Formula
    rate: Formula
    note: str
    start_fixed: bool = True
    rate_fixed: bool = True
    friction: Formula | None = None
    friction_width: Formula | None = None


@dataclass(frozen=True)
class Quantity:
    """A parameter, which can be changed at run time, or a constant, which is fixed in the code.

    value: its value in `unit`. formula: the formula in the scene that gives this value.
    """

    name: str
    unit: str
    value: float
    note: str
    formula: Formula


@dataclass(frozen=True)
class SceneInput:
    """An input, whose value can be given at every step.

    signal: formula that determines the input if no value is given. limits: formulas of the smallest
    and the largest value of the input, beyond which it is clipped; None if unbounded.
    """

    name: str
    unit: str
    signal: Formula
    note: str
    limits: tuple[Formula | None, ...] = (None, None)


@dataclass(frozen=True)
class SceneOutput:
    """An output: a named quantity that is computed from the motion by a formula.

    The formula may use all quantities of the scene, accelerations and constraint forces too.
    """

    name: str
    unit: str
    formula: Formula
    note: str


@dataclass(frozen=True)
class SceneConstraint:
    """A constraint equation: a formula that is zero along every motion.

    The formula depends on coordinates and t (holonomic), or is linear in the velocities.
    """

    name: str
    unit: str
    formula: Formula
    note: str


@dataclass(frozen=True)
class SceneEvent:
    """An event, which is triggered when a formula crosses zero.

    when: the formula. direction: "rising", "falling" or "both". action: "record", "stop" or "jump".
    jump: pairs (name, formula) of the coordinates, velocities and parameters that a jump sets.
    """

    name: str
    when: Formula
    direction: str
    action: str
    jump: tuple[tuple[str, Formula], ...]
    note: str


@dataclass(frozen=True)
class PicturePlace:
    """A position in a picture.

    at: three formulas in m; if None, the position and the axes are those of the body or [[point]]
    `name`.
    """

    name: str
    at: Vector | None


@dataclass(frozen=True)
class Shape:
    """One shape of a picture.

    kind: "dot" or "path" (one place), "line" (two places or more), "spring" (two places), "box" or
    "circle" (one place, their centre). size: edges of a box or radius of a circle, m. rotation: of
    a box or circle, relative to the axes of the body at its place, or else to the world's axes.
    """

    kind: str
    places: tuple[PicturePlace, ...]
    size: tuple[Formula, ...] = ()
    rotation: tuple[Turn, ...] = ()


@dataclass(frozen=True)
class Picture:
    """The shapes that a scene draws in its table [picture].

    axes: letters of the axes, such as "xz" in the plane, and "xyz" in space.
    """

    shapes: tuple[Shape, ...]
    axes: str


@dataclass(frozen=True)
class RunSettings:
    """Settings of the table [run] of a scene: what code is generated, and defaults of simulations.

    Attributes
    ----------
    h, duration : float
        Default step size and duration of a simulation, s.
    methods : tuple of str
        The steppers to generate; the first is the default.
    real : str
        C type of all computations.
    batch : bool
        Generate functions for many trajectories at once.
    linearize : bool or "parameters"
        Generate derivatives of the accelerations, "parameters" also those by the parameters.
    discretize : bool
        Generate derivatives of steps.
    frames : bool or tuple of str
        Bodies and points whose poses, velocities, accelerations and Jacobians are generated; True
        for all.
    inverse_dynamics, momentum : bool
        Generate these functions.
    tolerance : float or None
        Tolerance of adaptive steps; None for fixed steps.
    friction : str
        "smooth", or "stick" if Coulomb friction of joints and coordinates holds them exactly.
    """

    h: float = 0.001
    duration: float = 10.0
    methods: tuple[str, ...] = ("rk4",)
    real: str = "double"
    batch: bool = False
    linearize: bool | str = False
    discretize: bool = False
    frames: bool | tuple[str, ...] = False
    inverse_dynamics: bool = False
    momentum: bool = False
    tolerance: float | None = None
    friction: str = "smooth"

    @property
    def needs_derivatives(self) -> bool:
        """True if derivatives of the accelerations must be generated.

        They are needed for `linearize` and, to differentiate steps, for `discretize`.
        """
        return bool(self.linearize) or self.discretize


@dataclass(frozen=True)
class Scene:
    """A checked scene: the mechanical system and the settings that a TOML file describes.

    All names in the formulas are declared, and no definition is circular.

    Attributes
    ----------
    file, digest
        Name of the file, and SHA-256 digest of its text.
    kinetic, potential, dissipation
        Formulas of the energies in J and of Rayleigh's dissipation function.
    forces
        Formulas of generalized forces, by coordinate.
    assembly
        Bodies, joints, springs, dampers, forces and loops; None if there are none.
    places
        Lines of all keys in the file.
    warnings
        Problems that are not errors.
    used
        For each name, the keys of the formulas that use it.
    """

    name: str
    title: str
    note: str
    file: str
    digest: str
    coordinates: tuple[SceneCoordinate, ...]
    parameters: tuple[Quantity, ...]
    constants: tuple[Quantity, ...]
    inputs: tuple[SceneInput, ...]
    definitions: tuple[tuple[str, Formula], ...]
    kinetic: Formula
    potential: Formula
    dissipation: Formula
    forces: Mapping[str, Formula]
    outputs: tuple[SceneOutput, ...]
    events: tuple[SceneEvent, ...]
    constraints: tuple[SceneConstraint, ...]
    run: RunSettings
    assembly: Assembly | None
    picture: Picture | None
    places: SourceMap = field(repr=False, compare=False)
    warnings: tuple[Problem, ...] = ()
    used: Mapping[str, Sequence[Path]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def constrained(self) -> bool:
        """True if the scene has constraint equations, from [constraints] or from loops."""
        return bool(self.constraints or (self.assembly and self.assembly.loops))

    def start(
        self, parameters: Mapping[str, float] | None = None
    ) -> tuple[list[float], list[float]]:
        """Return the initial coordinates q and velocities q̇, each a list in the scene's order.

        parameters: values that replace those of the scene's parameters. Raises EomcError if an
        initial value can't be computed, such as 1/l with l = 0.
        """
        values = {p.name: p.value for p in (*self.parameters, *self.constants)}
        values.update(parameters or {})

        def number(formula: Formula, key: str) -> float:
            value, fault = value_of(formula, values)
            if fault:
                raise EomcError(str(self.problem(key, fault, formula)))
            return value

        return (
            [number(c.start, f"coordinates.{c.name}.start") for c in self.coordinates],
            [number(c.rate, f"coordinates.{c.name}.rate") for c in self.coordinates],
        )

    def problem(
        self,
        key: str,
        message: str,
        formula: Formula | None = None,
        severity: str = "error",
    ) -> Problem:
        """Return a problem (error or warning) at a key of the scene such as "energy.kinetic".

        It contains the line of the key in the file. formula: the formula to mark in that line.
        severity: "error" or "warning".
        """
        text = formula.text if formula else None
        return self.places.problem(tuple(key.split(".")), message, text=text, severity=severity)
