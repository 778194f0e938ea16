"""The motion of runs as a film, GIF by Pillow or MP4 by ffmpeg, drawn by matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any

import numpy as np

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.report.drawing import drawing
from eomc.report.picture import frame, seen, still
from eomc.report.style import COLOURS, INK

RATES = {".gif": 25, ".mp4": 50}  # pictures a second; a GIF counts in hundredths of a second
MOST = 1500  # pictures
SIZE, DPI = 4.8, 100  # inches of a run, dots an inch


def write(systems: Sequence[Any], runs: Sequence[Any], file: Path, title: str | None) -> None:
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
    begin, end = (pick(float(r.t[k]) for r in runs) for pick, k in ((min, 0), (max, -1)))
    count = int((end - begin) * rate) + 1
    if count > MOST:
        raise EomcError(
            f"{shown}: {end - begin:g} s are {count} pictures, and a film has at most {MOST}: "
            "run for less, or write .html"
        )
    times = begin + np.arange(count) / rate
    made = []
    for system, run in zip(systems, runs, strict=True):
        rows = np.rint(np.interp(times, run.t, np.arange(len(run.t)))).astype(int)
        drawn = drawing(system, np.asarray(run.t)[rows], np.asarray(run.q)[rows])
        if drawn is None:
            raise EomcError(
                f"{shown}: {system.name} says nothing about its shape: add [picture] to the scene, "
                "or write .html, which has the curves"
            )
        made.append((drawn, seen(drawn)))
    maker = PillowWriter if suffix == ".gif" else FFMpegWriter
    writer = maker(fps=rate, metadata={"title": texts.line(title or systems[0].title)})
    with matplotlib.rc_context({"text.usetex": False}):
        figure = Figure(figsize=(SIZE * len(runs), SIZE), dpi=DPI, layout="constrained")
        panels = figure.subplots(1, len(runs), squeeze=False)[0]
        try:
            with writer.saving(figure, str(file), DPI):
                for k, t in enumerate(times):
                    for axes, system, (drawn, flat) in zip(panels, systems, made, strict=True):
                        axes.clear()
                        words = texts.figure(title or system.title or system.name)
                        axes.set_title(f"{words}, t = {t:.2f} s", fontsize=10, color=INK)
                        for path, colour in zip(drawn.paths, COLOURS, strict=False):
                            axes.plot(*flat[: k + 1, path.point].T, color=colour, linewidth=1.0)
                        still(axes, drawn, flat[k])
                        frame(axes, drawn, flat)
                    writer.grab_frame()
        except (OSError, CalledProcessError) as fault:
            words = getattr(fault, "strerror", None) or str(fault)
            raise EomcError(f"{shown}: can't be written ({words})") from None
