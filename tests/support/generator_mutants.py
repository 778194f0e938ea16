"""Mutants of the generator: its Python, its templates and its handwritten C, with one change each.

    python tests/support/generator_mutants.py --count 300 --seed 1
    python tests/support/generator_mutants.py --only derive/tape --count 50
    python tests/support/generator_mutants.py --only derive/tape.py:120      all of a line

Modules take turns, with a random mutant each. A mutant is caught if scenes are refused, do not
compile or fail `eomc check`, or if a quick test fails: first those that execute the line. A mutant
that cannot be imported, parsed or compiled does not count. For survivors the output states whether
the files of any scene change. The first run executes all tests under coverage in a
copy of the tree, without optimisation, and takes some minutes. Needs coverage.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import hashlib
import importlib
import json
import os
import py_compile
import random
import shutil
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.forks import in_a_fork
from support.mutations import Mutant, of_python, of_template

ROOT = Path(__file__).parents[2]
PLACE = Path(os.environ.get("EOMC_MUTANTS", ROOT / "build" / "mutants"))
TREE = PLACE / "tree"
PACKAGE = TREE / "generator" / "eomc"
WIDE = (3, 5, 8, 13, 21, 34)  # seeds of random_scenes --wide, in addition to scenes/
STOPS = '[[event]]\nname = "low"\nwhen = "x"\naction = "stop"\n'
EVENT = '[[event]]\nname = "low"\nwhen = "theta - 3"\n'
RICH = {  # of scenes/, with lines added under [run] and at the end
    "pendulum_xy": (
        'tolerance = 1e-9\nmethod = ["rk4", "gauss8", "dp8"]\n'
        "linearize = true\ndiscretize = true\n",
        "",
    ),
    "slider_crank": ("tolerance = 1e-9\nbatch = true\n", ""),
    "mass_spring": ('method = ["rk4", "verlet", "gauss6"]\ntolerance = 1e-7\n', STOPS),
    "cartpole_driven": (
        'tolerance = 1e-8\nmethod = ["rk4", "dp8"]\nbatch = true\n'
        'linearize = "products"\ndiscretize = true\n',
        EVENT,
    ),
    "double_pendulum": (
        'method = ["rk4", "gauss4", "gauss16", "euler"]\ntolerance = 1e-6\n',
        "",
    ),
    "chain": ('method = ["rk4", "dp8"]\nbatch = true\nreal = "float"\n', ""),
    "cartpole_bodies": (
        "tolerance = 1e-9\nframes = true\ninverse_dynamics = true\nmomentum = true\nbatch = true\n",
        "",
    ),
}
BRIEF = ("EVERYTHING", "rich pendulum_xy", "rich cartpole_driven", "rich double_pendulum")
PYTEST = ("-p", "no:cacheprovider", "-p", "no:xdist", "-q", "--tb=line", "-m", "not slow")


@dataclass
class Execution:
    """Execution of a scene or a test: its duration, the executed lines, the files that it read."""

    seconds: float
    lines: dict[str, list[int]] = field(default_factory=dict)
    read: list[str] = field(default_factory=list)
    digest: str = ""  # of a scene's sources


@dataclass
class Executions:
    """Scenes by name, and quick tests that pass in the copy by their pytest names."""

    scenes: dict[str, Execution]
    tests: dict[str, Execution]


def copy_tree() -> str:
    """Copy the tree in its current state; return its digest."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    files = sorted(file for file in listing.split("\0") if file and (ROOT / file).is_file())
    total = hashlib.sha256()
    for file in files:
        total.update(file.encode() + (ROOT / file).read_bytes())
    if (PLACE / "digest").exists() and (PLACE / "digest").read_text() == total.hexdigest():
        return total.hexdigest()
    shutil.rmtree(TREE, ignore_errors=True)
    for file in files:
        (TREE / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, TREE / file)
    flags = PACKAGE / "toolchain" / "compiler.py"
    text = flags.read_text(encoding="utf-8")
    assert '("-O3", ' in text and '("-O2",)' in text
    flags.write_text(text.replace('("-O3", ', '("-O0", ').replace('("-O2",)', '("-O0",)'))
    # A mutant may have the size and the modification time of the original.
    checked = py_compile.PycInvalidationMode.CHECKED_HASH
    for folder in (TREE / "generator", TREE / "tests"):
        compileall.compile_dir(folder, quiet=1, invalidation_mode=checked)
    (PLACE / "digest").write_text(total.hexdigest())
    return total.hexdigest()


