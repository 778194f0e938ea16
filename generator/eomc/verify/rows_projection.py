"""Rows of `check` about `project`, and about constraints whose D has no inertia at all.

States are moved away, and have to be put back where the reference puts them, whatever is held. What
can't be put anywhere is refused, and left alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from eomc.verify import kkt
from eomc.verify.comparison import Comparison
from eomc.verify.measurement import Measurement, largest
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT
from eomc.verify.rows_refusals import FACTORS, Refusals
from eomc.verify.rows_runs import parameters, run_in_c
from eomc.verify.sampling import Expected, State, evaluate_module

AWAY = (1e-6, 1e-3, 1e-2)  # of how far things go: from a state to where it is projected from
FAR = (3.0, 30.0, 300.0)  # times as far as they go: no state may be found
OFF = 0.1  # the same, where all of a state is held
FIRM = 1e-4  # of the scaled KKT matrix without what is held: its least singular value
HOLDS = 1e-9  # of the terms of a row: single precision apart
OK, SINGULAR, NOT_FINITE, _, _, LOCKED = range(6)


def report(of: Comparison, module: Any, form: str) -> None:
    """Add the rows about one form's module."""
    rows = Projection(of, module)
    of.row(f"{form}project", LIMIT, "units of rounding", partial(rows.projected, False))
    of.row(f"{form}project, held", LIMIT, "units of rounding", partial(rows.projected, True))
    of.row(f"{form}project: refusals", 0, "calls that end otherwise", rows.refusals)


def of_inertia(of: Comparison, refusals: Refusals) -> None:
    """Add the rows about parameters with which nothing has inertia."""
    found = Weightless(of, refusals)
    row = of.row
    row("no inertia: refusals", 0, "calls that do not refuse", found.refuse)
    if not found.states:
        last = of.rows[-1]
        of.rows[-1] = replace(last, unit=f"{last.unit}: no parameters take all inertia away")


