"""The contents of an FMU (FMI unit) without a binary: texts by their path in the FMU."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from eomc.base import resources
from eomc.emit import c_function
from eomc.emit.c_expression import REALS
from eomc.emit.c_identifiers import rename_for_c
from eomc.emit.c_names import Target
from eomc.emit.fmu import description, scene
from eomc.emit.fmu.views import BuildDescription, View
from eomc.emit.portable import steppers
from eomc.emit.portable.views import View as PlainView
from eomc.program.outline import weight
from eomc.program.program import Program

VERSIONS = (2, 3)
# headers of the FMI standard, by version
_HEADERS = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}


@dataclass(frozen=True)
class Unit:
    """The contents of an FMU (FMI unit) as texts, without a binary.

    Attributes
    ----------
    name
        Name of the scene in C.
    version
        Version of FMI, 2 or 3.
    files
        Texts by their path in the FMU.
    sources
        Paths, relative to sources/, of the C files that are compiled.
    operations
        Number of arithmetic operations of the scene's functions, which determines compile time.
    """

    name: str
    version: int
    files: Mapping[str, str]
    sources: tuple[str, ...]
    operations: int


def unit(
    program: Program, version: int, show: Callable[[View], str], plain: Callable[[PlainView], str]
) -> Unit:
    """Return the texts that form the FMU of a program. There is no compiled binary among them.

    The same program always gives the same texts. version: version of FMI, 2 or 3. show: function
    that renders template data of the FMU as text. plain: the same for template data of portable C.
    """
    safe, written = rename_for_c(program)
    target = Target(safe, REALS[safe.system.run.real], written)
    name = target.prefix
    sources = (f"{name}.c", f"fmi/fmi{version}.c")

    def render(token: str) -> dict[str, str]:
        files = {
            "modelDescription.xml": show(description.view(target, version, token, sources)),
            "sources/fmi/scene.h": c_function.laid_out(show(scene.view(target, token))),
        }
        if version == 3:
            files["sources/buildDescription.xml"] = show(BuildDescription(name, sources))
        return files | texts

    texts = {f"sources/{file}": text for file, text in steppers.files(safe, plain).items()}
    texts |= {
        f"sources/fmi/{file}": resources.text("csrc", f"fmi/{file}")
        for file in (*_HEADERS[version], f"fmi{version}.c", "both.h", "unit.h")
    }
    texts["documentation/licenses/fmi-headers.txt"] = resources.text("csrc", "fmi/LICENSE.txt")
    whole = "\0".join(f"{file}\0{text}" for file, text in sorted(render("").items()))
    digest = hashlib.sha256(whole.encode(errors="surrogateescape")).hexdigest()
    token = "-".join((digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:32]))
    operations = sum(map(weight, safe.functions.values()))
    return Unit(name, version, render(token), sources, operations)
