"""A checked scene as data, with the place of each entry in its file. Independent of SymPy and C."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from eomc.base.errors import EomcError, Problem
from eomc.scene.assembly import Assembly
from eomc.scene.formulas import Formula
from eomc.scene.picture import Picture
from eomc.scene.scope import Path, value_of
from eomc.scene.source_map import SourceMap


@dataclass(frozen=True)
class Coordinate:
    """A generalized coordinate, with its initial value in `unit` and velocity in unit/s.

    The velocity is named `<name>_dot`. start_fixed, rate_fixed: True if assembly keeps the initial
    value or velocity. friction: Coulomb friction, N or N m. friction_width: rate over which it is
    smoothed.
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
    """A parameter (variable at run time) or a constant (folded into the code)."""

    name: str
    unit: str
    value: float
    note: str
    formula: Formula


@dataclass(frozen=True)
class Input:
    """An input, given from outside at every step; `signal` is its default as a formula.

    limits: smallest and largest value that acts, None if unbounded.
    """

    name: str
    unit: str
    signal: Formula
    note: str
    limits: tuple[Formula | None, ...] = (None, None)


@dataclass(frozen=True)
class Output:
    """An output: a formula of any quantities of the motion."""

    name: str
    unit: str
    formula: Formula
    note: str


@dataclass(frozen=True)
class Constraint:
    """A constraint: a formula that is zero along every motion.

    It depends on coordinates and t, or is linear in the velocities.
    """

    name: str
    unit: str
    formula: Formula
    note: str


@dataclass(frozen=True)
class Event:
    """An event, where a formula crosses zero.

    direction: "rising", "falling" or "both". action: "record", "stop" or "jump". jump: formulas of
    the coordinates and velocities after a jump.
    """

    name: str
    when: Formula
    direction: str
    action: str
    jump: tuple[tuple[str, Formula], ...]
    note: str


@dataclass(frozen=True)
class Run:
    """Settings of a run; step size h and duration in s are defaults for callers.

    Attributes
    ----------
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
        """True if derivatives of the accelerations are needed, also for derivatives of steps."""
        return bool(self.linearize) or self.discretize


@dataclass(frozen=True)
class Scene:
    """A checked scene: all names are declared, no definition is circular, all kinds are right.

    `used` maps each name to the places where it is used.
    """

    name: str
    title: str
    note: str
    file: str
    digest: str
    coordinates: tuple[Coordinate, ...]
    parameters: tuple[Quantity, ...]
    constants: tuple[Quantity, ...]
    inputs: tuple[Input, ...]
    definitions: tuple[tuple[str, Formula], ...]
    kinetic: Formula
    potential: Formula
    dissipation: Formula
    forces: Mapping[str, Formula]
    outputs: tuple[Output, ...]
    events: tuple[Event, ...]
    constraints: tuple[Constraint, ...]
    run: Run
    assembly: Assembly | None
    picture: Picture | None
    places: SourceMap = field(repr=False, compare=False)
    warnings: tuple[Problem, ...] = ()
    used: Mapping[str, Sequence[Path]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def constrained(self) -> bool:
        """True if there are constraints or loops."""
        return bool(self.constraints or (self.assembly and self.assembly.loops))

    def start(
        self, parameters: Mapping[str, float] | None = None
    ) -> tuple[list[float], list[float]]:
        """Return the initial q and q_dot, for the given values of parameters.

        Raises EomcError if one has no value, such as 1/l with l = 0.
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
        """Return a problem at a key such as `energy.kinetic`, with its line and formula marked."""
        text = formula.text if formula else None
        return self.places.problem(tuple(key.split(".")), message, text=text, severity=severity)
