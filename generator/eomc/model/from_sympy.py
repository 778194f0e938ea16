"""Conversion of the arguments of System.make to a scene whose formulas are SymPy expressions.

The user's symbols, whatever their assumptions, are replaced by those of the system, and functions
that formulas do not have are rewritten exactly. All else is checked as in a scene from TOML text.
"""

from __future__ import annotations

import ast
import json
import keyword
import math
import numbers
from collections.abc import Callable, Mapping
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.codegen import cfunctions
from sympy.core.function import AppliedUndef
from sympy.core.relational import GreaterThan, LessThan, StrictGreaterThan, StrictLessThan
from sympy.printing.str import StrPrinter

from eomc.base import names, texts
from eomc.base.errors import SceneError
from eomc.model import algebra
from eomc.model.symbols import symbol, t
from eomc.scene import formulas, read
from eomc.scene.formulas import Formula, FormulaError, Value, suggest
from eomc.scene.scene import Scene
from eomc.scene.toml_text import ArgumentMap, Path

_EXAMPLES = {  # of the arguments that are dicts
    "parameters": "{m: 2.0}",
    "forces": "{x: F}",
    "definitions": "{y: l*cos(theta)}",
    "outputs": '{"tip": x + l}',
    "constraints": '{"rod": x**2 + y**2 - l**2}',
    "limits": "{F: (-1, 1)}",
    "events": '{"impact": y}',
    "friction": "{x: mu*m*g}",
    "units": '{m: "kg"}',
    "picture": (
        '{"points": {"tip": ["l*sin(theta)", "-l*cos(theta)"]}, "lines": [[[0, 0], "tip"]]}'
    ),
}
_SETTINGS = (
    "h", "duration", "real", "batch", "linearize", "discretize", "inverse_dynamics", "tolerance",
)  # fmt: skip


