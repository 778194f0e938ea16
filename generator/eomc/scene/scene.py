"""A scene file, read and checked: data, with every fault told at its place. No SymPy, no C."""

from __future__ import annotations

import hashlib
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import pydantic

from eomc.base import names, texts
from eomc.base.errors import MOST, EomcError, Problem, SceneError
from eomc.scene import formulas, messages, repeat, schema, validate_bodies
from eomc.scene.assembly import Assembly
from eomc.scene.formulas import Formula, suggest
from eomc.scene.scope import (
    DOUBT,
    INPUT,
    NOTHING,
    POSITION,
    TIME,
    VELOCITY,
    Checker,
    value_of,
)
from eomc.scene.source_map import Places
from eomc.scene.toml_text import MAX_BYTES, MOST_PARTS, long_key

# --- what a checked scene is ------------------------------------------------------------------


@dataclass(frozen=True)
class Coordinate:
    """A generalized coordinate; its velocity is `<name>_dot`. Start in `unit`, rate in unit/s."""

    name: str
    unit: str
    start: Formula
    rate: Formula
    note: str


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
    """A quantity given from outside at every step; `signal` is what it is by default."""

    name: str
    unit: str
    signal: Formula
    note: str


@dataclass(frozen=True)
class Run:
    """How the scene is run unless the caller says otherwise: step size h and duration in s.

    methods: the steppers wanted, the one that runs use first. real: the C type that everything
    is computed in. batch: whether many trajectories at once are wanted. linearize: whether the
    derivatives of the accelerations are, "parameters" for those by parameters too.
    """

    h: float = 0.001
    duration: float = 10.0
    methods: tuple[str, ...] = ("rk4",)
    real: str = "double"
    batch: bool = False
    linearize: bool | str = False


@dataclass(frozen=True)
class Scene:
    """A checked scene: nothing in it is undeclared, circular, misspelt or of the wrong kind."""

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
    run: Run
    assembly: Assembly | None
    places: Places = field(repr=False, compare=False)
    warnings: tuple[Problem, ...] = ()

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


# --- reading --------------------------------------------------------------------------------------


def read(file: str | os.PathLike[str], parameters: Mapping[str, float] | None = None) -> Scene:
    """Read and check a scene file, with other values in place of those of its parameters.

    Raises SceneError with every fault, EomcError if unreadable.
    """
    path, shown = Path(file), texts.line(str(file))
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        others = (p.name for p in path.parent.glob("*.toml") if p.name != "pyproject.toml")
        meant = messages.file(path)
        near = f"; did you mean '{texts.line(meant)}'?" if meant else suggest(path.name, others)
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
    """Check the text of a scene, as `read` does. Raises SceneError with every fault."""
    if isinstance(data, str):
        data = data.encode(errors="surrogatepass")
    if len(data) > MAX_BYTES:
        shown = texts.line(file)
        raise EomcError(f"{shown}: it has more than the {MAX_BYTES} bytes a scene may have")
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as fault:
        raise SceneError([_encoding_problem(data, fault.start, file)]) from None
    if not text.strip():
        raise SceneError(
            [Problem("the file is empty: 'eomc new NAME' writes a scene to start from", file=file)]
        )
    if line := long_key(text):
        message = f"a key has more than {MOST_PARTS} parts: a scene's have three, a.b.c, at most"
        source = text.split("\n")[line - 1].rstrip()
        raise SceneError([Problem(message, "", file, line, 0, len(source), source)])
    try:
        tree = tomllib.loads(text)
    except ValueError as fault:
        raise SceneError([_toml_problem(fault, text, file)]) from None
    except RecursionError:
        raise SceneError([Problem("the TOML is nested too deeply", file=file)]) from None
    if _has_huge(tree):
        raise SceneError([_huge_problem(text, file)])
    check = _Check(tree, Places(text, file), parameters or {})
    return check.scene(hashlib.sha256(data).hexdigest())


def _encoding_problem(data: bytes, at: int, file: str) -> Problem:
    start = data.rfind(b"\n", 0, at) + 1
    source = data[start:].split(b"\n")[0].decode("utf-8", "replace").rstrip()
    column = len(data[start:at].decode())
    line = data[:start].count(b"\n") + 1
    return Problem(
        "the file is not UTF-8 text: save it as UTF-8", "", file, line, column, source=source
    )


