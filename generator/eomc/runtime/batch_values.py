"""Quantities computed from the rows of a batch: energies, outputs, constraint forces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from .arguments import Array
from .by_name import ByName
from .metadata import ModelInfo

_ROWS_PER_CALL = 2**16  # rows of all instances in a call, which fit in the cache


class Values:
    """Mixin of `batch_run.BatchRun` with quantities that are evaluated at the rows of a batch.

    The first axis of all results is the instance, the second one the row. Results are nan at rows
    that are nan, that is, after an instance has failed.
    """

    _model: ModelInfo
    q: Array
    qd: Array
    _params: Array  # (batch or 1, np)
    _row_inputs: Array | None  # at the rows, (batch or 1, n or 1, nu)
    t: Any
    __len__: Callable[[], int]

    @property
    def energy(self) -> Array:
        """Return the energy K + P (kinetic and potential) at each row, (batch, n), J.

        In a rotating frame, `jacobi` is conserved instead of the energy.
        """
        return self._evaluate(self._model.energy, ())

    @property
    def jacobi(self) -> Array:
        """Return the Jacobi integral qd.dK/dqd - K + P at each row, (batch, n), J.

        It equals the energy if the kinetic energy K is purely quadratic in qd.
        """
        return self._evaluate(self._model.jacobi, ())

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """Return the outputs of the scene as a dict from name to array (batch, n).

        Values are nan at rows that are nan. Outputs that depend on accelerations are also nan at
        states with a singular mass matrix D.
        """
        names = self._model.outputs
        if not names:
            return {}
        values = self._evaluate_with_inputs(self._model.output, (len(names),))
        return dict(zip(names, np.ascontiguousarray(np.moveaxis(values, 2, 0)), strict=True))

    @property
    def constraints(self) -> Mapping[str, Array]:
        """Return the residual of each constraint equation as a dict from name to array (batch, n).

        A residual is 0 if the equation is satisfied; its unit is that of the equation. Raises
        KeyError for unknown names.
        """
        model, names = self._model, self._model.constraint_names
        return _by_name(
            "constraints", names,
            lambda: self._evaluate(model.constraints, (len(names),)),
        )  # fmt: skip

    @property
    def multipliers(self) -> Mapping[str, Array]:
        """Return the Lagrange multiplier of each constraint as a dict from name to (batch, n).

        Raises KeyError for unknown names.
        """
        model, names = self._model, self._model.constraint_names
        return _by_name(
            "multipliers", names,
            lambda: self._evaluate_with_inputs(model._multipliers, (len(names),)),
        )  # fmt: skip

    @property
    def reactions(self) -> Mapping[str, Array]:
        """Return the reaction of each loop's joint on its second body, by the loop's name.

        A loop is a [[loop]] of the scene: a joint that closes a kinematic chain. Its reaction is
        the force, N, and the moment about the joint's point, N m, along the axes of the world, as
        an array (batch, n, 6). In plane scenes the array is (batch, n, 3), with two components of
        the force and the moment.
        """
        model, loops = self._model, self._model.loops
        shape = (len(loops), 3 if model._plane else 6)
        return _by_name(
            "reactions", loops, lambda: self._evaluate_with_inputs(model._reactions, shape)
        )

    def _evaluate_with_inputs(self, function: Callable[..., Any], shape: tuple[int, ...]) -> Array:
        """Evaluate a function of the state and the inputs at all rows."""
        return self._evaluate(
            function, shape, None if self._row_inputs is None else {"u": self._row_inputs}
        )

    def _evaluate(
        self, function: Callable[..., Any], shape: tuple[int, ...],
        inputs: Mapping[str, Array] | None = None,
    ) -> Array:  # fmt: skip
        """Evaluate a function at all rows, (batch, n, ...), nan at rows that are nan."""
        count, n = self.q.shape[:2]
        results = np.full((count, n, *shape), np.nan, self._model.dtype)
        t, each = np.broadcast_to(self.t, (count, n)), {"params": self._params[:, None]}
        each |= inputs or {}
        alike = {name: x.size == x.shape[-1] for name, x in each.items()}
        for first in range(0, count, many := max(1, _ROWS_PER_CALL // max(n, 1))):
            at = slice(first, first + many)
            q, qd = self.q[at], self.qd[at]
            finite = np.isfinite(q).all(axis=-1) & np.isfinite(qd).all(axis=-1)
            here: Any = ... if finite.all() else finite
            arguments = {
                name: x[0, 0]
                if alike[name]
                else _rows(np.broadcast_to(x, (count, n, x.shape[-1]))[at][here])
                for name, x in each.items()
            }
            values = function(_rows(q[here]), _rows(qd[here]), t=t[at][here].ravel(), **arguments)
            results[at][here] = values.reshape(results[at][here].shape)
        return results


def _rows(x: Array) -> Array:
    """Reshape (..., m) to rows (n, m)."""
    return x.reshape(-1, x.shape[-1]) if x.shape[-1] else x.reshape(int(np.prod(x.shape[:-1])), 0)


def _by_name(what: str, names: Sequence[str], rows: Callable[[], Array]) -> ByName:
    """Return the values of `rows`, (batch, n, names, ...), by name."""
    return ByName(what, names, np.ascontiguousarray(np.moveaxis(rows(), 2, 0)) if names else ())
