"""Plan of a sweep: the checked arguments of `eomc.sweep` or of a file of a sweep, as plain data.

It contains axes of grids and distributions of draws, which give the values of each trajectory by
its index. A drawn value depends on the seed, the name of the quantity and the index alone. With the
sampler "random" it does not depend on the other draws, nor on the number of trajectories; with
"sobol" it depends on the number of drawn quantities, with "latin" on the number of trajectories as
well.

References
----------
Salmon, Moraes, Dror, Shaw: Parallel random numbers: as easy as 1, 2, 3 (SC 2011), for Philox.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.base import texts
from eomc.base.errors import EomcError, SceneError
from eomc.base.resources import __version__
from eomc.runtime.package import model_of
from eomc.runtime.requests import count_input_periods
from eomc.scene.formulas import suggest
from eomc.scene.toml_text import SourceMap, text_and_tree

Array = NDArray[Any]

SAMPLERS = ("random", "sobol", "latin")
# the numbers of each distribution, in their order
DISTRIBUTIONS = {
    "uniform": ("low", "high"),
    "normal": ("mean", "deviation"),
    "log_uniform": ("low", "high"),
    "truncated_normal": ("mean", "deviation", "low", "high"),
}


class SweepError(EomcError):
    """Error for an argument of a sweep that the user can correct.

    path: the keys that lead to the argument in the file of a sweep, such as ("over", "theta"). The
    message begins with the last of them.
    """

    def __init__(self, path: tuple[str, ...], message: str) -> None:
        super().__init__(f"{path[-1]}: {message}" if path else message)
        self.path, self.message = path, message

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.message)


def check_name(path: tuple[str, ...], name: Any, known: Collection[str], what: str) -> None:
    """Raise SweepError, with a suggestion, unless `name` is one of the known names."""
    if name not in known:
        near = suggest(str(name), known) or f"; there are {', '.join(known) or 'none'}"
        raise SweepError(path, f"{what}{near}")


# --- grids ----------------------------------------------------------------------------------------


def read_axis(path: tuple[str, ...], value: Any) -> list[float]:
    """Return the values of an axis from a list, an array or a table {from, to, n, scale}.

    path: keys of the axis, for messages. Raises SweepError if the values are not finite numbers.
    """
    example = "give a list of numbers, or { from = 0, to = 1, n = 11 }"
    if isinstance(value, Mapping):
        table = dict(value)
        spacings: dict[str, Any] = {"linear": np.linspace, "log": np.geomspace}
        spacing = spacings.get(table.pop("scale", "linear"))
        if spacing is None:
            raise SweepError(path, f'scale: give "linear" or "log", here {value["scale"]!r}')
        for key in table:
            check_name(path, key, ("from", "to", "n", "scale"), f"no key {key!r} of an axis")
        for key in ("from", "to", "n"):
            if not _is_number(table.get(key)):
                fault = f"is no finite number: {table[key]!r}" if key in table else "is missing"
                raise SweepError(path, f"{key} {fault}; {example}")
        low, high, n = table["from"], table["to"], table["n"]
        if not isinstance(n, int) or n < 1:
            raise SweepError(path, f"n: give the number of values, 1 or more, here {n!r}")
        if spacing is np.geomspace and not (low > 0 and high > 0):
            raise SweepError(path, f"a logarithmic scale needs positive limits, here {low}, {high}")
        if n > 1 and low == high:
            raise SweepError(path, f"from and to are both {low}, with n = {n}: give n = 1")
        value = spacing(low, high, n)
    try:
        values = np.asarray(value, float)
    except (TypeError, ValueError):
        raise SweepError(path, f"{example}, here {value!r}") from None
    if values.ndim != 1 or not values.size or not np.isfinite(values).all():
        raise SweepError(path, f"{example}, here {value!r}")
    return [float(x) for x in values]


def _is_number(value: object) -> bool:
    kinds = (int, float, np.integer, np.floating)
    return isinstance(value, kinds) and not isinstance(value, bool) and math.isfinite(value)


# --- distributions --------------------------------------------------------------------------------


def read_distribution(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """Return a distribution as a dict of JSON: {kind: numbers} or {"scipy": [name, args, kwds]}.

    value: such a dict, for example {"normal": [2.0, 0.1]}, or a frozen distribution of scipy.stats.
    path: keys of the draw, for messages. Raises SweepError if it is neither.
    """
    if hasattr(value, "ppf") and hasattr(value, "dist"):
        return _read_frozen(path, value)
    if not (isinstance(value, Mapping) and len(value) == 1):
        example = "give a distribution, such as { normal = [2, 0.1] }"
        raise SweepError(path, f"{example}, not {value!r}")
    ((kind, numbers),) = value.items()
    check_name(path, kind, DISTRIBUTIONS, f"no distribution {kind!r}")
    names = DISTRIBUTIONS[kind]
    values = [*numbers] if isinstance(numbers, (list, tuple, np.ndarray)) else []
    if len(values) != len(names) or not all(map(_is_number, values)):
        raise SweepError(path, f"{kind} has the numbers [{', '.join(names)}], here {numbers!r}")
    by_name = dict(zip(names, map(float, values), strict=True))
    low, high = by_name.get("low", 1.0), by_name.get("high", np.inf)
    if by_name.get("deviation", 1.0) <= 0 or low >= high or (kind == "log_uniform" and low <= 0):
        why = "a deviation is positive, low is less than high, and in log_uniform positive"
        raise SweepError(path, f"{kind}: {why}, here {numbers!r}")
    return {kind: [*by_name.values()]}


def _read_frozen(path: tuple[str, ...], frozen: Any) -> dict[str, Any]:
    """Return a frozen distribution of scipy.stats as a dict of JSON."""
    from scipy import stats

    name, args, kwds = frozen.dist.name, frozen.args, frozen.kwds
    if type(getattr(stats, name, None)) is not type(frozen.dist):
        raise SweepError(path, f"{name} is no distribution of scipy.stats: workers don't have it")
    try:
        return {"scipy": [name, [*map(float, args)], {k: float(kwds[k]) for k in sorted(kwds)}]}
    except (TypeError, ValueError):
        raise SweepError(path, f"{name}: give numbers as its arguments, no arrays") from None


def inverse_cdf(distribution: Mapping[str, Any], u: Array) -> Array:
    """Return the values of a distribution at which its cumulative distribution function is u.

    distribution: as returned by `read_distribution`. u: numbers in (0, 1).
    """
    from scipy.special import ndtr, ndtri

    ((kind, numbers),) = distribution.items()
    if kind == "scipy":
        from scipy import stats

        name, args, kwds = numbers
        return np.asarray(getattr(stats, name)(*args, **kwds).ppf(u), float)
    if kind == "uniform":
        low, high = numbers
        return np.asarray(low + (high - low) * u)
    if kind == "log_uniform":
        low, high = map(math.log, numbers)
        return np.asarray(np.exp(low + (high - low) * u))
    mean, deviation, *limits = numbers
    if not limits:
        return np.asarray(mean + deviation * ndtri(u))
    low, high = ((limit - mean) / deviation for limit in limits)
    if low > 0:  # in the upper tail, 1 - cdf has more digits than cdf
        z = -ndtri(ndtr(-low) + u * (ndtr(-high) - ndtr(-low)))
    else:
        z = ndtri(ndtr(low) + u * (ndtr(high) - ndtr(low)))
    return np.asarray(np.clip(mean + deviation * z, *limits))


# --- numbers in (0, 1) by index -------------------------------------------------------------------


def random_uniforms(seed: int, name: str, start: int, stop: int) -> Array:
    """Return random numbers in (0, 1) of the indices start to stop: Philox with counter = index."""
    first = start // 4  # a count of Philox gives four numbers
    counts = -(-stop // 4) - first
    bits = np.random.Philox(key=_key(seed, name), counter=[first, 0, 0, 0]).random_raw(4 * counts)
    offset = start - 4 * first
    return ((bits >> np.uint64(12)).astype(float)[offset : offset + stop - start] + 0.5) * 2.0**-52


def _key(seed: int, name: str) -> Array:
    digest = hashlib.sha256(f"{seed} {name}".encode()).digest()
    return np.frombuffer(digest[:16], dtype="<u8").astype(np.uint64)


class _SobolSequence(threading.local):
    """Scrambled Sobol sequence of one seed; each thread has a generator, which has a position."""

    def __init__(self, seed: int, dimensions: int) -> None:
        from scipy.stats import qmc

        # of more than 30 bits, SciPy 1.17 can't skip points
        self.generator, self.position = qmc.Sobol(dimensions, scramble=True, rng=seed), 0

    def points(self, start: int, stop: int) -> Array:
        """Return the points start to stop, (stop - start, dimensions). Skipping takes 4 ns each."""
        if start < self.position:
            self.generator.reset()
            self.position = 0
        if start > self.position:
            self.generator.fast_forward(start - self.position)
        # SciPy warns if the first number of points is not a power of two
        count = stop - start if start else 1 << (stop - 1).bit_length()
        self.position = start + count
        points = self.generator.random(count)[: stop - start]
        return np.asarray(np.clip(points, 2.0**-53, 1 - 2.0**-53))


_sobol_sequence = lru_cache(maxsize=8)(_SobolSequence)


@lru_cache(maxsize=16)
def _latin_strata(seed: int, name: str, n: int) -> Array:
    """Return the stratum of each of n trajectories, a random permutation."""
    generator = np.random.Generator(np.random.Philox(key=_key(seed, f"{name} strata")))
    return generator.permutation(n)


def draw_values(
    draws: Mapping[str, Mapping[str, Any]], sampling: tuple[str, int, int], start: int, stop: int
) -> dict[str, Array]:
    """Return the values (stop - start,) of each draw for the indices start to stop.

    draws: distributions by name. sampling: the sampler, the seed and the number n of draws.
    """
    sampler, seed, n = sampling
    values = {}
    if sampler == "sobol" and draws:
        points = _sobol_sequence(seed, len(draws)).points(start, stop)
    for k, (name, distribution) in enumerate(draws.items()):
        if sampler == "sobol":
            u = points[:, k]
        else:
            u = random_uniforms(seed, name, start, stop)
            if sampler == "latin":
                u = (_latin_strata(seed, name, n)[start:stop] + u) / n
        values[name] = inverse_cdf(distribution, u)
    return values


# arguments of simulate_batch that a sweep passes on
RUN_OPTIONS = (
    "control_period", "duration", "every", "h", "max_evaluations", "max_step", "method", "steps",
    "stiff", "t0", "times", "tol",
)  # fmt: skip
FILE_KEYS = (
    "bits", "draws", "eomc_sweep", "inputs", "keep", "keep_draws", "noise", "over", "reduce", "run",
    "scene", "seed",
)  # fmt: skip
# functions over the rows of a trajectory, which leave out the rows after its end
OVER_ROWS = {"max": np.fmax.reduce, "min": np.fmin.reduce}
ONLY_ENDS = 10**9  # steps between two rows, of which then the first and the last remain


# receives a BatchTrajectory, and returns a dict of arrays (batch, ...)
OutputFunction = Callable[[Any], Mapping[str, Any]]
# receives t, q and qd (batch, nq), and returns the inputs (batch, nu)
Policy = Callable[[float, Any, Any], Any]


@dataclass(frozen=True)
class SweepArguments:
    """Arguments of `eomc.sweep` that determine its results; they are described there."""

    scene: Any
    over: Mapping[str, Any] = field(default_factory=dict)
    draws: Mapping[str, Any] = field(default_factory=dict)
    n: int | None = None
    sampler: str = "random"
    seed: int = 0
    inputs: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, Any] = field(default_factory=dict)
    policy: Policy | None = None
    outputs: Any = None
    reduce: Mapping[str, Any] = field(default_factory=dict)
    keep_draws: bool | None = None
    bits: str = "native"
    run: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plan:
    """Everything that determines the results of a sweep, as numbers, texts, lists and dicts.

    Attributes
    ----------
    name, scene : str
        Name and text of the scene.
    over, draws : dict
        Values of each axis of the grid, and distribution of each drawn quantity, by name.
    n : int
        Number of draws at each point of the grid; 0 without draws.
    noise : dict
        Distribution of the noise of each noisy input.
    periods : int
        Number of control periods, each with its own noise or call of the policy; 0 without them.
    outputs : list of str
        Stored quantities; empty if a function computes them.
    function, policy : str
        Digest of the source text of the function that computes the quantities, and of the policy;
        "" if there is none.
    reduce : dict
        For each reduced quantity a list of [kind, numbers].
    every : int
        Number of steps between two rows; 0 if rows are at times or at adaptive steps.
    versions : dict of str
        Versions of the packages on which the values of draws depend.
    """

    name: str
    scene: str
    over: dict[str, list[float]]
    draws: dict[str, dict[str, Any]]
    n: int
    sampler: str
    seed: int
    inputs: dict[str, float]
    noise: dict[str, dict[str, Any]]
    policy: str
    periods: int
    outputs: list[str]
    function: str
    reduce: dict[str, list[list[Any]]]
    keep_draws: bool
    bits: str
    run: dict[str, Any]
    every: int
    starts: list[str]
    versions: dict[str, str]

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of trajectories along each dimension."""
        draws = (self.n,) if self.draws else ()
        return (*(len(values) for values in self.over.values()), *draws)

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions."""
        return (*map(self.label, self.over), *(("draw",) if self.draws else ()))

    @property
    def size(self) -> int:
        """Number of trajectories."""
        return math.prod(self.shape)

    def label(self, name: str) -> str:
        """Return the name of a varied quantity in the Dataset.

        Initial values get "_start", since the plain name is that of the final value.
        """
        return f"{name}_start" if name in self.starts else name

    @cached_property
    def digest(self) -> str:
        """The SHA-256 of the plan."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()

    def can_grow_to(self, other: Plan) -> bool:
        """Return True if another plan is the same but for a larger number of draws."""
        is_longer = other.n > self.n and self.sampler != "latin"
        return is_longer and replace(self, n=other.n) == other

    def differences(self, other: Plan) -> Iterator[str]:
        """Yield a line for each difference from another plan, such as "seed: 0 there, 1 now"."""
        old, new = _flatten(asdict(self)), _flatten(asdict(other))
        for key in sorted({*old, *new}):
            if old.get(key) != new.get(key):
                if key in ("scene", "function", "policy"):
                    yield f"{key}: another text there"
                else:
                    yield f"{key}: {_shorten(old.get(key))} there, {_shorten(new.get(key))} now"


