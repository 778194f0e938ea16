"""Names and units of a system as figures and pages print them."""

from __future__ import annotations

import re

from eomc.base import names, texts
from eomc.model.system import Coordinate, Output
from eomc.runtime.labels import mathtext, of_words, rate_unit, with_unit

__all__ = ["html_name", "label", "mathtext", "rate_unit", "with_unit"]


def label(coordinate: Coordinate | Output, rate: bool = False) -> str:
    """Return the axis label of a coordinate or output for matplotlib: its symbol and its unit.

    rate: True for the label of its time derivative.
    """
    return with_unit(mathtext(coordinate.name, rate), rate_unit(coordinate.unit, rate))


def html_name(name: str, rate: bool = False) -> str:
    """Return a name as HTML: theta_1 as θ with a subscript; names of whole words stay words.

    rate: True to put a dot above the symbol, for the time derivative.

    >>> html_name("theta_1"), html_name("wrist_1_joint")
    ('θ<sub>1</sub>', 'wrist 1 joint')
    """
    if of_words(name):
        return texts.name(name).replace("_", " ") + ("\N{DOT ABOVE}" if rate else "")
    head, *rest = texts.name(name).split("_")
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", head):
        head, rest = digits[1], [digits[2], *rest]
    symbol, *below = (_LETTERS.get(part, part) for part in (head, *rest))
    if rate:  # behind a word, not on a letter of it
        symbol += "\N{DOT ABOVE}" if len(symbol) > 1 else "\N{COMBINING DOT ABOVE}"
    return f"{symbol}<sub>{','.join(below)}</sub>" if below else symbol


_LETTERS = {word: letter for letter, word in names.GREEK.items()}
