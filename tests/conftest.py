"""Fixtures that several test files share, and settings of the session."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import HealthCheck, settings
from support import fast_builds
from support.session import EVERYTHING, ROOT, Modules

# Background jobs of a shell ignore SIGINT, and tests of Ctrl-C would never end.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ["support.builds"]

gc.set_threshold(100_000, 20, 100)  # SymPy creates many objects and few cycles

# Nothing is written outside build/, nor to the caches of the user's other programs.
CACHES = {
    "EOMC_CACHE": "tests/eomc",
    "HYPOTHESIS_STORAGE_DIRECTORY": ".hypothesis",
    "MPLCONFIGDIR": "tests/matplotlib",
    "ZIG_GLOBAL_CACHE_DIR": "tests/zig",
}
for variable, folder in CACHES.items():
    os.environ.setdefault(variable, str(ROOT / "build" / folder))
# Slow generation of inputs on a busy machine is no error of the tested code.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
fast_builds.install()


@pytest.fixture(scope="session")
def modules() -> Modules:
    return Modules()


@pytest.fixture(scope="session")
def cartpole(modules: Modules) -> ModuleType:
    """The cart-pole: no inputs, no time, no friction."""
    return modules("cartpole")


@pytest.fixture(scope="session")
def driven(modules: Modules) -> ModuleType:
    """A cart-pole with one input, whose signal depends on time."""
    return modules("cartpole_driven")


@pytest.fixture(scope="session")
def everything(modules: Modules) -> ModuleType:
    """A scene with all features of the format."""
    return modules.of_text(EVERYTHING)


@pytest.fixture
def no_warnings() -> Iterator[None]:
    """Treat warnings as errors."""
    with warnings.catch_warnings(action="error"):
        yield


def pytest_collection(session: pytest.Session) -> None:
    """Let the second of two workers that compile all tests to bytecode start at the end.

    Then each worker finds half of it done by the other, if no bytecode exists.
    """
    whole = session.config.args == session.config.getini("testpaths")
    if os.environ.get("PYTEST_XDIST_WORKER") != "gw1" or not whole:
        return
    files = sorted(Path(__file__).parent.rglob("test_*.py"))
    for file in reversed(files[len(files) // 2 :]):
        sys.path.insert(0, str(file.parent))  # as pytest does
        with contextlib.suppress(Exception, pytest.skip.Exception):  # reported during collection
            importlib.import_module(file.stem)


def pytest_collection_finish() -> None:
    gc.freeze()  # imported and collected objects stay alive
