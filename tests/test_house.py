"""The rules of the house: what may import what, how long a room may be."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "generator" / "eomc"

# from the ground up; rooms on one storey do not import each other
STOREYS = (
    ("base", "integrators", "runtime"),
    ("scene",),
    ("model", "robots"),
    ("derive", "verify"),
    ("program",),
    ("emit",),
    ("toolchain", "pipeline"),
    ("report",),
    ("cli",),
)
DOORS = {"__init__", "__main__"}  # which nothing inside goes through
ALONGSIDE = {("pipeline", "toolchain")}  # the last step of the way, on the same storey
LEVEL = {room: level for level, rooms in enumerate(STOREYS) for room in rooms}


@cache
def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name below eomc."""
    return {
        ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
        for path in sorted(PACKAGE.rglob("*.py"))
    }


@cache
def nodes(name: str) -> list[ast.AST]:
    """All of a module's syntax, at any depth."""
    return [*ast.walk(ast.parse(modules()[name].read_text(encoding="utf-8")))]


@cache
def imports(name: str) -> frozenset[str]:
    """The modules of eomc that a module imports anywhere in its text, for types too."""
    return frozenset(_imports(name))


def _imports(name: str) -> Iterator[str]:
    known, runtime = modules(), name.startswith("runtime.")
    for node in nodes(name):
        if isinstance(node, ast.Import):
            wanted = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            beside = "eomc.runtime." * node.level + (f"{node.module}." if node.module else "")
            wanted = [f"{beside}{alias.name}" for alias in node.names]
            assert node.level == (runtime and wanted[0].startswith("eomc.")), "relative beside"
        else:
            continue
        for whole in wanted:
            package, *parts = whole.split(".")
            if package != "eomc":
                continue
            while parts and ".".join(parts) not in known:
                parts = parts[:-1]
            yield ".".join(parts) or "__init__"


def room(name: str) -> str:
    """The folder of a module, or the module itself where it lies at the top."""
    return name.split(".")[0]


def test_imports_go_down() -> None:
    found = [(name, other) for name in modules() for other in imports(name)]
    assert not [pair for pair in found if pair[1] in DOORS]
    assert not [
        f"{name} imports {other}"
        for name, other in found
        if room(name) != room(other) and name not in DOORS
        if (room(name), room(other)) not in ALONGSIDE
        if LEVEL[room(other)] >= LEVEL[room(name)]
    ]


def test_no_circle() -> None:
    """Not of types either."""
    tops = {n: imports(n) - {n} for n in modules()}
    assert len(list(TopologicalSorter(tops).static_order())) >= len(tops)


def test_every_room_has_its_storey() -> None:
    assert {room(name) for name in modules()} == set(LEVEL) | DOORS
    assert len(STOREYS) <= 9


def test_the_oracles_share_nothing_with_the_compiled_way() -> None:
    """Agreement with them means something."""
    for name in modules():
        if room(name) == "verify":
            used = {room(other) for other in imports(name)}
            assert not used & {"derive", "program", "emit", "toolchain", "pipeline"}, name


def test_what_lies_beside_a_built_module_needs_no_eomc() -> None:
    for name in modules():
        if room(name) == "runtime":
            assert {room(other) for other in imports(name)} <= {"runtime"}, name


def test_pictures_and_events_alone_are_asked_of_eomc_beside_a_built_module() -> None:
    """By name, when they are wanted; an import would be of no use where eomc is not installed."""
    asking = [
        name
        for name in modules()
        if room(name) == "runtime"
        for node in nodes(name)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and node.value.startswith("eomc.")
        and " " not in node.value
    ]
    assert asking == ["runtime.shown"]


MODULE, FUNCTION = 900, 80  # lines; of functions without their docstrings


def test_rooms_are_small() -> None:
    for name, path in modules().items():
        assert path.read_text(encoding="utf-8").count("\n") <= MODULE, name
        for node in nodes(name):
            if isinstance(node, ast.FunctionDef) and node.end_lineno is not None:
                start = (node.body[0].end_lineno or 0) if ast.get_docstring(node) else node.lineno
                assert node.end_lineno - start < FUNCTION, f"{name}: {node.name}"
