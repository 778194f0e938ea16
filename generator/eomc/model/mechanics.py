"""A mechanical system over symbols: coordinates, definitions, K, P, forces, constraints, events.

Independent of the source of the system, TOML or Python, and of the generated C.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from typing import Any, Self, TypeVar

import sympy
from sympy import Dummy, Expr, S, Symbol

from eomc.base.errors import Problem
from eomc.base.texts import listed, plural
from eomc.model.algebra import classes_of_shape
from eomc.model.symbols import (
    Constraint,
    Coordinate,
    Event,
    FrictionMode,
    Input,
    Output,
    Parameter,
    Reaction,
    dot,
    needed_definitions,
)
from eomc.model.tree import BodyFrame, Tree
from eomc.scene.scene import Scene
from eomc.scene.schema import RunSettings
from eomc.scene.toml_text import ArgumentMap


@dataclass(frozen=True)
class Move:
    """A coordinate or velocity whose initial value was changed to satisfy the constraints.

    guess: the initial value that the user gave. value: the value that satisfies the constraints.
    Both are in `unit`.
    """

    name: str
    guess: float
    value: float
    unit: str = ""

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name} = {self.value:.6g}{unit} (guess {self.guess:.6g})"


@dataclass(frozen=True)
class ConstraintSummary:
    """Properties of the constraints of a system, computed near its initial configuration.

    D is the mass matrix and A the Jacobian of the constraint equations, with one row A_r for each.

    Attributes
    ----------
    rows
        Names of the constraint equations.
    coordinates
        Number of coordinates.
    rank
        Rank of A almost everywhere on the constraint manifold.
    redundant
        Names of the equations that the others imply; they are not solved for.
    shared
        Names of the equations whose Lagrange multipliers are not unique.
    start_sigma, least_sigma
        Ratio s_rank / s_1 of the singular values s_1 >= s_2 >= ... of the scaled Jacobian.
        start_sigma is the ratio at the start, least_sigma the smallest ratio at the sampled
        configurations. The ratio is 0 at a singular configuration.
    positions
        Number of sampled configurations.
    weights
        If D is singular, weights with which D + sum_r weights[r] A_r^T A_r is regular; else empty.
    slopes
        Largest value of A_r D^-1 A_r^T for each equation among the sampled configurations.
    sums
        Weights of linear combinations of the equations that are solved for in place of `shared`;
        used if no subset of the equations is independent everywhere.
    moves, rate_moves
        Coordinates and velocities whose initial values were changed to satisfy the constraints.
    remarks
        Messages for the user.
    computed_from
        The data of the system from which the summary was computed; other data make it invalid.
    """

    rows: tuple[str, ...]
    coordinates: int
    rank: int
    redundant: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    start_sigma: float = 1.0
    least_sigma: float = 1.0
    positions: int = 1
    weights: tuple[float, ...] = ()
    slopes: tuple[float, ...] = ()
    sums: tuple[tuple[float, ...], ...] = ()
    moves: tuple[Move, ...] = ()
    rate_moves: tuple[Move, ...] = ()
    remarks: tuple[str, ...] = ()
    computed_from: tuple[Any, ...] = field(default=(), repr=False, compare=False)

    @property
    def freedoms(self) -> int:
        """The number of degrees of freedom: the number of coordinates minus the rank."""
        return self.coordinates - self.rank

    @property
    def ranks(self) -> str:
        """Text that states the rank, the redundant equations and the non-unique multipliers."""
        text = f"rank {self.rank} of {len(self.rows)}"
        if self.redundant:
            text += (
                f": {plural('equation', len(self.redundant))} {listed(self.redundant)} "
                f"{'is' if len(self.redundant) == 1 else 'are'} redundant"
            )
        if self.sums:
            text += "; the others are" if self.redundant else ":"
            text += f" solved as {len(self.sums)} linear {plural('combination', len(self.sums))}"
        if self.shared:
            start = "; the" if self.redundant or self.sums else ": the"
            text += f"{start} forces in {listed(self.shared)} are not unique"
        return text

    def table(self) -> str:
        """Return the summary as text of several lines for the terminal."""
        n = len(self.rows)
        lines = [
            f"{n} constraint {plural('equation', n)} on {self.coordinates} "
            f"{plural('coordinate', self.coordinates)}, {self.ranks}",
            f"  remaining: {self.freedoms} {plural('degree', self.freedoms)} of freedom",
            f"  sigma_min/sigma_max {self.start_sigma:.3g} at the start, "
            f"at least {self.least_sigma:.3g} at {self.positions} positions",
            *(f"  changed position: {move}" for move in self.moves),
            *(f"  changed velocity: {move}" for move in self.rate_moves),
            *(f"  - {remark}" for remark in self.remarks),
        ]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as a dict that can be written as JSON."""
        return {
            "rows": list(self.rows), "rank": self.rank, "freedoms": self.freedoms,
            "redundant": list(self.redundant), "not_unique": list(self.shared),
            "sigma_at_start": self.start_sigma, "sigma_least": self.least_sigma,
            "positions": self.positions, "start": [vars(m) for m in self.moves],
            "rates": [vars(m) for m in self.rate_moves], "remarks": list(self.remarks),
        }  # fmt: skip