def _flatten(tree: dict[str, Any]) -> dict[str, Any]:
    """Return a dict of dicts as one dict; keys of `run` stand alone, others as "draws.m"."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat.update({k if key == "run" else f"{key}.{k}": v for k, v in value.items()})
        else:
            flat[key] = value
    return flat


def _shorten(value: Any) -> str:
    if isinstance(value, list) and len(value) > 3:
        first, second, *_, last = map(json.dumps, value)
        return f"[{first}, {second}, ..., {last}] ({len(value)} values)"
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) < 60 else f"{text[:57]}..."


# --- arguments ------------------------------------------------------------------------------------


def read_scene(scene: Any) -> tuple[str, str]:
    """Return the name (of the file or of the model) and the text of a scene.

    scene: path of a scene, or a module of `eomc.load` from one. Raises SweepError if there is no
    such text.
    """
    model = model_of(scene)
    source = scene if model is None else model.source
    if not isinstance(source, (str, Path)):
        what = "a System" if model is None else "a module that was not loaded from a scene"
        why = f"{what} has no text to send to workers: write it as a scene, and give its path"
        raise SweepError(("scene",), why)
    try:
        data = Path(source).read_bytes()
    except OSError as fault:
        why = f"{texts.line(str(source))} can't be read ({fault.strerror})"
        raise SweepError(("scene",), why) from None
    if model is not None and hashlib.sha256(data).hexdigest() != model.info.digest:
        raise SweepError(("scene",), f"{source} has changed since it was loaded: load it again")
    return Path(source).stem, data.decode("utf-8-sig", errors="surrogateescape")


def make_plan(arguments: SweepArguments, model: Any, scene: tuple[str, str]) -> Plan:
    """Check the arguments of a sweep, and return them as a plan.

    model: module of the scene. scene: its name and text. Raises SweepError for a wrong argument.
    """
    import scipy

    a, starts = arguments, [x for c in model.coordinates for x in (c, f"{c}_dot")]
    known = [*starts, *model.parameters, *model.inputs]
    for table in ("over", "draws", "inputs", "noise", "reduce"):
        if not isinstance(x := getattr(a, table), Mapping):
            raise SweepError((table,), f"give a dict of names and values, here {x!r}")
    for table in ("over", "draws"):
        for name in getattr(a, table):
            what = f"no coordinate, rate, parameter or input of {scene[0]}"
            check_name((table, name), name, known, what)
    if both := sorted({*a.over} & {*a.draws}):
        raise SweepError(("draws", both[0]), "is in over as well: give it once")
    if not a.over and not a.draws:
        raise SweepError(("over",), "nothing varies: give over or draws (--over, --draw)")
    for table in ("inputs", "noise"):
        for name in getattr(a, table):
            check_name((table, name), name, model.inputs, f"no input of {scene[0]}")
    check_name(("bits",), a.bits, ("native", "portable"), f"no kind {a.bits!r}")
    run, noise = _read_run(a.run), {}
    for name, x in a.noise.items():
        noise[name] = read_distribution(("noise", name), x)
    outputs = _read_outputs(a, starts)
    reduce = {name: _read_reductions(("reduce", name), x) for name, x in a.reduce.items()}
    if reduce and not a.draws:
        raise SweepError(("reduce",), "reductions are over draws: give draws and n")
    for table, names in (("keep", outputs), ("reduce", reduce)):
        for name in () if callable(a.outputs) else names:
            path = (table, name) if table == "reduce" else (table,)
            _check_quantity(path, name, model_of(model).info, starts)
    trial, periods = _try_run(a, model, run)
    every = _choose_rows(a, trial, run.pop("every", None), [*outputs, *reduce])
    return Plan(
        name=scene[0], scene=scene[1],
        over={name: read_axis(("over", name), x) for name, x in a.over.items()},
        draws={name: read_distribution(("draws", name), x) for name, x in a.draws.items()},
        n=_read_count(a), sampler=a.sampler, seed=_read_integer("seed", a.seed),
        inputs={name: float(x) for name, x in a.inputs.items()}, noise=noise,
        policy="" if a.policy is None else _source_digest("policy", a.policy), outputs=outputs,
        function=_source_digest("outputs", a.outputs) if callable(a.outputs) else "",
        reduce=reduce, keep_draws=not reduce if a.keep_draws is None else bool(a.keep_draws),
        bits=a.bits, run=run, every=every, periods=periods, starts=starts,
        versions={"eomc": __version__, "numpy": np.__version__, "scipy": scipy.__version__},
    )  # fmt: skip


def _read_integer(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise SweepError((name,), f"give an integer, 0 or more, here {value!r}")
    return int(value)


def _read_count(a: SweepArguments) -> int:
    """Return the number of draws, 0 without draws."""
    check_name(("draws", "sampler"), a.sampler, SAMPLERS, f"no sampler {a.sampler!r}")
    if not a.draws:
        if a.n is not None:
            raise SweepError(("draws", "n"), "the number of draws goes with draws: give them")
        return 0
    if a.n is None or (n := _read_integer("n", a.n)) < 1:
        raise SweepError(("draws", "n"), "how many draws? such as n=100_000")
    if a.sampler == "latin" and n > 10**7:
        why = 'a Latin hypercube of more than 10**7 points: take "sobol"'
        raise SweepError(("draws", "sampler"), why)
    if a.sampler == "sobol" and n > 2**30:
        raise SweepError(("draws", "sampler"), 'Sobol sequences end at 2**30: take "random"')
    return n


def _read_run(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a run as plain numbers, texts and lists."""
    run = {}
    for name, value in options.items():
        if name == "keep":
            raise SweepError(("keep",), "in Python the stored quantities are given by outputs=")
        check_name(("run", name), name, RUN_OPTIONS, "no option of a run")
        if name == "times":
            value = read_axis(("run", "times"), value)
        if value is not None:
            run[name] = value.item() if isinstance(value, np.generic) else value
    return run


