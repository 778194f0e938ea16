"""Which lines of the generator the check of each scene and each quick test execute.

They run without optimisation in a copy of the tree, which `generator_mutants` changes.
"""

from __future__ import annotations

import compileall
import hashlib
import json
import os
import py_compile
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from forks import in_a_fork

ROOT = Path(__file__).parents[1]
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
        "linearize = true\ndiscretize = true\n",
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
class Executed:
    """Scenes by name, and quick tests that pass in the copy by their pytest names."""

    scenes: dict[str, Execution]
    tests: dict[str, Execution]


def copied() -> str:
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
        "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip
    (PLACE / "tmp").mkdir(exist_ok=True)
    sys.path[:0] = [str(PACKAGE.parent), str(TREE / "tests")]
    silent = os.open(PLACE / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(silent, 1)
    os.dup2(silent, 2)


def executed(renew: bool = True) -> Executed:
    """Return the executions in the current tree, by running everything unless it is stored.

    renew: if False, use the executions of an existing copy if there is one.
    """
    stored_files = [] if renew else [*PLACE.glob("executed_*.json")]
    stored = stored_files[0] if stored_files else PLACE / f"executed_{copied()[:16]}.json"
    if not stored.exists():
        scenes = dict(one for name in scene_names() for one in _watched(lambda n=name: _scene(n)))
        files = sorted(str(f.relative_to(TREE)) for f in (TREE / "tests").rglob("test_*.py"))
        tests = dict(one for file in files for one in _watched(lambda f=file: _file(f)))
        result = Executed(scenes, tests)
        for old in PLACE.glob("executed_*.json"):
            old.unlink()
        stored.write_text(json.dumps(asdict(result)))
    read = json.loads(stored.read_text())
    return Executed(*({k: Execution(**v) for k, v in read[x].items()} for x in ("scenes", "tests")))


def briefly() -> Executed:
    """Return digests of a few scenes' sources, without executed lines and tests."""
    copied()

    def digest(name: str) -> str:
        enter()
        from judged import Scene

        return Scene(name).digest

    results = {name: in_a_fork(lambda n=name: digest(n), 120, group=True) for name in BRIEF}
    assert all(how == "done" for how, _ in results.values()), results
    return Executed(
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
        from scene_author_wide import wide_text

        return wide_text(int(name.split()[1]))
    if name.startswith("rich"):
        name = name.split()[1]
        run, end = RICH[name]
        text = (TREE / "scenes" / f"{name}.toml").read_text(encoding="utf-8")
        return text.replace("\n[run]\n", f"\n[run]\n{run}") + end
    if name == "EVERYTHING":
        from conftest import EVERYTHING

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
    from judged import Scene

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


def tests_of(executions: Executed, file: str, lines: set[int]) -> Sequence[str]:
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
