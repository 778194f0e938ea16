"""Checks of constraints detect errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES, scene_system
from support.session import Modules
from support.template_checks import check_all
from support.template_checks.refusals import OK, RefusalChecks

from eomc.mechanism.assembly import assembled
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify import constraints
from eomc.verify.check import Table
from eomc.verify.comparison import LIMIT, Comparison
from eomc.verify.constraints import MAX_RESIDUAL, WORK_TOLERANCE
from eomc.verify.sampling import SMALL, Sampler
from eomc.verify.symbolic import reference_for

SCENE = """eomc = 1
name = "held_bob"
[coordinates]
x = { start = 0.6 }
y = { start = -0.8 }
[parameters]
m = 1.2
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "m*9.81*y"
[constraints]
rod = "x**2 + y**2 - 1"
[run]
linearize = true
"""
STIFF = """
[[spring]]
coordinate = "q1"
stiffness = 1e5
length = 1.0
"""
BOB = assembled(from_scene(parse(SCENE)))


@pytest.fixture(scope="module")
def bob(modules: Modules) -> ModuleType:
    return modules.unoptimised(BOB)


def failed_checks(module: Any, table: Table) -> set[str]:
    """Return the failed checks of one table."""
    comparison = Comparison(BOB, module, np.random.default_rng(0), 4)
    return {row.name for row in comparison.report(table) if not row.passed}


class WrongTangent:
    """A module whose tangents violate the constraints by a thousandth."""

    def __init__(self, module: ModuleType) -> None:
        self.module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self.module, name)

    def tangent(self, *state: Any, **how: Any) -> Any:
        return self.module.tangent(*state, **how) + 1e-3


@pytest.mark.slow
def test_correct_module_passes(bob: ModuleType) -> None:
    rows = check_all(BOB, bob, states=4).results
    assert {row.name for row in rows} >= {"tangent", "negative D along the rows"}
    assert all(row.passed for row in rows)


def test_tangent_that_violates_the_constraints_fails(bob: ModuleType) -> None:
    assert failed_checks(WrongTangent(bob), constraints.checks) == {"tangent"}


class ReferenceModule:
    """A module that returns the reference's values, with a change applied to some of them."""

    def __init__(self, of: Comparison, **changes: Callable[[Any], Any]) -> None:
        self.reference, self.changes = of.reference, changes

    def __getattr__(self, name: str) -> Any:
        bend = self.changes.get(name, lambda value: value)

        def evaluate(
            q: Any, qd: Any = None, t: float = 0.0, u: Any = None, params: Any = None
        ) -> Any:
            if name in ("multipliers", "reactions"):
                return bend(self.reference.multipliers(q, qd, t, u, params))
            return bend(self.reference.evaluate(name, q, qd, t, u, params))

        return evaluate


@pytest.fixture(scope="module")
def hinged() -> Comparison:
    """A four-bar with a crank that hardly moves."""
    of = Comparison(assembled(scene_system("four_bar")), None, np.random.default_rng(0), 2)
    of.sampler.spread[0] = 1e-7
    return of


@pytest.mark.parametrize(
    ("sign", "least", "most"), [(1, 0, WORK_TOLERANCE), (-1, 0.1, 2), (np.nan, 1, np.inf)]
)
def test_reactions_are_compared_if_a_coordinate_hardly_moves(
    hinged: Comparison, sign: float, least: float, most: float
) -> None:
    """NaN used to pass."""
    hinged.module = ReferenceModule(hinged, reactions=lambda f: {"pin": [sign * f[0], f[1], 0]})
    errors = [constraints.reaction_error(hinged, e) for e in hinged.few(4)]
    assert least <= max(errors) <= most


BELT = """eomc = 1
name = "belt"
[coordinates]
x = {}
y = { start = 1.0 }
z = {}
[energy]
kinetic = "x_dot**2/2 + y_dot**2/2 + z_dot**2/2"
potential = "y**2/2 + z**2"
[constraints]
belt = "x_dot - y"
wheel = "z_dot - x*y_dot"
motor = "y + z - sin(t) - 1"
"""


@pytest.mark.parametrize(
    "changes", [{}, {"constraint_rates": np.zeros_like}, {"constraint_jacobian": np.abs}]
)
def test_constraint_power_follows_from_explicit_time_terms(changes: dict[str, Any]) -> None:
    """A belt's constraint without explicit time was expected to do no work."""
    system = assembled(from_scene(parse(BELT)))
    of = Comparison(system, None, np.random.default_rng(0), 4)
    of.module = ReferenceModule(of, **changes)
    power = max(constraints.power_error(of, e) for e in of.expected)
    assert (power > LIMIT) == bool(changes)


def test_accelerations_of_negative_masses_fail(
    bob: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RefusalChecks, "accelerate", lambda *_: (OK, True))
    assert failed_checks(bob, lambda of: RefusalChecks(of).checks()) == {
        "negative D along the rows"
    }


@pytest.mark.slow
def test_multipliers_of_negative_masses_fail(
    bob: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = RefusalChecks.call

    def call_without_multipliers(self: RefusalChecks, name: str, s: Any) -> Any:
        return None if name == "multipliers" else call(self, name, s)

    monkeypatch.setattr(RefusalChecks, "call", call_without_multipliers)
    expected = {"negative D along the rows: refusals"}
    assert failed_checks(bob, lambda of: RefusalChecks(of).checks()) == expected


def test_states_with_negative_D_are_skipped() -> None:
    """These states are meaningless for a scene whose coordinates may make a mass negative."""
    kinetic = "(m - 2*x)*(x_dot**2 + y_dot**2)/2"
    text = SCENE.replace("m*(x_dot**2 + y_dot**2)/2", kinetic)
    system = assembled(from_scene(parse(text)))
    sampler = Sampler(reference_for(system), np.random.default_rng(0), SMALL)
    heavy, light = (replace(sampler.start, q=np.array(q)) for q in ((0.0, -1.0), (1.0, 0.0)))
    assert sampler.regular(heavy) and not sampler.regular(light)


@pytest.mark.slow
def test_runs_with_too_long_steps_do_not_fail_the_constraint_check(modules: Modules) -> None:
    """Angles of 1e37, whose sines are meaningless, used to be reported as violated constraints."""
    system = assembled(from_scene(parse((SCENES / "four_bar.toml").read_text("utf-8") + STIFF)))
    module, random = modules.unoptimised(system), np.random.default_rng(0)
    of = Comparison(system, module, random, 4)
    residuals = [constraints.residual_along_run("rk4", of, e) for e in of.few(3)]
    assert 0 < max(x for x in residuals if x is not None) < MAX_RESIDUAL
