"""A scene as an FMU (FMI unit) without a binary: its model description and its C header.

Variables are in the order of their value references, as in csrc/fmi/unit.h.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from math import inf

from sympy import Symbol

from eomc.base import resources
from eomc.base.texts import FreeText
from eomc.derive.tape import Stage, Tape
from eomc.emit.common.adaptive import DIRECTIONS
from eomc.emit.common.c_function import break_long_lines
from eomc.emit.common.c_names import Target
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.templates import show
from eomc.model.algebra import expression
from eomc.model.symbols import Input
from eomc.program.ir import Function, evaluate, nearby
from eomc.program.lower import lower
from eomc.program.outline import weight
from eomc.program.program import TIME, Program
from eomc.scene import formulas
from eomc.scene.formulas import parse
from eomc.scene.schema import ACTIONS

Attributes = tuple[tuple[str, FreeText], ...]
Names = frozenset[str]

VERSIONS = (2, 3)
# headers of the FMI standard, by version
_HEADERS = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
MAX_STEPS = 10_000  # largest number of adaptive steps in one call


@dataclass(frozen=True)
class Unit:
    """The contents of an FMU (FMI unit) as texts, without a binary.

    Attributes
    ----------
    name
        Name of the scene in C.
    version
        Version of FMI, 2 or 3.
    files
        Texts by their path in the FMU.
    sources
        Paths, relative to sources/, of the C files that are compiled.
    operations
        Number of arithmetic operations of the scene's functions, which determines compile time.
    """

    name: str
    version: int
    files: Mapping[str, str]
    sources: tuple[str, ...]
    operations: int


def render_unit(functions: SceneFunctions, version: int, portable_files: Mapping[str, str]) -> Unit:
    """Return the texts that form the FMU of a scene. There is no compiled binary among them.

    The same scene always gives the same texts. version: version of FMI, 2 or 3. portable_files:
    header and source in portable C.
    """
    name = functions.prefix
    sources = (f"{name}.c", f"fmi/fmi{version}.c")

    def render(token: str) -> dict[str, str]:
        files = {
            "modelDescription.xml": model_description(functions, version, token, sources),
            "sources/fmi/scene.h": break_long_lines(scene_header(functions, token)),
        }
        if version == 3:
            files["sources/buildDescription.xml"] = show(
                "fmu/build_description.xml", functions, sources=sources
            )
        return files | texts

    texts = {f"sources/{file}": text for file, text in portable_files.items()}
    texts |= {
        f"sources/fmi/{file}": resources.text("csrc", f"fmi/{file}")
        for file in (*_HEADERS[version], f"fmi{version}.c", "both.h", "unit.h")
    }
    texts["documentation/licenses/fmi-headers.txt"] = resources.text("csrc", "fmi/LICENSE.txt")
    whole = "\0".join(f"{file}\0{text}" for file, text in sorted(render("").items()))
    digest = hashlib.sha256(whole.encode(errors="surrogateescape")).hexdigest()
    token = "-".join((digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:32]))
    operations = sum(map(weight, functions.target.program.functions.values()))
    return Unit(name, version, render(token), sources, operations)


def scene_header(functions: SceneFunctions, token: str) -> str:
    """Return the text of scene.h, a C header of the FMU.

    With this header, the hand-written C, which is the same in all FMUs, calls the functions of this
    scene. token: text that identifies the build, as in modelDescription.xml.
    """
    target, s = functions.target, functions.target.system
    fixed = [c.start_fixed for c in s.coordinates] + [c.rate_fixed for c in s.coordinates]
    lines, starts = _start_formulas(target)
    return show(
        "fmu/scene.h",
        functions,
        token=token,
        input_starts=input_starts(target),
        events=[(e.name, DIRECTIONS[e.direction], ACTIONS.index(e.action)) for e in s.events],
        fixed=list(map(int, fixed)),
        lines=lines,
        starts=starts,
        max_steps=MAX_STEPS,
    )


def _start_formulas(target: Target) -> tuple[Sequence[str], list[tuple[int, str, str]]]:
    """Return the initial values that are formulas of parameters.

    The first result are the C statements that the values need. The second has for each value its
    index in [q; q̇], the array element to which it is assigned, and the value, as C expressions.
    """
    s, formulas = target.system, target.start_formulas
    symbols = {target.scene_name(p.name): p.symbol for p in s.parameters}
    tape = Tape({p.symbol: Stage.PARAMETER for p in s.parameters})
    values = [tape.define(expression(parse(text), symbols)) for text in formulas.values()]
    body = target.body(lower("starts", tape, values, s.names))
    states = [(array, c.name) for array in ("q", "qd") for c in s.coordinates]
    names = [target.scene_name(n) + ("_dot" if array == "qd" else "") for array, n in states]
    places = [names.index(name) for name in formulas]
    starts = [(k, target.element(*states[k]), x) for k, x in zip(places, body.results, strict=True)]
    return body.lines, starts


# --- model description ----------------------------------------------------------------------------


def model_description(
    functions: SceneFunctions, version: int, token: str, sources: tuple[str, ...]
) -> str:
    """Return the text of modelDescription.xml, which describes an FMU to simulation tools.

    version: version of FMI, 2 or 3. token: text that identifies the build. sources: names of the C
    files to compile.
    """
    target, s = functions.target, functions.target.system
    known = variables(target)
    state, rates = known["q"] + known["qd"], known["der_q"] + known["der_qd"]
    results = dependencies(target.program, has_signals(target))
    parameters = {target.scene_name(p.name): p.name for p in s.parameters}
    formulas = target.start_formulas
    starts = [
        (v, frozenset(parameters[n.id] for n in parse(formulas[v.name]).names()))
        for v in state
        if v.name in formulas
    ]
    names = [frozenset({x.name}) for x in (*s.q, *s.qd)]
    outputs = [*zip(state, names, strict=True)]
    derivatives = [*zip(rates, [*names[len(s.q) :], *results("acceleration")], strict=True)]
    computed = [*zip(known["outputs"], results("outputs"), strict=True)]
    indicators = zip(known["indicators"], results("events"), strict=True)
    # references of the variables that change, and with them those of what initial values depend on
    pairs = zip((*s.q, *s.qd), state, strict=True)
    moving: dict[str, tuple[int, ...]] = {x.name: (v.reference,) for x, v in pairs}
    inputs = {x.name: v.reference for x, v in zip(s.inputs, known["inputs"], strict=True)}
    moving |= {name: (reference,) for name, reference in inputs.items()}
    if version == 3:
        moving[TIME] = (known["time"][0].reference,)
    switches = [v.reference for v in known["switches"]]  # inputs may follow their signals
    every = moving | {name: (reference, *switches) for name, reference in inputs.items()}
    own = zip(s.parameters, known["parameters"], strict=True)
    every |= {p.name: (v.reference,) for p, v in own}
    structure = {
        "outputs": _unknowns([*outputs, *computed], moving),
        "rates": _unknowns(derivatives, moving),
        "initial": _unknowns([*starts, *derivatives, *computed], every),
        "indicators": _unknowns(indicators, moving),
    }
    listed = list(chain(*known.values()))
    meanings = {v.unit: unit for v in listed if (unit := parse_unit(v.unit)) is not None}
    # FMI 2 needs no variable for the time, and some importers take it for an error
    listed = [v for v in listed if v.reference or version == 3]
    files = {"sources": sources} if version == 2 else {}  # FMI 3 has them in a file of its own
    return show(
        f"fmu/fmi{version}.xml", functions, token=token, variables=listed, structure=structure,
        units=[(FreeText(text), unit.attributes) for text, unit in meanings.items()], **files,
    )  # fmt: skip


def _unknowns(
    pairs: Iterable[tuple[Variable, Names]], references: Mapping[str, tuple[int, ...]]
) -> list[tuple[int, list[int]]]:
    """Return the references of computed variables, and of the variables that each depends on.

    In FMI 2 references also are positions in the list of variables, counted from 1: reference 0 is
    the time, which that list does not contain.

    pairs: the variables, and the names of values that each depends on. references: value references
    by the names of values.
    """
    return [
        (v.reference, sorted({r for n in names for r in references.get(n, ())}))
        for v, names in pairs
    ]


def dependencies(program: Program, signals: bool) -> Callable[[str], list[Names]]:
    """Return a function for the names of the variables that the results of a function depend on.

    It takes the name of a function of the program, such as "outputs"; it returns [] if the program
    lacks the function. Variables are what a simulation tool sets in the FMU: coordinates,
    velocities, inputs, parameters and the time.

    signals: whether the scene's signals (formulas for its inputs) may replace the inputs. If so,
    results that depend on an input also depend on the variables in its signal.
    """
    s = program.system
    known = {x.name for x in (*s.q, *s.qd, *s.u, *s.parameters)} | {TIME}

    def of_results(name: str, items: Sequence[Symbol]) -> dict[str, Names]:
        results = dependencies_of_results(program[name]) if name in program else []
        return dict(zip([x.name for x in items], results, strict=False))

    accelerations = of_results("acceleration", s.qdd)
    replaced = of_results("signal", s.u) if signals else {}

    def dependencies_of(name: str) -> list[Names]:
        results = []
        for names in dependencies_of_results(program[name]) if name in program else ():
            for further in (accelerations, replaced):  # accelerations depend on inputs
                names = names.union(*(further[n] for n in names & further.keys()))
            results.append(names & known)
        return results

    return dependencies_of


def dependencies_of_results(function: Function) -> list[Names]:
    """Return the names of the arguments that each result of a function depends on.

    function: a function of the program, a list of elementary operations.
    """
    dependencies: dict[str, Names] = {}
    for a in (*function.early, *function.body):
        dependencies[a.name] = frozenset().union(*(dependencies.get(n, {n}) for n in a.value.names))
    return [dependencies.get(o.name, frozenset({o.name} - {""})) for o in function.outputs]


# --- variables ------------------------------------------------------------------------------------

_ENERGIES: Mapping[str, str] = {
    "kinetic": "kinetic energy",
    "potential": "potential energy",
    "total": "kinetic and potential energy",
}
TIME_NAME = "t"  # no scene can use this name for anything else


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU, as modelDescription.xml lists it.

    Attributes
    ----------
    reference
        Value reference: the number by which simulation tools access the variable.
    causality, variability, initial
        As in the FMI standard; "" for no attribute.
    unit, words
        Unit and description; "" for none.
    start, minimum, maximum
        Numbers as text; "" for none.
    derivative
        For time derivatives, the value reference of the state; otherwise None.
    boolean
        Whether the variable is a truth value rather than a number.
    """

    name: str
    reference: int
    causality: str
    variability: str = "continuous"
    initial: str = ""
    unit: str = ""
    start: str = ""
    words: str = ""
    minimum: str = ""
    maximum: str = ""
    derivative: int | None = None
    boolean: bool = False

    @property
    def attributes(self) -> Attributes:
        """The main attributes in modelDescription.xml, as pairs (name, value)."""
        return _attributes(
            name=self.name, valueReference=str(self.reference), description=self.words,
            causality=self.causality, variability=self.variability, initial=self.initial,
        )  # fmt: skip

    @property
    def inner(self) -> Attributes:
        """The attributes for unit, limits and start, which FMI 2 has in an element inside."""
        return _attributes(
            unit=self.unit if parse_unit(self.unit) else "", min=self.minimum, max=self.maximum,
            start=self.start, derivative="" if self.derivative is None else str(self.derivative),
        )  # fmt: skip