def _read_outputs(a: SweepArguments, starts: list[str]) -> list[str]:
    """Return the names of stored quantities."""
    if callable(a.outputs):
        return []
    if a.outputs is None:
        return [] if a.reduce else starts
    if isinstance(a.outputs, str) or not all(isinstance(x, str) for x in a.outputs):
        raise SweepError(("keep",), f"give a list of names or a function, here {a.outputs!r}")
    return [name for name in dict.fromkeys(a.outputs) if name not in a.reduce]


def _read_reductions(path: tuple[str, ...], value: Any) -> list[list[Any]]:
    """Return the reductions of a quantity as a list of [kind, numbers]."""
    example = 'give "mean", ("histogram", edges) or ("quantile", [0.05, 0.95])'
    if isinstance(value, list):
        return [x for each in value for x in _read_reductions(path, each)]
    if value == "mean":
        return [["mean", []]]
    if isinstance(value, Mapping) and len(value) == 1:
        value = next(iter(value.items()))
    if not isinstance(value, tuple) or len(value) != 2 or value[0] not in ("histogram", "quantile"):
        raise SweepError(path, f"{example}, here {value!r}")
    kind, numbers = value[0], read_axis(path, value[1])
    if kind == "histogram" and (len(numbers) < 2 or np.any(np.diff(numbers) <= 0)):
        raise SweepError(path, "histogram: give two or more ascending edges")
    if kind == "quantile" and not all(0 <= x <= 1 for x in numbers):
        raise SweepError(path, f"quantile: give probabilities from 0 to 1, here {numbers}")
    return [[kind, numbers]]


