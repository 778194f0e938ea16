"""Runs, and how they end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .adaptive_memory import FULL, REMEDY
from .arguments import Array
from .balance import Balance, balance
from .begun import infinite_at_start
from .columns import Columns, File
from .constrained_run import ConstrainedRun
from .dense import states
from .estimate import Estimate, estimate
from .happened import PassedOver
from .laws import asked
from .notebook import html
from .package import reduced, warn
from .plot import plot
from .section import crossings
from .shown import by_eomc

if TYPE_CHECKING:
    from .model import Model

STATUS = ("ok", "singular", "not finite", "no convergence", "accumulated", "locked")
SAID = {
    "singular": "D is not positive definite there, so no acceleration exists",
    "not finite": "the state would no longer be finite: the step may be too long, "
    "or the motion runs into a singularity",
    "no convergence": "the iteration for the step does not converge: take a smaller h",
    "locked": "no state near obeys the constraints: they contradict one another there, the "
    "position is singular, as that of a stretched leg is (eomc dof tells; guess a bent one), or "
    "the step is far too long",
    "interrupted": "interrupted",
    FULL: REMEDY,
}
LEFT_OUT = "u was a function, which a pickled or saved run doesn't keep: simulate again"


NOISE = (
    "estimate: u gives other values at the start than it gave in the run, as noise does, or what "
    "keeps a state of its own: let it depend on t, q and qd alone"
)


class MotionError(ArithmeticError):
    """There is no acceleration or step at a state; `status` says why, as that of a run."""

    def __init__(self, message: str, status: str) -> None:
        super().__init__(message)
        self.status = status

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("trajectory.MotionError", str(self), self.status)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation; `run` holds what was done until then."""

    def __init__(self, run: Any) -> None:
        super().__init__(run.message)
        self.run = run

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("trajectory.Interrupted", self.run)


