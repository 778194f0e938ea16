"""Compile a scene's C with other flags or changes, and check it in a process of its own."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import cffi
from cases import fast_kit
from forks import in_a_fork as in_a_fork

import eomc
from eomc.model.system import System
from eomc.toolchain import compiler as compiling
from eomc.toolchain.files import write_files

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
from eomc.verify import check
from instrument import Shipped
made = eomc.read({scene!r})
shipped = Shipped(made, Path({folder!r}))
said = shipped.compile({flags!r})
assert said is None, said
report = check.check(made, shipped.load())
print(report.table())
sys.exit(0 if report.passed else 1)
"""


def check_coverage(scene_text: str, folder: Path) -> tuple[str, list[tuple[int, str]]]:
    """Return the table of a scene's check, and the lines of its NAME.c that were not executed."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(scene_text, encoding="utf-8")
    here = str(Path(__file__).parent)
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
