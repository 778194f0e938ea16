"""Units of FMI: compiled, and put into one file."""

from __future__ import annotations

import platform
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eomc.base.errors import EomcError, NoCompilerError
from eomc.toolchain import archive
from eomc.toolchain.compiler import Compiler, compiler_for, flags, standard
from eomc.toolchain.running import lay_out, run, try_out

if TYPE_CHECKING:
    from eomc.emit.fmu.files import Unit

_SUFFIX = {"win32": ".dll", "cygwin": ".dll", "darwin": ".dylib"}
_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}


@dataclass(frozen=True)
class Exported:
    """A unit on disk. binary: the folder inside that holds one, "" where there is none, and why."""

    file: Path
    binary: str
    why: str = ""


def export(made: Unit, file: Path, binary: bool = True) -> Exported:
    """Write a unit to `file`, over a unit that is there, with a binary for this machine if wanted.

    Without a compiler the unit has its sources alone. Raises EomcError where the compiler fails,
    with its own words, or the file can't be written.
    """
    if file.is_dir():
        raise EomcError(f"{file}: is a folder: name a file, --out {made.name}.fmu")
    if file.suffix != ".fmu":
        raise EomcError(f"{file}: a unit of FMI is written as .fmu: end its name so")
    held: dict[str, bytes] = {}
    folder = why = ""
    if binary:
        try:
            held, folder = _compiled(made, compiler_for(made.operations))
        except NoCompilerError as fault:
            why = str(fault)
    texts = {name: text.encode(errors="backslashreplace") for name, text in made.files.items()}
    archive.write(file, dict(sorted((texts | held).items())), "binaries")
    return Exported(file, folder, why)


def place(version: int) -> str:
    """The folder of binaries for this system and processor, as FMI calls it."""
    system = {"win32": "windows", "cygwin": "windows"}.get(sys.platform, sys.platform)
    machine = _MACHINES.get(platform.machine().lower(), platform.machine().lower())
    if version == 2 and machine == "x86_64":
        return {"windows": "win64", "darwin": "darwin64"}.get(system, "linux64")
    return f"{machine}-{system}"


def _compiled(made: Unit, compiler: Compiler) -> tuple[dict[str, bytes], str]:
    library = made.name + _SUFFIX.get(sys.platform, ".so")
    folder = place(made.version)
    with tempfile.TemporaryDirectory(prefix="eomc-fmu-") as at:
        sources = Path(at, "sources")
        lay_out({n: text for n, text in made.files.items() if n.endswith((".c", ".h"))}, Path(at))
        command = [
            *compiler.command, standard("plain"), *flags("plain"), "-fPIC", "-fvisibility=hidden",
            "-shared", *made.sources, "-lm", "-o", library,
        ]  # fmt: skip
        run(made.name, sources, command)
        load = f"import ctypes; ctypes.CDLL({str(sources / library)!r}).fmi{made.version}GetVersion"
        try_out(made.name, compiler.command, load, (), ", or take --sources")
        return {f"binaries/{folder}/{library}": (sources / library).read_bytes()}, folder
