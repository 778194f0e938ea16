"""A mechanical system in SymPy: symbols, ordered definitions, K, P, dissipation and forces.

Made from a checked scene (`from_scene`) or in Python (`System.make`), with symbols or with
`sympy.physics.mechanics.dynamicsymbols`. Knows nothing of TOML or C.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef

from eomc.base import names
from eomc.base.errors import EomcError, Problem, SceneError
from eomc.model import given, growth
from eomc.model.multibody import Builder, Terms, Tree
from eomc.model.symbols import dot, symbol, t
from eomc.scene import formulas
from eomc.scene.formulas import FormulaError
from eomc.scene.scene import Run, Scene

__all__ = ["Coordinate", "Input", "Parameter", "System", "dot", "from_scene", "symbol", "t"]


@dataclass(frozen=True)
class Coordinate:
    """A generalized coordinate `q` and its velocity `qd`; `start` in `unit`, `rate` in unit/s."""

    name: str
    unit: str = ""
    start: float = 0.0
    rate: float = 0.0
    note: str = ""

    @property
    def q(self) -> Symbol:
        """The coordinate's symbol."""
        return symbol(self.name)

    @property
    def qd(self) -> Symbol:
        """The velocity's symbol, `<name>_dot`."""
        return symbol(f"{self.name}_dot")


@dataclass(frozen=True)
class Parameter:
    """A number that may change at run time."""

    name: str
    value: float
    unit: str = ""
    note: str = ""

    @property
    def symbol(self) -> Symbol:
        """The parameter's symbol."""
        return symbol(self.name)


@dataclass(frozen=True)
class Input:
    """A quantity given from outside at every step; `signal` is its value by default."""

    name: str
    unit: str = ""
    signal: Expr = sympy.S.Zero
    note: str = ""

    @property
    def symbol(self) -> Symbol:
        """The input's symbol."""
        return symbol(self.name)


@dataclass(frozen=True)
class System:
    """d/dt dK/dqd - dK/dq + dP/dq + dR/dqd = Q, over named definitions.

    `definitions` are (symbol, expression) pairs, each over the symbols before it, t included;
    `dot(e)` stands for de/dt. `forces` holds Q, one expression a coordinate. `tree`: the bodies
    that hang on joints, whose energies are part of K and P. `digest` names what the system was
    made from; `renamed` says which names C could not bear: (given, used) pairs. `scene`: what it
    was read from, where it was.
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    kinetic: Expr
    potential: Expr = sympy.S.Zero
    dissipation: Expr = sympy.S.Zero
    forces: tuple[Expr, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    inputs: tuple[Input, ...] = ()
    definitions: tuple[tuple[Symbol, Expr], ...] = ()
    tree: Tree | None = None
    run: Run = field(default_factory=Run)
    title: str = ""
    note: str = ""
    file: str = ""
    digest: str = ""
    renamed: tuple[tuple[str, str], ...] = ()
    warnings: tuple[Problem, ...] = field(default=(), compare=False)
    place: Callable[..., Problem] | None = field(default=None, compare=False, repr=False)
    scene: Scene | None = field(default=None, compare=False, repr=False)

    @property
    def q(self) -> tuple[Symbol, ...]:
        """The coordinates' symbols, in scene order."""
        return tuple(c.q for c in self.coordinates)

    @property
    def qd(self) -> tuple[Symbol, ...]:
        """The velocities' symbols, in scene order."""
        return tuple(c.qd for c in self.coordinates)

    def problem(self, key: str, message: str, severity: str = "error") -> Problem:
        """A problem at a key such as `energy.kinetic`, with its line where there is a scene."""
        if self.place is None:
            return Problem(message, key, f"System {self.name}", severity=severity)
        return self.place(key, message, severity=severity)

    def at(self, parameters: Mapping[str, float]) -> System:
        """The system with other values for some of its parameters."""
        changed = tuple(replace(p, value=parameters.get(p.name, p.value)) for p in self.parameters)
        return replace(self, parameters=changed)

    @property
    def u(self) -> tuple[Symbol, ...]:
        """The inputs' symbols, in scene order."""
        return tuple(i.symbol for i in self.inputs)

    @classmethod
    def make(
        cls,
        name: str,
        coordinates: Sequence[Any] | Mapping[Any, float | tuple[float, float]],
        kinetic: Any,
        potential: Any = 0,
        *,
        parameters: Mapping[Any, float] | None = None,
        dissipation: Any = 0,
        forces: Mapping[Any, Any] | None = None,
        inputs: Mapping[Any, Any] | Sequence[Any] = (),
        definitions: Mapping[Any, Any] | None = None,
        units: Mapping[Any, str] | None = None,
        title: str = "",
        h: float = 0.001,
        duration: float = 10.0,
        methods: Sequence[str] = ("rk4",),
        real: str = "double",
        batch: bool = False,
        linearize: bool | str = False,
    ) -> System:
        r"""A system from SymPy expressions.

        coordinates: symbols or dynamicsymbols, or a mapping to their start (or (start, rate)).
        With plain symbols the velocity of `theta` is the symbol `theta_dot`; with dynamicsymbols
        it is `theta.diff()`. parameters, inputs (to their default signal) and definitions are
        mappings from symbols. Names that C can't bear (`\theta`, `lambda`) are replaced, and
        `renamed` says how. Raises EomcError where something is undeclared.

        >>> from sympy.physics.mechanics import dynamicsymbols
        >>> theta, (m, l, g) = dynamicsymbols("theta"), sympy.symbols("m l g")
        >>> System.make("pendulum", {theta: 0.5}, m*l**2*theta.diff()**2/2,
        ...             -m*g*l*sympy.cos(theta), parameters={m: 1, l: 1, g: 9.81}).qd
        (theta_dot,)
        """
        return _Maker(name).make(
            coordinates, kinetic, potential, parameters or {}, dissipation, forces or {},
            inputs, definitions or {}, units or {}, title,
            given.run(h, duration, methods, real, batch, linearize),
        )  # fmt: skip


