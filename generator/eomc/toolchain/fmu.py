"""Compile FMI units (FMUs) and write them as archives."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eomc.base.errors import EomcError, NoCompilerError
from eomc.toolchain.compiler import SUFFIX, Compiler, compile_library, compiler_for
from eomc.toolchain.files import write_archive

if TYPE_CHECKING:
    from eomc.emit.fmu import Unit

_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}


@dataclass(frozen=True)
class Exported:
    """An FMU (FMI unit) that was written to disk.

    file: path of the FMU, a zip archive. binary: name of the platform whose compiled binary it
    contains, such as "linux64"; "" if there is no binary. why: the message that explains why a
    requested binary is missing; "" otherwise.
    """

    file: Path
    binary: str
    why: str = ""


def export(unit: Unit, file: Path, binary: bool = True) -> Exported:
    """Write an FMU to `file`, replacing an older one. Return a description of what was written.

    unit: the texts of the FMU. binary: whether the FMU includes, besides its C sources, a binary
    compiled for this machine; if there is no compiler, the binary is left out. Raises EomcError
    with the compiler's message if it fails, or if the file can't be written.
    """
    if file.is_dir():
        raise EomcError(f"{file}: is a folder: name a file, --out {unit.name}.fmu")
    if file.suffix != ".fmu":
        raise EomcError(f"{file}: a unit of FMI is written as .fmu: end its name so")
    binaries: dict[str, bytes] = {}
    folder = why = ""
    if binary:
        try:
            binaries, folder = _compile(unit, compiler_for(unit.operations))
        except NoCompilerError as fault:
            why = str(fault)
    texts = {name: text.encode(errors="backslashreplace") for name, text in unit.files.items()}
    write_archive(file, dict(sorted((texts | binaries).items())), "binaries")
    return Exported(file, folder, why)


def binary_folder(version: int) -> str:
    """Return the name of an FMU's folder for binaries of this platform, such as "linux64".

    The FMI standard defines the names. version: version of FMI, 2 or 3.
    """
    system = {"win32": "windows", "cygwin": "windows"}.get(sys.platform, sys.platform)
    machine = _MACHINES.get(platform.machine().lower(), platform.machine().lower())
    if version == 2 and machine == "x86_64":
        return {"windows": "win64", "darwin": "darwin64"}.get(system, "linux64")
    return f"{machine}-{system}"


def _compile(unit: Unit, compiler: Compiler) -> tuple[dict[str, bytes], str]:
    library = f"{unit.name}{SUFFIX}"
    folder = binary_folder(unit.version)
    files = {n.removeprefix("sources/"): text for n, text in unit.files.items()}
    binary = compile_library(
        compiler, unit.name, files, unit.sources, f"fmi{unit.version}GetVersion",
        ", or take --sources",
    )  # fmt: skip
    return {f"binaries/{folder}/{library}": binary}, folder
