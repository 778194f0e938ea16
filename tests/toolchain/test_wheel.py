"""A wheel of a compiled scene: what is in it, and what it does where there is no eomc."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from cases import SCENES
from click.testing import CliRunner
from toolchain.test_installed import environment, fresh, pip

from eomc import pipeline
from eomc.base import resources
from eomc.cli.main import main
from eomc.toolchain import wheel

NAME = "cartpole-0.1.0+sceneddc4d1636089-cp311-abi3-"


def test_no_file_of_a_module_is_called_as_one_that_wheels_write() -> None:
    """One of runtime/ was written over, and no wheel could be imported."""
    assert f"{wheel.COMPILED}.py" not in resources.runtime(batch=True)


def packed(folder: Path, text: str) -> Path:
    """The wheel of a scene's text."""
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return pipeline.write_wheel(folder / "scene.toml", folder)


def cartpole(change: str = "", to: str = "") -> str:
    return (SCENES / "cartpole.toml").read_text(encoding="utf-8").replace(change, to)


def ran(python: Path | str, code: str, at: Path, **variables: str) -> str:
    """What Python code prints; it ends well."""
    done = subprocess.run(
        [str(python), "-c", code], capture_output=True, text=True, cwd=at,
        env={**environment(), **variables},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- what is in it --------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_wheel_has_the_scene_types_and_a_record(
    tmp_path: Path, quickly_compiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, ["build", str(SCENES / "cartpole.toml"), "--wheel", "--json"])
    assert done.exit_code == 0, done.output
    (file,) = tmp_path.glob("*.whl")
    assert json.loads(done.output)[0]["wheel"] == file.name and file.name.startswith(NAME)
    assert sorted(os.listdir(tmp_path)) == [file.name]
    with zipfile.ZipFile(file) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}
    assert {"py.typed", "__init__.pyi", "compiled.py", "_cartpole_given.abi3.so"} <= {
        name.split("/")[1] for name in held
    }
    assert held["cartpole/cartpole.toml"] == (SCENES / "cartpole.toml").read_bytes()
    (record,) = (name for name in held if name.endswith("RECORD"))
    rows = [row.split(",") for row in held[record].decode().splitlines()]
    assert {row[0] for row in rows} == set(held)
    for name, digest, size in rows:
        if name != record:
            found = base64.urlsafe_b64encode(hashlib.sha256(held[name]).digest()).rstrip(b"=")
            assert (digest, int(size)) == (f"sha256={found.decode()}", len(held[name]))
    again = file.read_bytes()
    assert CliRunner().invoke(main, ["build", str(SCENES / "cartpole.toml"), "--wheel"]).output
    assert file.read_bytes() == again, "same scene, same bytes"
    with zipfile.ZipFile(file) as archive:
        archive.extractall(tmp_path / "site")
    code = "import cartpole; print(cartpole.simulate().status, cartpole.compiled.form)"
    assert ran(sys.executable, code, tmp_path, PYTHONPATH="site").split() == ["ok", "given"]


def test_a_title_is_one_line_of_metadata(tmp_path: Path, quickly_compiled: None) -> None:
    text = cartpole('"Cart-pole"', '"Wägelchen: a, b; Name: x"')
    with zipfile.ZipFile(packed(tmp_path, text)) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("METADATA"))
        lines = archive.read(name).decode("utf-8").splitlines()
    assert "Summary: Wägelchen: a, b; Name: x: compiled equations of motion" in lines
    assert [line for line in lines if line.startswith("Name:")] == ["Name: cartpole"]
    assert wheel._metadata("a", "1", "x\nName: b").count("\nName: ") == 1


