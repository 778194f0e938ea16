"""Compare FMUs in an importer, of both versions and both kinds, with the scene's module.

Co-simulation agrees bitwise with the portable form, from which its binary is compiled.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.fmus import BALL, FLOAT, RIG, VERSIONS, Host, exported, needs_fmpy, plain, rows
from support.session import tiers

from eomc.model.system import from_scene
from eomc.scene.read import parse

KINDS = ("CoSimulation", "ModelExchange")
FALLS = BALL.replace('"x - wall', '"x - 100*wall')  # the wall is too far to be hit
FEEDBACK = FLOAT.replace("[run]", "[run]\nlinearize = true")
BLOWS_UP = """
eomc = 1
name = "blows_up"
[coordinates]
x = { unit = "m", start = 1.0, rate = 1.0 }
[parameters]
m = 1.0
[energy]
kinetic = "m*x_dot**2/2"
potential = "-x**4"
[run]
h = 0.001
"""


@pytest.fixture(autouse=True)
def _fmpy() -> None:
    needs_fmpy()


def states(scene: str) -> list[str]:
    """Return the names of coordinates and velocities."""
    if "\n" not in scene:
        scene = (SCENES / f"{scene}.toml").read_text(encoding="utf-8")
    names = [c.name for c in from_scene(parse(scene, "test.toml")).coordinates]
    return [*names, *(f"{n}_dot" for n in names)]


def states_of_run(run: Any) -> np.ndarray:
    """Return the rows of a run, [q, qd]."""
    return np.hstack([run.q, run.qd])


# both versions share the scene's functions; code that differs is tested for both in the quick tier
NAMED = ("fmi2", "fmi3")
both = pytest.mark.parametrize("version", VERSIONS, ids=NAMED)


@pytest.fixture(params=tiers(VERSIONS, 3), ids=NAMED)
def version(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def hosts() -> Iterator[list[Host]]:
    """Yield a list of instances, which are freed at the end."""
    instances: list[Host] = []
    yield instances
    for host in instances:
        host.free()


# constraints and multipliers, events and outputs, single precision; then cases that add little
SCENES_TESTED = [
    "four_bar", BALL, FLOAT, "cartpole", "cartpole_driven", "kapitza_pendulum", "cartpole_bodies",
]  # fmt: skip
IDS = [s if "\n" not in s else s.split('"')[1] for s in SCENES_TESTED]


@both
@pytest.mark.parametrize("scene", tiers(SCENES_TESTED, BALL, FLOAT), ids=IDS)
def test_fmu_is_valid(scene: str, version: int) -> None:
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(exported(scene, version))) == []


@both
@pytest.mark.parametrize(
    "scene",
    tiers(["cartpole", "kapitza_pendulum", "cartpole_bodies", "four_bar"], "cartpole", "four_bar"),
)
def test_whole_steps_agree_bitwise_with_the_module(
    scene: str, version: int, hosts: list[Host]
) -> None:
    module, names = plain(scene), states(scene)
    run = module.simulate(steps=60)
    host = Host(exported(scene, version))
    hosts.append(host)
    host.start()
    assert np.array_equal(rows(host, names, 3 * run.h, 20), states_of_run(run)[::3])
    (total,) = host.get("energy.total")
    assert total == pytest.approx(run.energy[-1], rel=1e-14, abs=1e-14)


def test_initial_state_with_constraints_is_assembled(version: int, hosts: list[Host]) -> None:
    """Fixed values of the scene are unchanged; guesses move as in a run of the module."""
    run = plain("four_bar").simulate(q0=[0.9, 0.4, 1.2], qd0=[3.0, 0, 0], steps=30)
    names = states("four_bar")
    host = Host(exported("four_bar", version))
    hosts.append(host)
    host.set_all(dict(zip(names, (0.9, 0.4, 1.2, 3.0, 0.0, 0.0), strict=True)))
    host.start()
    assert np.array_equal(rows(host, names, 3 * run.h, 10), states_of_run(run)[::3])


def test_inconsistent_initial_state_is_reported(version: int, hosts: list[Host]) -> None:
    host = Host(exported("four_bar", version))
    hosts.append(host)
    host.set(c=0.01)
    with pytest.raises(Exception, match="ExitInitializationMode"):
        host.start()
    assert any("no state near obeys the constraints" in text for _, text in host.said)


def test_model_exchange_with_constraints_is_refused(version: int) -> None:
    """An importer's integration would violate them; it is refused with a message."""
    from fmpy import read_model_description

    described = read_model_description(str(exported("four_bar", version)))
    assert described.modelExchange is None and described.coSimulation is not None


