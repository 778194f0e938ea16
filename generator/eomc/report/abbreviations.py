"""Abbreviate long equations: name subexpressions that several formulas share."""

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

AnyEquations = TypeVar("AnyEquations", bound=Derived)

MIN_OPERATIONS = 4  # operations and sines: shorter sums get no name
LETTERS = ("s", "h", "w", "z", "sigma")  # for names of subexpressions, in order of preference
MAX_NAMED_COORDINATES = 9  # with more coordinates, entries of D get no names D_ij


def abbreviate(equations: AnyEquations) -> AnyEquations:
    """Return a copy of the equations in which repeated subexpressions are replaced by names.

    A subexpression that occurs twice or more gets a name; the field `named` of the copy contains
    the pairs (name, expression). In the scalar equations, long entries of the mass matrix D are
    also replaced by names such as D_12.
    """
    entries = _entries_of_D(equations)
    left = tuple([(rates, entries.get(c, c)) for rates, c in terms] for terms in equations.left)
    n = range(equations.D.rows)
    half = [equations.D[i, j] for i in n for j in n[i:]]
    matrices = [getattr(equations, name) for name in ("C", "g", "tau", "forces", "zero", "A")]
    scalars = [
        equations.kinetic, equations.potential, equations.jacobi, equations.power,
        equations.linear_potential,
    ]  # fmt: skip
    coefficients = [c for terms in left for _, c in terms]
    formulas = [*coefficients, *half, *(e for m in matrices for e in m)]
    formulas += [e for e in scalars if e is not None]
    named, reduced = extract_common_subexpressions(formulas, _unused_letter(equations.system))
    new = iter(reduced)
    left = tuple([(rates, next(new)) for rates, _ in terms] for terms in left)
    upper = {(i, j): next(new) for i in n for j in n[i:]}
    D = ImmutableMatrix(len(n), len(n), lambda i, j: upper[min(i, j), max(i, j)])
    C, g, tau, forces, zero, A = (
        ImmutableMatrix(m.rows, m.cols, [next(new) for _ in m]) for m in matrices
    )
    K, P, jacobi, power, U = (None if e is None else next(new) for e in scalars)
    return replace(
        equations, D=D, C=C, g=g, tau=tau, forces=forces, zero=zero, A=A, kinetic=K, potential=P,
        jacobi=jacobi, power=power, linear_potential=U, left=left, named=tuple(named),
    )  # fmt: skip


def extract_common_subexpressions(
    formulas: Sequence[Expr], letter: str
) -> tuple[list[tuple[Symbol, Expr]], list[Expr]]:
    """Replace subexpressions that occur repeatedly in `formulas` by names.

    letter: beginning of the names, which are `letter`_1, `letter`_2, ... Returns two lists: the
    definitions (name, expression over earlier names), and the rewritten formulas in their order.
    """
    temporary = sympy.numbered_symbols("_", real=True)
    subexpressions, reduced = sympy.cse(formulas, order="none", symbols=temporary)
    uses = Counter(s for e in (*(e for _, e in subexpressions), *reduced) for s in _symbols(e))
    inside: dict[Symbol, Expr] = {}
    named: list[tuple[Symbol, Expr]] = []
    for name, e in subexpressions:
        expanded = e.xreplace(inside)
        if uses[name] < 2 or not _deserves_name(expanded):
            inside[name] = expanded
        else:
            inside[name] = symbol(f"{letter}_{len(named) + 1}")
            named.append((inside[name], expanded))
    return named, [e.xreplace(inside) for e in reduced]


def _deserves_name(e: Expr) -> bool:
    """True if `e` contains a sum and enough operations, those inside angles not counted."""
    bare = e.xreplace({f: f.func(sympy.Dummy()) for f in e.atoms(sin, cos)})
    return bool(bare.has(sympy.Add)) and bool(bare.count_ops() >= MIN_OPERATIONS)


def _symbols(e: Expr) -> Iterator[Expr]:
    """Iterate over all occurrences of symbols in `e`."""
    return (part for part in sympy.preorder_traversal(e) if part.is_Symbol)


def _entries_of_D(equations: Derived) -> dict[Expr, Symbol]:
    """Map long entries of D to their names D_ij, unless the scene uses the name."""
    n = equations.D.rows
    if n > MAX_NAMED_COORDINATES:
        return {}
    names: dict[Expr, Symbol] = {}
    for i in range(n):
        for j in range(i, n):
            name, entry = f"D_{i + 1}{j + 1}", equations.D[i, j]
            if _deserves_name(entry) and name not in equations.system.names:
                names.setdefault(entry, symbol(name))
    return names


def _unused_letter(system: System) -> str:
    """Return a letter for names such as s_1 that no name of the scene begins with."""
    for letter in LETTERS:
        if not any(re.fullmatch(rf"{letter}(_?\d+)?", name) for name in system.names):
            return letter
    return "abbreviation"
