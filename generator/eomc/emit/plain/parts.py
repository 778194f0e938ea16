"""What views of both forms of C have in common."""

from __future__ import annotations

from dataclasses import dataclass

from eomc.emit.c_function import CFunction


@dataclass(frozen=True)
class Prefixed:
    """What every template names: the scene's prefix, and the type of numbers."""

    prefix: str
    real: str


@dataclass(frozen=True)
class Named(Prefixed):
    """And the prefix of macros and enumerators."""

    PREFIX: str


@dataclass(frozen=True)
class Tableau(Named):
    """And the coefficients of a method, as `coefficients.tableau` writes them."""

    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    b: tuple[str, ...]
    bA: tuple[str, ...]


@dataclass(frozen=True)
class Computed:
    """A function that is computed from the program.

    parts: the static functions that it calls: pieces of a long one, or one column of a matrix.
    values: the struct in which pieces hand values on. column_call: where it is a loop over columns.
    """

    function: CFunction
    parts: tuple[CFunction, ...] = ()
    values: str = ""
    column_call: str = ""
    out: str = ""
    symmetric: bool = False

    @property
    def text(self) -> str:
        """All of it, where it is no loop over columns."""
        texts = (self.values, *(f.definition for f in self.parts), self.function.definition)
        return "\n\n".join(filter(None, texts))
