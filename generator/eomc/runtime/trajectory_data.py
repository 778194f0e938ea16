"""The rows of a run by fixed steps, and the arguments of the run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array
from .columns import Columns
from .constrained_run import ConstrainedRun
from .package import own_model, reduced
from .stepping import Stepping

LEFT_OUT = "u was a function, which a pickled or saved run doesn't keep: simulate again"


class _Half:
    """q or qd of a run: a half of its rows, computed at the first access and stored."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, run: Trajectory | None, owner: type) -> Array:
        if run is None:
            return self  # type: ignore[return-value]  # access on the class, as by help()
        half: Array = run._rows[self.index]
        run.__dict__[self.name] = half
        return half


@dataclass(eq=False, repr=False)
class Trajectory(ConstrainedRun, Columns):
    """Data of a run by fixed steps, and quantities that are computed from the data.

    Attributes
    ----------
    t0, h : float
        Initial time and step size, s.
    q, qd : (n, nq) arrays
        Positions and velocities at the rows (stored states).
    steps, every : int
        Number of completed steps, and of steps from one row to the next.
    status : str
        "ok", or the reason for stopping.
    method : str
        Name of the method.
    evaluations : int
        Number of evaluations of accelerations.
    """

    _model: Stepping
    t0: float
    _rows: Array | tuple[Array, Array]  # q and qd, in one array (2, n, nq) or two
    h: float
    steps: int
    status: str
    _params: Array
    every: int
    _u: Any
    method: str
    evaluations: int
    _energy: Array | None = field(default=None, init=False)
    # inputs at the rows, if u is a function, and steps from one call of it to the next
    _applied: Array | None = field(default=None, init=False)
    _hold: int = field(default=1, init=False)

    q, qd = _Half(0), _Half(1)

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return (q, qd), each (..., nq), at times t (...,), s; subclasses implement it."""
        raise NotImplementedError

    @cached_property
    def t(self) -> Array:
        """Times of the rows, (n,), s."""
        return self.t0 + self.h * np.minimum(self.every * np.arange(len(self.q)), self.steps)

    @property
    def u(self) -> Array:
        """Inputs that act at each row, (n, nu), limited to their allowed ranges.

        At each row they are the values of the scene's signals, or the inputs of the step that
        begins there. The last row has the inputs of the last step.
        """
        return self._model._within(self._requested_inputs, self._params)

    @property
    def saturated(self) -> Array:
        """Array of bool (n, nu): True where an input exceeds its limits, before it is limited."""
        requested = self._requested_inputs
        return np.asarray(np.abs(requested - self._model._within(requested, self._params)) > 0)

    @property
    def _requested_inputs(self) -> Array:
        """The inputs at each row before saturation, (n, nu)."""
        if self._applied is not None:
            return self._applied
        shape = (len(self), self._model.nu)
        if self._u is None:
            signal: Any = self._model.signal
            return np.asarray(signal(self.q, self.qd, self.t, self._params))
        if self._u.ndim == 1:
            return np.broadcast_to(self._u, shape).copy()
        if not len(self._u):  # no step, and so no inputs
            return np.full(shape, np.nan, self._u.dtype)
        rows: Array = self._u[np.minimum(np.arange(len(self)) * self.every, self.steps - 1)]
        return rows

    @property
    def energy(self) -> Array:
        """Energy K + P (kinetic and potential) at each row, (n,), J.

        In a rotating frame, `jacobi` is conserved instead of the energy.
        """
        if self._energy is None:
            self._energy = self._evaluate(self._model.energy)
        return self._energy

    @property
    def jacobi(self) -> Array:
        """Jacobi's integral qd . dK/dqd - K + P at each row, (n,), J.

        It equals the energy if K is purely quadratic in qd. Otherwise, as in a rotating frame, it
        is conserved instead of the energy if the power is zero.
        """
        return self._evaluate(self._model.jacobi)

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """The scene's outputs at the rows, as a dict from name to array (n,).

        A value is nan where the output depends on accelerations and the mass matrix D is singular.
        """
        model = self._model
        if not model.outputs:
            return {}
        values = self._evaluate_with_inputs(model.output)
        return dict(zip(model.outputs, np.ascontiguousarray(values.T), strict=True))

    def _evaluate_with_inputs(self, function: Callable[..., Any]) -> Array:
        """Evaluate a function of the state and the inputs at each row."""
        constant = self._u is None or (self._applied is None and self._u.ndim == 1)
        return self._evaluate(function, u=self._u if constant else self.u)

    def _evaluate(self, function: Callable[..., Any], **arguments: Any) -> Array:
        """Evaluate a function of the state at each row, (n, ...)."""
        return np.asarray(function(self.q, self.qd, t=self.t, params=self._params, **arguments))

    def _equidistant(self) -> Trajectory:
        """Return a run with equidistant rows, one for each step, or enough for a picture."""
        return self if self.every == 1 else self._repeat(1, 1, None, None)

    def _repeat(
        self, parts: int, every: int, nudge: Array | None,
        progress: Callable[[int, int], None] | None,
    ) -> Any:  # fmt: skip
        """Repeat the run in steps of h/parts, from a start perturbed by `nudge` (2 nq,)."""
        model, x = self._model, self.x[0]
        if nudge is not None:
            x = (x + nudge).astype(model.dtype)
        u = self._u
        if u is not None and not callable(u) and np.ndim(u) == 2:
            u = u[: self.steps]  # each row held over `parts` steps
        return model._trajectory(
            x[: model.nq], x[model.nq :], model._pointer(x[: model.nq]),
            model._pointer(x[model.nq :]), self.h / parts, self.steps * parts, every, u,
            self._params, model._pointer(self._params), self.method, float(self.t[0]), None,
            progress, self._hold * parts,
        )  # fmt: skip

    def _to_arrays(self) -> dict[str, Any]:
        """Return the arrays of a saved run in addition to its columns; None is not saved."""
        u = None if callable(self._u) or isinstance(self._u, str) else self._u
        return {
            "q": self.q, "qd": self.qd, "t0": self.t0, "h": self.h, "steps": self.steps,
            "status": self.status, "params": self._params, "every": self.every, "held": u,
            "method": self.method, "evaluations": self.evaluations, "applied": self._applied,
            "singular_steps": self.singular_steps, "first_singular": self.first_singular,
        }  # fmt: skip

    @classmethod
    def _from_arrays(cls, model: Stepping, arrays: Mapping[str, Any], **own: Any) -> Self:
        applied = arrays.get("applied")
        u = arrays.get("held") if applied is None else LEFT_OUT
        run = cls(
            model, arrays["t0"], (arrays["q"], arrays["qd"]), arrays["h"], arrays["steps"],
            arrays["status"], arrays["params"], arrays["every"], u, arrays["method"],
            arrays["evaluations"], **own,
        )  # fmt: skip
        run._applied = applied
        for name in ("singular_steps", "first_singular"):
            setattr(run, name, arrays.get(name, getattr(run, name)))
        return run

    def _state(self) -> dict[str, Any]:
        """Return all attributes except cached ones."""
        derived = ("t", "q", "qd", "outputs")
        return {name: value for name, value in self.__dict__.items() if name not in derived}

    @classmethod
    def _of_state(cls, state: dict[str, Any]) -> Self:
        run = cls.__new__(cls)
        run.__dict__.update({"_model": own_model()} | state)
        return run

    def __copy__(self) -> Self:
        return self._of_state(self._state())

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self._of_state(deepcopy(self._state(), memo))

    def __reduce__(self) -> tuple[Any, ...]:
        state = self._state()
        del state["_model"]  # the build that reads the pickle has its own
        if callable(self._u):
            state["_u"] = LEFT_OUT
        kind = type(self)
        return reduced(f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}._of_state", state)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectory):
            return NotImplemented
        alike = self._settings() == other._settings()
        return alike and np.array_equal(self.q, other.q) and np.array_equal(self.qd, other.qd)

    __hash__ = None  # type: ignore[assignment]  # rows may be changed

    def _settings(self) -> tuple[Any, ...]:
        model = self._model
        return (
            model.name, model.digest, self.t0, self.h, self.steps, self.status, self.every,
            self.method, self._params.tolist(),
        )  # fmt: skip

    @property
    def x(self) -> Array:
        """States [q; qd] at the rows, (n, 2 nq)."""
        return np.hstack([self.q, self.qd])

    @property
    def description(self) -> str:
        """Text that describes the choice of steps, such as "h = 0.01 s"."""
        return f"h = {self.h:g} s"

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        return f"<Run of {self._model.name}: {how}{self.steps} steps of {self.h:g} s>"
