"""The registry of routes: every way to compute what the equations of motion say.

A new route is a function of the `Material`, here or in derive/, and its entry in `ROUTES`; which
route a function takes is decided by admissible.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from sympy import Expr

from eomc.derive import kkt
from eomc.derive.equations import Equations
from eomc.derive.lagrange import Derivation
from eomc.derive.ldl import Rows, SolveResult, solve
from eomc.derive.link_multipliers import prefer_short_chains
from eomc.derive.tape import Tape
from eomc.model.system import System
from eomc.program.polynomial import Expander

SHORT = 120  # names on a tape that C depends on: it is worth multiplying out


class Material:
    """What routes are made of: a derivation, and Lagrange's equations multiplied out."""

    def __init__(self, derived: Derivation) -> None:
        self.derived = derived
        self.lagrange = derived.lagrange
        self.expander = Expander(derived.lagrange.tape) if derived.lagrange else None

    @cached_property
    def expanded(self) -> tuple[Tape, Rows, Sequence[Expr]] | None:
        """D and b of D qdd = b, multiplied out on a tape; None where they grow too large."""
        if self.lagrange is None or self.expander is None:
            return None
        D, n = self.lagrange.D, len(self.lagrange.bias)
        lower = [(i, j) for i in range(n) for j in range(i + 1)]
        both = self.expander.expand([*(D[i][j] for i, j in lower), *self.lagrange.balance])
        if both is None:
            return None
        entries = dict(zip(lower, both, strict=False))
        rows = tuple(tuple(entries[max(i, j), min(i, j)] for j in range(n)) for i in range(n))
        return self.lagrange.tape, rows, both[len(lower) :]


@dataclass(frozen=True)
class Functions:
    """Results of functions by name, on a tape; notes: where unusual terms of K went."""

    tape: Tape
    outputs: Mapping[str, Sequence[Expr]]
    notes: tuple[str, ...]


def _by_ldl(system: System, order: str) -> str:
    if system.constraints:
        return (
            "a = qdd by L diag(d) L^T of the KKT matrix [[D, A^T], [A, 0]], eliminated in the "
            f"order {order}, each row of A as soon as the coordinates that it reads are gone."
        )
    return f"a = qdd by D = L diag(d) L^T, eliminated in the order {order}."


@dataclass(frozen=True)
class Route:
    """One way to the accelerations, to the other functions, or to both.

    sentence: what it is, for people. accelerations: qdd, or why it is passed over, or None where
    there is nothing to try; functions: None likewise. solved: how D qdd = tau - bias is solved,
    for a comment, with the order in which coordinates are eliminated. penalty: a factor on its
    weight, for what operations do not count.
    """

    name: str
    sentence: str
    accelerations: Callable[[Material], SolveResult] = lambda _: None
    functions: Callable[[Material], Functions | None] = lambda _: None
    solved: Callable[[System, str], str] = _by_ldl
    penalty: float = 1.0


def _power(e: Equations) -> Expr:
    """Into the system, with what constraints do that time moves: lambda A qd."""
    if e.rows is None or not any(e.rows.drift):
        return e.power
    multipliers = kkt.accelerations(e.tape, e.D, e.balance, e.rows).multipliers
    works = [e.tape.times(x, v) for x, v in zip(multipliers, e.rows.drift, strict=True)]
    return e.tape.total([e.power, *works])


def _functions(e: Equations | None) -> Functions | None:
    if e is None:
        return None
    wanted: dict[str, Sequence[Expr]] = {
        name if len(rows) == len(e.g) else f"{name}_column": [x for row in rows for x in row]
        for name, rows in (("D", e.D), ("C", e.C))
    }
    wanted |= {"g": e.g, "bias": e.bias, "tau": e.tau}
    wanted |= {"kinetic_energy": [e.kinetic], "potential_energy": [e.potential]}
    wanted["energy"] = [e.tape.define(e.kinetic + e.potential)]
    if e.jacobi is not None:
        wanted["jacobi"] = [e.jacobi]
    if (power := _power(e)) != 0:
        wanted["power"] = [power]
    if e.signals:
        wanted["signal"] = e.signals
    return Functions(e.tape, wanted, e.notes)


def _expanded_functions(material: Material) -> Functions | None:
    plain = _functions(material.lagrange)
    if plain is None or material.expander is None:
        return None
    expand = material.expander.expand
    found = {name: expand(outputs) for name, outputs in plain.outputs.items()}
    outputs = {name: short for name, short in found.items() if short is not None}
    return replace(plain, outputs=outputs)


def _rotated(material: Material) -> Functions | None:
    """C along a short tree, where rotations there and back cancel by sin^2 + cos^2 = 1."""
    plain = _functions(material.derived.newton_euler)
    if plain is None or "C" not in plain.outputs:
        return None
    C, tape = plain.outputs["C"], plain.tape
    names = [x for entry in C for x in entry.free_symbols]
    short = Expander(tape).expand(C) if len(tape.live(names)) <= SHORT else None
    return None if short is None else replace(plain, outputs={"C": short})


def _expanded(material: Material) -> SolveResult:
    if material.expanded is None:
        return None
    rows = material.lagrange.rows if material.lagrange else None
    return kkt.accelerations(*material.expanded, rows) if rows else solve(*material.expanded)


def _cancelled(material: Material) -> SolveResult:
    if material.expander is None or material.expanded is None:
        return None
    rows = material.lagrange.rows if material.lagrange else None
    short = material.expander.short
    if rows:
        return kkt.accelerations(*material.expanded, rows, short)
    return solve(*material.expanded, short)


def _constrained(e: Equations | None) -> SolveResult:
    """Under constraints, over equations as they are."""
    return kkt.accelerations(e.tape, e.D, e.balance, e.rows) if e and e.rows else None


def _by_articulated_bodies(_: System, order: str) -> str:
    return (
        "a = qdd by articulated bodies (Featherstone), the pivots d being those of "
        f"D = L diag(d) L^T, eliminated in the order {order}."
    )


def _by_multipliers(system: System, order: str) -> str:
    fractions = "Along a chain s = N/M: s_k is N there, and S_k is M times the entry it was. "
    return (
        "a = qdd by link multipliers (tensions), S = N T N^T = L diag(s) L^T, eliminated in the "
        f"order of the links of {order}. {fractions if prefer_short_chains(system) else ''}"
        "Every mass must be positive."
    )


ROUTES: Mapping[str, Route] = {
    r.name: r
    for r in (
        Route(
            "lagrange",
            "Lagrange over the program of K and P",
            lambda m: m.derived.ldl or _constrained(m.lagrange),
            lambda m: _functions(m.lagrange),
        ),
        Route("expanded", "the same, multiplied out", _expanded, _expanded_functions),
        Route("cancelled", "multiplied out again during elimination", _cancelled),
        Route(
            "articulated",
            "Newton and Euler, articulated bodies",
            lambda m: m.derived.articulated,
            solved=_by_articulated_bodies,
        ),
        Route(
            "composite",
            "Newton and Euler, D of composite bodies, L D L^T",
            lambda m: m.derived.composite or _constrained(m.derived.newton_euler),
        ),
        Route(
            "newton-euler",
            "Newton and Euler along the tree",
            functions=lambda m: _functions(m.derived.newton_euler),
        ),
        Route("rotated", "the same, multiplied out", functions=_rotated),
        Route(
            "multipliers",
            "link multipliers: the tensions of links between point masses",
            lambda m: m.derived.multipliers,
            solved=_by_multipliers,
            penalty=1.25,  # D bears massless links: that is worth a fifth
        ),
    )
}