class SystemArguments:
    """Converter of the arguments of System.make to a scene.

    values: the arguments by name, as the user gave them.

    Attributes
    ----------
    places
        The arguments as places of errors.
    renamed
        Names that C does not allow, as pairs (given name, name in the system).
    own_symbols
        Symbols, functions of time and derivatives of these that the user passed, by their names in
        the system. Names that were given as text have none.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values = values
        events = values["events"] if isinstance(values["events"], Mapping) else {}
        self.places = ArgumentMap(str(values["name"]), [*map(str, events)])
        self.renamed: list[tuple[str, str]] = []
        self.own_symbols: dict[str, Expr] = {}
        self._map: dict[Any, Expr] = {}  # symbols of the system by those of the user
        self._names: dict[str, str] = {}  # names in the system by the user's names
        self._known = {"t"}  # names of the time and of declared quantities
        self._rates: dict[str, str] = {}  # names of rates, as symbols of the user and in the system
        self._nonnegative: dict[Symbol, bool] = {}  # parameters

    def scene(self) -> Scene:
        """Return the checked scene. Raises SceneError for invalid arguments."""
        scene = read.check_tree(self._tree(), self.places)
        for p in scene.parameters:
            if p.value < 0 and self._nonnegative[symbol(p.name)]:
                why = f"its symbol can't be negative, here {p.value:g}"
                raise self._fault(("parameters", p.name), why)
        return scene

    def picture_text(self) -> str:
        """Return the picture as text, for the digest of the system."""
        return json.dumps(self._picture(self.values["picture"]), sort_keys=True, default=str)

    def _tree(self) -> dict[str, Any]:
        """Return the scene as the tree of dicts and lists that its TOML text would have."""
        values, value = self.values, self._value
        declared = {
            table: self._declare(table)
            for table in ("coordinates", "parameters", "inputs", "definitions")
        }
        by_symbol = {key: self._by_name(key) for key in ("forces", "limits", "friction", "units")}
        friction, limits = by_symbol["friction"], by_symbol["limits"]
        for key, table in (("limits", "inputs"), ("friction", "coordinates")):
            for name in by_symbol[key].keys() - declared[table].keys():
                raise self._fault((key, name), f"'{name}' is not among the {table}")
        tree: dict[str, Any] = {
            "eomc": 1,
            "name": values["name"],
            "title": _line(values["title"]),
            "coordinates": self._coordinates(declared["coordinates"], friction),
            "parameters": {
                name: {"value": value(("parameters", name), x)}
                for name, x in declared["parameters"].items()
            },
            "inputs": {
                name: {"signal": value(("inputs", name), 0 if x is None else x)}
                for name, x in declared["inputs"].items()
            },
            "energy": {
                key: value(("energy", key), values[key])
                for key in ("kinetic", "potential", "dissipation")
                if values[key] is not None
            },
            "run": {key: _setting(values[key]) for key in _SETTINGS if values[key] is not None},
        }
        for name, ends in limits.items():
            tree["inputs"][name]["limits"] = self._limits(("inputs", name, "limits"), ends)
        for table, entries in (
            ("definitions", declared["definitions"]), ("forces", by_symbol["forces"]),
        ):  # fmt: skip
            tree[table] = {name: value((table, name), x) for name, x in entries.items()}
        for table in ("constraints", "outputs"):
            tree[table] = {
                str(name): {"formula": value((table, str(name)), x)}
                for name, x in self._dict(table).items()
            }
        self._add_units(tree, by_symbol["units"])
        if events := self._dict("events"):
            pairs = enumerate(events.items(), start=1)
            tree["event"] = [self._event(("event", str(k)), name, x) for k, (name, x) in pairs]
        if values["picture"] is not None:
            tree["picture"] = self._picture(self._dict("picture"))
        methods = values["methods"]
        tree["run"]["method"] = [*methods] if isinstance(methods, (list, tuple)) else methods
        if friction:
            tree["run"]["friction"] = "stick"
        return tree

    def _fault(self, path: Path, message: str) -> SceneError:
        return SceneError([self.places.problem(path, message)])

    # --- names ------------------------------------------------------------------------------------

    def _dict(self, argument: str) -> Mapping[Any, Any]:
        value = self.values[argument]
        if value is not None and not isinstance(value, Mapping):
            why = f"give a dict, such as {_EXAMPLES[argument]}, here {value!r}"
            raise self._fault((argument,), why)
        return value or {}

    def _symbol(self, argument: str, value: Any) -> Any:
        if not isinstance(value, (str, Symbol, AppliedUndef)):
            raise self._fault((argument,), f"{value!r} is not a symbol")
        return symbol(value) if isinstance(value, str) else value

    def _by_name(self, argument: str) -> dict[str, Any]:
        """Return values by names in the system, from a dict with symbols or names as keys."""
        values = {_name(self._symbol(argument, one)): x for one, x in self._dict(argument).items()}
        return {self._names.get(name, name): x for name, x in values.items()}

    def _declare(self, table: str) -> dict[str, Any]:
        """Return values by names in the system, from a dict or a list of symbols; map these."""
        value, entries = self.values[table], dict[str, Any]()
        if table in _EXAMPLES:
            value = self._dict(table)
        elif not isinstance(value, (Mapping, list, tuple, set, frozenset)):
            raise self._fault((table,), f"give a list or dict of symbols, here {value!r}")
        for one in value:
            own, text = self._symbol(table, one), _name(one)
            name = names.plain(text) if names.fault(text) else text
            if name in entries:
                why = f"'{name}' stands here a second time: remove one of the two"
                raise self._fault((table, text), why)
            if name != text:
                self.renamed.append((text, name))
            entries[name] = value[one] if isinstance(value, Mapping) else None
            self._replace(own, text, name)
            if not isinstance(one, str):
                self.own_symbols[name] = own
            if table == "coordinates":
                self._declare_rates(one, own, name)
            elif table == "parameters":
                self._nonnegative[symbol(name)] = getattr(own, "is_nonnegative", None) is True
        return entries

    def _replace(self, own: Any, text: str, name: str) -> None:
        """Let a symbol of the system replace the user's symbol."""
        self._map[own] = symbol(name)
        if own == symbol(text):  # also without the assumption of real values
            self._map[Symbol(text)] = symbol(name)
        self._names[text] = self._names[str(own)] = name
        self._known.add(name)

    def _declare_rates(self, one: Any, own: Any, name: str) -> None:
        """Map velocity and acceleration of a coordinate; `one` is its symbol as it was given."""
        text = _name(own)
        for order, suffix in enumerate(("_dot", "_ddot"), start=1):
            if isinstance(own, AppliedUndef):
                (time,) = own.args
                rate = own.diff(time, order)
                self._map[time] = t
                self.own_symbols |= {"t": time, name + suffix: rate}
                self._replace(rate, text + suffix, name + suffix)
                continue
            self._replace(Symbol(text + suffix, **own.assumptions0), text + suffix, name + suffix)
            if not isinstance(one, str):
                self.own_symbols[name + suffix] = Symbol(text + suffix, real=own.is_real)
                self._rates[text + suffix] = name + suffix

    # --- entries ----------------------------------------------------------------------------------

    def _coordinates(
        self, coordinates: Mapping[str, Any], friction: Mapping[str, Any]
    ) -> dict[str, Any]:
        guess, entries = self.values["guess"], dict[str, Any]()
        if not isinstance(guess, (list, tuple, set, frozenset)):
            why = f"give a list of coordinates, such as [x], here {guess!r}"
            raise self._fault(("guess",), why)
        free = {self._names.get(n, n) for n in (_name(self._symbol("guess", x)) for x in guess)}
        for name in sorted(free - coordinates.keys()):
            raise self._fault(("guess",), f"'{name}' is not among the coordinates")
        for name, whole in coordinates.items():
            pair = whole if isinstance(whole, (tuple, list)) else (whole, None)
            if len(pair) != 2:
                why = f"give a start, or a pair (start, rate), here {whole!r}"
                raise self._fault(("coordinates", name), why)
            values: dict[str, Any] = dict(zip(("start", "rate"), pair, strict=True))
            values["friction"] = friction.get(name)
            entries[name] = {
                key: self._value(("coordinates", name, key), x)
                for key, x in values.items()
                if x is not None
            }
            if name in free:
                entries[name]["guess"] = True
        return entries

    def _limits(self, path: Path, ends: Any) -> Any:
        if not isinstance(ends, (tuple, list)) or len(ends) != 2:
            return ends
        infinite = (-math.inf, math.inf)
        return [
            end if x is None or x == end else self._value(path, x)
            for x, end in zip(ends, infinite, strict=True)
        ]

    def _event(self, path: Path, name: Any, entry: Any) -> dict[str, Any]:
        table: dict[str, Any] = {"name": str(name)}
        for one, x in (entry if isinstance(entry, Mapping) else {"when": entry}).items():
            key = self._names.get(str(one), str(one))
            texts_only = key in ("direction", "action", "note")
            table[key] = x if texts_only else self._value((*path, key), x)
        return table

    def _add_units(self, tree: dict[str, Any], units: Mapping[str, Any]) -> None:
        known = dict.fromkeys(tree["definitions"])
        for table in ("coordinates", "parameters", "inputs", "constraints", "outputs"):
            known |= tree[table]
            for name in tree[table].keys() & units.keys():
                tree[table][name]["unit"] = _line(units[name])
        for name in units.keys() - known.keys():
            why = f"'{name}' is no coordinate, parameter, input, constraint or output"
            raise self._fault(("units",), why + suggest(name, known))

    def _picture(self, value: Any) -> Any:
        """Return a value of the picture: sequences as lists, expressions as formulas."""
        if isinstance(value, Mapping):
            return {str(key): self._picture(entry) for key, entry in value.items()}
        if isinstance(value, sympy.MatrixBase):
            value = value.flat()
        if hasattr(value, "tolist"):  # NumPy's
            value = value.tolist()
        if isinstance(value, (list, tuple)):
            return [self._picture(entry) for entry in value]
        return self._value(("picture",), value) if isinstance(value, Expr) else value

    # --- expressions ------------------------------------------------------------------------------

    def _value(self, path: Path, value: Any) -> Value:
        """Return a number, the text of a formula, or a formula with an expression of the system."""
        if isinstance(value, (str, int)):
            return value
        if isinstance(value, numbers.Real) and not isinstance(value, Expr):
            return float(value)
        try:
            expr = sympy.sympify(value)
        except (sympy.SympifyError, TypeError, AttributeError, ValueError, RecursionError):
            expr = None
        if isinstance(expr, (sympy.MatrixBase, sympy.MatrixExpr)):
            why = "give one expression, not a matrix of {} by {}: its entry"
            raise self._fault(path, why.format(*expr.shape))
        if not isinstance(expr, Expr):
            raise self._fault(path, f"{value!r} is not an expression")
        rates = ((s, self._rates[s.name]) for s in expr.free_symbols if s.name in self._rates)
        self.own_symbols |= {rate: s for s, rate in rates}
        try:
            expr = rewrite_functions(self._in_own_symbols(expr), self._nonnegative)
            algebra.check_real(expr)
            check_functions(expr)
        except FormulaError as fault:
            raise self._fault(path, str(fault)) from None
        return as_formula(expr)

    def _in_own_symbols(self, expr: Expr) -> Expr:
        """Return an expression in symbols of the system. Raises FormulaError for another symbol."""
        expr = expr.replace(
            lambda e: isinstance(e, sympy.Derivative),
            lambda e: e if isinstance(e.expr, AppliedUndef) else e.doit(),
        )
        expr = expr.replace(lambda e: isinstance(e, sympy.Derivative), self._own_symbol)
        expr = expr.xreplace(self._map)
        others = expr.atoms(AppliedUndef) | expr.free_symbols
        return expr.xreplace({e: self._own_symbol(e) for e in others})

    def _own_symbol(self, e: Expr) -> Expr:
        if e in self._map:
            return self._map[e]
        rate = isinstance(e, sympy.Derivative)
        name = f"{_name(e.expr)}_{'d' * e.derivative_count}ot" if rate else _name(e)
        if name in self._known and e != symbol(name):
            if name == "t":
                raise FormulaError(
                    "this t is not the time: write eomc.model.system.t, or "
                    "dynamicsymbols._t where coordinates are dynamicsymbols"
                )
            raise FormulaError(
                f"the '{name}' declared there is another symbol than this: take the same one"
            )
        if not name.isidentifier() or keyword.iskeyword(name):
            raise FormulaError(f"'{name}' is not declared")
        return symbol(name)


