"""A wrong sign anywhere between the scene and the machine code makes the check fail.

Each breakage changes one thing in the generator, builds the cart-pole and runs `check`: it must
fail, in the checks that concern the broken part.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.builds import REUSED_BUILDS
from support.cases import scene_system
from support.session import ROOT, tiers

import eomc
from eomc.base import resources
from eomc.derive import lagrange
from eomc.derive.lagrange import EquationsOfMotion
from eomc.emit.common import c_expression, templates
from eomc.model.system import System
from eomc.program import program, routes
from eomc.program.ir import Sum, Value
from eomc.verify import convergence
from eomc.verify.check import TABLES, check
from eomc.verify.comparison import CheckReport

Breakage = Callable[[pytest.MonkeyPatch], None]
SCENE = "cartpole_driven"


def build_and_check(
    folder: Path, scene: str = SCENE, states: int = 8, with_orders: bool = True
) -> CheckReport:
    """Build a scene with a digest of its own and check it."""
    digest = hashlib.sha256(str(folder).encode()).hexdigest()
    system = replace(scene_system(scene), digest=digest)
    tables = [table for table in TABLES if with_orders or table is not convergence.checks]
    return check(system, eomc.load(system, folder), states=states, tables=tables)


def failed_checks(report: CheckReport) -> set[str]:
    return {row.name for row in report.results if not row.passed}


@pytest.fixture(autouse=True)
def quickly_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")


def derived(change: Callable[[EquationsOfMotion], EquationsOfMotion]) -> Breakage:
    """Change the equations of motion before they are lowered to a program."""

    def breakage(patch: pytest.MonkeyPatch) -> None:
        right = lagrange.derive

        def wrong(system: System) -> lagrange.Derivation:
            derivation = right(system)
            methods = {"lagrange": derivation.lagrange, "newton_euler": derivation.newton_euler}
            return replace(derivation, **{way: change(e) for way, e in methods.items() if e})

        patch.setattr(lagrange, "derive", wrong)

    return breakage


def negated(e: EquationsOfMotion, field: str, *at: int) -> EquationsOfMotion:
    """Return the equations with the opposite sign of one entry of a vector or matrix."""
    value = getattr(e, field)
    if len(at) == 1:
        return replace(e, **{field: tuple(-x if (i,) == at else x for i, x in enumerate(value))})
    rows = (
        tuple(-x if (i, j) == at else x for j, x in enumerate(row)) for i, row in enumerate(value)
    )
    return replace(e, **{field: tuple(rows)})


def text(right: str, wrong: str) -> Breakage:
    """Replace text in templates and handwritten C."""

    def breakage(patch: pytest.MonkeyPatch) -> None:
        read = resources.text
        places = [part for part in TEMPLATES if right in part.read_text(encoding="utf-8")]
        assert places, f"{right!r} stands in no template any more"
        patch.setattr(resources, "text", lambda *where: read(*where).replace(right, wrong))
        patch.setattr(
            templates, "environment", templates.environment.__wrapped__
        )  # clears the cache

    return breakage


def lowered(patch: pytest.MonkeyPatch) -> None:
    """Negate one term in the last sum of the acceleration while it is lowered to assignments."""
    right = routes.lower

    def wrong(name: str, *how: Any, **more: Any) -> Any:
        function = right(name, *how, **more)
        if name != "acceleration":
            return function
        body = list(function.body)
        k = max(k for k, a in enumerate(body) if isinstance(a.value, Sum))
        (weight, first), *rest = body[k].value.terms
        body[k] = replace(body[k], value=Sum(((-weight, first), *rest), body[k].value.constant))
        return replace(function, body=tuple(body))

    patch.setattr(routes, "lower", wrong)


def printed(patch: pytest.MonkeyPatch) -> None:
    """Print differences as sums."""
    right = c_expression.Printer.value

    def wrong(printer: c_expression.Printer, value: Value, binding: int = 1) -> tuple[str, int]:
        text, strength = right(printer, value, binding)
        return text.replace(" - ", " + ") if isinstance(value, Sum) else text, strength

    patch.setattr(c_expression.Printer, "value", wrong)


def eliminated(patch: pytest.MonkeyPatch) -> None:
    """Use the wrong sign of the solver's last pivot, after D itself."""
    right = program.cheapest

    def wrong(name: str, *how: Any) -> Any:
        function = right(name, *how)
        if name != "acceleration":
            return function
        outputs = tuple(replace(o, coefficient=-o.coefficient) for o in function.outputs[:1])
        return replace(function, outputs=(*outputs, *function.outputs[1:]))

    patch.setattr(program, "cheapest", wrong)


