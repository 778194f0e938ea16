"""Keys of other programs and textbooks, and the keys of a scene that they stand for."""

from __future__ import annotations

ALIASES = {
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
ALIASES_OF = {
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
