"""Check formulas of a scene against the declared names, and describe errors in words."""

from __future__ import annotations

import ast
import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter

from eomc.base import names
from eomc.base.errors import Problem
from eomc.runtime.mathematics import FUNCTIONS
from eomc.scene import formulas, hints
from eomc.scene.formulas import Formula, FormulaError, Value, suggest
from eomc.scene.toml_text import SourceMap

# kinds of quantities that a formula can depend on; after an error the kind is unknown
TIME, INPUT, POSITION, VELOCITY = "the time", "inputs", "coordinates", "velocities"
ACCELERATION, FORCE = "accelerations", "forces of constraints"
UNKNOWN = "something faulty"

NOTHING: frozenset[str] = frozenset()

# names that outputs can use besides all others, unless the scene declares them
JUMPS = tuple(f.name for f in FUNCTIONS.values() if f.shape == "jump")
ENERGIES = ("kinetic_energy", "potential_energy", "energy")

MAX_SUGGESTIONS = 20  # similar names are suggested for the first errors only

Path = tuple[str, ...]


def value_of(formula: Formula, known: Mapping[str, float]) -> tuple[float, str]:
    """Evaluate a formula and return a pair (value, reason).

    known: dict from each name that the formula may use to its value. The reason is "" if the value
    is real and finite. Otherwise the value is nan and the reason states what is wrong.
    """
    try:
        value = formulas.evaluate(formula, formulas.NUMERIC, known.__getitem__)
        if isinstance(value, (int, float)) and math.isfinite(value):
            return float(value), ""
        fault = "has no real, finite value"
    except ZeroDivisionError:
        fault = "divides by zero"
    except OverflowError:
        fault = "is too large for a double"
    except (ValueError, TypeError):
        fault = "has no real value"
    values = {n.id: known[n.id] for n in formula.names()}
    where = ", ".join(f"{name} = {value:g}" for name, value in values.items())
    advice = formulas.domain_advice(formula, known.__getitem__)
    return math.nan, f"'{formula.shown}' {fault}" + (f" at {where}" if where else "") + advice


def find_cycles(graph: dict[str, list[str]]) -> Iterator[list[str]]:
    """Yield each cycle of names whose definitions depend on one another.

    A cycle is a list of names in which the first name is repeated at the end. graph: dict from each
    name to the names on which it depends. The dict is changed: cycles that were found are removed.
    """
    while True:
        try:
            return TopologicalSorter(graph).prepare()
        except CycleError as cycle:
            ring = cycle.args[1][::-1]
            yield ring
            graph |= {name: [] for name in ring}


def cycle_text(cycle: list[str]) -> str:
    """Return a cycle of names as text such as "a -> b -> a", shortened if it is long."""
    return " -> ".join(cycle if len(cycle) <= 20 else [*cycle[:10], "...", *cycle[-9:]])


