"""The picture beside benchmarks/RESULTS.md: each row's ratio, quartiles and bar, on a log axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt

FASTER, BAR, SLOWER = "#1b6ca8", "#444444", "#c1440e"


@dataclass(frozen=True)
class Mark:
    """A line of the picture: quartiles of ours/theirs, and the bar, if there is one."""

    work: str
    against: str
    ratio: Sequence[float]
    bar: float | None

    @property
    def missed(self) -> bool:
        """Beyond its bar; where there is none, slower than the other."""
        return self.ratio[1] > (1.0 if self.bar is None else self.bar)


def draw(marks: list[Mark], file: Path) -> None:
    """Points with quartiles, bars as ticks; same marks, same bytes."""
    settings = {"svg.hashsalt": "eomc", "svg.fonttype": "none", "font.size": 8}
    with plt.rc_context(settings):
        figure, axes = plt.subplots(figsize=(8, 0.9 + 0.165 * len(marks)), layout="constrained")
        for k, mark in enumerate(marks):
            color = SLOWER if mark.missed else FASTER
            low, middle, high = mark.ratio
            axes.plot([low, high], [k, k], color=color, linewidth=1.5, solid_capstyle="butt")
            axes.plot([middle], [k], "o", color=color, markersize=3.5)
            if mark.bar is not None:
                axes.plot([mark.bar] * 2, [k - 0.42, k + 0.42], color=BAR, linewidth=1.5)
        axes.axvline(1.0, color="#999999", linewidth=0.7, zorder=0)
        for k in range(1, len(marks)):
            if marks[k].work != marks[k - 1].work:
                axes.axhline(k - 0.5, color="#dddddd", linewidth=0.6, zorder=0)
        axes.set_xscale("log")
        axes.set_yticks(range(len(marks)), [f"{m.work} | {m.against}" for m in marks])
        axes.tick_params(axis="y", length=0, labelsize=7)
        axes.set_ylim(len(marks) - 0.4, -0.6)
        axes.grid(axis="x", color="#eeeeee", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.set_xlabel(
            "our time / theirs: median and quartiles; | the bar; orange: missed, or slower"
        )
        for side in ("top", "right", "left"):
            axes.spines[side].set_visible(False)
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
        plt.close(figure)
