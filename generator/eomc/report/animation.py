"""Animations of runs: one self-contained page that plays them in real time, or a film."""

from __future__ import annotations

import base64
import html
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.emit.common.templates import environment
from eomc.report.drawing import Drawing
from eomc.report.style import html_name
from eomc.report.timeline import BatchTimeline, Panel, Source, Timeline, find_system
from eomc.runtime.atomic_write import atomic_write

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
        from eomc.report import film

        film.write_film(timelines, Path(file), title)
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
