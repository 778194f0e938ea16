"""The benchmarks that patch the generator patch names that exist."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import ModuleType

import pytest
from support.session import ROOT


@pytest.fixture
def tricks(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return benchmarks/tricks.py as a module."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    known = set(sys.modules)
    module = importlib.import_module("tricks")
    for name in set(sys.modules) - known:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(ROOT / "benchmarks")):
            del sys.modules[name]
    return module


def test_every_optimisation_that_tricks_leaves_out_exists(tricks: ModuleType) -> None:
    changes: list[Callable[[], AbstractContextManager[object]]] = [
        function
        for name, function in inspect.getmembers(tricks, inspect.isfunction)
        if name.startswith(("without_", "with_lanes"))
    ]
    assert len(changes) >= 6
    for change in changes:
        with change():  # raises AttributeError if the generator has no such name
            pass
