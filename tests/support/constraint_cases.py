"""The cases with constraints and reference solutions in data/constrained.json, as systems."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from eomc.model.system import System, from_scene
from eomc.scene.read import parse

DATA = Path(__file__).parents[1] / "data" / "constrained.json"
ROW = "row_"  # prefix of constraint names, before their number


@cache
def cases() -> dict[str, dict[str, Any]]:
    """Return the cases by name; "contract" in the file explains their keys."""
    return {case["name"]: case for case in json.loads(DATA.read_text())["cases"]}


def quoted(pairs: dict[str, str]) -> list[str]:
    """Return lines of TOML."""
    return [f"{name} = {json.dumps(text)}" for name, text in pairs.items()]


@cache
def system(name: str, start: str = "assembled", redundant: bool = True) -> System:
    """Return a case as a System, with the largest measured step size and t_end as its run.

    start: "assembled", or "guess" with the fixed initial values. redundant: mark the constraints
    that lambda_ref omits as redundant.
    """
    case = cases()[name]
    rows = [*case["constraints"], *case["velocity_constraints"]]
    from_guess = start == "guess"
    q, qd = (case["guess"]["q"], case["guess"]["qd"]) if from_guess else (case["q0"], case["qd0"])
    starts = zip(case["coordinates"], q, qd, strict=True)
    h = case["rk4_measured"][0]["h"] if case["rk4_measured"] else 0.01
    system_of_case = from_scene(
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
    independent = (case["redundant"] or {}).get("lambda_rows", range(len(rows)))
    constraints = tuple(
        replace(c, redundant=redundant and k not in independent)
        for k, c in enumerate(system_of_case.constraints)
    )
    coordinates = tuple(
        replace(
            c,
            start_fixed=not from_guess or c.name in case["held"],
            rate_fixed=not from_guess or c.name in case["held_rates"],
        )
        for c in system_of_case.coordinates
    )
    return replace(
        system_of_case,
        constraints=constraints,
        coordinates=coordinates,
    )


def ends(name: str, *keys: str) -> tuple[np.ndarray, ...]:
    """Return vectors of a case: q_ref, qd_ref, qdd_ref, lambda_ref (0 if redundant), ..."""
    case, vectors = cases()[name], []
    for key in keys:
        x = np.array(case[key], float)
        if key.startswith("lambda") and case["redundant"]:
            whole = np.zeros(case["redundant"]["rows"])
            whole[case["redundant"]["lambda_rows"]] = x
            x = whole
        vectors.append(x)
    return tuple(vectors)


def error_of(name: str, q: Any) -> float:
    """Return the error of q at t_end, relative to max(1, the largest entry)."""
    (reference,) = ends(name, "q_ref")
    return float(np.max(np.abs(np.asarray(q) - reference)) / max(1, np.max(np.abs(reference))))
