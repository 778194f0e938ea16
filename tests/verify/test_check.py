"""The check passes correct modules and fails wrong ones, in the corresponding check."""

from __future__ import annotations

import json
import math
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy
from support.cases import scene_system
from support.fake_module import (
    FakeModule,
    delay_time,
    ignore,
    modify,
    negate,
    set_,
    simplify_reference,
)
from support.session import Modules, tiers

from eomc.model.system import System, symbol
from eomc.model.system import from_scene as system_of
from eomc.scene.read import parse
from eomc.verify import convergence, equations, runs, sampling
from eomc.verify import symbolic as references
from eomc.verify.check import TABLES, check
from eomc.verify.comparison import CheckReport, Comparison, Measurement
from eomc.verify.convergence import Convergence, advice_checks
from eomc.verify.sampling import LARGE
from eomc.verify.symbolic import SymbolicReference, derive

# What is broken, how, and the checks that must fail.
BROKEN = {
    "a sign in D": (
        "cartpole_driven", modify("D", negate(0, 1)), {"D", "D = D^T", "D qdd + bias = tau"},
    ),
    "a sign in D, on the diagonal": ("cartpole_driven", modify("D", negate(1, 1)), {"D", "D > 0"}),
    "both signs off D's diagonal": (
        "cartpole_driven", modify("D", lambda D: D * [[1, -1], [-1, 1]]),
        {"D", "D qdd + bias = tau", "Ddot - 2C + dD/dt skew"},
    ),
    "a sign in C": (
        "cartpole_driven", modify("C", negate(0, 1)),
        {"C", "bias = C qd + g", "Ddot - 2C + dD/dt skew"},
    ),
    "the sign of Coriolis's force": (
        "foucault_pendulum", modify("C", np.transpose), {"C", "bias = C qd + g"},
    ),
    "a sign in g": ("cartpole_driven", modify("g", negate(1)), {"g", "bias = C qd + g"}),
    "a sign in bias": (
        "cartpole_driven", modify("bias", negate(0)),
        {"bias", "bias = C qd + g", "D qdd + bias = tau"},
    ),
    "tau without its input": ("cartpole_driven", ignore("tau", "u"), {"tau", "D qdd + bias = tau"}),
    "a sign in tau": ("cartpole_driven", modify("tau", np.negative), {"tau", "D qdd + bias = tau"}),
    "a sign in an acceleration": (
        "cartpole_driven", modify("acceleration", negate(1)),
        {"acceleration", "D qdd + bias = tau", "one step", "run", "power balance"},
    ),
    "accelerations without inputs": (
        "cartpole_driven", ignore("acceleration", "u"),
        {"acceleration", "D qdd + bias = tau", "one step"},
    ),
    "a weight of Runge and Kutta's": (
        "cartpole", set_("weights", np.array([1, 2, 1, 2]) / 6),
        {"one step", "run", "order of rk4"},
    ),
    "weights of order 1": (
        "cartpole", set_("weights", np.array([1, 0, 0, 0])), {"one step", "run", "order of rk4"},
    ),
    "the time of a step": ("cartpole_driven", delay_time, {"one step"}),
    "a parameter ignored in D": ("cartpole", ignore("D", "params"), {"D", "D qdd + bias = tau"}),
    "a parameter ignored in g": ("heavy_top", ignore("g", "params"), {"g", "bias = C qd + g"}),
    "parameters ignored in a run": ("mass_spring", ignore("simulate", "params"), {"run"}),
    "kinetic energy": ("cartpole", modify("kinetic_energy", lambda e: 2 * e), {"kinetic_energy"}),
    "potential energy": ("cartpole", modify("potential_energy", np.negative), {"potential_energy"}),
    "energy": (
        "cartpole", modify("energy", lambda e: e * (1 + 1e-9)), {"energy", "energy of the run"},
    ),
    "jacobi, taken for the energy": (
        "bead_on_hoop", lambda m: setattr(m, "jacobi", m.energy), {"jacobi", "power balance"},
    ),
    "the sign of the power": (
        "kapitza_pendulum", modify("power", np.negative), {"power", "power balance"},
    ),
    "no power": ("cartpole_driven", modify("power", lambda p: 0 * p), {"power", "power balance"}),
    "a value that is not a number": ("cartpole", modify("g", lambda g: g * np.nan), {"g"}),
    "a shape": ("cartpole", modify("g", lambda g: g[:1]), {"g"}),
    "names": ("cartpole", set_("coordinates", ("theta", "x")), {"names, defaults, start"}),
    "defaults": ("cartpole", set_("defaults", {}), {"names, defaults, start"}),
    "a run's status": (
        "cartpole",
        modify("simulate", lambda run: SimpleNamespace(**vars(run) | {"status": "lost"})),
        {"run"},
    ),
}  # fmt: skip