LEAST_FLOAT, LARGEST_FLOAT = 2.0**-126, 2.0**128 - 2.0**104  # of C's float, in full precision


@dataclass(frozen=True)
class Mechanics:
    """A mechanical system in symbols: d/dt dL/dqd - dL/dq + dR/dqd = Q with L = K - P - a.qd.

    Expressions are SymPy's; `dot(e)` in them stands for de/dt.

    Attributes
    ----------
    coordinates
        Generalized coordinates q, with initial values; then discrete coordinates.
    kinetic, potential, dissipation
        Kinetic energy K, potential energy P and Rayleigh's dissipation function R.
    linear_potential
        The part a(q, t).qd of a generalized potential, which is not part of the energy
        (py).
    forces
        Generalized forces Q, one for each coordinate.
    applied
        Forces F at positions y, as pairs (y, F). Each adds F dy/dq to Q.
    definitions
        Pairs (symbol, expression); each expression may use t and the symbols before it.
    constraints
        Equations formula = 0, holonomic ones first. With their Jacobian A (with respect to q, or
        to qd if nonholonomic) and the multipliers lambda, A^T lambda is added to Q.
    reactions
        Forces and moments in loop joints.
    tree
        The bodies with joints; their energies are part of K and P.
    frames, plane
        Frames of bodies and points, and whether the scene is planar.
    run
        Settings of runs and generated code.
    digest
        Hash of the source of the system.
    renamed
        Names that C does not allow, as pairs (given name, name in the system).
    place
        Function that returns a Problem at a key of the scene.
    file
        Name of the scene file; "" for a system made in Python.
    scene
        The checked scene.
    closure
        Summary of the constraints, once the initial values are consistent with them.
    modes
        Stick-slip friction modes, which are the last coordinates.
    discrete
        Names of the discrete coordinates for variables that jumps set. They are placed before the
        modes; no derivative with respect to them is taken.
    again
        Function that makes the system again; keyword arguments replace arguments of `System.make`.
    own_symbols
        Symbols, functions of time and derivatives of these that the user passed to `System.make`,
        by their names in the system.
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
    frames: tuple[BodyFrame, ...] = ()
    plane: bool = False
    run: RunSettings = field(default_factory=RunSettings)
    title: str = ""
    note: str = ""
    file: str = ""
    digest: str = ""
    renamed: tuple[tuple[str, str], ...] = ()
    warnings: tuple[Problem, ...] = field(default=(), compare=False)
    place: Callable[..., Problem] | None = field(default=None, compare=False, repr=False)
    scene: Scene | None = field(default=None, compare=False, repr=False)
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
        """The symbols of the coordinates, in the order of `coordinates`."""
        return tuple(c.q for c in self.coordinates)

    @property
    def qd(self) -> tuple[Symbol, ...]:
        """The symbols of the velocities, in the order of `coordinates`."""
        return tuple(c.qd for c in self.coordinates)

    @property
    def qdd(self) -> tuple[Symbol, ...]:
        """The symbols of the accelerations, in the order of `coordinates`."""
        return tuple(c.qdd for c in self.coordinates)

    @property
    def rates(self) -> dict[Symbol, Symbol]:
        """A dict from the symbol of each coordinate to that of its velocity.

        Discrete coordinates for parameters that events change (see `discrete`) are left out.
        """
        return {c.q: c.qd for c in self.coordinates if c.name not in self.discrete}

    @property
    def solved(self) -> tuple[tuple[tuple[int, float], ...], ...]:
        """The independent constraint equations, as weighted sums of `constraints`.

        The Lagrange multipliers of these equations are computed. Each equation is a tuple of pairs
        (index of the constraint, weight). The sums of `closure.sums` come first, then the single
        constraints that are neither redundant nor part of a sum.
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
        """Indices of the constraints with a `rotation_error`, as one tuple for each loop."""
        rows = [(k, c.loop) for k, c in enumerate(self.constraints) if c.rotation_error is not None]
        return tuple(tuple(k for k, _ in some) for _, some in groupby(rows, key=lambda row: row[1]))

    def problem(self, key: str, message: str, severity: str = "error") -> Problem:
        """Return a Problem (error, warning or note) about one entry of the system.

        key: key of the entry in a scene, such as "energy.kinetic". severity: "error", "warning" or
        "note". The result contains file and line if the system was read from a scene.
        """
        if self.place is None:
            places = ArgumentMap(self.name)
            return places.problem(tuple(key.split(".")), message, severity=severity)
        return self.place(key, message, severity=severity)

    def with_parameters(self, parameters: Mapping[str, float]) -> Self:
        """Return a copy of the system with other values of some parameters.

        parameters: dict from the name of a parameter to its new value.
        """
        changed = tuple(replace(p, value=parameters.get(p.name, p.value)) for p in self.parameters)
        return replace(self, parameters=changed)

    @property
    def output_frames(self) -> tuple[BodyFrame, ...]:
        """The frames of bodies and points for which the C code computes poses and Jacobians.

        Their order is that of the setting `frames` in the table [run] of the scene.
        """
        names, known = self.run.frames, {f.name: f for f in self.frames}
        return self.frames if names is True else tuple(known[name] for name in names or ())

    @property
    def own_events(self) -> tuple[Event, ...]:
        """The events that the user defined, without the two transitions of each friction mode."""
        return self.events[: len(self.events) - 2 * len(self.modes)]

    @property
    def reads_qdd(self) -> bool:
        """Whether generated functions may read the accelerations.

        True for a system with outputs, events, frames in the C code or inverse dynamics.
        """
        return bool(self.outputs or self.events or self.output_frames or self.run.inverse_dynamics)

    @property
    def linearizes_stages(self) -> bool:
        """Whether derivatives of steps need accelerations and their derivatives at each stage."""
        return self.run.discretize and not self.constraints

    @property
    def names(self) -> frozenset[str]:
        """The names that are in use, so that no definition or output may have them.

        They are the names of coordinates, velocities, inputs and parameters, and of accelerations
        if `reads_qdd`.
        """
        variables = (*self.q, *self.qd, *self.u, *(self.qdd if self.reads_qdd else ()))
        return frozenset([*(x.name for x in variables), *(p.name for p in self.parameters)])

    @property
    def u(self) -> tuple[Symbol, ...]:
        """The symbols of the inputs, in the order of `inputs`."""
        return tuple(i.symbol for i in self.inputs)

    def beyond_float(self) -> list[Problem]:
        """Return a Problem for each number that is out of range in single precision.

        The list is empty unless the C code computes in single precision.
        """
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


