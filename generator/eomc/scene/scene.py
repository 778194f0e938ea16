"""A checked scene: data, with the place of each entry in its file. No SymPy, no C."""

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
    """A generalized coordinate; its velocity is `<name>_dot`. Start in `unit`, rate in unit/s.

    held, rate_fixed: whether constraints leave them as they are when a start is assembled.
    friction: Coulomb's, N or N m; friction_width: the rate within which it is smoothed.
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
    """A parameter (changed at run time) or a constant (folded into the code)."""

    name: str
    unit: str
    value: float
    note: str
    formula: Formula


@dataclass(frozen=True)
class Input:
    """A quantity given from outside at every step; `signal` is what it is by default.

    limits: the least and largest value that acts, None where there is none.
    """

    name: str
    unit: str
    signal: Formula
    note: str
    limits: tuple[Formula | None, ...] = (None, None)


@dataclass(frozen=True)
class Output:
    """A quantity that is asked for: a formula over everything that a motion has."""

    name: str
    unit: str
    formula: Formula
    note: str


@dataclass(frozen=True)
class Constraint:
    """What is zero along every motion: a formula of coordinates and t, or linear in the rates."""

    name: str
    unit: str
    formula: Formula
    note: str


@dataclass(frozen=True)
class Event:
    """Where a formula crosses zero: up, down or both ways.

    action: "record", "stop" or "jump"; jump: what coordinates and velocities are after it.
    """

    name: str
    when: Formula
    direction: str
    action: str
    jump: tuple[tuple[str, Formula], ...]
    note: str


@dataclass(frozen=True)
class Run:
    """How the scene is run unless the caller says otherwise: step size h and duration in s.

    methods: the steppers wanted, the one that runs use first. real: the C type that everything
    is computed in. batch: whether many trajectories at once are wanted. linearize: whether the
    derivatives of the accelerations are, "parameters" for those by parameters too. discretize:
    whether those of steps are. frames: of which bodies and points poses, velocities, accelerations
    and Jacobians are, True for all. inverse_dynamics, momentum: whether these are.
    tolerance: of adaptive steps, None where the scene asks for none. friction: "smooth", or "stick"
    where that of joints and coordinates holds them exactly.
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
        """Whether derivatives of the accelerations are wanted; those of steps are made of them."""
        return bool(self.linearize) or self.discretize


@dataclass(frozen=True)
class Scene:
    """A checked scene: nothing in it is undeclared, circular, misspelt or of the wrong kind.

    used: where each name stands.
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
        """Whether there are constraints or loops."""
        return bool(self.constraints or (self.assembly and self.assembly.loops))

    def start(
        self, parameters: Mapping[str, float] | None = None
    ) -> tuple[list[float], list[float]]:
        """q and q_dot at the start, with the given values in place of the parameters' defaults.

        Raises EomcError where they have no value, such as 1/l with l = 0.
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
        """A problem at a key such as `energy.kinetic`, with its line and its formula marked."""
        text = formula.text if formula else None
        return self.places.problem(tuple(key.split(".")), message, text=text, severity=severity)