@cache
def reference(name: str) -> SymbolicReference:
    return derive(scene_system(name))


def failed_checks(report: CheckReport) -> set[str]:
    return {row.name for row in report.results if not row.passed}


@cache
def report_of_mass_spring() -> CheckReport:
    """The report of a mass on a spring, which several tests read."""
    return check(scene_system("mass_spring"), FakeModule(reference("mass_spring")), states=4)


@pytest.mark.parametrize(
    "name",
    tiers(
        (
            "mass_spring",
            "cartpole_driven",
            "furuta_pendulum",
            "kapitza_pendulum",
            "foucault_pendulum",
        ),
        "mass_spring",
    ),
)
def test_correct_module_passes(name: str) -> None:
    """The simplified equations round differently."""
    report = check(scene_system(name), FakeModule(simplify_reference(reference(name))))
    assert report.passed, report.table()
    values = [row for row in report.results if row.unit == "units of rounding"]
    assert max(row.error for row in values) < 2
    order = next(row for row in report.results if row.name == "order of rk4")
    assert order.error == pytest.approx(4, abs=0.2)


# Checks of runs with several step sizes, which take most of the time.
OF_RUNS = {"order of rk4", "power balance"}
WITHOUT_ORDERS = tuple(table for table in TABLES if table is not convergence.checks)
LONG = {what for what, (_, _, rows) in BROKEN.items() if rows & OF_RUNS}
# Each check once; test_breaks and tests/physics/test_steppers cover an order that is too low.
QUICK = (
    "a sign in D", "a sign in D, on the diagonal", "a sign in C", "a sign in g", "a sign in bias",
    "a sign in tau", "a sign in an acceleration", "the time of a step",
    "parameters ignored in a run", "kinetic energy", "potential energy", "energy", "no power",
    "a value that is not a number", "a shape", "names", "a run's status",
)  # fmt: skip


def check_broken(
    what: str, monkeypatch: pytest.MonkeyPatch, states: int | None = None
) -> CheckReport:
    """Check a broken module, without checks of runs that do not concern the breakage."""
    name, break_, _ = BROKEN[what]
    module = FakeModule(reference(name))
    break_(module)
    tables = TABLES
    if what in LONG:
        monkeypatch.setattr(convergence, "advice_checks", lambda *_: ())
    else:
        tables = WITHOUT_ORDERS
    return check(scene_system(name), module, states=states, tables=tables)


