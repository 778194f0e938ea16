"""Arguments that a batch refuses; the message names the argument."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from support.trajectories import STEPS, module, starts


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("real", ["double", "float"])
def test_starts_that_are_not_finite_are_refused_before_any_step(real: str, threads: int) -> None:
    """Wherever they are in the batch: no instance is simulated before the check."""
    m = module("cartpole", real=f'"{real}"')
    calls: list[int] = []
    for name, (row, column), value in (
        ("q0", (7, 1), np.nan), ("qd0", (19_999, 0), np.inf), ("q0", (12_000, 0), -np.inf),
        *([("qd0", (3, 1), 1e300)] if real == "float" else []),  # beyond the range of floats
    ):  # fmt: skip
        starts_by_name = dict(zip(("q0", "qd0"), starts(m, 20_000), strict=True))
        starts_by_name[name][row, column] = value
        for order in ("C", "F"):
            starts_by_name[name] = np.array(starts_by_name[name], order=order)  # type: ignore[call-overload]
            with pytest.raises(ValueError, match=rf"^{name}\[{row}, {column}\]: .* is not finite"):
                m.simulate_batch(
                    **starts_by_name,
                    steps=STEPS,
                    threads=threads,
                    progress=lambda finished, _: calls.append(finished),
                )
    assert not calls


def test_tables_of_wrong_shape_are_refused_by_name() -> None:
    """C would read beyond their end, or compute with values that are not numbers."""
    m = module("cartpole_driven")
    (q0, qd0), nan = starts(m, 5), np.nan
    invalid = np.tile(list(m.defaults.values()), (5, 1))
    invalid[3, 1] = nan
    calls = {
        "qd: 4 instances where q has 5": lambda: m.step_batch(q0, qd0[:4].copy()),
        "params: 3 instances where": lambda: m.step_batch(q0, qd0, params={"l": np.ones(3)}),
        "u: 4 instances where q has 5": lambda: m.step_batch(q0, qd0, u=np.zeros((4, 1))),
        "params: not all numbers are": lambda: m.step_batch(q0, qd0, params=invalid),
        "u: not all numbers are finite": lambda: m.step_batch(q0, qd0, u=[nan]),
        "u: 'push' is not an array of": lambda: m.step_batch(q0, qd0, u="push"),
        "u: 'Force' is not one of force; did you": lambda: m.step_batch(q0, qd0, u={"Force": 1}),
        "step all instances by step_batch in a loop": lambda: m.simulate_batch(
            q0, qd0, u=lambda t, q, qd: [0.0]
        ),
        "u: 20 instances where q0 has 5: a table over time": lambda: m.simulate_batch(
            q0, qd0, steps=20, u=np.zeros((20, 1))
        ),
        "q: an array of float32, shape (5, 2); moved in place": lambda: m.step_batch(
            q0.astype(np.float32), qd0
        ),
        "qd: an array of float64, shape (5, 2), not C-contiguous; moved": lambda: m.step_batch(
            q0, np.asfortranarray(qd0)
        ),
        "q: an array of float64, shape (2,); moved in place, it has": lambda: m.step_batch(
            q0[0], qd0[0]
        ),
        "q: a list; moved in place": lambda: m.step_batch(q0.tolist(), qd0),
        "qd: lies in the memory of q": lambda: m.step_batch(q0[:4], q0[1:]),
        "lies in the memory of q, where": lambda: m.step_batch(q0, q0),
        "u: shape (5, 3, 1), expected": lambda: m.simulate_batch(
            q0, qd0, steps=4, u=np.zeros((5, 3, 1))
        ),
    }
    for message, call in calls.items():
        with pytest.raises(ValueError, match=re.escape(message)):
            call()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"params": {"mass": [1.0, 2.0]}}, "params: 'mass'"),
        ({"params": {"m_c": [1.0, float("nan")]}}, "params: m_c"),
        ({"u": [1.0]}, "u: this scene has no inputs"),
        ({"q0": np.zeros((2, 3))}, "q0"),
        ({"q0": np.zeros((3, 2)), "params": {"m_c": [1.0, 2.0]}}, "params: 2 instances"),
        ({"q0": np.zeros((0, 2)), "qd0": np.zeros((0, 2))}, "q0: no instances"),
        ({"q0": np.zeros((3, 2)), "qd0": np.zeros((4, 2))}, "qd0: 4 instances where q0 has 3"),
        ({"params": {"m_c": "1"}}, "params: m_c: '1' is not an array of numbers"),
        ({"params": [{"m_c": 1}] * 2}, 'params: give one dict of arrays, {"m": [1, 2]}'),
        ({"every": 0}, "every"),
        ({"threads": 0}, "threads: 0 is not a whole number, 1 or more"),
        ({"threads": 1.5}, "threads: 1.5 is not"),
        ({"progress": 3}, "progress: 3 is not a function"),
        ({"method": "euler"}, "method"),
    ],
)
def test_invalid_arguments_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        module("cartpole").simulate_batch(steps=2, **options)


def test_masked_numbers_are_refused_by_name() -> None:
    """Masked numbers have no value; a masked array without masked numbers is accepted."""
    cartpole = module("cartpole")
    q, qd = (np.tile(x, (2, 1)) for x in cartpole.start)
    masked = np.ma.array(q, mask=[[0, 1], [0, 0]])
    calls = {
        "q0": lambda: cartpole.simulate_batch(masked, qd, steps=1),
        "q": lambda: cartpole.step_batch(masked, qd),
        "qd": lambda: cartpole.step_batch(q, masked, out=(q.copy(), qd.copy())),
        "params: m_c": lambda: cartpole.step_batch(
            q, qd, params={"m_c": np.ma.array([1.0, 2.0], mask=[0, 1])}
        ),
        "params": lambda: cartpole.step_batch(
            q, qd, params=np.ma.array(np.ones((2, 4)), mask=True)
        ),
    }
    for name, call in calls.items():
        with pytest.raises(ValueError, match=rf"^{name}: \d of \d numbers are masked"):
            call()
    unmasked = cartpole.simulate_batch(np.ma.array(q), qd, steps=3)
    assert np.array_equal(unmasked.q, cartpole.simulate_batch(q, qd, steps=3).q)


def test_unknown_argument_is_refused_with_a_suggestion() -> None:
    with pytest.raises(TypeError, match=r"^simulate_batch has no argument 'thread'.*'threads'\?$"):
        module("cartpole").simulate_batch(thread=2, steps=3)
