"""A scene file, read and checked: data, with every fault told at its place. No SymPy, no C."""

from __future__ import annotations

import ast
import hashlib
import math
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from eomc import formulas, names
from eomc.formulas import Formula, FormulaError, suggest
from eomc.problems import EomcError, Problem, SceneError

METHODS = ("rk4",)
MAX_BYTES = 4_000_000

# --- the layout of the file -------------------------------------------------------------------

_Number = Annotated[float, pydantic.Field(strict=True, allow_inf_nan=False)]
_Value = _Number | pydantic.StrictStr
_Positive = Annotated[float, pydantic.Field(strict=True, gt=0, allow_inf_nan=False)]


class _Table(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class _Coordinate(_Table):
    unit: pydantic.StrictStr = ""
    start: _Value = 0.0
    rate: _Value = 0.0
    note: pydantic.StrictStr = ""


class _Quantity(_Table):
    value: _Value
    unit: pydantic.StrictStr = ""
    note: pydantic.StrictStr = ""


class _Input(_Table):
    unit: pydantic.StrictStr = ""
    signal: _Value = 0.0
    note: pydantic.StrictStr = ""


class _Energy(_Table):
    kinetic: _Value
    potential: _Value = 0.0
    dissipation: _Value = 0.0


class _Run(_Table):
    h: _Positive = 0.001
    duration: _Positive = 10.0
    method: Literal[METHODS] = "rk4"  # type: ignore[valid-type]


def _spelled_out(value: object) -> object:
    """`m = 2.0` says the same as `m = { value = 2.0 }`."""
    return value if isinstance(value, dict) else {"value": value}


_Short = Annotated[_Quantity, pydantic.BeforeValidator(_spelled_out)]


class _Document(_Table):
    eomc: Literal[1]
    name: pydantic.StrictStr
    title: pydantic.StrictStr = ""
    note: pydantic.StrictStr = ""
    coordinates: dict[str, _Coordinate] = pydantic.Field(min_length=1)
    parameters: dict[str, _Short] = {}
    constants: dict[str, _Short] = {}
    inputs: dict[str, _Input] = {}
    definitions: dict[str, _Value] = {}
    energy: _Energy
    forces: dict[str, _Value] = {}
    run: _Run = _Run()


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
    """How the scene is run unless the caller says otherwise: step size h and duration in s."""

    h: float = 0.001
    duration: float = 10.0
    method: str = "rk4"


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
    warnings: tuple[Problem, ...] = ()

    def start(self, parameters: Mapping[str, float] | None = None) -> tuple[list[float], list[float]]:
        """q and q_dot at the start, with the given values in place of the parameters' defaults."""
        values = {p.name: p.value for p in (*self.parameters, *self.constants)}
        values.update(parameters or {})
        number = lambda f: formulas.evaluate(f, formulas.NUMERIC, values.__getitem__)  # noqa: E731 - one use, twice
        return (
            [float(number(c.start)) for c in self.coordinates],
            [float(number(c.rate)) for c in self.coordinates],
        )


# --- where things stand in the file -------------------------------------------------------------


class _Places:
    """Line numbers of keys, found by giving tomllib one statement at a time."""

    def __init__(self, text: str, file: str) -> None:
        self.lines = text.split("\n")
        self.file = file
        self._line: dict[tuple[str, ...], tuple[int, int]] = {}
        prefix: tuple[str, ...] = ()
        start = 0
        while start < len(self.lines):
            if self.lines[start].strip().startswith("#") or not self.lines[start].strip():
                start += 1
                continue
            for end in range(start + 1, len(self.lines) + 1):
                statement = "\n".join(self.lines[start:end])
                try:
                    tree = tomllib.loads(statement)
                except tomllib.TOMLDecodeError:
                    continue
                header = statement.lstrip().startswith("[")
                for path in _paths(tree):
                    self._line.setdefault((() if header else prefix) + path, (start, end))
                if header:
                    prefix = next(iter(sorted(_paths(tree), key=len, reverse=True)))
                start = end
                break
            else:
                start += 1

    def problem(
        self,
        path: tuple[str, ...],
        message: str,
        at: FormulaError | ast.expr | None = None,
        text: str = "",
        severity: str = "error",
    ) -> Problem:
        """A problem at a key, with the fault of its formula `text` marked where it can be found."""
        key = ".".join(path)
        known = path
        while known and known not in self._line:
            known = known[:-1]
        if not known:
            return Problem(message, key, self.file, severity=severity)
        start, end = self._line[known]
        for number in range(start, end):
            line = self.lines[number]
            column, width = -1, 1
            quoted = re.search(f"""(["']){re.escape(text)}\\1""", line) if text else None
            if quoted is not None:
                inside = quoted.start() + 1
                if isinstance(at, FormulaError):
                    column, width = inside + at.column, at.width
                elif at is not None:
                    column = inside + at.col_offset
                    width = max((at.end_col_offset or 0) - at.col_offset, 1)
                else:
                    column, width = inside, max(len(text), 1)
            elif text:
                continue
            elif len(path) > len(known) or len(path) > 1:
                last = re.search(rf"(?<![\w.]){re.escape(path[-1])}(?!\w)", line)
                if last is not None:
                    column, width = last.start(), len(path[-1])
            return Problem(
                message, key, self.file, number + 1, column, width, line.rstrip(), severity
            )
        return Problem(
            message, key, self.file, start + 1, source=self.lines[start].rstrip(), severity=severity
        )


def _paths(tree: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for key, value in tree.items():
        yield (key,)
        if isinstance(value, list):
            value = next((v for v in value if isinstance(v, dict)), None)
        if isinstance(value, dict):
            for rest in _paths(value):
                yield (key, *rest)


# --- reading --------------------------------------------------------------------------------------


def read(file: str | os.PathLike[str]) -> Scene:
    """Read and check a scene file. Raises SceneError with every fault, EomcError if unreadable."""
    path = Path(file)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        near = suggest(path.name, (p.name for p in path.parent.glob("*.toml")))
        raise EomcError(f"{file}: there is no such file{near}") from None
    except OSError as fault:
        raise EomcError(f"{file}: can't be read ({fault.strerror})") from None
    return parse(data, str(file))


def parse(data: bytes | str, file: str = "scene.toml") -> Scene:
    """Check the text of a scene. Raises SceneError with every fault."""
    if isinstance(data, str):
        data = data.encode()
    if len(data) > MAX_BYTES:
        raise EomcError(f"{file}: {len(data)} bytes are more than the {MAX_BYTES} a scene may have")
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as fault:
        line = data[: fault.start].count(b"\n") + 1
        raise SceneError(
            [Problem("the file is not UTF-8 text: save it as UTF-8", file=file, line=line)]
        ) from None
    if not text.strip():
        raise SceneError(
            [Problem("the file is empty: 'eomc new NAME' writes a scene to start from", file=file)]
        )
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        raise SceneError([_toml_problem(fault, text, file)]) from None
    except RecursionError:
        raise SceneError([Problem("the TOML is nested too deeply", file=file)]) from None
    return _Check(tree, _Places(text, file), hashlib.sha256(data).hexdigest()).scene()


def _toml_problem(fault: tomllib.TOMLDecodeError, text: str, file: str) -> Problem:
    lines = text.split("\n")
    found = re.search(r" \(at line (\d+), column (\d+)\)", str(fault))
    line, column = (int(found[1]), int(found[2]) - 1) if found else (len(lines), -1)
    message = re.sub(r" \(at .*\)", "", str(fault))
    remedy = ""
    if line <= len(lines):
        if re.match(r"\s*[^\s\"'=]*[^\x00-\x7f]", lines[line - 1]):
            remedy = ": bare keys are ASCII, write Greek letters out (theta)"
        elif "Invalid value" in message:
            remedy = ": formulas stand in quotes, numbers have digits on both sides of the point"
        elif "overwrite" in message or "declare" in message:
            remedy = ": each name and each [table] stands once"
    return Problem(
        f"not TOML: {message}{remedy}",
        file=file,
        line=line,
        column=column,
        source=lines[line - 1].rstrip() if line <= len(lines) else "",
    )


_TABLES = "coordinates parameters constants inputs definitions energy forces run".split()

# the kinds of thing a formula can hang on
_TIME, _INPUT, _POSITION, _VELOCITY = "the time", "inputs", "coordinates", "velocities"


@dataclass
class _Check:
    """Everything that is checked in one scene, faults collected on the way."""

    tree: dict[str, Any]
    places: _Places
    digest: str
    problems: list[Problem] = field(default_factory=list)
    missing: set[tuple[str, ...]] = field(default_factory=set)

    def scene(self) -> Scene:
        self.document = self._layout()
        doc = self.document
        # formulas of definitions and forces, by name, that are free of faults so far
        self._names()
        self.constants = self._quantities("constants", doc.constants)
        self.parameters = self._quantities("parameters", doc.parameters)
        self.kinds: dict[str, frozenset[str]] = {
            **dict.fromkeys((*doc.constants, *doc.parameters), frozenset()),
            **dict.fromkeys(doc.inputs, frozenset({_INPUT})),
            **dict.fromkeys(doc.coordinates, frozenset({_POSITION})),
            **{f"{c}_dot": frozenset({_VELOCITY}) for c in doc.coordinates},
            "t": frozenset({_TIME}),
        }
        self.used: set[str] = set()
        coordinates = self._coordinates()
        definitions = self._definitions()
        inputs = self._inputs()
        zero = formulas.parse("0")
        energies = {}
        for key in ("kinetic", "potential", "dissipation"):
            formula = self._formula(("energy", key), getattr(doc.energy, key))
            if formula:
                self._energy_kinds(key, formula)
            energies[key] = formula or zero
        forces = {
            c: self._formula(("forces", c), value) or zero
            for c, value in doc.forces.items()
            if c in doc.coordinates or self._not_a_coordinate(c)
        }
        self._unused()
        name = doc.name
        self._raise()
        scene = Scene(
            name=name,
            title=doc.title or name.replace("_", " ").capitalize(),
            note=doc.note,
            file=self.places.file,
            digest=self.digest,
            coordinates=tuple(coordinates),
            parameters=tuple(self.parameters),
            constants=tuple(self.constants),
            inputs=tuple(inputs),
            definitions=tuple(definitions.items()),
            **energies,
            forces=forces,
            run=Run(doc.run.h, doc.run.duration, doc.run.method),
            warnings=tuple(self.problems),
        )
        self._start(scene)
        self._raise()
        return scene

    def _raise(self) -> None:
        if any(p.severity == "error" for p in self.problems):
            raise SceneError(self.problems)

    def say(
        self,
        path: tuple[str, ...],
        message: str,
        at: FormulaError | ast.expr | None = None,
        text: str = "",
        severity: str = "error",
    ) -> None:
        self.problems.append(self.places.problem(path, message, at, text, severity))

    # layout

    def _layout(self) -> _Document:
        """The document; faulty entries are told, taken out, and the rest is checked on."""
        for _ in range(100):
            try:
                return _Document.model_validate(self.tree)
            except pydantic.ValidationError as fault:
                told = set()
                for error in fault.errors():
                    path = _clean(error["loc"])
                    if path not in told:
                        told.add(path)
                        self.missing |= {path, (*path, "kinetic")}
                        self.say(path, _say_layout(error, path, self.tree))
                        _mend(self.tree, path, error["type"])
        raise SceneError(self.problems)

    def _names(self) -> None:
        doc = self.document
        if why := names.module_fault(doc.name):
            self.say(("name",), why, text=doc.name)
        seen: dict[str, str] = {}
        for table in ("coordinates", "parameters", "constants", "inputs", "definitions"):
            for name in getattr(doc, table):
                if why := names.fault(name):
                    self.say((table, name), why)
                elif name in seen:
                    self.say((table, name), f"'{name}' stands in [{seen[name]}] already")
                seen.setdefault(name, table)
        for name in doc.coordinates:
            if f"{name}_dot" in seen:
                self.say(
                    (seen[f"{name}_dot"], f"{name}_dot"),
                    f"'{name}_dot' is the velocity of coordinate '{name}': choose another name",
                )

    # formulas

    def _parse(self, path: tuple[str, ...], value: float | str) -> Formula | None:
        text = value if isinstance(value, str) else repr(value)
        try:
            return formulas.parse(text)
        except FormulaError as fault:
            self.say(path, fault.message, fault, text)
            return None

    def _formula(
        self, path: tuple[str, ...], value: float | str, kinds: Mapping[str, frozenset[str]] | None = None
    ) -> Formula | None:
        """Parse a formula and check its names; None where it has a fault, which is told."""
        formula = self._parse(path, value)
        if formula is None:
            return None
        known = self.kinds if kinds is None else kinds
        good = True
        for node in formula.names():
            self.used.add(node.id)
            if node.id not in known:
                good = False
                self.say(path, self._unknown(node.id, known), node, str(value))
        if good:
            good = self._dots(path, formula, str(value))
        return formula if good else None

    def _unknown(self, name: str, known: Iterable[str]) -> str:
        if name in self.kinds:
            return f"'{name}' can't be used here: only {', '.join(known) or 'numbers and pi'}"
        if near := suggest(name, known):
            return f"'{name}' is not declared{near}"
        if name.endswith(("_ddot", "_dot_dot")):
            return f"'{name}' is not declared: accelerations can't stand in a formula, they are what is solved for"
        if name.endswith("_dot") and name[:-4] in self.kinds:
            return (
                f"'{name}' is not declared: only coordinates have velocities, "
                f"write dot({name[:-4]}) for the derivative of a definition"
            )
        if name in ("e", "E"):
            return f"'{name}' is not declared: write exp(1), or declare it in [constants]"
        return f"'{name}' is not declared: add it to [parameters], [constants], [inputs] or [definitions]"

    def kinds_of(self, formula: Formula) -> frozenset[str]:
        """What the value of the formula hangs on; dot(e) brings velocities where e moves."""
        found: set[str] = set()
        for node in formula.names():
            found |= self.kinds.get(node.id, frozenset())
        for call in formula.calls("dot"):
            if _POSITION in self.kinds_of(formula.part(call.args[0])):
                found.add(_VELOCITY)
        return frozenset(found)

    def _dots(self, path: tuple[str, ...], formula: Formula, text: str) -> bool:
        good = True
        for call in formula.calls("dot"):
            inside = formula.part(call.args[0])
            kinds = set(self.kinds_of(inside))
            if inside.tree is not formula.tree and any(True for _ in inside.calls("dot")):
                kinds.add(_VELOCITY)
            why = ""
            if _VELOCITY in kinds:
                why = "velocities, so its rate would hold accelerations, which are what is solved for"
            elif _INPUT in kinds:
                why = "inputs, whose rate nobody knows"
            if why:
                good = False
                self.say(path, f"dot(...) of something that depends on {why}", call, text)
        return good

    def _quantities(self, table: str, entries: Mapping[str, _Quantity]) -> list[Quantity]:
        """Constants may use earlier constants; parameters any constant."""
        known: dict[str, float] = {}
        if table == "parameters":
            known = {c.name: c.value for c in self.constants}
        out = []
        self.kinds, self.used = dict.fromkeys(known, frozenset()), getattr(self, "used", set())
        for name, entry in entries.items():
            path = (table, name) if (table, name, "value") not in self.places._line else (table, name, "value")
            formula = self._formula(path, entry.value, dict.fromkeys(known, frozenset()))
            if formula is None:
                known.setdefault(name, 1.0)
                continue
            value = self._value(path, formula, known, entry.value)
            if table == "constants":
                known[name] = value
            out.append(Quantity(name, entry.unit, value, entry.note, formula))
        return out

    def _value(
        self, path: tuple[str, ...], formula: Formula, known: Mapping[str, float], text: float | str
    ) -> float:
        try:
            value = formulas.evaluate(formula, formulas.NUMERIC, known.__getitem__)
            if isinstance(value, (int, float)) and math.isfinite(value):
                return float(value)
            fault = "is not a real, finite number"
        except ZeroDivisionError:
            fault = "divides by zero"
        except (ArithmeticError, ValueError, TypeError, KeyError) as error:
            fault = f"can't be evaluated ({error})"
        self.say(path, f"the value of '{formula.text}' {fault}", text=str(text))
        return 1.0

    def _coordinates(self) -> list[Coordinate]:
        plain = {q.name: frozenset[str]() for q in (*self.constants, *self.parameters)}
        out = []
        for name, entry in self.document.coordinates.items():
            start = self._formula(("coordinates", name, "start"), entry.start, plain)
            rate = self._formula(("coordinates", name, "rate"), entry.rate, plain)
            if start and rate:
                out.append(Coordinate(name, entry.unit, start, rate, entry.note))
        return out

    def _start(self, scene: Scene) -> None:
        values = {q.name: q.value for q in (*scene.constants, *scene.parameters)}
        for c in scene.coordinates:
            self._value(("coordinates", c.name, "start"), c.start, values, c.start.text)
            self._value(("coordinates", c.name, "rate"), c.rate, values, c.rate.text)

    def _definitions(self) -> dict[str, Formula]:
        entries = self.document.definitions
        for name in self._circular(entries):
            self.kinds.setdefault(name, frozenset())
        out: dict[str, Formula] = {}
        later = list(entries)
        for name, value in entries.items():
            later.remove(name)
            path = ("definitions", name)
            if name in self.kinds:  # circular, told already
                continue
            forward = [n for n in self._used_names(value) if n in later and n not in self.kinds]
            for used in forward:
                self.say(
                    path,
                    f"'{used}' is defined further down: move its line above this one",
                    text=str(value),
                )
                self.used.add(used)
            formula = None if forward else self._formula(path, value)
            self.kinds[name] = self.kinds_of(formula) if formula else frozenset()
            if formula:
                out[name] = formula
        return out

    def _used_names(self, value: float | str) -> list[str]:
        try:
            return [n.id for n in formulas.parse(str(value)).names()]
        except FormulaError:
            return []

    def _circular(self, entries: Mapping[str, float | str]) -> list[str]:
        graph = {n: [u for u in self._used_names(v) if u in entries] for n, v in entries.items()}
        lost: list[str] = []
        while True:
            try:
                TopologicalSorter(graph).prepare()
                return lost
            except CycleError as cycle:
                ring = list(reversed(cycle.args[1]))
                self.say(
                    ("definitions", ring[0]),
                    f"circular definition: {' -> '.join(ring)}; one of them must stand on its own",
                    text=str(entries[ring[0]]),
                )
                self.used.update(ring)
                lost += ring
                for name in ring:
                    graph[name] = []

    def _inputs(self) -> list[Input]:
        known = {n: k for n, k in self.kinds.items() if _INPUT not in k}
        out = []
        for name, entry in self.document.inputs.items():
            signal = self._formula(("inputs", name, "signal"), entry.signal, known)
            if signal:
                out.append(Input(name, entry.unit, signal, entry.note))
        return out

    def _energy_kinds(self, key: str, formula: Formula) -> None:
        path, text = ("energy", key), str(getattr(self.document.energy, key))
        kinds = self.kinds_of(formula)
        if _INPUT in kinds:
            self.say(
                path, "an energy can't depend on inputs: let them act through [forces]", text=text
            )
        if key == "potential" and _VELOCITY in kinds:
            self.say(
                path,
                "the potential energy can't depend on velocities: parts linear in them "
                "(magnetic, gyroscopic) belong in 'kinetic', friction in 'dissipation'",
                text=text,
            )
        if key == "kinetic" and _VELOCITY not in kinds and path not in self.missing:
            self.say(
                path,
                "the kinetic energy has no velocities, so nothing has inertia: "
                f"use {', '.join(f'{c}_dot' for c in self.document.coordinates)} or dot(...)",
                text=text,
            )
        self._smooth(path, formula, text)

    def _smooth(self, path: tuple[str, ...], formula: Formula, text: str) -> None:
        """Energies are differentiated, so nothing in them may jump."""
        defined = {n: str(v) for n, v in self.document.definitions.items()}
        queue: list[tuple[tuple[str, ...], Formula, str]] = [(path, formula, text)]
        seen: set[str] = set()
        while queue:
            where, f, shown = queue.pop()
            for call in f.calls("sign", "heaviside"):
                if {_POSITION, _VELOCITY} & self.kinds_of(f.part(call)):
                    function = call.func.id if isinstance(call.func, ast.Name) else ""
                    self.say(
                        where,
                        f"{function}(...) jumps, so energy.{path[-1]} that uses it has no derivative: "
                        "use abs, min or max (max(x, 0)**2 for a stop), a smooth tanh(x/width), "
                        "or give the force itself in [forces]",
                        call,
                        shown,
                    )
            for node in f.names():
                if node.id in defined and node.id not in seen:
                    seen.add(node.id)
                    inner = self._quiet(defined[node.id])
                    if inner is not None:
                        queue.append((("definitions", node.id), inner, defined[node.id]))

    def _quiet(self, text: str) -> Formula | None:
        try:
            return formulas.parse(text)
        except FormulaError:
            return None

    def _not_a_coordinate(self, name: str) -> bool:
        known = list(self.document.coordinates)
        self.say(
            ("forces", name),
            f"'{name}' is not a coordinate"
            + (suggest(name, known) or f": a force acts along {' or '.join(known)}"),
        )
        return False

    def _unused(self) -> None:
        doc = self.document
        if any(p.severity == "error" for p in self.problems):
            return  # a name may be unused only because its formula was refused
        for table in ("parameters", "constants", "inputs", "definitions"):
            for name in getattr(doc, table):
                if name not in self.used:
                    self.say(
                        (table, name),
                        f"'{name}' is not used by any formula: remove it, or use it",
                        severity="warning",
                    )


def _clean(location: tuple[Any, ...]) -> tuple[str, ...]:
    """pydantic's place without the branches of a union."""
    inner = {"float", "str", "constrained-str", "int"}
    return tuple(str(p) for p in location if str(p) not in inner and "[" not in str(p))


def _say_layout(error: Mapping[str, Any], path: tuple[str, ...], tree: Mapping[str, Any]) -> str:
    kind, given = str(error["type"]), error.get("input")
    last = path[-1] if path else ""
    if path == ("eomc",):
        if kind == "missing":
            return "the scene does not say its format: begin it with 'eomc = 1'"
        return f"format {given!r} is not known to this version, which reads format 1"
    if kind == "missing":
        wanted = {
            ("name",): "name = \"...\": it names the module and begins every C symbol",
            ("coordinates",): "[coordinates], such as x = { unit = \"m\", start = 0.0 }",
            ("energy",): "[energy] with kinetic = \"...\" and potential = \"...\"",
            ("energy", "kinetic"): "kinetic = \"...\" in [energy]",
        }.get(path, f"'{last}'" + (f" in [{'.'.join(path[:-1])}]" if path[:-1] else ""))
        return f"missing: add {wanted}"
    if kind == "extra_forbidden":
        models: dict[tuple[str, ...], list[str]] = {
            (): list(_Document.model_fields),
            ("energy",): list(_Energy.model_fields),
            ("run",): list(_Run.model_fields),
        }
        tables = {
            "coordinates": _Coordinate,
            "parameters": _Quantity,
            "constants": _Quantity,
            "inputs": _Input,
        }
        table = tables.get(path[0])
        known = models.get(path[:-1]) or (list(table.model_fields) if table else [])
        near = suggest(last, known)
        return f"unknown key '{last}'{near}" + ("" if near else f": known are {', '.join(known)}")
    if kind == "too_short":
        return "no coordinates: declare at least one, such as x = { unit = \"m\", start = 0.0 }"
    if kind == "literal_error" and path == ("run", "method"):
        return f"unknown method {given!r}: known are {', '.join(METHODS)}"
    if kind == "greater_than":
        return f"must be greater than zero, here {given!r}"
    if kind == "finite_number":
        return f"must be a finite number, here {given!r}"
    if kind in ("dict_type", "model_type", "model_attributes_type"):
        if path in {(t,) for t in _TABLES}:
            return f"'{last}' is a table: write [{last}] and its entries below"
        return f"'{last}' is a table: write {last} = {{ unit = \"m\", ... }}, here {given!r}"
    if path[0] == "run":
        return f"must be a number, here {given!r}"
    if kind.startswith("string") and len(path) and last in ("unit", "note", "name", "title"):
        return f"must be text in quotes, here {given!r}"
    return f"must be a number or a formula in quotes, here {given!r}"


def _mend(tree: dict[str, Any], path: tuple[str, ...], kind: str) -> None:
    """Take a faulty entry out, or put a harmless one in, so that the rest can be checked."""
    harmless: dict[tuple[str, ...], Any] = {
        ("eomc",): 1,
        ("name",): "scene",
        ("coordinates",): {"x": {}},
        ("energy",): {"kinetic": "0"},
        ("energy", "kinetic"): "0",
    }
    node: Any = tree
    for part in path[:-1]:
        node = node[part] if isinstance(node, dict) and isinstance(node.get(part), dict) else {}
    if path in harmless:
        node[path[-1]] = harmless[path]
    elif kind == "missing":
        node[path[-1]] = 1.0
    elif path and path[-1] in node:
        del node[path[-1]]
    elif len(path) > 1:
        _mend(tree, path[:-1], kind)
