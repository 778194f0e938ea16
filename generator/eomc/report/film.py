"""The motion of runs as a film, GIF by Pillow or MP4 by ffmpeg, drawn by matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from subprocess import CalledProcessError
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.report.drawing import Drawing, draw_mechanism
from eomc.report.picture import draw_marks, frame, project_points, shapes
from eomc.report.style import COLOURS, INK, choose_colours
from eomc.report.timeline import Source, Timeline, find_system
from eomc.runtime.atomic_write import atomic_write
from eomc.runtime.columns import imported

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

RATES = {".gif": 25, ".mp4": 50}  # pictures a second; a GIF counts in hundredths of a second
MAX_PICTURES = 1500  # of one film
MAX_VIEW_ROWS = 400  # of the run, from which `render` computes the limits of the view
SIZE, DPI = 4.8, 100  # inches of a run, dots an inch
WHITE_LEVEL = 248  # entries brighter than this become white: Pillow is off by about 4


def write_film(timelines: Sequence[Timeline], file: Path, title: str | None) -> None:
    """Write a film (.gif or .mp4) that shows the mechanisms side by side in real time.

    timelines: the runs to show. Raises EomcError if matplotlib or ffmpeg is missing, the film would
    be too long, a scene does not describe its shape, or the file can't be written.
    """
    suffix, shown = file.suffix.lower(), texts.line(str(file))
    try:
        import matplotlib
        from matplotlib.animation import FFMpegWriter
    except ImportError:
        raise EomcError(f"{shown}: films need matplotlib: pip install matplotlib") from None
    if suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise EomcError(f"{shown}: films as MP4 need the program ffmpeg: install it, or write .gif")
    rate = RATES[suffix]
    begin, end = (pick(float(r.t[k]) for r in timelines) for pick, k in ((min, 0), (max, -1)))
    count = int((end - begin) * rate) + 1
    if count > MAX_PICTURES:
        raise EomcError(
            f"{shown}: {end - begin:g} s are {count} pictures, and a film has at most "
            f"{MAX_PICTURES}: run for less, or write .html"
        )
    times = begin + np.arange(count) / rate
    drawings = []
    for timeline in timelines:
        rows = np.rint(np.interp(times, timeline.t, np.arange(len(timeline.t)))).astype(int)
        drawn = timeline.drawing(rows)
        if drawn is None:
            raise EomcError(
                f"{shown}: {timeline.system.name} says nothing about its shape: add [picture] to "
                "the scene, or write .html, which has the curves"
            )
        drawings.append(drawn)
    with matplotlib.rc_context({"text.usetex": False}):
        pictures = Pictures(timelines, drawings, times, title)
        try:
            with atomic_write(file) as new:
                if suffix == ".gif":
                    _gif(pictures, new)
                else:
                    _mp4(pictures, new, texts.line(title or timelines[0].title))
        except (OSError, CalledProcessError) as fault:
            words = getattr(fault, "strerror", None) or str(fault)
            raise EomcError(f"{shown}: can't be written ({words})") from None


def render(run: Any, t: Any, scene: Source | None) -> Pixels:
    """Draw the mechanism of a run at the times `t`, in a view that contains the whole motion.

    t: a time in s or times (n,); None for the end of the run. scene: needed if the module of the
    run was not loaded with `eomc.load`. Returns RGB pixels of shape (height, width, 3), or
    (n, height, width, 3) for times (n,). Raises EomcError if the scene does not describe the shape
    of the mechanism, and ImportError if matplotlib is not installed.
    """
    imported("matplotlib", "render")
    instants = np.asarray(run.t[-1] if t is None else t, dtype=float)
    timeline = Timeline(find_system(run, scene), run)
    q, _ = run(instants.ravel())
    rows = np.unique(np.linspace(0, len(timeline.t) - 1, MAX_VIEW_ROWS).astype(int))
    times = np.concatenate([instants.ravel(), timeline.t[rows]])
    states = np.concatenate([q, np.asarray(run.q)[rows]]).astype(float)
    drawn = draw_mechanism(timeline.system, times, states)
    if drawn is None:
        raise EomcError(
            f"render: {timeline.system.name} says nothing about its shape: add [picture] to the "
            "scene"
        )
    order = np.argsort(times, kind="stable")
    place = np.argsort(order)[: instants.size]
    ordered = replace(drawn, points=drawn.points[order])
    pictures = Pictures([timeline], [ordered], times[order], None)
    images = np.stack([pictures.picture(int(k))[..., :3] for k in place])
    return images if instants.ndim else images[0]


def _gif(pictures: Pictures, file: Path) -> None:
    """Write a GIF with one palette, computed from three of its pictures to save time."""
    from PIL import Image

    def image(picture: Pixels) -> Image.Image:
        return Image.fromarray(picture).convert("RGB")

    count = len(pictures.times)
    some = np.concatenate([pictures.picture(k) for k in (0, count // 2, count - 1)])
    few = image(some).quantize(method=Image.Quantize.MAXCOVERAGE)
    known = np.reshape(few.getpalette() or [], (-1, 3)).astype(np.uint8)
    known[known.min(axis=1) >= WHITE_LEVEL] = 255
    few.putpalette(known.tobytes())
    first, *others = (
        image(pictures.picture(k)).quantize(palette=few, dither=Image.Dither.NONE)
        for k in range(count)
    )
    delay = 1000 // RATES[".gif"]
    first.save(file, save_all=True, append_images=others, duration=delay, loop=0)


def _mp4(pictures: Pictures, file: Path, title: str) -> None:
    from matplotlib.animation import FFMpegWriter
    from matplotlib.figure import Figure

    writer = FFMpegWriter(fps=RATES[".mp4"], metadata={"title": title})
    width, height = pictures.figure.get_size_inches()
    sheet = Figure(figsize=(width, height), dpi=DPI)
    image = sheet.figimage(pictures.picture(0))
    with writer.saving(sheet, str(file), DPI):
        for k in range(len(pictures.times)):
            image.set_data(pictures.picture(k))
            writer.grab_frame()


class Pictures:
    """The pictures of a film: the drawings of all runs, side by side, at `times` (n,) in s.

    The static background is drawn once, and the moving marks are drawn over it.
    """

    def __init__(
        self,
        timelines: Sequence[Timeline],
        drawings: Sequence[Drawing],
        times: Array,
        title: str | None,
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.times = times
        self.figure = Figure(figsize=(SIZE * len(timelines), SIZE), dpi=DPI, layout="constrained")
        self.canvas = cast(Any, FigureCanvasAgg(self.figure))
        panels = self.figure.subplots(1, len(timelines), squeeze=False)[0]
        self.moving = [
            _Moving(axes, drawn, times, len(timeline.key), texts.figure(title or timeline.title))
            for axes, timeline, drawn in zip(panels, timelines, drawings, strict=True)
        ]
        self.canvas.draw()
        self.standing = self.canvas.copy_from_bbox(self.figure.bbox)

    def picture(self, k: int) -> Pixels:
        """Return the RGBA pixels (height, width, 4) of the picture at `times[k]`."""
        self.canvas.restore_region(self.standing)
        for moving in self.moving:
            moving.draw(k)
        return np.array(self.canvas.buffer_rgba())


class _Moving:
    """Moving artists of one run: its marks, the paths so far and the time in the title."""

    def __init__(
        self, axes: Axes, motion: Drawing, times: Array, instances: int, words: str
    ) -> None:
        self.axes, self.times, self.words, self.flat = axes, times, words, project_points(motion)
        hues = choose_colours(instances or len(COLOURS))
        self.title = axes.set_title(self._title(0), fontsize=10, color=INK)
        pairs = [*zip(motion.paths, hues, strict=False)]
        self.points = [path.point for path, _ in pairs]
        self.paths = [
            axes.plot(
                [], [], color=own if path.instance is None else hues[path.instance], linewidth=1.0
            )
            for path, own in pairs
        ]
        self.marks = draw_marks(axes, motion, self.flat[0], hues=hues)
        self.shapes = [[line for line, _ in shapes(motion, at, hues=hues)] for at in self.flat]
        for each in self.shapes:
            axes.update_datalim(np.concatenate(each))  # the view has room for all
        frame(axes, motion, self.flat)
        for artist in (self.title, *axes.lines):
            artist.set_animated(True)  # not part of the background

    def _title(self, k: int) -> str:
        return f"{self.words}, t = {self.times[k]:.2f} s"

    def draw(self, k: int) -> None:
        """Draw the marks, paths and title at `times[k]` over the background of the figure."""
        self.title.set_text(self._title(k))
        for (line,), point in zip(self.paths, self.points, strict=True):
            line.set_data(*self.flat[: k + 1, point].T)
        for line, points in zip(self.marks, self.shapes[k], strict=True):
            line.set_data(*points.T)
        for artist in (self.title, *sorted(self.axes.lines, key=lambda line: line.zorder)):
            self.axes.draw_artist(artist)