def test_other_communication_steps_end_with_a_shorter_step(version: int, hosts: list[Host]) -> None:
    module = plain("cartpole")
    host = Host(exported("cartpole", version))
    hosts.append(host)
    host.start()
    q, qd = module.simulate(steps=1).q[0], module.simulate(steps=1).qd[0]
    for size in (0.012, 0.0033, 0.005, 1e-5):
        host.step(size)
        whole = int(size / 0.005 + 1e-9)
        for _ in range(whole):
            q, qd = module.step(q, qd, 0.005)
        if size - whole * 0.005 > 1e-9:
            q, qd = module.step(q, qd, size - whole * 0.005)
        result = np.array(host.get("x", "theta", "x_dot", "theta_dot"))
        assert result == pytest.approx([*q, *qd], rel=1e-13)
    assert host.get("theta_dot") == host.get("der(theta)")


def test_summed_communication_points_are_exact_steps(version: int, hosts: list[Host]) -> None:
    """A thousand summed communication points are the same as whole steps of the run."""
    module = plain("cartpole")
    host = Host(exported("cartpole", version))
    hosts.append(host)
    host.start()
    for _ in range(1000):
        host.step(0.005)  # the sums differ from n h
    run = module.simulate(steps=1000)
    assert host.t != 1000 * 0.005
    assert np.array_equal(host.get("x", "theta"), run.q[-1])


@both
def test_inputs_are_constant_over_steps(version: int, hosts: list[Host]) -> None:
    module = plain("cartpole_driven")
    forces = np.array([[0.5], [-0.2], [0.1], [0.0], [1.0]])
    run = module.simulate(steps=5, u=forces)
    host = Host(exported("cartpole_driven", version))
    hosts.append(host)
    host.start()
    for k, (force,) in enumerate(forces):
        host.set(force=force)
        host.step(0.005)
        assert np.array_equal(
            host.get("x", "theta", "x_dot", "theta_dot"), [*run.q[k + 1], *run.qd[k + 1]]
        )


def test_signals_of_the_scene_are_applied_on_request(version: int, hosts: list[Host]) -> None:
    names, module = states("cartpole_driven"), plain("cartpole_driven")
    run = module.simulate(steps=200)
    host = Host(exported("cartpole_driven", version))
    hosts.append(host)
    host.follow_signals()
    host.start()
    assert np.array_equal(rows(host, names, 0.025, 40), states_of_run(run)[::5])
    assert host.get("force") == pytest.approx([0.01 * np.sin(1.0)], rel=1e-12)
    without_signals = Host(exported("cartpole_driven", version))
    hosts.append(without_signals)
    without_signals.start()  # otherwise its inputs are zero
    without_signals.step(1.0)
    assert without_signals.get("x", "x_dot", "force") == pytest.approx([0, 0, 0], abs=1e-12)


@both
def test_parameters_and_initial_values_can_be_set(version: int, hosts: list[Host]) -> None:
    module = plain("cartpole")
    run = module.simulate(steps=40, params={"m_p": 3.5, "l": 1.5}, q0=[0.1, 0.2], qd0=[0.3, -0.4])
    host = Host(exported("cartpole", version))
    hosts.append(host)
    host.set(m_p=3.5, l=1.5, x=0.1, theta=0.2, x_dot=0.3, theta_dot=-0.4)
    host.start()
    assert host.get("m_p", "theta", "g") == [3.5, 0.2, 9.8]
    host.step(0.2)
    assert np.array_equal(host.get("x", "theta", "x_dot", "theta_dot"), states_of_run(run)[-1])
    host.set(g=1.0)  # parameters may change between steps
    host.step(0.1)
    later_run = module.simulate(
        steps=20, params={"m_p": 3.5, "l": 1.5, "g": 1.0}, q0=run.q[-1], qd0=run.qd[-1]
    )
    assert np.array_equal(host.get("x", "theta"), later_run.q[-1])