# --- from a scene -------------------------------------------------------------------------------


def _number(text: str) -> Expr:
    return (
        sympy.Rational(text)
        if text[:2].lower() not in ("0x", "0o", "0b")
        else sympy.Integer(int(text, 0))
    )


_ALGEBRA: Mapping[str, Any] = {
    "number": _number,
    "pi": sympy.pi,
    **{n: getattr(sympy, n) for n in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")},
    **{n: getattr(sympy, n) for n in ("sinh", "cosh", "tanh", "exp", "log", "sqrt", "sign")},
    "abs": sympy.Abs,
    "heaviside": lambda x: sympy.Heaviside(x),
    "min": sympy.Min,
    "max": sympy.Max,
    "dot": dot,
}

_UNDEFINED = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)


def from_scene(scene: Scene) -> System:
    """The scene's formulas as SymPy expressions, constants folded in. Raises SceneError."""
    known: dict[str, Expr] = {"t": t}
    for c in scene.coordinates:
        known |= {c.name: symbol(c.name), f"{c.name}_dot": symbol(f"{c.name}_dot")}
    names_given = [*(p.name for p in scene.parameters), *(i.name for i in scene.inputs)]
    known |= {name: symbol(name) for name in names_given}
    problems: list[Problem] = []
    sizes: dict[str, growth.Size] = {}  # of constants and definitions

    def value(key: str, formula: formulas.Formula) -> Expr:
        name = key.partition(".")[2] if key.startswith(("constants.", "definitions.")) else ""
        try:
            sizes[name] = growth.VARIES
            sizes[name] = growth.size(formula, sizes)
            found = sympy.sympify(formulas.evaluate(formula, _ALGEBRA, known.__getitem__))
            if found.has(*_UNDEFINED):
                raise FormulaError("divides by zero")
            if found.has(sympy.I):
                raise FormulaError("has no real value")
        except (FormulaError, ArithmeticError, ValueError, TypeError) as fault:
            problems.append(scene.problem(key, f"'{formula.shown}' {fault}", formula))
            return sympy.S.Zero
        return found

    for constant in scene.constants:
        known[constant.name] = value(f"constants.{constant.name}", constant.formula)
    declared = [*known, *(name for name, _ in scene.definitions)]
    assembly = getattr(scene, "assembly", None)
    builder = Builder(assembly, value, declared) if assembly else None
    definitions = []
    if builder:
        builder.build_tree()
        definitions += builder.terms.definitions
        known |= {name.name: name for name, _ in definitions}
    for name, formula in scene.definitions:
        definitions.append((symbol(name), value(f"definitions.{name}", formula)))
        known[name] = symbol(name)
    if builder:
        builder.build_rest()
        builder.add_forces()
        definitions += builder.terms.later
    more = builder.terms if builder else Terms()
    kinetic = value("energy.kinetic", scene.kinetic)
    potential = value("energy.potential", scene.potential)
    start, rate = scene.start()
    system = System(
        name=scene.name,
        coordinates=tuple(
            Coordinate(c.name, c.unit, q, qd, c.note)
            for c, q, qd in zip(scene.coordinates, start, rate, strict=True)
        ),
        kinetic=sympy.Add(kinetic, more.kinetic, *more.tree_kinetic),
        potential=sympy.Add(potential, more.potential, *more.tree_potential),
        dissipation=value("energy.dissipation", scene.dissipation) + more.dissipation,
        forces=tuple(
            more.forces.get(c.name, sympy.S.Zero)
            + (
                value(f"forces.{c.name}", scene.forces[c.name])
                if c.name in scene.forces
                else sympy.S.Zero
            )
            for c in scene.coordinates
        ),
        tree=more.tree(kinetic, potential),
        parameters=tuple(Parameter(p.name, p.value, p.unit, p.note) for p in scene.parameters),
        inputs=tuple(
            Input(i.name, i.unit, value(f"inputs.{i.name}.signal", i.signal), i.note)
            for i in scene.inputs
        ),
        definitions=tuple(definitions),
        run=scene.run,
        title=scene.title,
        note=scene.note,
        file=scene.file,
        digest=scene.digest,
        warnings=(*scene.warnings, *_at_the_start(scene)),
        place=scene.problem,
        scene=scene,
    )
    if problems:
        raise SceneError(problems)
    return system


