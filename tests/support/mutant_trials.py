"""Checks and tests of one mutant of `generator_mutants`, in a forked process, in the copied
tree.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

import eomc
from eomc.mechanism.assembly import assembled
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.toolchain import cache
from support.generator_mutants import PLACE, PYTEST, TREE, scene_text
from support.random_scenes import EXTENSION, built
from support.template_checks import check_all


class Scene:
    """A scene, derived and rendered."""

    def __init__(self, name: str) -> None:
        os.environ["EOMC_CFLAGS"] = "-O0"
        warnings.simplefilter("ignore")
        self.made = assembled(from_scene(parse(scene_text(name), f"{name}.toml")))
        self.sources = eomc.sources(self.made, EXTENSION)
        texts = [*sorted(self.sources.files.items()), self.sources.binding, self.sources.cdef]
        self.digest = hashlib.sha256(repr(texts).encode()).hexdigest()

    def faults(self) -> list[str]:
        """Return the failed checks, those of templates too."""
        with tempfile.TemporaryDirectory(dir=PLACE / "tmp") as folder:
            compiled = PLACE / "compiled"
            fast = built(self.sources, Path(folder) / "fast", "fast", compiled)
            plain = built(self.sources, Path(folder) / "plain", "plain", compiled)
            report = check_all(self.made, fast, plain=plain)
        return [row.name for row in report.results if not row.passed]


def run_checks(
    scenes: Sequence[str],
    right: Mapping[str, str],
    most: int,
    seconds: float,
    same: bool = False,
) -> tuple[str, str]:
    """Run `eomc check`: return ("caught", cause), ("other bytes", scenes) or ("same bytes", "").

    right: digests of the scenes' sources without the mutant. most: number of scenes to check.
    seconds: no further check starts after this time. same: also check scenes with unchanged
    sources.
    """
    others, count, began = [], 0, time.monotonic()
    for name in scenes:
        if count >= most or (count and time.monotonic() - began > seconds):
            break
        try:
            scene = Scene(name)
            if scene.digest != right[name]:
                others.append(name)
            elif not same:
                continue
            count += 1
            faults = scene.faults()
        except Exception as fault:
            return "caught", f"{name}: {type(fault).__name__}: {fault}"[:300]
        if faults:
            return "caught", f"{name}: {', '.join(faults)}"[:300]
    return ("other bytes", ", ".join(others)) if others else ("same bytes", "")


def run_tests(tests: Sequence[str]) -> tuple[str, str]:
    """Return ("caught", first failed test), or ("passed", "")."""
    if not tests:
        return "passed", ""
    # Each mutant is built from scratch, but compilations of the same C are reused.
    shutil.rmtree(TREE / "build", ignore_errors=True)
    (TREE / "build").mkdir()
    cache.generator_digest = lambda: "a mutant's"
    cached = TREE / "tests" / "support" / "compiler_cache.py"
    os.environ |= {"EOMC_KEPT": str(PLACE / "compiled"), "CC": f"{sys.executable} -SI {cached}"}
    failed = []

    class First:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                failed.append(report.nodeid)

        def pytest_collectreport(self, report: Any) -> None:
            if report.failed:
                failed.append(report.nodeid)

    status = pytest.main([*PYTEST, "-x", *tests], plugins=[First()])
    if failed or status not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        return "caught", failed[0] if failed else str(status)
    return "passed", ""
