"""Fields that views of both forms of C share."""

from __future__ import annotations

from dataclasses import dataclass

from eomc.emit.c_function import CFunction


@dataclass(frozen=True)
class Prefixed:
    """Fields of all views: the scene's prefix and the C type of numbers."""

    prefix: str
    real: str


@dataclass(frozen=True)
class Named(Prefixed):
    """Fields of `Prefixed`, and the prefix of macros and enumerators."""

    PREFIX: str


@dataclass(frozen=True)
class Tableau(Named):
    """Fields of `Named`, and the coefficients of a method, see `coefficients.tableau`."""

    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    b: tuple[str, ...]
    bA: tuple[str, ...]


@dataclass(frozen=True)
class Computed:
    """A C function that is generated from a function of the program.

    Attributes
    ----------
    parts
        Static functions that it calls: pieces of a long function, or one column of a matrix.
    values
        The struct with the values that pieces share.
    column_call
        The call for one column, in functions that loop over columns.
    """

    function: CFunction
    parts: tuple[CFunction, ...] = ()
    values: str = ""
    column_call: str = ""
    out: str = ""
    symmetric: bool = False

    @property
    def text(self) -> str:
        """The text of all functions, except for loops over columns."""
        texts = (self.values, *(f.definition for f in self.parts), self.function.definition)
        return "\n\n".join(filter(None, texts))
