"""A pickled value belongs to the build that pickled it, whatever is built under its name since."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import batches
import numpy as np
import pytest
from cases import SCENES
from conftest import MODULES
from eventful import BALL, built

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


def forget(name: str) -> None:
    """Leave this process as one that has not loaded the builds of a scene."""
    for module in [m for m in sys.modules if m.startswith(f"_eomc_{name}_")]:
        del sys.modules[module]


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """What each version of a scene pickles, by the name of the version; all were built in turn."""
    root = tmp_path_factory.mktemp("versions")
    scene, pickled = root / "carriage.toml", {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EOMC_CFLAGS", "-O0")
        for name, text in {"first": TEXT, "reordered": REORDERED, "heavier": HEAVIER}.items():
            scene.write_text(text, encoding="utf-8")
            m = eomc.load(scene, root / "build")
            values = {
                "module": m, "function": m.energy, "model": m._model, "run": m.simulate(),
                "params": m.Params(m=0.7), "rest": m.equilibrium(free=["theta"]),
                "error": m.simulate().estimate(), "fault": m.MotionError("words", "singular"),
            }  # fmt: skip
            pickled[name] = {what: pickle.dumps(value) for what, value in values.items()}
    pickled["root"] = {"root": str(root / "build").encode()}
    return pickled


@pytest.fixture
def folder(versions: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of their builds, as a process finds it that has loaded none of them."""
    place = Path(versions["root"]["root"].decode()) / "carriage"
    stored = place.with_name("stored")
    shutil.copytree(place, stored)
    forget("carriage")
    yield place
    forget("carriage")
    shutil.rmtree(place)
    stored.rename(place)


def test_each_version_is_read_as_it_was_pickled(
    versions: dict[str, Any], folder: Path, no_warnings: None
) -> None:
    """And a process that has read one reads another, newer or older."""
    for name, m, order in (
        ("first", 0.1, ("x", "theta")),
        ("heavier", 0.3, ("x", "theta")),
        ("reordered", 0.1, ("theta", "x")),
        ("first", 0.1, ("x", "theta")),
    ):
        read = {what: pickle.loads(text) for what, text in versions[name].items()}
        module, run = read["module"], read["run"]
        assert module.defaults == {"m": m} and module.coordinates == order
        assert [run["x"][0], run["theta"][0]] == [0.5, 0.1]
        assert run.to_dict()["x"][0] == 0.5 and run.model is model_of(module) is read["model"]
        assert read["function"](*module.start) == module.energy(*module.start)
        assert run.energy[0] == module.energy(*module.start)
        assert type(read["rest"]).__name__ == "Equilibrium" and read["rest"].q.shape == (2,)
        assert read["error"].digits.keys() == set(order) | {f"{c}_dot" for c in order}


def test_a_module_whose_build_is_gone_is_refused_when_it_is_used(
    versions: dict[str, Any], folder: Path
) -> None:
    """A pool would wait for ever for a task whose reading raises an error."""
    shutil.rmtree(folder / ".builds")
    module, function = (pickle.loads(versions["first"][x]) for x in ("module", "function"))
    words = r"carriage: this was pickled by the build _carriage_\w{12}, which is gone"
    for use in UNREADABLE_USES:
        with pytest.raises(eomc.EomcError, match=words):
            use(module)
    with pytest.raises(eomc.EomcError, match=words):
        function([0.0, 0.0], [0.0, 0.0])
    assert repr(module).startswith("<unreadable: ") and not hasattr(module, "__len_hint__")
    # another process that has the build reads what this one could not
    passed_on = pickle.dumps((module, function))
    (folder.with_name("stored") / ".builds").rename(folder / ".builds")
    module, function = pickle.loads(passed_on)
    assert module.defaults == {"m": 0.1} and function([0.5, 0.1], [0.0, 0.0]) > 0
    shutil.copytree(folder / ".builds", folder.with_name("stored") / ".builds")


UNREADABLE_USES: list[Callable[[Any], object]] = [
    lambda m: m.defaults["m"], lambda m: m.simulate(), lambda m: range(m.nq), lambda m: len(m.q),
    lambda m: list(m.coordinates), lambda m: np.asarray(m.q), lambda m: float(m.h),
    lambda m: m.status == "ok", lambda m: m.name or "", lambda m: m["x"], lambda m: 2 * m.t,
    lambda m: setattr(m, "x", 1),
]  # fmt: skip


def test_data_of_a_build_that_is_gone_are_read_by_their_names(
    versions: dict[str, Any], folder: Path
) -> None:
    """With a warning where the columns are those of the present version, else refused by name."""
    shutil.rmtree(folder / ".builds")
    for what in ("run", "params", "rest", "error"):
        with pytest.warns(RuntimeWarning, match="pickled by another build of the scene, which is"):
            pickle.loads(versions["first"][what])
        with pytest.raises(eomc.EomcError, match=r"whose coordinates were theta, x; here they are"):
            len(pickle.loads(versions["reordered"][what]).q)
    with pytest.warns(RuntimeWarning):
        run = pickle.loads(versions["first"]["run"])
    assert run["x"][0] == 0.5 and run.params == {"m": 0.1} and run.model.info.defaults == {"m": 0.3}