class Checker:
    """Checks formulas of a scene against the declared names, and collects the problems.

    A path is the tuple of keys that lead to an entry of the scene, such as ("energy", "kinetic").

    places: lines of all keys in the file. problems: errors and warnings found so far. tables: the
    table in which each name is declared. kinds: for each name that formulas may use, the kinds of
    quantities that it depends on. used: for each name, the paths of the formulas that use it.
    centers: names of positions that bodies define, such as link_x. definitions: the checked
    definitions. repaired: paths of faulty entries that were reported and replaced by valid ones.
    """

    def __init__(self, places: SourceMap) -> None:
        self.places = places
        self.problems: list[Problem] = []
        self.faults = 0  # number of errors, each repetition counted
        self.reported: set[tuple[Path, str]] = set()
        self.used: dict[str, list[Path]] = defaultdict(list)
        self.repaired: set[Path] = set()
        self.tables: dict[str, str] = {}
        self.kinds: dict[str, frozenset[str]] = {}
        self.centers: set[str] = set()
        self.definitions: dict[str, Formula] = {}
        self.solved = False  # True if formulas may use accelerations

    def allow_solved_quantities(
        self, accelerations: Collection[str], forces: Collection[str]
    ) -> None:
        """Allow accelerations, energies and constraint forces in all formulas checked from now on.

        Only the formulas of outputs, which are checked last, may use them. accelerations, forces:
        the names of these quantities.
        """
        self.solved = True
        moving = frozenset({POSITION, VELOCITY})
        self.kinds = {
            **dict.fromkeys(ENERGIES, moving),
            **dict.fromkeys(accelerations, frozenset({ACCELERATION})),
            **dict.fromkeys(forces, frozenset({FORCE})),
            **self.kinds,
        }

    def report(
        self,
        path: Path,
        message: str,
        at: FormulaError | ast.expr | None = None,
        text: str | None = None,
        severity: str = "error",
    ) -> None:
        """Add a problem with the entry at `path` to `problems`.

        text: text of the faulty formula. at: the faulty part of this text. severity: "error" or
        "warning". If several copies of a repeated entry have the same problem, it is added once.
        """
        self.faults += severity == "error"
        origin = self.places.origin(path)
        same = (origin, re.sub(r"\d+", "", message))
        if origin == path or same not in self.reported:
            self.reported.add(same)
            self.problems.append(self.places.problem(path, message, at, text, severity))

    def report_missing(self, path: Path, remedy: str) -> None:
        """Add an error for a missing entry at `path`, unless an error was reported for it before.

        remedy: end of the message.
        """
        if path not in self.repaired:
            self.report(path, f"missing: {remedy}")

    def claim(self, path: Path, name: str, taken: dict[str, str], what: str) -> bool:
        """Report an error if a name is not valid or is in use; else add it to `taken`.

        path: keys of the entry that declares the name. taken: words on what has each name in use,
        such as "is the time". what: these words for this name. Returns True without an error.
        """
        why = names.fault(name)
        if not why and name in taken:
            why = f"'{name}' {taken[name]}: choose another name"
        if why:
            self.report(path, why, text=name if path[-1] == "name" else None)
        taken.setdefault(name, what)
        return not why

    def parse(self, path: Path, value: Value) -> Formula | None:
        """Parse an entry of the scene and return its formula, without checking its names.

        path: keys of the entry. value: the entry. If the syntax of the formula is not permitted,
        report the error and return None.
        """
        if isinstance(value, Formula):
            return value
        text = value if isinstance(value, str) else repr(value)
        if re.search(r"[\t\n]", text) and re.search(r"\\[tn]", self.places.source(path)):
            # "\theta" is a tab and 'heta', "\nu" a line break and 'u'
            self.report(path, "LaTeX is not read: write names without backslash (theta)")
            return None
        try:
            return formulas.parse(text)
        except FormulaError as fault_found:
            # a parameter is no product of others: "2 m" is a length
            declared = () if path[0] in ("parameters", "constants") else {*self.tables, *self.kinds}
            remedy = hints.quantity_remedy(text, declared)
            fault = FormulaError(remedy, 0, len(text)) if remedy else fault_found
            self.report(path, fault.message, fault, text)
            return None

    def formula(
        self,
        path: Path,
        value: Value,
        allowed: Collection[str] | None = None,
        rule: str = "",
    ) -> Formula | None:
        """Parse an entry of the scene, check the names in its formula, and return the formula.

        path: keys of the entry. value: the entry, a number or the text of a formula. allowed: the
        names that the formula may use, by default all names known so far. rule: describes these
        names in the message of an error. After an error, report it and return None.
        """
        formula = self.parse(path, value)
        return formula if formula and self.check_names(path, formula, allowed, rule) else None

    def check_names(
        self,
        path: Path,
        formula: Formula,
        allowed: Collection[str] | None = None,
        rule: str = "",
    ) -> bool:
        """Return True if a formula uses only permitted names; else report the errors.

        path: keys of the formula's entry in the scene. allowed: the permitted names, by default all
        names known so far. rule: describes these names in the message of an error. It is also an
        error if the time derivative dot(...) of an expression can't be computed.
        """
        before = self.faults
        for node in formula.names():
            self.used[node.id].append(path)
            if node.id not in (self.kinds if allowed is None else allowed):
                self.report(path, self._refusal(node.id, rule), node, formula.text)
        if self.faults == before:
            for call in formula.calls("dot"):
                is_constant = allowed is not None and not any(
                    self.tables.get(name) == "coordinates" for name in allowed
                )
                if why := rule if is_constant else self._rate_fault(call.args[0]):
                    self.report(path, f"dot(...) can't be used here: {why}", call, formula.text)
        return self.faults == before

    def _refusal(self, name: str, rule: str) -> str:
        """Return why `name` can't be used."""
        if rule and (name in self.tables or name in self.kinds):
            return f"'{name}' can't be used here: {rule}"
        if name in self.tables:
            return f"'{name}' is defined further down: move its line above this one"
        start = f"'{name}' is not declared"
        if name.endswith(("_ddot", "_dot_dot")):
            return f"{start}: accelerations are what is solved for, only [outputs] can use them"
        owner = name.removesuffix("_dot")
        if owner != name and owner in self.centers:
            return f"{start}: write dot({owner}) for the velocity of a body"
        match self.tables.get(owner) if owner != name else None:
            case "definitions":
                return f"{start}: write dot({owner}) for the rate of a definition"
            case "inputs":
                return f"{start}: nobody knows the rate of an input; add it as a further input"
            case "parameters" | "constants" as table:
                return f"{start}: '{owner}' stands in [{table}], so it doesn't move"
        if similar := self._similar_name(name) or hints.intended_velocity(name, self.tables):
            return f"{start}; did you mean '{similar}'?"
        if name == "time":
            return f"{start}; did you mean 't'?"
        if self.faults < MAX_SUGGESTIONS and (near := suggest(name, self.kinds)):
            return start + near
        if name in ("e", "E"):
            return f"{start}: write exp(1), or declare it in [constants]"
        return f"{start}: add it to [parameters], [constants], [inputs] or [definitions]"

    def _similar_name(self, name: str) -> str:
        """Return a known name that differs from `name` by underscores only, or ""."""
        plain = name.replace("_", "")
        known = self.kinds if self.faults < MAX_SUGGESTIONS else ()
        return next((k for k in known if k.replace("_", "") == plain), "")

    def _rate_fault(self, inside: ast.expr) -> str:
        """Return why dot(inside) does not exist; "" if it does."""
        kinds = self.kinds_of(inside)
        if INPUT in kinds:
            return "it holds inputs, whose rate nobody knows; add the rate as a further input"
        if ACCELERATION in kinds:
            return "it holds accelerations, whose rate is not computed"
        if FORCE in kinds:
            return "it holds forces of constraints, whose rate is not computed"
        if VELOCITY in kinds and not self.solved:
            return "it holds velocities, and their rates are what is solved for"
        return ""

    def kinds_of(self, node: ast.AST) -> frozenset[str]:
        """Return the kinds of quantities that a part of a formula depends on.

        node: syntax node of the part. A call dot(e) adds the kind of velocities if e depends on
        coordinates, and that of accelerations if e depends on velocities.
        """
        if isinstance(node, ast.Name):
            return self.kinds.get(node.id, NOTHING)
        kinds = NOTHING.union(*map(self.kinds_of, ast.iter_child_nodes(node)))
        dot = (
            isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dot"
        )
        if dot and VELOCITY in kinds:
            kinds |= {ACCELERATION}
        return kinds | {VELOCITY} if dot and POSITION in kinds else kinds

    def find_part(self, formula: Formula, kind: str) -> ast.expr:
        """Return the syntax node of the first part of the formula that depends on `kind`.

        kind: a kind of quantities, such as VELOCITY.
        """
        parts: list[ast.expr] = [*formula.calls("dot"), *formula.names()]
        parts_of_kind = [part for part in parts if kind in self.kinds_of(part)]
        return min(parts_of_kind, key=lambda part: part.col_offset, default=formula.tree)

    def depends_on(self, path: Path, formula: Formula, kind: str, why: str) -> bool:
        """Return whether a formula depends on a kind of quantities, such as VELOCITY; report it.

        path: keys of the formula's entry in the scene. why: the message.
        """
        depends = kind in self.kinds_of(formula.tree)
        if depends:
            self.report(path, why, self.find_part(formula, kind), formula.text)
        return depends

    def number(self, path: Path, formula: Formula | None, known: Mapping[str, float]) -> float:
        """Return the value of a formula.

        path: keys of the formula's entry in the scene. known: dict from each name that the formula
        may use to its value. If the formula has no finite value, report this and return nan. If the
        formula is None or uses a value that is nan, return nan without a report.
        """
        if formula is None or any(math.isnan(known[n.id]) for n in formula.names()):
            return math.nan  # reported already
        value, fault = value_of(formula, known)
        if fault:
            self.report(path, fault, text=formula.text)
        return value

    def check_smooth(self, path: Path, formula: Formula) -> None:
        """Report calls of sign and heaviside in a formula that will be differentiated.

        These functions are discontinuous. Calls whose arguments depend neither on time nor on the
        state are permitted. The definitions that the formula uses are checked too.
        """
        queue = [(path, formula)]
        visited: set[str] = set()
        while queue:
            where, f = queue.pop()
            for call in f.calls(*JUMPS):
                if {TIME, POSITION, VELOCITY} & self.kinds_of(call):
                    function = ast.unparse(call.func)
                    self.report(
                        where,
                        f"{function}(...) jumps, and {'.'.join(path)} that uses it is "
                        "differentiated: use abs, min or max (max(x, 0)**2 for a stop), a smooth "
                        "tanh(x/width), or give the force itself in [forces]",
                        call,
                        f.text,
                    )
            for node in f.names():
                if node.id in self.definitions and node.id not in visited:
                    visited.add(node.id)
                    queue.append((("definitions", node.id), self.definitions[node.id]))
