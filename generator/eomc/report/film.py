"""The motion of runs as a film, GIF by Pillow or MP4 by ffmpeg, drawn by matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from subprocess import CalledProcessError

import numpy as np

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.report.picture import frame, seen, still
from eomc.report.reel import Reel
from eomc.report.style import COLOURS, INK, colours
from eomc.runtime.written import replacing

RATES = {".gif": 25, ".mp4": 50}  # pictures a second; a GIF counts in hundredths of a second
MOST = 1500  # pictures
SIZE, DPI = 4.8, 100  # inches of a run, dots an inch


def write(reels: Sequence[Reel], file: Path, title: str | None) -> None:
    """The mechanisms in real time, side by side. Raises EomcError where that can't be done."""
    suffix, shown = file.suffix.lower(), texts.line(str(file))
    try:
        import matplotlib
        from matplotlib.animation import FFMpegWriter, PillowWriter
        from matplotlib.figure import Figure
    except ImportError:
        raise EomcError(f"{shown}: films need matplotlib: pip install matplotlib") from None
    if suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise EomcError(f"{shown}: films as MP4 need the program ffmpeg: install it, or write .gif")
    rate = RATES[suffix]
    begin, end = (pick(float(r.t[k]) for r in reels) for pick, k in ((min, 0), (max, -1)))
    count = int((end - begin) * rate) + 1
    if count > MOST:
        raise EomcError(
            f"{shown}: {end - begin:g} s are {count} pictures, and a film has at most {MOST}: "
            "run for less, or write .html"
        )
    times = begin + np.arange(count) / rate
    made = []
    for reel in reels:
        rows = np.rint(np.interp(times, reel.t, np.arange(len(reel.t)))).astype(int)
        drawn = reel.drawing(rows)
        if drawn is None:
            raise EomcError(
                f"{shown}: {reel.system.name} says nothing about its shape: add [picture] to the "
                "scene, or write .html, which has the curves"
            )
        made.append((drawn, seen(drawn)))
    maker = PillowWriter if suffix == ".gif" else FFMpegWriter
    writer = maker(fps=rate, metadata={"title": texts.line(title or reels[0].title)})
    with matplotlib.rc_context({"text.usetex": False}):
        figure = Figure(figsize=(SIZE * len(reels), SIZE), dpi=DPI, layout="constrained")
        panels = figure.subplots(1, len(reels), squeeze=False)[0]
        try:
            with replacing(file) as new, writer.saving(figure, str(new), DPI):
                for k, t in enumerate(times):
                    for axes, reel, (drawn, flat) in zip(panels, reels, made, strict=True):
                        axes.clear()
                        words = texts.figure(title or reel.title)
                        axes.set_title(f"{words}, t = {t:.2f} s", fontsize=10, color=INK)
                        hues = colours(len(reel.key) or len(COLOURS))
                        for path, own in zip(drawn.paths, hues, strict=False):
                            colour = own if path.whose is None else hues[path.whose]
                            axes.plot(*flat[: k + 1, path.point].T, color=colour, linewidth=1.0)
                        still(axes, drawn, flat[k], hues=hues)
                        frame(axes, drawn, flat)
                    writer.grab_frame()
                    figure.set_layout_engine("none")  # as in the first: nothing jumps
        except (OSError, CalledProcessError) as fault:
            words = getattr(fault, "strerror", None) or str(fault)
            raise EomcError(f"{shown}: can't be written ({words})") from None