def test_accelerations_and_outputs_agree_with_the_module(version: int, hosts: list[Host]) -> None:
    module = plain(BALL)
    host = Host(exported(BALL, version))
    hosts.append(host)
    host.set(wind=0.7)
    host.start()
    host.step(0.1)
    q, qd = (np.array(host.get(*n)) for n in (("y", "x"), ("y_dot", "x_dot")))
    result = host.get("der(y)", "der(x)", "der(y_dot)", "der(x_dot)")
    assert result == pytest.approx([*qd, *module.acceleration(q, qd, u=[0.7])], rel=1e-15)
    outputs = module.output(q, qd, u=[0.7])
    assert host.get("ax", "height") == pytest.approx(list(outputs), rel=1e-15)
    energies = host.get("energy.kinetic", "energy.potential", "energy.total")
    assert energies == pytest.approx(
        [module.kinetic_energy(q, qd), module.potential_energy(q), module.energy(q, qd)],
        rel=1e-15,
    )


@both
def test_states_are_stored_and_restored(version: int, hosts: list[Host]) -> None:
    host, other = Host(exported(BALL, version)), Host(exported(BALL, version))
    hosts += [host, other]
    for each in (host, other):
        each.start()
    host.step(0.4)
    state, at = host.saved_state(), host.t
    host.step(0.3)  # beyond an impact
    once = host.get("y", "y_dot", "x", "x_dot")
    host.restore(state)
    host.t = at
    host.step(0.3)
    assert host.get("y", "y_dot", "x", "x_dot") == once
    written = host.unit.serializeFMUState(state)
    read = other.unit.deserializeFMUState(written)
    other.restore(read)
    other.t = at
    other.step(0.3)
    assert other.get("y", "y_dot", "x", "x_dot") == once
    host.unit.freeFMUState(state)
    other.unit.freeFMUState(read)


def test_bytes_of_no_state_are_refused(version: int, hosts: list[Host]) -> None:
    host = Host(exported(BALL, version))
    hosts.append(host)
    host.start()
    state = host.saved_state()
    written = bytearray(host.unit.serializeFMUState(state))
    for wrong in (bytes(written[:-1]), bytes([written[0] ^ 1]) + bytes(written[1:]), b"x"):
        with pytest.raises(Exception, match="status 3"):
            host.unit.deserializeFMUState(wrong)
        assert host.said.pop()[1].endswith("no state of this unit, or of another build of it")
    host.unit.freeFMUState(state)


def test_instances_are_independent(version: int, hosts: list[Host]) -> None:
    names = states("cartpole")
    single = Host(exported("cartpole", version))
    heavy, light = Host(exported("cartpole", version)), Host(exported("cartpole", version))
    hosts += [single, heavy, light]
    heavy.set(m_p=9.0)
    for each in (single, heavy, light):
        each.start()
    result = rows(single, names, 0.01, 20)
    for k in range(20):
        heavy.step(0.01)
        light.step(0.01)
        assert np.array_equal(light.get(*names), result[k + 1])
    assert light.get("theta") != heavy.get("theta") and light.get("m_p") == [2.0]


def test_reset_unit_is_as_new(version: int, hosts: list[Host]) -> None:
    host = Host(exported("cartpole", version))
    hosts.append(host)
    for _ in range(2):
        host.start()
        assert host.get("x", "theta", "m_p") == [0.0, np.pi / 2, 2.0]
        host.step(0.5)
        assert np.array_equal(host.get("x", "theta"), plain("cartpole").simulate(steps=100).q[-1])
        host.unit.reset()
        host.set(m_p=3.0)
        host.unit.reset()


def test_events_agree_with_the_module(version: int, hosts: list[Host]) -> None:
    run = plain(FALLS).simulate(tol=1e-9, u=[0.0], times=[1.0, 2.0, 3.0])
    host = Host(exported(FALLS, version), logging=True)
    hosts.append(host)
    host.start()
    for k in range(3):
        for _ in range(4):
            assert not host.step(0.25)
        # other steps with the same tolerance
        assert host.get("y", "x") == pytest.approx(run.q[k], abs=1e-8)
    logged_events = [text for category, text in host.said if category == "logEvents"]
    for name in ("impact", "top"):
        times = [
            float(x[0]) for t in logged_events if (x := re.findall(rf"'{name}' at t = (\S+) s", t))
        ]
        assert times == pytest.approx(run.events[name].t, abs=1e-8), name
    assert len(run.events["impact"].t) == 6


