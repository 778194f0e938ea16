"""What a notebook shows of a run: its end, its verdict and a small picture."""

from __future__ import annotations

import base64
import io
from html import escape
from importlib.util import find_spec
from typing import Any

import numpy as np

from .labels import plain

SHOWN = 12  # coordinates in the table, at most


def html(run: Any) -> str:
    """A run as HTML; free text of the scene is escaped, no request leaves it."""
    model = run._model
    words = [f"{run.steps} steps of {run.method}, {run.told}"]
    words += [f"to t = {run.t[-1]:g} s"] if len(run) else []
    words.append(f"status: {run.status}" if run.status == "ok" else run.message)
    if run.error is not None:
        error = max(float(np.max(x[-1])) for x in (run.error.q, run.error.qd))
        words.append(run.error.warning or f"error at the end about {error:.1g}")
    rows = ["<tr><td>at the end</td></tr>"] if len(run) else []
    for k, name in enumerate(model.coordinates[:SHOWN] if len(run) else ()):
        unit = plain(model.units.get(name, ""))
        q, qd = f"{run.q[-1, k]:.9g}", f"{run.qd[-1, k]:.9g}"
        cells = (name, f"{q} {unit}", f"{name}_dot", f"{qd} {unit and unit + '/s'}")
        rows.append("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in cells) + "</tr>")
    if (more := len(model.coordinates) - SHOWN) > 0:
        rows.append(f"<tr><td>and {more} more</td></tr>")
    title = plain(model.title or model.name).replace(r"\$", "$")
    parts = [f"<b>{escape(title)}</b>", *(escape(plain(w)) for w in words)]
    return f"<div>{'<br>'.join(parts)}<table>{''.join(rows)}</table>{_picture(run)}</div>"


def _picture(run: Any) -> str:
    """The coordinates over time as an image, where matplotlib is there."""
    if not len(run) or find_spec("matplotlib") is None:
        return ""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from .plot import Source, grouped, plot

    source = Source(run)
    names = list(source.coordinates)
    panels = grouped([source.curve(name) for name in names])[:3]
    shown = [c.name for panel in panels for c in panel]
    with rc_context({"text.usetex": False}):
        figure = Figure(figsize=(6, 1.6 * len(panels) + 0.5), layout="constrained", dpi=80)
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        plot(run, shown, None, None, (), None, False, None, axes, {})
        file = io.BytesIO()
        figure.savefig(file, format="png")
    data = base64.b64encode(file.getvalue()).decode("ascii")
    said = escape("over time: " + ", ".join(shown), quote=True)
    return f'<img alt="{said}" src="data:image/png;base64,{data}">'
