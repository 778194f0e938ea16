"""Names and units as they are printed in figures."""

from __future__ import annotations

import re

from sympy.printing.latex import translate

from eomc.base import names, texts
from eomc.model.system import Coordinate, Output


def mathtext(name: str, rate: bool = False) -> str:
    r"""A name as it is printed: theta_1 or theta1 as $\theta_{1}$, m_c as $m_{\mathrm{c}}$.

    >>> mathtext("theta_1", rate=True)
    '$\\dot{\\theta}_{1}$'
    """
    head, *rest = name.split("_")
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", head):
        head, rest = digits[1], [digits[2], *rest]
    symbol, *below = (_upright(part) for part in (head, *rest))
    if len(head) == 1:
        symbol = head
    if rate:
        symbol = rf"\dot{{{symbol}}}"
    return f"${symbol}_{{{','.join(below)}}}$" if below else f"${symbol}$"


def _upright(word: str) -> str:
    if word in names.GREEK.values():
        return str(translate(word))
    return word if word.isdigit() else rf"\mathrm{{{word}}}"


def label(coordinate: Coordinate | Output, rate: bool = False) -> str:
    """A name with its unit, or that of its rate."""
    return with_unit(mathtext(coordinate.name, rate), rate_unit(coordinate.unit, rate))


def rate_unit(unit: str, rate: bool) -> str:
    """The unit, or that of the rate; "" where there is none."""
    return f"{unit}/s" if unit and rate else unit


def with_unit(text: str, unit: str) -> str:
    """A text as it is printed, and its unit in brackets."""
    return f"{text} ({texts.figure(unit)})" if unit else text


def html_name(name: str, rate: bool = False) -> str:
    """A plain name as it is printed in a page: theta_1 as θ with a subscript, words as words.

    >>> html_name("theta_1"), html_name("wrist_1_joint")
    ('θ<sub>1</sub>', 'wrist 1 joint')
    """
    if re.search(r"[a-z]{2,}\d*_.*[a-z]{2,}", name) and not set(name.split("_")) & {*_LETTERS}:
        return texts.name(name).replace("_", " ") + ("\N{COMBINING DOT ABOVE}" if rate else "")
    head, *rest = texts.name(name).split("_")
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", head):
        head, rest = digits[1], [digits[2], *rest]
    symbol, *below = (_LETTERS.get(part, part) for part in (head, *rest))
    if rate:
        symbol += "\N{COMBINING DOT ABOVE}"
    return f"{symbol}<sub>{','.join(below)}</sub>" if below else symbol


_LETTERS = {word: letter for letter, word in names.GREEK.items()}
