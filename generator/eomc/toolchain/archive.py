"""Archives that are the same bytes for the same contents, and never half there."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

from eomc.base.errors import writing
from eomc.runtime.written import replacing

_DATE = (1980, 1, 1, 0, 0, 0)  # of all that is inside, the earliest of a zip


def write(file: Path, contents: Mapping[str, bytes], programs: str = "") -> None:
    """Write a zip in place of `file`, when it is whole; its folder is made where it isn't there.

    programs: the folder in it whose files are executable. Raises EomcError where it can't be
    written.
    """
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as new, zipfile.ZipFile(new, "w") as archive:
            for name, data in contents.items():
                entry = zipfile.ZipInfo(name, _DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.create_system = 3  # whose rights these are
                runs = programs and name.startswith(f"{programs}/")
                entry.external_attr = (0o755 if runs else 0o644) << 16
                archive.writestr(entry, data)
