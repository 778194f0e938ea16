"""Write zip archives: reproducible, and never left half written."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

from eomc.base.errors import writing
from eomc.runtime.atomic_write import atomic_write

_DATE = (1980, 1, 1, 0, 0, 0)  # of all entries: the earliest date that zip allows


def write(file: Path, contents: Mapping[str, bytes], programs: str = "") -> None:
    """Write a zip archive to `file`, replacing an older file only when the new one is complete.

    Equal contents give archives with equal bytes. Missing folders on disk are created.

    contents: the bytes of each file, by its path in the archive. programs: the folder in the
    archive whose files are marked as executable; "" for none. Raises EomcError if the archive can't
    be written.
    """
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as new, zipfile.ZipFile(new, "w") as archive:
            for name, data in contents.items():
                entry = zipfile.ZipInfo(name, _DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.create_system = 3  # Unix: permissions are in external_attr
                runs = programs and name.startswith(f"{programs}/")
                entry.external_attr = (0o755 if runs else 0o644) << 16
                archive.writestr(entry, data)
