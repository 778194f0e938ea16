"""Rows of `eomc check` about what constraints hold notice what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cases import SCENES, scene_system
from conftest import Modules

from eomc.model.from_scene import from_scene
from eomc.program.assembly import assembled
from eomc.scene.read import parse
from eomc.verify import checks_constraints
from eomc.verify.check import check
from eomc.verify.checks_constraints import MAX_RESIDUAL, WORK_TOLERANCE, ConstraintChecks
from eomc.verify.checks_refusals import OK, RefusalChecks
from eomc.verify.comparison import Comparison
from eomc.verify.report import LIMIT
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


def failed(module: Any, report: Callable[[Comparison], None]) -> set[str]:
    """Of the rows that one part of the check adds."""
    made = Comparison(BOB, module, np.random.default_rng(0), 4)
    report(made)
    return {row.name for row in made.results if not row.passed}


class Bent:
    """A module whose tangents lead a thousandth off the rows."""

    def __init__(self, module: ModuleType) -> None:
        self.module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self.module, name)

    def tangent(self, *state: Any, **how: Any) -> Any:
        return self.module.tangent(*state, **how) + 1e-3


@pytest.mark.slow
def test_what_is_right_passes(bob: ModuleType) -> None:
    rows = check(BOB, bob, states=4).results
    assert {row.name for row in rows} >= {"tangent", "negative D along the rows"}
    assert all(row.passed for row in rows)


def test_a_tangent_that_leaves_the_rows_fails(bob: ModuleType) -> None:
    assert failed(Bent(bob), checks_constraints.report) == {"tangent"}


class Answering:
    """A module made of the reference alone, with what one of its values goes through."""

    def __init__(self, of: Comparison, **bent: Callable[[Any], Any]) -> None:
        self.reference, self.bent = of.reference, bent

    def __getattr__(self, name: str) -> Any:
        bend = self.bent.get(name, lambda found: found)

        def found(q: Any, qd: Any = None, t: float = 0.0, u: Any = None, params: Any = None) -> Any:
            if name in ("multipliers", "reactions"):
                return bend(self.reference.multipliers(q, qd, t, u, params))
            return bend(self.reference.evaluate(name, q, qd, t, u, params))

        return found


@pytest.fixture(scope="module")
def hinged() -> Comparison:
    """A four-bar with a crank that hardly moves."""
    of = Comparison(assembled(scene_system("four_bar")), None, np.random.default_rng(0), 2)
    of.sampler.spread[0] = 1e-7
    return of


@pytest.mark.parametrize(
    ("sign", "least", "most"), [(1, 0, WORK_TOLERANCE), (-1, 0.1, 2), (np.nan, 1, np.inf)]
)
def test_reactions_are_compared_where_a_coordinate_hardly_moves(
    hinged: Comparison, sign: float, least: float, most: float
) -> None:
    """What is no number passed."""
    made = ConstraintChecks(
        hinged, Answering(hinged, reactions=lambda f: {"pin": [sign * f[0], f[1], 0]})
    )
    assert least <= made.reaction_error() <= most


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
    "bent", [{}, {"constraint_rates": np.zeros_like}, {"constraint_jacobian": np.abs}]
)
def test_rows_do_the_work_of_their_parts_without_rates(bent: dict[str, Any]) -> None:
    """A belt's with no t in it, of which it was expected that it does none."""
    system = assembled(from_scene(parse(BELT)))
    of = Comparison(system, None, np.random.default_rng(0), 4)
    power = ConstraintChecks(of, Answering(of, **bent)).power_error()
    assert (power > LIMIT) == bool(bent)


def test_accelerations_of_negative_masses_fail(
    bob: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RefusalChecks, "accelerate", lambda *_: (OK, True))
    assert failed(bob, lambda made: RefusalChecks(made).report()) == {"negative D along the rows"}


@pytest.mark.slow
def test_multipliers_of_negative_masses_fail(
    bob: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = RefusalChecks.call

    def found(self: RefusalChecks, name: str, s: Any) -> Any:
        return None if name == "multipliers" else call(self, name, s)

    monkeypatch.setattr(RefusalChecks, "call", found)
    told = {"negative D along the rows: refusals"}
    assert failed(bob, lambda made: RefusalChecks(made).report()) == told


def test_states_with_a_negative_d_are_left_out() -> None:
    """Of a scene with a mass that its coordinates may make negative, these say nothing."""
    kinetic = "(m - 2*x)*(x_dot**2 + y_dot**2)/2"
    text = SCENE.replace("m*(x_dot**2 + y_dot**2)/2", kinetic)
    system = assembled(from_scene(parse(text)))
    sampler = Sampler(reference_for(system), np.random.default_rng(0), SMALL)
    heavy, light = (replace(sampler.start, q=np.array(q)) for q in ((0.0, -1.0), (1.0, 0.0)))
    assert sampler.regular(heavy) and not sampler.regular(light)


@pytest.mark.slow
def test_runs_whose_step_is_too_long_are_no_fault_of_the_rows(modules: Modules) -> None:
    """Angles of 1e37, whose sines are anything, were taken for rows that are not held."""
    system = assembled(from_scene(parse((SCENES / "four_bar.toml").read_text("utf-8") + STIFF)))
    module, random = modules.unoptimised(system), np.random.default_rng(0)
    made = ConstraintChecks(Comparison(system, module, random, 4), module)
    found = made.residual_along_run("rk4")
    assert isinstance(found, float) and 0 < found < MAX_RESIDUAL
