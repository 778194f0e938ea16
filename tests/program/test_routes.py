"""Every route of the registry computes the same motion; its entry tests a new one."""

from __future__ import annotations

import ast
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.cases import scene_system

from eomc.derive.lagrange import derive
from eomc.derive.ldl import Solution
from eomc.program import program, routes
from eomc.program.ir import evaluate, nearby
from eomc.program.lower import lower
from eomc.program.routes import ROUTES, RouteInputs

SCENES = ("simple_pendulum", "cartpole", "cartpole_bodies", "suspension")


@cache
def solutions(scene: str) -> dict[str, Solution]:
    material = RouteInputs(derive(scene_system(scene)))
    solution_of_route = {route.name: route.accelerations(material) for route in ROUTES.values()}
    return {
        name: solution
        for name, solution in solution_of_route.items()
        if isinstance(solution, Solution)
    }


def test_each_route_applies_to_some_scene() -> None:
    used = {name for scene in SCENES for name in solutions(scene)}
    material = RouteInputs(derive(scene_system("cartpole_bodies")))
    used |= {r.name for r in ROUTES.values() if r.functions(material)}
    for scene in ("cartpole_bodies", "four_bar"):
        material = RouteInputs(derive(scene_system(scene)))
        taken = program.accelerations(material)[1]
        used |= {r.name for r in ROUTES.values() if r.linearization(material, taken)}
    assert used == ROUTES.keys()


@pytest.mark.parametrize("scene", SCENES)
def test_all_routes_agree_in_forty_digits(scene: str) -> None:
    system = scene_system(scene)
    results = {
        name: lower("acceleration", solution.tape, solution.acceleration, checks=solution.pivots)
        for name, solution in solutions(scene).items()
    }
    assert len(results) > 1
    for k in range(3):
        state = nearby(system, k) | {i.name: 0.7 for i in system.inputs}
        expected, _ = evaluate(results["lagrange"], state, exact=True)
        for name, function in results.items():
            result, regular = evaluate(function, state, exact=True)
            assert regular, name
            np.testing.assert_allclose(result, expected, rtol=1e-15, atol=1e-25, err_msg=name)


def test_inverse_rotations_cancel_in_c() -> None:
    """For a tumbling box the expression differs from Newton and Euler's, the value does not."""
    material = RouteInputs(derive(scene_system("tumbling_box")))
    plain, short = (ROUTES[name].functions(material) for name in ("newton-euler", "rotated"))
    assert plain is not None and short is not None
    functions_of_C = [lower("C", f.tape, f.outputs["C"]) for f in (plain, short)]
    assert (
        functions_of_C[0].cost.multiplications > 60 and functions_of_C[1].cost.multiplications < 50
    )
    for k in range(3):
        one, other = (
            evaluate(f, nearby(material.derived.system, k), exact=True)[0] for f in functions_of_C
        )
        np.testing.assert_allclose(other, one, rtol=1e-15, atol=1e-25)


@pytest.mark.parametrize("name", ROUTES)
def test_comment_names_the_route_for_the_mass_matrix(name: str) -> None:
    route = ROUTES[name]
    assert route.sentence
    assert "x, theta" in route.solved(scene_system("cartpole"), "x, theta")


def test_no_other_file_compares_names_of_routes() -> None:
    package = Path(__file__).parents[2] / "generator" / "eomc"
    files = [f for f in package.rglob("*.py") if f.name != "routes.py"]
    texts = {f: f.read_text(encoding="utf-8") for f in files}
    files_with_names = {
        f: text for f, text in texts.items() if any(f'"{route}"' in text for route in ROUTES)
    }
    trees = {f: ast.parse(text) for f, text in files_with_names.items()}
    compared = [
        (f.name, node.lineno)
        for f, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Compare)
        for part in ast.walk(node)
        if isinstance(part, ast.Constant) and part.value in ROUTES
    ]
    assert len(files) > 100
    assert not compared


def test_states_without_a_result_of_any_route_are_ignored() -> None:
    errors = {"one": [math.inf, *[1e-16] * 3, 3e-16], "other": [math.inf, *[1e-16] * 3, math.inf]}
    assert routes.largest_errors(errors) == {"one": 3e-16, "other": math.inf}
    assert routes.largest_errors({"one": [math.inf]}) == {"one": 0.0}