def _attributes(**texts: str) -> Attributes:
    """Return the attributes of an XML element that are not empty."""
    return tuple((key, FreeText(text)) for key, text in texts.items() if text)


def has_signals(target: Target) -> bool:
    """Return True if the scene defines signals: formulas that give its inputs values by default."""
    return any(i.signal != 0 for i in target.system.inputs)


def input_starts(target: Target) -> list[float]:
    """Return the initial value of each input of a scene.

    It is the value of the input's signal (the scene's formula for it) at the start, limited to the
    numeric limits of the input. If signals can't be evaluated there, it is 0, limited likewise.
    """
    inputs = target.system.inputs
    if not inputs:
        return []
    try:
        starts = evaluate(target.program["signal"], nearby(target.system, 0))[0]
    except (ArithmeticError, ValueError):
        starts = [0.0] * len(inputs)
    return [
        min(max(start, -inf if low is None else low), inf if high is None else high)
        for start, (low, high) in zip(starts, map(numeric_limits, inputs), strict=True)
    ]


def numeric_limits(one: Input) -> tuple[float | None, float | None]:
    """Return the lower and the upper limit of an input as numbers.

    None stands for a limit that is missing, or that is a formula of parameters.
    """
    low, high = (float(x) if x is not None and x.is_number else None for x in one.limits)
    return low, high


