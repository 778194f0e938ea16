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
from eomc.report.drawing import drawing
from eomc.report.marks import Drawing
from eomc.report.picture import draw_marks, frame, project_points, shapes
from eomc.report.reel import Reel
from eomc.report.style import COLOURS, INK, colours
from eomc.report.system_of_run import Source, system_of
from eomc.runtime.atomic_write import atomic_write
from eomc.runtime.columns import imported

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

RATES = {".gif": 25, ".mp4": 50}  # pictures a second; a GIF counts in hundredths of a second
MOST = 1500  # pictures
VIEWED = 400  # rows of a run that the view of a single picture has room for, at most
SIZE, DPI = 4.8, 100  # inches of a run, dots an inch
WHITE = 248  # from which on it is white: Pillow finds the nearest colour to four values or so


def write(reels: Sequence[Reel], file: Path, title: str | None) -> None:
    """The mechanisms in real time, side by side. Raises EomcError where that can't be done."""
    suffix, shown = file.suffix.lower(), texts.line(str(file))
    try:
        import matplotlib
        from matplotlib.animation import FFMpegWriter
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
        made.append(drawn)
    with matplotlib.rc_context({"text.usetex": False}):
        pictures = Pictures(reels, made, times, title)
        try:
            with atomic_write(file) as new:
                if suffix == ".gif":
                    _gif(pictures, new)
                else:
                    _mp4(pictures, new, texts.line(title or reels[0].title))
        except (OSError, CalledProcessError) as fault:
            words = getattr(fault, "strerror", None) or str(fault)
            raise EomcError(f"{shown}: can't be written ({words})") from None


def render(run: Any, t: Any, scene: Source | None) -> Pixels:
    """Draw the mechanism at the times `t`, in a view with room for the whole motion.

    Returns pixels (height, width, 3), or (n, height, width, 3) for times (n,). Raises EomcError if
    the scene has no shape, ImportError without matplotlib.
    """
    imported("matplotlib", "render")
    wanted = np.asarray(run.t[-1] if t is None else t, dtype=float)
    reel = Reel(system_of(run, scene), run)
    q, _ = run(wanted.ravel())
    rows = np.unique(np.linspace(0, len(reel.t) - 1, VIEWED).astype(int))
    times = np.concatenate([wanted.ravel(), reel.t[rows]])
    states = np.concatenate([q, np.asarray(run.q)[rows]]).astype(float)
    drawn = drawing(reel.system, times, states)
    if drawn is None:
        raise EomcError(
            f"render: {reel.system.name} says nothing about its shape: add [picture] to the scene"
        )
    order = np.argsort(times, kind="stable")
    place = np.argsort(order)[: wanted.size]
    ordered = replace(drawn, points=drawn.points[order])
    pictures = Pictures([reel], [ordered], times[order], None)
    found = np.stack([pictures.at(int(k))[..., :3] for k in place])
    return found if wanted.ndim else found[0]


def _gif(pictures: Pictures, file: Path) -> None:
    """In the colours of three of its pictures, as it takes longer to find those of each."""
    from PIL import Image

    def image(picture: Pixels) -> Image.Image:
        return Image.fromarray(picture).convert("RGB")

    count = len(pictures.times)
    some = np.concatenate([pictures.at(k) for k in (0, count // 2, count - 1)])
    few = image(some).quantize(method=Image.Quantize.MAXCOVERAGE)
    known = np.reshape(few.getpalette() or [], (-1, 3)).astype(np.uint8)
    known[known.min(axis=1) >= WHITE] = 255
    few.putpalette(known.tobytes())
    first, *others = (
        image(pictures.at(k)).quantize(palette=few, dither=Image.Dither.NONE) for k in range(count)
    )
    delay = 1000 // RATES[".gif"]
    first.save(file, save_all=True, append_images=others, duration=delay, loop=0)


def _mp4(pictures: Pictures, file: Path, title: str) -> None:
    from matplotlib.animation import FFMpegWriter
    from matplotlib.figure import Figure

    writer = FFMpegWriter(fps=RATES[".mp4"], metadata={"title": title})
    width, height = pictures.figure.get_size_inches()
    sheet = Figure(figsize=(width, height), dpi=DPI)
    image = sheet.figimage(pictures.at(0))
    with writer.saving(sheet, str(file), DPI):
        for k in range(len(pictures.times)):
            image.set_data(pictures.at(k))
            writer.grab_frame()


class Pictures:
    """The pictures of a film, side by side what is drawn of each run, at some times.

    What stands is drawn once, and what moves over it.
    """

    def __init__(
        self, reels: Sequence[Reel], made: Sequence[Drawing], times: Array, title: str | None
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.times = times
        self.figure = Figure(figsize=(SIZE * len(reels), SIZE), dpi=DPI, layout="constrained")
        self.canvas = cast(Any, FigureCanvasAgg(self.figure))
        panels = self.figure.subplots(1, len(reels), squeeze=False)[0]
        self.moving = [
            _Moving(axes, drawn, times, len(reel.key), texts.figure(title or reel.title))
            for axes, reel, drawn in zip(panels, reels, made, strict=True)
        ]
        self.canvas.draw()
        self.standing = self.canvas.copy_from_bbox(self.figure.bbox)

    def at(self, k: int) -> Pixels:
        """The picture at an instant, (height, width, 4)."""
        self.canvas.restore_region(self.standing)
        for moving in self.moving:
            moving.draw(k)
        return np.array(self.canvas.buffer_rgba())


class _Moving:
    """What moves of one run: the marks, the paths so far and the time in the title."""

    def __init__(self, axes: Axes, made: Drawing, times: Array, instances: int, words: str) -> None:
        self.axes, self.times, self.words, self.flat = axes, times, words, project_points(made)
        hues = colours(instances or len(COLOURS))
        self.title = axes.set_title(self._title(0), fontsize=10, color=INK)
        pairs = [*zip(made.paths, hues, strict=False)]
        self.points = [path.point for path, _ in pairs]
        self.paths = [
            axes.plot(
                [], [], color=own if path.instance is None else hues[path.instance], linewidth=1.0
            )
            for path, own in pairs
        ]
        self.marks = draw_marks(axes, made, self.flat[0], hues=hues)
        self.shapes = [[line for line, _ in shapes(made, at, hues=hues)] for at in self.flat]
        for each in self.shapes:
            axes.update_datalim(np.concatenate(each))  # the view has room for all
        frame(axes, made, self.flat)
        for artist in (self.title, *axes.lines):
            artist.set_animated(True)  # not drawn with what stands

    def _title(self, k: int) -> str:
        return f"{self.words}, t = {self.times[k]:.2f} s"

    def draw(self, k: int) -> None:
        """Over what stands."""
        self.title.set_text(self._title(k))
        for (line,), point in zip(self.paths, self.points, strict=True):
            line.set_data(*self.flat[: k + 1, point].T)
        for line, points in zip(self.marks, self.shapes[k], strict=True):
            line.set_data(*points.T)
        for artist in (self.title, *sorted(self.axes.lines, key=lambda line: line.zorder)):
            self.axes.draw_artist(artist)