def _at_the_start(scene: Scene) -> list[Problem]:
    """Warnings of springs and dampers that have no direction there."""
    assembly = getattr(scene, "assembly", None)
    if not assembly or not any(line.points for line in (*assembly.springs, *assembly.dampers)):
        return []
    from eomc.model import mobility  # and with it NumPy, which few scenes need here

    return mobility.meeting(scene)


# --- from Python --------------------------------------------------------------------------------


class _Maker:
    """Turns a user's symbols, of whatever assumptions and spelling, into ours."""

    def __init__(self, name: str) -> None:
        if not isinstance(name, str):
            raise given.fault("name", f"must be text, here {name!r}")
        if why := names.module_fault(name):
            raise EomcError(f"System.make: name: {why}")
        self.name = name
        self.map: dict[Any, Expr] = {}
        self.taken: dict[str, Any] = {}
        self.renamed: list[tuple[str, str]] = []

    def name_of(self, one: Any, role: str) -> str:
        if not given.is_symbol(one):
            raise given.fault(role, f"{one!r} is not a symbol")
        text = one.func.__name__ if isinstance(one, AppliedUndef) else str(one)
        used = names.plain(text) if names.fault(text) else text
        if used in self.taken:
            raise EomcError(f"System.make: {role} '{text}': the name '{used}' is taken already")
        if used != text:
            self.renamed.append((text, used))
        self.taken[used] = one
        return used

    def expression(self, value: Any, role: str) -> Expr:
        expr = given.expression(value, role)
        expr = expr.replace(
            lambda e: isinstance(e, sympy.Derivative), lambda e: self.map.get(e, e)
        ).xreplace(self.map)
        strange = sorted(
            map(str, expr.atoms(AppliedUndef, sympy.Derivative) - expr.atoms(dot))
            if expr.has(AppliedUndef, sympy.Derivative)
            else []
        ) + sorted(s.name for s in expr.free_symbols if s not in self.known)
        if any(
            isinstance(d, sympy.Derivative) and d.derivative_count > 1
            for d in expr.atoms(sympy.Derivative)
        ):
            raise given.fault(role, "accelerations are what is solved for, none can be used")
        if strange == ["t"]:
            raise given.fault(
                role,
                "this t is not the time: write eomc.model.system.t, or "
                "dynamicsymbols._t where coordinates are dynamicsymbols",
            )
        if strange:
            raise EomcError(
                f"System.make: {role}: {', '.join(strange)} not declared: "
                "name it among coordinates, parameters, inputs or definitions"
            )
        if expr.has(*_UNDEFINED, sympy.I):
            raise EomcError(f"System.make: {role}: {expr} is not a real, finite expression")
        given.check_functions(expr, role)
        return expr

    def make(
        self, coordinates: Any, kinetic: Any, potential: Any, parameters: Mapping[Any, float],
        dissipation: Any, forces: Mapping[Any, Any], inputs: Any, definitions: Mapping[Any, Any],
        units: Mapping[Any, str], title: str, run: Run,
    ) -> System:  # fmt: skip
        starts = given.symbols(coordinates, "coordinates", 0.0)
        parameters = given.mapping(parameters, "parameters", "{m: 2.0}")
        forces = given.mapping(forces, "forces", "{x: F}")
        definitions = given.mapping(definitions, "definitions", "{y: l*cos(theta)}")
        units = given.mapping(units, "units", '{m: "kg"}')
        for text in (title, *units.values()):
            if not isinstance(text, str):
                raise EomcError(f"System.make: a title or unit is a text, not {text!r}")
        if not starts:
            raise EomcError("System.make: give at least one coordinate")
        made = []
        for one, start in starts.items():
            name = self.name_of(one, "coordinate")
            c = Coordinate(name, units.get(one, ""), *given.start(start, f"start of {name}"))
            self.map[one] = c.q
            if isinstance(one, AppliedUndef):
                time = one.args[0]
                self.map[sympy.Derivative(one, time)] = c.qd
                self.map[time] = t
            else:
                self.map[Symbol(f"{one}_dot", **one.assumptions0)] = c.qd
            made.append(c)
        declared = [
            Parameter(
                self.declare(p, "parameter"), given.number(v, f"parameter {p}"), units.get(p, "")
            )
            for p, v in parameters.items()
        ]
        pending = given.symbols(inputs, "inputs", 0)
        given_inputs = [(i, self.declare(i, "input")) for i in pending]
        self.known = {c.q for c in made} | {c.qd for c in made} | {t}
        self.known |= {symbol(n) for n in self.taken}
        ordered = []
        for one, body in definitions.items():
            expr = self.expression(body, f"definition {one}")
            defined = symbol(self.declare(one, "definition"))
            self.known.add(defined)
            ordered.append((defined, expr))
        unknown = [str(f) for f in forces if f not in starts]
        if unknown:
            raise EomcError(f"System.make: forces: {', '.join(unknown)} not among the coordinates")
        expression = self.expression
        made_of: dict[str, Any] = {
            "name": self.name,
            "coordinates": tuple(made),
            "kinetic": expression(kinetic, "kinetic"),
            "potential": expression(potential, "potential"),
            "dissipation": expression(dissipation, "dissipation"),
            "forces": tuple(expression(forces.get(c, 0), f"force on {c}") for c in starts),
            "parameters": tuple(declared),
            "inputs": tuple(
                Input(used, units.get(one, ""), expression(pending[one], f"signal of {one}"))
                for one, used in given_inputs
            ),
            "definitions": tuple(ordered),
            "run": run,
            "title": title or self.name.replace("_", " ").capitalize(),
        }
        digest = hashlib.sha256(sympy.srepr(sorted(made_of.items())).encode()).hexdigest()
        return System(**made_of, digest=digest, renamed=tuple(self.renamed))

    def declare(self, one: Any, role: str) -> str:
        used = self.name_of(one, role)
        self.map[one] = symbol(used)
        return used