MOTION = "D qdd + bias = tau"
TEMPLATES = [*(ROOT / "templates").rglob("*.jinja"), *(ROOT / "csrc").rglob("*.h")]

# What is broken, how, and the checks that must fail.
BREAKAGES: dict[str, tuple[Breakage, set[str]]] = {
    "an entry of D": (derived(lambda e: negated(e, "D", 0, 1)), {"D", "D = D^T", MOTION}),
    "both of D": (
        derived(lambda e: negated(negated(e, "D", 0, 1), "D", 1, 0)),
        {"D", "acceleration", "Ddot - 2C + dD/dt skew", "power balance"},
    ),
    "an entry of C": (
        derived(lambda e: negated(e, "C", 0, 1)),
        {"C", "Ddot - 2C + dD/dt skew", "bias = C qd + g"},
    ),
    "g": (derived(lambda e: negated(e, "g", 1)), {"g", "bias = C qd + g"}),
    "the bias": (
        derived(lambda e: negated(e, "bias", 1)),
        {"bias", "bias = C qd + g", MOTION},
    ),
    "an acceleration": (eliminated, {"acceleration", MOTION, "one step", "run"}),
    "lowering": (lowered, {"acceleration", MOTION, "run"}),
    "printing": (printed, {"acceleration", "one step"}),
    "a weight of the stepper": (
        text("+ 2*inner)", "+ 1*inner)"),
        {"one step", "run", "order of rk4"},
    ),
    "a sign in the stepper": (
        text("moving[i] += node*w->a", "moving[i] -= node*w->a"),
        {"one step", "run", "order of rk4"},
    ),
    "the time in a stage": (
        text("k == 3 ? h : h/2;", "k == 3 ? h : -h/2;"),
        {"one step", "run"},
    ),
    "the time of a step in a run": (
        text("options->t0 + ({{ real }})n*h", "options->t0 - ({{ real }})n*h"),
        {"run"},
    ),
    "the sine": (text("*s = ", "*s = -"), {"acceleration", "g"}),
    "what Python asks for": (
        text("{{ f.call }};", "{ {{ f.call }}; out[0] = -out[0]; }"),
        {"D", "D > 0"},
    ),
}


OF_RUNS = {
    "order of rk4",
    "power balance",
}  # these run several step sizes, which take most of the time

# The binding, a template. Other breakages are slow: test_check.py covers them with a stand-in,
# tests/physics/test_steppers.py with a tableau, and the golden files show them.
QUICK = ("what Python asks for",)


@pytest.mark.slow
@pytest.mark.parametrize("scene", (SCENE, "kapitza_pendulum"))
def test_check_passes_without_breakage(scene: str) -> None:
    report = build_and_check(REUSED_BUILDS / "unbroken", scene)
    assert report.passed, report.table()


@pytest.mark.parametrize("what", tiers(BREAKAGES, *QUICK))
def test_check_fails_with_breakage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    breakage, rows = BREAKAGES[what]
    breakage(monkeypatch)
    monkeypatch.setattr(convergence, "advice_checks", lambda *_: ())
    with_orders = bool(rows & OF_RUNS)
    report = build_and_check(tmp_path, states=8 if with_orders else 4, with_orders=with_orders)
    assert not report.passed
    assert rows <= failed_checks(report), report.table()


def test_build_refuses_an_inertia_with_the_wrong_sign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    derived(lambda e: negated(e, "D", 0, 0))(monkeypatch)
    with pytest.raises(eomc.EomcError, match=r"D is not positive definite|has no inertia"):
        build_and_check(tmp_path)
