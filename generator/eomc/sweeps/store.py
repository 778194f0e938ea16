"""Store of a sweep: a Zarr group with the plan, whose arrays are cut into blocks.

A block is one chunk (or one shard) of every array, so that no two tasks write the same file, and
Zarr writes each file under a temporary name. A block is finished if its chunk of `status` exists,
which is written last. The fill value of `status` is NOT_RUN, since Zarr writes no chunk that is
equal to the fill value. `open_dataset` reads a store lazily.

The parts of reductions over draws that blocks store merge to the same bits in any order. Moments
are merged as a binary tree over leaves of LEAF trajectories, so a block of LEAF times a power of
two is a subtree. Histograms and the counts for quantiles are integers.

References
----------
Chan, Golub, LeVeque: Updating formulae and a pairwise algorithm for computing sample variances
(1979), for the merging of moments.
"""

from __future__ import annotations

import asyncio
import math
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from eomc.base import texts
from eomc.base.errors import EomcError, writing
from eomc.sweeps.plan import Array, Plan, SweepError

LEAF = 256  # trajectories
# Quantiles count values by sign, exponent and seven bits of the fraction: 0.4 % wide bins from
# 2**-64 to 2**64. Smaller values count as 0, larger ones as the largest bin.
FRACTION_SHIFT = 45
LOWEST_KEY = (1023 - 64) << 7
HALF_BINS = 128 << 7


def part_width(kind: str, numbers: Sequence[float]) -> int:
    """Return the number of values that a block stores of a reduction."""
    return {"mean": 3, "histogram": len(numbers) - 1, "quantile": 2 * HALF_BINS}[kind]


def part_of_block(kind: str, numbers: Sequence[float], x: Array) -> Array:
    """Return the part (..., width) of a reduction, for values (..., n) of a block's draws.

    Values that are not finite are left out.
    """
    if kind == "mean":
        return _moments(x)
    rows = np.ascontiguousarray(x, float).reshape(-1, x.shape[-1])
    if kind == "histogram":
        parts = [np.histogram(row[np.isfinite(row)], numbers)[0] for row in rows]
    else:
        parts = [np.bincount(_bins(row[np.isfinite(row)]), minlength=2 * HALF_BINS) for row in rows]
    return np.stack(parts).reshape(*x.shape[:-1], -1)


def merge(kind: str, numbers: Sequence[float], parts: Any) -> dict[str, Array]:
    """Merge the parts (..., blocks, width) of all blocks; return the results by their endings."""
    if kind == "mean":
        count, mean, squares = np.moveaxis(_merge_tree(np.moveaxis(parts[...], -2, 0)), -1, 0)
        deviation = np.sqrt(squares / np.where(count > 1, count - 1, np.nan))
        mean = np.where(count > 0, mean, np.nan)
        return {"count": count.astype(int), "mean": mean, "std": deviation}
    total = sum(parts[..., k, :] for k in range(parts.shape[-2]))
    return {kind: total if kind == "histogram" else _quantiles(total, numbers)}


# --- moments --------------------------------------------------------------------------------------


def _moments(x: Array) -> Array:
    """Return number, mean and sum of squared deviations (..., 3) of the finite values (..., n)."""
    missing = -x.shape[-1] % LEAF
    x = np.concatenate([x, np.full((*x.shape[:-1], missing), np.nan)], -1)
    # NumPy adds in another order along axes that are not contiguous
    x = np.ascontiguousarray(x, float).reshape(*x.shape[:-1], -1, LEAF)
    finite = np.isfinite(x)
    count = finite.sum(-1).astype(float)
    mean = np.where(finite, x, 0.0).sum(-1) / np.maximum(count, 1)
    deviations = np.where(finite, x - mean[..., None], 0.0)
    leaves = np.stack([count, mean, (deviations * deviations).sum(-1)], -1)
    return _merge_tree(np.moveaxis(leaves, -2, 0))


def _merge_tree(parts: Array) -> Array:
    """Merge neighbours (m, ..., 3) until one is left, (..., 3)."""
    while len(parts) > 1:
        if len(parts) % 2:
            parts = np.concatenate([parts, np.zeros((1, *parts.shape[1:]))])
        parts = _merge_pair(parts[0::2], parts[1::2])
    return np.asarray(parts[0])


