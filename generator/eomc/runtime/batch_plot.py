"""Plots of many runs: bands of quantiles, lines, final values over parameters."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .arguments import Array, not_one_of
from .atomic_write import File
from .labels import mathtext, with_unit
from .plot import Curve, Source, against, check_axes, finished, new_axes, no_files
from .plugins import require_eomc

_OF_ONE = {"phase", "section", "other", "labels"}


def single_run_hint(runs: Any) -> str:
    """Return a hint for error messages: the call that repeats one instance as a single run.

    runs: the batch that contains the instance.
    """
    name = runs._model.name
    return f"is of one run: {name}.simulate(runs.q[k, 0], runs.qd[k, 0], params=...)"


class Fans:
    """Mixin that adds plots and animations to `batch_run.BatchRun`."""

    def plot(
        self, *names: str, quantiles: Sequence[float] = (0.05, 0.25, 0.5, 0.75, 0.95),
        lines: int | None = None, over: Any = None, wrap: bool | str | Sequence[str] = False,
        ax: Any = None, axes: Any = None, file: File | None = None, **style: Any,
    ) -> Any:  # fmt: skip
        """Plot the distribution of the instances over time, as bands between quantiles.

        Parameters
        ----------
        *names : str
            Columns to plot, each in its own panel; by default the coordinates.
        quantiles : sequence of float
            Limits of the bands, from 0 to 1, of the instances that reached each time. If their
            number is odd, the middle one is drawn as a line.
        lines : int, optional
            Draw this number of instances as lines instead of the bands.
        over : str or (batch,) array, optional
            Draw the final value of each instance instead, over "instance" (its index), a parameter
            or these numbers.
        wrap, ax, axes, file, **style
            As in `Run.plot`.

        Returns
        -------
        matplotlib Axes, or an array of Axes if there are several panels

        Raises
        ------
        TypeError
            For arguments that apply to single runs only, such as phase.
        KeyError
            For unknown names.
        ValueError
            If `over` is neither a known name nor has the shape (batch,).
        ModuleNotFoundError
            If matplotlib is not installed.
        """
        for name in _OF_ONE & style.keys():
            raise TypeError(f"plot: {name}= {single_run_hint(self)}.plot({name}=...)")
        return fan(self, names, quantiles, lines, over, wrap, ax, axes, file, style)

    def animate(
        self, file: File | None = None, *, names: Sequence[str] = (),
        instances: int | Sequence[int] = 6, scene: Any = None, title: str | None = None,
    ) -> Any:  # fmt: skip
        """Animate several instances together in different colours.

        Instances that ended earlier keep their last position.

        Parameters
        ----------
        file : path, optional
            File to write: a page .html, or a film .gif or .mp4.
        names : sequence of str
            Columns to draw as curves; by default the coordinates and the energy.
        instances : int or sequence of int
            Number of instances, which are evenly spaced in the batch, or their indices; at most 24.
        scene : path, optional
            Scene file, if the module was not loaded by `eomc.load`.
        title : str, optional
            Title of the page.

        Returns
        -------
        Animation or None
            The page; None for a film.

        Raises
        ------
        KeyError
            For unknown names.
        EomcError
            For unknown instances, or if the animation cannot be drawn or written.
        ImportError
            If eomc is not installed.
        """
        page = require_eomc("report.animation")
        return page.instances(self, file, names=names, chosen=instances, scene=scene, title=title)


def fan(
    run: Any, names: Sequence[str], quantiles: Iterable[float], lines: int | None, over: Any,
    wrap: bool | Collection[str], ax: Any, axes: Any, file: File | None, style: Mapping[str, Any],
) -> Any:  # fmt: skip
    """Draw the distribution of a batch over time with matplotlib and return the Axes.

    run: the batch. The other arguments are those of `BatchRun.plot`.
    """
    no_files(names)
    source = Source(run, wrap)
    curves = [source.curve(name) for name in ([*names] or source.coordinates)]
    if ax is None and axes is None:
        panels = new_axes(len(curves))
    else:
        panels = check_axes(ax, axes, len(curves))
    for place, curve in zip(panels, curves, strict=True):
        if over is not None:
            _ends(place, curve, *_over(run, over), style)
        elif lines is not None:
            for k in np.unique(np.linspace(0, len(run) - 1, min(lines, len(run))).astype(int)):
                each = replace(curve, values=curve.values[k])
                against(place, source.t, [each], **{"linewidth": 0.6, "color": "C0", **style})
        else:
            _bands(place, source.t, curve, sorted(quantiles), style)
        if over is None:
            place.set_ylabel(with_unit(curve.text, curve.unit))
    if over is None:
        panels[-1].set_xlabel(with_unit(mathtext("t"), "s"))
    return finished(panels, file)


def _bands(axes: Any, t: Array, curve: Curve, quantiles: Sequence[float], style: Any) -> None:
    """Fill between pairs of quantiles and draw the median."""
    has_values = ~np.isnan(curve.values).all(axis=0)  # rows with values of some instance
    t, values = t[has_values], curve.values[:, has_values]
    bands = np.nanquantile(values, quantiles, axis=0)
    colour = style.get("color", "C0")
    pairs = len(quantiles) // 2
    for k in range(pairs):
        low, high = quantiles[k], quantiles[-1 - k]
        axes.fill_between(
            t, bands[k], bands[-1 - k], color=colour, alpha=0.15 + 0.35 * (k + 1) / (pairs + 1),
            linewidth=0, label=f"{100 * low:g} to {100 * high:g} %",
        )  # fmt: skip
    if len(quantiles) % 2:
        axes.plot(t, bands[pairs], **{"color": colour, "label": "median", **style})
    axes.legend()


def _over(run: Any, over: Any) -> tuple[str, Array]:
    """Return label and values (batch,) of the axis: instance, parameter or given numbers."""
    if isinstance(over, str) and over == "instance":
        return "instance", np.arange(len(run), dtype=float)
    if isinstance(over, str):
        names = run._model.parameters
        if over not in names:
            raise ValueError(not_one_of("over", over, ("instance", *names)))
        unit = run._model.units.get(over, "")
        values = np.broadcast_to(run._params[:, names.index(over)], (len(run),))
        return with_unit(mathtext(over), unit), values
    values = np.asarray(over, float)
    if values.shape != (len(run),):
        raise ValueError(f"over: shape {values.shape}, expected ({len(run)},)")
    return "", values


def _ends(axes: Any, curve: Curve, label: str, x: Array, style: Any) -> None:
    """Draw the last value of each instance over x."""
    good = np.isfinite(curve.values)
    last = curve.values.shape[1] - 1 - np.argmax(good[:, ::-1], axis=1)
    y = np.where(good.any(axis=1), curve.values[np.arange(len(last)), last], np.nan)
    axes.plot(x, y, **{"linestyle": "none", "marker": ".", **style})
    axes.set_xlabel(label)
    axes.set_ylabel(with_unit(f"{curve.text} at the end", curve.unit))
