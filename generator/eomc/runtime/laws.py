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
    """Call u(t, q, qd) and check its result; the note of an exception gives the time and state."""
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
    """Warn, once, that a function as u is slow."""
    if "u" not in model._warned:
        model._warned.add("u")
        warn(
            f"{model.name}: u is a Python function, called before each step: some hundred times "
            "slower than a table (steps, nu) or the scene's own signal"
        )


class FeedbackLaw:
    """A function u(t, q, qd) that a run calls every `hold` steps, with its values at the rows."""

    def __init__(
        self, law: Callable[..., Any], inputs: Callable[[Any], Any], every: int, hold: int
    ) -> None:
        self.law, self.inputs, self.every, self.hold = law, inputs, every, hold
        self.calls, self.values = 0, list[Array]()
        self.last: Any = None

    def __call__(self, t: float, q: Array, qd: Array) -> Array:
        """Evaluate the function at the start of a control period."""
        self.last = evaluate_law(self.law, self.inputs, t, q, qd)
        self.calls += 1
        rows = -(-self.calls * self.hold // self.every)  # of the run before the next call
        self.values += [self.last.copy()] * (rows - len(self.values))
        return self.last  # type: ignore[no-any-return]

    def rows(self, count: int, width: int) -> Array:
        """Return the inputs applied from each row of the run on, (count, width)."""
        last = np.full(width, np.nan) if self.last is None else self.last
        return np.array([*self.values, last][:count], last.dtype)


class SampledSignal:
    """The scene's signals as a feedback law, for a zero-order hold over control periods."""

    def __init__(self, model: Functions, params: Any) -> None:
        self.model, self.params = model, params

    def __call__(self, t: float, q: Array, qd: Array) -> Array:
        """Evaluate the signals at a state."""
        values: Array = self.model.signal(q, qd, t, self.params)
        return values