def _merge_pair(a: Array, b: Array) -> Array:
    """Merge moments (..., 3) of two disjoint sets; an empty set changes no bit of the other."""
    n, mean, squares = np.moveaxis(a, -1, 0)
    m, other_mean, other_squares = np.moveaxis(b, -1, 0)
    total = n + m
    weight = m / np.maximum(total, 1)
    step = other_mean - mean
    merged = [total, mean + step * weight, squares + other_squares + step * step * n * weight]
    return np.stack(merged, -1)


# --- quantiles ------------------------------------------------------------------------------------


def _bins(x: Array) -> Array:
    """Return the index of the bin of each value; indices ascend with the values."""
    keys = (np.abs(x).view(np.int64) >> FRACTION_SHIFT) - LOWEST_KEY
    keys = np.clip(keys, 0, HALF_BINS - 1)
    return np.asarray(np.where(x < 0, HALF_BINS - 1 - keys, HALF_BINS + keys))


def _quantiles(counts: Array, probabilities: Sequence[float]) -> Array:
    """Return quantiles (..., probabilities) from counts (..., bins): the middle of the bin."""
    totals = np.cumsum(counts, -1)
    ranks = np.asarray(probabilities) * (totals[..., -1:] - 1)
    bins = np.stack([(totals <= rank[..., None]).sum(-1) for rank in np.moveaxis(ranks, -1, 0)], -1)
    keys = np.where(bins < HALF_BINS, HALF_BINS - 1 - bins, bins - HALF_BINS)
    lower = ((keys + LOWEST_KEY) << FRACTION_SHIFT).view(float)
    upper = ((keys + LOWEST_KEY + 1) << FRACTION_SHIFT).view(float)
    values = np.where(keys == 0, 0.0, (lower + upper) / 2) * np.where(bins < HALF_BINS, -1, 1)
    return np.where(totals[..., -1:] > 0, values, np.nan)


NOT_RUN = 255
MARK = "eomc_sweep"  # attribute of the group
# Array of flags, each a file: the one at a digest of the worker's processor is 1.
PROCESSORS = "processors"
INNER_CHUNK = 1 << 16  # trajectories that a reader gets at once from a larger block
Region = tuple[slice, ...]


@dataclass(frozen=True)
class ArrayLayout:
    """Shape of an array of a store, and how it is cut.

    dims: names of the dimensions. chunk: part of the shape that one block writes. is_sparse:
    whether most values are 0, so that compression pays.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    dtype: str
    fill: float
    is_sparse: bool = False

    @property
    def bytes(self) -> int:
        """Size of the array without compression."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


def choose_block_size(plan: Plan, seconds: float, threads: int, workers: int) -> int:
    """Return the number of trajectories of a block: two seconds of work, at least 8 a worker.

    seconds: computing time of one trajectory. The number is LEAF times a power of two; no result
    depends on it.
    """
    most = min(2.0 * threads / max(seconds, 1e-9), plan.size / (8 * workers), 1 << 20)
    return LEAF << max(0, int(math.log2(max(most / LEAF, 1))))


def cut_block(plan: Plan, size: int) -> tuple[int, ...]:
    """Return the shape of a block of at most about `size` trajectories.

    A block contains trailing axes as a whole, and a part of the axis before them. Along the draws
    its length is all of them if they are few, otherwise LEAF times a power of two.
    """
    shape = list(plan.shape)
    if plan.draws and shape[-1] > LEAF:
        shape[-1] = LEAF << math.ceil(math.log2(shape[-1] / LEAF))
        size = LEAF << max(0, int(math.log2(max(size / LEAF, 1))))
    return _cut(shape, size)


def _cut(shape: Sequence[int], size: int) -> tuple[int, ...]:
    """Return trailing axes of a shape as a whole, a part of the next, and 1 for the others."""
    part = list[int]()
    for n in reversed(shape):
        k = max(1, min(n, size))
        part.insert(0, k)
        size = size // k if k == n else 1
    return tuple(part)


def _inner_chunk(chunk: tuple[int, ...], dimensions: int) -> tuple[int, ...] | None:
    """Return the inner chunks of a shard, or None if they don't divide it or are all of it."""
    inner = _cut(chunk[:dimensions], INNER_CHUNK) + chunk[dimensions:]
    divides = all(n % k == 0 for n, k in zip(chunk, inner, strict=True))
    return inner if divides and inner != chunk else None


