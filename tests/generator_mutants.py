"""Mutants of the generator: its Python, its templates and its handwritten C, with one change each.

    python tests/generator_mutants.py --count 300 --seed 1
    python tests/generator_mutants.py --only derive/tape --count 50
    python tests/generator_mutants.py --only derive/tape.py:120      all of a line

Modules take turns, with a random mutant each. A mutant is caught if scenes are refused, do not
compile or fail `eomc check`, or if a quick test fails: first those that execute the line. A mutant
that cannot be imported, parsed or compiled does not count. For survivors the output states whether
the files of any scene change. The first run executes all tests under coverage, which takes some
minutes. Needs coverage.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import random
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from changes import Mutant, of_python, of_template
from executed import (
    OF_TEXTS,
    PACKAGE,
    PLACE,
    TREE,
    Executed,
    Execution,
    briefly,
    enter,
    executed,
    tests_of,
)
from forks import in_a_fork

MODULES = (
    "derive", "program", "emit", "model", "robots", "runtime", "scene", "integrators", "base",
    "toolchain", "pipeline", "verify", "report", "cli",
)  # fmt: skip
TEMPLATES = (
    "templates/c",
    "templates/python",
    "templates/fmu",
    "csrc/lanes",
    "csrc/sincos",
)  # their C
HEAVY = ("numpy", "sympy", "cffi", "pydantic", "jinja2", "pytest", "hypothesis", "coverage",
         "click", "rich", "defusedxml.ElementTree", "scipy.linalg")  # fmt: skip
# number of tests run first, seconds of further ones and their number
FEW, MORE, MOST = 12, 15.0, 40
UNPRINTED = ("generator/eomc/verify/",)  # modules without influence on the C
CHECKED_FIRST = tuple(f"generator/eomc/{room}/" for room in ("derive", "program", "emit", "model"))


@dataclass(frozen=True)
class Place:
    """A mutant in its file, whose name is relative to the root of the tree."""

    file: str
    source: str
    mutant: Mutant

    @property
    def line(self) -> int:
        """Return the line number, counted from one."""
        return self.source.count("\n", 0, self.mutant.at) + 1

    @property
    def lines(self) -> set[int]:
        """Return the lines of its statement, one of which coverage counts; none in templates and
        C.
        """
        if not self.file.endswith(".py"):
            return set()
        numbers = {self.line}
        for node in ast.walk(ast.parse(self.source)):
            if isinstance(node, ast.stmt):
                inside = getattr(node, "body", None)
                end = inside[0].lineno - 1 if inside else node.end_lineno
                if node.lineno <= self.line <= (end or 0):
                    numbers = set(range(node.lineno, (end or 0) + 1))
        return numbers

    def __str__(self) -> str:
        old = self.source[self.mutant.at : self.mutant.end]
        if len(old) > 60:
            old = f"{old[:28]}...{old[-28:]}"
        text = self.source.splitlines()[self.line - 1].strip()
        return f"{self.file}:{self.line}: {old!r} -> {self.mutant.new[-60:]!r}   | {text}"


def files() -> dict[str, list[Mutant]]:
    """Return the mutants of each file."""
    by_file = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        name = str(file.relative_to(PACKAGE))
        if name.split("/")[0].removesuffix(".py") in MODULES:
            by_file[str(file.relative_to(TREE))] = of_python(file.read_text(encoding="utf-8"))
    for folder in TEMPLATES:
        for file in sorted((TREE / folder).rglob("*.[ch]*")):
            by_file[str(file.relative_to(TREE))] = of_template(file.read_text(encoding="utf-8"))
    return {name: mutants for name, mutants in by_file.items() if mutants}


def sample(only: Sequence[str], count: int, seed: int) -> Iterator[Place]:
    """Yield a mutant of each file in turn, in an order that the seed determines."""
    draw = random.Random(seed)
    places: dict[str, list[Place]] = {}
    for name, mutants in files().items():
        source = (TREE / name).read_text(encoding="utf-8")
        own = [Place(name, source, mutant) for mutant in mutants]
        own = [p for p in own if not only or any(part in f"{name}:{p.line}:" for part in only)]
        if own:
            places[name] = draw.sample(own, len(own))
    while places and count > 0:
        for name in draw.sample(sorted(places), len(places)):
            yield places[name].pop()
            if not places[name]:
                del places[name]
            count -= 1
            if count == 0:
                return


def judge(place: Place, executions: Executed) -> tuple[str, str]:
    """Return "no mutant", "check", "tests", "other bytes" or "same bytes", and the cause.

    A test that also fails without the mutant, in the copy or on a busy machine, is not used again.
    """
    while True:
        file, before = TREE / place.file, PLACE / "before.json"
        before.write_text(json.dumps({place.file: place.source}), encoding="utf-8")
        file.write_text(place.mutant.apply(place.source), encoding="utf-8")
        try:
            verdict, words = _judge(place, executions)
        finally:
            restore_file()
        if words not in executions.tests:
            return verdict, words
        alone = [words]
        right = in_a_fork(
            lambda alone=alone: _run_judge("by_tests", alone), _limit(alone, executions), group=True
        )
        if right == ("done", ["passed", ""]):
            return verdict, words
        del executions.tests[words]


def restore_file() -> None:
    """Restore the file of the last mutant, also after a killed run."""
    before = PLACE / "before.json"
    if before.exists():
        for name, source in json.loads(before.read_text(encoding="utf-8")).items():
            (TREE / name).write_text(source, encoding="utf-8")
        before.unlink()


def _judge(place: Place, executions: Executed) -> tuple[str, str]:
    python = place.file.endswith(".py")
    if python:
        module = place.file.removeprefix("generator/").removesuffix(".py").replace("/", ".")

        def imported() -> None:
            enter()
            importlib.import_module(module)

        if in_a_fork(imported, 60, group=True)[0] != "done":
            return "no mutant", ""
    lines = place.lines
    scenes = sorted(
        (name for name, one in executions.scenes.items() if runs(one, place.file, lines)),
        key=lambda name: executions.scenes[name].seconds,
    )
    right = {name: one.digest for name, one in executions.scenes.items()}
    same = place.file.startswith(UNPRINTED)
    tests = list(tests_of(executions, place.file, lines))
    few, more = tests[:FEW], _tests_within(MORE, tests[FEW : FEW + MOST], executions)
    judges: list[tuple[str, float, Callable[[], tuple[str, str]]]] = [
        ("check", 90, lambda: _run_judge("by_check", scenes, right, 4, 15.0, same)),
        ("tests", _limit(few, executions), lambda: _run_judge("by_tests", few)),
        ("tests", _limit(more, executions), lambda: _run_judge("by_tests", more)),
        # survivors are checked at length
        ("check", 400, lambda: _run_judge("by_check", scenes, right, 40, 200.0, same)),
        ("tests", 900, lambda: _run_judge("by_tests", _tests_of_folder(place.file, executions))),
    ]
    if not executions.tests:
        judges = judges[:1]
    elif python and not place.file.startswith(CHECKED_FIRST):
        judges[:2] = reversed(judges[:2])
    left = ("", "")
    for kind, limit, ask in judges:
        how, result = in_a_fork(ask, limit, group=True)
        if how != "done":
            return kind, f"{how} {result}"
        assert isinstance(result, list)
        by, words = result
        if by == "caught":
            broken = ("Template", "compiler failed", "error: ")
            known = python or kind == "tests" or not any(b in words for b in broken)
            return (kind if known else "no mutant"), words
        if kind == "check":
            left = by, words
    return left


def _limit(tests: Sequence[str], executions: Executed) -> float:
    return 45 + 5 * sum(executions.tests[test].seconds for test in tests)


def _tests_of_folder(file: str, executions: Executed) -> list[str]:
    """Return the quick tests of the folder that a file belongs to, or of generated code."""
    room = Path(file).parts[2] if file.startswith("generator/") else ""
    folders = (f"tests/{room}/",) if room else OF_TEXTS
    return [test for test in executions.tests if test.startswith(folders)]


def _run_judge(what: str, *arguments: object) -> tuple[str, str]:
    enter()
    import judged

    result: tuple[str, str] = getattr(judged, what)(*arguments)
    return result


def runs(one: Execution, file: str, lines: set[int]) -> bool:
    """Return whether a scene's check executes lines; True for templates and unrecorded scenes."""
    return not lines or not one.lines or not lines.isdisjoint(one.lines.get(file, ()))