@both
def test_stop_event_terminates_the_unit(version: int, hosts: list[Host]) -> None:
    run = plain(BALL).simulate(tol=1e-9, duration=3.0, u=[0.0])
    host = Host(exported(BALL, version))
    hosts.append(host)
    host.start()
    while not host.step(0.25):
        assert host.t < 3
    assert run.stopped == "wall" and host.t == pytest.approx(run.t[-1], abs=1e-9)
    assert host.get("x") == pytest.approx([0.9], abs=1e-9)
    assert host.step(0.25) and host.get("x") == pytest.approx([0.9], abs=1e-9)


def test_stop_inside_a_step_returns_early(
    hosts: list[Host],
) -> None:
    end = plain(BALL).simulate(tol=1e-9, duration=3.0, u=[0.0]).t[-1]
    host = Host(exported(BALL, 3))
    hosts.append(host)
    host.start()
    while not host.step(0.25):
        assert not host.returned_early
    assert host.returned_early and host.t == pytest.approx(end, abs=1e-9)
    # a step that ends exactly at the stop is complete
    host.unit.reset()
    host.start()
    assert host.step(end) is host.returned_early


@pytest.mark.parametrize("scene", ["cartpole", "cartpole_driven", "kapitza_pendulum", FALLS])
def test_model_exchange_with_cvode_agrees(scene: str, version: int) -> None:
    from fmpy import simulate_fmu

    names, driven = states(scene), scene in ("cartpole_driven",)
    result = simulate_fmu(
        str(exported(scene, version)), fmi_type="ModelExchange", stop_time=1.5,
        relative_tolerance=1e-9, output_interval=0.05, record_events=False,
        start_values={"inputs.follow_signals": True} if driven else {}, output=names,
    )  # fmt: skip
    module = plain(scene)
    how: dict[str, Any] = {"tol": 1e-12} if scene == FALLS else {"h": 2.5e-4}
    run = module.simulate(duration=1.5, **({"u": [0.0]} if scene == FALLS else {}), **how)
    final_state = np.array([result[n][-1] for n in names])
    # CVode's tolerance, which the motion magnifies a few hundred times
    assert final_state == pytest.approx(states_of_run(run)[-1], rel=1e-5, abs=1e-6)


def test_model_exchange_by_euler_converges(version: int) -> None:
    """Only derivatives are used: Euler's method with two step sizes, extrapolated to zero."""
    from fmpy import simulate_fmu

    ends = []
    for h in (1e-3, 5e-4):
        result = simulate_fmu(
            str(exported("cartpole", version)), fmi_type="ModelExchange", solver="Euler",
            step_size=h, stop_time=0.5, output_interval=h, output=states("cartpole"),
        )  # fmt: skip
        ends.append(np.array([result[n][-1] for n in states("cartpole")]))
    expected = states_of_run(plain("cartpole").simulate(duration=0.5))[-1]
    errors = [np.abs(e - expected).max() for e in ends]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.01)
    assert 2 * ends[1] - ends[0] == pytest.approx(expected, abs=1e-5)


def test_events_in_model_exchange_are_recorded(version: int) -> None:
    from fmpy import simulate_fmu

    result = simulate_fmu(
        str(exported(FALLS, version)), fmi_type="ModelExchange", stop_time=3.0,
        relative_tolerance=1e-10, output_interval=0.1, output=["y", "y_dot"],
    )  # fmt: skip
    run = plain(FALLS).simulate(tol=1e-12, duration=3.0, u=[0.0])
    # an event is recorded before and after its jump
    times = np.array([t for t, n in zip(result["time"], np.diff(result["time"], prepend=-1),
                                        strict=True) if n == 0])  # fmt: skip
    expected = np.sort(np.concatenate([run.events[n].t for n in ("impact", "top")]))
    assert times == pytest.approx(expected, abs=1e-6)
    assert result["y"].min() > -1e-6
    assert result["y"][-1] == pytest.approx(run.q[-1, 0], abs=1e-6)


