"""Generated C in other projects: a folder, CMake, pkg-config, two versions in one program."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from support.cases import SCENES
from support.compilation import STRICT, compiled, run
from support.session import needs

from eomc import pipeline
from eomc.cli.main import main
from eomc.toolchain import compiler

USE = """#include <PREFIX.h>
#include <cstdio>

int main()
{
    double q[ENUM_NQ] = { 0.0, 0.5 }, qd[ENUM_NQ] = { 0.0, 0.0 };
    const PREFIX_status status = PREFIX_rk4_step(q, qd, 0.5, &PREFIX_defaults);

    std::printf("%d %.17g\\n", static_cast<int>(status), q[ENUM_THETA]);
    return 0;
}
"""
SUBDIRECTORY = """cmake_minimum_required(VERSION 3.13)
project(robot LANGUAGES CXX)
add_subdirectory(cartpole)
add_executable(robot robot.cpp)
target_link_libraries(robot PRIVATE cartpole::cartpole)
"""
INSTALLED = SUBDIRECTORY.replace("add_subdirectory(cartpole)", "find_package(cartpole REQUIRED)")


def eomc(*words: str) -> Result:
    return CliRunner().invoke(main, words)


def build_c(folder: Path, *words: str) -> Path:
    """Write the C of the cart-pole with `eomc build --c`; return the folder."""
    result = eomc("build", str(SCENES / "cartpole.toml"), "--c", str(folder), *words)
    assert result.exit_code == 0, result.output
    return folder


def use(prefix: str = "cartpole") -> str:
    return USE.replace("PREFIX", prefix).replace("ENUM", prefix.upper())


def cmake(*words: str, at: Path) -> None:
    process = run(needs("cmake"), *words, cwd=at)
    assert process.returncode == 0, process.stdout + process.stderr


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Output of the program compiled by hand."""
    folder = build_c(tmp_path_factory.mktemp("by_hand"))
    (folder / "use.cpp").write_text(use(), encoding="utf-8")
    compiled(needs("gcc"), "-std=c99", "-O2", "-c", "cartpole.c", cwd=folder)
    compiled(needs("g++"), "-I.", "use.cpp", "cartpole.o", "-lm", cwd=folder)
    output = run("./a.out", cwd=folder).stdout
    assert re.fullmatch(r"0 1\.155\d+\n", output)
    return output


# --- the command ----------------------------------------------------------------------------------


def test_build_c_writes_c_only_and_calls_no_compiler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("CC", "/nowhere/cc")
    folder = build_c(tmp_path / "deep" / "cartpole")
    there = {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()}
    assert there == {
        "cartpole.h", "cartpole.c", "fast/cartpole.h", "fast/cartpole.c", "main.c", "selftest.c",
        "CMakeLists.txt", "cartpole.pc.in", "costs.txt",
    }  # fmt: skip
    assert sorted(os.listdir(tmp_path)) == ["deep"]
    again = (folder / "main.c").read_bytes()
    build_c(folder)
    assert (folder / "main.c").read_bytes() == again
    costs = (folder / "costs.txt").read_text(encoding="utf-8")
    assert re.search(r"^acceleration +3 +9 +1 +1 +0$", costs, re.MULTILINE)