def _check_quantity(path: tuple[str, ...], name: str, info: Any, starts: Sequence[str]) -> None:
    """Raise SweepError unless `name` is COLUMN, COLUMN.max, .min or .end, or EVENT.time and others.

    info: facts about the scene. starts: names of coordinates and rates.
    """
    head, dot, tail = name.partition(".")
    columns = [*starts, *info.inputs, *info.outputs, "energy"]
    what = f"{head!r} is no column or event of {info.name}"
    check_name(path, head, [*columns, *info.events], what)
    known = [*OVER_ROWS, "end"] if head in columns else ["time", "count", *starts]
    if (dot or head not in columns) and tail not in known:
        raise SweepError(path, f"after {head} and a dot: {', '.join(known)}, here {tail!r}")


def _try_run(a: SweepArguments, model: Any, run: dict[str, Any]) -> tuple[Any, int]:
    """Return a run of one trajectory, and the number of control periods of noise or a policy."""
    options, period, is_driven = dict(run), None, bool(a.noise or a.policy)
    options.pop("every", None)
    if is_driven:
        period = options.pop("control_period", None)
        missing = {*model.inputs} - {*a.inputs, *a.noise, *a.over, *a.draws}
        if missing and a.policy is None:
            raise SweepError(
                ("inputs",), f"noise replaces all signals: give {min(missing)} as well"
            )
    elif "control_period" in run:
        raise SweepError(("run", "control_period"), "goes with noise or a policy")
    try:
        trial = model.simulate_batch(threads=1, **options)
        info = model_of(model).info
        periods = count_input_periods(info, trial.request, period)[1] if is_driven else 0
    except (ValueError, TypeError) as fault:
        name, _, why = str(fault).partition(": ")
        path = ("run", name) if name in run else ("run",)
        raise SweepError(path, why if name in run else str(fault)) from None
    if a.policy is not None and (trial.tol > 0 or info.events):
        raise SweepError(("policy",), "needs fixed steps (h=), and a scene without events")
    if a.policy is not None:
        run["h"] = float(trial.h)
        run.setdefault("control_period", run["h"])
    if is_driven and not periods:
        raise SweepError(("run",), "noise with adaptive steps needs control_period, in s")
    return trial, periods


