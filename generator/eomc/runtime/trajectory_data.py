"""The rows of a run by fixed steps, and what it was made with."""

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
    """q or qd of a run: a half of its rows, made when it is first asked for, and kept."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, run: Trajectory | None, owner: type) -> Array:
        if run is None:
            return self  # type: ignore[return-value]  # on the class, as for help()
        half: Array = run._rows[self.index]
        run.__dict__[self.name] = half
        return half


@dataclass(eq=False, repr=False)
class Trajectory(ConstrainedRun, Columns):
    """What `trajectory.Run` keeps, and what follows from that alone."""

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
    _applied: Array | None = field(default=None, init=False)  # where u is a function,
    _hold: int = field(default=1, init=False)  # which is called every so many steps

    q, qd = _Half(0), _Half(1)

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """(q, qd) at any time within: each kind of run has its own way."""
        raise NotImplementedError

    @cached_property
    def t(self) -> Array:
        """The times of the rows, (n,), s."""
        return self.t0 + self.h * np.minimum(self.every * np.arange(len(self.q)), self.steps)

    @property
    def u(self) -> Array:
        """The inputs as they acted at each row, (n, nu), so within their limits.

        They are the signals there, or what was held from there on; in the last row what was held
        over the last step.
        """
        return self._model._within(self._given, self._params)

    @property
    def saturated(self) -> Array:
        """Whether each input was beyond its limits at each row, (n, nu)."""
        given = self._given
        return np.asarray(np.abs(given - self._model._within(given, self._params)) > 0)

    @property
    def _given(self) -> Array:
        """The inputs at each row, (n, nu), whatever their limits."""
        if self._applied is not None:
            return self._applied
        shape = (len(self), self._model.nu)
        if self._u is None:
            signal: Any = self._model.signal
            return np.asarray(signal(self.q, self.qd, self.t, self._params))
        if self._u.ndim == 1:
            return np.broadcast_to(self._u, shape).copy()
        if not len(self._u):  # no step, and so nothing held
            return np.full(shape, np.nan, self._u.dtype)
        rows: Array = self._u[np.minimum(np.arange(len(self)) * self.every, self.steps - 1)]
        return rows

    @property
    def energy(self) -> Array:
        """K + P along the run, (n,), J. What is conserved may be `jacobi` instead."""
        if self._energy is None:
            self._energy = self._values(self._model.energy)
        return self._energy

    @property
    def jacobi(self) -> Array:
        """qd.dK/dqd - K + P along the run, (n,), J: the energy, where K is purely quadratic.

        Else, as in a frame that is turned, this is what is conserved where there is no power.
        """
        return self._values(self._model.jacobi)

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """The scene's outputs along the run by their names, (n,) each.

        nan where one needs accelerations and D is singular.
        """
        model = self._model
        if not model.outputs:
            return {}
        values = self._driven(model.output)
        return dict(zip(model.outputs, np.ascontiguousarray(values.T), strict=True))

    def _driven(self, function: Callable[..., Any]) -> Array:
        """What a function of the state and the inputs gives at each row."""
        constant = self._u is None or (self._applied is None and self._u.ndim == 1)
        return self._values(function, u=self._u if constant else self.u)

    def _values(self, function: Callable[..., Any], **held: Any) -> Array:
        """What a function of the state gives at each row, (n, ...)."""
        return np.asarray(function(self.q, self.qd, t=self.t, params=self._params, **held))

    def _even(self) -> Trajectory:
        """With rows equally far apart, as many as there are steps, or enough to draw it."""
        return self if self.every == 1 else self._again(1, 1, None, None)

    def _again(
        self, parts: int, every: int, nudge: Array | None,
        progress: Callable[[int, int], None] | None,
    ) -> Any:  # fmt: skip
        """The same motion in steps of h/parts, from a start moved by `nudge` (2 nq,)."""
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

    def _kept(self) -> dict[str, Any]:
        """What a saved run keeps of it besides its columns; None: nothing."""
        held = None if callable(self._u) or isinstance(self._u, str) else self._u
        return {
            "q": self.q, "qd": self.qd, "t0": self.t0, "h": self.h, "steps": self.steps,
            "status": self.status, "params": self._params, "every": self.every, "held": held,
            "method": self.method, "evaluations": self.evaluations, "applied": self._applied,
            "singular_steps": self.singular_steps, "first_singular": self.first_singular,
        }  # fmt: skip

    @classmethod
    def _of_kept(cls, model: Stepping, kept: Mapping[str, Any], **own: Any) -> Self:
        applied = kept.get("applied")
        u = kept.get("held") if applied is None else LEFT_OUT
        run = cls(
            model, kept["t0"], (kept["q"], kept["qd"]), kept["h"], kept["steps"], kept["status"],
            kept["params"], kept["every"], u, kept["method"], kept["evaluations"], **own,
        )  # fmt: skip
        run._applied = applied
        for name in ("singular_steps", "first_singular"):
            setattr(run, name, kept.get(name, getattr(run, name)))
        return run

    def _state(self) -> dict[str, Any]:
        """All but what is made when it is asked for."""
        made = ("t", "q", "qd", "outputs")
        return {name: value for name, value in self.__dict__.items() if name not in made}

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
        del state["_model"]  # the build that reads it has its own
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
        """The states [q; qd], (n, 2 nq)."""
        return np.hstack([self.q, self.qd])

    @property
    def told(self) -> str:
        """How its steps were chosen, in words."""
        return f"h = {self.h:g} s"

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        return f"<Run of {self._model.name}: {how}{self.steps} steps of {self.h:g} s>"