@dataclass(frozen=True)
class Projection:
    """What is measured of one form's module."""

    of: Comparison
    module: Any

    def projected(self, some: bool) -> float | Measurement:
        """A state moved away is put back where the reference puts it. some: one is held."""
        of = self.of
        scale = of.sampler.scale
        random = np.random.default_rng(11)

        def error(e: Expected, part: float) -> float | None:
            by = part * scale * random.uniform(-1, 1, scale.shape)
            held = self._firm(e.state, random) if some else ()
            if held is None:
                return None
            s = replace(e.state, q=e.state.q + by[0], qd=e.state.qd + by[1])
            near = self._near(s, held)
            if not np.all(np.isfinite(near.q)) or not of.sampler.regular(near):
                return None
            if of.sampler.wrong_rotations(near):
                return None
            expected = of.sampler.expected(near)
            if expected is None:
                return None
            found = self.module.project(s.q, s.qd, t=s.t, params=s.params, held=self._names(held))
            size = np.abs([near.q, near.qd]) + scale + expected.size["place"]
            moved = np.abs(np.array([near.q - s.q, near.qd - s.qd]))
            if np.any(moved > (100 if held else 10) * part * scale):  # there may be several
                return None
            given = np.array([s.q, s.qd], of.dtype)
            stays = all(np.array_equal(np.array(found)[:, i], given[:, i]) for i in held)
            error = of.units(found, np.array([near.q, near.qd]), size)
            return error if stays else np.inf

        errors = [error(e, part) for e in of.few(6) for part in AWAY]
        why = "no state that is moved away has a place nearby"
        return largest(errors, "nothing can be held" if some else why)

    def _near(self, s: State, held: tuple[int, ...]) -> State:
        """Where the reference puts a state."""
        with np.errstate(all="ignore"):
            if not held:
                return self.of.sampler.project(s, nearest=True)
            q, qd = self.of.reference.project(s.q, s.qd, s.t, s.params, held)
        return replace(s, q=q, qd=qd)

    def _firm(self, s: State, random: np.random.Generator) -> tuple[int, ...] | None:
        """A coordinate that can be held: the rows don't need it; None where they need all."""
        D = self.of.reference.evaluate("D", s.q, s.qd, s.t, s.u, s.params)
        A = self.of.sampler.rows("constraint_jacobian", s)
        for i in random.permutation(len(s.q)).tolist():
            if kkt.is_regular(*kkt.with_fixed_coordinates(D, A, (i,)), FIRM):
                return (i,)
        return None

    def _names(self, held: tuple[int, ...]) -> list[str]:
        names = [c.name for c in self.of.system.coordinates]
        return [name for i in held for name in (names[i], f"{names[i]}_dot")]

    def refusals(self) -> float:
        """How often what can't be put anywhere is not refused, or is written."""
        random = np.random.default_rng(13)
        scale = self.of.sampler.scale
        wrong = 0
        for e in self.of.few(4):
            wrong += sum(self._refused(s, held) for s, held in self._lost(e.state, scale))
            for part in FAR:
                by = part * scale * random.uniform(-1, 1, scale.shape)
                wrong += not self._found(replace(e.state, q=e.state.q + by[0], qd=by[1]))
                near = replace(e.state, q=e.state.q / part + 1e-3 * by[0])
                wrong += not self._found(near)  # to the origin, where rows may turn over
        return float(wrong)

    def _lost(self, s: State, scale: Vector) -> Iterator[tuple[State, tuple[int, int]]]:
        """States that are on no row, and what is held of them: positions, rates."""
        rows = np.array([c.holonomic for c in self.of.system.constraints])
        A = np.abs(evaluate_module(self.module, "constraint_jacobian", s))
        off = replace(s, q=s.q + OFF * scale[0])
        lack = np.abs(evaluate_module(self.module, "constraints", off))
        if np.any((lack > OFF / 10 * (A @ scale[0]))[rows]):
            yield off, (1, 1)
        off = replace(s, qd=s.qd + OFF * scale[1])
        lack = np.abs(evaluate_module(self.module, "constraint_rates", off))
        if np.any(lack > OFF / 10 * (A @ scale[1])):
            yield off, (0, 1)
        q, qd = s.q.copy(), s.qd.copy()
        q[0] = qd[-1] = np.nan
        yield replace(s, q=q), (0, 0)
        yield replace(s, qd=qd), (0, 0)

    def _refused(self, s: State, held: tuple[int, int]) -> bool:
        """Whether a state is not refused, or is changed all the same."""
        status, kept, _ = self._put(s, held)
        return status not in (SINGULAR, NOT_FINITE, LOCKED) or not kept

    def _found(self, s: State) -> bool:
        """Whether a state is put onto the rows, or refused and left alone."""
        status, kept, found = self._put(s, (0, 0))
        if status:
            return kept
        holds = 1e-3 if self.of.dtype == np.float32 else HOLDS
        A = np.abs(evaluate_module(self.module, "constraint_jacobian", found))
        rows = np.array([c.holonomic for c in self.of.system.constraints])
        off = np.abs(evaluate_module(self.module, "constraints", found))[rows]
        level = (A @ (np.abs(found.q) + self.of.sampler.spread + np.max(np.abs(found.q))))[rows]
        return bool(np.all(np.isfinite(found.q)) and np.all(off <= holds * level))

    def _put(self, s: State, held: tuple[int, int]) -> tuple[int, bool, State]:
        """The C function's status, whether it has left the state alone, and the state behind it."""
        model = self.module._model
        q, qd = (np.array(x, model.dtype) for x in (s.q, s.qd))
        before = np.array([q, qd])
        flags = [x for x in held for _ in s.q] if any(held) else None
        told = model._ffi.NULL if flags is None else model._ffi.new("int[]", flags)
        found = model._lib.project(
            1, model._pointer(q), model._pointer(qd), s.t, told,
            model._pointer(parameters(model, s)), model._c[2],
        )  # fmt: skip
        kept = np.array_equal(before, np.array([q, qd]), equal_nan=True)
        return int(found & 7), kept, replace(s, q=q.astype(float), qd=qd.astype(float))


class Weightless:
    """Parameters with which D is negative, or nothing, in every direction."""

    def __init__(self, of: Comparison, refusals: Refusals) -> None:
        self.of, self.refusals = of, refusals
        self.states = list(self._found())

    def _found(self) -> Iterator[State]:
        defaults = self.of.sampler.defaults
        changes = [{n: f * (x or 1.0)} for n, x in defaults.items() for f in FACTORS[:4]]
        changes += [{n: f * x for n, x in defaults.items()} for f in (0.0, -1.0)]
        for change in changes:
            for e in self.of.few(2):
                s = replace(e.state, params={**defaults, **change}, u=None)
                with np.errstate(all="ignore"):
                    D = self.of.reference.evaluate("D", s.q, s.qd, s.t, None, s.params)
                if np.all(np.isfinite(D)) and np.linalg.eigvalsh(D)[-1] <= 0:
                    yield s

    def refuse(self) -> float:
        """How many calls do not refuse, or write all the same."""
        wrong = 0
        for s in self.states[:12]:
            status, clean = self.refusals.accelerate(s)
            wrong += status != SINGULAR or not clean
            for method in self.of.methods:
                run = run_in_c(self.of.module._model, method, s, self.of.system.run.h, 3)
                wrong += run.steps != 0 or run.status != SINGULAR
            for off in (s.q + 1e-3 * self.of.sampler.spread, s.q):
                x = replace(s, q=off, qd=s.qd + 1e-3 * self.of.sampler.speed)
                status, kept, _ = Projection(self.of, self.of.module)._put(x, (0, 0))
                wrong += status not in (OK, SINGULAR) or not kept  # OK: rows hold without lengths
        return float(wrong)