def _choose_rows(a: SweepArguments, trial: Any, every: Any, quantities: Sequence[str]) -> int:
    """Return the number of steps between two rows; 0 if rows are not counted in steps."""
    over_rows = [name for name in quantities if name.partition(".")[2] in OVER_ROWS]
    if "times" in a.run or trial.tol > 0:
        if every is not None:
            raise SweepError(
                ("run", "every"), "counts fixed steps: leave it out, or leave out times"
            )
        if over_rows and "times" not in a.run:
            why = "adaptive steps have rows at the start and at the end alone: give times"
            raise SweepError(("keep", over_rows[0]), why)
        return 0
    if over_rows or callable(a.outputs):
        return _read_integer("every", 1 if every is None else every)
    return ONLY_ENDS


def _source_digest(name: str, function: Any) -> str:
    """Return the digest of the source text of a function, by which a resumed sweep compares it."""
    try:
        return hashlib.sha256(inspect.getsource(function).encode()).hexdigest()
    except (OSError, TypeError):
        why = "a function without source text can't be compared when the sweep goes on: "
        raise SweepError((name,), f"{why}write it into a file") from None


# --- files ----------------------------------------------------------------------------------------


def read_file(file: Path) -> tuple[SweepArguments, SourceMap]:
    """Read the file of a sweep; return its arguments, and the places of its keys for messages.

    The file may also be a scene, of which then nothing varies.

    Raises EomcError if the file can't be read, and SceneError with the place of a fault in it.
    """
    shown = texts.line(str(file))
    try:
        data = file.read_bytes()
    except OSError as fault:
        raise EomcError(f"{shown}: can't be read ({fault.strerror})") from None
    if not data.strip():
        raise EomcError(f"{shown}: is empty: name a scene in it, and what varies under [over]")
    text, tree = text_and_tree(data, shown)
    places = SourceMap(text, shown)
    if "eomc_sweep" not in tree and "eomc" in tree:
        return SweepArguments(scene=file), places
    try:
        return _read_tree(tree, file.parent), places
    except SweepError as fault:
        raise place_error(fault, places) from None


