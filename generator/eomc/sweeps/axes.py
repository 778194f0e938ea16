"""Axes of grids, distributions of draws, and the values of both by the index of a trajectory.

A drawn value depends on the seed, the name of the quantity and the index alone. With the sampler
"random" it does not depend on the other draws, nor on the number of trajectories; with "sobol" it
depends on the number of drawn quantities, with "latin" on the number of trajectories as well.

References
----------
Salmon, Moraes, Dror, Shaw: Parallel random numbers: as easy as 1, 2, 3 (SC 2011), for Philox.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections.abc import Collection, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.base.errors import EomcError
from eomc.scene.formulas import suggest

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
        raise SweepError(
            path, f"give a distribution, such as {{ normal = [2, 0.1] }}, not {value!r}"
        )
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
        return {
            "scipy": [name, [float(x) for x in args], {k: float(kwds[k]) for k in sorted(kwds)}]
        }
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
    if kind in ("uniform", "log_uniform"):
        low, high = numbers
        if kind == "uniform":
            return np.asarray(low + (high - low) * u)
        return np.asarray(np.exp(math.log(low) + (math.log(high) - math.log(low)) * u))
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