def variables(target: Target) -> dict[str, list[Variable]]:
    """Return the variables of the FMU of a scene by kind, in the order of their value references.

    "der_q" and "der_qd" are the time derivatives of q and q̇, "indicators" the event functions. The
    kind "switches" has the truth value that makes the scene's signals (formulas) replace the
    inputs; it is empty if the scene has no signals.
    """
    s, written, next_reference = target.system, target.scene_name, count().__next__
    of_parameters = target.start_formulas

    def new_variable(name: str, causality: str, **more: str | int | bool) -> Variable:
        return Variable(name, next_reference(), causality, **more)  # type: ignore[arg-type]

    def state(name: str, start: float, unit: str, words: str) -> Variable:
        initial = "approx" if name in of_parameters else "exact"
        return new_variable(
            name, "output", initial=initial, start=repr(start), unit=unit, words=words
        )

    time = new_variable(TIME_NAME, "independent", unit="s", words="time")
    named = [(written(c.name), c) for c in s.coordinates]
    q = [state(name, c.start, c.unit, c.note) for name, c in named]
    qd = [
        state(f"{name}_dot", c.rate, derivative_unit(c.unit, 1), f"rate of {name}")
        for name, c in named
    ]
    der_q = [
        new_variable(f"der({x.name})", "local", initial="calculated", unit=v.unit, words=v.words,
             derivative=x.reference)
        for x, v in zip(q, qd, strict=True)
    ]  # fmt: skip
    der_qd = [
        new_variable(f"der({v.name})", "local", initial="calculated",
             unit=derivative_unit(c.unit, 2), words=f"acceleration of {name}",
             derivative=v.reference)
        for v, (name, c) in zip(qd, named, strict=True)
    ]  # fmt: skip
    return {
        "time": [time],
        "q": q,
        "qd": qd,
        "der_q": der_q,
        "der_qd": der_qd,
        "inputs": [
            new_variable(written(i.name), "input", start=repr(value), unit=i.unit, words=i.note,
                 **_range_of(i))
            for i, value in zip(s.inputs, input_starts(target), strict=True)
        ],
        "outputs": [
            new_variable(o.name, "output", initial="calculated", unit=o.unit, words=o.note)
            for o in s.outputs
        ],
        "parameters": [
            new_variable(written(p.name), "parameter", variability="tunable", initial="exact",
                 start=repr(p.value), unit=p.unit, words=p.note)
            for p in s.parameters
        ],
        "energies": [
            new_variable(f"energy.{name}", "local", initial="calculated", unit="J", words=words)
            for name, words in _ENERGIES.items()
        ],
        "indicators": [
            new_variable(f"indicator.{e.name}", "local", initial="calculated",
                 words=f"zero where event {e.name} happens")
            for e in s.events
        ],
        "switches": [
            new_variable(name, "parameter", variability="tunable", initial="exact", start="false",
                 boolean=True, words="whether the scene's signals act in place of the inputs")
            for name in ["inputs.follow_signals"] * has_signals(target)
        ],
    }  # fmt: skip


