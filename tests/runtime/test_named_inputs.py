"""Inputs by name, in all functions that take u."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
import sympy
from support import trajectories
from support.trajectories import QD, Q, runs_are_equal
from sympy.physics.mechanics import dynamicsymbols

from eomc.runtime.package import model_of

S, SD = [0.3, 0.4, 0.5], [0.2, -0.1, 0.3]


@pytest.mark.parametrize("name", ["acceleration", "tau", "power", "step"])
def test_functions_take_inputs_by_name(everything: ModuleType, name: str) -> None:
    """The order of the names is free."""
    call = getattr(everything, name)
    by_name = call(S, SD, t=0.3, u={"push": 2, "u": np.float64(0.7)})
    assert np.array_equal(by_name, call(S, SD, t=0.3, u=[0.7, 2.0]))
    assert not np.array_equal(by_name, call(S, SD, t=0.3, u=[2.0, 0.7]))


def test_run_takes_inputs_by_name(everything: ModuleType, driven: ModuleType) -> None:
    table = np.sin(np.arange(5.0))
    options: dict[str, Any] = {"steps": 5, "h": 0.01}
    by_name = {"u": 0.5, "push": table}
    as_table = np.column_stack([np.full(5, 0.5), table])
    assert runs_are_equal(
        everything.simulate(u=by_name, **options), everything.simulate(u=as_table, **options)
    )
    constant = everything.simulate(u={"push": 1, "u": 0.5}, **options)
    assert runs_are_equal(constant, everything.simulate(u=[0.5, 1.0], **options))
    by_law = everything.simulate(
        u=lambda t, q, qd: {"u": 0.5, "push": np.sin(round(100 * t))}, **options
    )
    assert runs_are_equal(by_law, everything.simulate(u=as_table, **options))
    assert everything.advice(h=1e3, u={"u": 0.5, "push": 1}) == everything.advice(
        h=1e3, u=[0.5, 1.0]
    )


@pytest.mark.parametrize("shape", [(), (3,), (3, 5), (1, 5)])
def test_batch_takes_inputs_by_name(shape: tuple[int, ...]) -> None:
    m = trajectories.module("cartpole_driven")
    force = np.random.default_rng(1).random(shape)
    q0 = np.tile(Q, (3, 1))
    by_name = m.simulate_batch(q0, steps=5, u={"force": force})
    assert by_name == m.simulate_batch(q0, steps=5, u=force[..., None])
    if len(shape) < 2:
        q, qd = q0.copy(), np.tile(QD, (3, 1))
        q_expected, qd_expected = q.copy(), qd.copy()
        m.step_batch(q, qd, u={"force": force})
        m.step_batch(
            q_expected, qd_expected, u=np.atleast_1d(force)[..., None] if shape else [force]
        )
        assert np.array_equal(q, q_expected) and np.array_equal(qd, qd_expected)


def test_symbols_of_sympy_are_names(driven: ModuleType) -> None:
    """Symbols name parameters and inputs, in runs and batches; dynamicsymbols work too."""
    m_c, force = sympy.Symbol("m_c", positive=True), dynamicsymbols("force")
    run = driven.simulate(params={m_c: 3.0}, u={force: 0.5}, steps=5)
    assert runs_are_equal(run, driven.simulate(params={"m_c": 3.0}, u={"force": 0.5}, steps=5))
    m, options = trajectories.module("cartpole_driven"), {"q0": [Q, Q], "steps": 5}
    by_symbol = m.simulate_batch(params={m_c: [2.0, 3.0]}, u={force: [0.5, 1.0]}, **options)
    assert by_symbol == m.simulate_batch(params={"m_c": [2, 3]}, u={"force": [0.5, 1.0]}, **options)
    with pytest.raises(ValueError, match="params: 'm_d' is not one of m_c"):
        driven.D(Q, params={sympy.Symbol("m_d"): 1.0})


def test_instances_and_tables_are_broadcast(everything: ModuleType) -> None:
    by_name = {"u": np.arange(3.0), "push": np.arange(12.0).reshape(3, 4)}
    inputs = model_of(everything).arguments.inputs_by_name(by_name)
    assert inputs.shape == (3, 4, 2) and inputs.flags.c_contiguous
    assert np.array_equal(inputs[..., 1], by_name["push"])
    assert np.array_equal(inputs[..., 0], np.repeat(np.arange(3.0), 4).reshape(3, 4))


@pytest.mark.parametrize(
    ("u", "message"),
    [
        ({"push": 1, "Push": 1, "u": 0}, r"u: 'Push' is not one of u, push; did you mean 'push'\?"),
        ({"pus": 1}, r"u: 'pus' is not one of u, push; did you mean 'push'\?"),
        ({"u": 1.0}, r"u: no value for push: give all inputs, or None for the signals"),
        ({}, r"u: no value for u, push"),
        ({"u": 1, "push": "much"}, r"u: push: 'much' is not an array of numbers"),
        ({"u": np.zeros(3), "push": np.zeros(2)}, r"u: u has shape \(3,\), push has shape \(2,\)"),
        ({"u": 1, "push": np.nan}, r"u: .*nan.* is not finite"),
    ],
)
def test_invalid_input_is_named(everything: ModuleType, u: Any, message: str) -> None:
    for call in (
        lambda: everything.acceleration(S, SD, u=u),
        lambda: everything.simulate(steps=2, u=u),
        lambda: everything.step(S, SD, u=u),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            call()


def test_table_by_name_has_one_row_per_step(everything: ModuleType) -> None:
    with pytest.raises(ValueError, match="u: 3 rows for 2 steps"):
        everything.simulate(steps=2, u={"u": 1.0, "push": np.zeros(3)})


def test_parameter_names_are_suggested(cartpole: ModuleType) -> None:
    with pytest.raises(ValueError, match=r"params: 'M_c' is not one of .*; did you mean 'm_c'\?"):
        cartpole.D(Q, params={"M_c": 1.0})
    with pytest.raises(AttributeError, match=r"'mc' .*; did you mean 'm_c'\?"):
        _ = cartpole.Params().mc