@both
def test_stop_event_ends_model_exchange(version: int) -> None:
    from fmpy import simulate_fmu

    result = simulate_fmu(
        str(exported(BALL, version)), fmi_type="ModelExchange", stop_time=3.0,
        relative_tolerance=1e-10, output_interval=0.1, output=["x"],
    )  # fmt: skip
    run = plain(BALL).simulate(tol=1e-12, duration=3.0, u=[0.0])
    assert result["time"][-1] == pytest.approx(run.t[-1], abs=1e-6)


@both
@pytest.mark.parametrize("kind", KINDS)
def test_directional_derivatives_agree_with_the_module(
    kind: str, version: int, hosts: list[Host]
) -> None:
    module = plain(BALL)
    host = Host(exported(BALL, version), kind)
    hosts.append(host)
    host.set(x=0.3, y=0.7, x_dot=-0.2, y_dot=1.5, wind=0.4)
    host.start()
    q, qd = [0.7, 0.3], [1.5, -0.2]
    A, B, C, D = module.linearize(q, qd, u=[0.4], outputs=True)
    state = ["y", "x", "y_dot", "x_dot"]
    rates = [f"der({n})" for n in state]
    whole = np.vstack([np.hstack([A, B]), np.hstack([C, D])])
    for k, known in enumerate([*state, "wind"]):
        result = host.slope([*rates, "ax", "height"], [known], [2.0])
        assert result == pytest.approx(2 * whole[:, k], rel=1e-14, abs=1e-15)
    seeds = [0.3, -0.1, 0.7, 0.2, 1.1]
    result = host.slope([*rates, "ax", "height", "x"], [*state, "wind"], seeds)
    assert result == pytest.approx([*(whole @ seeds), -0.1], rel=1e-14, abs=1e-15)


PULLED = """
eomc = 1
name = "pulled"
[coordinates]
th = { start = 0.4 }
[parameters]
l = 0.8
[inputs]
T = {}
[energy]
kinetic = "l**2*th_dot**2/2"
potential = "-9.81*l*cos(th)"
[forces]
th = "T"
[outputs]
ax = "dot(dot(l*sin(th)))"
[run]
linearize = true
"""


def test_derivatives_of_outputs_may_read_accelerations(version: int, hosts: list[Host]) -> None:
    module, host = plain(PULLED), Host(exported(PULLED, version), "ModelExchange")
    hosts.append(host)
    host.set(th=0.4, th_dot=1.5, T=0.7)
    host.start()
    *_, C, D = module.linearize([0.4], [1.5], u=[0.7], outputs=True)
    slopes = [host.slope(["ax"], [known], [1.0])[0] for known in ("th", "th_dot", "T")]
    assert slopes == pytest.approx([*C[0], *D[0]], rel=1e-14)


@both
def test_parameter_derivatives_agree_with_the_module(version: int, hosts: list[Host]) -> None:
    module, host = plain(RIG), Host(exported(RIG, version))
    hosts.append(host)
    host.set(x=0.7, y=-0.4, x_dot=0.2, y_dot=0.1, force=0.5, pull=5.0, push=0.3)
    host.start()
    q, qd, u = np.array([0.7, -0.4]), np.array([0.2, 0.1]), np.array([0.5, 5.0, 0.3])
    E = module.sensitivity(q, qd, u=u)
    rates, outputs = ["der(x_dot)", "der(y_dot)"], ["load", "where"]
    for k, name in enumerate(module.parameters):
        h = 1e-6
        above, below = (
            module.output(q, qd, u=u, params={name: module.defaults[name] + d}) for d in (h, -h)
        )
        by_differences = (above - below) / (2 * h)
        result = host.slope([*rates, *outputs, "x", "der(x)"], [name], [2.0])
        assert result[:2] == pytest.approx(2 * E[:, k], rel=1e-14)
        assert result[2:4] == pytest.approx(2 * by_differences, rel=1e-8, abs=1e-8)
        assert result[4:] == [0, 0]
    # the lowest upper limit of the pull is active, so that the acceleration of x depends on it
    assert host.slope(["der(x_dot)"], ["most"], [1.0]) == [1.0]
    both_at_once = host.slope(rates, ["k", "y"], [0.5, 3.0])
    columns = np.array([host.slope(rates, [name], [1.0]) for name in ("k", "y")])
    assert both_at_once == pytest.approx(columns.T @ [0.5, 3.0], rel=1e-14)
    host.follow_signals()
    with pytest.raises(Exception, match="status 3"):
        host.slope(rates, ["k"], [1.0])
    assert "while signals depend on parameters" in host.said.pop()[1]


