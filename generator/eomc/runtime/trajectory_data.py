"""Data of single runs: rows, arguments, events, and what follows from them without a new run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, ByName
from .columns import Columns
from .interfaces import CompiledModel
from .package import own_model, reduced
from .requests import FixedStepRequest, as_numbers
from .status import MotionError

_MAX_ROUNDINGS = (
    2.0**26
)  # residuals above this number of roundings of their terms violate a constraint
_MIN_SCALE = 1e-9  # smallest scale of the terms
LEFT_OUT = "u was a function, which a pickled or saved run does not contain: simulate again"
_STEP_TOLERANCE = 1e-12  # times closer to a step than this fraction of h coincide with it


class _Half:
    """q or qd of a run: a half of its rows, computed at the first access and stored."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, run: Trajectory | None, owner: type) -> Array:
        if run is None:
            return self  # type: ignore[return-value]  # access on the class, as by help()
        half: Array = run.rows[self.index]
        run.__dict__[self.name] = half
        return half


@dataclass(eq=False, repr=False)
class Trajectory(Columns):
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
    singular_steps : int
        Number of steps that end at a singular position, where a constraint equation depends on the
        others. Its multiplier is large or 0 there, and joint forces are not unique. The motion is
        correct nevertheless.
    first_singular : float
        End time of the first of these steps, s; nan if there is none.
    """

    model: CompiledModel
    t0: float
    rows: Array | tuple[Array, Array]  # q and qd, in one array (2, n, nq) or two
    h: float
    steps: int
    status: str
    parameter_values: Array
    every: int
    input_source: Any
    method: str
    evaluations: int
    _energy: Array | None = field(default=None, init=False)
    # inputs at the rows, if u is a function, and steps from one call of it to the next
    applied_inputs: Array | None = field(default=None, init=False)
    hold: int = field(default=1, init=False)
    singular_steps: int = field(default=0, init=False)
    first_singular: float = field(default=float("nan"), init=False)

    q, qd = _Half(0), _Half(1)

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return the state at any time within the run.

        A shorter step of the method from the last row before yields the state, with the order of
        the method.

        Parameters
        ----------
        t : array_like, any shape
            Times, s.

        Returns
        -------
        q, qd : arrays of shape t.shape + (nq,)

        Raises
        ------
        ValueError
            If a time is outside of the run, or if u was a function whose values are not stored at
            each step.
        """
        return states(self, t)

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
        return self.model.functions.saturate(self.requested_inputs, self.parameter_values)

    @property
    def saturated(self) -> Array:
        """Array of bool (n, nu): True where an input exceeds its limits, before it is limited."""
        requested = self.requested_inputs
        return np.asarray(
            np.abs(requested - self.model.functions.saturate(requested, self.parameter_values)) > 0
        )

    @property
    def requested_inputs(self) -> Array:
        """The inputs at each row before saturation, (n, nu)."""
        if self.applied_inputs is not None:
            return self.applied_inputs
        shape = (len(self), self.model.info.nu)
        if self.input_source is None:
            signal: Any = self.model.functions.signal
            return np.asarray(signal(self.q, self.qd, self.t, self.parameter_values))
        if self.input_source.ndim == 1:
            return np.broadcast_to(self.input_source, shape).copy()
        if not len(self.input_source):  # no step, and so no inputs
            return np.full(shape, np.nan, self.input_source.dtype)
        rows: Array = self.input_source[
            np.minimum(np.arange(len(self)) * self.every, self.steps - 1)
        ]
        return rows

    @property
    def energy(self) -> Array:
        """Energy K + P (kinetic and potential) at each row, (n,), J.

        In a rotating frame, `jacobi` is conserved instead of the energy.
        """
        if self._energy is None:
            self._energy = self.evaluate(self.model.functions.energy)
        return self._energy

    @property
    def jacobi(self) -> Array:
        """Jacobi's integral qd . dK/dqd - K + P at each row, (n,), J.

        It equals the energy if K is purely quadratic in qd. Otherwise, as in a rotating frame, it
        is conserved instead of the energy if the power is zero.
        """
        return self.evaluate(self.model.functions.jacobi)

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """The scene's outputs at the rows, as a dict from name to array (n,).

        A value is nan where the output depends on accelerations and the mass matrix D is singular.
        """
        model = self.model
        if not model.info.outputs:
            return {}
        values = self._evaluate_with_inputs(model.functions.output)
        return dict(zip(model.info.outputs, np.ascontiguousarray(values.T), strict=True))

    @property
    def constraints(self) -> Mapping[str, Array]:
        """Return the residual of each constraint equation as a dict from name to array (n,).

        The array has a value for each row. A residual is 0 if the equation is satisfied; its unit
        is that of the equation. Raises KeyError for unknown names.
        """
        names = self.model.info.constraints.names
        return ByName(
            "constraints",
            names,
            self.evaluate(self.model.constraints.constraints).T if names else (),
        )

    @property
    def multipliers(self) -> Mapping[str, Array]:
        """Return the Lagrange multiplier of each constraint as a dict from name to array (n,).

        The array has a value for each row; nan where the multiplier does not exist. Raises KeyError
        for unknown names.
        """
        names = self.model.info.constraints.names
        values = (
            self._evaluate_with_inputs(self.model.constraints.multipliers_or_nan).T if names else ()
        )
        return ByName("multipliers", names, np.ascontiguousarray(values))

    @property
    def reactions(self) -> Mapping[str, Array]:
        """Return the reaction of each loop's joint on its second body, by the loop's name.

        A loop is a [[loop]] of the scene: a joint that closes a kinematic chain. Its reaction is
        the force, N, and the moment about the joint's point, N m, along the axes of the world, at
        all rows: an array (n, 6). In plane scenes the array is (n, 3), with two components of the
        force and the moment.
        """
        loops = self.model.info.constraints.loops
        if not loops:
            return ByName("reactions", (), ())
        values = self._evaluate_with_inputs(self.model.constraints.reactions_or_nan)
        return ByName("reactions", loops, np.moveaxis(values, -2, 0))

    @property
    def broken_constraints(self) -> str:
        """Return a message on a constraint that is violated at the end of the run, or ""."""
        model, names = self.model, self.model.info.constraints.names
        left_out = (
            self.singular_steps or model.info.constraints.redundant
        )  # steps satisfy all other constraints
        if not left_out or not len(self.q) or self.status != "ok":
            return ""
        q, qd, t, p = self.q[-1], self.qd[-1], float(self.t[-1]), self.parameter_values
        sizes = np.abs(model.constraints.constraint_jacobian(q, t=t, params=p)).astype(float)
        for what, x in (("constraints", q), ("constraint_rates", qd)):
            off = np.abs(getattr(model.constraints, what)(q, qd, t, p)).astype(float)
            share = off / np.maximum(sizes @ (np.abs(x) + np.max(np.abs(x))), _MIN_SCALE)
            worst = int(np.argmax(share))
            if share[worst] > _MAX_ROUNDINGS * float(np.finfo(model.info.dtype).eps):
                rate = "the rate of " if what != "constraints" else ""
                return (
                    f"{rate}{names[worst]} is {off[worst]:.3g} at the end, not 0: constraints "
                    "contradict one another, and this motion does not obey them all"
                )
        return ""

    @property
    def _singular(self) -> str:
        """Return a message on violated or dependent constraint equations; "" if there are none."""
        if broken := self.broken_constraints:
            return broken
        if not self.singular_steps:
            return ""
        many = "a step ends" if self.singular_steps == 1 else f"{self.singular_steps} steps end"
        return (
            f"{many} where a constraint depends on others, first at t = {self.first_singular:.9g}: "
            "multipliers and reactions are not unique there"
        )

    def _evaluate_with_inputs(self, function: Callable[..., Any]) -> Array:
        """Evaluate a function of the state and the inputs at each row."""
        constant = self.input_source is None or (
            self.applied_inputs is None and self.input_source.ndim == 1
        )
        return self.evaluate(function, u=self.input_source if constant else self.u)

    def evaluate(self, function: Callable[..., Any], **arguments: Any) -> Array:
        """Evaluate a function of the state at each row, (n, ...)."""
        return np.asarray(
            function(self.q, self.qd, t=self.t, params=self.parameter_values, **arguments)
        )

    def equidistant(self) -> Trajectory:
        """Return a run with equidistant rows, one for each step, or enough for a picture."""
        return self if self.every == 1 else self.repeat(1, 1, None, None)

    def repeat(
        self, parts: int, every: int, nudge: Array | None,
        progress: Callable[[int, int], None] | None,
    ) -> Any:  # fmt: skip
        """Repeat the run in steps of h/parts, from a start perturbed by `nudge` (2 nq,)."""
        model, x = self.model, self.x[0]
        if nudge is not None:
            x = (x + nudge).astype(model.info.dtype)
        u = self.input_source
        if u is not None and not callable(u) and np.ndim(u) == 2:
            u = u[: self.steps]  # each row held over `parts` steps
        nq = model.info.nq
        return model.integrator.run(
            FixedStepRequest(
                x[:nq], x[nq:], float(self.t[0]), self.h / parts, self.steps * parts, every, u,
                self.parameter_values, self.method, self.hold * parts, progress=progress,
            )
        )  # fmt: skip

    def to_arrays(self) -> dict[str, Any]:
        """Return the arrays of a saved run in addition to its columns; None is not saved."""
        u = (
            None
            if callable(self.input_source) or isinstance(self.input_source, str)
            else self.input_source
        )
        return {
            "q": self.q, "qd": self.qd, "t0": self.t0, "h": self.h, "steps": self.steps,
            "status": self.status, "params": self.parameter_values, "every": self.every, "held": u,
            "method": self.method, "evaluations": self.evaluations, "applied": self.applied_inputs,
            "singular_steps": self.singular_steps, "first_singular": self.first_singular,
        }  # fmt: skip

    @classmethod
    def from_arrays(cls, model: CompiledModel, arrays: Mapping[str, Any], **own: Any) -> Self:
        """Create the run from the arrays and numbers of `to_arrays`, read from a file."""
        applied = arrays.get("applied")
        u = arrays.get("held") if applied is None else LEFT_OUT
        run = cls(
            model, arrays["t0"], (arrays["q"], arrays["qd"]), arrays["h"], arrays["steps"],
            arrays["status"], arrays["params"], arrays["every"], u, arrays["method"],
            arrays["evaluations"], **own,
        )  # fmt: skip
        run.applied_inputs = applied
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
        run.__dict__.update({"model": own_model()} | state)
        return run

    def __copy__(self) -> Self:
        return self._of_state(self._state())

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self._of_state(deepcopy(self._state(), memo))

    def __reduce__(self) -> tuple[Any, ...]:
        state = self._state()
        del state["model"]  # the build that reads the pickle has its own
        if callable(self.input_source):
            state["input_source"] = LEFT_OUT
        kind = type(self)
        return reduced(f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}._of_state", state)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trajectory):
            return NotImplemented
        alike = self.settings() == other.settings()
        return alike and np.array_equal(self.q, other.q) and np.array_equal(self.qd, other.qd)

    __hash__ = None  # type: ignore[assignment]  # rows may be changed

    def settings(self) -> tuple[Any, ...]:
        """Return the settings of the run that have to agree for two runs to be equal."""
        model = self.model
        return (
            model.info.name, model.info.digest, self.t0, self.h, self.steps, self.status,
            self.every,
            self.method, self.parameter_values.tolist(),
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
        return f"<Run of {self.model.info.name}: {how}{self.steps} steps of {self.h:g} s>"


def within(run: Any, t: ArrayLike) -> Array:
    """Check that times lie within a run; return them, s, as an array of the same shape.

    A time that is outside of the run by no more than rounding is set to the start or end of the
    run. Raises ValueError if a time is further outside.
    """
    times = as_numbers(t, "t", np.dtype(float))
    begin, end = run.t0, float(run.t[-1])
    slack = 1e-12 * max(abs(begin), abs(end), end - begin)
    if times.size and not (times.min() >= begin - slack and times.max() <= end + slack):
        raise ValueError(f"t: the run goes from {begin:g} s to {end:.9g} s")
    return np.asarray(np.clip(times, begin, end))


def states(run: Trajectory, t: ArrayLike) -> tuple[Array, Array]:
    """Return the positions and velocities of a run with fixed steps at any times within the run.

    The state at a time is computed by a shorter step of the same method from the last step before
    that time. Its error has the order of the method if the forces are smooth. Inputs are constant
    over the same steps as in the run.

    Parameters
    ----------
    t : array_like, (...)
        Times, s.

    Returns
    -------
    q, qd : (..., nq) arrays

    Raises
    ------
    ValueError
        If a time is outside of the run, or if u was a function whose values are not stored at each
        step.
    """
    times = within(run, t)
    nq, (whole, rest) = run.model.info.nq, parts(times.ravel(), run.t0, run.h, run.steps)
    out = np.empty((2, times.size, nq), run.model.info.dtype)
    for k, (n, left) in enumerate(zip(whole.tolist(), rest.tolist(), strict=True)):
        out[:, k] = _state_after(run, n, left)
    q, qd = out.reshape(2, *times.shape, nq)
    return q, qd


def parts(times: Array, t0: float, h: float, most: int = 2**60) -> tuple[Array, Array]:
    """Split times into a number of whole steps from t0 and a remaining time, both (n,).

    times: (n,), s. t0: start of the run, s. h: step size, s. most: largest number of steps, such as
    the number of steps of the run. The remaining time is in s.
    """
    steps = (times - t0) / h
    near = _STEP_TOLERANCE + 4 * np.finfo(float).eps * steps  # times are rounded
    whole = np.minimum((steps + near).astype(int), most)
    return whole, np.where(steps - whole < near, 0.0, times - (t0 + whole * h))


def _state_after(run: Trajectory, n: int, rest: float) -> Any:
    """Return the state `rest` seconds after step n."""
    model, row = run.model, min(n // run.every, len(run) - 1)
    q, qd, first = run.q[row], run.qd[row], row * run.every
    for k in range(first, n):
        q, qd = model.integrator.step(
            q, qd, run.h, *_time_and_inputs(run, k), run.parameter_values, run.method
        )
    if rest > 0:
        q, qd = model.integrator.step(
            q, qd, rest, *_time_and_inputs(run, n), run.parameter_values, run.method
        )
    return q, qd


def _time_and_inputs(run: Trajectory, n: int) -> tuple[float, Any]:
    """Return the time of step n and its inputs."""
    t, u = run.t0 + n * run.h, run.input_source
    if u is None or (not callable(u) and not isinstance(u, str) and u.ndim == 1):
        return t, u
    if not callable(u) and not isinstance(u, str):
        return t, u[min(n, len(u) - 1)]
    if run.applied_inputs is None or run.every > 1:
        raise ValueError(
            "u was a function, and its values between rows are not stored: take every=1"
        )
    return t, run.applied_inputs[n]


def infinite_at_start(run: Trajectory) -> str:
    """Return a sentence that names the quantity that is not finite at the initial state of a run.

    The quantity is the potential energy, the kinetic energy or an acceleration. Return "" if all
    accelerations are finite there or cannot be computed, or if the run made a step.
    """
    if run.status != "not finite" or run.steps or not len(run):
        return ""
    model, q, qd, inputs = run.model, run.q[0], run.qd[0], run.input_source
    at: dict[str, Any] = {"t": run.t0, "params": run.parameter_values}
    try:
        model.functions.acceleration(
            q, qd, u=None if inputs is None or not model.info.nu else run.u[0], **at
        )
        return ""
    except MotionError as lacking:
        if lacking.status != "not finite":
            return ""
    except ValueError:  # the inputs of a saved run are unknown
        return ""
    what = "an acceleration"
    if not np.isfinite(model.functions.potential_energy(q, **at)):
        what = "the potential energy"
    elif not np.isfinite(model.functions.kinetic_energy(q, qd, **at)):
        what = "the kinetic energy"
    return f"{what} is not finite at the start: start elsewhere"
