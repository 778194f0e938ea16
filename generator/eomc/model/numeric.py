"""SymPy expressions as functions of numbers, whatever their symbols are called."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import sympy
from sympy import Dummy, Expr


def compiled(
    arguments: Sequence[Any],
    expressions: Any,
    modules: Any,
    definitions: Sequence[tuple[Any, Expr]] = (),
) -> Callable[..., Any]:
    """Return a function of the arguments that evaluates an expression, or a list of them.

    The generated code contains names of Python and of `modules`, such as `size` or `e`, which a
    parameter may have too. Dummy symbols therefore replace the arguments and the definitions.

    Parameters
    ----------
    arguments : sequence of Symbol
        The arguments, in their order; names stand for symbols.
    expressions : Expr or sequence of Expr
        What is evaluated.
    modules : as `modules` of `sympy.lambdify`
        Where functions and constants come from.
    definitions : sequence of (Symbol, Expr), optional
        Symbols of the expressions that are evaluated first, each over those before it. Without
        them, common subexpressions are evaluated once.
    """
    names = [*arguments, *(name for name, _ in definitions)]
    stand_ins: dict[Any, Any] = {name: Dummy(real=True) for name in names}

    def renamed(e: Expr) -> Expr:
        return sympy.sympify(e).xreplace(stand_ins)

    several = isinstance(expressions, (list, tuple))
    replaced = [*map(renamed, expressions)] if several else renamed(expressions)
    known = [(stand_ins[name], renamed(e)) for name, e in definitions]
    shared = (lambda e: (known, e)) if definitions else True
    function: Callable[..., Any]
    function = sympy.lambdify([stand_ins[x] for x in arguments], replaced, modules, cse=shared)
    return function
