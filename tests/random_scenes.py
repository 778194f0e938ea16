"""What the check says of random valid scenes.

python tests/random_scenes.py --count 2000            right modules must pass
python tests/random_scenes.py --count 300 --negate    with one term negated they must not
python tests/random_scenes.py --wide --count 500      with outputs, events, loops and so on
python tests/random_scenes.py --show 7                the scene of that number
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import io
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType

import cffi
import negated
from scene_author import scene_text
from scene_author_wide import wide_text

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.emit.render import Sources
from eomc.model.from_scene import from_scene
from eomc.program.assembly import assembled
from eomc.scene.read import parse
from eomc.toolchain import compiler
from eomc.verify.check import check

ROOT = Path(__file__).parent.parent / "build" / "random"
EXTENSION = "_extension"
JUDGES = ("order of", "h of", "power balance", "beside")  # rows that may say they can't judge


@dataclass(frozen=True)
class Outcome:
    """Of one scene: "passed", "false alarm", "not built", "no start", "check raised"; where a term
    is negated "caught", "wrong pass", "unchanged" or, where the build itself refused, "refused".

    rows: those that failed, with what was found. unjudged: those that said they judge nothing.
    judged: how many rows about orders, steps and balances did.
    """

    seed: int
    outcome: str
    words: str = ""
    rows: tuple[str, ...] = ()
    unjudged: tuple[str, ...] = ()
    judged: int = 0
    seconds: float = 0.0


def outcome(seed: int, negate: bool, root: Path, wide: bool = False) -> Outcome:
    """The scene of that number derived, built under `root` and checked."""
    began = time.perf_counter()
    made, module, plain = None, None, None
    try:
        text = (wide_text if wide else scene_text)(seed)
        made = from_scene(parse(text, f"{seed}.toml"))
        try:
            made = assembled(made)
        except SceneError as fault:  # a loop that can't close from there, rightly
            return Outcome(seed, "no start", _words(fault))
        sources = eomc.sources(made, EXTENSION)
        module = built(sources, root / "right")
        if not negate:  # what is wrong is to be seen without a right one beside it
            plain = built(sources, root / "plain", "plain")
    except Exception as fault:
        return Outcome(seed, "not built", _words(fault))
    what = ""
    if negate:
        right, (sources, what) = module, negated.negated_sources(made, EXTENSION, seed)
        try:
            module = built(sources, root / "wrong")
        except EomcError as fault:  # such as a D that is not positive definite
            return Outcome(seed, "refused", f"{what}: {_words(fault)}")
        if not negated.changes(right, module, seed):
            return Outcome(seed, "unchanged", what)
    try:
        report = check(made, module, plain=plain, seed=seed)
    except Exception as fault:
        return Outcome(seed, "check raised", _words(fault))
    verdict = ("caught", "wrong pass") if negate else ("false alarm", "passed")
    about = [row for row in report.results if any(word in row.name for word in JUDGES)]
    return Outcome(
        seed,
        verdict[report.passed],
        what,
        tuple(f"{r.name}: {r.error:.4g} {r.unit}" for r in report.results if not r.passed),
        tuple(f"{r.name}: {r.unit}" for r in about if r.unit.startswith("not judged")),
        len(about),
        round(time.perf_counter() - began, 2),
    )


def _words(fault: Exception) -> str:
    return f"{type(fault).__name__}: {str(fault)[-600:]}"


def built(
    sources: Sources, folder: Path, form: str = "fast", kept: Path | None = None
) -> ModuleType:
    """The module of a form of these sources, as a build makes it, its binding not optimised.

    kept: a folder of what was compiled from the same C before.
    """
    folder.mkdir(parents=True)
    for file, text in sources.files.items():
        if file.startswith("fast/") == (form == "fast") or file.endswith(".py"):
            path = folder / file.removeprefix("fast/")
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    ffi = cffi.FFI()
    ffi.cdef(sources.cdef)
    ffi.set_source(EXTENSION, sources.binding)
    with redirect_stdout(io.StringIO()):  # it tells of itself
        ffi.emit_c_code(str(folder / "binding.c"))
    flags = [compiler.standard(form), *compiler.flags()]
    texts = [(file.name, file.read_text()) for file in sorted(folder.glob("*.[ch]"))]
    digest = hashlib.sha256(repr((flags, texts)).encode()).hexdigest()
    library = folder / f"{EXTENSION}{sysconfig.get_config_var('EXT_SUFFIX')}"
    if kept is not None and (kept / digest).exists():
        shutil.copy(kept / digest, library)
    else:
        _compile(sources.name, flags, library)
        if kept is not None:
            kept.mkdir(exist_ok=True)
            shutil.copy(library, kept / digest)
    name = f"_random_{hashlib.sha256(str(folder).encode()).hexdigest()}"
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _compile(name: str, flags: Sequence[str], library: Path) -> None:
    include = {sysconfig.get_path("include"), sysconfig.get_path("platinclude")}
    for words in (
        ["-O0", *(f"-I{path}" for path in include), "-c", "binding.c"],
        [*flags, "-c", f"{name}.c"],
        ["-shared", "binding.o", f"{name}.o", "-lm", "-o", library.name],
    ):
        command = [*compiler.find_compiler().command, "-fPIC", *words]
        done = subprocess.run(
            command, cwd=library.parent, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise EomcError(done.stderr)


def _one(task: tuple[int, bool, bool]) -> Outcome:
    """For a process of a pool: nothing of the build is left."""
    os.environ.setdefault("EOMC_CFLAGS", "-O1")
    warnings.simplefilter("ignore")
    ROOT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=ROOT) as root:
        seed, negate, wide = task
        return outcome(seed, negate, Path(root), wide)


def main() -> int:
    """1 where something right failed, or something wrong passed."""
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--count", type=int, default=100)
    asked.add_argument("--seed", type=int, default=0, help="the number of the first scene")
    asked.add_argument("--negate", action="store_true", help="negate one term of each")
    asked.add_argument("--wide", action="store_true", help="those of scene_author_wide")
    asked.add_argument("--jobs", type=int, default=1)
    asked.add_argument("--log", type=Path, help="a line of JSON for each scene")
    asked.add_argument("--show", type=int, metavar="N", help="print the scene of that number")
    given = asked.parse_args()
    if given.show is not None:
        print((wide_text if given.wide else scene_text)(given.show), end="")
        return 0
    tasks = [(given.seed + k, given.negate, given.wide) for k in range(given.count)]
    counts: Counter[str] = Counter()
    unjudged: Counter[str] = Counter()
    judged = 0
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        log = stack.enter_context(given.log.open("a")) if given.log else None
        pool = stack.enter_context(context.Pool(given.jobs, maxtasksperchild=50))
        for told in pool.imap_unordered(_one, tasks):
            counts[told.outcome] += 1
            unjudged.update(text.split(":")[0] for text in told.unjudged)
            judged += told.judged
            if told.outcome in ("false alarm", "wrong pass", "check raised", "not built"):
                print(f"{told.seed}: {told.outcome} {told.words}", *told.rows, sep="\n    ")
            if log:
                print(json.dumps(asdict(told)), file=log, flush=True)
    print(", ".join(f"{n} {what}" for what, n in counts.most_common()))
    print(f"of {judged} rows about orders, h and balances not judged: {unjudged.total()}")
    print(", ".join(f"{n} {row}" for row, n in unjudged.most_common()))
    bad = ("false alarm", "wrong pass", "check raised", "not built")
    return int(any(counts[outcome] for outcome in bad))


if __name__ == "__main__":
    sys.exit(main())