def _range_of(one: Input) -> dict[str, str]:
    """Return `minimum` and `maximum` of an input as text, where its limits are numbers."""
    limits = zip(("minimum", "maximum"), numeric_limits(one), strict=True)
    return {key: repr(limit) for key, limit in limits if limit is not None}


# --- units of measurement -------------------------------------------------------------------------

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
# exponents of the units in BASE
_SI: Mapping[str, tuple[int, ...]] = {
    **{name: tuple(int(name == b) for b in BASE) for name in BASE},
    "g": (1, 0, 0, 0, 0, 0, 0, 0),
    "N": (1, 1, -2, 0, 0, 0, 0, 0),
    "J": (1, 2, -2, 0, 0, 0, 0, 0),
    "W": (1, 2, -3, 0, 0, 0, 0, 0),
    "Pa": (1, -1, -2, 0, 0, 0, 0, 0),
    "Hz": (0, 0, -1, 0, 0, 0, 0, 0),
    "C": (0, 0, 1, 1, 0, 0, 0, 0),
    "V": (1, 2, -3, -1, 0, 0, 0, 0),
    "F": (-1, -2, 4, 2, 0, 0, 0, 0),
    "H": (1, 2, -2, -2, 0, 0, 0, 0),
    "Wb": (1, 2, -2, -1, 0, 0, 0, 0),
    "T": (1, 0, -2, -1, 0, 0, 0, 0),
    "S": (-1, -2, 3, 2, 0, 0, 0, 0),
    "Ohm": (1, 2, -3, -2, 0, 0, 0, 0),
}
_PREFIXES = {
    "n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "k": 1e3, "M": 1e6, "G": 1e9,
}  # fmt: skip
_NONE = (0,) * len(BASE)
_TIME = _SI["s"]
_ANGLE = _SI["rad"]
_OTHERS: Mapping[str, tuple[float, tuple[int, ...]]] = {
    "min": (60.0, _TIME),
    "h": (3600.0, _TIME),
    "deg": (math.pi / 180, _ANGLE),
    "°": (math.pi / 180, _ANGLE),
    "rev": (2 * math.pi, _ANGLE),
    "t": (1000.0, _SI["kg"]),
    "L": (1e-3, (0, 3, 0, 0, 0, 0, 0, 0)),
    "bar": (1e5, _SI["Pa"]),
    "Ω": (1.0, _SI["Ohm"]),
    "%": (0.01, _NONE),
}
# a unit, and its power as FMI writes it: s-2; or 1, which is no power
_WORD = re.compile(r"([A-Za-zµΩ°%]+|(?<![\d^-])(?<!\*\*)1(?!\d))(?:\s*(-?\d+))?")
_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_MOST = 20  # largest magnitude of an exponent