# --- functions that are not smooth, and smooth ones that may be steep relative to a step ----------

KINDS = classes_of_shape("corner", "jump")
STEEP = classes_of_shape("corner", "jump", "steep")  # tanh acts as a jump if it is narrow


def nonsmooth_functions(system: Mechanics, kinds: tuple[Any, ...] = KINDS) -> str:
    """Return text that lists the non-smooth functions, such as abs, in a system's expressions.

    The names are separated by commas; the text is "" if there are none. kinds: SymPy classes of the
    functions to look for.
    """
    s = system
    exprs = (
        *(s.kinetic, s.potential, s.linear_potential, s.dissipation, *s.forces),
        *(e for x in s.applied for e in x),
        *(e for _, e in s.definitions),
        *(i.signal for i in s.inputs),
        *(c.formula for c in s.constraints if not c.switched),
    )
    names = {atom.func.__name__.lower() for e in exprs for atom in e.atoms(*kinds)}
    return ", ".join(sorted(names))


def has_steep_terms(system: Mechanics) -> bool:
    """Return True if the expressions of a system are non-smooth or may vary fast within one step.

    Functions that may vary fast are tanh, atan and erf of any argument, and functions of the
    velocities other than polynomials, sines and cosines, such as friction smoothed by
    v/sqrt(v**2 + w**2) or the Stribeck term exp(-v**2).
    """
    if nonsmooth_functions(system, STEEP):
        return True
    s, fast = system, set(system.qd)
    for name, e in s.definitions:
        if e.free_symbols & fast or e.has(dot):
            fast.add(name)
    exprs = (
        s.dissipation, *s.forces, *(f for _, f in s.applied), *(e for _, e in s.definitions),
        *(i.signal for i in s.inputs),
    )  # fmt: skip
    return any(
        (f.free_symbols & fast or f.has(dot)) and not _is_gentle(f)
        for e in exprs
        for f in e.atoms(sympy.Function, sympy.Pow)
    )


