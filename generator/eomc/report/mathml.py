"""Equations as MathML, which browsers set without a script: LaTeX goes through latex2mathml."""

from __future__ import annotations

import re
from functools import cache

from markupsafe import Markup

from eomc.base.errors import EomcError
from eomc.report import equations_text
from eomc.report.equations import Equations

_FUNCTION = re.compile(r"<mi>(a?(?:sin|cos|tan)h?|exp|log|min|max|arg)</mi>")
_SPACED = r'<mo lspace="0.17em" rspace="0.17em">\1</mo>'


def lines(found: Equations) -> tuple[list[tuple[bool, Markup]], list[tuple[bool, Markup]]]:
    """The lines of the equations of motion, and of the rest: whether each goes on with the last.

    Raises EomcError without latex2mathml.
    """
    first, second = (
        [_line(x) for x in lines] for lines in equations_text.latex_lines(found.set_out)
    )
    return first, second


def _line(text: str) -> tuple[bool, Markup]:
    more = text.startswith(equations_text.GOES_ON)
    left, _, right = text.partition("&")
    return more, _made((left + right.replace(r"\quad", "", int(more))).strip())


@cache
def _made(latex: str) -> Markup:
    try:
        from latex2mathml.converter import convert
    except ImportError:
        raise EomcError("equations in a page need latex2mathml: pip install latex2mathml") from None
    made = convert(latex).replace('display="inline"', 'displaystyle="true"')
    return Markup(_FUNCTION.sub(_SPACED, made))
