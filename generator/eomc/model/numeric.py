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
    """Return a Python function of numbers that evaluates an expression or a list of expressions.

    Symbols may have any names: they are replaced by dummy symbols, so that a parameter may have the
    name of an object in Python or in `modules`, such as `size` or `e`.

    Parameters
    ----------
    arguments : sequence of Symbol
        The arguments of the function, in order.
    expressions : Expr or sequence of Expr
        The expressions to evaluate. A sequence gives a function that returns a list.
    modules : as `modules` of `sympy.lambdify`
        Modules that contain the functions and constants, such as "math".
    definitions : sequence of (Symbol, Expr), optional
        Symbols of the expressions and their values, which are evaluated first and in order; each
        may use the symbols before it. Without definitions, common subexpressions are eliminated.
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
