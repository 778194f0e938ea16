"""Arguments that a compiled module refuses; the message names the argument."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.session import MODULES, Modules
from support.trajectories import QD, Q

from eomc.runtime.package import model_of

NAN = math.nan
MASKED = np.ma.array([0.3, 1.1], mask=[0, 1])
BAD_VALUES = [
    ("D", ([1],), {}, r"q: shape \(1,\), expected \(2,\) or \(n, 2\): x, theta"),
    ("D", ([[[1, 2]]],), {}, r"q: shape \(1, 1, 2\)"),
    ("D", (5,), {}, r"q: 5, expected \(2,\) or \(n, 2\): x, theta"),
    ("D", (None,), {}, r"q: None, expected \(2,\)"),
    ("step", ([1], QD), {}, r"q: shape \(1,\), expected \(2,\): x, theta$"),
    ("step", ([*Q, *QD], QD), {}, r"q: shape \(4,\), expected \(2,\): .*; velocities go to qd$"),
    ("step", (Q, QD), {"u": [1, 2]}, r"u: shape \(2,\), expected \(1,\): force$"),
    ("step", (Q, QD), {"u": abs}, r"u: .*: give what it returns, u\(t, q, qd\); runs alone"),
    ("step", (abs, QD), {}, r"q: <built-in function abs> is not an array of numbers$"),
    ("step", (Q, QD), {"method": np.array(["rk4", "dp8"])}, "method: array.* is not in this"),
    ("applied", ([[1, 2], [3]], QD), {}, r"q: .* is not an array of numbers"),
    ("equilibrium", (Q, [[1, 2], [3]]), {}, r"qd: .* is not an array of numbers"),
    ("equilibrium", (Q,), {"free": 3}, r"free: 3 is no list of names: x, theta, x_dot, theta_do"),
    ("D", (Q,), {"params": ["1", "2", "2", "9.8"]}, r"params: expected a dict, Params or 4 fin"),
    ("rhs", (0, {"x": 1}), {}, r"x: \{'x': 1\} is not an array of numbers"),
    ("D", (["a", "b"],), {}, r"q: .*not an array of numbers"),
    ("D", ([1 + 2j, 0],), {}, r"q: "),
    ("D", (np.array([1 + 2j, 0]),), {}, r"q: .*not an array of numbers"),
    ("D", ([[1, 2], [3]],), {}, r"q: "),
    ("D", ([1, NAN],), {}, r"q: .*nan.* is not finite"),
    ("D", ([1, math.inf],), {}, r"q: .*inf.* is not finite"),
    ("C", (Q, [1, 2, 3]), {}, r"qd: shape \(3,\)"),
    ("C", ([Q, Q], QD), {}, r"qd: shape \(2,\) with q of shape \(2, 2\)"),
    ("bias", (Q, [NAN, 0]), {}, r"qd: .*nan.* is not finite"),
    ("acceleration", (Q, None), {}, r"qd: "),
    ("step", (Q, None), {}, r"qd: "),
    ("step", ([Q, Q], [QD, QD]), {}, r"q: shape \(2, 2\), expected \(2,\)"),
    ("acceleration", (Q, QD), {"t": NAN}, r"t: nan is not a finite number"),
    ("acceleration", (Q, QD), {"t": "now"}, r"t: "),
    ("tau", (Q, QD), {"t": None}, r"t: "),
    ("acceleration", (Q, QD), {"u": [1, 2]}, r"u: shape \(2,\), expected \(1,\)"),
    ("acceleration", (Q, QD), {"u": [[1.0]]}, r"u: shape \(1, 1\), expected \(1,\)"),
    ("tau", (Q, QD), {"u": NAN}, r"u: .*nan.* is not finite"),
    ("D", (Q,), {"params": {"mc": 1}}, r"params: 'mc' is not one of m_c, m_p, l, g"),
    ("D", (Q,), {"params": {"m_c": NAN}}, r"params: m_c: nan is not a finite number"),
    ("D", (Q,), {"params": {"m_c": "two"}}, r"params: m_c"),
    ("D", (Q,), {"params": {"m_c": None}}, r"params: m_c"),
    ("D", (Q,), {"params": {"self": 1.0}}, r"params: 'self' is not one of"),
    ("D", (Q,), {"params": {1: 1.0}}, r"params: "),
    ("D", (Q,), {"params": [1, 2]}, r"params: expected .*4 finite numbers.*m_c, m_p, l, g"),
    ("D", (Q,), {"params": [1, 2, 3, NAN]}, r"params: expected .*finite"),
    ("D", (Q,), {"params": "heavy"}, r"params: "),
    ("D", (Q,), {"out": np.zeros(4)}, r"out: .*shape \(2, 2\)"),
    ("D", (Q,), {"out": np.zeros((2, 2), np.float32)}, r"out: .*float64"),
    ("D", (Q,), {"out": [[0, 0], [0, 0]]}, r"out: "),
    ("step", (Q, QD), {"out": 3}, r"out"),
    ("step", (Q, QD), {"out": (np.zeros(2),)}, r"out"),
    ("step", (Q, QD), {"out": (np.zeros(2), np.zeros(3))}, r"out.*shape \(2,\)"),
    ("step", (Q, QD), {"h": 0}, r"h: 0 is not a step size"),
    ("step", (Q, QD), {"h": -0.01}, r"h: -0.01 is not a step size: .*greater than 0"),
    ("step", (Q, QD), {"h": -1}, r"h: -1 is not a step size"),
    ("advice", (Q, QD), {"h": -0.01}, r"h: -0.01 is not a step size"),
    ("step", (Q, QD), {"h": NAN}, r"h: nan"),
    ("step", (Q, QD), {"h": "small"}, r"h: "),
    ("D", (MASKED,), {}, r"q: 1 of 2 numbers are masked: fill them in first, with .filled"),
    ("acceleration", ([MASKED.data] * 2, np.ma.array([QD] * 2, mask=True)), {}, r"qd: 4 of 4 num"),
    ("step", (Q, QD), {"u": np.ma.array([1.0], mask=True)}, r"u: 1 of 1 numbers are masked"),
    ("D", ([Q, Q],), {"t": MASKED}, r"t: 1 of 2 numbers are masked"),
    ("D", ([Q, Q],), {"t": [0.0]}, r"t: shape \(1,\), expected one number or \(2,\)"),
    (
        "D",
        (Q,),
        {"params": np.ma.array([2.0, 2, 2, 9.8], mask=[0, 0, 1, 0])},
        r"params: 1 of 4 num",
    ),
    ("acceleration", (Q, QD), {"out": MASKED.copy()}, r"out: 1 of 2 numbers are masked"),
    ("rhs", (0, np.ma.array([*Q, *QD], mask=[0, 0, 0, 1])), {}, r"x: 1 of 4 numbers are masked"),
    ("rhs", (0, [1, 2]), {}, r"x: shape \(2,\), expected \(4,\): q, then qd"),
    ("rhs", (0, None), {}, r"x: "),
    ("rhs", (0, 10**400), {}, r"x: 10+ is not an array of numbers"),
]


def identifier_or_none(value: Any) -> str | None:
    return value if isinstance(value, str) and value.isidentifier() else None


@pytest.mark.filterwarnings("ignore:.*Python function")
def test_feedback_law_with_wrong_signature_is_refused(
    driven: ModuleType,
) -> None:
    """Errors raised inside the law stay unchanged."""
    for law, reason in (
        (lambda t, q: [0.0], "takes 2 positional arguments but 3 were given"),
        (lambda t, q, qd, gain: [0.0], "missing 1 required positional argument: 'gain'"),
    ):
        with pytest.raises(TypeError, match=rf"^u: is called as u\(t, q, qd\), and .* {reason}"):
            driven.simulate(steps=2, u=law)
    with pytest.raises(TypeError, match=r"^unsupported operand"):
        driven.simulate(steps=2, u=lambda t, q, qd: [t + "x"])


@pytest.mark.parametrize("t", ["a", "0.001", [0.0, "a"], 1j, {}, [[0.0], [0.0, 0.0]]])
def test_invalid_times_of_a_run_are_refused(driven: ModuleType, t: Any) -> None:
    run = driven.simulate(steps=2)
    with pytest.raises(ValueError, match=f"^t: {re.escape(repr(t))} is not an array of numbers"):
        run(t)
    assert run(0.001)[0].shape == (2,) and run([0, 0.001])[0].shape == (2, 2)


@pytest.mark.parametrize(("name", "args", "options", "message"), BAD_VALUES, ids=identifier_or_none)
def test_invalid_argument_is_named(
    driven: ModuleType, name: str, args: Any, options: Any, message: str
) -> None:
    with pytest.raises(ValueError, match="(?s)^" + message):
        getattr(driven, name)(*args, **options)


BAD_RUNS = [
    ({"q0": [1]}, r"q0: shape \(1,\), expected \(2,\)"),
    (
        {"q0": [[1, 2]]},
        r"q0: shape \(1, 2\), expected one state, \(2,\).*simulate_batch takes many",
    ),
    ({"qd0": [NAN, 0]}, r"qd0: .*nan.* is not finite"),
    ({"q0": MASKED, "steps": 1}, r"q0: 1 of 2 numbers are masked: fill them in"),
    ({"u": np.ma.masked_less([0.0, 1.0], 0.5), "steps": 2}, r"u: 1 of 2 numbers are masked"),
    ({"u": lambda t, q, qd: MASKED[1:], "steps": 2}, r"u: what the function returned: 1 of 1"),
    ({"q0": [0, 1, 2, 3]}, r"q0: shape \(4,\), expected \(2,\): .*; velocities go to qd0$"),
    ({"progress": "x"}, r"progress: 'x' is not a function of steps done and in all"),
    ({"q0": [[1, 2], [3]]}, r"q0: \[\[1, 2\], \[3\]\] is not an array of numbers"),
    ({"h": 0}, r"h: 0 is not a step size: give a number of seconds greater than 0"),
    ({"h": -0.1}, r"h: -0.1 is not a step size: give a number of seconds greater than 0"),
    ({"h": math.inf}, r"h: inf"),
    ({"h": 10**400}, r"h: 1000.* is not a finite number"),
    ({"h": 1e-300, "duration": 1e300}, r"duration: 1e\+300 s are more steps .*take a larger h"),
    ({"h": 1e-300, "duration": 1}, r"duration: 1 s are more steps"),
    ({"steps": 10**30}, r"steps: 1e\+30 are more than a run can count"),
    ({"steps": 10**400}, r"steps: so many are more than a run can count"),
    ({"q0": [0.0, 10**400]}, r"q0: .*is not an array of numbers"),
    ({"params": [10**400, 1, 1, 1]}, r"params: expected"),
    ({"h": "a"}, r"h: "),
    ({"h": "0.1"}, r"h: '0.1' is not a number"),
    ({"duration": -1}, r"duration: -1 is not a time"),
    ({"duration": NAN}, r"duration: nan"),
    ({"duration": "long"}, r"duration: "),
    ({"steps": 1, "duration": 1}, r"steps: give steps or duration, not both"),
    ({"steps": -1}, r"steps: -1 is not a whole number, "),
    ({"steps": 1.5}, r"steps: 1.5 is not a whole number, "),
    ({"steps": NAN}, r"steps: nan"),
    ({"steps": "a"}, r"steps: "),
    ({"every": 0}, r"every: 0 is not a whole number, "),
    ({"every": -3}, r"every: -3"),
    ({"every": 2.5}, r"every: 2.5"),
    ({"every": NAN}, r"every: nan"),
    ({"every": None}, r"every: None"),
    ({"t0": NAN}, r"t0: nan is not a finite number"),
    ({"t0": "a"}, r"t0: "),
    ({"estimate": "no"}, r"estimate: 'no' is not True or False"),
    ({"method": "euler"}, r"method: 'euler' is not in this module"),
    ({"params": {"l": [1, 2]}}, r"params: l: \[1, 2\] is not a number: .*simulate_batch"),
    ({"u": {"force": len}}, r"u: force: .*: one function u\(t, q, qd\) gives all inputs"),
    ({"u": [len]}, r"u: \[.*: one function u\(t, q, qd\) gives all inputs"),
    ({"params": {"x": 1}}, r"params: 'x' is a coordinate: give it in q0"),
    ({"u": [1, 2, 3], "steps": 2}, r"u: 3 rows for 2 steps: give one row a step"),
    ({"u": np.ones((3, 2)), "steps": 3}, r"u: shape \(3, 2\), expected \(1,\) or \(n, 1\)"),
    ({"u": [1, NAN], "steps": 2}, r"u\[1, 0\]: nan in float64 is not finite"),
    ({"u": []}, r"u: "),
    ({"u": "push"}, r"u: .* not an array of numbers"),
    ({"out": 3}, r"out"),
    ({"out": (np.zeros((3, 2)),)}, r"out"),
    ({"out": (np.zeros((3, 2)), np.zeros((3, 2)))}, r"out\[0\]: .*shape \(2001, 2\)"),
]


# the messages are the ids: the repr of a function differs between processes
@pytest.mark.parametrize(("options", "message"), BAD_RUNS, ids=[message for _, message in BAD_RUNS])
def test_invalid_argument_of_a_run_is_named(driven: ModuleType, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match="(?s)^" + message):
        driven.simulate(**options)


@pytest.mark.parametrize(
    ("shared", "invalid", "message"),
    [
        ({"steps": 3}, {"q0": np.array([NAN, 0.0])}, "q0: .* is not finite"),
        ({"steps": 3}, {"qd0": np.array([0.0, math.inf])}, "qd0: .* is not finite"),
        ({"steps": 3}, {"q0": np.zeros((1, 2))}, "q0: shape"),
        ({"steps": 3}, {"u": np.array([NAN])}, "u: .* is not finite"),
        ({"steps": 3}, {"u": NAN}, "u: .* is not finite"),
        ({"steps": 3}, {"u": np.array([[0.0], [NAN], [0.0]])}, "u.*nan.* is not finite"),
        ({"steps": 3}, {"u": np.zeros((2, 1))}, "u: 2 rows for 3 steps"),
        ({"steps": 3}, {"params": np.full(4, NAN)}, "params: expected .*4 finite numbers"),
        ({"steps": 3}, {"params": {"m_c": NAN}}, "m_c: nan is not a finite number"),
        ({"steps": 3}, {"t0": NAN}, "t0: nan is not a finite number"),
        ({"steps": 3}, {"t0": 1e17}, "h: .* is less than what time resolves"),
        ({"steps": 3}, {"stiff": 0}, "stiff: 0 is not True or False"),
        ({"steps": 3}, {"estimate": 0}, "estimate: 0 is not True or False"),
        ({"times": np.array([0.0, 0.1, 0.2])}, {"times": np.array([0.0, 0.2, 0.1])}, r"times\[2\]"),
        ({"times": np.array([0.0, 0.1])}, {"times": np.array([0.0, NAN])}, "row of finite numbers"),
        ({"times": np.array([0.0, 0.1])}, {"times": np.array([-0.1, 0.1])}, r"times\[0\] is -0.1"),
        ({"times": np.array([0.1]), "duration": 0.1}, {"times": np.array([0.2])}, "behind the end"),
        ({"times": np.array([0.1]), "duration": 0.1}, {"duration": 0.05}, "behind the end"),
        ({"times": np.array([0.1])}, {"steps": 5}, "steps: times say where rows are"),
        ({"duration": 0.1}, {"duration": -0.1}, "duration: -0.1 is not a time"),
        ({"duration": 0.1}, {"steps": 5}, "steps: give steps or duration"),
        ({"steps": 3}, {"method": "euler"}, "euler"),
    ],
)  # fmt: skip
def test_later_calls_are_checked_as_the_first(
    driven: ModuleType, shared: dict[str, Any], invalid: dict[str, Any], message: str
) -> None:
    """The steps of the first call are stored; those of later calls need no checks."""
    for _ in range(2):
        assert driven.simulate(**shared).status == "ok"
        with pytest.raises(ValueError, match=message):
            driven.simulate(**(shared | invalid))


def test_stored_steps_give_the_same_runs(driven: ModuleType) -> None:
    """Runs and requests are those of a call whose steps are not stored, bit by bit."""
    q0, qd0, u = np.array(Q), np.array(QD), np.array([[0.1], [0.2], [0.3]])
    plain_steps = model_of(driven).integrator.plain_steps
    for options in (
        {"steps": 3}, {"steps": 3, "every": 2}, {"steps": 3, "u": u}, {"steps": 3, "u": [0.5]},
        {"steps": 3, "u": 0.5}, {"steps": 3, "t0": 0.7}, {"steps": 3, "params": {"m_c": 3.0}},
        {"duration": 0.03}, {"times": np.array([0.0, 0.011, 0.02])}, {"steps": 0},
        {"times": np.array([0.0, 0.011, 0.02]), "duration": 0.03}, {"duration": np.float64(0.03)},
    ):  # fmt: skip
        plain_steps.clear()
        first = driven.simulate(list(Q), qd0, **options)
        later = driven.simulate(q0, qd0, **options)
        assert later == first and (later.t == first.t).all() and (later.u == first.u).all()
        for name, value in first.request.to_mapping().items():
            assert np.array_equal(getattr(later.request, name), value), name
        q0[0] = 9.0  # the run has copies
        assert later.request.q[0] == Q[0]
        q0[0] = Q[0]


@pytest.mark.parametrize("u", [1.0, [], lambda t, q, qd: 0.0])
def test_inputs_are_refused_by_a_scene_without_inputs(cartpole: ModuleType, u: Any) -> None:
    for call in (cartpole.tau, cartpole.acceleration, cartpole.step):
        with pytest.raises(ValueError, match=r"^u: this scene has no inputs"):
            call(Q, QD, u=u)
    with pytest.raises(ValueError, match=r"^u: this scene has no inputs"):
        cartpole.simulate(u=u)


def test_params_are_refused_by_a_scene_without_parameters(modules: Modules) -> None:
    text = 'eomc = 1\nname = "bare"\n[coordinates]\nx = { start = 1 }\n[energy]\n'
    m: Any = modules.unoptimised(text + 'kinetic = "x_dot**2"\n[run]\nbatch = true\n')
    for simulate in (m.simulate, m.simulate_batch):
        with pytest.raises(ValueError, match=r"^params: there is no 'm': this scene has none$"):
            simulate(steps=1, params={"m": 1})
        with pytest.raises(ValueError, match=r"^params: this scene has no parameters$"):
            simulate(steps=1, params=[1, 2])


def test_params_of_another_scene_are_refused(cartpole: ModuleType, modules: Modules) -> None:
    with pytest.raises(ValueError, match=r"^params: these are another scene's: m, l, g"):
        cartpole.D(Q, params=modules("simple_pendulum").Params())


def test_missing_velocities_are_refused() -> None:
    """Run in a separate process: a null pointer would crash this one."""
    calls = "\n".join(
        f"try: m.{name}([0.0, 1.0], None)\n"
        "except ValueError as e: assert str(e).startswith('qd:')\n"
        f"else: raise SystemExit('{name} took None')"
        for name in ("C", "bias", "tau", "kinetic_energy", "energy", "jacobi", "power", "signal")
    )
    code = f"import eomc\nm = eomc.load({str(SCENES / 'cartpole_driven.toml')!r}, {str(MODULES)!r})"
    process = subprocess.run(
        [sys.executable, "-c", f"{code}\n{calls}"], capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr or f"ended by signal {-process.returncode}"


def test_too_many_rows_are_refused_before_the_run(cartpole: ModuleType) -> None:
    with pytest.raises(MemoryError, match=r"rows of 4 numbers don't fit in memory.*every="):
        cartpole.simulate(steps=10**15)


def test_partially_imported_numpy_ma_is_tolerated(
    driven: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another thread may be importing it: NumPy imports it on first use."""
    monkeypatch.setitem(sys.modules, "numpy.ma", ModuleType("numpy.ma"))
    assert driven.D(np.array(Q)).shape == (2, 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tols": 1e-9}, "simulate has no argument 'tols'; did you mean 'tol'?"),
        ({"tolerance": 1e-9}, "simulate has no argument 'tolerance'; did you mean 'tol'?"),
        ({"t": 10}, "simulate has no argument 't'; did you mean 'duration'?"),
        ({"step": 0.01, "steps": 3}, "simulate has no argument 'step'; did you mean 'h'?"),
        ({"Duration": 1.0}, "simulate has no argument 'Duration'; did you mean 'duration'?"),
        ({"g": 1.6}, "simulate has no argument 'g': write params={'g': ...}"),
        ({"force": 1.0}, "simulate has no argument 'force': write u={'force': ...}"),
        ({"zzz": 1, "events": {"a": "x"}}, "'zzz': it has q0, qd0, h, "),
    ],
)
def test_unknown_argument_is_refused_with_a_suggestion(
    driven: ModuleType, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(TypeError, match=re.escape(message)):
        driven.simulate(**options)


def test_memory_of_checked_steps_is_limited(cartpole: ModuleType) -> None:
    for k in range(300):
        cartpole.simulate(steps=5, h=0.001 + 1e-6 * k)
    assert 0 < len(model_of(cartpole).integrator.plain_steps) <= 256
