"""What is computed from the rows of a batch: energies, outputs, what constraints have."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from .arguments import Array
from .by_name import ByName
from .facts import Facts

_Rows = tuple[slice, slice]  # of instances and of times


class Values:
    """A part of `batch_run.BatchRun`: as in a single run, with the instances before all else."""

    _model: Facts
    q: Array
    qd: Array
    _params: Array  # (batch or 1, np)
    _held: Array | None  # at the rows, (batch or 1, n or 1, nu)
    t: Any
    __len__: Callable[[], int]

    @property
    def energy(self) -> Array:
        """K + P, (batch, n), J. What is conserved may be `jacobi` instead."""
        return self._values("energy", self._model.energy, ())

    @property
    def jacobi(self) -> Array:
        """qd.dK/dqd - K + P, (batch, n), J: the energy, where K is purely quadratic."""
        return self._values("jacobi", self._model.jacobi, ())

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """The scene's outputs by their names, (batch, n) each, nan where rows are.

        nan also where one needs accelerations and D is singular.
        """
        names = self._model.outputs
        if not names:
            return {}
        found = self._driven("outputs", self._model.output, (len(names),))
        return dict(zip(names, np.ascontiguousarray(np.moveaxis(found, 2, 0)), strict=True))

    @property
    def constraints(self) -> Mapping[str, Array]:
        """What each constraint lacks, (batch, n), by name: rounding."""
        model, names = self._model, self._model.constraint_names
        return _by_name(
            "constraints", names,
            lambda: self._values("constraints", model.constraints, (len(names),)),
        )  # fmt: skip

    @property
    def multipliers(self) -> Mapping[str, Array]:
        """The multiplier of each constraint, (batch, n), by name."""
        model, names = self._model, self._model.constraint_names
        return _by_name(
            "multipliers", names,
            lambda: self._driven("multipliers", model._multipliers, (len(names),)),
        )  # fmt: skip

    @property
    def reactions(self) -> Mapping[str, Array]:
        """What each [[loop]] does to its second body, by name, in the world's axes.

        Force and moment about the joint's point, (batch, n, 6); in the plane (batch, n, 3), force
        (2) and moment.
        """
        model, loops = self._model, self._model.loops
        shape = (len(loops), 3 if model._plane else 6)
        timed = min(model._timed & {"multipliers", "reactions"}, default="reactions")
        return _by_name("reactions", loops, lambda: self._driven(timed, model._reactions, shape))

    def _driven(self, name: str, function: Callable[..., Any], shape: tuple[int, ...]) -> Array:
        """What a function of the state and the inputs gives at all rows."""
        return self._values(name, function, shape, self._held)

    def _values(
        self, name: str, function: Callable[..., Any], shape: tuple[int, ...],
        held: Array | None = None,
    ) -> Array:  # fmt: skip
        """A function at all rows, (batch, n, ...), nan where these are; under inputs as held."""
        found = np.full((*self.q.shape[:2], *shape), np.nan, self._model.dtype)
        good: Any = np.isfinite(self.q).all(axis=-1) & np.isfinite(self.qd).all(axis=-1)
        for at in self._groups(name == "signal" or name in self._model._timed, held):
            here = good[at]
            k, j = (part.start or 0 for part in at)
            given: dict[str, Any] = {"params": self._params[min(k, len(self._params) - 1)]}
            if held is not None:
                given["u"] = held[min(k, len(held) - 1), min(j, held.shape[1] - 1)]
            t = float(self.t[j])
            found[at][here] = function(self.q[at][here], self.qd[at][here], t=t, **given)
        return found

    def _groups(self, timed: bool, held: Array | None) -> Iterator[_Rows]:
        """Rows that can be evaluated in one call: of one time, parameters and inputs."""
        count, n = self.q.shape[:2]
        alike = len(self._params) == 1 and (held is None or len(held) == 1)
        steady = not timed and (held is None or held.shape[1] == 1)
        for k in [slice(None)] if alike else [slice(k, k + 1) for k in range(count)]:
            for j in [slice(None)] if steady else [slice(j, j + 1) for j in range(n)]:
                yield k, j


def _by_name(what: str, names: Sequence[str], rows: Callable[[], Array]) -> ByName:
    """What `rows` gives, (batch, n, names, ...), by name; they are not asked for where none is."""
    return ByName(what, names, np.ascontiguousarray(np.moveaxis(rows(), 2, 0)) if names else ())
