"""One block of a sweep, as a worker computes it: simulate, reduce, write.

A worker needs the path of the store and the number of the block. It reads the plan from the store,
and builds the module of the scene's text once in a folder of this machine.
"""

from __future__ import annotations

import math
import os
import shlex
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from eomc.base.errors import EomcError
from eomc.sweeps.plan import (
    OVER_ROWS,
    Array,
    OutputFunction,
    Plan,
    Policy,
    SweepError,
    draw_values,
    inverse_cdf,
    random_uniforms,
)
from eomc.sweeps.store import Region, Store, open_store, part_name, part_of_block

# A call of simulate_batch takes so many instances, whose states then fit in the cache, and so many
# bytes of rows, and of noise, which is read once and should stay in the cache.
MAX_INSTANCES, MAX_ROW_BYTES, MAX_NOISE_BYTES = 4096, 1 << 25, 1 << 20
PROBE_INSTANCES, PROBE_SECONDS = 64, 0.1

_modules: dict[str, Any] = {}
_building = threading.Lock()


@dataclass(frozen=True)
class Task:
    """A block to compute.

    stamp: that of the store. client: host and process that started the sweep.
    """

    path: str
    stamp: str
    number: int
    threads: int
    client: tuple[str, int]
    function: OutputFunction | None
    policy: Policy | None


@dataclass(frozen=True)
class BlockReport:
    """A worker's report of a block: numbers of trajectories, and computing times in s.

    failures: number of failed trajectories by status.
    """

    trajectories: int
    failures: dict[str, int]
    seconds: float
    simulation_seconds: float


@dataclass(frozen=True)
class Probe:
    """Facts that the first trajectories of a sweep show.

    quantities: for each quantity the type and the shape of the values of one trajectory. rows:
    number of rows. seconds: computing time of one trajectory.
    """

    quantities: dict[str, tuple[str, tuple[int, ...]]] = field(default_factory=dict)
    rows: int = 2
    seconds: float = 0.0


def process_name() -> tuple[str, int]:
    """Return the names of this host and process."""
    return socket.gethostname(), os.getpid()


def load_module(name: str, text: str, bits: str = "native") -> Any:
    """Return the module of a scene's text, which is built once on this machine.

    It is built in a folder of $EOMC_CACHE, by default ~/.cache/eomc, whose name is the text's
    digest. bits: "portable" to compile without contraction. Raises SweepError if the module does
    not simulate batches.
    """
    import hashlib

    from eomc import pipeline
    from eomc.base.names import fault
    from eomc.base.resources import __version__
    from eomc.runtime.atomic_write import atomic_write

    data = text.encode("utf-8", errors="surrogateescape")
    digest = hashlib.sha256(data + f"{__version__} {bits}".encode()).hexdigest()
    with _building:
        if digest not in _modules:
            home = os.environ.get("EOMC_CACHE") or Path.home() / ".cache" / "eomc"
            folder = Path(home) / "sweeps" / digest[:16]
            file = folder / f"{'scene' if fault(name) else name}.toml"
            if not file.exists():
                folder.mkdir(parents=True, exist_ok=True)
                with atomic_write(file, cached=True) as new:
                    new.write_bytes(data)
            with _flags(bits):
                module = pipeline.load(file, folder)
            if "simulate_batch" not in dir(module):
                why = f"{name} simulates no batches: write batch = true under [run] of the scene"
                raise SweepError(("scene",), why)
            _modules[digest] = module
    return _modules[digest]


@contextmanager
def _flags(bits: str) -> Iterator[None]:
    """Add the flag of portable bits to those of the compiler while the block runs."""
    from eomc.toolchain.compiler import flags

    before = {name: x for name, x in os.environ.items() if name == "EOMC_CFLAGS"}
    try:
        if bits == "portable":
            os.environ["EOMC_CFLAGS"] = shlex.join([*flags(), "-ffp-contract=off"])
        yield
    finally:
        os.environ.pop("EOMC_CFLAGS", None)
        os.environ.update(before)


# --- simulation -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Instances:
    """Trajectories of a part of a sweep.

    values: those of each varied quantity, (batch,). indices: numbers (batch,) on which their noise
    depends.
    """

    values: Mapping[str, Array]
    indices: Array

    def take(self, which: Any) -> Instances:
        """Return some of the instances, by their numbers or a slice."""
        return Instances({name: x[which] for name, x in self.values.items()}, self.indices[which])


def instances_of_block(plan: Plan, region: Region) -> Instances:
    """Return the instances of a part of the sweep's shape.

    Draws and noise are the same at every point of the grid (common random numbers).
    """
    sizes = tuple(s.stop - s.start for s in region)
    values = {}
    for k, (name, axis) in enumerate(plan.over.items()):
        own = np.asarray(axis)[region[k]].reshape(-1, *(1,) * (len(sizes) - 1 - k))
        values[name] = np.broadcast_to(own, sizes).ravel()
    if not plan.draws:
        first = int(np.ravel_multi_index([s.start for s in region], plan.shape))
        return Instances(values, np.arange(first, first + math.prod(sizes)))
    start, stop = region[-1].start, region[-1].stop
    drawn = draw_values(plan.draws, (plan.sampler, plan.seed, plan.n), start, stop)
    values |= {name: np.broadcast_to(x, sizes).ravel() for name, x in drawn.items()}
    return Instances(values, np.broadcast_to(np.arange(start, stop), sizes).ravel())


