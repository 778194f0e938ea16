"""Animations of runs, in real time: a self-contained page that plays them, or a film (GIF, MP4)."""

from __future__ import annotations

import base64
import html
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from subprocess import CalledProcessError
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.emit.common.templates import environment
from eomc.report.drawing import (
    BatchTimeline,
    Drawing,
    Panel,
    Source,
    Timeline,
    draw_mechanism,
    find_system,
)
from eomc.report.plot import (
    COLOURS,
    INK,
    choose_colours,
    draw_marks,
    frame,
    html_name,
    project_points,
    shapes,
)
from eomc.runtime.atomic_write import atomic_write
from eomc.runtime.columns import imported

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 60  # of playing, at most
MIN_INTERPOLATED_ROWS = 600  # for an adaptive run
SMOOTH_ROWS_PER_SECOND = 25  # of playing: from here on positions are interpolated linearly
PANEL_HEIGHT = 9.5  # em, of a panel of curves with its caption
MAX_BYTES = 650_000  # of positions and curves, before encoding as text
LEVELS = 32_767  # quantisation levels on either side of the middle of a range
FILMS = (".gif", ".mp4")
SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10, 25, 100, 500)
MIN_PLAYING_SECONDS, MAX_PLAYING_SECONDS = (
    1.0,
    60.0,
)  # s that the motion is played in, where not in real time


@dataclass(frozen=True)
class Animation:
    """An HTML page that plays a motion. Notebooks display it; `save` writes it to a file.

    page: the HTML text. panels: the number of panels with curves below the drawing, from which a
    notebook computes the height of its frame.
    """

    page: str = field(repr=False)
    panels: int = 0

    def save(self, file: str | os.PathLike[str]) -> None:
        """Write the page to `file`. Raises EomcError if the file can't be written."""
        with writing(texts.line(str(file))), atomic_write(file) as new:
            new.write_text(self.page, encoding="utf-8")

    def _repr_html_(self) -> str:
        """The page in a frame of its own, as high as the page."""
        inside = html.escape(self.page)
        height = max(34.0, 7 + PANEL_HEIGHT * self.panels)
        style = f"width:100%;height:{height:g}em;border:0"
        fit = "this.style.height=this.contentDocument.documentElement.scrollHeight+4+'px'"
        return f'<iframe style="{style}" title="motion" onload="{fit}" srcdoc="{inside}"></iframe>'


def animate(
    runs: Sequence[Any],
    file: str | os.PathLike[str] | None = None,
    *,
    scene: Source | None = None,
    title: str | None = None,
) -> Animation | None:
    """Animate simulated runs, drawn side by side, as an HTML page or a film.

    file: path with the suffix .html for a page, or .gif or .mp4 for a film; if None, no file is
    written. scene: the scene of the first run, needed if its module was not loaded with
    `eomc.load`. title: heading that replaces the titles of the scenes. Returns the page, or None if
    a film was written. Raises EomcError if the animation can't be drawn or written.
    """
    _check(file)
    timelines = [
        Timeline(find_system(run, scene if k == 0 else None), run) for k, run in enumerate(runs)
    ]
    return make_animation(timelines, file, title)


def instances(
    batch: Any,
    file: str | os.PathLike[str] | None = None,
    *,
    names: Sequence[str] = (),
    chosen: int | Sequence[int] = 6,
    scene: Source | None = None,
    title: str | None = None,
) -> Animation | None:
    """Animate several instances of a batch of runs, drawn over each other.

    An instance is one run of the batch. names: quantities to plot below the drawing, one panel
    each; by default coordinates and the energy. chosen: the number of instances to show, spread
    evenly over the batch, or the list of their indices. The other arguments, the result and the
    errors are those of `animate`; in addition, KeyError is raised for unknown names.
    """
    _check(file)
    return make_animation(
        [BatchTimeline(find_system(batch, scene), batch, names, chosen)], file, title
    )


def _check(file: str | os.PathLike[str] | None) -> None:
    if file is not None and Path(file).suffix.lower() not in (".html", *FILMS):
        raise EomcError(
            f"{texts.line(str(file))}: a motion is written as .html, .gif or .mp4: end its name so"
        )


