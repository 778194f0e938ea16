"""HTML summary of a run for notebooks: final state, verdict and a small picture."""

from __future__ import annotations

import base64
import io
from html import escape
from importlib.util import find_spec
from typing import Any

import numpy as np

from .labels import plain
from .package import require_eomc

SHOWN = 12  # maximum number of coordinates in the table


def html(run: Any) -> str:
    """Return a summary of a run as HTML: status, final state, error and a small picture.

    Names and titles from the scene are escaped, and nothing is loaded from URLs. Without matplotlib
    there is no picture.
    """
    model = run.model
    words = [f"{run.steps} steps of {run.method}, {run.description}"]
    words += [f"to t = {run.t[-1]:g} s"] if len(run) else []
    words.append(f"status: {run.status}" if run.status == "ok" else run.message)
    if run.error is not None:
        error = max(float(np.max(x[-1])) for x in (run.error.q, run.error.qd))
        words.append(run.error.warning or f"error at the end about {error:.1g}")
    rows = ["<tr><td>at the end</td></tr>"] if len(run) else []
    for k, name in enumerate(model.info.coordinates[:SHOWN] if len(run) else ()):
        unit = plain(model.info.units.get(name, ""))
        q, qd = (f"{x[-1, k] + 0.0:.9g}" for x in (run.q, run.qd))  # no -0
        cells = (name, f"{q} {unit}", f"{name}_dot", f"{qd} {unit and unit + '/s'}")
        rows.append("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in cells) + "</tr>")
    if (more := len(model.info.coordinates) - SHOWN) > 0:
        rows.append(f"<tr><td>and {more} more</td></tr>")
    title = plain(model.info.title or model.info.name).replace(r"\$", "$")
    parts = [f"<b>{escape(title)}</b>", *(escape(plain(w)) for w in words)]
    return f"<div>{'<br>'.join(parts)}<table>{''.join(rows)}</table>{_picture(run)}</div>"


def _picture(run: Any) -> str:
    """Return an image (HTML) of the coordinates over time; "" without matplotlib.

    The mechanism is drawn beside them if eomc is installed and the scene describes its shape.
    """
    if not len(run) or find_spec("matplotlib") is None:
        return ""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from .plot import Source, grouped, plot

    source = Source(run)
    names = list(source.coordinates)
    panels = grouped([source.curve(name) for name in names])[:3]
    shown = [c.name for panel in panels for c in panel]
    drawn = _mechanism(run)
    with rc_context({"text.usetex": False}):
        height = max(1.6 * len(panels) + 0.5, 3.2 if drawn else 0)
        figure = Figure(figsize=(9 if drawn else 6, height), layout="constrained", dpi=80)
        grid = figure.add_gridspec(len(panels), 2 if drawn else 1)
        axes = [figure.add_subplot(grid[0, 0])]
        axes += [figure.add_subplot(grid[k, 0], sharex=axes[0]) for k in range(1, len(panels))]
        plot(run, shown, None, None, (), None, False, None, axes, None, {})
        for above in axes[:-1]:
            above.tick_params(labelbottom=False)
        if drawn:
            drawn.draw(figure.add_subplot(grid[:, 1]))
        file = io.BytesIO()
        figure.savefig(file, format="png")
    data = base64.b64encode(file.getvalue()).decode("ascii")
    description = "over time: " + ", ".join(shown) + ("; and the mechanism" if drawn else "")
    return f'<img alt="{escape(description, quote=True)}" src="data:image/png;base64,{data}">'


def _mechanism(run: Any) -> Any:
    """Return the object that draws the mechanism of a run; None without eomc or shapes."""
    try:
        return require_eomc("report.picture").of_run(run)
    except ImportError:
        return None
