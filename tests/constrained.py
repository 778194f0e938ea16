"""The cases with constraints and trusted answers in data/constrained.json, as systems."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from eomc.model.from_scene import from_scene
from eomc.model.system import System
from eomc.scene.read import parse

DATA = Path(__file__).parent / "data" / "constrained.json"
ROW = "row_"  # a constraint's name, before its number


@cache
def cases() -> dict[str, dict[str, Any]]:
    """The cases by name; the file's own \"contract\" says what their keys mean."""
    return {case["name"]: case for case in json.loads(DATA.read_text())["cases"]}


def quoted(pairs: dict[str, str]) -> list[str]:
    """Lines of TOML."""
    return [f"{name} = {json.dumps(text)}" for name, text in pairs.items()]


@cache
def system(name: str, start: str = "assembled", redundant: bool = True) -> System:
    """A case as a System, with the coarsest measured step size and t_end as its run.

    start: "assembled", or the "guess" with what is held. redundant: whether the rows that
    lambda_ref leaves out are marked.
    """
    case = cases()[name]
    rows = [*case["constraints"], *case["velocity_constraints"]]
    from_guess = start == "guess"
    q, qd = (case["guess"]["q"], case["guess"]["qd"]) if from_guess else (case["q0"], case["qd0"])
    starts = zip(case["coordinates"], q, qd, strict=True)
    h = case["rk4_measured"][0]["h"] if case["rk4_measured"] else 0.01
    made = from_scene(
        parse(
            "\n".join(
                [
                    "eomc = 1",
                    f'name = "{name.lower()}"',
                    "[coordinates]",
                    *(f'{c} = {{ start = "{x}", rate = "{v}" }}' for c, x, v in starts),
                    "[parameters]",
                    *(f"{p} = {float(value)!r}" for p, value in case["parameters"].items()),
                    "[definitions]",
                    *quoted(case.get("definitions") or {}),
                    "[constraints]",
                    *quoted({f"{ROW}{k}": row for k, row in enumerate(rows)}),
                    "[energy]",
                    *quoted({"kinetic": case["K"], "potential": case["P"]}),
                    "[forces]",
                    *quoted(case["generalized_forces"]),
                    "[run]",
                    f"h = {h!r}",
                    f"duration = {float(case['t_end'])!r}",
                ]
            ),
            f"{name}.toml",
        )
    )
    kept = (case["redundant"] or {}).get("lambda_rows", range(len(rows)))
    constraints = tuple(
        replace(c, redundant=redundant and k not in kept) for k, c in enumerate(made.constraints)
    )
    coordinates = tuple(
        replace(
            c,
            start_fixed=not from_guess or c.name in case["held"],
            rate_fixed=not from_guess or c.name in case["held_rates"],
        )
        for c in made.coordinates
    )
    return replace(
        made,
        constraints=constraints,
        coordinates=coordinates,
    )


def ends(name: str, *keys: str) -> tuple[np.ndarray, ...]:
    """Vectors of a case: q_ref, qd_ref, qdd_ref, lambda_ref (0 of redundant rows), ..."""
    case, found = cases()[name], []
    for key in keys:
        x = np.array(case[key], float)
        if key.startswith("lambda") and case["redundant"]:
            whole = np.zeros(case["redundant"]["rows"])
            whole[case["redundant"]["lambda_rows"]] = x
            x = whole
        found.append(x)
    return tuple(found)


def error_of(name: str, q: Any) -> float:
    """The error of q at t_end, relative to max(1, the largest entry)."""
    (reference,) = ends(name, "q_ref")
    return float(np.max(np.abs(np.asarray(q) - reference)) / max(1, np.max(np.abs(reference))))