def make_animation(
    timelines: Sequence[Timeline], file: str | os.PathLike[str] | None, title: str | None
) -> Animation | None:
    """Animate the runs of the timelines, drawn side by side, and write the page or film to `file`.

    title: heading that replaces the titles of the scenes. Returns the page, or None if the suffix
    of `file` requests a film. If `file` is None, no file is written.
    """
    if file is not None and Path(file).suffix.lower() in FILMS:
        write_film(timelines, Path(file), title)
        return None
    count = max(len(list(timeline.panels(np.zeros(1, dtype=int)))) for timeline in timelines)
    animation = Animation(page(timelines, title), count)
    if file is not None:
        animation.save(file)
    return animation


def page(timelines: Sequence[Timeline], title: str | None = None) -> str:
    """Return the HTML text of the page that plays the timelines (runs) side by side."""
    pages = [_RunOnPage(timeline, len(timelines)) for timeline in timelines]
    heading = title or " and ".join(dict.fromkeys(timeline.title for timeline in timelines))
    seconds = max(page_run.rows[-1] - page_run.rows[0] for page_run in pages)
    data = {
        "speed": _speed(seconds),
        "speeds": SPEEDS,
        "runs": [page_run.data() for page_run in pages],
    }
    text = json.dumps(data, separators=(",", ":"))
    safe = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return (
        environment()
        .get_template("report/animation.html.jinja")
        .render(
            title=texts.html(heading),
            data=Markup(safe),
            runs=[page_run.words() for page_run in pages],
            speeds=[f"{speed:g}" for speed in SPEEDS],
            travels=any(page_run.drawing and page_run.drawing.travels for page_run in pages),
        )
    )


def _speed(seconds: float) -> float:
    """Return the playing speed: 1 (real time), unless the motion is very short or very long."""
    if MIN_PLAYING_SECONDS <= seconds <= MAX_PLAYING_SECONDS or not seconds:
        return 1.0
    target_speed = seconds / (
        MIN_PLAYING_SECONDS if seconds < MIN_PLAYING_SECONDS else MAX_PLAYING_SECONDS / 2
    )
    return min(SPEEDS, key=lambda speed: abs(math.log(speed / target_speed)))


