"""The wheel of a compiled scene: its contents, and its use without eomc."""

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
from click.testing import CliRunner
from support.cases import SCENES
from toolchain.test_installed import create_environment, environment, pip

from eomc import pipeline
from eomc.base import resources
from eomc.cli.main import main
from eomc.toolchain import archives

NAME = "cartpole-0.2.0.dev0+sceneddc4d1636089-cp311-abi3-"


def test_no_module_file_has_a_name_that_wheels_write() -> None:
    """A file of runtime/ was once overwritten, so that no wheel could be imported."""
    assert f"{archives.COMPILED}.py" not in resources.runtime(batch=True)


def write_wheel_of(folder: Path, text: str) -> Path:
    """Write the wheel of a scene given as text."""
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return pipeline.write_wheel(folder / "scene.toml", folder)


def cartpole(change: str = "", to: str = "") -> str:
    return (SCENES / "cartpole.toml").read_text(encoding="utf-8").replace(change, to)


def output_of(python: Path | str, code: str, folder: Path, **variables: str) -> str:
    """Return the output of Python code, which must succeed."""
    process = subprocess.run(
        [str(python), "-c", code], capture_output=True, text=True, cwd=folder,
        env={**environment(), **variables},
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    return process.stdout


# --- what is in it --------------------------------------------------------------------------------


@pytest.mark.slow
def test_wheel_contains_the_scene_types_and_a_record(
    tmp_path: Path, quickly_compiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, ["build", str(SCENES / "cartpole.toml"), "--wheel", "--json"])
    assert result.exit_code == 0, result.output
    (file,) = tmp_path.glob("*.whl")
    assert json.loads(result.output)[0]["wheel"] == file.name and file.name.startswith(NAME)
    assert sorted(os.listdir(tmp_path)) == [file.name]
    with zipfile.ZipFile(file) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    assert {"py.typed", "__init__.pyi", "compiled.py", "_cartpole_given.abi3.so"} <= {
        name.split("/")[1] for name in contents
    }
    assert contents["cartpole/cartpole.toml"] == (SCENES / "cartpole.toml").read_bytes()
    (record,) = (name for name in contents if name.endswith("RECORD"))
    rows = [row.split(",") for row in contents[record].decode().splitlines()]
    assert {row[0] for row in rows} == set(contents)
    for name, digest, size in rows:
        if name != record:
            encoded_digest = base64.urlsafe_b64encode(
                hashlib.sha256(contents[name]).digest()
            ).rstrip(b"=")
            assert (digest, int(size)) == (f"sha256={encoded_digest.decode()}", len(contents[name]))
    again = file.read_bytes()
    assert CliRunner().invoke(main, ["build", str(SCENES / "cartpole.toml"), "--wheel"]).output
    assert file.read_bytes() == again, "same scene, same bytes"
    with zipfile.ZipFile(file) as archive:
        archive.extractall(tmp_path / "site")
    code = "import cartpole; print(cartpole.simulate().status, cartpole.compiled.form)"
    assert output_of(sys.executable, code, tmp_path, PYTHONPATH="site").split() == ["ok", "given"]


def test_title_is_one_line_of_metadata(tmp_path: Path, quickly_compiled: None) -> None:
    text = cartpole('"Cart-pole"', '"Wägelchen: a, b; Name: x"')
    with zipfile.ZipFile(write_wheel_of(tmp_path, text)) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("METADATA"))
        lines = archive.read(name).decode("utf-8").splitlines()
    assert "Summary: Wägelchen: a, b; Name: x: compiled equations of motion" in lines
    assert [line for line in lines if line.startswith("Name:")] == ["Name: cartpole"]
    assert archives._metadata("a", "1", "x\nName: b").count("\nName: ") == 1


