"""Compile FMUs (units of FMI) and wheels, and write them as archives.

A wheel of a compiled scene requires NumPy and cffi only. Its extensions use Python's stable ABI
(abi3). There is one extension for each of several processor generations; the package loads the most
capable one that the machine supports.
"""

from __future__ import annotations

import base64
import hashlib
import platform
import re
import sys
import sysconfig
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from eomc.base import texts
from eomc.base.errors import EomcError, NoCompilerError
from eomc.base.resources import __version__, generator_version
from eomc.emit.common.templates import show
from eomc.emit.package import Form
from eomc.emit.render import Sources
from eomc.toolchain import extension
from eomc.toolchain.compiler import (
    FLAGS,
    SUFFIX,
    Compiler,
    compile_library,
    compiler_for,
    user_flags,
)
from eomc.toolchain.files import write_archive, write_files

if TYPE_CHECKING:
    from eomc.emit.fmu import Unit

COMPILED = "compiled"  # name of the module that chooses an extension
OLDEST_GLIBC = 17  # minor version, glibc 2.17: the oldest for which wheels have a tag


@dataclass(frozen=True)
class _Generation:
    """A processor generation: the features that Linux reports for it, and its compiler flags."""

    name: str
    needs: tuple[str, ...]
    flags: tuple[str, ...]


_AVX2 = ("avx2", "fma", "bmi1", "bmi2", "f16c", "movbe")
_AVX2_FLAGS = ("-mavx2", "-mfma", "-mbmi", "-mbmi2", "-mf16c", "-mmovbe")
_AVX512 = ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")
_GENERATIONS = {
    "x86_64": (
        _Generation(
            "avx512",
            (*_AVX512, *_AVX2),
            (*(f"-m{x}" for x in _AVX512), *_AVX2_FLAGS, "-mprefer-vector-width=256"),
        ),
        _Generation("avx2", _AVX2, _AVX2_FLAGS),
    ),
}
_BASELINE = _Generation("baseline", (), ())  # every processor of the architecture


def generations() -> tuple[_Generation, ...]:
    """Return the processor generations for which a wheel has an extension, the newest first.

    A generation is a set of processor features, such as AVX2, with compiler flags for them. The
    result contains all generations of this machine's architecture. If $EOMC_CFLAGS is set, it
    contains a single generation, with the flags in that variable.
    """
    chosen = user_flags()
    if chosen is not None:
        return (_Generation("given", (), chosen),)
    portable = tuple(flag for flag in FLAGS if flag != "-march=native")
    supported = (*_GENERATIONS.get(platform.machine(), ()), _BASELINE)
    return tuple(_Generation(g.name, g.needs, (*portable, *g.flags)) for g in supported)


def write_wheel(sources: Sources, scene: bytes, digest: str, title: str, folder: Path) -> Path:
    """Compile the sources of a scene, write a wheel into `folder`, and return the wheel's path.

    Parameters
    ----------
    sources : Sources
        The generated files, with COMPILED as the name of their extension module.
    scene : bytes
        The scene's TOML file, which the wheel includes.
    digest : str
        Digest of the scene file, which becomes part of the wheel's version.
    title : str
        Title of the scene, for the wheel's summary.
    folder : Path
        Where the wheel is written.

    Raises
    ------
    EomcError
        If the compiler fails, or the folder can't be written.
    """
    name, (suffix, python, abi) = sources.name, _interface()
    compiler = compiler_for(sources.operations)
    files = {f: text.encode() for f, text in sources.files.items() if f.endswith(".py")}
    files |= {"__init__.pyi": sources.stub.encode(), "py.typed": b"", f"{name}.toml": scene}
    forms = []
    with tempfile.TemporaryDirectory(prefix="eomc-wheel-") as place:
        build_folder = Path(place)
        write_files(sources.files, build_folder)
        for g in generations():
            module = f"_{name}_{g.name}"
            library = module + suffix
            extension.build(sources, module, build_folder, library, compiler, "fast", g.flags)
            files[library] = (build_folder / library).read_bytes()
            forms.append(Form(g.name, module, g.needs))
    files[f"{COMPILED}.py"] = show(
        "python/compiled.py", prefix=name, version=generator_version(), forms=forms
    ).encode()
    version = f"{__version__}+scene{digest[:12]}"
    tag = f"{python}-{abi}-{_platform(files)}"
    info = f"{name}-{version}.dist-info"
    contents = {f"{name}/{file}": data for file, data in sorted(files.items())}
    contents[f"{info}/METADATA"] = _metadata(name, version, title).encode()
    contents[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: eomc {__version__}\nRoot-Is-Purelib: false\nTag: {tag}\n"
    ).encode()
    wheel = folder / f"{name}-{version}-{tag}.whl"
    write_archive(wheel, _with_record(contents, f"{info}/RECORD"))
    return wheel


def _interface() -> tuple[str, str, str]:
    """Return the suffix of extensions, and the Python and ABI tags of the wheel."""
    if sysconfig.get_config_var("Py_DEBUG") or sysconfig.get_config_var("Py_GIL_DISABLED"):
        version = f"cp{sys.version_info[0]}{sys.version_info[1]}"
        suffix = str(sysconfig.get_config_var("EXT_SUFFIX"))
        return suffix, version, version + getattr(sys, "abiflags", "")
    return (".pyd" if sys.platform == "win32" else ".abi3.so"), "cp311", "abi3"


def _platform(files: Mapping[str, bytes]) -> str:
    """Return the platform tag of the wheel; on Linux, with the glibc version that it requires."""
    if sys.platform == "linux" and platform.libc_ver()[0] == "glibc":
        versions = (re.findall(rb"GLIBC_2\.(\d+)", data) for data in files.values())
        newest = max((int(n) for matches in versions for n in matches), default=0)
        return f"manylinux_2_{max(newest, OLDEST_GLIBC)}_{platform.machine()}"
    return re.sub(r"[-.]", "_", sysconfig.get_platform())


def _metadata(name: str, version: str, title: str) -> str:
    return "\n".join(
        (
            "Metadata-Version: 2.1",
            f"Name: {name}",
            f"Version: {version}",
            f"Summary: {texts.flat(title) or name}: compiled equations of motion",
            "Requires-Python: >=3.11",
            "Requires-Dist: cffi>=1.16",
            "Requires-Dist: numpy>=1.26",
            "Classifier: Typing :: Typed",
            "",
        )
    )


def _with_record(files: Mapping[str, bytes], record: str) -> dict[str, bytes]:
    """Return the files together with the RECORD of their digests."""
    rows = []
    for name, data in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        rows.append(f"{name},sha256={digest},{len(data)}\n")
    return {**files, record: "".join((*rows, f"{record},,\n")).encode()}


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


def write_fmu(unit: Unit, file: Path, binary: bool = True) -> Exported:
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
            binaries, folder = _compile_fmu(unit, compiler_for(unit.operations))
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


def _compile_fmu(unit: Unit, compiler: Compiler) -> tuple[dict[str, bytes], str]:
    library = f"{unit.name}{SUFFIX}"
    folder = binary_folder(unit.version)
    files = {n.removeprefix("sources/"): text for n, text in unit.files.items()}
    binary = compile_library(
        compiler, unit.name, files, unit.sources, f"fmi{unit.version}GetVersion",
        ", or take --sources",
    )  # fmt: skip
    return {f"binaries/{folder}/{library}": binary}, folder