def _read_tree(tree: Mapping[str, Any], folder: Path) -> SweepArguments:
    """Return the arguments in the tree of a file of a sweep."""
    for key in tree:
        check_name((key,), key, FILE_KEYS, "no key of a sweep")
    if tree.get("eomc_sweep") != 1:
        raise SweepError(("eomc_sweep",), "write eomc_sweep = 1, the version of the format")
    if not isinstance(tree.get("scene"), str):
        raise SweepError(("scene",), 'name the file of the scene, such as scene = "cartpole.toml"')
    tables = ("over", "draws", "inputs", "noise", "run", "reduce")
    for key in tables:
        if not isinstance(tree.get(key, {}), dict):
            raise SweepError((key,), f"is a table: write [{key}]")
    over, draws, inputs, noise, run, reduce = (dict(tree.get(key, {})) for key in tables)
    return SweepArguments(
        scene=folder / tree["scene"], over=over, n=draws.pop("n", None),
        sampler=draws.pop("sampler", "random"), draws=draws, seed=tree.get("seed", 0),
        inputs=inputs, noise=noise, outputs=tree.get("keep"), reduce=reduce,
        keep_draws=tree.get("keep_draws"), bits=tree.get("bits", "native"), run=run,
    )  # fmt: skip


def place_error(fault: SweepError, places: SourceMap) -> SceneError:
    """Return the error for a fault in the file of a sweep, with the line of the argument."""
    return SceneError([places.problem(fault.path, fault.message)])