def _name(one: Any) -> str:
    """Return the name of a symbol, of a function of time such as theta(t), or of a text."""
    return str(one.func.__name__ if isinstance(one, AppliedUndef) else one)


def _line(text: Any) -> Any:
    return texts.line(text) if isinstance(text, str) else text


def _setting(value: Any) -> Any:
    """Return a number of any type as a float, and any other value unchanged."""
    if isinstance(value, bool) or not isinstance(value, (numbers.Real, Expr)):
        return value
    return value if isinstance(value, Expr) and not value.is_number else float(value)


# --- formulas -------------------------------------------------------------------------------------

_KNOWN = (sympy.Add, sympy.Mul, sympy.Pow, Symbol, sympy.Number, sympy.NumberSymbol)
_MOST_TERMS = 50  # in a parenthesis: the depth of the syntax tree is their number


def check_functions(expr: Expr) -> None:
    """Raise FormulaError if an expression contains a function that formulas do not have."""
    known = (*_KNOWN, *algebra.CLASSES.values())
    queue, visited = [expr], {expr}
    while queue:
        part = queue.pop()
        if not isinstance(part, known):
            raise FormulaError(formulas.unknown_function(type(part).__name__))
        if isinstance(part, sympy.Heaviside) and part.args[1] != sympy.S.Half:
            raise FormulaError(f"{part}: Heaviside(x) is 1/2 at 0, without another value")
        more = [arg for arg in part.args if arg not in visited]
        visited.update(more)
        queue += more


