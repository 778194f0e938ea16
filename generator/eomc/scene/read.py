"""Read and check a scene file; every error is reported at its place. Independent of SymPy and C.

`expand` expands `repeat = "i = 1..n"` and `theta[i]` in the tree of a scene. Repeated entries
become separate entries, and `name[index]` becomes the name followed by the number. The arrays of
tables [[body]], [[spring]], ... become tables, with the names of bodies and points as keys, or else
numbers from 1.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from eomc.base import names, texts
from eomc.base.errors import EomcError, SceneError
from eomc.scene import formulas, hints, schema, toml_text, validate_bodies, validate_tables
from eomc.scene.formulas import Formula, FormulaError, Value, suggest
from eomc.scene.scene import NamedFormula, Quantity, Scene, SceneInput
from eomc.scene.schema import RunSettings
from eomc.scene.scope import (
    INPUT,
    NOTHING,
    POSITION,
    TIME,
    UNKNOWN,
    VELOCITY,
    Checker,
    cycle_text,
    find_cycles,
    value_of,
)
from eomc.scene.scope import Path as KeyPath
from eomc.scene.toml_text import ARRAYS, MAX_BYTES, SourceMap
from eomc.scene.validate_tables import ValueChecker


def read(file: str | os.PathLike[str], parameters: Mapping[str, float] | None = None) -> Scene:
    """Read and check a scene file.

    Parameters
    ----------
    file : path
    parameters : mapping from names to numbers, optional
        Values that replace those of the scene's parameters, in the same units.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If the scene has errors; the exception contains all of them, with their places.
    EomcError
        If the file can't be read.
    """
    path, shown = Path(file), texts.line(str(file))
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        others = (p.name for p in path.parent.glob("*.toml") if p.name != "pyproject.toml")
        intended = hints.intended_file(path)
        near = (
            f"; did you mean '{texts.line(intended)}'?" if intended else hints.shipped_remedy(path)
        )
        near = near or suggest(path.name, others)
        raise EomcError(f"{shown}: there is no such file{near}") from None
    except IsADirectoryError:
        raise EomcError(f"{shown}: is a folder: name a scene, such as scenes/NAME.toml") from None
    except (OSError, ValueError) as fault:
        why = getattr(fault, "strerror", None) or fault
        raise EomcError(f"{shown}: can't be read ({why})") from None
    return parse(data, shown, parameters)


def parse(
    data: bytes | str, file: str = "scene.toml", parameters: Mapping[str, float] | None = None
) -> Scene:
    """Parse and check the TOML text of a scene, and return the checked scene.

    file: name of the scene in messages. parameters: values that replace those of the scene's
    parameters. Raises SceneError with all errors in the scene.
    """
    if isinstance(data, str):
        data = data.encode(errors="surrogatepass")
    text, tree = toml_text.text_and_tree(data, file)
    check = _SceneChecker(tree, SourceMap(text, file), parameters or {})
    return check.scene(hashlib.sha256(data).hexdigest())


def check_tree(tree: dict[str, Any], places: SourceMap) -> Scene:
    """Check a scene that is given as a tree of dicts and lists, and return the checked scene.

    tree: as TOML text would be parsed, or with instances of Formula; it may be changed. places:
    places of errors. Raises SceneError with all errors in the scene.
    """
    return _SceneChecker(tree, places, {}).scene("")


class _SceneChecker(ValueChecker):
    """Checks one scene, and collects all errors."""

    def __init__(
        self, tree: dict[str, Any], places: SourceMap, parameters: Mapping[str, float]
    ) -> None:
        super().__init__(places)
        self.values = parameters
        _repair_tables(tree, self)
        if not expand(tree, self):
            raise SceneError(self.problems)
        self.bodies = bool(tree.get("body"))
        self.doc = schema.read(tree, self)
        self.tables = self._names()

    def scene(self, digest: str) -> Scene:
        """Return the checked scene. Raises SceneError with all errors in it.

        digest: SHA-256 of the scene's text, stored in the scene.
        """
        doc = self.doc
        self.kinds |= {
            **dict.fromkeys((*doc.constants, *doc.parameters), NOTHING),
            **dict.fromkeys(doc.inputs, frozenset({INPUT})),
            **dict.fromkeys(doc.coordinates, frozenset({POSITION})),
            **{f"{c}_dot": frozenset({VELOCITY}) for c in doc.coordinates},
            "t": frozenset({TIME}),
        }
        self.centers = validate_bodies.center_names(doc)
        self.kinds |= dict.fromkeys(self.centers - {*self.tables}, frozenset({POSITION}))
        constants, parameters = self._quantities("constants"), self._quantities("parameters")
        coordinates = list(validate_tables.check_coordinates(self))
        self._definitions()
        inputs = self._inputs()
        energies = {key: self._energy(key) for key in ("kinetic", "potential", "dissipation")}
        forces = self._forces()
        assembly = validate_bodies.assemble(self)
        events = list(validate_tables.check_events(self))
        constraints = list(validate_tables.check_constraints(self))
        validate_tables.check_guesses(self)
        run = self._run()
        picture = validate_tables.check_picture(self)
        outputs = self._outputs(validate_tables.force_names(doc, assembly))
        self._check_requests()
        self._warn_unused()
        if any(p.severity == "error" for p in self.problems):
            raise SceneError(self.problems)
        return Scene(
            name=doc.name,
            title=doc.title or doc.name.replace("_", " ").capitalize(),
            note=doc.note,
            file=self.places.file,
            digest=digest,
            coordinates=tuple(coordinates),
            parameters=tuple(parameters),
            constants=tuple(constants),
            inputs=tuple(inputs),
            definitions=tuple(self.definitions.items()),
            **energies,
            forces=forces,
            outputs=tuple(outputs),
            events=tuple(events),
            constraints=tuple(constraints),
            run=run,
            assembly=assembly,
            picture=picture,
            places=self.places,
            warnings=tuple(self.problems),
            used=dict(self.used),
        )

    def _run(self) -> RunSettings:
        """Return the settings of a run; the method "auto" requires adaptive steps."""
        settings = self.doc.run
        sticks, tolerance = settings.friction == "stick", settings.tolerance
        if "auto" in settings.methods and tolerance is None:
            tolerance = schema.DEFAULT_TOLERANCE[settings.real]
        if settings.real == "float" and (tolerance or 1) < schema.MIN_FLOAT_TOLERANCE:
            least = schema.MIN_FLOAT_TOLERANCE
            why = f'a float can keep {least:g} at best: take that, or real = "double"'
            self.report(("run", "tolerance"), why)
        frictions: list[object] = [c.friction for c in self.doc.coordinates.values()]
        frictions += [body.friction for body in self.doc.body.values()]
        if sticks and all(friction is None for friction in frictions):
            why = "there is no friction: add it to a [[body]] with a joint, or to a coordinate"
            self.report(("run", "friction"), why)
        for key in ("linearize", "discretize"):
            if sticks and getattr(settings, key):
                why = 'friction that sticks has no derivatives: take friction = "smooth" for that'
                self.report(("run", key), why)
        methods = tuple(m for m in settings.methods if m != "auto") or ("rk4",)
        return replace(settings, methods=methods, tolerance=tolerance)

    # document and names

    def _names(self) -> dict[str, str]:
        """Return the table of every declared name."""
        doc = self.doc
        if why := names.module_fault(doc.name):
            self.report(("name",), why, text=doc.name)
        taken = {f"{name}_dot": f"is the velocity of '{name}'" for name in doc.coordinates}
        tables_by_name: dict[str, str] = {}
        for table in ("coordinates", "parameters", "constants", "inputs", "definitions"):
            for name in getattr(doc, table):
                self.claim((table, name), name, taken, f"stands in [{table}] already")
                tables_by_name.setdefault(name, table)
        columns = {n: t for n, t in tables_by_name.items() if t not in ("constants", "definitions")}
        taken = validate_tables.names_in_use(doc, columns)
        for name in doc.outputs:
            self.claim(("outputs", name), name, taken, "stands in [outputs] already")
        for table in ("coordinates", "parameters", "constants", "inputs", "constraints"):
            for name, entry in getattr(doc, table).items():
                self._unit((table, name), entry.unit, getattr(entry, "start", 0))
        # the formula of an output may convert to any unit; a coordinate by itself does not
        states = {*doc.coordinates, *(f"{name}_dot" for name in doc.coordinates)}
        for name, output in doc.outputs.items():
            if (formula := str(output.formula).strip()) in states:
                self._unit(("outputs", name), output.unit, formula=formula)
        return tables_by_name

    def _unit(self, path: tuple[str, ...], unit: str, start: Value = 0, formula: str = "") -> None:
        """Report a unit that suggests a conversion: units are text, nothing is converted.

        `formula` is the coordinate or velocity that an output consists of.
        """
        plain = unit.strip().lower()
        if hints.is_in_degrees(unit):
            number = f"{start:g}" if isinstance(start, float) and start else "30"
            remedy = f'write {number} degrees as {hints.degrees_formula(number)}, with unit = "rad"'
            remedy = f'write formula = "{formula}*180/pi"' if formula else remedy
            self.report((*path, "unit"), f"angles are in radians, nothing is converted: {remedy}")
        elif plain in hints.NOT_SI:
            message = (
                f"'{unit}' is not an SI unit: numbers are taken as they stand, none is converted"
            )
            self.report((*path, "unit"), message, severity="warning")

    # tables

    def _quantities(self, table: str) -> list[Quantity]:
        """Check constants (over earlier ones) or parameters (over constants); extends `known`."""
        known = self.known
        rule = "a constant is made of numbers and of constants above it"
        allowed: Collection[str] = known
        if table == "parameters":
            rule = "a parameter's value is made of numbers and constants; "
            rule += "what depends on other parameters is a definition"
            allowed = list(known)
        out = []
        for name, entry in getattr(self.doc, table).items():
            path = (table, name, "value")
            formula = self.formula(path, entry.value, allowed, rule)
            known[name] = self.number(path, formula, known)
            if table == "parameters":
                known[name] = self.values.get(name, known[name])
            if formula:
                out.append(Quantity(name, entry.unit, known[name], entry.note, formula))
        return out

    def _definitions(self) -> None:
        parsed = {n: self.parse(("definitions", n), v) for n, v in self.doc.definitions.items()}
        sound = {name: formula for name, formula in parsed.items() if formula}
        circular = self._find_circular(sound)
        self.kinds |= dict.fromkeys(circular, frozenset({UNKNOWN}))
        for name in parsed:
            formula = sound.get(name)
            path = ("definitions", name)
            if formula is None or name in circular or path in self.repaired:
                self.kinds[name] = frozenset({UNKNOWN})
            elif self.check_names(path, formula):
                self.definitions[name] = formula
                self.kinds[name] = self.kinds_of(formula.tree)
            else:
                self.kinds[name] = frozenset({UNKNOWN})

    def _find_circular(self, definitions: Mapping[str, Formula]) -> set[str]:
        """Return names that depend on themselves; each cycle is reported, at most 50 of them."""
        graph = {
            name: [n.id for n in formula.names() if n.id in definitions]
            for name, formula in definitions.items()
        }
        circular: set[str] = set()
        for count, cycle in enumerate(find_cycles(graph)):
            if count == SceneError.MAX_SHOWN:
                return set(definitions)
            formula = definitions[cycle[0]]
            self.report(
                ("definitions", cycle[0]),
                f"circular definition: {cycle_text(cycle)}; one of them must stand on its own",
                next(n for n in formula.names() if n.id == cycle[1]),
                formula.text,
            )
            circular.update(cycle)
        return circular

    def _inputs(self) -> list[SceneInput]:
        allowed = [name for name, kinds in self.kinds.items() if INPUT not in kinds]
        rule = "a signal can't depend on inputs"
        out = []
        for name, entry in self.doc.inputs.items():
            signal = self.formula(("inputs", name, "signal"), entry.signal, allowed, rule)
            limits = self._limits(("inputs", name, "limits"), entry.limits)
            if signal:
                out.append(SceneInput(name, entry.unit, signal, entry.note, limits))
        return out

    def _limits(
        self, path: tuple[str, ...], limits: Sequence[Value | None]
    ) -> tuple[Formula | None, ...]:
        """Return an input's checked limits, which must be in order at the parameters' values."""
        checked = [None if x is None else self.value(path, x) for x in limits]
        values = [pair[1] for pair in checked if pair]
        if len(values) == 2 and values[0] >= values[1]:
            why = f"the least value, {values[0]:g}, is not below the largest, {values[1]:g}"
            self.report(path, why)
        return tuple(pair and pair[0] for pair in checked)

    def _energy(self, key: str) -> Formula:
        path = ("energy", key)
        formula = self.formula(path, getattr(self.doc.energy, key))
        if formula is None:
            return formulas.parse("0")
        kinds = self.kinds_of(formula.tree)
        sure = UNKNOWN not in kinds and not {path, ("energy",)} & self.repaired
        fault = partial(self.report, path, text=formula.text)
        why = "an energy can't depend on inputs: let them act through [forces]"
        self.depends_on(path, formula, INPUT, why)
        if key == "kinetic" and VELOCITY not in kinds and sure and not self.bodies:
            velocities = " or ".join(f"{c}_dot" for c in self.doc.coordinates)
            remedy = f"use {velocities}, or dot(...) of a definition"
            if any(f"{c}_dot" in str(self.doc.energy.potential) for c in self.doc.coordinates):
                remedy = "are kinetic and potential swapped?"
            fault(f"the kinetic energy has no velocities, so nothing has inertia: {remedy}")
        if key == "dissipation" and VELOCITY not in kinds and sure and any(formula.names()):
            fault(
                "the dissipation has no velocities, so it gives no force -dR/dq_dot: "
                "viscous friction is b*x_dot**2/2",
            )
        self.check_smooth(path, formula)
        return formula

    def _forces(self) -> dict[str, Formula]:
        out = {}
        for name, value in self.doc.forces.items():
            formula = self.formula(("forces", name), value)
            if self.is_coordinate(("forces", name), name) and formula:
                out[name] = formula
        return out

    def _outputs(self, forces: Sequence[str]) -> list[NamedFormula]:
        """Check the outputs, whose formulas may use all quantities of the motion."""
        self.allow_solved_quantities([f"{name}_ddot" for name in self.doc.coordinates], forces)
        out = []
        for name, entry in self.doc.outputs.items():
            path = ("outputs", name, "formula")
            if validate_tables.reports_unknown_multiplier(self, path, entry.formula, forces):
                continue
            formula = self.formula(path, entry.formula)
            if name in self.centers and formula and formula.text.strip() != name:
                why = f"'{name}' is a place of a body or point already: use that, or another name"
                self.report(("outputs", name), why)
            if formula:
                out.append(NamedFormula(name, entry.unit, formula, entry.note))
        return out

    def _check_requests(self) -> None:
        """Report settings of [run] that request bodies or points which do not exist."""
        run, doc = self.doc.run, self.doc
        for key in ("frames", "momentum"):
            if getattr(run, key) and not doc.body:
                why = f"'{key}' is of bodies, and there is no [[body]]: remove it, or name what is "
                self.report(("run", key), f"{why}asked for in [outputs]")
                return
        known = [entry.name for table in (doc.body, doc.point) for entry in table.values()]
        for name in run.frames if isinstance(run.frames, tuple) else ():
            if name not in known:
                remedy = suggest(name, known) or f": known are {', '.join(known[:9])}"
                message = f"'{name}' is no body or point{remedy}"
                self.report(("run", "frames"), message, text=name)

    def _warn_unused(self) -> None:
        if any(p.severity == "error" for p in self.problems):
            return  # a name may be unused only because its formula was refused
        for name, table in self.tables.items():
            if table != "coordinates" and name not in self.used:
                self.report(
                    (table, name),
                    f"'{name}' is not used by any formula: remove it, or use it",
                    severity="warning",
                )


def _repair_tables(tree: dict[str, Any], check: Checker) -> None:
    """Report unknown tables that newcomers often write, and remove them from the tree of a scene.

    If an unknown table probably stands for a valid one, its entries are moved to the valid table,
    so that they can be checked. check: object that collects the errors.
    """
    for name in [n for n, entry in tree.items() if isinstance(entry, (dict, list))]:
        if match := hints.merge_array(name, tree[name]):
            table, entries = match
            check.report((name,), hints.one_table_message(name, table))
            check.repaired |= {(table,), *((table, key) for key in entries)}
            del tree[name]
            existing = tree.get(table)
            tree[table] = {**entries, **(existing if isinstance(existing, dict) else {})}
            check.places.rename((name,), (table,))
        elif name in hints.TABLES:
            check.report((name,), f"there is no [{name}] in a scene: {hints.TABLES[name]}")
            del tree[name]
            if hints.TABLES[name] == hints.ENERGY:
                tree.setdefault("energy", {"kinetic": "0"})
                check.repaired.add(("energy",))


_PLAIN = ("definitions", "forces")  # tables with formulas as entries
_WORDS = ("unit", "note", "title", "repeat")  # keys with free text
# no formulas
_NAMED = ("body", "point", "loop")  # arrays whose entries have names
_NAMES = ("name", "parent", "joint", "coordinate", "bodies", "body", "frame")

_INDEXED = re.compile(r"(?<!\w)([A-Za-z_]\w*)\s*\[([^\[\]]*)\]", re.ASCII)
_REPEAT = re.compile(r"\s*([A-Za-z_]\w*)\s*=(.*?)\.\.(.*)", re.ASCII | re.DOTALL)
_WRITTEN = 'is written repeat = "i = 1..n"'


def expand(tree: dict[str, Any], check: Checker) -> bool:
    """Expand all repeated entries and indexed names of a scene, in place.

    tree: the scene as parsed from TOML, which is changed. check: object that collects the errors.
    Returns False if there were errors that prevent further checks, else True.
    """
    return _Expansion(tree, check).run()


class _Expansion:
    """Expands the repeated entries and indexed names of one scene."""

    MAX_ENTRIES = 10_000  # produced by repetition
    MAX_TEXT = 5_000_000  # characters produced by repetition

    def __init__(self, tree: dict[str, Any], check: Checker) -> None:
        self.tree = tree
        self.check = check
        self.constants: dict[str, float] = {}  # values of constants so far
        self.declared: dict[str, str] = {}
        self.entry_count = 0
        self.characters = 0
        self.sound = True

    def run(self) -> bool:
        """Expand all entries in place; return True if there were no errors."""
        for written, array_name in hints.ARRAYS.items():
            if isinstance(self.tree.get(written), (dict, list)) and array_name not in self.tree:
                entries, unknown = self.tree.pop(written), f"unknown table '{written}': "
                if not _is_array(entries):
                    self._report((written,), unknown + _array_remedy(array_name, entries))
                    continue
                self.check.report((written,), f"{unknown}write [[{array_name}]]")
                self.tree[array_name] = entries
                self.check.places.rename((written,), (array_name,))
        for table in schema.REPEATABLE_TABLES:
            if isinstance(self.tree.get(table), dict):
                self.declared |= dict.fromkeys(self.tree[table], table)
        for table in schema.REPEATABLE_TABLES:
            if isinstance(self.tree.get(table), dict):
                self.tree[table] = self._expand_table(table, self.tree[table])
        for array in ARRAYS:
            if array in self.tree:
                self.tree[array] = self._expand_array(array, self.tree[array])
        for key in ("energy", "gravity"):
            if key in self.tree:
                self.tree[key] = self._expand_once((key,), self.tree[key])
        return self.sound

    def _report(
        self, path: KeyPath, message: str, at: FormulaError | None = None, text: str = ""
    ) -> None:
        self.sound = False
        self.check.report(path, message, at, text)

    def _expand_table(self, table: str, entries: Mapping[str, Any]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, value in entries.items():
            path = (table, key)
            if not (isinstance(value, dict) and "repeat" in value):
                name = self._expand_once(path, key, bare=False)
                new_entries = [(name, self._expand_once(path, value))]
            else:
                if table in _PLAIN and "value" not in value:
                    self._report(path, 'missing: add value = "..." to repeat')
                    continue
                new_entries = self._repeat_entry(path, key, value)
                if table in _PLAIN:
                    new_entries = [(name, entry["value"]) for name, entry in new_entries]
            self.check.places.repeat(path, [(table, name) for name, _ in new_entries])
            for name, entry in new_entries:
                if name in out:
                    self._report(path, f"'{name}' stands here a second time: remove one of the two")
                out[name] = entry
                if table == "constants":
                    self._store_constant(name, entry)
        return out

    def _store_constant(self, name: str, entry: Any) -> None:
        """Store a constant's value; if it has none, that is reported later."""
        value = entry.get("value") if isinstance(entry, dict) else entry
        try:
            formula = formulas.parse(value if isinstance(value, str) else repr(value))
            if all(node.id in self.constants for node in formula.names()):
                self.constants[name], _ = value_of(formula, self.constants)
        except (FormulaError, KeyError):
            return

    def _expand_array(self, array: str, entries: Any) -> dict[str, Any]:
        if not _is_array(entries):
            self._report((array,), _array_remedy(array, entries))
            return {}
        out: dict[str, Any] = {}
        places = self.check.places
        for k, entry in enumerate(entries, start=1):
            written = (array, f"#{k}")
            name = entry.get("name") if array in _NAMED else None
            shown = (array, name if isinstance(name, str) and name else str(len(out) + 1))
            places.repeat(written, [shown])
            if "repeat" in entry:
                new_entries = [e for _, e in self._repeat_entry(shown, name, entry)]
            else:
                new_entries = [self._expand_once(shown, entry)]
            labels = []
            for each in new_entries:
                label = each.get("name") if array in _NAMED else None
                if not isinstance(label, str) or not label or label in out:
                    label = str(len(out) + 1)
                out[label] = each
                labels.append((array, label))
            places.repeat(written, labels)
        return out

    def _repeat_entry(
        self, path: KeyPath, key: Any, entry: dict[str, Any]
    ) -> list[tuple[str, Any]]:
        """Expand an entry with `repeat` into (name, entry) pairs."""
        key = key if isinstance(key, str) else ""
        text = entry["repeat"]
        try:
            index, first, last = self._parse_repeat(text)
        except FormulaError as fault:
            self._report((*path, "repeat"), fault.message, fault, str(text))
            return []
        without_repeat = {k: v for k, v in entry.items() if k != "repeat"}
        out = []
        for number in range(first, last + 1):
            expanded = self._expand(path, without_repeat, {index: number})
            name = self._expand(path, key, {index: number}, bare=False)
            if expanded is None or name is None:
                return []
            out.append((name, expanded))
        if len(out) > 1 and key and out[0][0] == out[-1][0]:
            self._report(path, f"each repetition needs a name of its own: write {key}[{index}]")
            return []
        return out

    def _parse_repeat(self, text: Any) -> tuple[str, int, int]:
        """Return the index of a repetition, its first and its last value. Raises FormulaError."""
        if not isinstance(text, str):
            raise FormulaError(f'must be text, such as "i = 1..n", here {text!r:.40}')
        match, width = _REPEAT.fullmatch(text), len(text)
        if not match:
            raise FormulaError(f"'{text}' is no repetition, which {_WRITTEN}", 0, width)
        index = match[1]
        if why := self._index_fault(index):
            raise FormulaError(why, match.start(1), len(index))
        try:
            first, last = (self._index_value(match[k].strip(), {}) for k in (2, 3))
        except FormulaError as fault:
            raise FormulaError(fault.message, 0, width) from None
        if last < first - 1:
            why = f"runs from {first} to {last}, and counts up only: exchange the ends"
            raise FormulaError(why, 0, width)
        self.entry_count += last - first + 1
        if self.entry_count > self.MAX_ENTRIES:
            raise FormulaError(
                f"repetition makes {self.entry_count} entries up to here, and "
                f"{self.MAX_ENTRIES} are the most: let it end sooner",
                0,
                width,
            )
        return index, first, last

    def _index_fault(self, index: str) -> str:
        if index in self.declared:
            return f"'{index}' stands in [{self.declared[index]}] too: use another index, such as k"
        if names.fault(index) or index in ("x", "y", "z", *formulas.FUNCTIONS):
            return f"'{index}' can't be an index: use another, such as i"
        return ""

    def _expand_once(self, path: KeyPath, value: Any, bare: bool = True) -> Any:
        """Return a value outside of repetition with its indices expanded."""
        expanded = self._expand(path, value, {}, bare)
        return value if expanded is None else expanded

    def _expand(
        self, path: KeyPath, value: Any, index: Mapping[str, int], bare: bool = True
    ) -> Any:
        """Return the value with its indices expanded; None after an error, which is reported."""
        if isinstance(value, str):
            try:
                text = self._expand_text(value, index, bare)
            except FormulaError as fault:
                self._report(path, fault.message, fault, value)
                return None
            if text != value:
                self.check.places.rewrite(text, value)
            return text
        if isinstance(value, list):
            inside = [self._expand(path, each, index, bare) for each in value]
            return None if None in inside else inside
        if isinstance(value, dict):
            out = {}
            for key, each in value.items():
                expanded = each
                if key not in _WORDS:
                    expanded = self._expand((*path, key), each, index, bare and key not in _NAMES)
                if expanded is None:
                    return None
                out[key] = expanded
            return out
        return value

    def _expand_text(self, text: str, index: Mapping[str, int], bare: bool) -> str:
        """Return a formula or name with its indices expanded. Raises FormulaError."""
        if len(text) > formulas.MAX_LENGTH or not (index or "[" in text):
            return text  # too long ones are reported later

        def replace_index(match: re.Match[str]) -> str:
            name, inside = match[1], match[2]
            at, width = match.start(), len(match[0])
            try:
                number = self._index_value(inside, index)
            except FormulaError as fault:
                raise FormulaError(fault.message, at, width) from None
            if name[-1].isdigit():
                raise FormulaError(
                    f"'{match[0]}' would be {name}{number}, as others may be: a name with an index "
                    f"can't end in a digit, {name}_[{inside}] is {name}_{number}",
                    at,
                    width,
                )
            if number < 0:
                raise FormulaError(
                    f"the index of '{match[0]}' is {number}: it can't be negative", at, width
                )
            return f"{name}{number}"

        out = _INDEXED.sub(replace_index, text)
        for name, number in index.items() if bare else ():
            shown = str(number) if number >= 0 else f"({number})"
            out = re.sub(rf"(?<![\w.]){name}(?!\w)", shown, out, flags=re.ASCII)
        self.characters += len(out) if index else 0
        if self.characters > self.MAX_TEXT:
            raise FormulaError(f"repetition makes more than {self.MAX_TEXT:,} characters of text")
        return out

    def _index_value(self, text: str, index: Mapping[str, int]) -> int:
        """Return the value of an index or bound: a formula of constants and of the index."""
        formula = _parse_index(text)
        known = {**self.constants, **index}
        for node in formula.names():
            if node.id not in known:
                raise FormulaError(self._unknown_name(node.id, index))
            if node.id not in index:
                self.check.used[node.id].append(("constants", node.id))
        value, fault = value_of(formula, known)
        if fault:
            raise FormulaError(fault)
        if not value.is_integer() or abs(value) >= 1e10:
            rule = "and an index is a whole number of at most ten digits"
            raise FormulaError(f"'{formula.shown}' is {value:g}, {rule}")
        return int(value)

    def _unknown_name(self, name: str, index: Mapping[str, int]) -> str:
        """Return why a name can't be used in an index."""
        table = self.declared.get(name)
        if table == "constants":
            return f"'{name}' has no value here: move its line above this one"
        if table:
            return (
                f"'{name}' stands in [{table}], and what is repeated is decided when the code is "
                "made: only [constants] can count"
            )
        remedy = suggest(name, [*index, *self.constants]) or ": declare it in [constants]"
        if name != "n" and len(name) == 1 and not index and remedy.startswith(":"):
            remedy += f', or add repeat = "{name} = 1..n" to the entry'
        return f"'{name}' is not known in an index{remedy}"


@lru_cache(maxsize=1_000)  # the same text in each copy of an entry
def _parse_index(text: str) -> Formula:
    formula = formulas.parse(text)
    if any(formula.calls("dot")):
        raise FormulaError("dot(...) can't be used in an index")
    return formula


def _array_remedy(array: str, entries: Any) -> str:
    """Return the message for [array] in single brackets."""
    inner = isinstance(entries, dict) and all(isinstance(e, dict) for e in entries.values())
    named = (
        f' and name = "{next(iter(entries))}"'
        if inner and entries and array in (*_NAMED, "event")
        else ""
    )
    return f"each {array} has a table of its own: write [[{array}]]{named}"


def _is_array(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)
