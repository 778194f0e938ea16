"""Choice of the compiler, and the message while ziglang prepares its libraries."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from support.builds import CHANGED
from support.session import needs

import eomc
from eomc.toolchain import compiler


@pytest.fixture
def ziglang(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make ziglang the only compiler, by a script that calls gcc; return its library cache."""
    package = tmp_path / "site" / "ziglang"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("", encoding="utf-8")
    gcc = needs("gcc")
    code = f"import os, sys\nos.execv({gcc!r}, [{gcc!r}, *sys.argv[2:]])\n"
    (package / "__main__.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delitem(sys.modules, "ziglang", raising=False)
    monkeypatch.setattr(shutil, "which", lambda *a, **k: None)
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(tmp_path / "zig"))
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    return tmp_path / "zig"


@pytest.mark.slow
def test_first_build_by_ziglang_reports_its_preparation(
    scene: Path, root: Path, ziglang: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    messages: list[str] = []
    assert eomc.build(scene, root, warn=lambda p: messages.append(str(p))).fresh
    assert len(messages) == 1 and "note: ziglang prepares its libraries" in messages[0]
    (ziglang / "o").mkdir(parents=True)
    scene.write_text(CHANGED, encoding="utf-8")
    assert eomc.build(scene, root, warn=lambda p: messages.append(str(p))).fresh
    assert len(messages) == 1


def test_other_compilers_report_no_preparation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", "/nowhere")
    assert compiler.first_call_note() == ""