def enter() -> None:
    """Let this forked process use the copy from now on."""
    os.chdir(TREE)
    sys.dont_write_bytecode = True
    os.environ |= {
        "PYTHONPATH": f"{PACKAGE.parent}", "TMPDIR": str(PLACE / "tmp"), "PYTHONPYCACHEPREFIX": "",
        "PYTHONDONTWRITEBYTECODE": "1", "EOMC_MUTANTS": str(PLACE),
    }  # fmt: skip
    (PLACE / "tmp").mkdir(exist_ok=True)
    sys.path[:0] = [str(PACKAGE.parent), str(TREE / "tests")]
    for name in [name for name in sys.modules if name.split(".")[0] == "support"]:
        del sys.modules[name]  # imported again from the copy
    silent = os.open(PLACE / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(silent, 1)
    os.dup2(silent, 2)


def record_executions(renew: bool = True) -> Executions:
    """Return the executions in the current tree, by running everything unless it is stored.

    renew: if False, use the executions of an existing copy if there is one.
    """
    stored_files = [] if renew else [*PLACE.glob("executed_*.json")]
    stored = stored_files[0] if stored_files else PLACE / f"executed_{copy_tree()[:16]}.json"
    if not stored.exists():
        scenes = dict(one for name in scene_names() for one in _watched(lambda n=name: _scene(n)))
        files = sorted(str(f.relative_to(TREE)) for f in (TREE / "tests").rglob("test_*.py"))
        tests = dict(one for file in files for one in _watched(lambda f=file: _file(f)))
        result = Executions(scenes, tests)
        for old in PLACE.glob("executed_*.json"):
            old.unlink()
        stored.write_text(json.dumps(asdict(result)))
    read = json.loads(stored.read_text())
    return Executions(
        *({k: Execution(**v) for k, v in read[x].items()} for x in ("scenes", "tests"))
    )


def digest_few_scenes() -> Executions:
    """Return digests of a few scenes' sources, without executed lines and tests."""
    copy_tree()

    def digest(name: str) -> str:
        enter()
        from support.mutant_trials import Scene

        return Scene(name).digest

    results = {name: in_a_fork(lambda n=name: digest(n), 120, group=True) for name in BRIEF}
    assert all(how == "done" for how, _ in results.values()), results
    return Executions(
        {name: Execution(0, digest=str(value)) for name, (_, value) in results.items()}, {}
    )


def _watched(work: Callable[[], dict[str, Any]]) -> Iterable[tuple[str, Execution]]:
    how, value = in_a_fork(work, 900, group=True)
    if how != "done":
        print(f"not watched: {how} {value}", flush=True)
        return []
    assert isinstance(value, dict)
    return [(name, Execution(**one)) for name, one in value.items()]


def scene_names() -> list[str]:
    """Return the names of scenes/, one scene with all features, RICH ones, random ones."""
    names = sorted(file.stem for file in (TREE / "scenes").glob("*.toml"))
    rich = (f"rich {name}" for name in RICH)
    return [*names, "EVERYTHING", *rich, *(f"wide {seed}" for seed in WIDE)]


def scene_text(name: str) -> str:
    """Return the text of one of these scenes."""
    if name.startswith("wide"):
        from support.scene_author import wide_text

        return wide_text(int(name.split()[1]))
    if name.startswith("rich"):
        name = name.split()[1]
        run, end = RICH[name]
        text = (TREE / "scenes" / f"{name}.toml").read_text(encoding="utf-8")
        return text.replace("\n[run]\n", f"\n[run]\n{run}") + end
    if name == "EVERYTHING":
        from support.session import EVERYTHING

        return EVERYTHING
    return (TREE / "scenes" / f"{name}.toml").read_text(encoding="utf-8")


class Watch:
    """Coverage by context, and the files of the copy that are read."""

    def __init__(self) -> None:
        import coverage

        include = [f"{PACKAGE}/*", f"{TREE}/build/*", f"{PLACE}/tmp/*"]
        self.coverage = coverage.Coverage(data_file=None, include=include, config_file=False)
        self.coverage.start()
        self.read: set[str] = set()
        sys.addaudithook(self._opened)

    def _opened(self, event: str, arguments: tuple[Any, ...]) -> None:
        if (
            event == "open"
            and isinstance(arguments[0], str)
            and arguments[0].startswith(f"{TREE}/")
        ):
            self.read.add(arguments[0].removeprefix(f"{TREE}/"))

    def lines(self) -> dict[str, dict[str, list[int]]]:
        """Return lines by file, by context; a copy of a file of runtime/ counts as that file."""
        self.coverage.stop()
        data = self.coverage.get_data()
        result: dict[str, dict[str, list[int]]] = defaultdict(dict)
        for file in data.measured_files():
            own = Path(file)
            if not own.is_relative_to(PACKAGE):
                own = PACKAGE / "runtime" / own.name
                if not own.exists():
                    continue
            name = str(own.relative_to(TREE))
            for line, contexts in data.contexts_by_lineno(file).items():
                for context in contexts:
                    result[context].setdefault(name, []).append(line)
        return result


def _scene(name: str) -> dict[str, Any]:
    """Derive, build and check a scene."""
    import time

    enter()
    watch = Watch()
    watch.coverage.switch_context("scene")
    began = time.perf_counter()
    from support.mutant_trials import Scene

    scene = Scene(name)
    faults = scene.faults()
    assert not faults, faults
    seconds = time.perf_counter() - began
    watch.coverage.switch_context("")
    return {
        name: asdict(Execution(seconds, watch.lines()["scene"], sorted(watch.read), scene.digest))
    }


def _file(file: str) -> dict[str, Any]:
    """Run the quick tests of a file."""
    import pytest

    enter()
    watch = Watch()
    seconds: dict[str, float] = defaultdict(float)
    bad = set()

    class Contexts:
        def pytest_runtest_setup(self, item: pytest.Item) -> None:
            watch.coverage.switch_context(item.nodeid)

        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            seconds[report.nodeid] += report.duration
            if not report.passed:
                bad.add(report.nodeid)

    pytest.main([*PYTEST, file], plugins=[Contexts()])
    lines, read = watch.lines(), sorted(watch.read)
    return {
        test: asdict(Execution(took, lines.get(test, {}), read))
        for test, took in seconds.items()
        if test not in bad
    }


OF_TEXTS = ("tests/c/", "tests/emit/", "tests/physics/", "tests/runtime/", "tests/toolchain/")
A_FILE = 2  # tests of each file that run for a template


def tests_of(executions: Executions, file: str, lines: set[int]) -> Sequence[str]:
    """Return tests for lines of Python: those that execute them, then those of their file.

    For a template or C, return some of each test file of generated code. The fastest come first,
    but golden tests last, because they also detect changes without effect.
    """

    def rank(test: str) -> tuple[bool, bool, float]:
        one = executions.tests[test]
        return lines.isdisjoint(one.lines.get(file, ())), "golden" in test, one.seconds

    if lines:
        return sorted((t for t, one in executions.tests.items() if file in one.lines), key=rank)
    chosen: list[str] = []
    counts: Counter[str] = Counter()
    for test in sorted(executions.tests, key=rank):
        own = test.split("::")[0]
        if (
            own.startswith(OF_TEXTS)
            and file in executions.tests[test].read
            and counts[own] < A_FILE
        ):
            counts[own] += 1
            chosen.append(test)
    return chosen


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
    "csrc/solver",
)  # their C
HEAVY = ("numpy", "sympy", "cffi", "jinja2", "pytest", "hypothesis", "coverage",
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


def judge(place: Place, executions: Executions) -> tuple[str, str]:
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
            lambda alone=alone: _run_trial("run_tests", alone),
            _limit(alone, executions),
            group=True,
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


def _judge(place: Place, executions: Executions) -> tuple[str, str]:
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
        ("check", 90, lambda: _run_trial("run_checks", scenes, right, 4, 15.0, same)),
        ("tests", _limit(few, executions), lambda: _run_trial("run_tests", few)),
        ("tests", _limit(more, executions), lambda: _run_trial("run_tests", more)),
        # survivors are checked at length
        ("check", 400, lambda: _run_trial("run_checks", scenes, right, 40, 200.0, same)),
        ("tests", 900, lambda: _run_trial("run_tests", _tests_of_folder(place.file, executions))),
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


def _limit(tests: Sequence[str], executions: Executions) -> float:
    return 45 + 5 * sum(executions.tests[test].seconds for test in tests)


def _tests_of_folder(file: str, executions: Executions) -> list[str]:
    """Return the quick tests of the folder that a file belongs to, or of generated code."""
    room = Path(file).parts[2] if file.startswith("generator/") else ""
    folders = (f"tests/{room}/",) if room else OF_TEXTS
    return [test for test in executions.tests if test.startswith(folders)]


def _run_trial(what: str, *arguments: object) -> tuple[str, str]:
    enter()
    from support import mutant_trials

    result: tuple[str, str] = getattr(mutant_trials, what)(*arguments)
    return result


def runs(one: Execution, file: str, lines: set[int]) -> bool:
    """Return whether a scene's check executes lines; True for templates and unrecorded scenes."""
    return not lines or not one.lines or not lines.isdisjoint(one.lines.get(file, ()))


def _tests_within(seconds: float, tests: Sequence[str], executions: Executions) -> list[str]:
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
    executions = digest_few_scenes() if options.brief else record_executions(not options.kept)
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
