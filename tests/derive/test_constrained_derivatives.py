"""Compare derivatives of constrained accelerations by residuals with forward differentiation.

Both are evaluated in forty digits at states around the start. Nothing is compiled here.
"""

from __future__ import annotations

import inspect
from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import Any

import pytest
from support.cases import SCENES, scene_system
from support.session import tiers
from test_inverse_dynamics_derivatives import functions
from test_kkt import DOUBLE, LINKS, with_constraints

import eomc
from eomc.derive import constraints, lagrange
from eomc.model.symbols import symbol
from eomc.model.system import System
from eomc.program import program, routes
from eomc.program.ir import Function, evaluate, nearby

QUICK = ("slider_crank", "pendulum_xy")
NAMES = (
    *QUICK,
    "four_bar",
    "quadrotor",
    "rolling_disk",
    "delta_robot",
    "andrews_squeezer",
    "bricard",
)


def largest_difference(one: Function, other: Function, system: System) -> float:
    """Return the largest difference of two functions at three states, of the largest entry."""
    differences = []
    for k in range(3):
        state = nearby(system, k) | {i.name: 0.7 for i in system.inputs}
        (first, regular), (second, other_regular) = (
            evaluate(f, state, exact=True) for f in (one, other)
        )
        assert regular and other_regular
        size = max(map(abs, first))
        differences += [abs(a - b) / size for a, b in zip(first, second, strict=True)]
    return float(max(differences))


@cache
def compared(name: str) -> tuple[System, dict[str, Function]]:
    system = eomc.read(SCENES / f"{name}.toml")
    return system, functions(system)


@pytest.mark.parametrize("name", tiers(NAMES, *QUICK))
def test_derivatives_by_residuals_agree_with_forward_differentiation(name: str) -> None:
    """Bricard's linkage has redundant constraints, the quadrotor's D is singular without them."""
    system, by_route = compared(name)
    assert {*by_route} == {"forward", "kkt"}
    assert largest_difference(*by_route.values(), system) < 1e-25


def test_derivatives_agree_where_only_constraints_move_a_coordinate() -> None:
    system = with_constraints(DOUBLE, **LINKS)
    system = replace(system, kinetic=system.kinetic.subs(symbol("x2_dot"), 0))
    by_route = functions(system)
    assert largest_difference(by_route["forward"], by_route["kkt"], system) < 1e-25


def test_modes_exclude_derivatives_by_residuals() -> None:
    """Constraints that modes switch have factors of their own."""
    material = routes.RouteInputs(lagrange.derive(scene_system("pendulum_xy")))
    taken = program.accelerations(material)[1]
    e = material.derived.lagrange
    assert e is not None and e.rows is not None
    switched = replace(e, rows=replace(e.rows, switched=frozenset({0})))
    material.derived = replace(material.derived, lagrange=switched)
    assert routes.ROUTES["kkt"].linearization(material, taken) is None


MUTANTS = (
    ("minus_product(db[i], dD[i])", "minus_product(db[i], D[i])"),
    ("minus_product(db[i], dD[i])", "[db[i]]"),
    ("*minus_product(db[i], dD[i]), ", ""),
    ("tape.times(dA[r][i], multipliers[r])", "tape.times(A[r][i], multipliers[r])"),
    ("minus_product(dc[r], dA[r])", "[dc[r]]"),
    ("minus_product(dc[r], dA[r])", "minus_product(S.Zero, dA[r])"),
    ("*(tape.scaled(S.NegativeOne, y) for y in products)", "*products"),
)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        pytest.param(*mutant, marks=() if k % 6 == 0 else pytest.mark.slow)
        for k, mutant in enumerate(MUTANTS)
    ],
)
def test_each_term_of_the_residuals_is_tested(
    old: str, new: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The comparison fails where a term is left out or has another sign or factor."""
    source = inspect.getsource(constraints)
    changed = " ".join(source.split()).count(" ".join(old.split()))
    assert changed == 1
    mutant: Any = ModuleType("mutant")
    mutant.__dict__["__name__"] = constraints.__name__
    exec(source.replace(old, new), mutant.__dict__)
    system, routes_of_module = compared("slider_crank")
    monkeypatch.setattr(routes, "linearize_constrained", mutant.linearize_constrained)
    wrong = functions(system)["kkt"]
    assert largest_difference(routes_of_module["forward"], wrong, system) > 1e-6
