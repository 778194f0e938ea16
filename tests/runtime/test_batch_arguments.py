"""Arguments that a batch refuses, by name."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from batches import STEPS, module, starts


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("real", ["double", "float"])
def test_starts_that_are_not_finite_are_refused_before_any_moves(real: str, threads: int) -> None:
    """Wherever they are; nobody waits for the others' hours first."""
    m = module("cartpole", real=f'"{real}"')
    calls: list[int] = []
    for name, (row, column), number in (
        ("q0", (7, 1), np.nan), ("qd0", (19_999, 0), np.inf), ("q0", (12_000, 0), -np.inf),
        *([("qd0", (3, 1), 1e300)] if real == "float" else []),  # no float is that large
    ):  # fmt: skip
        given = dict(zip(("q0", "qd0"), starts(m, 20_000), strict=True))
        given[name][row, column] = number
        for order in ("C", "F"):
            given[name] = np.array(given[name], order=order)  # type: ignore[call-overload]
            with pytest.raises(ValueError, match=rf"^{name}\[{row}, {column}\]: .* is not finite"):
                m.simulate_batch(
                    **given,
                    steps=STEPS,
                    threads=threads,
                    progress=lambda done, _: calls.append(done),
                )
    assert not calls


def test_tables_that_do_not_fit_are_refused_by_name() -> None:
    """C would read on behind them, or compute with what is no number."""
    m = module("cartpole_driven")
    (q0, qd0), nan = starts(m, 5), np.nan
    wrong = np.tile(list(m.defaults.values()), (5, 1))
    wrong[3, 1] = nan
    tries = {
        "qd: 4 instances where q has 5": lambda: m.step_batch(q0, qd0[:4].copy()),
        "params: 3 instances where": lambda: m.step_batch(q0, qd0, params={"l": np.ones(3)}),
        "u: 4 instances where q has 5": lambda: m.step_batch(q0, qd0, u=np.zeros((4, 1))),
        "params: not all numbers are": lambda: m.step_batch(q0, qd0, params=wrong),
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
    for words, call in tries.items():
        with pytest.raises(ValueError, match=re.escape(words)):
            call()


@pytest.mark.parametrize(
    ("given", "named"),
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
def test_wrong_arguments_are_named(given: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=re.escape(named)):
        module("cartpole").simulate_batch(steps=2, **given)


def test_masked_numbers_are_refused_by_name() -> None:
    """They have no value; where nothing is masked, a masked array is as good as any."""
    many = module("cartpole")
    q, qd = (np.tile(x, (2, 1)) for x in many.start)
    masked = np.ma.array(q, mask=[[0, 1], [0, 0]])
    tries = {
        "q0": lambda: many.simulate_batch(masked, qd, steps=1),
        "q": lambda: many.step_batch(masked, qd),
        "qd": lambda: many.step_batch(q, masked, out=(q.copy(), qd.copy())),
        "params: m_c": lambda: many.step_batch(
            q, qd, params={"m_c": np.ma.array([1.0, 2.0], mask=[0, 1])}
        ),
        "params": lambda: many.step_batch(q, qd, params=np.ma.array(np.ones((2, 4)), mask=True)),
    }
    for name, call in tries.items():
        with pytest.raises(ValueError, match=rf"^{name}: \d of \d numbers are masked"):
            call()
    plain = many.simulate_batch(np.ma.array(q), qd, steps=3)
    assert np.array_equal(plain.q, many.simulate_batch(q, qd, steps=3).q)


def test_an_argument_that_is_not_there_is_told_with_what_is_meant() -> None:
    with pytest.raises(TypeError, match=r"^simulate_batch has no argument 'thread'.*'threads'\?$"):
        module("cartpole").simulate_batch(thread=2, steps=3)
