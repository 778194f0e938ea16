"""Events passed to a call, in addition to those of the scene."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import sympy
from sympy.physics.mechanics import dynamicsymbols

import eomc
from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.runtime.package import model_of

pytestmark = pytest.mark.usefixtures("unoptimised_file")
TOL = 1e-9  # default tolerance of a scene with events
# compiled once for all tests: two record, one stops and one jumps at a threshold parameter
EVENTS = {
    "section": {"when": "x", "direction": "rising"},
    "through": "x - 0.5",
    "wall": {"when": "x - at_wall", "action": "stop"},
    "drop": {
        "when": "x - at_drop", "direction": "falling", "action": "jump", "m": np.float64(4),
        "c": "4*c",
    },
}  # fmt: skip
TEXT = """eomc = 1
name = "oscillator"
[coordinates]
x = { unit = "m", start = 1 }
[parameters]
k = 3
c = 1
m = 1
at_wall = 9
at_drop = 9
[energy]
kinetic = "m*x_dot**2/2"
potential = "(k + c)*x**2/2"
[[event]]
name = "turns"
when = "x_dot"
direction = "rising"
[run]
tolerance = 1e-9
duration = 10
batch = true
"""


# Once a process: a scene that is loaded from another folder is the same module.
@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("asked") / "oscillator.toml"
    file.write_text(TEXT)
    return file


@pytest.fixture(scope="session")
def oscillator(scene: Path) -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EOMC_CFLAGS", "-O0")
        return eomc.load(scene, scene.parent / "build")


def test_added_events_are_detected_with_those_of_the_scene(oscillator: ModuleType) -> None:
    run = oscillator.simulate(events=EVENTS)
    assert run.events["section"].t == pytest.approx((np.arange(3) + 0.75) * math.pi, abs=TOL)
    assert run.events["turns"].t == pytest.approx((np.arange(3) + 0.5) * math.pi, abs=TOL)
    assert "section" not in oscillator.simulate().events


def test_warning_points_to_the_line_of_the_caller(oscillator: ModuleType) -> None:
    """Warnings of a run, of a batch and of an error estimate."""
    never = {"never": "x - 5"}
    stiff = {"params": {"k": 1e6}, "h": 0.0029, "events": never}
    calls = (
        lambda: oscillator.simulate(steps=50, **stiff),
        lambda: oscillator.simulate_batch(steps=50, **stiff | {"h": 0.003}),
        lambda: oscillator.simulate(h=0.5, duration=0.2, events=never),
        lambda: oscillator.simulate(h=0.4, duration=30, estimate=True, events=never),
    )
    for call in calls:
        with pytest.warns(RuntimeWarning) as warnings:
            call()
        assert {(w.filename, w.lineno) for w in warnings} == {
            (__file__, call.__code__.co_firstlineno)
        }


def test_formula_alone_records_both_directions(oscillator: ModuleType) -> None:
    run = oscillator.simulate(duration=math.pi, events=EVENTS)
    assert run.events["through"].t == pytest.approx([math.pi / 6, 5 * math.pi / 6], abs=TOL)
    # parameters of the module's own class work too
    parameter_sets = (oscillator.Params(k=15), {"k": 15})
    for params in parameter_sets:
        run = oscillator.simulate(duration=0.5, params=params, events=EVENTS)
        assert run.events["through"].t == pytest.approx([math.pi / 12], abs=TOL)


def test_added_events_can_stop_and_jump(oscillator: ModuleType) -> None:
    options = {"params": {"at_wall": -0.5}, "events": EVENTS}
    run = oscillator.simulate(**options)
    assert run.stopped == "wall" and run.t[-1] == pytest.approx(math.pi / 3, abs=TOL)
    batch = oscillator.simulate_batch([[1.0], [0.4]], tol=1e-9, **options)
    assert batch.reached == pytest.approx([math.pi / 3, 10], abs=TOL)
    assert batch.stopped.tolist() == ["wall", ""] and batch.events["wall"].instance.tolist() == [0]
    assert batch.events["turns"].for_instance(1).t == pytest.approx(
        (np.arange(3) + 0.5) * math.pi, abs=TOL
    )
    run = oscillator.simulate(duration=3.0, params=oscillator.Params(at_drop=0), events=EVENTS)
    assert run["m"][-1] == 4 and run["c"][-1] == 4


def test_added_events_are_compiled_once(oscillator: ModuleType, scene: Path) -> None:
    folder = scene.parent / "build" / "oscillator" / ".events"

    def modification_times() -> dict[Path, int]:
        return {f: f.stat().st_mtime_ns for f in folder.glob("*/oscillator/_oscillator_*")}

    oscillator.simulate(duration=1.0, events=EVENTS)
    first = modification_times()
    model_of(oscillator).extensions.clear()  # simulates a new process
    run = oscillator.simulate(duration=1.0, events=EVENTS)
    assert len(run.events["through"]) == 1 and modification_times() == first != {}
    assert pickle.loads(pickle.dumps(run)).events["through"].t == run.events["through"].t


@pytest.mark.usefixtures("no_warnings")
def test_saved_run_with_events_is_loaded(oscillator: ModuleType, tmp_path: Path) -> None:
    """In this process and as if in another; the state jumps between rows."""
    options = {"params": {"at_drop": 0}, "events": EVENTS}
    runs = (
        oscillator.simulate(**options),
        oscillator.simulate_batch([[1.0], [0.4]], tol=1e-9, **options),
    )
    times = [1.0, 2.0, 3.0]
    for k, run in enumerate(runs):
        run.save(tmp_path / f"{k}.npz")
    for _ in range(2):
        for k, run in enumerate(runs):
            loaded = oscillator.load_run(tmp_path / f"{k}.npz")
            assert loaded == run and list(loaded.events) == ["turns", *EVENTS]
            np.testing.assert_array_equal(loaded.events["drop"].t, run.events["drop"].t)
            if not k:
                assert np.array_equal(loaded(times), run(times)) and loaded(2.0)[0][2] == 4
        model_of(oscillator).extensions.clear()


def test_saved_run_without_its_scene_is_refused_with_advice(
    oscillator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "run.npz"
    oscillator.simulate(duration=1.0, events=EVENTS).save(file)
    model_of(oscillator).extensions.clear()
    monkeypatch.setattr(model_of(oscillator), "source", None)
    with pytest.raises(EomcError, match=r"load it with eomc\.load") as error:
        oscillator.load_run(file)
    assert "numpy.load reads its rows" in error.value.__notes__[0]


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ({"a": "y"}, "a.when: 'y' is not declared"),
        ({"a": "x", "b": {"when": "x", "action": "jmp"}}, "b.action: unknown action 'jmp'"),
        ({"2x": "x"}, "2x.name: '2x' is not a plain name"),
        ({"turns": "x"}, "turns.name: 'turns' is an event already"),
        ({"a": {"when": "x", "action": "jump", "z": 1}}, "a.z: 'z' is no coordinate"),
        ({"a": "x\"\n[run]\nh = 5"}, "a.when"),
        ({"a": None}, "a: when: give a formula"),
        (["x"], "give a dict"),
    ],
)  # fmt: skip
def test_invalid_event_is_named(oscillator: ModuleType, events: dict, message: str) -> None:
    with pytest.raises(EomcError, match=r"simulate\(events=\)") as error:
        oscillator.simulate(events=events)
    assert message in str(error.value)


def test_missing_or_changed_scene_is_reported(
    oscillator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "oscillator.toml"
    other.write_text(TEXT.replace("k = 3", "k = 5"))
    for source, message in (
        (tmp_path / "gone.toml", r"gone\.toml: can't be read \(No such file"),
        (other, "has changed since it was built: load it again"),
        (None, r"load it with eomc\.load"),
    ):
        monkeypatch.setattr(model_of(oscillator), "source", source)
        with pytest.raises(EomcError, match=message):
            oscillator.simulate(events={"a": "x"})


def test_unwritable_folder_is_named(
    oscillator: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(EomcError, match=r"oscillator\.toml: can't be written \(Read-only"):
        oscillator.simulate(events={"later": "x - 0.125"})


def pendulum() -> eomc.System:
    """A pendulum of dynamicsymbols with an event of its own, the turning point."""
    theta, (w, d, low, brake) = dynamicsymbols("theta"), sympy.symbols("w d low brake")
    return eomc.System.make(
        "swinging", {theta: 0.5}, theta.diff() ** 2 / 2, w**2 * theta**2 / 2,
        parameters={w: 2.0, d: 0.0, low: -9.0, brake: 9.0}, forces={theta: -d * theta.diff()},
        batch=True, tolerance=1e-9,
        events={"turns": {"when": theta.diff(), "direction": "rising"}},
    )  # fmt: skip


def pendulum_events() -> dict:
    """Two events record, one stops and one jumps at a threshold parameter."""
    theta, d, brake = dynamicsymbols("theta"), sympy.Symbol("d"), sympy.Symbol("brake")
    return {
        "down": {"when": theta, "direction": "rising"},
        "half": "theta - 1/4",
        "stops": {"when": "theta - low", "action": "stop"},
        "brakes": {"when": theta - brake, "action": "jump", theta.diff(): 0, d: "d + 1"},
    }


@pytest.fixture(scope="module")
def systems(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder for modules of Systems."""
    return tmp_path_factory.mktemp("systems")


