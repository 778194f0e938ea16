"""D, C, g, accelerations and other functions of a state: values and accepted arguments."""

from __future__ import annotations

import math
from inspect import signature
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import EVERYTHING
from support.trajectories import QD, Q, runs_are_equal

from eomc.emit.package import FUNCTIONS, OPTIONAL
from eomc.model.system import System
from eomc.runtime.batch import Batch
from eomc.runtime.constraints import Constraints
from eomc.runtime.frames import Frames
from eomc.runtime.functions import Functions
from eomc.runtime.integrator import Integrator
from eomc.runtime.package import CONSTRAINED
from eomc.runtime.statics import Statics
from eomc.verify.taylor import TaylorReference


def test_values_equal_the_textbook(cartpole: ModuleType) -> None:
    """D = [[4, -2 c], [-2 c, 8/3]], C = [[0, 2 s theta'], [0, 0]], g = [0, -2 * 9.8 s]."""
    c, s = math.cos(Q[1]), math.sin(Q[1])
    D, C = [[4, -2 * c], [-2 * c, 8 / 3]], [[0, 2 * s * QD[1]], [0, 0]]
    tolerance = {"rtol": 1e-14, "atol": 1e-15}
    np.testing.assert_allclose(cartpole.D(Q), D, **tolerance)
    np.testing.assert_allclose(cartpole.C(Q, QD), C, **tolerance)
    np.testing.assert_allclose(cartpole.g(Q), [0, -2 * 9.8 * s], **tolerance)
    np.testing.assert_allclose(cartpole.bias(Q, QD), C @ np.array(QD) + cartpole.g(Q), **tolerance)
    np.testing.assert_allclose(cartpole.tau(Q, QD), [0, 0])
    qdd = np.linalg.solve(D, -cartpole.bias(Q, QD))
    np.testing.assert_allclose(cartpole.acceleration(Q, QD), qdd, **tolerance)
    K, P = 0.5 * np.array(QD) @ D @ QD, 2 * 9.8 * c
    assert cartpole.kinetic_energy(Q, QD) == pytest.approx(K, rel=1e-14)
    assert cartpole.potential_energy(Q) == pytest.approx(P, rel=1e-14)
    assert cartpole.energy(Q, QD) == pytest.approx(K + P, rel=1e-14)
    assert cartpole.jacobi(Q, QD) == cartpole.energy(Q, QD)
    assert cartpole.power(Q, QD) == 0


def test_time_inputs_and_parameters_are_positional_in_this_order() -> None:
    """In all functions of a state, they follow the state and the function's own arguments."""
    names_checked = []
    parts = (Functions, Frames, Constraints, Statics, Integrator, Batch)
    methods = {name: method for part in parts for name, method in vars(part).items()}
    names_of_parts = [name for names in FUNCTIONS.values() for name in names]
    optional = [name for names in OPTIONAL.values() for name in names]
    for name in [*names_of_parts, "step_batch", *CONSTRAINED, "reactions", *optional]:
        parameters = list(signature(methods[name]).parameters.values())
        names = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
        if "t" in [p.name for p in parameters] and name not in ("rhs", "step_batch"):
            names_checked.append(name)
            order = [n for n in names if n in ("q", "qd", "qdd", "t", "u", "params", "method")]
            assert order == sorted(order, key="q qd qdd t u params method".split().index), name
            assert {"q", "t", "params"} <= {*order}, name
    assert len(names_checked) > 25


def test_positional_arguments_equal_named_ones(everything: ModuleType) -> None:
    q, qd, t, p = [0.2, -0.5, 0.4], [0.3, 0.6, -0.2], 1.7, {"m": 2.5}
    assert np.array_equal(everything.D(q, t, p), everything.D(q, t=t, params=p))
    assert np.array_equal(everything.bias(q, qd, t, p), everything.bias(q, qd, t=t, params=p))
    assert everything.energy(q, qd, t, p) == everything.energy(q, qd, t=t, params=p)


def test_values_agree_with_the_reference(everything: ModuleType) -> None:
    reference = TaylorReference(everything_system())
    q, qd, t, u = [0.2, -0.5, 0.4], [0.3, 0.6, -0.2], 1.7, [0.5, -0.25]
    params = {"m": 2.5, "values": 0.9, "h": 0.1}
    names = {"kinetic_energy": "kinetic", "potential_energy": "potential"}
    for name in ("D", "g", "potential_energy", "C", "bias", "kinetic_energy", "energy", "jacobi"):
        state = (q,) if name in ("D", "g", "potential_energy") else (q, qd)
        value = getattr(everything, name)(*state, t=t, params=params)
        expected = reference.evaluate(names.get(name, name), q, qd, t, None, params)
        np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-13, err_msg=name)
    for inputs in (None, u):
        for name in ("tau", "power"):
            value = getattr(everything, name)(q, qd, t, inputs, params)
            expected = reference.evaluate(name, q, qd, t, inputs, params)
            np.testing.assert_allclose(value, expected, rtol=1e-12, err_msg=name)
        np.testing.assert_allclose(
            everything.acceleration(q, qd, t, inputs, params),
            reference.acceleration(q, qd, t, inputs, params),
            rtol=1e-12,
        )
    signals = reference.evaluate("signals", q, qd, t)
    np.testing.assert_allclose(everything.signal(q, qd, t), signals, rtol=1e-14, atol=0)


