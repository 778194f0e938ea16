"""The symbols that a system is written in: names, the time, and rates kept as they stand."""

from __future__ import annotations

from functools import lru_cache

import sympy
from sympy import Symbol

t = Symbol("t", real=True)

# behind a name: a direction's entry along it; no name of a user's ends so
ALONG = "_along_"


class dot(sympy.Function):  # type: ignore[misc]  # noqa: N801 - it prints as the scene writes it
    """The total time derivative of its argument, kept as it stands until it is asked for."""

    nargs = 1
    is_real = True


@lru_cache(maxsize=10_000)  # SymPy takes ten times as long to find one that it has
def symbol(name: str) -> Symbol:
    """The symbol of a name; all of a system's symbols are real."""
    return Symbol(name, real=True)