def test_added_events_of_a_system_are_detected_with_its_own(systems: Path) -> None:
    system, events = pendulum(), pendulum_events()
    m = eomc.load(system, systems)
    assert system == pendulum() and pickle.loads(pickle.dumps(system)) == system
    run = m.simulate(events=events)
    assert run.events["down"].t == pytest.approx((np.arange(3) + 0.75) * math.pi, abs=TOL)
    assert run.events["turns"].t == pytest.approx((np.arange(3) + 0.5) * math.pi, abs=TOL)
    assert run.events["half"].t[0] == pytest.approx(math.pi / 6, abs=TOL)
    run = m.simulate(duration=2.0, params={"brake": 0.0}, events=events)
    assert abs(run.q[-1, 0]) < TOL and run["d"][-1] == 1
    batch = m.simulate_batch([[0.5], [0.1]], tol=1e-9, params={"low": 0.2}, events=events)
    assert batch.reached == pytest.approx([math.acos(0.4) / 2, 10], abs=TOL)


@pytest.mark.usefixtures("no_warnings")
def test_saved_run_of_a_system_needs_the_events_again(systems: Path, tmp_path: Path) -> None:
    m, file = eomc.load(pendulum(), systems), tmp_path / "run.npz"
    run = m.simulate(duration=1.0, events=pendulum_events())
    run.save(file)
    loaded = m.load_run(file)
    assert loaded == run and loaded.events["half"].t == run.events["half"].t
    model_of(m).extensions.clear()
    with pytest.raises(ValueError, match=r"which files don't keep: call swinging\.simulate\(ev"):
        m.load_run(file)