def test_unwritable_wheel_is_reported(tmp_path: Path, quickly_compiled: None) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(pipeline.EomcError, match="can't be written"):
        pipeline.write_wheel(SCENES / "cartpole.toml", tmp_path / "file" / "dist")
    words = ["build", str(SCENES / "cartpole.toml"), "--wheel", "--c", "x"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 2 and "choose one" in result.output


def test_processor_generations_are_ordered_from_wide_to_narrow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("EOMC_CFLAGS", raising=False)
    monkeypatch.setattr(archives.platform, "machine", lambda: "x86_64")
    generations = archives.generations()
    assert [g.name for g in generations] == ["avx512", "avx2", "baseline"]
    assert (
        set(generations[0].needs) > set(generations[1].needs) > set(generations[2].needs) == set()
    )
    assert all("-march=native" not in g.flags and "-O3" in g.flags for g in generations)
    monkeypatch.setattr(archives.platform, "machine", lambda: "aarch64")
    assert [g.name for g in archives.generations()] == ["baseline"]


# --- where it is installed ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of a new environment with the cart-pole's wheel and its dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("EOMC_CFLAGS", raising=False)
        file = pipeline.write_wheel(SCENES / "cartpole.toml", folder)
    executable = create_environment(folder / "venv")
    result = pip(executable, str(file))
    if result.returncode:
        pytest.skip(f"NumPy and cffi can't be installed: {result.stderr.strip()[-200:]}")
    return executable


REPORT_CODE = """
import json, importlib.util, cartpole, cartpole.compiled
assert importlib.util.find_spec("eomc") is None
print(json.dumps([cartpole.compiled.form, cartpole.digest, cartpole.simulate().x[-1].tolist()]))
"""


@pytest.mark.slow
def test_new_environment_runs_every_form(
    python: Path, tmp_path: Path, cartpole: ModuleType
) -> None:
    """The forms are those of this processor; without a request the first one is used."""
    compiled = "import cartpole.compiled as c; print(*(n for n in c.FORMS if "
    available = output_of(
        python, compiled + "c._processor().issuperset(c.FORMS[n][1])))", tmp_path
    ).split()
    assert available[-1] == "baseline"
    expected = cartpole.simulate().x[-1]
    for form in ["", *available]:
        form_used, digest, x = json.loads(
            output_of(python, REPORT_CODE, tmp_path, EOMC_PROCESSOR=form)
        )
        assert form_used == (form or available[0]) and digest == cartpole.digest
        np.testing.assert_allclose(x, expected, rtol=1e-10, atol=1e-10)
    code = "\ntry:\n    import cartpole\nexcept ImportError as fault:\n    print(fault)"
    assert "is none of avx512" in output_of(python, code, tmp_path, EOMC_PROCESSOR="mmx")


@pytest.mark.slow
def test_type_checkers_accept_its_functions(python: Path, tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "use.py").write_text(
        "import cartpole\nreveal_type(cartpole.simulate().q)\ncartpole.simulate(duraton=3.0)\n"
        "cartpole.nothing\n"
    )
    (site,) = python.parent.parent.glob("lib/*/site-packages")
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", "cache", "use.py"]
    how = {**os.environ, "MYPYPATH": str(site)}
    process = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=how)
    assert 'use.py:2: note: Revealed type is "numpy.ndarray' in process.stdout
    assert 'use.py:3: error: Argument "duraton"' in process.stdout
    assert 'Module has no attribute "nothing"' in process.stdout


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
status = run(q, qd, 0.005, 2000, np.array([*cartpole.defaults.values()]))
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
def test_numba_and_scipy_call_the_functions(
    library: str, code: str, python: Path, tmp_path: Path
) -> None:
    result = pip(python, library)
    if result.returncode:
        pytest.skip(f"{library} can't be installed: {result.stderr.strip()[-200:]}")
    numbers = [float(x) for x in output_of(python, code, tmp_path).split()]
    assert len(numbers) == 2 and max(numbers) < 1e-9


def test_functions_for_scipy_depend_on_the_state_only() -> None:
    def functions_of_state(name: str) -> set[str]:
        cdef = pipeline.sources(pipeline.read(SCENES / f"{name}.toml")).cdef
        return set(re.findall(r"double (\w+)_at\(", cdef))

    assert functions_of_state("cartpole") == {"kinetic_energy", "potential_energy", "energy"}
    assert functions_of_state("kapitza_pendulum") == set()  # its energies depend on time
