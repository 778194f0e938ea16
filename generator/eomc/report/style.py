"""How figures and pages look: names and units, colours, a light grid, thin lines."""

from __future__ import annotations

import re
from colorsys import hls_to_rgb
from typing import TYPE_CHECKING

from eomc.base import names, texts
from eomc.model.system import Coordinate, Output
from eomc.runtime.labels import mathtext, of_words, rate_unit, with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, distinct in every kind of colour vision; yellow left out on white
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, FAINT = "#333333", "#DDDDDD"


def choose_colours(count: int) -> tuple[str, ...]:
    """Return `count` distinct colours as texts such as "#0072B2".

    They are the first of COLOURS, or hues from red to violet if COLOURS has too few.
    """
    if count <= len(COLOURS):
        return COLOURS[:count]
    hues = (k / count * 5 / 6 for k in range(count))
    shades = (tuple(round(255 * x) for x in hls_to_rgb(hue, 0.36, 0.75)) for hue in hues)
    return tuple("#{:02X}{:02X}{:02X}".format(*shade) for shade in shades)


def format_axes(axes: Axes, lines: bool = True) -> None:
    """Format matplotlib axes: a light grid, no box, and thin lines for the curves drawn so far.

    lines: False to leave the width of the curves unchanged.
    """
    axes.grid(True, color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK)
    axes.tick_params(colors=INK, labelsize=9, length=3)
    axes.ticklabel_format(axis="y", scilimits=(-3, 4), useMathText=True)
    for line in axes.get_lines() if lines else ():
        line.set_linewidth(1.3)


# --- names and units ------------------------------------------------------------------------------

_LETTERS = {word: letter for letter, word in names.GREEK.items()}


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
    if rate:  # after the word: a dot would be set on one of its letters
        symbol += "\N{DOT ABOVE}" if len(symbol) > 1 else "\N{COMBINING DOT ABOVE}"
    return f"{symbol}<sub>{','.join(below)}</sub>" if below else symbol
