"""Checks of the initial states, parameters and inputs of many instances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, without_mask
from .model import LARGE, Model
from .starts import initial_state_for_parameters, is_by_name


class Instances(Model):
    """Compiled scene whose methods accept arguments with one row for each of many instances."""

    def __init__(self, extension: Any, **scene: Any) -> None:
        super().__init__(extension, **scene)
        self._whole = (self._ffi.typeof("long[]"), self._ffi.typeof("int[]"))  # done, status
        # C functions that step many instances, by method
        self._batch_steps = {x: self._stepper(x, "batch_step") for x in (None, *self.methods)}
        # measured seconds per step and instance, by function and log2 of the number of instances
        # (few instances do not fill a register); used only to choose the size of chunks
        self._paces: dict[Any, float] = {}

    def step_batch(self, *_: Any, **__: Any) -> Any:
        """Advance many instances by one or more steps; implemented by `BatchModel.step_batch`."""
        raise NotImplementedError

    def _instances(
        self, q0: Any, qd0: Any, params: Any, u: Any,
        steps: int | None, t0: float | None = None,
    ) -> tuple[tuple[Array, Array], Array, Array | None, Array | None]:  # fmt: skip
        """Return ((q, qd), parameters, inputs, status), with one row for each instance.

        A single row of parameters or inputs applies to all instances. q and qd may be the caller's
        arrays, which must not be changed and may contain numbers that are not finite. If t0 is
        given, the starts are assembled on the constraints at that time; status, (batch,), is None
        if this succeeds for all.
        """
        start, table = self._start, self._parameter_rows(params)
        if (params is not None and self._follows) or is_by_name(q0, qd0):
            q0, qd0 = initial_state_for_parameters(self, q0, qd0, table, many_values=True)
        q = self._rows_of(start[0] if q0 is None else self._completed(q0, 0), "q0")
        qd = self._rows_of(start[1] if qd0 is None else self._completed(qd0, 1), "qd0")
        inputs = self._input_rows(u, steps)
        sizes = {
            "q0": 1 if q.ndim == 1 else len(q),
            "qd0": 1 if qd.ndim == 1 else len(qd),
            "params": len(table),
            "u": 1 if inputs is None else len(inputs),
        }
        if empty := [name for name, size in sizes.items() if not size]:
            raise ValueError(f"{empty[0]}: no instances")
        whose, count = next((x for x in sizes.items() if x[1] > 1), ("q0", 1))
        for name, size in sizes.items():
            if size not in (1, count):
                hint = ": a table over time for all is (1, steps, nu)" if name == "u" else ""
                raise ValueError(f"{name}: {size} instances where {whose} has {count}{hint}")

        if whose == "u" and inputs is not None and np.ndim(u) == 2 and len(inputs) == steps:
            one, each = f"(1, {steps}, {self.nu})", f"({steps}, 1, {self.nu})"
            raise ValueError(
                f"u: shape {np.shape(u)} may be a table over time or one row an instance: give "
                f"{one} for a table, {each} for as many instances"
            )

        whole = (count, self.nq)  # broadcast_to is slow even without effect
        q, qd = (x if x.shape == whole else np.broadcast_to(x, whole) for x in (q, qd))
        codes = None
        if t0 is not None:
            q, qd, codes = self._assembled_rows(q, qd, table, t0)
        return (q, qd), table, inputs, codes

    def _rows_of(self, values: ArrayLike, name: str) -> Array:
        """Return states (nq,) or (n, nq); an array (n, nq) is returned without further checks."""
        if isinstance(values, np.ndarray) and values.ndim == 2 and values.shape[1] == self.nq:
            without_mask(values, name)
            if values.dtype in (self.dtype, np.float64) and values.flags.aligned:
                return values
        return self._array(values, name, self.nq)

    def _input_rows(self, u: Any, steps: int | None) -> Array | None:
        """Return inputs (batch or 1, steps or 1, nu); steps None: constant during the run."""
        if u is None:
            return None
        if not self.nu:
            raise ValueError("u: this scene has no inputs")
        if callable(u):
            raise ValueError(
                "u: a Python function can't be called for many at once: give a table, or step all "
                "instances by step_batch in a loop that computes u from their states"
            )
        if type(u) is not np.ndarray and isinstance(u, Mapping):
            u = self._by_name(u)
        if type(u) is np.ndarray and u.dtype is self.dtype and u.flags.carray:
            array = u
        else:
            array = self._numbers(u, "u")
        if array.ndim < 3:
            array = array[:, None] if array.ndim == 2 else array.reshape(1, 1, -1)
        if array.ndim != 3 or array.shape[2] != self.nu or array.shape[1] not in (1, steps):
            shapes, wide = f"({self.nu},), (batch, {self.nu})", f"(batch, {steps}, {self.nu})"
            table = ": rows, each held over a control period, take control_period=, in s"
            rows = ", a row for each step or control period of duration="
            over = f" or {wide}{rows}" if steps else table
            raise ValueError(f"u: shape {np.shape(u)}, expected {shapes}{over}")
        at = self._pointer(array)
        for k in range(0, array.size, LARGE):
            if not self._lib.all_finite(min(LARGE, array.size - k), at + k):
                raise ValueError("u: not all numbers are finite")
        return array