def test_events_of_a_system_are_compiled_once(systems: Path) -> None:
    modification_times = []
    for _ in range(2):  # simulates a new process
        m = eomc.load(pendulum(), systems)
        model_of(m).extensions.clear()
        m.simulate(duration=1.0, events=pendulum_events())
        (extension,) = systems.glob("swinging/.events/*/swinging/_swinging_*")
        modification_times.append(extension.stat().st_mtime_ns)
    assert modification_times[0] == modification_times[1]


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ({"a": "y"}, r"simulate\(events=\): error: events\.a\.when: 'y' is not declared"),
        ({"turns": "theta"}, "event turns: 'turns' is an event already"),
        ({"a": {"when": "theta", "action": "jump", "z": 1}}, r"events\.a\.z: 'z' is no coordinate"),
        ({"a": {"when": "d - 1", "action": "jump", "d": 2}}, r"=\): .*a.when: only jumps"),
        (["theta"], "give a dict"),
    ],
)  # fmt: skip
def test_invalid_event_of_a_system_is_named(events: dict, message: str, tmp_path: Path) -> None:
    info = SimpleNamespace(name="swinging", events=("turns",))
    m = SimpleNamespace(info=info, source=pendulum())
    with pytest.raises(EomcError, match=message):
        pipeline.with_events(m, events, tmp_path)


@pytest.mark.slow
def test_system_read_from_a_file_works_and_changed_one_is_refused(
    scene: Path, tmp_path: Path
) -> None:
    system = eomc.read(scene)
    run = eomc.load(system, tmp_path).simulate(duration=1.0, events=EVENTS)
    assert run.events["through"].t == pytest.approx([math.pi / 6], abs=TOL)
    for changed in (system.with_parameters({"k": 5.0}), pendulum().with_parameters({"w": 1.0})):
        info = SimpleNamespace(name=changed.name, events=("turns",))
        m = SimpleNamespace(info=info, source=changed)
        with pytest.raises(EomcError, match=r"was changed since .* made it: give"):
            pipeline.with_events(m, EVENTS, tmp_path)
