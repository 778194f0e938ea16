"""Equations as MathML, which browsers show without a script: LaTeX converted by latex2mathml."""

from __future__ import annotations

import re
from functools import cache

from markupsafe import Markup

from eomc.base.errors import EomcError
from eomc.report import equations_text
from eomc.report.equations import Equations

_FUNCTION = re.compile(r"<mi>(a?(?:sin|cos|tan)h?|exp|log|min|max|arg)</mi>")
_SPACED = r'<mo lspace="0.17em" rspace="0.17em">\1</mo>'


def lines(derived: Equations) -> tuple[list[tuple[bool, Markup]], list[tuple[bool, Markup]]]:
    """Convert equations to MathML and return them as a pair of lists of printed lines.

    The first list contains the equations of motion, the second all other formulas. Each line is a
    pair (continues, MathML), where continues is True if the line continues the equation of the
    previous line. Raises EomcError if latex2mathml is not installed.
    """
    first, second = (
        [_line(x) for x in lines] for lines in equations_text.latex_lines(derived.set_out)
    )
    return first, second


def _line(text: str) -> tuple[bool, Markup]:
    continues = text.startswith(equations_text.CONTINUATION)
    left, _, right = text.partition("&")
    return continues, _convert((left + right.replace(r"\quad", "", int(continues))).strip())


@cache
def _convert(latex: str) -> Markup:
    try:
        from latex2mathml.converter import convert
    except ImportError:
        raise EomcError("equations in a page need latex2mathml: pip install latex2mathml") from None
    converted = convert(latex).replace('display="inline"', 'displaystyle="true"')
    return Markup(_FUNCTION.sub(_SPACED, converted))