@both
@pytest.mark.parametrize("kind", KINDS)
def test_initial_values_by_formula_follow_parameters(
    kind: str, version: int, hosts: list[Host]
) -> None:
    host = Host(exported(RIG, version), kind)
    hosts.append(host)
    assert host.get("x", "x_dot") == [0.25, 0.05]
    host.set(x0=0.5, w=0.2)
    assert host.get("x", "x_dot", "y") == [1.2, 0.2, 0.3]
    host.set(x=3.0)  # the importer's own initial value is unchanged
    host.set(x0=0.7)
    host.start()
    assert host.get("x", "x_dot") == [3.0, 0.2]
    host.set(w=0.9)  # after the start a parameter changes no state
    assert host.get("x", "x_dot") == [3.0, 0.2]
    host.unit.reset()
    host.set(w=0.1)
    host.start()
    assert host.get("x", "x_dot") == pytest.approx([0.3, 0.1], rel=1e-15)
    host.unit.reset()
    assert host.get("x", "x_dot") == [0.25, 0.05]


def test_missing_derivatives_are_refused_with_a_message(version: int, hosts: list[Host]) -> None:
    for scene, unknown, known, words in (
        ("cartpole", "der(x_dot)", "x", "[run] linearize = true"),
        (BALL, "energy.total", "x", "of coordinates, velocities, accelerations and outputs only"),
        (BALL, "ax", "m", '[run] linearize = "parameters"'),
        (BALL, "ax", "energy.total", "coordinates, velocities, inputs and parameters only"),
        (FEEDBACK, "der(phi_dot)", "phi", "while signals answer the state"),
    ):
        host = Host(exported(scene, version))
        hosts.append(host)
        if scene == FEEDBACK:
            host.follow_signals()
        host.start()
        with pytest.raises(Exception, match="status 3"):
            host.slope([unknown], [known], [1.0])
        assert words in host.said.pop()[1]


def test_single_precision_agrees_with_the_module(version: int, hosts: list[Host]) -> None:
    module = plain(FLOAT)
    run = module.simulate(steps=100)
    host = Host(exported(FLOAT, version))
    hosts.append(host)
    host.follow_signals()
    host.start()
    assert np.array_equal(rows(host, ["phi", "phi_dot"], 0.05, 20), states_of_run(run)[::5])


@pytest.mark.parametrize("kind", KINDS)
def test_failures_are_logged_with_a_message(kind: str, version: int, hosts: list[Host]) -> None:
    host = Host(exported(BLOWS_UP, version), kind)
    hosts.append(host)
    if kind == "CoSimulation":
        host.start()
        with pytest.raises(Exception, match="discard"):
            while host.t < 10:
                host.step(0.1)
        category, text = host.said[-1]
        assert category == "logStatusDiscard"
        assert re.fullmatch(r"at t = \S+ s: the state would no longer be finite: .*", text)
        return
    host.set(m=0.0)
    host.start()
    with pytest.raises(Exception, match="discard"):
        host.get("der(x_dot)")
    assert host.said[-1][1] == (
        "at t = 0 s: D is not positive definite there, so no acceleration exists"
    )


@pytest.mark.parametrize("name", ["energy.total", "der(theta)", "der(theta_dot)", "t"])
def test_calculated_variables_cannot_be_set(name: str, version: int, hosts: list[Host]) -> None:
    host = Host(exported("cartpole", version))
    hosts.append(host)
    host.of.setdefault("t", 0)
    with pytest.raises(Exception, match="status 3"):
        host.set_all({name: 1.0})
    assert "is calculated and can't be set" in host.said[-1][1]


def test_other_misuse_is_reported(version: int, hosts: list[Host]) -> None:
    host = Host(exported("cartpole", version))
    hosts.append(host)
    for misuse, words in (
        (lambda: host.step(0.1), "after initialization"),
        (lambda: host.set(x=float("nan")), "can't be set to nan"),
        (lambda: host.set(m_c=float("inf")), "can't be set to inf"),
    ):
        with pytest.raises(Exception, match="status 3"):
            misuse()
        assert words in host.said[-1][1]
    host.start()
    for misuse, words in (
        (lambda: host.step(-0.1), "a size of zero or more"),
        (lambda: host.step(float("nan")), "a size of zero or more"),
        (lambda: host.step(1e8), "more than 1e9 steps"),
        (lambda: host.set(x=1.0), "until its start only"),
        (lambda: host.unit.enterInitializationMode(), "not for the mode"),
    ):
        with pytest.raises(Exception, match="status 3"):
            misuse()
        assert words in host.said[-1][1]
    host.t = 5.0
    with pytest.raises(Exception, match="status 3"):
        host.step(0.1)
    assert "begins where the last one ended" in host.said[-1][1]


