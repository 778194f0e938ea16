"""A wheel of a compiled scene, which needs NumPy and cffi alone where it is installed.

Its extensions use the part of Python's interface that stays (abi3). There is one for each of some
generations of processors; the package loads the widest that the machine has.
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

from eomc.base import texts
from eomc.base.version import __version__
from eomc.emit.render import Sources, show
from eomc.emit.views import Compiled, Form
from eomc.toolchain import archive, extension
from eomc.toolchain.compiler import FLAGS, compiler_for, given_flags
from eomc.toolchain.running import lay_out

COMPILED = "compiled"  # the module that chooses an extension
OLDEST = 17  # glibc 2.17, below which installers know no wheels


@dataclass(frozen=True)
class _Generation:
    """Of processors: what Linux says that they have, and the flags that use it."""

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
_BASELINE = _Generation("baseline", (), ())  # what every processor of the architecture has


def generations() -> tuple[_Generation, ...]:
    """Those of this architecture, the widest first; with $EOMC_CFLAGS one of these flags."""
    given = given_flags()
    if given is not None:
        return (_Generation("given", (), given),)
    portable = tuple(flag for flag in FLAGS if flag != "-march=native")
    found = (*_GENERATIONS.get(platform.machine(), ()), _BASELINE)
    return tuple(_Generation(g.name, g.needs, (*portable, *g.flags)) for g in found)


def build(made: Sources, scene: bytes, digest: str, title: str, folder: Path) -> Path:
    """Compile the sources, and write their wheel into `folder`; its path.

    made: with COMPILED for its extension. scene: its file, which is packed too. digest: of that.
    Raises EomcError where the compiler fails, or the folder can't be written.
    """
    name, (suffix, python, abi) = made.name, _interface()
    compiler = compiler_for(made.operations)
    files = {f: text.encode() for f, text in made.files.items() if f.endswith(".py")}
    files |= {"__init__.pyi": made.stub.encode(), "py.typed": b"", f"{name}.toml": scene}
    forms = []
    with tempfile.TemporaryDirectory(prefix="eomc-wheel-") as place:
        at = Path(place)
        lay_out(made.files, at)
        for g in generations():
            called = f"_{name}_{g.name}"
            library = called + suffix
            extension.build(made, called, at, library, compiler, "fast", g.flags)
            files[library] = (at / library).read_bytes()
            forms.append(Form(g.name, called, g.needs))
    files[f"{COMPILED}.py"] = show(Compiled(name, __version__, tuple(forms))).encode()
    version = f"{__version__}+scene{digest[:12]}"
    tag = f"{python}-{abi}-{_platform(files)}"
    info = f"{name}-{version}.dist-info"
    whole = {f"{name}/{file}": data for file, data in sorted(files.items())}
    whole[f"{info}/METADATA"] = _metadata(name, version, title).encode()
    whole[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: eomc {__version__}\nRoot-Is-Purelib: false\nTag: {tag}\n"
    ).encode()
    wheel = folder / f"{name}-{version}-{tag}.whl"
    archive.write(wheel, _recorded(whole, f"{info}/RECORD"))
    return wheel


def _interface() -> tuple[str, str, str]:
    """An extension's suffix, and a wheel's tags of Python and of its interface."""
    if sysconfig.get_config_var("Py_DEBUG") or sysconfig.get_config_var("Py_GIL_DISABLED"):
        version = f"cp{sys.version_info[0]}{sys.version_info[1]}"
        suffix = str(sysconfig.get_config_var("EXT_SUFFIX"))
        return suffix, version, version + getattr(sys, "abiflags", "")
    return (".pyd" if sys.platform == "win32" else ".abi3.so"), "cp311", "abi3"


def _platform(files: Mapping[str, bytes]) -> str:
    """A wheel's tag of the platform: of Linux with the glibc that its extensions ask for."""
    if sys.platform == "linux" and platform.libc_ver()[0] == "glibc":
        asked = (re.findall(rb"GLIBC_2\.(\d+)", data) for data in files.values())
        newest = max((int(n) for found in asked for n in found), default=0)
        return f"manylinux_2_{max(newest, OLDEST)}_{platform.machine()}"
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


def _recorded(files: Mapping[str, bytes], record: str) -> dict[str, bytes]:
    """The files, and behind them the record of their digests."""
    rows = []
    for name, data in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        rows.append(f"{name},sha256={digest},{len(data)}\n")
    return {**files, record: "".join((*rows, f"{record},,\n")).encode()}
