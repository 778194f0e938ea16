"""Long equations by names: what several formulas share is named once, and set out below them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import sympy
from sympy import Expr, ImmutableMatrix, Symbol, cos, sin

from eomc.model.system import System, symbol
from eomc.report.derived import Derived

Found = TypeVar("Found", bound=Derived)

WORTH = 4  # operations and sines of a sum that gets a name; shorter ones are written out each time
LETTERS = ("s", "h", "w", "z", "sigma")  # of the names, the first that the scene does not use
NAMED_ENTRIES = 9  # coordinates, up to which entries of D keep their names in the equations


def of(found: Found) -> Found:
    """The same equations over `named`: entries of D in the equations, and what formulas share."""
    entries = _entries_of_D(found)
    left = tuple([(rates, entries.get(c, c)) for rates, c in terms] for terms in found.left)
    n = range(found.D.rows)
    half = [found.D[i, j] for i in n for j in n[i:]]
    matrices = [getattr(found, name) for name in ("C", "g", "tau", "forces", "zero", "A")]
    scalars = [
        found.kinetic, found.potential, found.jacobi, found.power, found.linear_potential,
    ]  # fmt: skip
    coefficients = [c for terms in left for _, c in terms]
    formulas = [*coefficients, *half, *(e for m in matrices for e in m)]
    formulas += [e for e in scalars if e is not None]
    named, made = shared(formulas, _letter(found.system))
    new = iter(made)
    left = tuple([(rates, next(new)) for rates, _ in terms] for terms in left)
    upper = {(i, j): next(new) for i in n for j in n[i:]}
    D = ImmutableMatrix(len(n), len(n), lambda i, j: upper[min(i, j), max(i, j)])
    C, g, tau, forces, zero, A = (
        ImmutableMatrix(m.rows, m.cols, [next(new) for _ in m]) for m in matrices
    )
    K, P, jacobi, power, U = (None if e is None else next(new) for e in scalars)
    return replace(
        found, D=D, C=C, g=g, tau=tau, forces=forces, zero=zero, A=A, kinetic=K, potential=P,
        jacobi=jacobi, power=power, linear_potential=U, left=left, named=tuple(named),
    )  # fmt: skip


def shared(formulas: Sequence[Expr], letter: str) -> tuple[list[tuple[Symbol, Expr]], list[Expr]]:
    """What formulas share, (name, formula over names before it), and the formulas over names."""
    temporary = sympy.numbered_symbols("_", real=True)
    found, made = sympy.cse(formulas, order="none", symbols=temporary)
    uses = Counter(s for e in (*(e for _, e in found), *made) for s in _symbols(e))
    inside: dict[Symbol, Expr] = {}
    named: list[tuple[Symbol, Expr]] = []
    for name, e in found:
        whole = e.xreplace(inside)
        if uses[name] < 2 or not _worth(whole):
            inside[name] = whole
        else:
            inside[name] = symbol(f"{letter}_{len(named) + 1}")
            named.append((inside[name], whole))
    return named, [e.xreplace(inside) for e in made]


def _worth(e: Expr) -> bool:
    """Whether it is long enough for a name: no product alone, and angles count nothing."""
    bare = e.xreplace({f: f.func(sympy.Dummy()) for f in e.atoms(sin, cos)})
    return bool(bare.has(sympy.Add)) and bool(bare.count_ops() >= WORTH)


def _symbols(e: Expr) -> Iterator[Expr]:
    """As often as they stand there."""
    return (part for part in sympy.preorder_traversal(e) if part.is_Symbol)


def _entries_of_D(found: Derived) -> dict[Expr, Symbol]:
    """Names of entries that are worth one, where the scene leaves them free."""
    n = found.D.rows
    if n > NAMED_ENTRIES:
        return {}
    made: dict[Expr, Symbol] = {}
    for i in range(n):
        for j in range(i, n):
            name, entry = f"D_{i + 1}{j + 1}", found.D[i, j]
            if _worth(entry) and name not in found.system.names:
                made.setdefault(entry, symbol(name))
    return made


def _letter(system: System) -> str:
    """Of names such as s_1, which nothing of the scene is called."""
    for letter in LETTERS:
        if not any(re.fullmatch(rf"{letter}(_?\d+)?", name) for name in system.names):
            return letter
    return "abbreviation"