def simulate(
    model: Any, plan: Plan, instances: Instances, threads: int, policy: Policy | None
) -> Any:
    """Simulate a batch of instances."""
    n = len(instances.indices)
    q0, qd0 = (np.tile(np.asarray(x, float), (n, 1)) for x in model.start)
    names, inputs = list(model.coordinates), dict[str, Any](plan.inputs)
    params: dict[str, Array] = {}
    for name, x in instances.values.items():
        if name in plan.starts:
            start = q0 if name in names else qd0
            start[:, names.index(name.removesuffix("_dot") if start is qd0 else name)] = x
        else:
            (inputs if name in model.inputs else params)[name] = x
    for name, distribution in plan.noise.items():
        noise = _noise(plan, name, distribution, instances.indices)
        inputs[name] = np.reshape(inputs.get(name, 0.0), (-1, 1)) + noise
    options = {**plan.run, "params": params or None, "threads": threads}
    if plan.every:
        options["every"] = plan.every
    with np.errstate(all="ignore"):
        u: Any = inputs or None
        if policy is not None:
            u = _inputs_of_policy(model, plan, (q0.copy(), qd0.copy()), inputs, options, policy)
        return model.simulate_batch(q0, qd0, u=u, **options)


def _noise(plan: Plan, name: str, distribution: Mapping[str, Any], indices: Array) -> Array:
    """Return the noise (batch, periods) of an input, by the indices of the instances."""
    first, last, periods = int(indices.min()), int(indices.max()) + 1, plan.periods
    u = random_uniforms(plan.seed, f"noise {name}", first * periods, last * periods)
    return np.asarray(inverse_cdf(distribution, u).reshape(-1, periods)[indices - first])


def _inputs_of_policy(
    model: Any, plan: Plan, state: tuple[Array, Array], noise: Mapping[str, Array],
    options: Mapping[str, Any], policy: Policy,
) -> Array:  # fmt: skip
    """Return the inputs (batch, periods, nu) of a rollout, by a step of each control period.

    state: initial positions and velocities, which are advanced. noise: that of inputs, (batch,
    periods), which is added to the inputs of the policy.
    """
    (q, qd), step = state, {k: options[k] for k in ("params", "threads", "method") if k in options}
    h, t = plan.run["h"], plan.run.get("t0", 0.0)
    count = round(plan.run["control_period"] / h)
    table = np.empty((len(q), plan.periods, model.nu))
    for k in range(plan.periods):
        u = np.asarray(policy(t + k * count * h, q.copy(), qd.copy()), float)
        if u.size != len(q) * model.nu or not np.isfinite(u).all():
            why = f"return finite numbers of shape {(len(q), model.nu)}, here {u.shape}"
            raise SweepError(("policy",), why)
        table[:, k] = u.reshape(len(q), -1)
        for name, values in noise.items():
            table[:, k, model.inputs.index(name)] += values[:, k]
        model.step_batch(q, qd, h, t + k * count * h, table[:, k].copy(), steps=count, **step)
    return table


def quantities_of(plan: Plan, function: OutputFunction | None, runs: Any) -> dict[str, Array]:
    """Return the stored and reduced quantities (batch, ...); those of failed instances are nan."""
    if function is not None:
        quantities = {str(k): np.asarray(x) for k, x in function(runs).items()}
    else:
        quantities = {}
        for name in (*plan.outputs, *plan.reduce):
            column, _, kind = name.partition(".")
            if column in runs.events:
                quantities[name] = _event_quantity(runs, column, kind, plan.starts)
                continue
            x = runs[column]
            if kind in OVER_ROWS:
                x = OVER_ROWS[kind](x, axis=1)
            elif kind == "end" or "times" not in plan.run:
                x = x[:, -1]
            quantities[name] = x
    failed = runs.status_codes != 0
    if failed.any():
        for name, x in quantities.items():
            if x.dtype.kind == "f":
                quantities[name] = np.where(failed.reshape(-1, *(1,) * (x.ndim - 1)), np.nan, x)
    return quantities


def _event_quantity(runs: Any, event: str, quantity: str, starts: list[str]) -> Array:
    """Return the number of occurrences of an event, or time or state at the first, (batch,)."""
    log = runs.events[event]
    if quantity == "count":
        return np.bincount(log.instance, minlength=len(runs))
    states = np.stack([log.q, log.qd], axis=2).reshape(len(log.t), -1)  # in the order of starts
    values = log.t if quantity == "time" else states[:, starts.index(quantity)]
    first = np.full(len(runs), np.nan)
    instances, rows = np.unique(log.instance, return_index=True)
    first[instances] = values[rows]
    return first


