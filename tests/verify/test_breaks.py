"""A wrong sign anywhere between the scene and the machine code makes the check fail.

Each breakage changes one thing in the generator, builds the cart-pole with it and lets `check`
look: it has to fail, and in the rows that are about what was broken.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from builds import KEPT
from cases import scene_system
from conftest import ROOT, tiers

import eomc
from eomc.base import resources
from eomc.derive import lagrange
from eomc.derive.lagrange import EquationsOfMotion
from eomc.emit import c_expression, render
from eomc.model.system import System
from eomc.program import program, routes
from eomc.program.ir import Sum
from eomc.verify.check import check
from eomc.verify.comparison import Comparison
from eomc.verify.report import CheckReport

Breakage = Callable[[pytest.MonkeyPatch], None]
SCENE = "cartpole_driven"


def checked(folder: Path, scene: str = SCENE, states: int = 8) -> CheckReport:
    """The check of a scene built anew, under a digest of its own."""
    digest = hashlib.sha256(str(folder).encode()).hexdigest()
    made = replace(scene_system(scene), digest=digest)
    return check(made, eomc.load(made, folder), states=states)


def failed(report: CheckReport) -> set[str]:
    return {row.name for row in report.results if not row.passed}


@pytest.fixture(autouse=True)
def quickly_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")


def derived(change: Callable[[EquationsOfMotion], EquationsOfMotion]) -> Breakage:
    """The equations of motion are changed before they become a program."""

    def breakage(patch: pytest.MonkeyPatch) -> None:
        right = lagrange.derive

        def wrong(system: System) -> lagrange.Derivation:
            made = right(system)
            ways = {"lagrange": made.lagrange, "newton_euler": made.newton_euler}
            return replace(made, **{way: change(e) for way, e in ways.items() if e})

        patch.setattr(lagrange, "derive", wrong)

    return breakage


def negated(e: EquationsOfMotion, field: str, *at: int) -> EquationsOfMotion:
    """One entry of a vector or matrix with the other sign."""
    value = getattr(e, field)
    if len(at) == 1:
        return replace(e, **{field: tuple(-x if (i,) == at else x for i, x in enumerate(value))})
    rows = (
        tuple(-x if (i, j) == at else x for j, x in enumerate(row)) for i, row in enumerate(value)
    )
    return replace(e, **{field: tuple(rows)})


def text(right: str, wrong: str) -> Breakage:
    """Templates and hand-written C say something else."""

    def breakage(patch: pytest.MonkeyPatch) -> None:
        read = resources.text
        places = [part for part in TEMPLATES if right in part.read_text(encoding="utf-8")]
        assert places, f"{right!r} stands in no template any more"
        patch.setattr(resources, "text", lambda *where: read(*where).replace(right, wrong))
        patch.setattr(render, "environment", render.environment.__wrapped__)  # read anew

    return breakage


def lowered(patch: pytest.MonkeyPatch) -> None:
    """On its way to assignments the last sum of the acceleration loses a sign."""
    right = routes.lower

    def wrong(name: str, *how: Any, **more: Any) -> Any:
        made = right(name, *how, **more)
        if name != "acceleration":
            return made
        body = list(made.body)
        k = max(k for k, a in enumerate(body) if isinstance(a.value, Sum))
        (weight, first), *rest = body[k].value.terms
        body[k] = replace(body[k], value=Sum(((-weight, first), *rest), body[k].value.constant))
        return replace(made, body=tuple(body))

    patch.setattr(routes, "lower", wrong)


def printed(patch: pytest.MonkeyPatch) -> None:
    """Differences are written as sums."""
    right = c_expression.Printer._sum
    patch.setattr(c_expression.Printer, "_sum", lambda *a: right(*a).replace(" - ", " + "))


def eliminated(patch: pytest.MonkeyPatch) -> None:
    """The solver's last pivot is taken with the wrong sign, after D itself was right."""
    right = program.cheapest

    def wrong(name: str, *how: Any) -> Any:
        made = right(name, *how)
        if name != "acceleration":
            return made
        outputs = tuple(replace(o, coefficient=-o.coefficient) for o in made.outputs[:1])
        return replace(made, outputs=(*outputs, *made.outputs[1:]))

    patch.setattr(program, "cheapest", wrong)


MOTION = "D qdd + bias = tau"
TEMPLATES = [*(ROOT / "templates").rglob("*.jinja"), *(ROOT / "csrc").rglob("*.h")]

# what is broken, how, and rows that have to say so
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
        text("(first + n)*h", "(first - n)*h"),
        {"run"},
    ),
    "the sine": (text("*s = ", "*s = -"), {"acceleration", "g"}),
    "what Python asks for": (
        text("{{ f.call }};", "{ {{ f.call }}; out[0] = -out[0]; }"),
        {"D", "D > 0"},
    ),
}


OF_RUNS = {"order of rk4", "power balance"}  # of several step sizes, which take most of the time

# the binding, a template; what tests/verify/test_check.py breaks in a stand-in, what
# tests/physics/test_steppers.py breaks in a tableau, and what golden files show, is slow
QUICK = ("what Python asks for",)


@pytest.mark.slow
@pytest.mark.parametrize("scene", (SCENE, "kapitza_pendulum"))
def test_unbroken_it_passes(scene: str) -> None:
    report = checked(KEPT / "unbroken", scene)
    assert report.passed, report.table()


@pytest.mark.parametrize("what", tiers(BREAKAGES, *QUICK))
def test_broken_it_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    breakage, rows = BREAKAGES[what]
    breakage(monkeypatch)
    without = "add_advice_check" if rows & OF_RUNS else "add_convergence_checks"
    monkeypatch.setattr(Comparison, without, lambda *_: None)
    report = checked(tmp_path, states=8 if rows & OF_RUNS else 4)
    assert not report.passed
    assert rows <= failed(report), report.table()


def test_an_inertia_with_the_wrong_sign_is_not_even_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    derived(lambda e: negated(e, "D", 0, 0))(monkeypatch)
    with pytest.raises(eomc.EomcError, match=r"D is not positive definite|has no inertia"):
        checked(tmp_path)
