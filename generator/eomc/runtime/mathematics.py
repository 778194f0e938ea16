"""The functions of formulas, one row each: their names in Python, NumPy, SymPy, mpmath and C.

A new function is a row of `FUNCTIONS`. It is then read in formulas, differentiated, evaluated by
all references and written in C. If SymPy has no class of that name, `model/algebra.py` defines one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any


@dataclass(frozen=True)
class MathFunction:
    """A function of formulas. Derivatives and other expressions are formulas, too.

    Attributes
    ----------
    name
        Name in formulas. Names in `math`, SymPy, mpmath, NumPy and C are the same unless given.
    title
        Description for the documentation.
    derivatives
        Derivative with respect to each argument, in terms of the arguments; () where none is taken
        from here.
    arguments
        Names of the arguments in `derivatives`, `domain` and `exact`; they are the fewest that a
        call has.
    most_arguments
        The largest number of arguments, if it is not the number of `arguments`.
    domain
        Condition under which the value is real and finite; "" if it always is.
    exact
        The function in terms of others, for programs that do not have it; "" if all of them do.
    shape
        "smooth"; "steep" (smooth, but acts as a jump if it is narrow); "corner" (continuous);
        "jump".
    sympy, mpmath, numpy, c
        Names there. `mpmath` and `numpy` are None if there is no such function for real numbers.
    """

    name: str
    title: str
    derivatives: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ("x",)
    most_arguments: int = 0
    domain: str = ""
    exact: str = ""
    shape: str = "smooth"
    sympy: str = ""
    mpmath: str | None = ""
    numpy: str | None = ""
    c: str = ""

    @property
    def argument_counts(self) -> tuple[int, int]:
        """The smallest and the largest number of arguments."""
        return len(self.arguments), self.most_arguments or len(self.arguments)

    def name_in(self, program: str) -> str | None:
        """Return the name in "sympy", "mpmath", "numpy" or "c"; None if it does not have it."""
        name: str | None = getattr(self, program)
        return self.name if name == "" else name


_MANY = 32  # arguments of min and max
_ROWS = (
    MathFunction("sin", "sine", ("cos(x)",)),
    MathFunction("cos", "cosine", ("-sin(x)",)),
    MathFunction("tan", "tangent", ("1 + tan(x)**2",)),
    MathFunction(
        "asin", "inverse sine", ("1/sqrt((1 - x)*(1 + x))",), domain="-1 <= x <= 1", numpy="arcsin"
    ),
    MathFunction(
        "acos",
        "inverse cosine",
        ("-1/sqrt((1 - x)*(1 + x))",),
        domain="-1 <= x <= 1",
        numpy="arccos",
    ),
    MathFunction("atan", "inverse tangent", ("1/(1 + x**2)",), shape="steep", numpy="arctan"),
    MathFunction(
        "atan2",
        "angle of the point (x, y)",
        ("x/(x**2 + y**2)", "-y/(x**2 + y**2)"),
        ("y", "x"),
        numpy="arctan2",
    ),
    MathFunction("sinh", "hyperbolic sine", ("cosh(x)",)),
    MathFunction("cosh", "hyperbolic cosine", ("sinh(x)",)),
    MathFunction("tanh", "hyperbolic tangent", ("1/cosh(x)**2",), shape="steep"),
    MathFunction("asinh", "inverse hyperbolic sine", ("1/sqrt(1 + x**2)",), numpy="arcsinh"),
    MathFunction(
        "acosh",
        "inverse hyperbolic cosine",
        ("1/sqrt((x - 1)*(x + 1))",),
        domain="x >= 1",
        numpy="arccosh",
    ),
    MathFunction(
        "atanh",
        "inverse hyperbolic tangent",
        ("1/((1 - x)*(1 + x))",),
        domain="-1 < x < 1",
        numpy="arctanh",
    ),
    MathFunction("exp", "e to the power x", ("exp(x)",)),
    MathFunction("expm1", "exp(x) - 1, exact near 0", ("exp(x)",), exact="exp(x) - 1"),
    MathFunction("log", "natural logarithm", ("1/x",), domain="x > 0"),
    MathFunction(
        "log1p", "log(1 + x), exact near 0", ("1/(1 + x)",), domain="x > -1", exact="log(1 + x)"
    ),
    MathFunction("sqrt", "square root", ("1/(2*sqrt(x))",), domain="x >= 0"),
    MathFunction(
        "cbrt",
        "cube root, negative for x < 0",
        ("1/(3*cbrt(x)**2)",),
        exact="sign(x)*abs(x)**(1/3)",
        mpmath=None,
    ),
    MathFunction(
        "hypot",
        "length sqrt(x**2 + y**2)",
        ("x/hypot(x, y)", "y/hypot(x, y)"),
        ("x", "y"),
        exact="sqrt(x**2 + y**2)",
    ),
    MathFunction("erf", "error function", ("2*exp(-x**2)/sqrt(pi)",), shape="steep", numpy=None),
    MathFunction("erfc", "1 - erf(x)", ("-2*exp(-x**2)/sqrt(pi)",), shape="steep", numpy=None),
    MathFunction("abs", "absolute value", shape="corner", sympy="Abs", c="fabs"),
    MathFunction("min", "smallest", (), ("x", "y"), _MANY, shape="corner", sympy="Min", c="fmin"),
    MathFunction("max", "largest", (), ("x", "y"), _MANY, shape="corner", sympy="Max", c="fmax"),
    MathFunction("sign", "-1, 0 or 1", shape="jump"),
    MathFunction("heaviside", "0, 1/2 at 0, then 1", shape="jump", sympy="Heaviside"),
)
FUNCTIONS: Mapping[str, MathFunction] = {f.name: f for f in _ROWS}
ANALYTIC = tuple(f for f in _ROWS if f.derivatives)

# the functions for floats; they raise an exception where the value is not real
DOUBLES: Mapping[str, Callable[..., Any]] = {
    **{f.name: getattr(math, f.name) for f in ANALYTIC},
    "abs": abs,
    "sign": lambda x: float((x > 0) - (x < 0)),
    "heaviside": lambda x: 0.5 * ((x > 0) - (x < 0)) + 0.5,
    "min": min,
    "max": max,
}


def numpy_functions() -> dict[str, Callable[..., Any]]:
    """Return the functions for arrays, by name; they return nan where the value is not real."""
    import numpy as np  # takes 0.1 s, which the reader of formulas does not need

    def function(f: MathFunction) -> Callable[..., Any]:
        name = f.name_in("numpy")
        return np.vectorize(DOUBLES[f.name], [float]) if name is None else getattr(np, name)

    return {
        **{f.name: function(f) for f in ANALYTIC},
        "abs": np.abs,
        "sign": np.sign,
        "heaviside": lambda x: np.heaviside(x, 0.5),
        "min": lambda *x: reduce(np.minimum, x),
        "max": lambda *x: reduce(np.maximum, x),
    }