def test_start_time_other_than_zero(version: int, hosts: list[Host]) -> None:
    module = plain("kapitza_pendulum")
    host = Host(exported("kapitza_pendulum", version))
    hosts.append(host)
    host.start(t=2.0)
    host.step(0.05)
    run = module.simulate(steps=50, t0=2.0)
    assert np.array_equal(host.get("theta"), run.q[-1])
    assert host.get("theta") != [module.simulate(steps=50).q[-1, 0]]


def test_tolerance_of_the_importer_is_used(version: int, hosts: list[Host]) -> None:
    exact = plain(FALLS).simulate(tol=1e-14, u=[0.0], times=[2.0]).q[-1]
    errors = []
    for tolerance in (1e-3, 1e-12):
        host = Host(exported(FALLS, version))
        hosts.append(host)
        host.start(tolerance=tolerance)
        host.step(2.0)
        errors.append(np.abs(np.array(host.get("y", "x")) - exact).max())
    assert errors[1] < 1e-11 and errors[1] <= errors[0]


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["cartpole_driven", BALL], ids=["cartpole_driven", "ball"])
def test_fmu_is_compiled_from_its_sources(scene: str, version: int, tmp_path: Path) -> None:
    """By FMPy with CMake, without a compiler's warning about the generated C."""
    import shutil

    from fmpy import extract
    from fmpy.build import build_platform_binary

    folder = Path(extract(str(exported(scene, version)), str(tmp_path / "unit")))
    shutil.rmtree(folder / "binaries")
    build_platform_binary(folder, build_dir=_empty(tmp_path / "made"))
    host = Host(exported(scene, version), folder=str(folder))
    host.start()
    host.step(0.5)
    again = Host(exported(scene, version))
    again.start()
    again.step(0.5)
    names = states(scene)
    assert host.get(*names) == pytest.approx(again.get(*names), rel=1e-12)
    host.free()
    again.free()


@pytest.mark.slow
@pytest.mark.parametrize("target", ["x86_64-windows-gnu", "aarch64-macos", "aarch64-linux-gnu"])
def test_fmu_compiles_for_other_machines(target: str, version: int, tmp_path: Path) -> None:
    """By ziglang without a warning; the result cannot run here."""
    pytest.importorskip("ziglang", reason="ziglang is not installed: pip install '.[cc]'")
    import sys

    from fmpy import extract
    from support.compilation import compiled

    extract(str(exported(BALL, version)), str(tmp_path))
    # the headers of the standard declare functions without prototypes
    flags = "-std=c99 -O2 -Wall -Wextra -Werror -Wno-strict-prototypes -shared".split()
    compiled(
        sys.executable, "-m", "ziglang", "cc", "-target", target, *flags, "ball.c",
        f"fmi/fmi{version}.c", "-o", "made", cwd=tmp_path / "sources",
    )  # fmt: skip
    assert (tmp_path / "sources" / "made").stat().st_size > 10_000


def _empty(folder: Path) -> Path:
    folder.mkdir()
    return folder


WALLS = """
eomc = 1
name = "walls"
[coordinates]
x = { unit = "m", rate = 1.0 }
y = { start = 0.25, rate = 1.0 }
[parameters]
e = 0.9
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "0"
[[event]]
name = "walls"
when = "1 - x**2"
action = "jump"
x_dot = "-e*x_dot"
[[event]]
name = "again"
when = "t - 1"
action = "jump"
y_dot = "2*y_dot"
[[event]]
name = "half"
when = "t - 2.5"
direction = "rising"
action = "jump"
x = "x - 5"
x_dot = "1"
[run]
tolerance = 1e-9
duration = 3
"""


