"""Fields that the template data of portable and of optimised C share."""

from __future__ import annotations

from dataclasses import dataclass

from eomc.emit.c_function import CFunction


@dataclass(frozen=True)
class Prefixed:
    """Fields of the template data of every generated C file.

    prefix: the scene's name, with which all C functions and types begin. real: the C type of
    numbers, such as "double".
    """

    prefix: str
    real: str


@dataclass(frozen=True)
class Named(Prefixed):
    """Fields of `Prefixed`, and PREFIX, with which all C macros and enumerators begin."""

    PREFIX: str


@dataclass(frozen=True)
class Tableau(Named):
    """Fields of `Named`, and the coefficients of a Runge-Kutta method for second-order equations.

    c: the nodes. A, AA: the rows of the matrices A and A A. b, bA: the weights b and b A. All are
    C literals or initialisers, as returned by `coefficients.tableau`.
    """

    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    b: tuple[str, ...]
    bA: tuple[str, ...]


@dataclass(frozen=True)
class Computed:
    """A C function whose body is generated from a function of the eomc program, with its helpers.

    Attributes
    ----------
    function
        The C function itself.
    parts
        Static C functions that `function` calls: the pieces of a long function, or the function for
        one column of a matrix.
    values
        C definition of the struct with the intermediate values that the pieces share; "" for none.
    column_call, out, symmetric
        For matrix functions that loop over columns: the C call that computes one column, the name
        of the output array, and whether the matrix is symmetric.
    """

    function: CFunction
    parts: tuple[CFunction, ...] = ()
    values: str = ""
    column_call: str = ""
    out: str = ""
    symmetric: bool = False

    @property
    def text(self) -> str:
        """C text of the struct and of all functions, in the order in which C needs them.

        Not for functions that loop over columns: a template writes their loop around `column_call`.
        """
        texts = (self.values, *(f.definition for f in self.parts), self.function.definition)
        return "\n\n".join(filter(None, texts))