def _has_huge(tree: dict[str, Any]) -> bool:
    """Whether there is a whole number beyond all doubles; Python may not even print one."""
    left: list[Any] = [tree]
    while left:
        value = left.pop()
        if isinstance(value, dict):
            left += value.values()
        elif isinstance(value, list):
            left += value
        elif isinstance(value, int) and value.bit_length() > 1024:
            return True
    return False


def _huge_problem(text: str, file: str) -> Problem:
    long = re.search(r"(?i)=[^\"'\n]*?\b(0x[\da-f_]{250}|[\d_]{300}|0o[\d_]{300})", text)
    line = text.count("\n", 0, long.start(1)) + 1 if long else 0
    return Problem(
        "a number has hundreds of digits, more than any double: shorten it", "", file, line
    )


def _toml_problem(fault: ValueError, text: str, file: str) -> Problem:
    """tomllib's message, its place, and what is mostly meant by it."""
    if not isinstance(fault, tomllib.TOMLDecodeError):  # an int beyond Python's 4,300 digits
        return _huge_problem(text, file)
    lines = text.split("\n")
    found = re.search(r" \(at line (\d+), column (\d+)\)", str(fault))
    line, column = (int(found[1]), int(found[2]) - 1) if found else (len(lines), -1)
    message = re.sub(r" \(at .*\)", "", str(fault))
    source = lines[line - 1].rstrip()
    key = re.match(r"\s*([^=\s]+)\s*=", source)
    width = 1
    if re.match(r"\s*[^\s\"'=#]*[^\x00-\x7f]", source):
        remedy = ": bare keys are ASCII, write Greek letters out (theta)"
    elif "overwrite" in message and key:
        remedy = f": '{key[1]}' stands here a second time, remove one of the two"
        column, width = key.start(1), len(key[1])
    elif "Cannot declare" in message:
        remedy = ": a [table] stands once, put its entries together"
        column, width = 0, len(source)
    else:
        told = messages.bare(source)
        remedy = next((r for m, r in _TOML_REMEDIES.items() if m in message), "")
        remedy = f": {told}" if told else remedy
    return Problem(f"not TOML: {message}{remedy}", "", file, line, column, width, source)


_TOML_REMEDIES = {
    "Invalid value": ": formulas stand in quotes, numbers have digits on both sides of the point",
    "Expected newline": ": one entry a line, comments begin with '#', decimals are written 9.81",
    "Illegal character '\\n'": ": is a closing quote missing in this line?",
    "Unescaped '\\'": ": LaTeX is not read, write names without backslash (theta)",
    "Unclosed inline table": ": entries in { ... } are separated by commas and stand on one line",
}


