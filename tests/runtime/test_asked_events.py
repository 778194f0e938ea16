"""Events that a call asks for, besides those of the scene."""

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

pytestmark = pytest.mark.usefixtures("unoptimised_file")
TOL = 1e-9  # of a scene with events that names none
# compiled once for all tests: two that record, and one each that stops and jumps where it is told
BESIDE = {
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
duration = 10
batch = true
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("asked") / "oscillator.toml"
    file.write_text(TEXT)
    return file


@pytest.fixture(scope="module")
def oscillator(scene: Path) -> ModuleType:
    return eomc.load(scene, scene.parent / "build")


def test_they_stand_beside_the_scene_s(oscillator: ModuleType) -> None:
    run = oscillator.simulate(events=BESIDE)
    assert run.events["section"].t == pytest.approx((np.arange(3) + 0.75) * math.pi, abs=TOL)
    assert run.events["turns"].t == pytest.approx((np.arange(3) + 0.5) * math.pi, abs=TOL)
    assert "section" not in oscillator.simulate().events


def test_a_warning_points_to_the_caller_s_line(oscillator: ModuleType) -> None:
    """Of a run and of a batch, which another module makes; its own estimate's too."""
    never = {"never": "x - 5"}
    stiff = {"params": {"k": 1e6}, "h": 0.0029, "events": never}
    ways = (
        lambda: oscillator.simulate(steps=50, **stiff),
        lambda: oscillator.simulate_batch(steps=50, **stiff | {"h": 0.003}),
        lambda: oscillator.simulate(h=0.5, duration=0.2, events=never),
        lambda: oscillator.simulate(h=0.4, duration=30, estimate=True, events=never),
    )
    for way in ways:
        with pytest.warns(RuntimeWarning) as said:
            way()
        assert {(w.filename, w.lineno) for w in said} == {(__file__, way.__code__.co_firstlineno)}


def test_a_formula_alone_records_both_ways(oscillator: ModuleType) -> None:
    run = oscillator.simulate(duration=math.pi, events=BESIDE)
    assert run.events["through"].t == pytest.approx([math.pi / 6, 5 * math.pi / 6], abs=TOL)
    ways = (oscillator.Params(k=15), {"k": 15})  # parameters of the module serve
    for params in ways:
        run = oscillator.simulate(duration=0.5, params=params, events=BESIDE)
        assert run.events["through"].t == pytest.approx([math.pi / 12], abs=TOL)


def test_they_stop_and_jump(oscillator: ModuleType) -> None:
    stop = {"params": {"at_wall": -0.5}, "events": BESIDE}
    run = oscillator.simulate(**stop)
    assert run.stopped == "wall" and run.t[-1] == pytest.approx(math.pi / 3, abs=TOL)
    both = oscillator.simulate_batch([[1.0], [0.4]], tol=1e-9, **stop)
    assert both.reached == pytest.approx([math.pi / 3, 10], abs=TOL)
    assert both.stopped.tolist() == ["wall", ""] and both.events["wall"].instance.tolist() == [0]
    assert both.events["turns"].for_instance(1).t == pytest.approx(
        (np.arange(3) + 0.5) * math.pi, abs=TOL
    )
    run = oscillator.simulate(duration=3.0, params=oscillator.Params(at_drop=0), events=BESIDE)
    assert run["m"][-1] == 4 and run["c"][-1] == 4


def test_they_are_compiled_once(oscillator: ModuleType, scene: Path) -> None:
    made = scene.parent / "build" / "oscillator" / ".events"

    def dates() -> dict[Path, int]:
        return {f: f.stat().st_mtime_ns for f in made.glob("*/oscillator/_oscillator_*")}

    oscillator.simulate(duration=1.0, events=BESIDE)
    before = dates()
    oscillator._model.extensions.clear()  # as in another process
    run = oscillator.simulate(duration=1.0, events=BESIDE)
    assert len(run.events["through"]) == 1 and dates() == before != {}
    assert pickle.loads(pickle.dumps(run)).events["through"].t == run.events["through"].t


@pytest.mark.usefixtures("no_warnings")
def test_a_saved_run_is_loaded_with_them(oscillator: ModuleType, tmp_path: Path) -> None:
    """Here, and as in another process; between rows its state jumps."""
    how = {"params": {"at_drop": 0}, "events": BESIDE}
    runs = oscillator.simulate(**how), oscillator.simulate_batch([[1.0], [0.4]], tol=1e-9, **how)
    times = [1.0, 2.0, 3.0]
    for k, run in enumerate(runs):
        run.save(tmp_path / f"{k}.npz")
    for _ in range(2):
        for k, run in enumerate(runs):
            again = oscillator.load_run(tmp_path / f"{k}.npz")
            assert again == run and list(again.events) == ["turns", *BESIDE]
            np.testing.assert_array_equal(again.events["drop"].t, run.events["drop"].t)
            if not k:
                assert np.array_equal(again(times), run(times)) and again(2.0)[0][2] == 4
        oscillator._model.extensions.clear()


def test_a_saved_run_without_the_scene_is_told_how(
    oscillator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "run.npz"
    oscillator.simulate(duration=1.0, events=BESIDE).save(file)
    oscillator._model.extensions.clear()
    monkeypatch.setattr(oscillator._model, "source", None)
    with pytest.raises(EomcError, match=r"load it with eomc\.load") as fault:
        oscillator.load_run(file)
    assert "numpy.load reads its rows" in fault.value.__notes__[0]


@pytest.mark.parametrize(
    ("events", "words"),
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
def test_a_fault_is_named(oscillator: ModuleType, events: dict, words: str) -> None:
    with pytest.raises(EomcError, match=r"simulate\(events=\)") as fault:
        oscillator.simulate(events=events)
    assert words in str(fault.value)


def test_a_scene_that_is_not_there_or_another_is_told(
    oscillator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "oscillator.toml"
    other.write_text(TEXT.replace("k = 3", "k = 5"))
    for source, words in (
        (tmp_path / "gone.toml", r"gone\.toml: can't be read \(No such file"),
        (other, "has changed since it was built: load it again"),
        (None, r"load it with eomc\.load"),
    ):
        monkeypatch.setattr(oscillator._model, "source", source)
        with pytest.raises(EomcError, match=words):
            oscillator.simulate(events={"a": "x"})


def test_a_folder_that_can_t_be_written_is_named(
    oscillator: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(EomcError, match=r"oscillator\.toml: can't be written \(Read-only"):
        oscillator.simulate(events={"later": "x - 0.125"})


def swinging() -> eomc.System:
    """A pendulum of dynamicsymbols, whose own event is its turning."""
    theta, (w, d, low, brake) = dynamicsymbols("theta"), sympy.symbols("w d low brake")
    return eomc.System.make(
        "swinging", {theta: 0.5}, theta.diff() ** 2 / 2, w**2 * theta**2 / 2,
        parameters={w: 2.0, d: 0.0, low: -9.0, brake: 9.0}, forces={theta: -d * theta.diff()},
        batch=True,
        events={"turns": {"when": theta.diff(), "direction": "rising"}},
    )  # fmt: skip


def beside_its_own() -> dict:
    """Two that record, and one each that stops and jumps where it is told."""
    theta, d, brake = dynamicsymbols("theta"), sympy.Symbol("d"), sympy.Symbol("brake")
    return {
        "down": {"when": theta, "direction": "rising"},
        "half": "theta - 1/4",
        "stops": {"when": "theta - low", "action": "stop"},
        "brakes": {"when": theta - brake, "action": "jump", theta.diff(): 0, d: "d + 1"},
    }


@pytest.fixture(scope="module")
def systems(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where modules of Systems are built."""
    return tmp_path_factory.mktemp("systems")


def test_a_system_has_them_beside_its_own(systems: Path) -> None:
    made, beside = swinging(), beside_its_own()
    m = eomc.load(made, systems)
    assert made == swinging() and pickle.loads(pickle.dumps(made)) == made
    run = m.simulate(events=beside)
    assert run.events["down"].t == pytest.approx((np.arange(3) + 0.75) * math.pi, abs=TOL)
    assert run.events["turns"].t == pytest.approx((np.arange(3) + 0.5) * math.pi, abs=TOL)
    assert run.events["half"].t[0] == pytest.approx(math.pi / 6, abs=TOL)
    run = m.simulate(duration=2.0, params={"brake": 0.0}, events=beside)
    assert abs(run.q[-1, 0]) < TOL and run["d"][-1] == 1
    both = m.simulate_batch([[0.5], [0.1]], tol=1e-9, params={"low": 0.2}, events=beside)
    assert both.reached == pytest.approx([math.acos(0.4) / 2, 10], abs=TOL)


@pytest.mark.usefixtures("no_warnings")
def test_of_a_system_a_saved_run_finds_them(systems: Path, tmp_path: Path) -> None:
    m, file = eomc.load(swinging(), systems), tmp_path / "run.npz"
    run = m.simulate(duration=1.0, events=beside_its_own())
    run.save(file)
    again = m.load_run(file)
    assert again == run and again.events["half"].t == run.events["half"].t
    m._model.extensions.clear()
    with pytest.raises(ValueError, match=r"which files don't keep: call swinging\.simulate\(ev"):
        m.load_run(file)


def test_of_a_system_they_are_compiled_once(systems: Path) -> None:
    dates = []
    for _ in range(2):  # as in another process
        m = eomc.load(swinging(), systems)
        m._model.extensions.clear()
        m.simulate(duration=1.0, events=beside_its_own())
        (extension,) = systems.glob("swinging/.events/*/swinging/_swinging_*")
        dates.append(extension.stat().st_mtime_ns)
    assert dates[0] == dates[1]


@pytest.mark.parametrize(
    ("events", "words"),
    [
        ({"a": "y"}, r"simulate\(events=\): event a: y not declared"),
        ({"turns": "theta"}, "event turns: 'turns' is an event already"),
        ({"a": {"when": "theta", "action": "jump", "z": 1}}, "event a: z is no coordinate"),
        ({"a": {"when": "d - 1", "action": "jump", "d": 2}}, r"=\): .*a.when: only jumps"),
        (["theta"], "give a dict"),
    ],
)  # fmt: skip
def test_of_a_system_a_fault_is_named(events: dict, words: str, tmp_path: Path) -> None:
    info = SimpleNamespace(name="swinging", events=("turns",))
    m = SimpleNamespace(info=info, source=swinging())
    with pytest.raises(EomcError, match=words):
        pipeline.with_events(m, events, tmp_path)


@pytest.mark.slow
def test_a_system_that_was_read_or_changed(scene: Path, tmp_path: Path) -> None:
    own = eomc.read(scene)
    run = eomc.load(own, tmp_path).simulate(duration=1.0, events=BESIDE)
    assert run.events["through"].t == pytest.approx([math.pi / 6], abs=TOL)
    for changed in (own.with_parameters({"k": 5.0}), swinging().with_parameters({"w": 1.0})):
        m = SimpleNamespace(name=changed.name, source=changed, events=("turns",))
        with pytest.raises(EomcError, match=r"was changed since .* made it: give"):
            pipeline.with_events(m, BESIDE, tmp_path)