class _Half:
    """q or qd of a run: a half of its rows, made when it is first asked for, and kept."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, run: Run | None, owner: type) -> Array:
        if run is None:
            return self  # type: ignore[return-value]  # on the class, as for help()
        half: Array = run._rows[self.index]
        run.__dict__[self.name] = half
        return half


@dataclass(eq=False, repr=False)
class Run(ConstrainedRun, Columns):
    """A trajectory: t (n,), q (n, nq), qd (n, nq), u (n, nu), status; by name run["theta_dot"].

    status: "ok", "singular", "not finite", "no convergence", under constraints "locked", or
    "interrupted"; a run that is not ok
    ends with its last good state, and `message` says where and why. energy (n,): K + P, computed
    when it is asked for; `steps` were done by `method`, of size h, and a row kept of `every` so
    many. evaluations: of accelerations. error: an Estimate, where it was asked for.

    Runs are equal where their scene, settings and rows are, bit by bit. A pickled run keeps all of
    that, its parameters and its inputs, but not a u that is a function: estimate() is refused then.
    Where it is read again, it finds the built module as it was found here.
    """

    _model: Model
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
    error: Estimate | None = field(default=None, init=False)
    _energy: Array | None = field(default=None, init=False)
    _applied: Array | None = field(default=None, init=False)  # where u is a function,
    _hold: int = field(default=1, init=False)  # which is called every so many steps

    q, qd = _Half(0), _Half(1)

    @cached_property
    def t(self) -> Array:
        """The times of the rows, (n,), s."""
        return self.t0 + self.h * np.minimum(self.every * np.arange(len(self.q)), self.steps)

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """(q, qd) at any time within the run, t (...,): each (..., nq).

        By a shorter step of the method from the last one before, so of its order. Raises ValueError
        outside of the run, or where u was a function and rows don't tell what it gave.
        """
        return states(self, t)

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
            self._energy = self._values("energy")
        return self._energy

    @property
    def jacobi(self) -> Array:
        """qd.dK/dqd - K + P along the run, (n,), J: the energy, where K is purely quadratic.

        Else, as in a frame that is turned, this is what is conserved where there is no power.
        """
        return self._values("jacobi")

    stopped = ""  # by which event; fixed steps pass over them

    @property
    def events(self) -> Mapping[str, Any]:
        """What adaptive steps find by the scene's events; fixed steps pass over them: empty."""
        return PassedOver(self._model.events)

    def _even(self) -> Run:
        """With rows equally far apart, as many as there are steps, or enough to draw it."""
        return self if self.every == 1 else self._again(1, 1, None, None)

    def balance(self) -> Balance | None:
        """What inputs and forces put in and what was lost, J, and the error that this leaves.

        What jumps of events put in or took stands apart. None where rows don't tell the inputs, of
        a function with `every`, or where an energy or a force is not finite.
        """
        return balance(self)

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """The scene's outputs along the run by their names, (n,) each.

        nan where one needs accelerations and D is singular.
        """
        model = self._model
        if not model.outputs:
            return {}
        values = self._driven("outputs", model.output)
        return dict(zip(model.outputs, np.ascontiguousarray(values.T), strict=True))

    def _driven(self, name: str, function: Callable[..., Any]) -> Array:
        """What a function of the state and the inputs gives at each row."""
        if self._u is None or (self._applied is None and self._u.ndim == 1):
            return self._values(name, function, u=self._u)
        return np.asarray(function(self.q, self.qd, self.t, self.u, self._params))

    def _values(self, name: str, function: Callable[..., Any] | None = None, **held: Any) -> Array:
        function = function or getattr(self._model, name)
        values = [
            np.atleast_1d(function(q, qd, t=float(self.t[k]), params=self._params, **held))
            for k, q, qd in self._model._by_time(name, self.t, self.q, self.qd)
        ]
        return np.concatenate(values)

    def plot(
        self, *names: str, phase: Any = None, section: Mapping[str, Array] | None = None,
        other: Run | Sequence[Run] = (), labels: Sequence[str] | None = None,
        wrap: bool | str | Sequence[str] = False, ax: Any = None, axes: Any = None,
        file: File | None = None, **style: Any,
    ) -> Any:  # fmt: skip
        """Curves over time by name; coordinates, inputs, outputs and energy where none is given.

        Names of one kind, unit and size share a panel. phase: a coordinate, drawn over its rate, a
        pair of names, or a list of such; section: what `section` returns, drawn there as points.
        other: runs beside this one, dashed; labels: names of the runs, in a legend. wrap: angles
        from -pi to pi, those in rad or the named ones, without lines where they jump. ax: one Axes
        for all, axes: one a panel. file: where the figure is written, too. style: for matplotlib's
        `plot`. Returns the Axes, an array of several. Raises ModuleNotFoundError without
        matplotlib, KeyError for unknown names.
        """
        return plot(self, names, phase, section, other, labels, wrap, ax, axes, file, style)

    def section(
        self, name: str, value: float = 0.0, *, rising: bool | None = None,
        period: float | None = None,
    ) -> dict[str, Array]:  # fmt: skip
        """All columns (m,) where one of them crosses a value: a Poincaré section.

        rising: only where it grows, or only where it falls. period: whole periods above and below
        the value count too, as 2 pi of an angle, or of t that of a drive. Each column is a cubic
        through four rows: errors go as the fourth power of the time between rows, and crossings
        closer than rows are missed, so keep every=1. Raises ValueError below four rows.
        """
        return crossings(self._drawn.to_dict(), name, value, rising, period)

    @property
    def _drawn(self) -> Run:
        """Itself, with rows near enough for curves."""
        return self

    def _repr_html_(self) -> str:
        """For notebooks: the end, the verdict, a small picture where matplotlib is there."""
        return html(self)

    def animate(
        self, file: File | None = None, *others: Run, scene: Any = None, title: str | None = None
    ) -> Any:
        """The motion as a page that plays it, for browsers and notebooks, or as a film.

        file: where it is written, a page .html, or a film .gif or .mp4, which need matplotlib;
        others: runs that are shown beside it. scene: the path of the scene, where the module was
        not loaded by eomc.load. Returns an Animation; see docs/pictures.md. Raises ImportError
        without eomc, EomcError where it can't be drawn or written.
        """
        page = by_eomc("report.animation")
        return page.animate([self, *others], file, scene=scene, title=title)

    def estimate(self, progress: Callable[[int, int], None] | None = None) -> Estimate:
        """The run's own error, by doing it again in shorter steps; kept in `error`.

        Where u is a function, it is called again, as often as in the run for each finer one.
        Warns where the motion is not resolved. Raises ValueError where the run was pickled and lost
        that function, or where this gives other values at the start than it gave: noise.
        """
        self._repeated()
        try:
            self.error = self._estimated(progress)
        except KeyboardInterrupt:
            raise Interrupted(self) from None
        if words := self.error.warning:
            warn(f"{self._model.name}: {words}")
        return self.error

    def _repeated(self) -> None:
        """Raise ValueError where the run can't be done again."""
        if isinstance(self._u, str):
            raise ValueError(f"estimate: {self._u}")
        if callable(self._u) and self._applied is not None and len(self) and self.t[0] == self.t0:
            now = asked(self._u, self._model._inputs, self.t0, self.q[0], self.qd[0])
            if not np.array_equal(now, self._applied[0]):
                raise ValueError(NOISE)

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        return estimate(self, progress)

    def _again(
        self, parts: int, every: int, nudge: Array | None,
        progress: Callable[[int, int], None] | None,
    ) -> Run:  # fmt: skip
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
    def _of_kept(cls, model: Model, kept: Mapping[str, Any], **own: Any) -> Run:
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
    def _of_state(cls, state: dict[str, Any]) -> Run:
        run = cls.__new__(cls)
        run.__dict__.update(state)
        return run

    def __copy__(self) -> Run:
        return self._of_state(self._state())

    def __deepcopy__(self, memo: dict[int, Any]) -> Run:
        return self._of_state(deepcopy(self._state(), memo))

    def __reduce__(self) -> tuple[Any, ...]:
        state = self._state()
        if callable(self._u):
            state["_u"] = LEFT_OUT
        kind = type(self)
        return reduced(f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}._of_state", state)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Run):
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
    def message(self) -> str:
        """What happened, in a sentence."""
        if self.status == "ok":
            return f"{self.steps} steps of {self.h:g} s"
        return (
            f"stopped at t = {self.t[-1]:.9g} after {self.steps} steps of {self.h:g} s, "
            f"{state_text(self.q[-1], self.qd[-1])}: {infinite_at_start(self) or SAID[self.status]}"
        )

    @property
    def told(self) -> str:
        """How its steps were chosen, in words."""
        return f"h = {self.h:g} s"

    @property
    def _remark(self) -> str:
        """What is to be said of a run that is whole, or ""."""
        return self._singular

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        return f"<Run of {self._model.name}: {how}{self.steps} steps of {self.h:g} s>"


def state_text(q: Array, qd: Array) -> str:
    """A state in a message."""

    def text(x: Array) -> str:
        return np.array2string(x + 0.0, precision=6, threshold=12)  # no -0

    return f"q = {text(q)}, qd = {text(qd)}"