class _Check(Checker):
    """Everything that is checked in one scene, faults collected on the way."""

    def __init__(
        self, tree: dict[str, Any], places: Places, parameters: Mapping[str, float]
    ) -> None:
        super().__init__(places)
        self.values = parameters
        messages.tables(tree, self)
        if not repeat.expand(tree, self):
            raise SceneError(self.problems)
        self.bodies = bool(tree.get("body"))
        self.doc = self._layout(tree)
        self.tables = self._names()

    def scene(self, digest: str) -> Scene:
        """The checked scene. Raises SceneError with every fault."""
        doc = self.doc
        self.kinds |= {
            **dict.fromkeys((*doc.constants, *doc.parameters), NOTHING),
            **dict.fromkeys(doc.inputs, frozenset({INPUT})),
            **dict.fromkeys(doc.coordinates, frozenset({POSITION})),
            **{f"{c}_dot": frozenset({VELOCITY}) for c in doc.coordinates},
            "t": frozenset({TIME}),
        }
        self.centers = validate_bodies.centers(doc)
        self.kinds |= dict.fromkeys(self.centers - {*self.tables}, frozenset({POSITION}))
        known: dict[str, float] = {}
        constants = self._quantities("constants", known)
        parameters = self._quantities("parameters", known)
        coordinates = self._coordinates(known)
        self._definitions()
        inputs = self._inputs()
        energies = {key: self._energy(key) for key in ("kinetic", "potential", "dissipation")}
        forces = self._forces()
        assembly = validate_bodies.assemble(self, doc, known)
        self._unused()
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
            run=Run(
                doc.run.h,
                doc.run.duration,
                doc.run.method,
                doc.run.real,
                doc.run.batch,
                doc.run.linearize,
            ),
            assembly=assembly,
            places=self.places,
            warnings=tuple(self.problems),
        )

    # layout and names

    def _layout(self, tree: dict[str, Any]) -> schema.Document:
        """The document; faulty entries are told, taken out or mended, and the rest checked on."""
        for _ in range(100):
            try:
                return schema.read(tree)
            except pydantic.ValidationError as fault:
                errors = fault.errors()
            # misspelt keys first: what is missing may only be misspelt
            errors.sort(key=lambda error: error["type"] != "extra_forbidden")
            told: set[tuple[str, ...]] = set()
            for error in errors:
                path = schema.place(error)
                if path in told or (error["type"] == "missing" and schema.has(tree, path)):
                    continue
                told.add(path)
                self.say(path, schema.say(error, path))
                if error["type"] == "extra_forbidden":
                    self._misspelt(tree, path)
                else:
                    self.mended.add(path)
                    schema.mend(tree, path)
            if ("coordinates",) in self.mended:
                break  # everything else hangs on them
        raise SceneError(self.problems)

    def _misspelt(self, tree: dict[str, Any], path: tuple[str, ...]) -> None:
        """Take an unknown key for the one that was meant, or out."""
        table = schema.table_at(tree, path[:-1])
        value = table.pop(path[-1])
        meant = schema.meant(path)
        if meant and meant not in table:
            table[meant] = value
            self.places.rename(path, (*path[:-1], meant))
        elif isinstance(value, dict):
            self.kinds |= dict.fromkeys(value, frozenset({DOUBT}))

    def _names(self) -> dict[str, str]:
        """Every declared name and its table."""
        doc = self.doc
        if why := names.module_fault(doc.name):
            self.say(("name",), why, text=doc.name)
        seen: dict[str, str] = {}
        for table in ("coordinates", "parameters", "constants", "inputs", "definitions"):
            for name in getattr(doc, table):
                if why := names.fault(name):
                    self.say((table, name), why)
                elif name in seen:
                    self.say(
                        (table, name),
                        f"'{name}' stands in [{seen[name]}] already: rename one of the two",
                    )
                seen.setdefault(name, table)
        for name in doc.coordinates:
            velocity = f"{name}_dot"
            if velocity in seen:
                self.say(
                    (seen[velocity], velocity),
                    f"'{velocity}' is the velocity of coordinate '{name}': choose another name",
                )
        for table in ("coordinates", "parameters", "constants", "inputs"):
            for name, entry in getattr(doc, table).items():
                self._unit((table, name), entry.unit, getattr(entry, "start", 0))
        return seen

    def _unit(self, path: tuple[str, ...], unit: str, start: float | str = 0) -> None:
        """Units are texts; those that show that something was meant to be converted are told."""
        plain = unit.strip().lower()
        if plain in ("deg", "degree", "degrees", "°", "deg/s", "°/s"):
            number = f"{start:g}" if isinstance(start, float) and start else "30"
            remedy = f'write {number} degrees as {messages.radians(number)}, with unit = "rad"'
            self.say((*path, "unit"), f"angles are in radians, nothing is converted: {remedy}")
        elif plain in (
            "mm",
            "cm",
            "km",
            "g",
            "gram",
            "ms",
            "min",
            "rpm",
            "inch",
            "ft",
            "lb",
            "lbs",
        ):
            message = (
                f"'{unit}' is not an SI unit: numbers are taken as they stand, none is converted"
            )
            self.say((*path, "unit"), message, severity="warning")

    # tables

    def _quantities(self, table: str, known: dict[str, float]) -> list[Quantity]:
        """Constants may use constants above them; parameters any constant. Adds to `known`."""
        allowed, rule = {
            "constants": (known, "a constant is made of numbers and of constants above it"),
            "parameters": (
                list(known),
                "a parameter's value is made of numbers and constants; "
                "what hangs on other parameters is a definition",
            ),
        }[table]
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

    def _coordinates(self, known: Mapping[str, float]) -> list[Coordinate]:
        def formula(path: tuple[str, ...], value: float | str) -> Formula | None:
            rule = f"a {path[-1]} is made of numbers, constants and parameters"
            found = self.formula(path, value, known, rule)
            self.number(path, found, known)
            return found

        out = []
        for name, entry in self.doc.coordinates.items():
            start = formula(("coordinates", name, "start"), entry.start)
            rate = formula(("coordinates", name, "rate"), entry.rate)
            if start and rate:
                out.append(Coordinate(name, entry.unit, start, rate, entry.note))
        return out

    def _definitions(self) -> None:
        parsed = {n: self.parse(("definitions", n), v) for n, v in self.doc.definitions.items()}
        sound = {name: formula for name, formula in parsed.items() if formula}
        circular = self._circular(sound)
        self.kinds |= dict.fromkeys(circular, frozenset({DOUBT}))
        for name in parsed:
            formula = sound.get(name)
            path = ("definitions", name)
            if formula is None or name in circular or path in self.mended:
                self.kinds[name] = frozenset({DOUBT})
            elif self.checked(path, formula):
                self.definitions[name] = formula
                self.kinds[name] = self.kinds_of(formula.tree)
            else:
                self.kinds[name] = frozenset({DOUBT})

    def _circular(self, definitions: Mapping[str, Formula]) -> set[str]:
        """The names that hang on themselves, each ring told once; beyond MOST, all."""
        graph = {
            name: [n.id for n in formula.names() if n.id in definitions]
            for name, formula in definitions.items()
        }
        lost: set[str] = set()
        for _ in range(MOST):
            try:
                TopologicalSorter(graph).prepare()
                return lost
            except CycleError as cycle:
                ring = list(reversed(cycle.args[1]))
                shown = ring if len(ring) <= 20 else [*ring[:10], "...", *ring[-9:]]
                self.say(
                    ("definitions", ring[0]),
                    f"circular definition: {' -> '.join(shown)}; one of them must stand on its own",
                    next(n for n in definitions[ring[0]].names() if n.id == ring[1]),
                    definitions[ring[0]].text,
                )
                lost.update(ring)
                graph |= {name: [] for name in ring}
        return set(definitions)

    def _inputs(self) -> list[Input]:
        allowed = [name for name, kinds in self.kinds.items() if INPUT not in kinds]
        rule = "a signal can't hang on inputs"
        out = []
        for name, entry in self.doc.inputs.items():
            signal = self.formula(("inputs", name, "signal"), entry.signal, allowed, rule)
            if signal:
                out.append(Input(name, entry.unit, signal, entry.note))
        return out

    def _energy(self, key: str) -> Formula:
        path = ("energy", key)
        formula = self.formula(path, getattr(self.doc.energy, key))
        if formula is None:
            return formulas.parse("0")
        kinds = self.kinds_of(formula.tree)
        sure = DOUBT not in kinds and not {path, ("energy",)} & self.mended
        fault = partial(self.say, path, text=formula.text)
        if INPUT in kinds:
            fault(
                "an energy can't depend on inputs: let them act through [forces]",
                self.where(formula, INPUT),
            )
        if key == "potential" and VELOCITY in kinds:
            fault(
                "the potential energy can't depend on velocities: parts linear in them "
                "(magnetic, gyroscopic) belong in 'kinetic' with the sign changed, "
                "friction in 'dissipation'",
                self.where(formula, VELOCITY),
            )
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
        self.smooth(path, formula)
        return formula

    def _forces(self) -> dict[str, Formula]:
        out = {}
        known = list(self.doc.coordinates)
        for name, value in self.doc.forces.items():
            formula = self.formula(("forces", name), value)
            if name not in known:
                remedy = suggest(name, known) or f": a force acts along {' or '.join(known)}"
                self.say(("forces", name), f"'{name}' is not a coordinate{remedy}")
            elif formula:
                out[name] = formula
        return out

    def _unused(self) -> None:
        if any(p.severity == "error" for p in self.problems):
            return  # a name may be unused only because its formula was refused
        for name, table in self.tables.items():
            if table != "coordinates" and name not in self.used:
                self.say(
                    (table, name),
                    f"'{name}' is not used by any formula: remove it, or use it",
                    severity="warning",
                )