def _is_gentle(f: sympy.Expr) -> bool:
    natural_power = f.is_Pow and f.exp.is_Integer and f.exp > 0
    return bool(natural_power or isinstance(f, (dot, sympy.sin, sympy.cos)))


# --- generalized potentials -----------------------------------------------------------------------

# U(q, qd, t) = P(q, t) + a(q, t).qd, such as that of a magnetic field. The generalized force is
# Q = d/dt dU/dqd - dU/dq (Goldstein, Poole & Safko, *Classical Mechanics*, sec. 1.5), so that
# L = K - U. The linear part does no work: where K is quadratic in the velocities,
# qd.dL/dqd - L = K + P, without a.qd.

NOT_LINEAR = (
    "the potential energy can contain velocities in linear terms only, such as those of a magnetic "
    "field: inertia belongs in 'kinetic', friction in 'dissipation'"
)


class NotLinearError(ValueError):
    """Error for a potential energy that is nonlinear in the velocities."""


def split_potential(
    potential: Expr, definitions: Sequence[tuple[Symbol, Expr]], velocities: Iterable[Symbol]
) -> tuple[Expr, Expr]:
    """Split a generalized potential U = P(q, t) + a(q, t).qd and return the pair (P, a.qd).

    A time derivative dot(y) in U counts as a velocity and is not expanded. A term with dot(y)
    therefore belongs to a.qd even if y depends on t explicitly. Symbols whose definitions contain
    velocities are replaced by their expressions.

    Parameters
    ----------
    potential
        The generalized potential U.
    definitions
        Pairs (symbol, expression), each expression over the symbols before it.
    velocities
        Symbols of the generalized velocities.

    Raises
    ------
    NotLinearError
        If U is nonlinear in the velocities.
    """
    moving = {*velocities}
    for name, e in definitions:
        if e.free_symbols & moving or e.has(dot):
            moving.add(name)

    def moves(e: Expr) -> bool:
        return bool(e.free_symbols & moving or e.has(dot))

    terms = sympy.Add.make_args(potential)
    conservative = sympy.Add(*(e for e in terms if not moves(e)))
    rest = sympy.Add(*filter(moves, terms))
    if rest == 0:
        return potential, S.Zero
    known: dict[Expr, Expr] = {}
    for name, e in needed_definitions(definitions, [rest]):
        if name in moving:
            known[name] = e.xreplace(known)
    rest = rest.xreplace(known)
    rates = sorted(rest.atoms(dot), key=str)
    outer = [e for e in rates if not any(other != e and other.has(e) for other in rates)]
    stand_ins: dict[Expr, Expr] = {e: Dummy(real=True) for e in outer}
    rest = rest.xreplace(stand_ins)
    variables = [*(rest.free_symbols & {*velocities}), *stand_ins.values()]
    variables.sort(key=str)
    at_rest = dict.fromkeys(variables, S.Zero)
    slopes = [_eliminate_variables(sympy.diff(rest, x), variables) for x in variables]
    linear = sympy.Add(*(a * x for a, x in zip(slopes, variables, strict=True)))
    back = {dummy: e for e, dummy in stand_ins.items()}
    return conservative + rest.xreplace(at_rest), linear.xreplace(back)


def _eliminate_variables(slope: Expr, variables: Sequence[Expr]) -> Expr:
    """Return a derivative in a form without the variables. Raises NotLinearError if impossible."""
    for attempt in (lambda e: e, sympy.expand, sympy.simplify):
        slope = attempt(slope)
        if not slope.has(*variables):
            return slope
    raise NotLinearError(NOT_LINEAR)