class _Printer(StrPrinter):  # type: ignore[misc]  # SymPy has no types
    """Printer of SymPy expressions as formulas of scenes."""

    def _print_Function(self, expr: Any) -> str:
        args = expr.args[:1] if isinstance(expr, sympy.Heaviside) else expr.args
        return f"{_FORMULA_NAMES[type(expr)]}({self.stringify(args, ', ')})"

    _print_Max = _print_Min = _print_Abs = _print_Heaviside = _print_Function

    def _print(self, expr: Any, **settings: Any) -> str:
        """Print a long sum or product in parentheses, which limit the depth of the syntax tree."""
        if not isinstance(expr, (sympy.Add, sympy.Mul)) or len(expr.args) <= _MOST_TERMS:
            return str(super()._print(expr, **settings))
        size = -(-len(expr.args) // _MOST_TERMS)
        parts = (expr.args[k : k + size] for k in range(0, len(expr.args), size))
        groups = (f"({self._print(expr.func(*part, evaluate=False))})" for part in parts)
        return (" + " if expr.is_Add else "*").join(groups)

    def _print_Float(self, expr: Any) -> str:
        return repr(float(expr))

    def _print_Exp1(self, expr: Any) -> str:
        return "exp(1)"

    def _print_NumberSymbol(self, expr: Any) -> str:
        return repr(float(expr))

    def _print_Pi(self, expr: Any) -> str:
        return "pi"


_FORMULA_NAMES = {function: name for name, function in algebra.CLASSES.items()}


def as_formula(expr: Expr) -> Formula:
    """Return a SymPy expression of real symbols as a formula, whose text is in the scenes' syntax.

    >>> x = Symbol("x")
    >>> as_formula(sympy.Abs(x) ** 2 / 2 + sympy.exp(1) * sympy.Max(x, 0)).text
    'abs(x)**2/2 + exp(1)*max(0, x)'
    """
    text = str(_Printer().doprint(expr))
    return Formula(text, ast.parse(text, mode="eval").body, expr)


# --- functions that formulas of scenes have -------------------------------------------------------

_AS: Mapping[Any, Callable[[Expr], Expr]] = {
    sympy.UnevaluatedExpr: lambda x: x,
    sympy.sec: lambda x: 1 / sympy.cos(x),
    sympy.csc: lambda x: 1 / sympy.sin(x),
    sympy.cot: lambda x: sympy.cos(x) / sympy.sin(x),
    sympy.sech: lambda x: 1 / sympy.cosh(x),
    sympy.csch: lambda x: 1 / sympy.sinh(x),
    sympy.coth: lambda x: 1 / sympy.tanh(x),
    cfunctions.Cbrt: algebra.cbrt,
    cfunctions.expm1: algebra.expm1,
    cfunctions.hypot: algebra.hypot,
    cfunctions.log1p: algebra.log1p,
    cfunctions.exp2: lambda x: 2**x,
    cfunctions.log2: lambda x: sympy.log(x) / sympy.log(2),
    cfunctions.log10: lambda x: sympy.log(x) / sympy.log(10),
    sympy.asec: lambda x: sympy.acos(1 / x),
    sympy.acsc: lambda x: sympy.asin(1 / x),
}
_ORDERS = (GreaterThan, LessThan, StrictGreaterThan, StrictLessThan)


def rewrite_functions(expr: Expr, fixed: Mapping[Symbol, bool]) -> Expr:
    """Return an equal expression without Piecewise and without functions such as sec and coth.

    The result uses only functions that formulas of scenes can use. fixed: dict from each constant
    symbol to True if it is known to be nonnegative, else False. Raises FormulaError for a Piecewise
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
        raise FormulaError(f"{piecewise} has no last piece: give one for all else, (0, True)")
    last_piece = result
    for k in reversed(range(len(pieces))):
        piece, condition = pieces[k]
        if not isinstance(condition, _ORDERS):
            raise FormulaError(f"{condition} in a Piecewise can't be used: write x > a or x < a")
        d = condition.gts - condition.lts
        other = _applicable_piece(condition, piecewise.args[k + 1 :], fixed)
        q = sympy.cancel((piece - other) / d) if other is not None else sympy.zoo
        if q.has(sympy.zoo, sympy.nan) or not sympy.fraction(q)[1].free_symbols <= fixed.keys():
            unknown = [str(s) for s in fixed if s in condition.free_symbols and not fixed[s]]
            order = f"; Symbol('{unknown[0]}', positive=True) tells an order" if unknown else ""
            jump = sympy.Heaviside(d)
            if len(pieces) == 1:
                jump = last_piece + (piece - last_piece) * jump
            raise FormulaError(
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