def test_what_can_not_be_written_is_told(tmp_path: Path, quickly_compiled: None) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(pipeline.EomcError, match="can't be written"):
        pipeline.write_wheel(SCENES / "cartpole.toml", tmp_path / "file" / "dist")
    words = ["build", str(SCENES / "cartpole.toml"), "--wheel", "--c", "x"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2 and "choose one" in done.output


def test_generations_of_processors_go_from_wide_to_narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EOMC_CFLAGS", raising=False)
    monkeypatch.setattr(wheel.platform, "machine", lambda: "x86_64")
    found = wheel.generations()
    assert [g.name for g in found] == ["avx512", "avx2", "baseline"]
    assert set(found[0].needs) > set(found[1].needs) > set(found[2].needs) == set()
    assert all("-march=native" not in g.flags and "-O3" in g.flags for g in found)
    monkeypatch.setattr(wheel.platform, "machine", lambda: "aarch64")
    assert [g.name for g in wheel.generations()] == ["baseline"]


# --- where it is installed ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with the cart-pole's wheel, and what that asks for."""
    folder = tmp_path_factory.mktemp("wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("EOMC_CFLAGS", raising=False)
        file = pipeline.write_wheel(SCENES / "cartpole.toml", folder)
    found = fresh(folder / "venv")
    done = pip(found, str(file))
    if done.returncode:
        pytest.skip(f"NumPy and cffi can't be installed: {done.stderr.strip()[-200:]}")
    return found


TOLD = """
import json, importlib.util, cartpole, cartpole.compiled
assert importlib.util.find_spec("eomc") is None
print(json.dumps([cartpole.compiled.form, cartpole.digest, cartpole.simulate().x[-1].tolist()]))
"""


@pytest.mark.slow
def test_a_fresh_environment_runs_it_in_every_form(
    python: Path, tmp_path: Path, cartpole: ModuleType
) -> None:
    """Those that this processor has; without a wish the first."""
    compiled = "import cartpole.compiled as c; print(*(n for n in c.FORMS if "
    there = ran(python, compiled + "c._processor().issuperset(c.FORMS[n][1])))", tmp_path).split()
    assert there[-1] == "baseline"
    wanted = cartpole.simulate().x[-1]
    for form in ["", *there]:
        found, digest, x = json.loads(ran(python, TOLD, tmp_path, EOMC_PROCESSOR=form))
        assert found == (form or there[0]) and digest == cartpole.digest
        np.testing.assert_allclose(x, wanted, rtol=1e-10, atol=1e-10)
    code = "\ntry:\n    import cartpole\nexcept ImportError as fault:\n    print(fault)"
    assert "is none of avx512" in ran(python, code, tmp_path, EOMC_PROCESSOR="mmx")


@pytest.mark.slow
def test_type_checkers_know_its_functions(python: Path, tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "use.py").write_text(
        "import cartpole\nreveal_type(cartpole.simulate().q)\ncartpole.simulate(duraton=3.0)\n"
        "cartpole.nothing\n"
    )
    (site,) = python.parent.parent.glob("lib/*/site-packages")
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", "cache", "use.py"]
    how = {**os.environ, "MYPYPATH": str(site)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=how)
    assert 'use.py:2: note: Revealed type is "numpy.ndarray' in done.stdout
    assert 'use.py:3: error: Argument "duraton"' in done.stdout
    assert 'Module has no attribute "nothing"' in done.stdout


NUMBA = """
import numba, numpy as np, cartpole
from cartpole import compiled
from cartpole.compiled import ffi, lib
from numba.core.typing import cffi_utils

cffi_utils.register_module(compiled)
step = lib.rk4_step


@numba.njit
def run(q, qd, h, steps, p):
    at, moving, given = ffi.from_buffer(q), ffi.from_buffer(qd), ffi.from_buffer(p)
    status = 0
    for k in range(steps):
        status = max(status, step(at, moving, at, moving, k*h, h, given, given))
    return status


q, qd = cartpole.start
status = run(q, qd, cartpole._model.info.h, 2000, np.array([*cartpole.defaults.values()]))
print(status, abs(np.hstack([q, qd]) - cartpole.simulate().x[-1]).max())
"""
SCIPY = """
import numpy as np, cartpole
from cartpole.compiled import ffi, lib
from scipy import LowLevelCallable, integrate

p = np.array([*cartpole.defaults.values()])
for name in ("potential_energy", "energy"):
    f = LowLevelCallable(ffi.addressof(lib, name + "_at"), ffi.cast("void *", p.ctypes.data))
    found, _ = integrate.quad(f, 0, 1, args=(0.5, 0.25, 0.75))
    x = [0.0, 0.5, 0.25, 0.75]
    wanted = getattr(cartpole, name)(x[:2], *([x[2:]] if name == "energy" else []))
    print(abs(found - wanted))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("library", "code"), [("numba", NUMBA), ("scipy", SCIPY)])
def test_numba_and_scipy_call_its_functions(
    library: str, code: str, python: Path, tmp_path: Path
) -> None:
    done = pip(python, library)
    if done.returncode:
        pytest.skip(f"{library} can't be installed: {done.stderr.strip()[-200:]}")
    numbers = [float(x) for x in ran(python, code, tmp_path).split()]
    assert len(numbers) == 2 and max(numbers) < 1e-9


def test_the_functions_for_scipy_are_those_of_the_state_alone() -> None:
    def at(name: str) -> set[str]:
        cdef = pipeline.sources(pipeline.read(SCENES / f"{name}.toml")).cdef
        return set(re.findall(r"double (\w+)_at\(", cdef))

    assert at("cartpole") == {"kinetic_energy", "potential_energy", "energy"}
    assert at("kapitza_pendulum") == set()  # time is in its energies