@dataclass(frozen=True)
class UnitOfMeasurement:
    """A unit of measurement in terms of FMI's base units (`BASE`: kg, m, s, ...).

    The unit is `factor` times the product of the base units, each raised to its power. powers: the
    integer exponents, in the order of BASE.
    """

    factor: float
    powers: tuple[int, ...]

    def __mul__(self, other: UnitOfMeasurement) -> UnitOfMeasurement:
        powers = (a + b for a, b in zip(self.powers, other.powers, strict=True))
        return UnitOfMeasurement(self.factor * other.factor, tuple(powers))

    def __pow__(self, power: int) -> UnitOfMeasurement:
        if abs(power) > _MOST:
            raise ValueError("no unit has such a power")
        return UnitOfMeasurement(self.factor**power, tuple(power * n for n in self.powers))

    def __truediv__(self, other: UnitOfMeasurement) -> UnitOfMeasurement:
        return self * other**-1

    @property
    def attributes(self) -> tuple[tuple[str, str], ...]:
        """The attributes of FMI's XML element BaseUnit for this unit, as pairs (name, value).

        There is one for each base unit with an exponent other than 0, and "factor" unless it is 1.
        """
        powers = [(b, str(n)) for b, n in zip(BASE, self.powers, strict=True) if n]
        return (*powers, *([("factor", repr(self.factor))] if self.factor != 1 else []))


ONE = UnitOfMeasurement(1.0, _NONE)


def parse_unit(text: str) -> UnitOfMeasurement | None:
    """Return the meaning of a unit written as text, such as "N m/rad" or "kg*m^2".

    None if the text is empty or is not a known unit.

    >>> parse_unit("N m/rad").attributes
    (('kg', '1'), ('m', '2'), ('s', '-2'), ('rad', '-1'))
    >>> parse_unit("furlongs") is parse_unit("") is None
    True
    """
    units: dict[str, UnitOfMeasurement] = {}

    def name(match: re.Match[str]) -> str:
        units[new := f"u{len(units)}"] = _word(match[1])
        return new + (f"**{match[2]}" if match[2] else "")

    text = re.sub(r"[⁻⁰¹²³⁴-⁹]+", lambda match: f"^{match[0].translate(_RAISED)} ", text)
    try:
        text = re.sub(r"[·.]", "*", _WORD.sub(name, text)).replace("^", "**")
        product = formulas.parse(re.sub(r"(?<=[\w)])\s+(?=[\w(])", "*", text))
        meaning = formulas.evaluate(product, {"number": int}, units.__getitem__)
        if re.search(r"\*\*[-\d ]+\*\*", product.text):  # a power of a power
            return None
        fits = all(abs(n) <= _MOST for n in meaning.powers) and 1e-60 < meaning.factor < 1e60
    except (ValueError, TypeError, AttributeError, OverflowError):
        return None
    return meaning if fits else None


def _word(word: str) -> UnitOfMeasurement:
    """Return the meaning of a unit with an optional prefix. Raises ValueError."""
    if word == "1":
        return ONE
    if word in _OTHERS:
        return UnitOfMeasurement(*_OTHERS[word])
    if word in _SI:
        return UnitOfMeasurement(1e-3 if word == "g" else 1.0, _SI[word])
    scale, unit = _PREFIXES.get(word[:1]), word[1:]
    if scale is None or unit not in _SI or unit == "kg":
        raise ValueError(f"{word} is no unit")
    return UnitOfMeasurement(scale * (1e-3 if unit == "g" else 1.0), _SI[unit])


def derivative_unit(text: str, times: int) -> str:
    """Return the unit of a time derivative of a quantity, as text.

    text: the unit of the quantity; for "", the result is "" too. times: 1 for the first derivative,
    2 for the second.

    >>> derivative_unit("m", 2), derivative_unit("N m", 1)
    ('m/s^2', '(N m)/s')
    """
    if not text:
        return ""
    whole = text if re.fullmatch(r"\w+", text) else f"({text})"
    return f"{whole}/s" + ("" if times == 1 else f"^{times}")