def _tests_within(seconds: float, tests: Sequence[str], executions: Executed) -> list[str]:
    """Return the first tests that take at most the given time."""
    chosen, left = [], seconds
    for test in tests:
        left -= executions.tests[test].seconds + 0.01
        if left < 0:
            break
        chosen.append(test)
    return chosen


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], help="parts of a file's name, FILE:LINE")
    parser.add_argument("--log", type=Path, help="a line of JSON for each mutant")
    parser.add_argument("--minutes", type=float, default=1e9)
    parser.add_argument("--kept", action="store_true", help="the copy of the last run")
    parser.add_argument("--brief", action="store_true", help="three scenes alone, and no tests")
    options = parser.parse_args(arguments)
    (PLACE / "tmp").mkdir(parents=True, exist_ok=True)
    restore_file()
    for name in HEAVY:
        importlib.import_module(name)
    executions = briefly() if options.brief else executed(not options.kept)
    counts: Counter[str] = Counter()
    rooms: dict[str, Counter[str]] = defaultdict(Counter)
    end = time.monotonic() + 60 * options.minutes
    for place in sample(options.only, options.count, options.seed):
        if time.monotonic() > end:
            break
        began = time.monotonic()
        verdict, words = judge(place, executions)
        counts[verdict] += 1
        rooms["/".join(Path(place.file).parts[:3])][verdict] += 1
        if options.log:
            row = {"verdict": verdict, "place": str(place), "by": words,
                   "seconds": round(time.monotonic() - began, 1)}  # fmt: skip
            with options.log.open("a") as log:
                print(json.dumps(row), file=log)
        if verdict.endswith("bytes"):
            print(f"{verdict}: {place}   {words}", flush=True)
    for room, own in sorted(rooms.items()):
        print(f"{room}: " + ", ".join(f"{n} {what}" for what, n in own.most_common()))
    live = counts.total() - counts["no mutant"]
    caught = counts["check"] + counts["tests"]
    print(f"{caught} of {live} caught ({caught / max(1, live):.1%}): "
          + ", ".join(f"{n} {what}" for what, n in counts.most_common()))  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
