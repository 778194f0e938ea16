"""A mechanical system over symbols: coordinates, definitions, K, P, forces, constraints, events.

Independent of the source of the system, TOML or Python, and of the generated C.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from typing import Any, Self, TypeVar

import sympy
from sympy import Expr, Symbol

from eomc.base.errors import Problem
from eomc.model.constraint_report import ConstraintSummary
from eomc.model.symbols import (
    Constraint,
    Coordinate,
    Event,
    FrictionMode,
    Input,
    Output,
    Parameter,
    Reaction,
)
from eomc.model.tree import Frame, Tree
from eomc.scene.scene import Run, Scene

LEAST_FLOAT, LARGEST_FLOAT = 2.0**-126, 2.0**128 - 2.0**104  # of full precision, in C


_TABLES = "constants constraints coordinates definitions energy forces inputs outputs parameters"
_TABLE = re.compile(rf"\[({_TABLES.replace(' ', '|')})\]")


def in_words_of_python(message: str) -> str:
    """Return a message about tables of a scene with the arguments of System.make in their place.

    >>> in_words_of_python("split it with [definitions]")
    'split it with definitions'
    """
    return _TABLE.sub(r"\1", message)


def argument_of(key: str) -> str:
    """Return the argument of System.make that corresponds to a key of a scene.

    >>> argument_of("run.method"), argument_of("energy.kinetic"), argument_of("parameters.m")
    ('methods', 'kinetic', 'parameters.m')
    """
    table, _, last = key.partition(".")
    if table not in ("run", "energy") or not last:
        return key
    return {"method": "methods"}.get(last, last)


@dataclass(frozen=True)
class Mechanics:
    """d/dt dL/dqd - dL/dq + dR/dqd = Q with L = K - P - a.qd, over named definitions.

    `definitions` are (symbol, expression) pairs, each over the symbols before it, t included;
    `dot(e)` stands for de/dt. `linear_potential` is a(q, t).qd, the part of a generalized potential
    that is linear in the velocities (generalized_potential.py), no part of the energy. `forces`:
    Q, one expression for each coordinate. `applied`: forces F at positions y, as pairs (y, F), each
    of which adds F dy/dq to Q. `constraints`: expressions that are zero, holonomic ones first; with
    their Jacobian A (with respect to q, or to qd if nonholonomic) and the multipliers lambda,
    A^T lambda is added to Q. `reactions`: of the loops. `tree`: the bodies with joints, whose
    energies are part of K and P. `frames`: of bodies and points, in space or in the `plane`.
    `digest`: hash of the source of the system. `renamed`: names that C does not allow, as (given,
    used) pairs. `scene`: the scene from which the system was read, if any. `picture_scene`: for a
    system made in Python with a picture, a scene of its names and the picture only. `closure`:
    properties of the constraints, once initial values are assembled. `modes`: stick-slip friction
    modes, the last coordinates. `discrete`: names of discrete coordinates, placed before the modes;
    no derivative with respect to them is taken. `again`: `make` with its arguments, any of which
    can be replaced. `own_symbols`: the symbols, functions of time and their derivatives that the
    user gave to `make`, by their names in the system.
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    kinetic: Expr
    potential: Expr = sympy.S.Zero
    linear_potential: Expr = sympy.S.Zero
    dissipation: Expr = sympy.S.Zero
    forces: tuple[Expr, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    inputs: tuple[Input, ...] = ()
    definitions: tuple[tuple[Symbol, Expr], ...] = ()
    outputs: tuple[Output, ...] = ()
    events: tuple[Event, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    reactions: tuple[Reaction, ...] = ()
    applied: tuple[tuple[Expr, Expr], ...] = ()
    tree: Tree | None = None
    frames: tuple[Frame, ...] = ()
    plane: bool = False
    run: Run = field(default_factory=Run)
    title: str = ""
    note: str = ""
    file: str = ""
    digest: str = ""
    renamed: tuple[tuple[str, str], ...] = ()
    warnings: tuple[Problem, ...] = field(default=(), compare=False)
    place: Callable[..., Problem] | None = field(default=None, compare=False, repr=False)
    scene: Scene | None = field(default=None, compare=False, repr=False)
    picture_scene: Scene | None = field(default=None, compare=False, repr=False)
    closure: ConstraintSummary | None = field(default=None, compare=False, repr=False)
    modes: tuple[FrictionMode, ...] = ()
    discrete: tuple[str, ...] = ()
    again: partial[Any] | None = field(default=None, compare=False, repr=False)
    own_symbols: Mapping[str, Expr] = field(default_factory=dict, compare=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out `again` and `own_symbols`, whose symbols may not support pickling."""
        return {**self.__dict__, "again": None, "own_symbols": {}}

    @property
    def q(self) -> tuple[Symbol, ...]:
        """The coordinates' symbols, in scene order."""
        return tuple(c.q for c in self.coordinates)

    @property
    def qd(self) -> tuple[Symbol, ...]:
        """The velocities' symbols, in scene order."""
        return tuple(c.qd for c in self.coordinates)

    @property
    def qdd(self) -> tuple[Symbol, ...]:
        """The accelerations' symbols, in scene order."""
        return tuple(c.qdd for c in self.coordinates)

    @property
    def rates(self) -> dict[Symbol, Symbol]:
        """The velocities by coordinate, without discrete coordinates."""
        return {c.q: c.qd for c in self.coordinates if c.name not in self.discrete}

    @property
    def solved(self) -> tuple[tuple[tuple[int, float], ...], ...]:
        """The equations to solve with: sums of constraints, as (index, weight) pairs.

        Those of `closure.sums` come first; the others are single constraints.
        """
        sums = self.closure.sums if self.closure else ()
        mixed = {k for row in sums for k, w in enumerate(row) if w}
        own = (k for k, c in enumerate(self.constraints) if not c.redundant and k not in mixed)
        return (
            *(tuple((k, w) for k, w in enumerate(row) if w) for row in sums),
            *(((k, 1.0),) for k in own),
        )

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...]:
        """The indices of the constraints with a rotation error, for each loop that has some."""
        rows = [(k, c.loop) for k, c in enumerate(self.constraints) if c.rotation_error is not None]
        return tuple(tuple(k for k, _ in some) for _, some in groupby(rows, key=lambda row: row[1]))

    def problem(self, key: str, message: str, severity: str = "error") -> Problem:
        """Return a problem at a key such as `energy.kinetic`, with its line if there is a scene."""
        if self.place is None:
            message, key = in_words_of_python(message), argument_of(key)
            return Problem(message, key, f"System {self.name}", severity=severity)
        return self.place(key, message, severity=severity)

    def with_parameters(self, parameters: Mapping[str, float]) -> Self:
        """Return the system with other values for some of its parameters."""
        changed = tuple(replace(p, value=parameters.get(p.name, p.value)) for p in self.parameters)
        return replace(self, parameters=changed)

    @property
    def output_frames(self) -> tuple[Frame, ...]:
        """The frames whose poses, velocities and Jacobians are generated, in the order of [run]."""
        names, known = self.run.frames, {f.name: f for f in self.frames}
        return self.frames if names is True else tuple(known[name] for name in names or ())

    @property
    def own_events(self) -> tuple[Event, ...]:
        """The events of the scene, without the two transitions of each friction mode."""
        return self.events[: len(self.events) - 2 * len(self.modes)]

    @property
    def reads_qdd(self) -> bool:
        """Whether functions may read accelerations."""
        return bool(self.outputs or self.events or self.output_frames or self.run.inverse_dynamics)

    @property
    def names(self) -> frozenset[str]:
        """Names that no other value may have: coordinates, velocities, inputs, parameters, and
        accelerations if functions may read them.
        """
        variables = (*self.q, *self.qd, *self.u, *(self.qdd if self.reads_qdd else ()))
        return frozenset([*(x.name for x in variables), *(p.name for p in self.parameters)])

    @property
    def u(self) -> tuple[Symbol, ...]:
        """The inputs' symbols, in scene order."""
        return tuple(i.symbol for i in self.inputs)

    def beyond_float(self) -> list[Problem]:
        """Report numbers that are out of range in single precision."""
        if self.run.real != "float":
            return []
        faults = []
        if self.run.h < LEAST_FLOAT:
            why = f"is {self.run.h:g}, less than a float can be: take a larger step, or real double"
            faults.append(self.problem("run.h", why))
        numbers = [(f"parameters.{p.name}", sympy.Float(p.value)) for p in self.parameters]
        expressions: list[tuple[str, Expr]] = [
            *((f"definitions.{s}", e) for s, e in self.definitions),
            ("energy.kinetic", self.kinetic),
            ("energy.potential", self.potential),
            ("energy.potential", self.linear_potential),
            ("energy.dissipation", self.dissipation),
            *((f"forces.{c.name}", e) for c, e in zip(self.coordinates, self.forces, strict=True)),
            *((f"inputs.{i.name}.signal", i.signal) for i in self.inputs),
            *(
                (f"inputs.{i.name}.limits", e)
                for i in self.inputs
                for e in i.limits
                if e is not None
            ),
            *(("force", e) for pair in self.applied for e in pair),
            *((f"outputs.{o.name}", o.formula) for o in self.outputs),
            *(("event", x) for e in self.events for x in (e.when, *(f for _, f in e.jump))),
            *((f"constraints.{c.name}", c.formula) for c in self.constraints),
        ]
        numbers += [(key, n) for key, e in expressions for n in e.atoms(sympy.Number)]
        for key, n in numbers:
            if abs(n) > LARGEST_FLOAT:
                why = f"{float(n):g} is more than a float can be: use other units, or real double"
                faults.append(self.problem(key, why))
        return faults


# type of functions that return a changed system of the same class
AnySystem = TypeVar("AnySystem", bound=Mechanics)
