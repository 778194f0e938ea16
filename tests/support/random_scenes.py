"""Check random valid scenes.

python tests/support/random_scenes.py --count 2000            correct modules must pass
python tests/support/random_scenes.py --count 300 --negate    modules with a negated term must fail
python tests/support/random_scenes.py --wide --count 500      with outputs, events, loops and so on
python tests/support/random_scenes.py --show 7                the scene of that number
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

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.emit.render import Sources
from eomc.mechanism.assembly import assembled
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.toolchain import compiler

sys.path.insert(0, str(Path(__file__).parents[1]))

from support import sign_errors
from support.scene_author import scene_text, wide_text
from support.template_checks import check_all

ROOT = Path(__file__).parents[2] / "build" / "random"
EXTENSION = "_extension"
# checks that may report that they cannot judge
JUDGES = ("order of", "h of", "power balance", "beside")


@dataclass(frozen=True)
class Outcome:
    """Result for one scene: "passed", "false alarm", "not built", "no start", "check raised"; with
    a negated term "caught", "wrong pass", "unchanged" or, if the build itself failed, "refused".

    rows: failed checks, with their values. unjudged: checks that could not judge. judged: number of
    checks of orders, steps and balances.
    """

    seed: int
    outcome: str
    words: str = ""
    rows: tuple[str, ...] = ()
    unjudged: tuple[str, ...] = ()
    judged: int = 0
    seconds: float = 0.0


def outcome(seed: int, negate: bool, root: Path, wide: bool = False) -> Outcome:
    """Derive the scene of that number, build it under `root` and check it."""
    began = time.perf_counter()
    system, module, plain = None, None, None
    try:
        text = (wide_text if wide else scene_text)(seed)
        system = from_scene(parse(text, f"{seed}.toml"))
        try:
            system = assembled(system)
        except SceneError as fault:  # a loop that cannot be closed
            return Outcome(seed, "no start", _words(fault))
        sources = eomc.sources(system, EXTENSION)
        module = built(sources, root / "right")
        if not negate:  # the error must be detected without a correct module for comparison
            plain = built(sources, root / "plain", "plain")
    except Exception as fault:
        return Outcome(seed, "not built", _words(fault))
    what = ""
    if negate:
        right, (sources, what) = module, sign_errors.negated_sources(system, EXTENSION, seed)
        try:
            module = built(sources, root / "wrong")
        except EomcError as fault:  # such as a D that is not positive definite
            return Outcome(seed, "refused", f"{what}: {_words(fault)}")
        if not sign_errors.changes(right, module, seed):
            return Outcome(seed, "unchanged", what)
    try:
        report = check_all(system, module, plain=plain, seed=seed)
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
    sources: Sources, folder: Path, form: str = "fast", cache: Path | None = None
) -> ModuleType:
    """Build a module of one form of these sources, with a binding that is not optimised.

    cache: a folder with earlier compilations of the same C.
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
    with redirect_stdout(io.StringIO()):  # suppresses its output
        ffi.emit_c_code(str(folder / "binding.c"))
    flags = [compiler.standard(form), *compiler.flags()]
    texts = [(file.name, file.read_text()) for file in sorted(folder.glob("*.[ch]"))]
    digest = hashlib.sha256(repr((flags, texts)).encode()).hexdigest()
    library = folder / f"{EXTENSION}{sysconfig.get_config_var('EXT_SUFFIX')}"
    if cache is not None and (cache / digest).exists():
        shutil.copy(cache / digest, library)
    else:
        _compile(sources.name, flags, library)
        if cache is not None:
            cache.mkdir(exist_ok=True)
            shutil.copy(library, cache / digest)
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
        process = subprocess.run(
            command, cwd=library.parent, capture_output=True, text=True, check=False
        )
        if process.returncode:
            raise EomcError(process.stderr)


def _one(task: tuple[int, bool, bool]) -> Outcome:
    """Handle a task in a process of a pool; remove the build."""
    os.environ.setdefault("EOMC_CFLAGS", "-O1")
    warnings.simplefilter("ignore")
    ROOT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=ROOT) as root:
        seed, negate, wide = task
        return outcome(seed, negate, Path(root), wide)


def main() -> int:
    """Return 1 if a correct module failed or a wrong one passed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="the number of the first scene")
    parser.add_argument("--negate", action="store_true", help="negate one term of each")
    parser.add_argument("--wide", action="store_true", help="those of wide_text")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--log", type=Path, help="a line of JSON for each scene")
    parser.add_argument("--show", type=int, metavar="N", help="print the scene of that number")
    options = parser.parse_args()
    if options.show is not None:
        print((wide_text if options.wide else scene_text)(options.show), end="")
        return 0
    tasks = [(options.seed + k, options.negate, options.wide) for k in range(options.count)]
    counts: Counter[str] = Counter()
    unjudged: Counter[str] = Counter()
    judged = 0
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        log = stack.enter_context(options.log.open("a")) if options.log else None
        pool = stack.enter_context(context.Pool(options.jobs, maxtasksperchild=50))
        for result in pool.imap_unordered(_one, tasks):
            counts[result.outcome] += 1
            unjudged.update(text.split(":")[0] for text in result.unjudged)
            judged += result.judged
            if result.outcome in ("false alarm", "wrong pass", "check raised", "not built"):
                print(f"{result.seed}: {result.outcome} {result.words}", *result.rows, sep="\n    ")
            if log:
                print(json.dumps(asdict(result)), file=log, flush=True)
    print(", ".join(f"{n} {what}" for what, n in counts.most_common()))
    print(f"of {judged} rows about orders, h and balances not judged: {unjudged.total()}")
    print(", ".join(f"{n} {row}" for row, n in unjudged.most_common()))
    bad = ("false alarm", "wrong pass", "check raised", "not built")
    return int(any(counts[outcome] for outcome in bad))


if __name__ == "__main__":
    sys.exit(main())