def test_simultaneous_events_in_both_directions_and_of_time(
    version: int, hosts: list[Host]
) -> None:
    """Two events at one time, one that bounces repeatedly, one that moves another over its zero."""
    from fmpy import simulate_fmu

    # bounces at t = 1, where its other velocity doubles, and is moved at 2.5
    expected = [1 - 0.9 * 1.5 - 5 + 0.5, 0.25 + 1 + 2 * 2, 1, 2]
    result = simulate_fmu(
        str(exported(WALLS, version)), fmi_type="ModelExchange", stop_time=3.0,
        relative_tolerance=1e-10, output_interval=0.05, output=["x", "y", "x_dot", "y_dot"],
    )  # fmt: skip
    final_state = [result[n][-1] for n in ("x", "y", "x_dot", "y_dot")]
    assert final_state == pytest.approx(expected, abs=1e-6)
    host = Host(exported(WALLS, version), logging=True)
    hosts.append(host)
    host.start(tolerance=1e-12)
    for _ in range(12):
        host.step(0.25)
    assert host.get("x", "y", "x_dot", "y_dot") == pytest.approx(expected, abs=1e-11)
    assert len([c for c, _ in host.said if c == "logEvents"]) == 3


def test_event_at_zero_initially_is_not_triggered(version: int) -> None:
    from fmpy import simulate_fmu

    scene = FALLS.replace('y = { unit = "m", start = 1.0 }', "y = { rate = 2.0 }")
    run = plain(scene).simulate(tol=1e-12, duration=1.0, u=[0.0])
    result = simulate_fmu(
        str(exported(scene, version)), fmi_type="ModelExchange", stop_time=1.0,
        relative_tolerance=1e-10, output_interval=0.01, output=["y", "y_dot"],
    )  # fmt: skip
    assert result["y"][-1] == pytest.approx(run.q[-1, 0], abs=1e-6)
    assert len(run.events["impact"].t) == 3


# --- other importers ------------------------------------------------------------------------------


@both
def test_casadi_imports_the_fmu(version: int, tmp_path: Path) -> None:
    """CasADi evaluates derivatives, outputs and their exact Jacobians."""
    casadi = pytest.importorskip("casadi", reason="CasADi is not installed")
    from fmpy import extract

    extract(str(exported(BALL, version)), str(tmp_path))
    builder = casadi.DaeBuilder("ball", str(tmp_path))
    assert builder.x() == ["y", "x", "y_dot", "x_dot"] and builder.u() == ["wind"]
    f = builder.create("f", ["x", "u"], ["ode", "y"])
    module, q, qd, u = plain(BALL), [0.7, 0.3], [1.5, -0.2], [0.4]
    rates, outputs = (np.array(v).ravel() for v in f([*q, *qd], u))
    assert rates == pytest.approx([*qd, *module.acceleration(q, qd, u=u)], rel=1e-15)
    assert outputs == pytest.approx([*q, *qd, *module.output(q, qd, u=u)], rel=1e-15)
    A, B, C, D = module.linearize(q, qd, u=u, outputs=True)
    ode_x, ode_u, y_x, y_u = map(np.array, f.jacobian()([*q, *qd], u, 0, 0))
    assert ode_x == pytest.approx(A, rel=1e-14) and ode_u == pytest.approx(B, rel=1e-14)
    assert y_x[4:] == pytest.approx(C, rel=1e-14) and y_u[4:] == pytest.approx(D, rel=1e-14)


def test_libcosim_imports_the_fmu() -> None:
    """Co-simulation of two connected FMI 2.0 units in the Open Simulation Platform."""
    pytest.importorskip("libcosimpy", reason="libcosimpy is not installed")
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(step_size=10_000_000)  # ns
    unit = CosimLocalSlave(fmu_path=str(exported("cartpole", 2)), instance_name="pole")
    index = execution.add_local_slave(local_slave=unit)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer=observer)
    assert execution.simulate_until(target_time=1_000_000_000)
    references = {
        v.name if isinstance(v.name, str) else v.name.decode(): v.reference
        for v in execution.slave_variables(slave_index=index)
    }
    names = ("x", "theta", "energy.total")
    result = observer.last_real_values(
        slave_index=index, variable_references=[references[n] for n in names]
    )
    run = plain("cartpole").simulate(duration=1.0)
    assert [*result] == pytest.approx([*run.q[-1], run.energy[-1]], rel=1e-13, abs=1e-13)