def everything_system() -> System:
    from eomc.model.system import from_scene
    from eomc.scene.read import parse

    return from_scene(parse(EVERYTHING, "everything.toml"))


@pytest.mark.parametrize(
    "name",
    "D C g bias tau kinetic_energy potential_energy energy jacobi power acceleration".split(),
)
def test_many_states_equal_single_states(driven: ModuleType, name: str) -> None:
    random = np.random.default_rng(2)
    q, qd = random.normal(size=(2, 7, 2))
    function = getattr(driven, name)

    def value(k: Any) -> Any:
        return function(*((q[k],) if name in ("D", "g", "potential_energy") else (q[k], qd[k])))

    values = value(slice(None))
    assert np.array_equal(values, np.array([value(k) for k in range(7)]))
    assert values.shape[0] == 7
    assert value(slice(0)).shape == (0, *values.shape[1:])


@pytest.mark.parametrize(
    "values",
    [
        (1, 2),
        [1, np.float32(2)],
        np.array([1, 2]),
        np.array([1, 2], np.float32),
        np.array([1, 2], np.uint8),
        np.array([1.0, 9, 2, 9])[::2],
        np.array([2.0, 1.0])[::-1],
        np.array([1, 2], dtype=object),
        np.array([1.0, 2.0], ">f8"),
        np.ma.array([1.0, 2.0], mask=False),
    ],
)
def test_array_like_arguments_are_accepted(cartpole: ModuleType, values: Any) -> None:
    assert np.array_equal(cartpole.D(values), cartpole.D(np.array([1.0, 2.0])))
    run, expected = (cartpole.simulate(x, x, steps=3) for x in (values, np.array([1.0, 2.0])))
    assert runs_are_equal(run, expected)


def test_numbers_whose_sum_overflows_are_finite(cartpole: ModuleType) -> None:
    large = np.array([1e308, 1e308])
    assert np.isfinite(cartpole.D(large)).all()
    assert cartpole.simulate(large, steps=0).q.tolist() == [large.tolist()]
    with pytest.raises(ValueError, match=r"q: .*inf.* is not finite"):
        cartpole.D([math.inf, -math.inf])


def test_views_of_a_larger_array_are_accepted(cartpole: ModuleType) -> None:
    wide = np.random.default_rng(3).normal(size=(5, 4))
    q, qd = wide[:, :2], wide[:, 2:]  # not contiguous
    assert np.array_equal(cartpole.bias(q, qd), cartpole.bias(q.copy(), qd.copy()))
    assert np.array_equal(cartpole.D(q.copy("F")), cartpole.D(q.copy("C")))


def test_arguments_are_never_modified(driven: ModuleType) -> None:
    q, qd, u = np.array(Q), np.array(QD), np.ones((4, 1))
    params = driven.Params(l=1.5)
    for array in (q, qd, u):
        array.flags.writeable = False
    driven.step(q, qd, params=params)
    driven.acceleration(q, qd, params=params)
    driven.simulate(q, qd, steps=4, u=u, params=params)
    assert (q.tolist(), qd.tolist(), params.l) == (Q, QD, 1.5)


def test_out_is_written_and_returned(cartpole: ModuleType) -> None:
    D, a = np.empty((2, 2)), np.empty(2)
    assert cartpole.D(Q, out=D) is D
    assert np.array_equal(D, cartpole.D(Q))
    assert cartpole.acceleration(Q, QD, out=a) is a
    assert np.array_equal(a, cartpole.acceleration(Q, QD))
    q, qd = np.array(Q), np.array(QD)
    end_state = cartpole.step(q, qd, out=(q, qd))  # in place
    assert end_state[0] is q
    assert np.array_equal(end_state, cartpole.step(Q, QD))
    rows = np.empty((6, 2)), np.empty((6, 2))
    run = cartpole.simulate(steps=5, out=rows)
    assert np.shares_memory(run.q, rows[0])
    assert np.array_equal(rows[1], cartpole.simulate(steps=5).qd)


@pytest.mark.parametrize("params", [{"m_c": 3, "g": 1.5}, [3, 2, 2, 1.5], "Params"])
def test_parameters_by_name_in_order_or_as_params(cartpole: ModuleType, params: Any) -> None:
    if params == "Params":
        params = cartpole.Params(m_c=3, g=1.5)
    assert cartpole.D(Q, params=params)[0, 0] == 5
    assert cartpole.g(Q, params=params)[1] == pytest.approx(-2 * 1.5 * math.sin(Q[1]))
    run = cartpole.simulate(Q, QD, steps=1, params=params)
    assert np.array_equal(cartpole.step(Q, QD, params=params), (run.q[-1], run.qd[-1]))
    assert run.energy[0] == cartpole.energy(Q, QD, params=params)
    assert cartpole.D(Q)[0, 0] == 4  # defaults are unchanged


def test_inputs_default_to_the_signals(driven: ModuleType) -> None:
    assert driven.signal(Q, QD, 2.0) == pytest.approx([0.01 * math.sin(2)], rel=1e-15)
    assert driven.tau(Q, QD, 2.0) == pytest.approx([0.01 * math.sin(2), 0], rel=1e-15)
    assert driven.tau(Q, QD, 2.0, u=7).tolist() == [7, 0]
    assert driven.tau(Q, QD, u=[7]).tolist() == [7, 0]
    assert driven.power(Q, QD, u=7) == pytest.approx(7 * QD[0])
