"""Calls of C compilers; a scene's C compiled with other flags or changes, and checked."""

from __future__ import annotations

import gzip
import importlib.util
import json
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import cffi
import pytest

import eomc
from eomc.model.system import System
from eomc.toolchain import compiler as compiling
from eomc.toolchain.files import write_files
from support.cases import fast_kit

STRICT = """-std=c99 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Wshadow
-Werror""".split()


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


def compiled(*command: str, cwd: Path) -> None:
    """Run a compiler, which must issue no messages."""
    process = run(*command, cwd=cwd)
    assert (process.returncode, process.stdout + process.stderr) == (0, "")


def clang(cpp: bool = False) -> list[str]:
    """Return the command of clang, or of ziglang's; skip the test if neither is installed."""
    if path := shutil.which("clang++" if cpp else "clang"):
        return [path]
    if importlib.util.find_spec("ziglang") is None:
        pytest.skip("neither clang nor ziglang is installed")
    return [sys.executable, "-m", "ziglang", "c++" if cpp else "cc"]


# functions of <math.h>, and the one of sine and cosine, that generated C may call
MATHEMATICS = set(
    """sin cos sincos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp expm1 log
    log1p sqrt cbrt hypot pow erf erfc fabs fmin fmax fma""".split()
)
COVERAGE = ("-O0", "--coverage", "-march=native", "-fno-math-errno", "-fno-trapping-math")


class Shipped:
    """The files of a scene in a folder, to be compiled any number of times."""

    def __init__(self, system: System, folder: Path) -> None:
        self.name, self.folder = system.name, folder
        self.extension = f"_{self.name}_tried"
        self.compiler = compiling.find_compiler().command
        sources = eomc.sources(system, self.extension)
        folder.mkdir(parents=True, exist_ok=True)
        runtime = {f: text for f, text in sources.files.items() if f.startswith("_runtime/")}
        files = fast_kit(sources) | runtime
        write_files(files, folder)
        self.source = files[f"{self.name}.c"]
        ffi = cffi.FFI()
        ffi.cdef(sources.cdef)
        ffi.set_source(self.extension, sources.binding)
        ffi.emit_c_code(str(folder / "binding.c"))
        include = {sysconfig.get_path("include"), sysconfig.get_path("platinclude")}
        self._run("-fPIC", "-O0", *(f"-I{p}" for p in include), "-c", "binding.c")

    def compile(self, flags: Sequence[str], source: str | None = None) -> str | None:
        """Compile and link, with `source` in place of the shipped text; return the errors, if
        any.
        """
        text = self.source if source is None else source
        (self.folder / f"{self.name}.c").write_text(text, encoding="utf-8")
        library = self.extension + str(sysconfig.get_config_var("EXT_SUFFIX"))
        (self.folder / library).unlink(missing_ok=True)  # never write into a mapped file
        linked = [flag for flag in flags if flag == "--coverage"]
        try:
            self._run(compiling.STANDARD, "-fPIC", *flags, "-c", f"{self.name}.c", "-o", "scene.o")
            self._run(*linked, "-shared", "scene.o", "binding.o", "-lm", "-o", library)
        except subprocess.CalledProcessError as fault:
            return str(fault.stderr)
        return None

    def load(self) -> ModuleType:
        """Import the compiled module; only once in a process."""
        spec = spec_from_file_location(
            f"tried_{self.folder.name}",
            self.folder / "__init__.py",
            submodule_search_locations=[str(self.folder)],
        )
        assert spec is not None and spec.loader is not None
        module = module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        return module

    def _run(self, *words: str) -> None:
        subprocess.run(
            [*self.compiler, *words], cwd=self.folder, check=True, capture_output=True, text=True
        )


# --- lines ----------------------------------------------------------------------------------------

CHECK = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import eomc
from support.compilation import Shipped
from support.template_checks import check_all
made = eomc.read({scene!r})
shipped = Shipped(made, Path({folder!r}))
said = shipped.compile({flags!r})
assert said is None, said
report = check_all(made, shipped.load())
print(report.table())
sys.exit(0 if report.passed else 1)
"""


def check_coverage(scene_text: str, folder: Path) -> tuple[str, list[tuple[int, str]]]:
    """Check a scene, templates too; return the table and the lines of its C not executed."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(scene_text, encoding="utf-8")
    here = str(Path(__file__).parents[1])
    code = CHECK.format(
        tests=here, scene=str(folder / "scene.toml"), folder=str(folder), flags=COVERAGE
    )
    for old in folder.glob("*.gcda"):
        old.unlink()
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if ran.returncode:
        raise AssertionError(ran.stdout + ran.stderr)
    return ran.stdout, list(unexecuted(folder))


def unexecuted(folder: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines that gcov counts as not executed, from scene.gcda: numbers and texts."""
    output = subprocess.run(
        ["gcov", "--json-format", "--stdout", "scene.gcda"],
        cwd=folder, check=True, capture_output=True,
    ).stdout  # fmt: skip
    if output[:2] == b"\x1f\x8b":
        output = gzip.decompress(output)
    counts: dict[int, int] = {}
    for line in output.splitlines():
        for file in json.loads(line)["files"]:
            if not file["file"].endswith(".c"):
                continue
            text = (folder / file["file"]).read_text().splitlines()
            for entry in file["lines"]:
                number = entry["line_number"]
                counts[number] = max(counts.get(number, 0), entry["count"])
    for number, count in sorted(counts.items()):
        if count == 0:
            yield number, text[number - 1].strip()