@pytest.mark.parametrize("what", tiers(BROKEN, *QUICK))
def test_wrong_module_fails(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    report = check_broken(what, monkeypatch, states=4)
    assert BROKEN[what][2] <= failed_checks(report), report.table()
    assert not report.passed


@pytest.fixture
def as_if_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use Taylor arithmetic as reference, and scales from changing all inputs at once, as for
    large systems.
    """
    monkeypatch.setattr(references, "MAX_SIZE", 0)
    monkeypatch.setattr(sampling, "MOST_NUDGES", 0)


@pytest.mark.parametrize("name", tiers(("cartpole_driven", "foucault_pendulum"), "cartpole_driven"))
def test_correct_module_passes_as_if_large(name: str, as_if_large: None) -> None:
    report = check(scene_system(name), FakeModule(simplify_reference(reference(name))))
    assert report.passed, report.table()
    assert report.states == LARGE.states
    assert report.reference == "Taylor arithmetic"
    assert "6 random states, against Taylor arithmetic" in " ".join(report.table().split())
    values = [row for row in report.results if row.unit == "units of rounding"]
    assert max(row.error for row in values) < 10  # combined scales are smaller


@pytest.mark.parametrize(
    "what",
    tiers(
        ("a sign in D", "a sign in C", "the sign of Coriolis's force", "a sign in g",
         "a sign in bias", "a sign in tau", "a sign in an acceleration",
         "accelerations without inputs",
         "a weight of Runge and Kutta's", "the time of a step", "a parameter ignored in D",
         "parameters ignored in a run", "kinetic energy", "energy", "jacobi, taken for the energy",
         "the sign of the power"),
        "a sign in C", "a parameter ignored in D", "energy",
    ),
)  # fmt: skip
def test_wrong_module_fails_as_if_large(
    what: str, as_if_large: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = check_broken(what, monkeypatch)
    assert BROKEN[what][2] <= failed_checks(report), report.table()


def test_exception_of_a_module_is_reported() -> None:
    module = FakeModule(reference("mass_spring"))
    module.g = lambda *place, **how: {}["k"]  # type: ignore[method-assign]
    report = check(scene_system("mass_spring"), module, states=4, tables=WITHOUT_ORDERS)
    assert failed_checks(report) == {"g", "bias = C qd + g"}
    assert "KeyError: 'k'" in report.table()


@pytest.mark.slow
def test_order_is_measured_between_discontinuities_of_friction() -> None:
    """The order shows in spans between two discontinuities; the check used to take any span."""
    x, v = symbol("x"), symbol("x_dot")
    system = System.make("dry", [x], v**2 / 2, x**2 / 2, forces={x: -sympy.sign(v)}, h=0.05)
    report = check(system, FakeModule(derive(system)), states=8)
    assert report.passed, report.table()
    order = next(row for row in report.results if row.name == "order of rk4")
    assert order.judged and 3.5 < order.error < 4.5


def test_order_is_not_judged_across_discontinuities(monkeypatch: pytest.MonkeyPatch) -> None:
    """The table and the JSON report say so, and the check passes; without a discontinuity it
    fails.
    """
    x, v, low = symbol("x"), symbol("x_dot"), lambda *_: 1.0
    monkeypatch.setattr(Convergence, "order", low)
    monkeypatch.setattr(convergence, "advice_checks", lambda *_: ())
    for force, passed in ((sympy.sign(v), True), (sympy.tanh(v), False)):
        system = System.make("dry", [x], v**2 / 2, 0, forces={x: -force}, h=0.05)
        report = check(system, FakeModule(derive(system)), states=4)
        (row,) = (row for row in report.results if row.name == "order of rk4")
        assert row.passed == passed and row.judged != passed
        assert ("not expected with sign" in " ".join(report.table().split())) == passed


def test_unmeasurable_order_is_reported_as_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    unseen = Measurement(math.nan, "too few halvings")
    monkeypatch.setattr(Convergence, "order", lambda *_: unseen)
    monkeypatch.setattr(convergence, "advice_checks", lambda *_: ())
    report = check(scene_system("mass_spring"), FakeModule(reference("mass_spring")), states=4)
    assert report.passed
    assert "not judged: too few halvings" in " ".join(report.table().split())
    (row,) = (row for row in report.as_dict()["rows"] if not row["judged"])
    assert row["name"] == "order of rk4" and row["error"] is None and row["passed"]


def test_singular_initial_state_is_skipped() -> None:
    r, theta, m = symbol("r"), symbol("theta"), symbol("m")
    speed = symbol("r_dot") ** 2 + r**2 * symbol("theta_dot") ** 2
    system = System.make("polar", {r: 0.0, theta: 0.0}, m * speed / 2, m * r**2, parameters={m: 2})
    report = check(system, FakeModule(derive(system)), states=8)
    assert report.passed, report.table()
    assert report.rejected >= 1


def test_coordinate_without_inertia_is_reported() -> None:
    x, y = symbol("x"), symbol("y")
    system = System.make("lazy", [x, y], symbol("x_dot") ** 2 / 2, x**2 + y**2)
    report = check(system, FakeModule(derive(system)), states=4)
    assert failed_checks(report) == {"states"}
    assert report.states == 0


def test_rounding_of_cancelling_terms_is_no_error() -> None:
    """C is 0 only as the difference of equal terms, so its rounding is not compared with 0."""
    a, b = symbol("a"), symbol("b")
    angle, rate = a + b, symbol("a_dot") + symbol("b_dot")
    kinetic = sum((f(angle).diff(a) * rate) ** 2 for f in (sympy.sin, sympy.cos)) * 7 / 2
    system = System.make("ring", {a: 0.3, b: 0.1}, kinetic + symbol("a_dot") ** 2 / 3, 0)
    module = FakeModule(simplify_reference(derive(system)))
    report = check(system, module, states=8, tables=WITHOUT_ORDERS)
    assert report.passed, report.table()


def test_each_method_has_checks_of_one_step_and_of_a_run() -> None:
    module: Any = FakeModule(reference("mass_spring"))
    comparison = Comparison(scene_system("mass_spring"), module, np.random.default_rng(0), 4)
    for methods in (("rk4", "dp8", "gauss4"), ("rk4", "gauss8", "euler")):
        comparison.methods = methods
        names = {check.name for check in runs.checks(comparison)}
        assert {"one step", "run", *(f"one step of {m}" for m in methods[1:])} < names
        assert {f"run by {m}" for m in methods[1:]} < names


def test_portable_form_counts_if_its_error_is_larger() -> None:
    """A line of the report applies to both forms of C, and names the portable one if it fails."""
    modules = [FakeModule(reference("mass_spring")) for _ in range(2)]
    table = (equations.checks,)
    for bad, name in ((0, "g"), (1, "plain C: g")):
        right, wrong = modules[bad].g, modify("g", np.negative)
        wrong(modules[bad])
        report = check(
            scene_system("mass_spring"), modules[0], plain=modules[1], states=4, tables=table
        )
        modules[bad].g = right  # type: ignore[method-assign]
        assert name in failed_checks(report) <= {name, "bias = C qd + g"}


def test_report_as_json_and_as_table() -> None:
    report = report_of_mass_spring()
    parsed = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert parsed["passed"] is True
    assert parsed["reference"] == "expanded equations"
    assert {row["name"] for row in parsed["rows"]} >= {"D", "acceleration", "run", "order of rk4"}
    assert all(row.name in report.table() for row in report.results)
    assert max(map(len, report.table().splitlines())) <= 100


@pytest.mark.slow
def test_report_is_reproducible_for_a_seed() -> None:
    module = FakeModule(reference("cartpole"))
    first, second = (check(scene_system("cartpole"), module, states=4) for _ in range(2))
    assert first == second
    assert first != check(scene_system("cartpole"), module, states=4, seed=1)


class ModuleWithScaledAdvice:
    """A compiled module that gives advice for steps `by` times as long as the actual ones."""

    def __init__(self, module: Any, by: float) -> None:
        self.module, self.by = module, by

    def __getattr__(self, name: str) -> Any:
        return getattr(self.module, name)

    def advice(self, q: Any, qd: Any, h: float, **how: Any) -> str | None:
        message: str | None = self.module.advice(q, qd, h * self.by, **how)
        return message


SLOPES = """eomc = 1
name = "slopes"
[coordinates]
x = { start = 0.4 }
y = { start = 0.1, rate = 0.3 }
[parameters]
k = 3.0
[inputs]
f = { signal = "sin(x)" }
[energy]
kinetic = "x_dot**2/2 + (2 + sin(x))*y_dot**2/2"
potential = "k*(x - y)**2/2"
dissipation = "k*x_dot**2/9"
[forces]
y = "f*x"
[run]
linearize = "parameters"
"""


@pytest.mark.parametrize(
    "real, wrong",
    [
        *(("double", what) for what in ("", "A", "B", "sensitivity")),
        *(pytest.param("float", what, marks=pytest.mark.slow) for what in ("", "A")),
    ],
)
def test_derivatives_are_compared_with_finite_differences(
    modules: Modules, real: str, wrong: str
) -> None:
    text = f'{SLOPES}real = "{real}"\n'
    module = modules.unoptimised(text)

    class WrongModule:
        def __getattr__(self, name: str) -> Any:
            return getattr(module, name)

        def linearize(self, *place: Any, **how: Any) -> Any:
            A, B = module.linearize(*place, **how)
            return (negate(3, 0)(A) if wrong == "A" else A), (-B if wrong == "B" else B)

        def sensitivity(self, *place: Any, **how: Any) -> Any:
            return module.sensitivity(*place, **how) * (-1 if wrong == "sensitivity" else 1)

    report = check(system_of(parse(text)), WrongModule(), states=4, tables=WITHOUT_ORDERS)
    rows = {"": set(), "sensitivity": {"sensitivity"}}.get(wrong, {"linearize", "closed loop"})
    assert failed_checks(report) == rows, report.table()
    assert {"linearize", "sensitivity"} <= {row.name for row in report.results}


@pytest.mark.parametrize("name", tiers(("cartpole", "mass_spring"), "mass_spring"))
def test_advice_on_h_is_compared_with_eigenvalues(modules: Modules, name: str) -> None:
    """The advice must be right within a factor of two."""
    system = scene_system(name)
    for by, good in ((1.0, True), (1 / 2.2, False), (2.2, False)):
        comparison = Comparison(
            system, ModuleWithScaledAdvice(modules(name), by), np.random.default_rng(0), 4
        )
        (row,) = comparison.report(advice_checks)
        assert row.name == "h of rk4" and row.passed == good, row
        assert not good or row.error < 1.1


def test_without_oscillation_there_is_no_advice_to_check() -> None:
    (row,) = (r for r in report_of_mass_spring().results if r.name == "h of rk4")
    assert row.passed and row.unit == "not applicable: nothing limits h"