def probe(model: Any, plan: Plan, function: OutputFunction | None, policy: Policy | None) -> Probe:
    """Simulate the first trajectories of a sweep, to find every fault before a worker does.

    Raises SweepError if a quantity does not have a value for each trajectory.
    """
    region = [slice(0, 1)] * (len(plan.shape) - 1) + [slice(0, min(4, plan.shape[-1]))]
    instances = instances_of_block(plan, tuple(region))
    count = len(instances.indices)
    with warnings.catch_warnings():
        ignore_failures()
        started_at = time.perf_counter()
        runs = simulate(model, plan, instances, 1, policy)
        quantities = quantities_of(plan, function, runs)
        seconds = (time.perf_counter() - started_at) / count
        if seconds * count < PROBE_SECONDS:
            many = instances.take(np.arange(PROBE_INSTANCES) % count)
            started_at = time.perf_counter()
            quantities_of(plan, function, simulate(model, plan, many, 1, policy))
            seconds = (time.perf_counter() - started_at) / PROBE_INSTANCES
    for name, x in quantities.items():
        if not x.shape or len(x) != count or x.dtype.kind not in "fiub":
            why = f"{name}: give an array of numbers, a row for each of the {count} runs"
            raise SweepError(("outputs",), f"{why}, here of shape {x.shape} and type {x.dtype}")
    types = {name: (x.dtype.str, x.shape[1:]) for name, x in quantities.items()}
    return Probe(types, runs.q.shape[1], seconds)


def ignore_failures() -> None:
    """Ignore the warnings of batches with failed instances, which the sweep counts itself."""
    warnings.filterwarnings("ignore", ".*the first that could not go on", RuntimeWarning)


# --- a block --------------------------------------------------------------------------------------


def run_block(task: Task, cancelled: Callable[[], bool] = lambda: False) -> BlockReport | None:
    """Compute a block, write it to the store, and return a report; None if it was cancelled.

    cancelled: called before each call of simulate_batch; True ends the computation.
    """
    from eomc.toolchain.compiler import processor

    started_at = time.perf_counter()
    if task.client != process_name():
        ignore_failures()  # the client ignores them itself, and restores the filters at the end
    try:
        store = open_store(task.path, task.stamp)
        model = load_module(store.plan.name, store.plan.scene, store.plan.bits)
    except EomcError as fault:
        if task.client == process_name():
            raise
        raise EomcError(f"worker {':'.join(map(str, process_name()))}: {fault}") from None
    store.mark_processor(processor())
    plan = store.plan
    at, region = store.place(task.number)
    instances = instances_of_block(plan, region)
    total = math.prod(s.stop - s.start for s in region)
    status, collected = np.empty(total, np.uint8), dict[str, Array]()
    simulation_seconds = 0.0
    for part in _parts(model, store, total):
        if cancelled():
            return None
        before = time.perf_counter()
        runs = simulate(model, plan, instances.take(part), task.threads, task.policy)
        simulation_seconds += time.perf_counter() - before
        status[part] = runs.status_codes
        for name, x in quantities_of(plan, task.function, runs).items():
            if name not in collected:
                collected[name] = np.empty((total, *x.shape[1:]), x.dtype)
            collected[name][part] = x
    if plan.keep_draws:
        collected |= {plan.label(name): instances.values[name] for name in plan.draws}
    _write(store, at, region, collected, status)
    codes, counts = np.unique(status[status > 0], return_counts=True)
    failures = {model.STATUS[k]: int(n) for k, n in zip(codes, counts, strict=True)}
    seconds = time.perf_counter() - started_at
    return BlockReport(total, failures, seconds, simulation_seconds)


def _parts(model: Any, store: Store, total: int) -> Iterator[slice]:
    """Yield the slices of a block that are simulated in one call each."""
    row_bytes = 8 * store.facts["rows"] * (2 * model.nq + model.nu + 1)
    size = min(MAX_INSTANCES, MAX_ROW_BYTES // row_bytes)
    if store.plan.noise and not store.plan.policy:
        size = min(size, MAX_NOISE_BYTES // (8 * store.plan.periods))
    size = max(1, size)
    for start in range(0, total, size):
        yield slice(start, min(start + size, total))


def _write(
    store: Store, at: tuple[int, ...], region: Region, collected: Mapping[str, Array], status: Array
) -> None:
    """Write the quantities of a block and its parts of reductions; the status comes last."""
    plan, sizes = store.plan, tuple(s.stop - s.start for s in region)
    writes = []
    for name, x in collected.items():
        x = x.reshape(*sizes, *x.shape[1:])
        for kind, numbers in plan.reduce.get(name, ()):
            part = part_of_block(kind, numbers, x)[..., None, :]
            place = (*region[:-1], slice(at[-1], at[-1] + 1))
            writes.append((part_name(name, kind), place, part))
        if name not in plan.reduce:
            writes.append((name, region, x))
    store.write(writes)
    store.write([("status", region, status.reshape(sizes))])
