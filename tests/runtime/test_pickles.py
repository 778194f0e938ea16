"""A pickled value belongs to the build that pickled it, whatever was built under its name later."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support import trajectories
from support.cases import SCENES
from support.event_scenes import BALL, built
from support.session import MODULES

import eomc
from eomc.runtime.package import Identity, model_of

TEXT = """
eomc = 1
name = "carriage"
[coordinates]
x     = { unit = "m", start = 0.5 }
theta = { unit = "rad", start = 0.1 }
[parameters]
m = 0.1
[energy]
kinetic   = "x_dot**2/2 + m*theta_dot**2/8"
potential = "m*9.81*cos(theta)/2"
[run]
h        = 0.01
duration = 0.1
"""
REORDERED = TEXT.replace('x     = { unit = "m", start = 0.5 }\n', "").replace(
    "[parameters]", 'x     = { unit = "m", start = 0.5 }\n[parameters]'
)
HEAVIER = TEXT.replace("m = 0.1", "m = 0.3")

pytestmark = pytest.mark.usefixtures("unoptimised_file")


def unload_builds(name: str) -> None:
    """Remove the loaded builds of a scene from this process."""
    for module in [m for m in sys.modules if m.startswith(f"_eomc_{name}_")]:
        del sys.modules[module]


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Pickled values of each version of a scene, by version; the versions were built in turn."""
    root = tmp_path_factory.mktemp("versions")
    scene, pickled = root / "carriage.toml", {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EOMC_CFLAGS", "-O0")
        for name, text in {"first": TEXT, "reordered": REORDERED, "heavier": HEAVIER}.items():
            scene.write_text(text, encoding="utf-8")
            m = eomc.load(scene, root / "build")
            values = {
                "module": m, "function": m.energy, "model": model_of(m), "run": m.simulate(),
                "params": m.Params(m=0.7), "rest": m.equilibrium(free=["theta"]),
                "error": m.simulate().estimate(), "fault": m.MotionError("words", "singular"),
            }  # fmt: skip
            pickled[name] = {kind: pickle.dumps(value) for kind, value in values.items()}
    pickled["root"] = {"root": str(root / "build").encode()}
    return pickled


@pytest.fixture
def folder(versions: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of the builds, in a process that has loaded none of them."""
    path = Path(versions["root"]["root"].decode()) / "carriage"
    stored = path.with_name("stored")
    shutil.copytree(path, stored)
    unload_builds("carriage")
    yield path
    unload_builds("carriage")
    shutil.rmtree(path)
    stored.rename(path)


def test_each_version_is_unpickled_as_it_was(
    versions: dict[str, Any], folder: Path, no_warnings: None
) -> None:
    """A process that has loaded one version can load others, newer or older."""
    for name, m, order in (
        ("first", 0.1, ("x", "theta")),
        ("heavier", 0.3, ("x", "theta")),
        ("reordered", 0.1, ("theta", "x")),
        ("first", 0.1, ("x", "theta")),
    ):
        loaded = {kind: pickle.loads(text) for kind, text in versions[name].items()}
        module, run = loaded["module"], loaded["run"]
        assert module.defaults == {"m": m} and module.coordinates == order
        assert [run["x"][0], run["theta"][0]] == [0.5, 0.1]
        assert run.to_dict()["x"][0] == 0.5 and run.model is model_of(module) is loaded["model"]
        assert loaded["function"](*module.start) == module.energy(*module.start)
        assert run.energy[0] == module.energy(*module.start)
        assert type(loaded["rest"]).__name__ == "Equilibrium" and loaded["rest"].q.shape == (2,)
        assert loaded["error"].digits.keys() == set(order) | {f"{c}_dot" for c in order}


def test_module_of_a_deleted_build_is_refused_on_use(
    versions: dict[str, Any], folder: Path
) -> None:
    """Not on unpickling: a pool would wait for ever for a task that fails to unpickle."""
    shutil.rmtree(folder / ".builds")
    module, function = (pickle.loads(versions["first"][x]) for x in ("module", "function"))
    message = r"carriage: this was pickled by the build _carriage_\w{12}, which is gone"
    for use in UNREADABLE_USES:
        with pytest.raises(eomc.EomcError, match=message):
            use(module)
    with pytest.raises(eomc.EomcError, match=message):
        function([0.0, 0.0], [0.0, 0.0])
    assert repr(module).startswith("<unreadable: ") and not hasattr(module, "__len_hint__")
    # another process that has the build can unpickle what this one could not
    repickled = pickle.dumps((module, function))
    (folder.with_name("stored") / ".builds").rename(folder / ".builds")
    module, function = pickle.loads(repickled)
    assert module.defaults == {"m": 0.1} and function([0.5, 0.1], [0.0, 0.0]) > 0
    shutil.copytree(folder / ".builds", folder.with_name("stored") / ".builds")


UNREADABLE_USES: list[Callable[[Any], object]] = [
    lambda m: m.defaults["m"], lambda m: m.simulate(), lambda m: range(m.nq), lambda m: len(m.q),
    lambda m: list(m.coordinates), lambda m: np.asarray(m.q), lambda m: float(m.h),
    lambda m: m.status == "ok", lambda m: m.name or "", lambda m: m["x"], lambda m: 2 * m.t,
    lambda m: setattr(m, "x", 1),
]  # fmt: skip


def test_data_of_a_deleted_build_are_unpickled_by_column_names(
    versions: dict[str, Any], folder: Path
) -> None:
    """With a warning if the columns equal those of the present version, else refused by name."""
    shutil.rmtree(folder / ".builds")
    for kind in ("run", "params", "rest", "error"):
        with pytest.warns(RuntimeWarning, match="pickled by another build of the scene, which is"):
            pickle.loads(versions["first"][kind])
        with pytest.raises(eomc.EomcError, match=r"whose coordinates were theta, x; here they are"):
            len(pickle.loads(versions["reordered"][kind]).q)
    with pytest.warns(RuntimeWarning):
        run = pickle.loads(versions["first"]["run"])
    assert run["x"][0] == 0.5 and run.params == {"m": 0.1} and run.model.info.defaults == {"m": 0.3}


def test_all_but_errors_are_refused_if_no_build_is_left(
    versions: dict[str, Any], folder: Path
) -> None:
    shutil.rmtree(folder)
    for kind in ("module", "function", "run", "params", "error"):
        with pytest.raises(eomc.EomcError, match=r"the build of carriage that pickled this is go"):
            len(pickle.loads(versions["first"][kind]))
    assert pickle.loads(versions["first"]["fault"]).status == "singular"
    folder.mkdir()


def test_damaged_build_is_not_loaded(versions: dict[str, Any], folder: Path) -> None:
    for file in folder.glob(".builds/*/_runtime/status.py"):
        file.write_text(file.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    with pytest.raises(eomc.EomcError, match="which is gone"):
        pickle.loads(versions["first"]["module"]).simulate()


# --- all kinds of pickled values ------------------------------------------------------------------


@pytest.fixture(scope="module")
def values(unoptimised_file: None) -> dict[str, Any]:
    """One value of each kind."""
    ball, batch = built(BALL), trajectories.module("mass_spring")
    run, runs = ball.simulate(duration=1.0), ball.simulate_batch([[0, 1], [0, 2]], duration=0.5)
    return {
        "batch": batch.simulate_batch([[0.1], [0.2]], steps=10),
        "batch at times": batch.simulate_batch([[0.1], [0.2]], times=[0.0, 0.05]),
        "adaptive batch": runs,
        "adaptive run": run,
        "stepped run": ball.simulate(h=0.01, duration=1.0),
        "events": run.events["impact"],
        "events of a batch": runs.events["impact"],
        "balance": run.balance(),
        "interrupted": ball.Interrupted(run),
    }


KINDS = [
    "batch", "batch at times", "adaptive batch", "adaptive run", "stepped run", "events",
    "events of a batch", "balance", "interrupted",
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_value_is_unpickled_without_a_loaded_module(
    values: dict[str, Any], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    value, pickled = values[kind], pickle.dumps(values[kind])
    for name in [m for m in sys.modules if m.startswith("_eomc_")]:
        monkeypatch.delitem(sys.modules, name)
    loaded = pickle.loads(pickled)
    assert type(loaded) is not type(value) and type(loaded).__name__ == type(value).__name__
    assert repr(loaded) == repr(value)
    if hasattr(value, "to_dict"):
        expected, actual = value.to_dict(), loaded.to_dict()
        assert expected.keys() == actual.keys()
        assert all(np.array_equal(expected[k], actual[k], equal_nan=True) for k in expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("field", ["coordinates", "parameters", "inputs", "events"])
def test_value_with_other_names_is_refused(values: dict[str, Any], kind: str, field: str) -> None:
    """Names of events too: a run stores their numbers."""
    if kind == "interrupted":  # it has only a message; the run inside is a value by itself
        return
    function, (path, pickled, *rest) = values[kind].__reduce__()
    identity = Identity(*pickled)._replace(extension="_another_0")
    with pytest.warns(RuntimeWarning, match="another build of the scene"):
        function(path, tuple(identity), *rest)
    changed = identity._replace(**{field: (*getattr(identity, field)[::-1], "more")})
    with pytest.raises(eomc.EomcError, match=f"whose {field} were .*more; here they are"):
        len(function(path, tuple(changed), *rest))


def test_numbers_of_another_precision_are_refused(values: dict[str, Any]) -> None:
    function, (path, pickled, *rest) = values["batch"].__reduce__()
    changed = Identity(*pickled)._replace(extension="_another_0", dtype="float32")
    with pytest.raises(eomc.EomcError, match="pickled in float32; the build here has float64"):
        len(function(path, tuple(changed), *rest))


@pytest.mark.parametrize("path", ["trajectory.Run._of_state", "adaptive.AdaptiveRun._of_state"])
def test_class_of_an_earlier_version_is_refused(values: dict[str, Any], path: str) -> None:
    function, (place, pickled, _, *rest) = values["batch"].__reduce__()
    changed = Identity(*pickled)._replace(extension="_another_0")
    with pytest.raises(eomc.EomcError, match="pickled by an earlier version of eomc"):
        len(function(place, tuple(changed), path, *rest))


def test_saved_run_with_other_events_is_refused(values: dict[str, Any], tmp_path: Path) -> None:
    file, ball = tmp_path / "run.npz", built(BALL)
    values["adaptive run"].save(file)
    stored = dict(np.load(file))
    stored["events"] = np.array([*stored["events"][::-1], "more"])
    np.savez(file, **stored)
    with pytest.raises(ValueError, match=r"whose events were .*more; here they are"):
        ball.load_run(file)
    del stored["events"]  # as in files of older versions
    np.savez(file, **stored)
    assert ball.load_run(file) == values["adaptive run"]


def test_module_imported_by_its_own_name_is_refused_if_another_build_has_the_name(
    cartpole: ModuleType,
) -> None:
    """Such a module is found by its name alone, which another build now has."""
    code = """
import pickle, sys
import cartpole as m
function, (identity, path, arguments) = m.__reduce__()
read = function(identity, path, arguments)
assert read is m and pickle.loads(pickle.dumps(m)) is m
other = function(("_cartpole_0", *identity[1:]), path, arguments)
try:
    other.simulate()
except RuntimeError as fault:
    print(fault)
"""
    process = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={"PYTHONPATH": str(MODULES)},
    )
    assert "pickled by the build _cartpole_0, which is gone" in process.stdout, process.stderr


# --- pools ----------------------------------------------------------------------------------------

POOL = """
import multiprocessing, pathlib, shutil, sys
import eomc

scene, root, how = pathlib.Path(sys.argv[1]), sys.argv[2], sys.argv[3]

def mass(m):
    return m.defaults["m_c"]

def outcome(pool, call, *arguments):
    try:
        return pool.apply_async(call, arguments).get(30)
    except eomc.EomcError as fault:
        return "refused"

if __name__ == "__main__":
    text = scene.read_text()
    with multiprocessing.get_context(how).Pool(1) as pool:
        versions = []
        for value in ("2.0", "3.0", "4.0"):  # while the worker lives on
            scene.write_text(text.replace("m_c = { value = 2.0", f"m_c = {{ value = {value}"))
            versions.append(eomc.load(scene, root))
            print(outcome(pool, mass, versions[-1]), outcome(pool, versions[0].D, [0.0, 0.5])[0, 0])
        shutil.rmtree(pathlib.Path(root, "cartpole", ".builds"))
    with multiprocessing.get_context(how).Pool(1) as pool:
        print([outcome(pool, mass, m) for m in versions], outcome(pool, versions[0].D, [0.0, 0.5]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_pool_loads_each_version_and_never_waits(method: str, tmp_path: Path) -> None:
    file, script = tmp_path / "cartpole.toml", tmp_path / "pool.py"
    shutil.copy(SCENES / "cartpole.toml", file)
    script.write_text(POOL, encoding="utf-8")
    command = [sys.executable, str(script), str(file), str(tmp_path / "build"), method]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert process.stdout.splitlines() == [
        "2.0 4.0", "3.0 4.0", "4.0 4.0", "['refused', 'refused', 4.0] refused",
    ], process.stderr  # fmt: skip
