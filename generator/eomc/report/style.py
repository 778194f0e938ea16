"""How figures look: colours, a light grid, thin lines."""

from __future__ import annotations

from colorsys import hls_to_rgb
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, distinct in every kind of colour vision; yellow left out on white
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, FAINT = "#333333", "#DDDDDD"


def colours(count: int) -> tuple[str, ...]:
    """Return `count` distinct colours as texts such as "#0072B2".

    They are the first of COLOURS, or hues from red to violet if COLOURS has too few.
    """
    if count <= len(COLOURS):
        return COLOURS[:count]
    hues = (k / count * 5 / 6 for k in range(count))
    shades = (tuple(round(255 * x) for x in hls_to_rgb(hue, 0.36, 0.75)) for hue in hues)
    return tuple("#{:02X}{:02X}{:02X}".format(*shade) for shade in shades)


def plain(axes: Axes, lines: bool = True) -> None:
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
