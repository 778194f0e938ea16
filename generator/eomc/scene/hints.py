"""What newcomers write instead, in formulas, keys, tables, numbers and names, and the remedies."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from eomc.base import names, resources
from eomc.runtime import mathematics

# --- formulas -------------------------------------------------------------------------------------

# remedies by characters, by functions, and by nodes of Python's syntax tree
_QUOTE = "quotes and primes are not used here: write {}_dot for a velocity, dot(e) for de/dt"
_ORDER = "comparisons are not used in formulas: write heaviside(a - b), min or max"
CHARACTERS: Mapping[str, str] = {
    **dict.fromkeys("'\"`", _QUOTE),
    **dict.fromkeys("<>", _ORDER),
    **dict.fromkeys(
        "\\\b\f\v\a\r", "LaTeX is not read: write names without backslash (theta), powers as **"
    ),
    **dict.fromkeys("[{", "lists and indices are not used: give each quantity a name of its own"),
    "^": "'^' is not a power here: write '**'",
    "=": "'=' is not used inside a formula: write only what stands right of it",
    "°": "angles are in radians: write 90 degrees as 90*pi/180",
    "#": "a comment can't stand inside a formula: put it after the closing quotes",
    "%": "'%' is not used in formulas: comments stand after the closing quotes, with '#'",
    **{c: f"'{c}' is not ASCII: write {names.plain(c)}" for c in names.GREEK},
    "π": "'π' is not ASCII: write pi",
    **dict.fromkeys("·×⋅∙", "products are written with '*'"),
    **dict.fromkeys("−–—", "this dash is not a minus sign: write '-'"),
    **dict.fromkeys("′’‘″“”", _QUOTE),
    **{c: f"'{c}' is not ASCII: write **{n}" for n, c in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")},
    "|": "bars are not used here: write abs(...)",
    "½": "'½' is not ASCII: write 1/2",
    "√": "'√' is not ASCII: write sqrt(...)",
}

# functions of other programs and textbooks, and the functions that they stand for
FUNCTION_ALIASES: Mapping[str, str] = {
    **{f"arc{f[1:]}": f for f in mathematics.FUNCTIONS if f[0] == "a" and f != "abs"},
    **{f"ar{f[1:]}": f for f in ("asinh", "acosh", "atanh")},
    **{f.capitalize(): f for f in (*mathematics.FUNCTIONS, "dot")},
    "ln": "log", "fabs": "abs", "sgn": "sign", "signum": "sign", "sine": "sin", "cosine": "cos",
    "step": "heaviside", "tangent": "tan", "fmin": "min", "fmax": "max", "norm": "hypot",
    "Derivative": "dot", "diff": "dot", "derivative": "dot", "ddt": "dot",
    "arctg": "atan", "tg": "tan", "Minimum": "min", "Maximum": "max",
}  # fmt: skip

SYNTAX: Mapping[type, str] = {
    ast.FloorDiv: "'//' is not used in formulas: write '/'",
    ast.IfExp: "'if' is not used in formulas: write heaviside(a - b), min or max",
    ast.BoolOp: "'and' and 'or' are not used in formulas: write heaviside, min or max",
    ast.Compare: _ORDER,
    ast.Attribute: "'.' is not used in formulas: names are plain, velocities end in _dot",
    ast.Lambda: "'lambda' is not used in formulas",
}

_SMOOTH = "it jumps: write a smooth function, heaviside, min or max"
_INVERSES = (("sec", "cos"), ("csc", "sin"), ("cot", "tan"), ("sech", "cosh"), ("csch", "sinh"),
             ("coth", "tanh"))  # fmt: skip
# remedies by the names of functions that formulas do not have
FUNCTIONS: Mapping[str, str] = {
    **dict.fromkeys(
        ("gamma", "lgamma", "tgamma", "besselj"), "formulas have no special functions but erf, erfc"
    ),
    "pow": "write a**b",
    **dict.fromkeys(("radians", "deg2rad", "deg", "degrees"), "write 30 degrees as 30*pi/180"),
    **{name: f"write 1/{of}(...)" for name, of in _INVERSES},
    "acot": "write atan(1/x)",
    "sinc": "write sin(x)/x",
    "log10": "write log(x)/log(10)",
    "log2": "write log(x)/log(2)",
    "exp2": "write 2**x",
    **dict.fromkeys(("floor", "ceil", "ceiling", "round", "trunc", "fmod", "Mod"), _SMOOTH),
    **dict.fromkeys(("Piecewise", "ITE"), "write heaviside(a - b), min or max"),
    **dict.fromkeys(("Integral", "Sum", "Product"), "write its value, by .doit() in SymPy"),
}

# --- keys -----------------------------------------------------------------------------------------

# keys of other programs and textbooks, and the keys of a scene that they stand for
KEYS = {
    "dt": "h", "step": "h", "time": "duration", "tend": "duration", "t_end": "duration",
    "initial": "start", "init": "start", "velocity": "rate", "units": "unit", "val": "value",
    "variables": "coordinates", "params": "parameters", "const": "constants", "x0": "start",
    "q0": "start", "v0": "rate", "qd0": "rate", "speed": "rate", "t_final": "duration",
    "tf": "duration", "T_end": "duration", "tmax": "duration", "stepsize": "h", "step_size": "h",
    "integrator": "method", "solver": "method", "dofs": "coordinates",
    "range": "limits", "bounds": "limits", "limit": "limits", "saturation": "limits",
    "T": "kinetic", "K": "kinetic",
    "V": "potential", "U": "potential", "P": "potential", "R": "dissipation",
}  # fmt: skip
KEYS_OF_ARRAYS = {
    "body": {
        "origin": "offset", "xyz": "offset", "translation": "offset", "at": "offset",
        "pos": "position", "rpy": "rotation", "angle": "rotation", "orientation": "rotation",
        "com": "center", "cog": "center", "centre": "center", "type": "joint", "kind": "joint",
        "coordinate": "coordinates", "q": "coordinates", "m": "mass", "I": "inertia",
        "J": "inertia", "moment": "inertia", "c": "damping", "b": "damping", "d": "damping",
        "mu": "friction", "coulomb": "friction", "width": "friction_width", "motor": "actuator",
        "torque": "actuator", "force": "actuator", "input": "actuator", "id": "name",
    },
    "point": {
        "parent": "body", "link": "body", "at": "place", "offset": "place", "position": "place",
        "xyz": "place", "point": "place", "origin": "place", "rpy": "rotation",
        "angle": "rotation", "orientation": "rotation", "id": "name",
    },
    "spring": {
        "k": "stiffness", "c": "stiffness", "constant": "stiffness", "rest": "length",
        "l": "length", "l0": "length", "rest_length": "length", "free_length": "length",
        "torsional": "turning", "angular": "turning", "rotational": "turning",
        "between": "bodies", "joint": "coordinate", "ends": "points", "anchors": "points",
    },
    "damper": {
        "c": "damping", "b": "damping", "d": "damping", "coefficient": "damping",
        "torsional": "turning", "angular": "turning", "rotational": "turning",
        "between": "bodies", "joint": "coordinate", "ends": "points", "anchors": "points",
    },
    "force": {
        "at": "point", "position": "point", "place": "point", "offset": "point", "link": "body",
        "F": "force", "direction": "force", "moment": "torque", "M": "torque", "axes": "frame",
    },
    "loop": {
        "type": "joint", "kind": "joint", "between": "bodies", "body": "bodies", "point": "points",
        "anchors": "points", "ends": "points", "axes": "axis", "direction": "axis", "l": "length",
        "distance": "length", "coordinate": "coordinates", "angle": "rotation", "factor": "ratio",
        "multiplier": "ratio", "orientation": "rotation", "rpy": "rotation", "id": "name",
    },
    "event": {
        "condition": "when", "function": "when", "if": "when", "expr": "when", "zero": "when",
        "type": "action", "then": "action", "do": "action", "id": "name",
    },
}  # fmt: skip


LAGRANGIANS = ("L", "lagrangian", "Lagrangian")
GIVE_ENERGIES = (
    "give L = K - P as kinetic = K and potential = P, where the potential can have terms linear in "
    "the velocities"
)
# other names of the arguments of System.make, in scenes, runs and textbooks
ARGUMENTS = {
    "method": "methods", "start": "coordinates", "K": "kinetic", "T": "kinetic", "P": "potential",
    "V": "potential", "params": "parameters", "loads": "forces", "tol": "tolerance",
    "event": "events",
}  # fmt: skip
# arrays of tables
ARRAYS = {
    "bodies": "body", "Body": "body", "link": "body", "links": "body", "springs": "spring",
    "Spring": "spring", "dampers": "damper", "Damper": "damper", "loops": "loop", "Loop": "loop",
    "points": "point", "Point": "point", "events": "event", "Event": "event", "Events": "event",
}  # fmt: skip

# --- tables ---------------------------------------------------------------------------------------

_CONTACT = "what may part again is a stiff force, max(x, 0)**2 in [energy], or an [[event]]"
_START = "starts stand with their coordinates: theta = { start = 0.5, rate = 0 }"
_RUN = "how a scene is run stands in [run]: h, duration, method"
_LOSS = (
    "friction is a force, -b*x_dot in [forces], or b*x_dot**2/2 as dissipation in [energy]; "
    'a [[body]] has damping = "b" and friction = "c", and a coordinate friction = "c"'
)
_JOINT = 'a joint stands with the body that it moves, in [[body]]: joint = "revolute"'
ENERGY = "write [energy] with kinetic and potential, of which it is the difference"

# remedies by the names of tables that scenes do not have
TABLES: Mapping[str, str] = {
    **dict.fromkeys(("contact", "contacts"), _CONTACT),
    **dict.fromkeys(("initial", "initial_conditions", "start", "starts", "ic", "state"), _START),
    **dict.fromkeys(("states", "velocities", "velocity", "rates", "rate"), _START),
    **dict.fromkeys(("simulation", "sim", "solver", "settings", "options", "config"), _RUN),
    **dict.fromkeys(("time", "integrator", "stepper", "simulate"), _RUN),
    **dict.fromkeys(("friction", "damping", "dissipation", "drag"), _LOSS),
    **dict.fromkeys(("joint", "joints"), _JOINT),
    **dict.fromkeys(("lagrangian", "Lagrangian", "L", "hamiltonian"), ENERGY),
}
# tables that newcomers write as arrays of tables, each with an example of an entry
_ONE_TABLE: Mapping[str, str] = {
    "coordinates": 'x = { unit = "m", start = 0.0 }',
    "parameters": "m = 1.0",
    "constants": "n = 5",
    "inputs": 'F = { unit = "N" }',
    "definitions": 'y = "l*cos(theta)"',
    "forces": 'x = "F - b*x_dot"',
    "constraints": 'rod = "x**2 + y**2 - l**2"',
}
_OF_FORCES = {"body", "point", "force", "torque", "frame"}


def merge_array(name: str, entries: Any) -> tuple[str, dict[str, Any]] | None:
    """Convert an array of tables, such as [[parameter]], that should be one table [parameters].

    name: the name of the array as written. entries: its value in the TOML tree. Returns the name of
    the intended table, such as "parameters", and a dict from the name of each entry to the entry.
    Returns None if the array does not stand for one table.
    """
    table = next((t for t in _ONE_TABLE if name.lower() in (t, t.removesuffix("s"))), None)
    if table is None or not isinstance(entries, list) or not entries:
        return None
    if name == "force" and any(isinstance(e, dict) and e.keys() & _OF_FORCES for e in entries):
        return None  # on a body
    merged: dict[str, Any] = {}
    for entry in entries:
        if not isinstance(entry, dict):
            return None
        entry_name = entry.get("name")
        if isinstance(entry_name, str):
            merged[entry_name] = {key: value for key, value in entry.items() if key != "name"}
        else:
            merged |= entry
    return table, merged


def one_table_message(name: str, table: str) -> str:
    """Return the error message for an array of tables [[`name`]] that must be one table [`table`].

    The message contains an example of an entry.
    """
    start = "" if name == table else f"unknown table '{name}': "
    return f"{start}write [{table}] once, and a line such as {_ONE_TABLE[table]} for each entry"


# --- numbers with units ---------------------------------------------------------------------------

MAX_QUANTITY_LENGTH = 60  # characters of a number with its unit
_DEGREES = ("deg", "degs", "degree", "degrees", "°", "grad")
# to SI units: powers of ten only, so that the suggested number keeps its digits
_POWERS = {"mm": -3, "cm": -2, "dm": -1, "km": 3, "g": -3, "gram": -3, "grams": -3, "mg": -6,
           "t": 3, "ms": -3, "us": -6, "µs": -6, "kN": 3, "mN": -3, "kJ": 3, "kPa": 3}  # fmt: skip
_SI = {"mm": "m", "cm": "m", "dm": "m", "km": "m", "g": "kg", "gram": "kg", "grams": "kg",
       "mg": "kg", "t": "kg", "ms": "s", "us": "s", "µs": "s", "kN": "N", "mN": "N", "kJ": "J",
       "kPa": "Pa", "meter": "m", "meters": "m", "metre": "m", "metres": "m", "second": "s",
       "seconds": "s", "sec": "s", "radian": "rad", "radians": "rad"}  # fmt: skip
_UNIT = r"(?:k?g|[kcdmµu]?m|m?s|sec|rad|k?N|m?N|k?J|W|Hz|k?Pa|A|V|T|K|C|mol)"
_POWER = r"(?:(?:\^|\*\*)-?\d|[²³])?"
_UNITS = re.compile(rf"{_UNIT}{_POWER}(?:\s*[*/· ]?\s*{_UNIT}{_POWER})*")
_NUMBER = r"[+\-−]?\s*(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*([^\s\d.+\-−].*?)\s*")


def quantity_remedy(text: str, declared: Collection[str] = ()) -> str | None:
    """Return advice, for an error message, on a number that is written with a unit (`30 deg`).

    declared: names that the scene declares. A declared name is not read as a unit, so that `2 m`
    is taken for a product if m is declared. Returns None if the text is not a number with a unit.
    """
    match = _QUANTITY.fullmatch(text) if len(text) <= MAX_QUANTITY_LENGTH else None
    if match is None or match[2] in declared:
        return None
    number, unit = match[1].replace("−", "-").replace(" ", ""), match[2]
    if unit in _DEGREES:
        return f"angles are in radians, nothing is converted: write {degrees_formula(number)}"
    if unit == "rpm":
        return f'nothing is converted: write "{number}*2*pi/60", in rad/s'
    if unit in _POWERS:
        number, unit = _scale_decimal(number, _POWERS[unit]), _SI[unit]
    elif unit not in _SI and not _UNITS.fullmatch(unit):
        return None
    unit = _SI.get(unit, unit)
    return f"a number stands without quotes and without its unit, {unit} in SI: write {number}"


NOT_SI = "mm cm km g gram ms min rpm inch ft lb lbs".split()
_UNIT_OF_DEGREES = re.compile(
    r"(?<![a-z])(?:deg|degs|degree|degrees)(?![a-z])|(?<!\d)°(?![CF])", re.I
)


def is_in_degrees(unit: str) -> bool:
    """Return True if a unit contains angular degrees, such as `deg/s`.

    Returns False for units of temperature.
    """
    return bool(_UNIT_OF_DEGREES.search(unit))


def degrees_formula(number: str) -> str:
    """Return the formula in quotes that converts an angle in degrees to rad: "30*pi/180"."""
    return f'"{number}*pi/180"'


def number_remedy(text: object) -> str:
    """Return advice, for an error message, on a number that is written as a text.

    For "1 ms" the advice is ": write 0.001, without quotes", with the number converted to SI units.
    Returns "" if the text is not a number.
    """
    if not isinstance(text, str) or not (
        match := re.fullmatch(rf"\s*({_NUMBER})\s*(\D*?)\s*", text)
    ):
        return ""
    plain = match[1].replace("−", "-").replace(" ", "")
    return f": write {_scale_decimal(plain, _POWERS.get(match[2], 0))}, without quotes"


def _scale_decimal(number: str, power: int) -> str:
    try:
        return f"{float(f'{number}e{power}'):.15g}" if power else number
    except ValueError:  # it has an exponent already
        return f"{float(number) * 10.0**power:.15g}"


# remedies by parts of tomllib's messages
TOML = {
    "Invalid value": "formulas stand in quotes, numbers have digits on both sides of the point",
    "Expected newline": "one entry a line, comments begin with '#', decimals are written 9.81",
    "Illegal character '\\n'": "is a closing quote missing in this line?",
    "Unescaped '\\'": "LaTeX is not read, write names without backslash (theta)",
    "Unclosed inline table": "entries in { ... } are separated by commas and stand on one line",
}


def toml_remedy(line: str) -> str | None:
    """Return advice, for an error message, on a line that is not valid TOML.

    Three common errors are recognised: a dash in place of a minus sign, a colon in place of "=",
    and a number followed by a unit. Returns None for any other error.
    """
    line = line[:200]
    if re.search(r"[=,[]\s*−", line):
        return "this dash is not a minus sign: write '-'"
    if re.match(r"\s*[\w.]+\s*:", line):
        return "entries are written name = value"
    match = re.search(rf"=\s*({_NUMBER})\s*([^\s,}}\]#=\d][^,}}\]#=]*)", line)
    return quantity_remedy(f"{match[1]} {match[2]}") if match else None


# --- equations and events -------------------------------------------------------------------------

_EQUATION = re.compile(r"\s*([^<>=!]+?)\s*(?:[<>]=?|==?)\s*([^<>=!]+?)\s*")
# remedies for events that set inputs or constants
SWITCH_OFF = ": write '{name}*on' where it acts, with a parameter on = 1, and set that to 0"
MAKE_PARAMETER = ", and does not change in a run: make it a parameter"


def difference(text: str) -> str:
    """Return the formula that is zero where an equation or a comparison changes, or "".

    >>> difference("x**2 = l + 1"), difference("x < 0"), difference("x - 1")
    ('x**2 - (l + 1)', 'x', '')
    """
    if not (match := _EQUATION.fullmatch(text)):
        return ""
    left, right = match.groups()
    right = right if re.fullmatch(r"[\w.*/()]+", right) else f"({right})"
    return left if right == "0" else f"{left} - {right}"


# --- names ----------------------------------------------------------------------------------------

_VELOCITY = (
    r"dot_?(\w+)", r"d_?(\w+?)_?dt", r"d_?(\w+)", r"[Dv]_?(\w+)", r"vel(?:ocity)?_(\w+)",
    r"qd_(\w+)", r"(\w+?)_?dot", r"(\w+)_(?:d|v|t|p|prime|vel|velocity|rate|speed|diff)",
    r"(\w+?)(?:p|d|prime)",
)  # fmt: skip


def intended_velocity(name: str, tables: Mapping[str, str]) -> str:
    """Return the velocity, such as `theta_dot`, that an unknown name such as `dtheta` may mean.

    tables: maps each declared name of the scene to its table. Returns "" if no coordinate fits.
    """
    match = (re.fullmatch(pattern, name) for pattern in _VELOCITY)
    owners = (match[1] for match in match if match)
    return next((f"{owner}_dot" for owner in owners if tables.get(owner) == "coordinates"), "")


# --- files ----------------------------------------------------------------------------------------


def intended_file(path: Path) -> str:
    """Return the path of the existing scene file that a path which does not exist may mean.

    An example is scenes/cartpole.toml for `cartpole`. Returns "" if there is no such file.
    """
    name = path.name if path.suffix == ".toml" else f"{path.name}.toml"
    for folder in (path.parent, path.parent / "scenes", Path("scenes")):
        if path.name and (folder / name).is_file():
            return str(folder / name)
    return ""


def shipped_remedy(path: Path) -> str:
    """Return the command that writes the example scene of this name, as the end of a message.

    Returns "" if eomc has no example scene with the name of the file.
    """
    name = path.name.removesuffix(".toml")
    remedy = f"; eomc new --from {name} writes the one that comes with eomc"
    return remedy if name in resources.scenes() else ""