def test_foreign_files_are_not_overwritten(tmp_path: Path) -> None:
    for name in ("main.c", "CMakeLists.txt"):
        (tmp_path / name).write_text("mine", encoding="utf-8")
    result = eomc("build", str(SCENES / "cartpole.toml"), "--c", str(tmp_path))
    assert result.exit_code == 2 and "main.c, CMakeLists.txt: give another folder" in result.output
    assert sorted(os.listdir(tmp_path)) == ["CMakeLists.txt", "main.c"]
    (tmp_path / "file").write_text("", encoding="utf-8")
    result = eomc("build", str(SCENES / "cartpole.toml"), "--c", str(tmp_path / "file" / "c"))
    assert result.exit_code == 2 and "can't be written" in result.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--prefix", "a"], "goes with --c"),
        (["--c", "a", "--prefix", "double"], "--prefix: 'double' is"),
        (["--c", "a", "--prefix", "a b"], "is not a plain name"),
        (["--c", "a", str(SCENES / "acrobot.toml")], "takes one scene"),
    ],
)
def test_contradictory_options_are_refused(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = eomc("build", str(SCENES / "cartpole.toml"), *words)
    assert result.exit_code == 2 and message in result.output
    assert os.listdir(tmp_path) == []


def test_module_build_has_the_same_files(tmp_path: Path, quickly_compiled: None) -> None:
    folder = build_c(tmp_path / "c")
    built = pipeline.build(SCENES / "cartpole.toml", tmp_path).folder
    for file in folder.rglob("*"):
        if file.is_file():
            assert (built / file.relative_to(folder)).read_bytes() == file.read_bytes()


@pytest.mark.slow
def test_two_versions_link_into_one_program(tmp_path: Path, printed: str) -> None:
    """Build a scene twice, the second time with another gravity and another prefix."""
    build_c(tmp_path / "a")
    heavier = (SCENES / "cartpole.toml").read_text(encoding="utf-8").replace("9.8,", "19.6,")
    (tmp_path / "cartpole.toml").write_text(heavier, encoding="utf-8")
    words = ["--c", str(tmp_path / "b"), "--prefix", "heavier"]
    assert eomc("build", str(tmp_path / "cartpole.toml"), *words).exit_code == 0
    body = use().split("int main()\n")[1]
    second = body.replace("cartpole", "heavier").replace("CARTPOLE", "HEAVIER")
    program = "#include <cartpole.h>\n#include <heavier.h>\n#include <cstdio>\n"
    program += f"static int one() {body} static int two() {second}"
    program += "int main() { return one() + two(); }\n"
    (tmp_path / "both.cpp").write_text(program, encoding="utf-8")
    for name, at in (("cartpole", "a"), ("heavier", "b")):
        compiled("cc", *STRICT, f"-I{at}", "-c", f"{at}/{name}.c", cwd=tmp_path)
        compiled("cc", *STRICT, f"-I{at}", "-c", f"{at}/main.c", "-o", "main.o", cwd=tmp_path)
        compiled("cc", f"-I{at}", f"{at}/selftest.c", f"{name}.o", "-lm", "-o", name, cwd=tmp_path)
        assert run(f"./{name}", cwd=tmp_path).stdout.startswith(f"{name}: right in")
    objects = ("cartpole.o", "heavier.o")
    compiled(needs("g++"), "-Ia", "-Ib", "both.cpp", *objects, "-lm", cwd=tmp_path)
    one, two = run("./a.out", cwd=tmp_path).stdout.splitlines()
    assert one == printed.strip() and two != one
    source = (tmp_path / "b" / "heavier.c").read_text(encoding="utf-8")
    assert "eomc build cartpole.toml --c DIR --prefix heavier" in source
    assert not re.search(r"\bcartpole_|CARTPOLE", source)


# --- build systems --------------------------------------------------------------------------------


def built(project: Path, text: str, *words: str) -> str:
    """Return the output of the C++ project with this CMakeLists.txt."""
    (project / "CMakeLists.txt").write_text(text, encoding="utf-8")
    (project / "robot.cpp").write_text(use(), encoding="utf-8")
    cmake("-S", ".", "-B", "out", *words, at=project)
    cmake("--build", "out", at=project)
    return run("./out/robot", cwd=project).stdout


@pytest.mark.slow
def test_cpp_project_adds_the_folder(tmp_path: Path, printed: str) -> None:
    needs("cmake"), needs("g++")
    build_c(tmp_path / "cartpole")
    assert built(tmp_path, SUBDIRECTORY) == printed


@pytest.mark.slow
def test_cpp_project_adds_optimised_c(tmp_path: Path, printed: str) -> None:
    needs("cmake"), needs("g++")
    build_c(tmp_path / "cartpole")
    fast = built(tmp_path, SUBDIRECTORY, "-DCARTPOLE_FAST=ON")
    assert float(fast.split()[1]) == pytest.approx(float(printed.split()[1]), rel=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["OFF", "ON"])
def test_shared_library_is_built_and_installed(form: str, tmp_path: Path) -> None:
    """Use CMake's own switch; ctypes calls functions of the installed library."""
    build_c(tmp_path / "cartpole")
    words = ["BUILD_SHARED_LIBS=ON", f"CARTPOLE_FAST={form}", "CMAKE_C_VISIBILITY_PRESET=hidden"]
    cmake("-S", "cartpole", "-B", "library", *(f"-D{w}" for w in words), at=tmp_path)
    cmake("--build", "library", at=tmp_path)
    cmake("-E", "chdir", "library", "ctest", "--output-on-failure", at=tmp_path)
    cmake("--install", "library", "--prefix", str(tmp_path / "there"), at=tmp_path)
    (library,) = (tmp_path / "there").rglob("libeomc_cartpole.*")
    assert library.suffix == ".so"
    code = f"import ctypes; print(ctypes.CDLL({str(library)!r}).cartpole_rk4_step is not None)"
    assert run(sys.executable, "-c", code, cwd=tmp_path).stdout == "True\n"


def test_cmake_decides_whether_the_library_is_shared(tmp_path: Path) -> None:
    text = (build_c(tmp_path) / "CMakeLists.txt").read_text(encoding="utf-8")
    assert re.search(r"^add_library\(eomc_cartpole \$\{sources\}/cartpole.c\)$", text, re.M)
    for kind in ("ARCHIVE", "LIBRARY", "RUNTIME"):
        assert f"{kind} DESTINATION" in text


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Folder into which CMake installed the library, moved afterwards."""
    build_c(tmp_path / "cartpole")
    cmake("-S", "cartpole", "-B", "library", f"-DCMAKE_INSTALL_PREFIX={tmp_path}/no", at=tmp_path)
    cmake("--build", "library", at=tmp_path)
    cmake("-E", "chdir", "library", "ctest", "--output-on-failure", at=tmp_path)
    cmake("--install", "library", "--prefix", str(tmp_path / "first"), at=tmp_path)
    return (tmp_path / "first").rename(tmp_path / "moved")


@pytest.mark.slow
def test_cpp_project_finds_the_installed_package(
    tmp_path: Path, installed: Path, printed: str
) -> None:
    needs("cmake"), needs("g++")
    (tmp_path / "project").mkdir()
    how = f"-DCMAKE_PREFIX_PATH={installed}"
    assert built(tmp_path / "project", INSTALLED, how) == printed


@pytest.mark.slow
def test_pkg_config_finds_the_installed_package(
    tmp_path: Path, installed: Path, printed: str
) -> None:
    (pc_file,) = installed.rglob("cartpole.pc")
    where = {**os.environ, "PKG_CONFIG_PATH": str(pc_file.parent)}
    words = [needs("pkg-config"), "--cflags", "--libs", "cartpole"]
    flags = subprocess.run(words, env=where, capture_output=True, text=True, check=True).stdout
    (tmp_path / "use.cpp").write_text(use(), encoding="utf-8")
    compiled(needs("g++"), "use.cpp", *flags.split(), cwd=tmp_path)
    assert run("./a.out", cwd=tmp_path).stdout == printed


def test_cmake_compiles_optimised_c_with_the_flags_of_modules(tmp_path: Path) -> None:
    text = (build_c(tmp_path) / "CMakeLists.txt").read_text(encoding="utf-8")
    flags = [flag for flag in compiler.FLAGS if flag != "-march=native"]
    assert " ".join(flags) in text