class _RunOnPage:
    """One run on the page: its rows, drawing and panels."""

    def __init__(self, timeline: Timeline, count: int) -> None:
        drawing = timeline.drawing(np.zeros(1, dtype=int))
        width = drawing.points[0].size if drawing else 0
        max_rows = max(
            MAX_BYTES // (2 * (width + timeline.curves + 4) * count), 2
        )  # rows; a time has 8 bytes
        seconds = float(timeline.t[-1] - timeline.t[0])
        self.speed = _speed(seconds)
        row_count = min(
            max(int(FRAMES_PER_SECOND / self.speed * seconds) + 1, MIN_INTERPOLATED_ROWS), max_rows
        )
        resampled = timeline.resample(row_count)
        self.timeline, t = timeline, timeline.t
        last = len(t) - 1
        spacing = seconds / last if last else 1.0
        step = max(round(self.speed / (FRAMES_PER_SECOND * spacing)), 1) if spacing > 0 else 1
        step = 1 if resampled else max(step, -(-last // max_rows))
        self.index = np.unique(np.append(np.arange(0, last + 1, step), last))
        self.rows = t[self.index]
        self.drawing = timeline.drawing(self.index)
        self.panels = list(timeline.panels(self.index))

    @property
    def rate(self) -> float:
        """Number of stored states per second of simulated time."""
        lasting = self.rows[-1] - self.rows[0]
        return (len(self.rows) - 1) / lasting if lasting else 0.0

    def data(self) -> dict[str, Any]:
        """Return the data of the run for the script of the page, to be written as JSON."""
        has_stairs = self.timeline.has_stairs
        return {
            "t": [float(self.rows[0]), float(self.rows[-1])],
            "rows": base64.b64encode(self.rows.astype("<f8").tobytes()).decode("ascii"),
            "smooth": bool(self.rate * self.speed >= SMOOTH_ROWS_PER_SECOND),
            "drawing": _drawing_data(self.drawing) if self.drawing else None,
            "many": len(self.timeline.key),
            "panels": [
                [
                    _quantize(c.values) | {"stairs": has_stairs and c.kind == "inputs"}
                    for c in p.curves
                ]
                for p in self.panels
            ],
        }

    def words(self) -> dict[str, Any]:
        """Return the texts that describe the run, as data for the template animation.html."""
        drawing = self.drawing
        scale = np.ptp(drawing.points, axis=(0, 1)).max() / (2 * LEVELS) if drawing else 0.0
        resolution = f"{len(self.rows)} rows, {self.rate:.3g} a second of the motion"
        if drawing:
            resolution += f"; positions to {scale:.1g} {drawing.unit}".rstrip()
        kinds = dict.fromkeys(_KINDS[m.kind] for m in drawing.marks) if drawing else {}
        many = len(self.timeline.key)
        space = "in the plane" if drawing and drawing.is_planar else "in space"
        return {
            "title": texts.html(self.timeline.title),
            "drawn": bool(drawing),
            "plane": bool(drawing and drawing.is_planar),
            "description": texts.html(
                f"{self.timeline.title}, {space}: "
                + ", ".join([*kinds, *([f"of {many} instances"] if many else [])])
            ),
            "key": [texts.html(words) for words in self.timeline.key],
            "resolution": resolution,
            "panels": [*map(_caption, self.panels)],
        }


def _caption(panel: Panel) -> dict[str, Any]:
    """Return the caption of a panel: the names of its curves, or that of their common quantity."""
    names = [panel.name] if panel.name else [curve.name for curve in panel.curves]
    return {
        "names": [Markup(html_name(n.removesuffix("_dot"), n.endswith("_dot"))) for n in names],
        "keyed": not panel.name,
        "plain": ", ".join(names).replace("_", " "),
        "unit": texts.html(panel.curves[0].unit),
    }


_KINDS = {
    "line": "lines", "rod": "bodies", "arm": "bodies", "rail": "rails", "spring": "springs",
    "damper": "dampers", "box": "boxes", "inertia": "boxes of the inertias", "circle": "circles",
    "joint": "joints", "spiral": "springs that turn", "slide": "slides", "ground": "supports",
    "mass": "centres of mass", "point": "points", "dot": "points",
}  # fmt: skip


def _quantize(values: Array) -> dict[str, Any]:
    """Quantise values to 16 bits between their minimum and maximum; -32768 if not finite."""
    finite = np.isfinite(values)
    low = float(values[finite].min()) if finite.any() else 0.0
    high = float(values[finite].max()) if finite.any() else 0.0
    middle, half = low / 2 + high / 2, high / 2 - low / 2
    scale = half / LEVELS if half > 0 else 1.0
    with np.errstate(invalid="ignore"):
        levels = np.where(finite, np.round((values - middle) / scale), -LEVELS - 1)
    text = base64.b64encode(levels.astype("<i2").tobytes()).decode("ascii")
    return {"data": text, "middle": middle, "scale": scale}


def _drawing_data(drawing: Drawing) -> dict[str, Any]:
    """Return the data of a drawing: moving points, static points, and the marks on them."""
    points = drawing.points
    moves = np.ptp(np.nan_to_num(points, nan=1e300), axis=0).max(axis=1) > 0
    order = np.argsort(~moves, kind="stable")
    place = np.empty(len(order), dtype=int)
    place[order] = np.arange(len(order))
    moving = points[:, moves]
    return {
        "axes": drawing.axes,
        "labels": [name.replace("_", " ") for name in drawing.labels],
        "unit": drawing.unit,
        "up": drawing.up,
        "follow": drawing.max_extent if drawing.travels else 0,
        "count": int(moves.sum()),
        "moving": _quantize(moving) if moving.size else None,
        "fixed": [[float(f"{x:.9g}") if math.isfinite(x) else 0.0 for x in p]
                  for p in points[0, ~moves]],
        "marks": [[mark.kind, *(int(place[k]) for k in mark.points)] for mark in drawing.marks],
        "whose": [mark.instance for mark in drawing.marks if mark.instance is not None],
        "paths": [
            [p.name.replace("_", " "), int(place[p.point]), k if p.instance is None else p.instance]
            for k, p in enumerate(drawing.paths)
        ],
    }  # fmt: skip


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
