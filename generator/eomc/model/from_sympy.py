"""Conversion of a user's symbols and expressions, whatever their assumptions, for System.make.

SymPy functions that formulas of scenes do not have are rewritten exactly. A picture becomes the
table [picture] of a scene with the names of the system and the picture only, and its expressions
become formulas.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef
from sympy.core.relational import GreaterThan, LessThan, StrictGreaterThan, StrictLessThan
from sympy.printing.str import StrPrinter

from eomc.base import names
from eomc.base.errors import EomcError, Problem, SceneError
from eomc.model import api_arguments, constraints
from eomc.model.algebra import UNDEFINED
from eomc.model.api_arguments import argument_error, name_of, undeclared_error
from eomc.model.generalized_potential import NotLinearError, split_potential
from eomc.model.hybrid import Friction
from eomc.model.mechanics import AnySystem
from eomc.model.symbols import (
    Constraint,
    Coordinate,
    Event,
    Input,
    Output,
    Parameter,
    dot,
    multiplier_of,
    needed_definitions,
    symbol,
    t,
)
from eomc.scene import read
from eomc.scene.messages import is_in_degrees
from eomc.scene.scene import RunSettings, Scene
from eomc.scene.schema import ACTIONS, DIRECTIONS

_OF_NUMBERS = (
    "a parameter's value is made of numbers; what depends on other parameters is a definition"
)
Ends = tuple[Expr | None, ...]  # the least and the largest value of an input


def _first_input(
    expr: Expr, definitions: Sequence[tuple[Symbol, Expr]], inputs: Iterable[str]
) -> str:
    """Return the first input by name on which an expression depends, also by definitions, or ""."""
    uses = expr.free_symbols.union(
        *(e.free_symbols for _, e in needed_definitions(definitions, [expr]))
    )
    return min((i for i in inputs if symbol(i) in uses), default="")


@dataclass(frozen=True, kw_only=True)
class SystemArguments:
    """The arguments of System.make as a user gave them; they are explained there.

    Arguments that were not given have their defaults, {} in place of None. They are not checked,
    except for `run`, the settings of simulations and of the generated code.
    """

    name: str
    coordinates: Any
    kinetic: Any
    potential: Any
    dissipation: Any
    parameters: Any
    forces: Any
    inputs: Any
    definitions: Any
    outputs: Any
    constraints: Any
    guess: Any
    limits: Any
    events: Any
    friction: Any
    picture: Any
    units: Any
    title: str
    run: RunSettings


class Maker:
    """Converter of the arguments of System.make to a system with symbols of its own.

    The user's symbols may have any assumptions and names. Symbols of the system, which replace
    them, are real and have names that are valid in C. arguments: the arguments of System.make.
    """

    def __init__(self, arguments: SystemArguments) -> None:
        name = arguments.name
        if not isinstance(name, str):
            raise argument_error("name", f"must be text, here {name!r}")
        if why := names.module_fault(name):
            raise EomcError(f"System.make: name: {why}")
        self.name = name
        self.arguments = arguments
        self.map: dict[Any, Expr] = {}
        self.used: dict[str, Expr] = {}  # symbols of the user's expressions, by their names
        self.taken: dict[str, Any] = {}
        self.renamed: list[tuple[str, str]] = []
        self.fixed: dict[Symbol, bool] = {}  # parameters, and whether they are never negative
        self.frictions: list[Friction] = []  # that stick

    def _name_of(self, one: Any, role: str) -> str:
        if not isinstance(one, (Symbol, AppliedUndef)):
            raise argument_error(role, f"{one!r} is not a symbol")
        text = name_of(one)
        used = names.plain(text) if names.fault(text) else text
        if used in self.taken:
            raise EomcError(f"System.make: {role} '{text}': the name '{used}' is taken already")
        if used != text:
            self.renamed.append((text, used))
        self.taken[used] = one
        return used

    def _expression(self, value: Any, role: str, rule: str = "") -> Expr:
        if isinstance(value, str):
            known = {s.name: s for s in self.known}
            value = api_arguments.parse_formula(value, role, known, rule)
        expr = api_arguments.expression(value, role)
        if not isinstance(value, str):
            self.used |= {s.name: s for s in expr.free_symbols}
        expr = expr.replace(
            lambda e: isinstance(e, sympy.Derivative),
            lambda e: e if isinstance(e.expr, AppliedUndef) else e.doit(),
        )
        expr = expr.replace(
            lambda e: isinstance(e, sympy.Derivative), lambda e: self.map.get(e, e)
        ).xreplace(self.map)
        functions = expr.atoms(AppliedUndef, sympy.Derivative) - expr.atoms(dot)
        strange = sorted(map(str, functions))
        strange += sorted(s.name for s in expr.free_symbols if s not in self.known)
        if any(d.derivative_count > 1 for d in expr.atoms(sympy.Derivative)):
            raise argument_error(role, "accelerations are what is solved for, none can be used")
        if strange == ["t"] and not rule:
            raise argument_error(
                role,
                "this t is not the time: write eomc.model.system.t, or "
                "dynamicsymbols._t where coordinates are dynamicsymbols",
            )
        if strange:
            raise undeclared_error(role, strange, (s.name for s in self.known), rule)
        try:
            expr = rewrite_functions(expr, self.fixed)
        except JumpError as jump:
            raise argument_error(role, str(jump)) from None
        if expr.has(*UNDEFINED, sympy.I):
            raise EomcError(f"System.make: {role}: {expr} is not a real, finite expression")
        api_arguments.check_functions(expr, role)
        return expr

    def _parameter(self, one: Any, value_: Any, units: Mapping[str, str]) -> Parameter:
        value = api_arguments.number(value_, f"parameter {one}", _OF_NUMBERS)
        never_negative = getattr(one, "is_nonnegative", None) is True
        if never_negative and value < 0:
            raise argument_error(
                f"parameter {one}", f"its symbol can't be negative, here {value:g}"
            )
        unit = units.get(name_of(one), "")
        declared = Parameter(self._declare(one, "parameter"), value, unit)
        self.fixed[declared.symbol] = never_negative
        return declared

    def make(self, of: type[AnySystem]) -> AnySystem:
        """Make a mechanical system from the arguments and return it.

        of: class of the result, such as System. Raises EomcError for invalid arguments.
        """
        arguments = self.arguments
        starts = api_arguments.symbols(arguments.coordinates, "coordinates", None)
        parameters = api_arguments.by_symbol(arguments.parameters, "parameters", "{m: 2.0}")
        forces = api_arguments.by_name(arguments.forces, "forces", "{x: F}")
        definitions = api_arguments.by_symbol(
            arguments.definitions, "definitions", "{y: l*cos(theta)}"
        )
        units = self._units()
        if not starts:
            raise EomcError("System.make: give at least one coordinate")
        coordinates = [self._coordinate(one, units) for one in starts]
        declared = [self._parameter(p, v, units) for p, v in parameters.items()]
        coordinates = [*self._with_initial_values(coordinates, starts.values(), declared)]
        coordinates = self._mark_fixed(coordinates, [*starts])
        pending = api_arguments.symbols(arguments.inputs, "inputs", 0)
        named = map(name_of, (*starts, *parameters, *pending, *definitions))
        outputs = [*map(str, arguments.outputs)]
        api_arguments.check_units(
            units, [*named, *map(str, arguments.constraints), *outputs], outputs
        )
        input_names = {i: self._declare(i, "input") for i in pending}
        ends = self._limits(pending, declared)
        self.known = {c.q for c in coordinates} | {c.qd for c in coordinates} | {t}
        self.known |= {symbol(n) for n in self.taken}
        ordered = []
        for one, body in definitions.items():
            expr = self._expression(body, f"definition {one}")
            defined = symbol(self._declare(one, "definition"))
            self.known.add(defined)
            ordered.append((defined, expr))
        if unknown := [f for f in forces if f not in map(name_of, starts)]:
            raise EomcError(f"System.make: forces: {', '.join(unknown)} not among the coordinates")
        rubbed = api_arguments.by_name(arguments.friction, "friction", "{x: mu*m*g}")
        sticks = [f"{self.map[x].name}_sticks" for x in starts if name_of(x) in rubbed]
        used_inputs = input_names.values()
        drawn, drawn_text = None, ""
        if arguments.picture is not None:
            drawn, drawn_text = picture_scene(
                arguments.picture, self._expression, coordinates, declared, used_inputs, ordered
            )
        energies = self._energies(ordered, [c.qd for c in coordinates], used_inputs)
        fields: dict[str, Any] = {
            "name": self.name,
            "coordinates": tuple(coordinates),
            **energies,
            "forces": tuple(
                self._expression(forces.get(name_of(c), 0), f"force on {c}") for c in starts
            ),
            "parameters": tuple(declared),
            "inputs": tuple(self._inputs(pending, input_names, units, ends, ordered)),
            "definitions": tuple(ordered),
            **self._constraints(coordinates, ordered, used_inputs, units),
            "events": tuple(self._events(starts, declared)),
            "outputs": tuple(
                self._outputs(
                    starts, coordinates, units, [*map(str, arguments.constraints), *sticks]
                )
            ),
            "run": arguments.run,
            "title": arguments.title or self.name.replace("_", " ").capitalize(),
        }
        self.frictions = list(self._frictions(starts, declared))
        whole = sympy.srepr(sorted(fields.items())) + drawn_text + str(self.frictions or "")
        return of(
            **fields,
            digest=hashlib.sha256(whole.encode()).hexdigest(),
            renamed=tuple(self.renamed),
            picture_scene=drawn,
            own_symbols=self._own_symbols(starts),
        )

    def _units(self) -> dict[str, str]:
        """Return the units by name."""
        units = api_arguments.by_name(self.arguments.units, "units", '{m: "kg"}')
        for text in (self.arguments.title, *units.values()):
            if not isinstance(text, str):
                raise EomcError(f"System.make: a title or unit is a text, not {text!r}")
        return units

    def _energies(
        self, definitions: Sequence[tuple[Symbol, Expr]], velocities: Sequence[Symbol],
        inputs: Iterable[str],
    ) -> dict[str, Expr]:  # fmt: skip
        """Return the energies by field name, the potential split into its parts."""
        expressions = {
            role: self._expression(getattr(self.arguments, role), role)
            for role in ("kinetic", "potential", "dissipation")
        }
        for role, energy in expressions.items():
            if used_input := _first_input(energy, definitions, inputs):
                why = f"{used_input} is an input, and an energy can't depend on inputs"
                raise argument_error(role, f"{why}: let it act through forces")
            what = f"the {role} energy"
            api_arguments.check_smooth(energy, role, dict(definitions), self.fixed.keys(), what)
        try:
            expressions["potential"], linear = split_potential(
                expressions["potential"], definitions, velocities
            )
        except NotLinearError as why:
            raise argument_error("potential", str(why)) from None
        return expressions if linear == 0 else {**expressions, "linear_potential": linear}

    def _coordinate(self, one: Any, units: Mapping[Any, str]) -> Coordinate:
        """Return a coordinate and declare its symbols."""
        name = self._name_of(one, "coordinate")
        c = Coordinate(name, units.get(name_of(one), ""))
        self.map[one] = c.q
        if isinstance(one, AppliedUndef):
            time = one.args[0]
            self.map[sympy.Derivative(one, time)] = c.qd
            self.map[time] = t
        else:
            self.map[Symbol(f"{one}_dot", **one.assumptions0)] = c.qd
            if one == symbol(one.name):
                self.map[Symbol(one.name)], self.map[Symbol(f"{one}_dot")] = c.q, c.qd
        return c

    def _with_initial_values(
        self,
        coordinates: Iterable[Coordinate],
        starts: Iterable[Any],
        parameters: Iterable[Parameter],
    ) -> Iterator[Coordinate]:
        """Yield the coordinates with initial values, over parameters; given values are fixed."""
        values = {p.symbol: p.value for p in parameters}
        self.known = {*values}
        rule = "a start is made of numbers and parameters"
        for c, whole in zip(coordinates, starts, strict=True):
            role, ends = f"start of {c.name}", []
            for x in api_arguments.initial_values(whole, role):
                follows = ""
                if isinstance(x, (str, Expr)):
                    x = self._expression(x, role, rule)
                    if x.has(dot):
                        raise undeclared_error(role, ["dot(...)"], (), rule)
                    if x.free_symbols:
                        follows = formula_text(x)
                        api_arguments.parse_formula(
                            follows, role, {s.name: s for s in values}, rule
                        )
                    x = x.xreplace(values)
                ends.append((None if x is None else api_arguments.number(x, role), follows))
            (start, follows), (rate, rate_follows) = ends
            yield replace(
                c, start=start or 0.0, rate=rate or 0.0, start_fixed=start is not None,
                rate_fixed=rate is not None, follows=follows, rate_follows=rate_follows,
            )  # fmt: skip

    def _mark_fixed(
        self, coordinates: Sequence[Coordinate], keys: Sequence[Any]
    ) -> list[Coordinate]:
        """Return the coordinates with initial values marked as fixed or as guesses."""
        guess, rows = self.arguments.guess, bool(self.arguments.constraints)
        if isinstance(guess, str) or not isinstance(guess, (list, tuple, set, frozenset)):
            raise argument_error(
                "guess", f"give a list of coordinates, such as [x], here {guess!r}"
            )
        guessed = {name_of(api_arguments.symbol_of(one, "guess")) for one in guess}
        if unknown := sorted(guessed - {name_of(one) for one in keys}):
            raise argument_error("guess", f"{', '.join(unknown)} not among the coordinates")
        if guessed and not rows:
            raise argument_error(
                "guess", "constraints move a guess, and there are none: leave it out"
            )
        free = [name_of(one) in guessed for one in keys]
        return [
            replace(
                c,
                start_fixed=not rows or (c.start_fixed and not moves),
                rate_fixed=not rows or (c.rate_fixed and not moves),
            )
            for c, moves in zip(coordinates, free, strict=True)
        ]

    def _constraints(
        self, coordinates: Sequence[Coordinate], ordered: Sequence[tuple[Symbol, Expr]],
        inputs: Iterable[str], units: Mapping[Any, str],
    ) -> dict[str, Any]:  # fmt: skip
        """Return the constraints and their warnings by field name; empty without constraints."""
        rows = self.arguments.constraints
        if not isinstance(rows, Mapping):
            example = '{"rod": x**2 + y**2 - l**2}'
            raise argument_error("constraints", f"give a dict, such as {example}, here {rows!r}")
        declared = []
        moving = (s.name for c in coordinates for s in (c.qd, c.qdd))
        taken = {*self.taken, *moving, "energy"}
        for one, formula in rows.items():
            name, role = api_arguments.valid_name(one, "constraints"), f"constraint {one}"
            if name in taken:
                raise EomcError(f"System.make: {role}: the name '{name}' is taken already")
            expr = self._expression(formula, role)
            api_arguments.check_smooth(expr, role, dict(ordered), self.fixed.keys(), "it")
            if used_input := _first_input(expr, ordered, inputs):
                why = (
                    f"{used_input} is an input, whose rate is not known: let it act through forces"
                )
                raise argument_error(role, why)
            declared.append(Constraint(name, expr, unit=units.get(name, "")))

        def fault(row: Constraint, message: str) -> None:
            raise argument_error(f"constraint {row.name}", f"{row.formula} {message}")

        doubts: list[Problem] = []

        def doubt(row: Constraint, message: str) -> None:
            message = f"{row.formula} {message}"
            doubts.append(
                Problem(
                    message, f"constraints.{row.name}", f"System {self.name}", severity="warning"
                )
            )

        checked = constraints.ConstraintChecker(coordinates, ordered, {}, fault, doubt).classify(
            declared
        )
        return {"constraints": checked, "warnings": tuple(doubts)} if declared else {}

    def _inputs(
        self, signals: Mapping[Any, Any], used: Mapping[Any, str], units: Mapping[Any, str],
        limits: Mapping[str, Ends], definitions: Sequence[tuple[Symbol, Expr]],
    ) -> Iterator[Input]:  # fmt: skip
        """Yield the inputs, with their names in the system."""
        for one, signal in signals.items():
            name, role = name_of(one), f"signal of {one}"
            value = self._expression(signal, role)
            if used_input := _first_input(value, definitions, used.values()):
                raise argument_error(
                    role, f"{used_input} is an input, and a signal can't depend on inputs"
                )
            ends = limits.get(name, (None, None))
            yield Input(used[one], units.get(name, ""), value, limits=ends)

    def _limits(self, inputs: Iterable[Any], parameters: Iterable[Parameter]) -> dict[str, Ends]:
        """Return the limits of inputs by name, over parameters."""
        values = {p.symbol: p.value for p in parameters}
        self.known = {*values}
        known, checked = {name_of(i) for i in inputs}, dict[str, Ends]()
        rule = "limits are made of numbers and parameters"
        limits = api_arguments.by_name(self.arguments.limits, "limits", "{F: (-1, 1)}")
        for name, pair in limits.items():
            role = f"limits of {name}"
            if name not in known:
                raise argument_error(role, f"inputs are {', '.join(sorted(known)) or 'none'}")
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                raise argument_error(role, f"give the least and the largest value, here {pair!r}")
            ends = zip(pair, (-sympy.oo, sympy.oo), strict=True)
            least, most = (
                None if x is None or x == end else self._expression(x, role, rule)
                for x, end in ends
            )
            if least is not None and most is not None and (most - least).xreplace(values) <= 0:
                raise argument_error(role, f"{least}, the least value, is not below {most}")
            checked[name] = (least, most)
        return checked

    def _events(self, starts: Iterable[Any], parameters: Iterable[Parameter]) -> Iterator[Event]:
        """Yield the events; each is given as a formula or a dict as in [[event]]."""
        events = self.arguments.events
        if not isinstance(events, Mapping):
            raise argument_error("events", f'give a dict, such as {{"impact": y}}, here {events!r}')
        state: dict[str, str] = {}  # names in the system, by names that the user may write
        for one in starts:
            name = self.map[one].name
            rate = one.diff() if isinstance(one, AppliedUndef) else f"{one}_dot"
            state |= {str(one): name, name_of(one): name}
            state |= {str(rate): f"{name}_dot", f"{name_of(one)}_dot": f"{name}_dot"}
        state |= {name_of(self.taken[p.name]): p.name for p in parameters}
        for name, entry in events.items():
            called, role = api_arguments.valid_name(name, "events"), f"event {name}"
            table = {str(k): x for k, x in entry.items()} if isinstance(entry, Mapping) else {}
            when = self._expression(table.pop("when", None) if table else entry, role)
            if not when.free_symbols:
                raise argument_error(role, f"{when} never crosses zero: it has no names")
            direction, action = table.pop("direction", "both"), table.pop("action", "record")
            if not isinstance(note := table.pop("note", ""), str):
                raise argument_error(role, f"note is a text, not {note!r}")
            for key, word, known in (
                ("direction", direction, DIRECTIONS), ("action", action, ACTIONS),
            ):  # fmt: skip
                if word not in known:
                    raise argument_error(role, f"{key} is one of {', '.join(known)}, here {word!r}")
            if strange := [key for key in table if key not in state]:
                why = f"{strange[0]} is no coordinate, velocity or parameter, which a jump sets"
                raise argument_error(role, why)
            if (action == "jump") != bool(table):
                remedy = 'add "action": "jump" where something is set, and only there'
                raise argument_error(role, remedy)
            jump = ((state[key], self._expression(x, f"{role}: {key}")) for key, x in table.items())
            yield Event(called, when, direction, action, tuple(jump), note=note)

    def _frictions(
        self, starts: Iterable[Any], parameters: Iterable[Parameter]
    ) -> Iterator[Friction]:
        """Yield stick-slip friction along coordinates, over parameters."""
        values = {p.symbol: p.value for p in parameters}
        known = {name_of(one): self.map[one].name for one in starts}
        friction = api_arguments.by_name(self.arguments.friction, "friction", "{x: mu*m*g}")
        for name, size in friction.items():
            role = f"friction of {name}"
            if name not in known:
                raise argument_error(role, f"coordinates are {', '.join(known)}")
            force = self._expression(size, role)
            if moving := sorted(s.name for s in force.free_symbols - self.fixed.keys()):
                raise argument_error(role, f"{moving[0]} is no parameter, of which it is made")
            if (value := float(force.xreplace(values))) < 0:
                raise argument_error(role, f"is {value:g}, and can't be negative")
            yield Friction(known[name], force, "friction")

    def _outputs(
        self, starts: Iterable[Any], coordinates: Sequence[Coordinate],
        units: Mapping[Any, str], rows: Sequence[str],
    ) -> Iterator[Output]:  # fmt: skip
        """Yield the outputs, which may use accelerations and multipliers (lambda_rod)."""
        outputs = self.arguments.outputs
        for one, c in zip(starts, coordinates, strict=True):
            if isinstance(one, AppliedUndef):
                self.map[sympy.Derivative(one, (one.args[0], 2))] = c.qdd
            else:
                self.map[Symbol(f"{one}_ddot", **one.assumptions0)] = c.qdd
            self.known.add(c.qdd)
        for row in rows:
            name, multiplier = symbol(f"lambda_{row}"), multiplier_of(row)
            if name.name not in self.taken:
                self.map |= {name: multiplier, Symbol(name.name): multiplier}
                self.known |= {name, multiplier}
        if not isinstance(outputs, Mapping):
            raise argument_error(
                "outputs", f'give a dict, such as {{"tip": x + l}}, here {outputs!r}'
            )
        moving = {x for c in coordinates for x in (c.q, c.qd)}
        for name, formula in outputs.items():
            called = api_arguments.valid_name(name, "outputs")
            expr = self._expression(formula, f"output {name}")
            if called in rows:
                raise argument_error("outputs", f"'{name}' is a constraint already: rename one")
            if expr in moving and is_in_degrees(units.get(name, "")):
                raise argument_error(
                    "outputs",
                    f"{name}: angles are in radians, nothing is converted: give {formula}*180/pi",
                )
            yield Output(called, expr, units.get(name, ""))

    def _declare(self, one: Any, role: str) -> str:
        used = self._name_of(one, role)
        self.map[one] = symbol(used)
        if one == symbol(name_of(one)):  # also without the assumption of real values
            self.map[Symbol(one.name)] = symbol(used)
        return used

    def _own_symbols(self, coordinates: Iterable[Any]) -> dict[str, Expr]:
        """Return the user's symbols of coordinates, their derivatives, and all other quantities.

        Names that were given as text have no symbol of the user. A velocity that has none in the
        user's expressions is real where its coordinate is, and has either sign.
        """
        arguments = self.arguments
        declarations = (
            arguments.coordinates,
            arguments.parameters,
            arguments.inputs,
            arguments.definitions,
        )
        as_text = {one for group in declarations for one in group if isinstance(one, str)}
        moving, replacements = {*coordinates}, dict[str, Expr]()
        for name, one in self.taken.items():
            if name_of(one) in as_text:
                continue
            replacements[name] = one
            if one in moving and isinstance(one, AppliedUndef):
                (time,) = one.args
                replacements["t"] = time
                replacements[f"{name}_dot"], replacements[f"{name}_ddot"] = (
                    one.diff(time),
                    one.diff(time, 2),
                )
            elif one in moving:
                for order in ("_dot", "_ddot"):
                    rate = Symbol(f"{one}{order}", real=one.is_real)
                    replacements[name + order] = self.used.get(rate.name, rate)
        return replacements


# --- functions that formulas of scenes have -------------------------------------------------------

_AS: Mapping[Any, Callable[[Expr], Expr]] = {
    sympy.UnevaluatedExpr: lambda x: x,
    sympy.sec: lambda x: 1 / sympy.cos(x),
    sympy.csc: lambda x: 1 / sympy.sin(x),
    sympy.cot: lambda x: sympy.cos(x) / sympy.sin(x),
    sympy.sech: lambda x: 1 / sympy.cosh(x),
    sympy.csch: lambda x: 1 / sympy.sinh(x),
    sympy.coth: lambda x: 1 / sympy.tanh(x),
    sympy.asec: lambda x: sympy.acos(1 / x),
    sympy.acsc: lambda x: sympy.asin(1 / x),
}
_ORDERS = (GreaterThan, LessThan, StrictGreaterThan, StrictLessThan)


class JumpError(ValueError):
    """Error for a SymPy Piecewise that is discontinuous or whose continuity is undecided."""


def rewrite_functions(expr: Expr, fixed: Mapping[Symbol, bool]) -> Expr:
    """Return an equal expression without Piecewise and without functions such as sec and coth.

    The result uses only functions that formulas of scenes can use. fixed: dict from each constant
    symbol to True if it is known to be nonnegative, else False. Raises JumpError for a Piecewise
    that is discontinuous, or whose continuity cannot be decided.
    """
    expr = expr.replace(lambda e: type(e) in _AS, lambda e: _AS[type(e)](*e.args))
    return expr.replace(lambda e: isinstance(e, sympy.Piecewise), lambda e: _continuous(e, fixed))


def _continuous(piecewise: sympy.Piecewise, fixed: Mapping[Symbol, bool]) -> Expr:
    """Return a continuous Piecewise as a sum of products with Max.

    Starts from the last piece. Where d > 0 a piece replaces another; if their difference is q d
    with finite q, the term q Max(d, 0) is added.
    """
    *pieces, (result, last) = piecewise.args
    if last != sympy.true:
        raise JumpError(f"{piecewise} has no last piece: give one for all else, (0, True)")
    last_piece = result
    for k in reversed(range(len(pieces))):
        piece, condition = pieces[k]
        if not isinstance(condition, _ORDERS):
            raise JumpError(f"{condition} in a Piecewise can't be used: write x > a or x < a")
        d = condition.gts - condition.lts
        other = _applicable_piece(condition, piecewise.args[k + 1 :], fixed)
        q = sympy.cancel((piece - other) / d) if other is not None else sympy.zoo
        if q.has(sympy.zoo, sympy.nan) or not sympy.fraction(q)[1].free_symbols <= fixed.keys():
            unknown = [str(s) for s in fixed if s in condition.free_symbols and not fixed[s]]
            order = f"; Symbol('{unknown[0]}', positive=True) tells an order" if unknown else ""
            jump = sympy.Heaviside(d)
            if len(pieces) == 1:
                jump = last_piece + (piece - last_piece) * jump
            raise JumpError(
                f"{piecewise} jumps where {d} = 0, or can't be seen not to: write {jump}, whose "
                f"Heaviside is 1/2 there, or Max, Min or a smooth tanh{order}"
            )
        result += q * sympy.Max(d, 0)
    return result


def _applicable_piece(condition: Any, later: Any, fixed: Mapping[Symbol, bool]) -> Expr | None:
    """Return the later piece that applies where a condition holds; None if undecided."""
    for piece, other in later:
        if _are_exclusive(condition, sympy.Not(other), fixed):
            return piece
        if not _are_exclusive(condition, other, fixed):
            return None
    return None


def _are_exclusive(one: Any, other: Any, fixed: Mapping[Symbol, bool]) -> bool:
    """Return True if two conditions exclude each other: d > 0 and e > 0 if d + s e <= 0, s > 0."""
    if isinstance(one, _ORDERS) and isinstance(other, _ORDERS):
        (d, varying), (e, against) = (
            (x.gts - x.lts).expand().as_independent(*x.free_symbols - fixed.keys(), as_Add=True)
            for x in (one, other)
        )
        s = -sympy.cancel(varying / against) if against != 0 else sympy.S.Zero
        known = {x: sympy.Dummy(x.name, nonnegative=True) for x in fixed if fixed[x]}
        if s.is_positive and sympy.expand(d + s * e).xreplace(known).is_nonpositive:
            return True
    return bool(sympy.And(one, other).simplify() == sympy.false)


# --- pictures -------------------------------------------------------------------------------------

_PICTURE_EXAMPLE = (
    '{"points": {"tip": ["l*sin(theta)", "-l*cos(theta)"]}, "lines": [[[0, 0], "tip"]]}'
)
_WORDS = (  # phrases of messages, for TOML and for Python
    ('lines = [["cart", "tip"]]', '"lines": [["cart", "tip"]]'),
    ("[picture.points], such as tip = [", '"points", such as "tip": ['),
    (
        'a table, such as { tip = ["x", "l*cos(theta)"] }',
        'a dict, such as {"tip": ["x", "l*cos(theta)"]}',
    ),
    ("a list of tables with", "a list of dicts with"),
    ('[{ at = "cart", size = [0.4, 0.2] }]', '[{"at": "cart", "size": [0.4, 0.2]}]'),
    ('[{ at = "wheel", radius = 0.1 }]', '[{"at": "wheel", "radius": 0.1}]'),
    (", here a table", ", here a dict"),
    (", here true", ", here True"),
    (", here false", ", here False"),
)
_SCENE_NAMES = {"Abs": "abs", "Max": "max", "Min": "min"}


def picture_scene(
    picture: Any, expression: Callable[[Any, str], Expr], coordinates: Iterable[Coordinate],
    parameters: Iterable[Parameter], inputs: Iterable[str],
    definitions: Sequence[tuple[Symbol, Expr]],
) -> tuple[Scene, str]:  # fmt: skip
    """Return a scene with the picture of a system made in Python, and the picture as JSON text.

    Parameters
    ----------
    picture
        The argument `picture` of System.make.
    expression
        Function that converts a user's expression; called with (expression, description of it for
        messages).
    coordinates, parameters, inputs
        Quantities that the picture may use; the scene declares all of them.
    definitions
        Pairs (symbol, expression) that the picture may use; the scene contains those that it needs.

    Raises
    ------
    EomcError
        If the picture is invalid.
    """
    if not isinstance(picture, Mapping):
        raise argument_error(
            "picture", f"give a dict, such as {_PICTURE_EXAMPLE}, here {picture!r}"
        )
    table = _as_toml(picture, expression)
    coordinates = [*coordinates]
    tree: dict[str, Any] = {
        "eomc": 1,
        "name": "pictured",
        "coordinates": {c.name: _metres(c) for c in coordinates},
        "parameters": {p.name: {"value": p.value, **_metres(p)} for p in parameters},
        "inputs": {name: {} for name in inputs},
        "definitions": _used_definitions(table, definitions),
        "energy": {"kinetic": f"{coordinates[0].name}_dot**2"},  # required in a scene; not drawn
        "picture": table,
    }
    try:
        scene = read.check_tree(tree, "System.make")
    except SceneError as wrong:
        problems = [replace(p, message=message_in_python(p.message)) for p in wrong.problems]
        raise SceneError(problems) from None
    return scene, json.dumps(table, sort_keys=True, default=str)


def message_in_python(message: str) -> str:
    """Return a message about the table [picture] with Python syntax in place of TOML syntax."""
    for toml, python in _WORDS:
        message = message.replace(toml, python)
    return message


def _metres(one: Coordinate | Parameter) -> dict[str, str]:
    """Return the unit if it is a length, the only one that pictures use."""
    return {"unit": "m"} if one.unit == "m" else {}


def _as_toml(value: Any, expression: Callable[[Any, str], Expr]) -> Any:
    """Convert a value to that of a scene: expressions to formulas, sequences to lists."""
    if isinstance(value, Mapping):
        return {str(key): _as_toml(entry, expression) for key, entry in value.items()}
    if isinstance(value, sympy.MatrixBase):
        value = value.flat()
    if hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_as_toml(entry, expression) for entry in value]
    if isinstance(value, Expr):
        return formula_text(expression(value, "picture"))
    return value


def _used_definitions(table: Any, definitions: Sequence[tuple[Symbol, Expr]]) -> dict[str, str]:
    """Return the definitions on which a picture depends, in their order."""
    names = {*re.findall(r"[A-Za-z_]\w*", json.dumps(table, default=str))}
    used: dict[str, str] = {}
    for name, expr in reversed(definitions):
        if name.name in names:
            names |= {s.name for s in expr.free_symbols if isinstance(s, Symbol)}
            used[name.name] = formula_text(expr)
    return dict(reversed(used.items()))


class _Formula(StrPrinter):  # type: ignore[misc]  # SymPy has no types
    """Printer of SymPy expressions as formulas of scenes."""

    def _print_Function(self, expr: Any) -> str:
        name = type(expr).__name__
        return f"{_SCENE_NAMES.get(name, name)}({self.stringify(expr.args, ', ')})"

    _print_Max = _print_Min = _print_Abs = _print_Function

    def _print_Heaviside(self, expr: Any) -> str:
        return f"heaviside({self._print(expr.args[0])})"

    def _print_Float(self, expr: Any) -> str:
        return repr(float(expr))

    def _print_Exp1(self, expr: Any) -> str:
        return "exp(1)"

    def _print_NumberSymbol(self, expr: Any) -> str:
        return repr(float(expr))

    def _print_Pi(self, expr: Any) -> str:
        return "pi"


def formula_text(expr: Expr) -> str:
    """Return a SymPy expression as a formula in the syntax of scenes.

    >>> x = Symbol("x")
    >>> formula_text(sympy.Abs(x) ** 2 / 2 + sympy.exp(1) * sympy.Max(x, 0))
    'abs(x)**2/2 + exp(1)*max(0, x)'
    """
    return str(_Formula().doprint(expr))
