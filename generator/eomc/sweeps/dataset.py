"""Dataset of a store: what is stored, read lazily, and the merged reductions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.sweeps.reductions import merge
from eomc.sweeps.store import PROCESSORS, Store, part_name


def open_dataset(path: Path) -> Any:
    """Return the `xarray.Dataset` of a store."""
    import xarray

    store = Store(path)
    plan = store.plan
    dataset = xarray.open_zarr(str(path), consolidated=False, mask_and_scale=False, chunks=None)
    dataset = dataset.drop_vars(PROCESSORS)
    dataset.attrs = {"scene": plan.name, "seed": plan.seed, "sampler": plan.sampler}
    outer = plan.dims[:-1]
    for name, reductions in plan.reduce.items():
        for kind, numbers in reductions:
            parts = part_name(name, kind)
            dataset = dataset.drop_vars(parts)
            for ending, values in merge(kind, numbers, store.group[parts]).items():
                dims, coordinates = outer, {}
                if kind == "histogram":
                    middle = (np.asarray(numbers[1:]) + numbers[:-1]) / 2
                    dims, coordinates = (*outer, f"{name}_bin"), {f"{name}_bin": middle}
                elif kind == "quantile":
                    dims = (*outer, f"{name}_probability")
                    coordinates = {f"{name}_probability": numbers}
                dataset = dataset.assign_coords(coordinates)
                dataset[f"{name}_{ending}"] = (dims, values)
    return dataset


def write_parquet(path: Path, folder: Path) -> None:
    """Write the stored quantities of each finished block to a Parquet file.

    A file has a row for each trajectory, with its axes and values. Raises EomcError if the packages
    for that are missing, or a file can't be written.
    """
    store = Store(path)
    if store.plan.reduce:
        raise EomcError("Parquet files have a row for each trajectory: leave out the reductions")
    with writing(texts.line(str(folder))):
        dataset = open_dataset(path)
        folder.mkdir(parents=True, exist_ok=True)
        for number in np.flatnonzero(store.finished()):
            region = dict(zip(store.plan.dims, store.place(int(number))[1], strict=True))
            rows = dataset.isel(region).to_dataframe().reset_index()
            if store.plan.draws:
                rows["draw"] += region["draw"].start
            try:
                rows.to_parquet(folder / f"block-{number:06d}.parquet", index=False)
            except ImportError:
                raise EomcError("Parquet files need pyarrow: pip install pyarrow") from None


def draw_plot(path: Path, file: Path) -> None:
    """Plot the first quantity of a store: a curve, a map, or a histogram, according to the shape.

    Of the results of a function, the first in alphabetical order is drawn.

    One axis gives a curve, or points if the quantity has several values; two axes give a map. Draws
    without an axis give a histogram with quantiles, and with axes their mean. Raises EomcError for
    more axes, and without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise EomcError("drawing needs matplotlib: pip install matplotlib") from None
    store, dataset = Store(path), open_dataset(path)
    plan, finished = store.plan, int(store.finished().sum())
    endings = [f"{name}_{kind}" for name, kinds in plan.reduce.items() for kind, _ in kinds]
    varied = {"status", *map(plan.label, plan.draws)}
    names = [*plan.outputs, *endings, *sorted({*dataset.data_vars} - varied), "status"]
    name = next(name for name in names if name in dataset)
    values = dataset[name].squeeze()
    axes = [dim for dim in plan.dims[: len(plan.over)] if dim in values.dims]
    if len(axes) > 2:
        raise EomcError(f"a plot has at most two axes, and this sweep has {', '.join(axes)}")
    ax = (figure := Figure(layout="constrained")).subplots()
    if "draw" in values.dims and axes:
        values = values.mean("draw")
    if len(axes) == 2:
        values = values.isel({d: -1 for d in values.dims if d not in axes})
        image = ax.pcolormesh(*(dataset[x] for x in axes), values.transpose(*axes[::-1]))
        figure.colorbar(image, label=name)
        ax.set(xlabel=axes[0], ylabel=axes[1])
    elif axes:
        y = values.transpose(axes[0], ...).values.reshape(len(dataset[axes[0]]), -1)
        ax.plot(dataset[axes[0]], y, *(["k,"] if y.shape[1] > 1 else []))
        ax.set(xlabel=axes[0], ylabel=name)
    else:
        _draw_histogram(ax, values, name)
    if finished < store.blocks:
        ax.set_title(f"{finished} of {store.blocks} blocks")
    with writing(texts.line(str(file))):
        figure.savefig(file)


def _draw_histogram(ax: Any, values: Any, name: str) -> None:
    """Draw a histogram of values, or the stored one, with the quantiles of 5, 50 and 95 %."""
    if name.endswith("_histogram"):
        (dimension,) = values.dims
        ax.step(values[dimension], values, where="mid")
        name = name.removesuffix("_histogram")
    else:
        x = values.values[np.isfinite(values.values)]
        ax.hist(x, bins=100)
        for probability in (0.05, 0.5, 0.95) if len(x) else ():
            ax.axvline(np.quantile(x, probability), color="k", linewidth=0.8)
    ax.set(xlabel=name, ylabel="trajectories")
