"""Trees of bodies as scene texts: some written by hand, and a Hypothesis strategy for all kinds."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from hypothesis import strategies as st

from eomc.scene.joints import JOINTS

Entry = Mapping[str, Any]


def text(
    bodies: Sequence[Entry],
    gravity: Sequence[Any],
    parameters: Mapping[str, float],
    more: Sequence[tuple[str, Entry]] = (),
    start: float = 0.3,
) -> str:
    """Return a scene; `more`: the other tables, each with its heading."""
    moved_by = [q for body in bodies for q in _listed(body.get("coordinates", []))]
    names = dict.fromkeys(q for q in moved_by if q.isidentifier())  # the others are formulas
    tables = [
        ("[coordinates]", {q: {"start": round(start + 0.1 * k, 6)} for k, q in enumerate(names)}),
        ("[parameters]", parameters),
        *more,
        *(("[[body]]", body) for body in bodies),
    ]
    lines = ["eomc = 1", 'name = "tree"', f"gravity = {_toml(gravity)}"]
    for heading, entries in tables:
        lines += [heading, *(f"{key} = {_toml(value)}" for key, value in entries.items())]
    return "\n".join(lines)


def _listed(names: str | Sequence[str]) -> Sequence[str]:
    return [names] if isinstance(names, str) else names


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value)


# --- written by hand ------------------------------------------------------------------------------


def chain(links: int, points: bool = False) -> str:
    """Return a planar chain of equal rods, or of point masses at their ends, in relative angles."""
    rod = {"center": ["l", 0]} if points else {"center": ["l/2", 0], "inertia": "m*l**2/12"}
    bodies = [
        {"name": f"link{k}", "joint": "revolute", "coordinates": f"q{k}", "mass": "m", **rod,
         **({"parent": f"link{k - 1}", "offset": ["l", 0]} if k > 1 else {})}
        for k in range(1, links + 1)
    ]  # fmt: skip
    return text(bodies, [0, "-g"], {"m": 1.3, "l": 0.7, "g": 9.81}, start=0.1)


def arm(joints: int = 7, numbers: bool = False, straight: bool = False) -> str:
    """Return an arm with perpendicular axes and general inertias, as parameters or numbers.

    straight: the links are symmetric about their own x, y and z instead.
    """
    names = "m cx cy cz Ixx Iyy Izz Ixy Ixz Iyz d".split()
    parameters = {"g": 9.81}
    bodies = []
    for k in range(1, joints + 1):
        wave = [math.sin(1.7 * k + 2.9 * i) for i in range(len(names))]
        centre, size = 0.1, (1.5 + wave[0] / 2, 0.25 + wave[4] / 20)
        values = [
            size[0], *(centre * x for x in wave[1:4]), *(size[1] + x / 50 for x in wave[4:7]),
            *(x / 50 for x in wave[7:10]), 0.3 + wave[10] / 10,
        ]  # fmt: skip
        values_by_name = {f"{n}{k}": round(v, 6) for n, v in zip(names, values, strict=True)}
        m, cx, cy, cz, *moments, d = values_by_name.values() if numbers else values_by_name
        if not numbers:
            parameters |= values_by_name
        if straight:
            cx = cz = 0
            moments[3:] = 0, 0, 0
        place: Entry = {"offset": [0, 0, d]}
        if k > 1:
            turn = [["x", "pi/2" if k % 2 else "-pi/2"]]
            place = {"parent": f"link{k - 1}", "offset": [0, d, 0], "rotation": turn}
        bodies.append({"name": f"link{k}", "joint": "revolute", "coordinates": f"q{k}", "mass": m,
                       "center": [cx, cy, cz], "inertia": moments, **place})  # fmt: skip
    return text(bodies, [0, 0, "-g"], parameters)


def star(arms: int, joints: int = 3) -> str:
    """Return arms side by side on the world."""
    bodies = [
        {"name": f"b{a}_{k}", "joint": "revolute", "coordinates": f"q{a}_{k}", "mass": "m",
         "axis": [0, k % 2, 1 - k % 2], "center": [0.1, 0.2, "c"], "inertia": ["J", "J", "J"],
         "rotation": [["z", 0.3 + a]],
         **({"parent": f"b{a}_{k - 1}", "offset": ["l", 0, 0]} if k else {})}
        for a in range(arms)
        for k in range(joints)
    ]  # fmt: skip
    return text(bodies, [0, 0, "-g"], {"m": 1.0, "c": 0.3, "J": 0.02, "l": 0.5, "g": 9.81})


# --- random trees ---------------------------------------------------------------------------------

PARAMETERS = {"m": 1.3, "l": 0.6, "J": 0.05, "c": 0.2, "k": 30.0, "g": 9.81, "alpha": 0.4}

# Parent of each joint's body, -1 for the world: every tree of up to three joints, in every order.
SHAPES = [(-1,), *((-1, p) for p in (-1, 0)), *((-1, p, r) for p in (-1, 0) for r in (-1, 0, 1))]

PLANE = ("revolute", "prismatic")
SPACE = ("revolute", "prismatic", "revolute", "prismatic", "cylindrical", "screw", "universal")

GEARS = ("qb00", "-qb00", "-2*qb00 + 0.3", "alpha*qb00 - l", "sin(qb00)/2")  # of the first joint

_AXES = ([1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1], [1, 2, -2], [0.36, 0.48, -0.8])


@st.composite
def trees(draw: Any, shape: Sequence[int], plane: bool) -> str:
    """Return a tree of this shape as a scene, with random other features of scenes of bodies."""
    bodies: list[dict[str, Any]] = []
    kinds = [draw(st.sampled_from(PLANE if plane else SPACE)) for _ in shape]
    for k, (parent, kind) in enumerate(zip(shape, kinds, strict=True)):
        bodies.append(_body(draw, f"b{k}", parent, kind, k not in shape, plane))
    coordinates = [q for body in bodies for q in body["coordinates"]]
    if draw(st.booleans()):  # a body geared to the joints
        parent = draw(st.sampled_from(["world", *(body["name"] for body in bodies)]))
        geared = _body(draw, "geared", -1, draw(st.sampled_from(PLANE)), True, plane)
        geared |= {"parent": parent, "coordinates": draw(st.sampled_from(GEARS))}
        bodies.append(geared)
    if draw(st.booleans()):  # a fixed joint
        bodies.append(
            {"name": "load", "parent": draw(st.sampled_from(["world", "b0"])), "joint": "fixed",
             **_place(draw, plane), **_mass(draw, True, plane)}
        )  # fmt: skip
    more: list[tuple[str, Entry]] = []
    if draw(st.booleans()):
        q, last = coordinates[0], bodies[-1]["name"]
        energy = {"kinetic": f"m*dot({last}_x)**2/3 + J*(1 + sin({q})**2)*{q}_dot**2"}
        more.append(("[energy]", {**energy, "potential": f"k*{q}**2/5 + g*{last}_y"}))
        more.append(("[forces]", {coordinates[-1]: f"u*cos({q}) - c*{q}_dot"}))
    more.append(("[inputs]", {"u": {"signal": "sin(t)"}}))
    ends = [draw(st.sampled_from(["world", "b0"])), bodies[len(shape) - 1]["name"]]
    points = [_vector(draw, plane), [0.3, "l"] if plane else [0.3, "l", 0.2]]
    if ends[0] != ends[1] and draw(st.booleans()):
        length = draw(st.sampled_from([0, 0.2, "l"]))
        spring = {"bodies": ends, "points": points, "stiffness": "k", "length": length}
        more.append(("[[spring]]", spring))
        more.append(("[[damper]]", {"bodies": ends[::-1], "points": points, "damping": "c"}))
    if draw(st.booleans()):
        spring = {"coordinate": coordinates[-1], "stiffness": 3, "length": draw(_lengths)}
        more.append(("[[spring]]", spring))
        more.append(("[[damper]]", {"coordinate": coordinates[0], "damping": 0.1}))
    if plane and ends[0] != ends[1] and draw(st.booleans()):
        more.append(("[[spring]]", {"bodies": ends, "turning": True, "stiffness": "k"}))
    gravity = draw(st.sampled_from([[0, "-g"], [1.5, "-g"], [0, 0]]))
    return text(bodies, gravity if plane else [*gravity, "-g/2"], PARAMETERS, more)


_lengths = st.sampled_from([0, 0.1, "l"])


def _body(
    draw: Any, name: str, parent: int, kind: str, leaf: bool, plane: bool
) -> dict[str, Any]:  # fmt: skip
    number = len(JOINTS[kind].motions)
    body: dict[str, Any] = {
        "name": name, "joint": kind, "coordinates": [f"q{name}{i}" for i in range(number)],
        **_place(draw, plane), **_mass(draw, leaf, plane),
    }  # fmt: skip
    if parent >= 0:
        body["parent"] = f"b{parent}"
    if kind == "prismatic" and plane:
        body["axis"] = draw(st.sampled_from([[1, 0], [0, -1], [0.6, 0.8]]))
    elif kind == "universal":
        first = draw(st.sampled_from(range(3)))
        body["axis"] = [_AXES[first], _AXES[(first + 1) % 3]]
    elif not plane:
        body["axis"] = draw(st.sampled_from(_AXES))
    if kind == "screw":
        body["pitch"] = draw(st.sampled_from([0.2, "-l", "c/(2*pi)"]))
    for extra in ("armature", "damping", "friction", "actuator"):
        if draw(st.integers(0, 3)) == 0:
            body[extra] = {"armature": 0.02, "damping": "c", "friction": "c", "actuator": "u"}[
                extra
            ]
            if extra == "friction":
                body["friction_width"] = 0.5
    return body


def _place(draw: Any, plane: bool) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if draw(st.booleans()):
        out["offset"] = _vector(draw, plane)
    if draw(st.booleans()):
        angle = st.sampled_from(["pi/2", "-pi/2", "pi", 0.7, "alpha"])
        turns = [[draw(st.sampled_from("xyz")), draw(angle)] for _ in range(2)]
        out["rotation"] = draw(angle) if plane else turns
    return out


def _vector(draw: Any, plane: bool) -> list[Any]:
    entry = st.sampled_from([0, 0, 0.3, "l", "-l/2"])
    return [draw(entry) for _ in range(2 if plane else 3)]


def _mass(draw: Any, leaf: bool, plane: bool) -> dict[str, Any]:
    """Return the mass of a body; inside a tree possibly none, or that of a point or rod."""
    full = (
        [0.07, "J"] if plane else [["J", "J", "J"], [0.02, 0.03, "J/2"],
                                   [0.05, "J", 0.04, 0.004, -0.006, "J/20"]]
    )  # fmt: skip
    if not leaf and draw(st.integers(0, 2)) == 0:
        return {}
    mass = {"mass": draw(st.sampled_from([0.8, "m", "2*m"])), "center": _vector(draw, plane)}
    if leaf or draw(st.booleans()):
        mass["inertia"] = draw(st.sampled_from(full))
    return mass


def geared(wheel: str, slide: str) -> str:
    """Return a wheel and a slide that move by these formulas of an arm's coordinates."""
    mass = {"mass": "m", "center": [0.1, -0.2, "l/3"], "inertia": [0.05, "J", 0.04, 0.004, 0, 0]}
    more = {"armature": 0.03, "damping": "c", "friction": "c", "friction_width": 0.5}
    bodies = [
        {"name": "arm", "joint": "revolute", "coordinates": "a", "axis": [1, 2, -2], **mass},
        {"name": "hand", "parent": "arm", "joint": "universal", "coordinates": ["b", "a - b"],
         "offset": ["l", 0, 0], **mass},
        {"name": "wheel", "parent": "arm", "joint": "revolute", "coordinates": wheel,
         "offset": [0, "l", 0], "axis": [0, 1, 0], **mass, **more, "actuator": "u"},
        {"name": "slide", "parent": "wheel", "joint": "prismatic", "coordinates": slide,
         "axis": [3, 0, 4], **mass, **more},
    ]  # fmt: skip
    inputs = ("[inputs]", {"u": {"signal": "sin(t)"}})
    return text(bodies, [0, 1, "-g"], PARAMETERS, [inputs])
