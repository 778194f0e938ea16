"""Inputs that are functions of the time and the state, called from a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .arguments import Array
from .functions import Functions
from .metadata import ModelInfo
from .package import warn


def evaluate_law(
    law: Callable[..., Any], inputs: Callable[[Any], Any], t: float, q: Array, qd: Array
) -> Array:
    """Call a user's function law(t, q, qd) and return the inputs (nu,) that it computes.

    inputs: function that checks the returned value and converts it to an array. t: time, s. q, qd:
    state (nq,). An exception in the law gets a note with the time and the state. An invalid result
    raises ValueError or TypeError.
    """
    try:
        try:
            returned = law(t, q.copy(), qd.copy())
        except TypeError as fault:
            if fault.__traceback__ and fault.__traceback__.tb_next:  # raised inside the function
                raise
            raise TypeError(f"u: is called as u(t, q, qd), and {fault}") from None
        try:
            inputs_array = inputs(returned)
        except ValueError as fault:
            wrong = str(fault).removeprefix("u: ")
            raise ValueError(f"u: what the function returned: {wrong}") from None
    except Exception as fault:
        fault.add_note(f"u was asked at t = {t:.9g} s, q = {q}, qd = {qd}")
        raise
    if inputs_array is None:
        raise ValueError("u: the function returned None, not the inputs")
    return np.array(inputs_array)


def warn_called_each_step(model: ModelInfo) -> None:
    """Issue a warning, once for each model, that calling a Python function in each step is slow."""
    if "u" not in model._warned:
        model._warned.add("u")
        warn(
            f"{model.name}: u is a Python function, called before each step: some hundred times "
            "slower than a table (steps, nu) or the scene's own signal"
        )


class FeedbackLaw:
    """A user's function u(t, q, qd) that a run by fixed steps calls once in each control period.

    The inputs that apply at each row of the run are stored. law: the function. inputs: function
    that converts and checks its result. every: number of steps between two rows. hold: number of
    steps of a control period.
    """

    def __init__(
        self, law: Callable[..., Any], inputs: Callable[[Any], Any], every: int, hold: int
    ) -> None:
        self.law, self.inputs, self.every, self.hold = law, inputs, every, hold
        self.calls, self.values = 0, list[Array]()
        self.last: Any = None

    def __call__(self, t: float, q: Array, qd: Array) -> Array:
        """Return, and store, the inputs (nu,) of the control period that begins at time t, s."""
        self.last = evaluate_law(self.law, self.inputs, t, q, qd)
        self.calls += 1
        rows = -(-self.calls * self.hold // self.every)  # of the run before the next call
        self.values += [self.last.copy()] * (rows - len(self.values))
        return self.last  # type: ignore[no-any-return]

    def rows(self, count: int, width: int) -> Array:
        """Return the stored inputs that apply from each row of the run on, (count, width).

        count: number of rows. width: number of inputs. Values are nan if the function has not been
        called.
        """
        last = np.full(width, np.nan) if self.last is None else self.last
        return np.array([*self.values, last][:count], last.dtype)


class SampledSignal:
    """The scene's input signals as a function u(t, q, qd).

    A run with a control period calls it once in each period and holds the result constant.
    """

    def __init__(self, model: Functions, params: Any) -> None:
        self.model, self.params = model, params

    def __call__(self, t: float, q: Array, qd: Array) -> Array:
        """Return the scene's signals (nu,) at time t, s, and state q, qd."""
        values: Array = self.model.signal(q, qd, t, self.params)
        return values
