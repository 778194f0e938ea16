"""The motion of runs as one page without a network, that plays it in real time, or as a film."""

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
from eomc.emit.render import environment
from eomc.report.labels import html_name
from eomc.report.marks import Drawing
from eomc.report.reel import Instances, Panel, Reel
from eomc.report.system_of_run import Source, system_of
from eomc.runtime.atomic_write import atomic_write

Array = NDArray[np.float64]

FRAMES = 60  # rows a second of playing, at most
INTERPOLATED = 600  # rows of an adaptive run, at least
SMOOTH = 25  # rows a second of playing from which positions are interpolated linearly between rows
PANEL_HEIGHT = 9.5  # em, of a panel of curves with its caption
BYTES = 650_000  # of positions and curves before they are written as text, at most
LEVELS = 32_767  # of a quantity from its middle to its ends
FILMS = (".gif", ".mp4")
SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10, 25, 100, 500)
SHORT, LONG = 1.0, 60.0  # s that the motion is played in, where not in real time


@dataclass(frozen=True)
class Animation:
    """A page that plays a motion; notebooks show it, `save` writes it.

    panels: the number of panels of curves below each other.
    """

    page: str = field(repr=False)
    panels: int = 0

    def save(self, file: str | os.PathLike[str]) -> None:
        """Write the page. Raises EomcError where it can't be written."""
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
    """The motion of runs, side by side.

    file: .html, .gif or .mp4; None: nothing is written. scene: of the first run, as in system_of.
    Returns the page, None of a film. Raises EomcError where it can't be drawn or written.
    """
    _check(file)
    reels = [Reel(system_of(run, scene if k == 0 else None), run) for k, run in enumerate(runs)]
    return shown(reels, file, title)


def instances(
    batch: Any,
    file: str | os.PathLike[str] | None = None,
    *,
    names: Sequence[str] = (),
    chosen: int | Sequence[int] = 6,
    scene: Source | None = None,
    title: str | None = None,
) -> Animation | None:
    """The motion of instances of a batch, over each other.

    names: of the curves. chosen: how many instances, or which. Else as `animate`; raises KeyError
    for unknown names too.
    """
    _check(file)
    return shown([Instances(system_of(batch, scene), batch, names, chosen)], file, title)


def _check(file: str | os.PathLike[str] | None) -> None:
    if file is not None and Path(file).suffix.lower() not in (".html", *FILMS):
        raise EomcError(
            f"{texts.line(str(file))}: a motion is written as .html, .gif or .mp4: end its name so"
        )


def shown(
    reels: Sequence[Reel], file: str | os.PathLike[str] | None, title: str | None
) -> Animation | None:
    """The page of what is shown, None of a film; written where there is a file."""
    if file is not None and Path(file).suffix.lower() in FILMS:
        from eomc.report import film

        film.write(reels, Path(file), title)
        return None
    count = max(len(list(reel.panels(np.zeros(1, dtype=int)))) for reel in reels)
    made = Animation(page(reels, title), count)
    if file is not None:
        made.save(file)
    return made


def page(reels: Sequence[Reel], title: str | None = None) -> str:
    """The text of the page."""
    shown = [_Shown(reel, len(reels)) for reel in reels]
    named = title or " and ".join(dict.fromkeys(reel.title for reel in reels))
    lasting = max(one.rows[-1] - one.rows[0] for one in shown)
    data = {"speed": _speed(lasting), "speeds": SPEEDS, "runs": [one.data() for one in shown]}
    text = json.dumps(data, separators=(",", ":"))
    safe = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return (
        environment()
        .get_template("report/animation.html.jinja")
        .render(
            title=texts.html(named),
            data=Markup(safe),
            runs=[one.words() for one in shown],
            speeds=[f"{speed:g}" for speed in SPEEDS],
            travels=any(one.drawing and one.drawing.travels for one in shown),
        )
    )


def _speed(seconds: float) -> float:
    """Real time, unless the motion would then be over at once or not for a long while."""
    if SHORT <= seconds <= LONG or not seconds:
        return 1.0
    wanted = seconds / (SHORT if seconds < SHORT else LONG / 2)
    return min(SPEEDS, key=lambda speed: abs(math.log(speed / wanted)))