def test_where_no_build_is_left_all_but_errors_is_refused(
    versions: dict[str, Any], folder: Path
) -> None:
    shutil.rmtree(folder)
    for what in ("module", "function", "run", "params", "error"):
        with pytest.raises(eomc.EomcError, match=r"the build of carriage that pickled this is go"):
            len(pickle.loads(versions["first"][what]))
    assert pickle.loads(versions["first"]["fault"]).status == "singular"
    folder.mkdir()


def test_a_damaged_build_is_not_read(versions: dict[str, Any], folder: Path) -> None:
    for file in folder.glob(".builds/*/_runtime/status.py"):
        file.write_text(file.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    with pytest.raises(eomc.EomcError, match="which is gone"):
        pickle.loads(versions["first"]["module"]).simulate()


# --- all that can be pickled ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def values(unoptimised_file: None) -> dict[str, Any]:
    """One of each kind."""
    ball, many = built(BALL), batches.module("mass_spring")
    run, runs = ball.simulate(duration=1.0), ball.simulate_batch([[0, 1], [0, 2]], duration=0.5)
    return {
        "batch": many.simulate_batch([[0.1], [0.2]], steps=10),
        "batch at times": many.simulate_batch([[0.1], [0.2]], times=[0.0, 0.05]),
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


@pytest.mark.parametrize("what", KINDS)
def test_a_value_is_read_where_its_module_was_not_loaded(
    values: dict[str, Any], what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    value, pickled = values[what], pickle.dumps(values[what])
    for name in [m for m in sys.modules if m.startswith("_eomc_")]:
        monkeypatch.delitem(sys.modules, name)
    other = pickle.loads(pickled)
    assert type(other) is not type(value) and type(other).__name__ == type(value).__name__
    assert repr(other) == repr(value)
    if hasattr(value, "to_dict"):
        mine, read = value.to_dict(), other.to_dict()
        assert mine.keys() == read.keys()
        assert all(np.array_equal(mine[k], read[k], equal_nan=True) for k in mine)


@pytest.mark.parametrize("what", KINDS)
@pytest.mark.parametrize("field", ["coordinates", "parameters", "inputs", "events"])
def test_no_value_is_read_under_other_names(values: dict[str, Any], what: str, field: str) -> None:
    """Events too: what a run stores of them is numbered."""
    if what == "interrupted":  # its words are its own; the run inside is a value by itself
        return
    function, (place, pickled, *rest) = values[what].__reduce__()
    same = Identity(*pickled)._replace(extension="_another_0")
    with pytest.warns(RuntimeWarning, match="another build of the scene"):
        function(place, tuple(same), *rest)
    other = same._replace(**{field: (*getattr(same, field)[::-1], "more")})
    with pytest.raises(eomc.EomcError, match=f"whose {field} were .*more; here they are"):
        len(function(place, tuple(other), *rest))


def test_numbers_of_another_precision_are_refused(values: dict[str, Any]) -> None:
    function, (place, pickled, *rest) = values["batch"].__reduce__()
    other = Identity(*pickled)._replace(extension="_another_0", dtype="float32")
    with pytest.raises(eomc.EomcError, match="pickled in float32; the build here has float64"):
        len(function(place, tuple(other), *rest))


def test_a_saved_run_with_other_events_is_refused(values: dict[str, Any], tmp_path: Path) -> None:
    file, ball = tmp_path / "run.npz", built(BALL)
    values["adaptive run"].save(file)
    stored = dict(np.load(file))
    stored["events"] = np.array([*stored["events"][::-1], "more"])
    np.savez(file, **stored)
    with pytest.raises(ValueError, match=r"whose events were .*more; here they are"):
        ball.load_run(file)
    del stored["events"]  # as files of an older version
    np.savez(file, **stored)
    assert ball.load_run(file) == values["adaptive run"]


def test_a_module_imported_by_its_own_name_is_refused_where_another_build_stands(
    cartpole: ModuleType,
) -> None:
    """It is found by that name alone: another build has the name now."""
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
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={"PYTHONPATH": str(MODULES)},
    )
    assert "pickled by the build _cartpole_0, which is gone" in done.stdout, done.stderr


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
@pytest.mark.parametrize("how", ["spawn", "forkserver"])
def test_a_pool_reads_each_version_and_never_waits(how: str, tmp_path: Path) -> None:
    file, script = tmp_path / "cartpole.toml", tmp_path / "pool.py"
    shutil.copy(SCENES / "cartpole.toml", file)
    script.write_text(POOL, encoding="utf-8")
    words = [sys.executable, str(script), str(file), str(tmp_path / "build"), how]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.splitlines() == [
        "2.0 4.0", "3.0 4.0", "4.0 4.0", "['refused', 'refused', 4.0] refused",
    ], done.stderr  # fmt: skip