def lay_out(
    plan: Plan, block: tuple[int, ...], quantities: Mapping[str, tuple[str, tuple[int, ...]]]
) -> dict[str, ArrayLayout]:
    """Return the arrays of a store by name.

    block: shape of a block. quantities: for each quantity the type and the shape of the values of
    one trajectory. Raises SweepError for reductions that are not of one number.
    """
    dims, shape = plan.dims, plan.shape
    layouts = {
        "status": ArrayLayout(dims, shape, block, "uint8", NOT_RUN),
        PROCESSORS: ArrayLayout(("digest",), (1 << 16,), (1,), "uint8", 0),
    }
    if missing := [name for name in plan.reduce if name not in quantities]:
        there = ", ".join(quantities)
        raise SweepError(("reduce", missing[0]), f"the function returns no such name, but {there}")
    for name, (dtype, extra) in quantities.items():
        if name in plan.reduce:
            if extra:
                raise SweepError(("reduce", name), "has several numbers a trajectory: reduce one")
            blocks = -(-shape[-1] // block[-1])
            for kind, numbers in plan.reduce[name]:
                width = part_width(kind, numbers)
                layouts[part_name(name, kind)] = ArrayLayout(
                    (*dims[:-1], "block", f"{name}_{kind}_part"), (*shape[:-1], blocks, width),
                    (*block[:-1], 1, width), "float64" if kind == "mean" else "int64", 0,
                    kind == "quantile",
                )  # fmt: skip
            continue
        own = [f"{name}_{k}" for k in range(len(extra))]
        if extra and "." not in name and not plan.function:
            own = ["t"]
        fill = np.nan if np.dtype(dtype).kind == "f" else 0
        layouts[name] = ArrayLayout((*dims, *own), (*shape, *extra), (*block, *extra), dtype, fill)
    for name in plan.draws if plan.keep_draws else ():
        layouts[plan.label(name)] = ArrayLayout(dims, shape, block, "float64", np.nan)
    return layouts


def part_name(name: str, kind: str) -> str:
    """Return the name of the array with the blocks' parts of a reduction."""
    return f"{name}_{kind}_parts"


@contextmanager
def hold_store(path: Path) -> Iterator[None]:
    """Lock a store while the block runs. Raises EomcError if another sweep has locked it.

    The lock file is in the parent folder, since Zarr warns of other files in the store. The lock
    ends with the process.
    """
    from eomc.toolchain.cache import hold_lock

    refusal = "another sweep writes here: wait for it, or give another store"
    with hold_lock(path.with_name(f"{path.name}.lock"), f"{texts.line(str(path))}: {refusal}"):
        yield


def read_plan(path: Path) -> Plan | None:
    """Return the plan of a store; None if the folder is missing or empty.

    Raises EomcError if the folder contains something else.
    """
    import zarr

    shown = texts.line(str(path))
    if path.is_file():
        raise EomcError(f"{shown}: is a file: give a folder")
    if not path.is_dir() or not any(path.iterdir()):
        return None
    try:
        attributes = zarr.open_group(str(path), mode="r").attrs
        if MARK in attributes:
            return Plan(**attributes[MARK])
    except TypeError:
        raise EomcError(f"{shown}: is a store of another version of eomc: give another") from None
    except (FileNotFoundError, KeyError, ValueError):
        pass
    raise EomcError(f"{shown}: is no store of a sweep, and not empty: give another folder")


def create_store(
    path: Path, plan: Plan, layouts: Mapping[str, ArrayLayout], facts: Mapping[str, Any]
) -> None:
    """Create the store of a sweep, unless another process does so at the same time.

    The store is created under a temporary name. facts: further attributes of the group, among them
    "block", the shape of a block.
    """
    import zarr
    from zarr.codecs import ZstdCodec

    new = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        group = zarr.create_group(str(new), zarr_format=3)
        coordinates = {plan.label(name): values for name, values in plan.over.items()}
        if "times" in plan.run:
            coordinates["t"] = plan.run["times"]
        for name, values in coordinates.items():
            group.create_array(name, data=np.asarray(values), dimension_names=[name])
        for name, layout in layouts.items():
            inner = _inner_chunk(layout.chunk, min(len(plan.shape), len(layout.shape)))
            group.create_array(
                name, shape=layout.shape, chunks=inner or layout.chunk,
                shards=layout.chunk if inner else None, dtype=layout.dtype, fill_value=layout.fill,
                dimension_names=layout.dims, compressors=ZstdCodec() if layout.is_sparse else None,
            )  # fmt: skip
        group.attrs.put({**facts, MARK: asdict(plan)})
        with suppress(OSError):  # the other process has been quicker
            new.rename(path)
    finally:
        shutil.rmtree(new, ignore_errors=True)


class Store:
    """An existing store of a sweep.

    Attributes
    ----------
    path, plan
        Folder and plan of the sweep.
    facts : dict
        Other attributes of the group.
    block, counts : tuple of int
        Shape of a block, and numbers of blocks along each dimension.
    """

    def __init__(self, path: Path) -> None:
        import zarr

        self.path = path
        self.group = zarr.open_group(str(path), mode="r+")
        self.facts: dict[str, Any] = dict(self.group.attrs)
        self.plan = Plan(**self.facts.pop(MARK))
        self.block = tuple(self.facts["block"])
        self.counts = tuple(-(-n // k) for n, k in zip(self.plan.shape, self.block, strict=True))
        self.arrays = {name: array.async_array for name, array in self.group.arrays()}

    @property
    def stamp(self) -> str:
        """Text that changes with the plan and the blocks of the store."""
        return f"{self.plan.digest} {self.block}"

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return math.prod(self.counts)

    def place(self, number: int) -> tuple[tuple[int, ...], Region]:
        """Return the position of a block among the blocks, and its slices of the shape."""
        at = tuple(int(k) for k in np.unravel_index(number, self.counts))
        cut = zip(at, self.block, self.plan.shape, strict=True)
        return at, tuple(slice(k * size, min((k + 1) * size, n)) for k, size, n in cut)

    def finished(self) -> Array:
        """Return whether each block is finished, (blocks,): one listing of names of files."""
        there = np.zeros(self.counts, bool)
        root = self.path / "status" / "c"
        for folder, _, files in os.walk(root):
            parts = Path(folder).relative_to(root).parts
            for file in files if len(parts) == len(self.counts) - 1 else ():
                if file.isdigit():  # files that are being written end in .partial
                    there[tuple(map(int, (*parts, file)))] = True
        return there.ravel()

    def write(self, values: Sequence[tuple[str, Region, Array]]) -> None:
        """Write parts of arrays at once, which takes half of the time of one after the other."""

        async def write_all() -> None:
            writes = (self.arrays[name].setitem(region, x) for name, region, x in values)
            await asyncio.gather(*writes)

        asyncio.run(write_all())

    def mark_processor(self, processor: str) -> None:
        """Note in the store that a processor has computed a block."""
        k = zlib.crc32(processor.encode()) % (1 << 16)
        if not (self.path / PROCESSORS / "c" / str(k)).exists():
            self.write([(PROCESSORS, (slice(k, k + 1),), np.ones(1, np.uint8))])

    def count_processors(self) -> int:
        """Return the number of kinds of processors that have computed blocks."""
        return sum(file.name.isdigit() for file in (self.path / PROCESSORS / "c").glob("*"))

    def grow(self, plan: Plan) -> None:
        """Make room for more draws; the blocks at the previous end are computed again.

        Raises EomcError if there are so few draws that a block does not end at a leaf.
        """
        if self.block[-1] % LEAF:
            shown, n = texts.line(str(self.path)), self.plan.n
            raise EomcError(f"{shown}: a store of {n} draws can't grow: give another store")
        if self.plan.n % self.block[-1]:
            for file in (self.path / "status" / "c").rglob(str(self.counts[-1] - 1)):
                if file.is_file():
                    file.unlink()
        axis, blocks = len(plan.shape) - 1, -(-plan.n // self.block[-1])
        for _, array in self.group.arrays():
            shape = list(array.shape)
            if len(shape) > axis and array.metadata.dimension_names[axis] in ("draw", "block"):
                is_part = array.metadata.dimension_names[axis] == "block"
                shape[axis] = blocks if is_part else plan.n
                array.resize(tuple(shape))
        self.group.attrs[MARK] = asdict(plan)

    def remove_partial_files(self) -> None:
        """Remove the incomplete files that killed workers have left."""
        for file in self.path.rglob("*.partial"):
            file.unlink(missing_ok=True)


@lru_cache(maxsize=8)
def open_store(path: str, stamp: str) -> Store:
    """Return a store, which is opened once in a process: metadata take 0.7 ms an array.

    stamp: that of the store, so that a changed store is opened again.
    """
    store = Store(Path(path))
    if store.stamp != stamp:
        raise SweepError((), f"{texts.line(path)}: was replaced while the sweep ran")
    return store


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