class _Shown:
    """One run on the page."""

    def __init__(self, reel: Reel, count: int) -> None:
        made = reel.drawing(np.zeros(1, dtype=int))
        width = made.points[0].size if made else 0
        most = max(BYTES // (2 * (width + reel.curves + 4) * count), 2)  # rows; a time has 8 bytes
        lasting = float(reel.t[-1] - reel.t[0])
        self.speed = _speed(lasting)
        even = min(max(int(FRAMES / self.speed * lasting) + 1, INTERPOLATED), most)
        resampled = reel.resample(even)
        self.reel, t = reel, reel.t
        last = len(t) - 1
        spacing = lasting / last if last else 1.0
        step = max(round(self.speed / (FRAMES * spacing)), 1) if spacing > 0 else 1
        step = 1 if resampled else max(step, -(-last // most))
        self.index = np.unique(np.append(np.arange(0, last + 1, step), last))
        self.rows = t[self.index]
        self.drawing = reel.drawing(self.index)
        self.panels = list(reel.panels(self.index))

    @property
    def rate(self) -> float:
        """Rows a second."""
        lasting = self.rows[-1] - self.rows[0]
        return (len(self.rows) - 1) / lasting if lasting else 0.0

    def data(self) -> dict[str, Any]:
        return {
            "t": [float(self.rows[0]), float(self.rows[-1])],
            "rows": base64.b64encode(self.rows.astype("<f8").tobytes()).decode("ascii"),
            "smooth": bool(self.rate * self.speed >= SMOOTH),
            "drawing": _drawn(self.drawing) if self.drawing else None,
            "many": len(self.reel.key),
            "panels": [
                [_packed(line.values) | {"stairs": line.stairs} for line in p.lines]
                for p in self.panels
            ],
        }

    def words(self) -> dict[str, Any]:
        """What the page says of the run."""
        made = self.drawing
        scale = np.ptp(made.points, axis=(0, 1)).max() / (2 * LEVELS) if made else 0.0
        resolution = f"{len(self.rows)} rows, {self.rate:.3g} a second of the motion"
        if made:
            resolution += f"; positions to {scale:.1g} {made.unit}".rstrip()
        kinds = dict.fromkeys(_KINDS[m.kind] for m in made.marks) if made else {}
        many = len(self.reel.key)
        return {
            "title": texts.html(self.reel.title),
            "drawn": bool(made),
            "plane": bool(made and made.is_planar),
            "description": texts.html(
                f"{self.reel.title}, {'in the plane' if made and made.is_planar else 'in space'}: "
                + ", ".join([*kinds, *([f"of {many} instances"] if many else [])])
            ),
            "key": [texts.html(words) for words in self.reel.key],
            "resolution": resolution,
            "panels": [*map(_caption, self.panels)],
        }


def _caption(panel: Panel) -> dict[str, Any]:
    """What stands above curves: the name of each, or that of the quantity that all are of."""
    names = [panel.name] if panel.name else [line.name for line in panel.lines]
    return {
        "names": [Markup(html_name(n.removesuffix("_dot"), n.endswith("_dot"))) for n in names],
        "keyed": not panel.name,
        "plain": ", ".join(names).replace("_", " "),
        "unit": texts.html(panel.unit),
    }


_KINDS = {
    "line": "lines", "rod": "bodies", "arm": "bodies", "rail": "rails", "spring": "springs",
    "damper": "dampers", "box": "boxes", "inertia": "boxes of the inertias", "circle": "circles",
    "joint": "joints", "spiral": "springs that turn", "slide": "slides", "ground": "supports",
    "mass": "centres of mass", "point": "points", "dot": "points",
}  # fmt: skip


def _packed(values: Array) -> dict[str, Any]:
    """Values as 16 bits each between the least and the largest; what is not finite is -32768."""
    finite = np.isfinite(values)
    low = float(values[finite].min()) if finite.any() else 0.0
    high = float(values[finite].max()) if finite.any() else 0.0
    middle, half = low / 2 + high / 2, high / 2 - low / 2
    scale = half / LEVELS if half > 0 else 1.0
    with np.errstate(invalid="ignore"):
        levels = np.where(finite, np.round((values - middle) / scale), -LEVELS - 1)
    text = base64.b64encode(levels.astype("<i2").tobytes()).decode("ascii")
    return {"data": text, "middle": middle, "scale": scale}


def _drawn(made: Drawing) -> dict[str, Any]:
    """Points that move and points that stand, and the marks on them."""
    points = made.points
    moves = np.ptp(np.nan_to_num(points, nan=1e300), axis=0).max(axis=1) > 0
    order = np.argsort(~moves, kind="stable")
    place = np.empty(len(order), dtype=int)
    place[order] = np.arange(len(order))
    moving = points[:, moves]
    return {
        "axes": made.axes,
        "labels": [name.replace("_", " ") for name in made.labels],
        "unit": made.unit,
        "up": made.up,
        "follow": made.max_extent if made.travels else 0,
        "count": int(moves.sum()),
        "moving": _packed(moving) if moving.size else None,
        "still": [[float(f"{x:.9g}") if math.isfinite(x) else 0.0 for x in p]
                  for p in points[0, ~moves]],
        "marks": [[mark.kind, *(int(place[k]) for k in mark.points)] for mark in made.marks],
        "whose": [mark.instance for mark in made.marks if mark.instance is not None],
        "paths": [
            [p.name.replace("_", " "), int(place[p.point]), k if p.instance is None else p.instance]
            for k, p in enumerate(made.paths)
        ],
    }  # fmt: skip
