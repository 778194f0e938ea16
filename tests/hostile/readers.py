"""Coverage-guided fuzzing of all readers of text: scenes, formulas, robot files, command lines.

    make fuzz                                            each target in turn, without end
    python tests/hostile/readers.py scene --seconds 60 --seed 1
    python tests/hostile/readers.py scene --show FILE    the result of one input

An input is accepted, or refused with an EomcError that names the file. Anything else is a finding:
another exception, more than SECONDS, more than MEMORY. Each finding is printed once with its
traceback, and stored with its input in build/hostile/finds. Seeds are the committed corpus, the
scenes and the bad scenes; inputs that reach new lines are stored in build/hostile/corpus for the
next time.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import atheris

with atheris.instrument_imports(include=["eomc"]):
    from eomc.base.errors import EomcError
    from eomc.cli.main import COMMANDS, main
    from eomc.model.system import from_scene
    from eomc.robots import edit, mjcf, scene_text, urdf
    from eomc.scene import formulas
    from eomc.scene.read import parse

HERE = Path(__file__).parent
TESTS, ROOT = HERE.parent, HERE.parents[1]
sys.path.insert(0, str(TESTS))

from support.bad_scenes import bad_scenes  # noqa: E402

OUTPUT_FOLDER = ROOT / "build" / "hostile"
SECONDS = 10.0  # allowed for one input
MEMORY = 2**30  # bytes that all inputs together may add
SYMPY_FROM = 12  # with so many bodies a scene is not derived, because that takes seconds

Target = Callable[[bytes], bool]  # returns whether the input was accepted


class Slow(BaseException):
    """An input that takes longer than SECONDS."""


# --- targets --------------------------------------------------------------------------------------


def formula(data: bytes) -> bool:
    """Parse a formula; a syntax error must contain a position."""
    text = data.decode("utf-8", "replace")
    try:
        formulas.parse(text)
    except formulas.FormulaError as fault:
        assert fault.message and 0 <= fault.column <= max(len(text), 1), fault
        return False
    return True


def read(data: bytes) -> bool:
    """Read a scene, without SymPy."""
    return _accepted(lambda: parse(data, "fuzz.toml"), "fuzz.toml")


def scene(data: bytes) -> bool:
    """Read a scene, as a system with SymPy."""
    return _accepted(lambda: from_scene(parse(data, "fuzz.toml")), "fuzz.toml")


def urdf_file(data: bytes) -> bool:
    """Read a URDF; the scene written from it must be valid."""
    return _robot(data, urdf.read)


def mjcf_file(data: bytes) -> bool:
    """Read an MJCF model, likewise; included files do not exist."""
    return _robot(data, lambda path: mjcf.read(path, include=b"include" in data))


def _robot(data: bytes, reader: Callable[[Path], Any]) -> bool:
    path = Path("fuzz.xml")
    path.write_bytes(data)

    def stopped(robot: Any) -> Any:
        return edit.with_joint_stops(robot) if edit.joint_stops(robot) else robot

    def convert() -> None:
        robot = reader(path)
        for change in (lambda r: r, edit.with_nearest_inertias, stopped):
            text = scene_text.scene_text(scene_text.prepare_for_scene(change(robot)))
            read_back = parse(text, "fuzz.xml.toml")
            if len(robot.bodies) < SYMPY_FROM:
                from_scene(read_back)

    return _accepted(convert, "fuzz")


def command(data: bytes) -> bool:
    """Run a command line in its own folder: status 0, 1, 2, or 130 if a run was interrupted."""
    words = [w for w in map(_harmless, data.decode("utf-8", "replace").split("\n")) if w][:12]
    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main.main(args=words, prog_name="eomc")
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
        except Slow:
            # Some commands run as long as requested.
            if not {"run", "report", "check"} & set(words):
                raise
    assert status in (0, 1, 2, 130), status
    assert "Traceback" not in err.getvalue(), err.getvalue()
    assert status != 2 or err.getvalue().strip(), "no word about what is wrong"
    return status == 0


def _harmless(word: str) -> str:
    """Replace words that name something outside the folder."""
    word = re.sub(r"[/\0]", "_", word)
    return "" if ".." in word or word.startswith("~") else word


def _accepted(work: Callable[[], object], name: str) -> bool:
    """Run `work`; a refusal must name the file or the robot, which has the file's name by
    default.
    """
    try:
        work()
    except EomcError as fault:
        where, _, why = str(fault).partition(": ")
        assert where and len(why) > 10, fault
        assert where.startswith(name) or not name.endswith(".toml"), fault
        return False
    return True


TARGETS: dict[str, Target] = {
    "formula": formula, "read": read, "scene": scene, "urdf": urdf_file, "mjcf": mjcf_file,
    "command": command,
}  # fmt: skip


# --- mutations that preserve most of the grammar --------------------------------------------------

TOKEN = re.compile(r'"[^"\n]*"|\w+|\s+|.', re.S)
HOSTILE = """-1 0 1 1e-300 1e300 1e400 nan inf -inf 0x10 1_0 9999999999 9**9**9 "" [] {} [[]] true t
pi "world" "\\u0000" x_dot dot( ( ) [i] [n-1] "i = 1..n" "i = 1..99999" é 𝐱 \ufeff \ud7ff "
' <!-- &lt;
&#0; <x> </x> -- --help --out --set x=1 x= =1 nan=nan -h --h""".split()


def seeds(name: str) -> list[Path]:
    """Return the folders with the initial inputs."""
    place = "scene" if name == "read" else name
    folders = [HERE / "corpus" / place]
    if place == "scene":
        bad = OUTPUT_FOLDER / "bad_scenes"
        bad.mkdir(parents=True, exist_ok=True)
        for scene in bad_scenes():
            (bad / f"{scene.name}.toml").write_bytes(scene.text)
        folders += [ROOT / "scenes", bad, TESTS / "report" / "pictured"]
    return folders


def everything(name: str) -> list[bytes]:
    """Return all initial inputs."""
    files = [file for folder in seeds(name) for file in sorted(folder.iterdir())]
    return [file.read_bytes() for file in files if file.suffix not in (".py", ".txt")]


def _fine(name: str, data: bytes) -> bool:
    return name == "command" or TARGETS[name](data)


def pool(name: str) -> tuple[list[str], list[str]]:
    """Return tokens and lines of all initial inputs."""
    texts = [data.decode("utf-8", "replace") for data in everything(name)]
    lines = sorted({line for text in texts for line in text.split("\n") if line.strip()})
    tokens = {t for line in lines for t in TOKEN.findall(line) if t.strip()}
    return [*sorted(tokens), *HOSTILE * 3, *_options(name)], lines


def _options(name: str) -> list[str]:
    if name != "command":
        return []
    import click

    context = click.Context(main)
    words = list(COMMANDS)
    for each in COMMANDS:
        subcommand = main.get_command(context, each)
        assert subcommand is not None
        for parameter in subcommand.params:
            if isinstance(parameter, click.Option):
                words += parameter.opts
            if isinstance(parameter.type, click.Choice):
                words += map(str, parameter.type.choices)
    return words


class Mutator:
    """Applies some changes of tokens, values and lines, mostly to a valid seed; or of bytes."""

    def __init__(self, name: str) -> None:
        self.tokens, self.lines = pool(name)
        self.valid = [data for data in everything(name) if _fine(name, data)]

    def __call__(self, data: bytes, most: int, seed: int) -> bytes:
        draw = random.Random(seed)
        part = draw.random()
        if part < 0.2:
            return bytes(atheris.Mutate(data, most))
        if part < 0.45:  # inputs that reached new lines are mostly invalid
            data = draw.choice(self.valid)
        text = data.decode("utf-8", "replace")
        for _ in range(draw.choice([1, 1, 1, 2, 2, 4])):
            text = self._changed(text, draw)
        return text.encode("utf-8", "surrogatepass")[:most]

    def _changed(self, text: str, draw: random.Random) -> str:
        if draw.random() < 0.4:
            lines = text.split("\n")
            at, other = draw.randrange(len(lines)), draw.randrange(len(lines))
            match draw.randrange(6):
                case 0:
                    del lines[at]
                case 1:
                    lines.insert(at, draw.choice(self.lines))
                case 2:
                    lines[at] = draw.choice(self.lines)
                case 3:
                    lines.insert(other, lines[at])
                case 4:
                    lines[at], lines[other] = lines[other], lines[at]
                case _:
                    a, b = sorted((at, other))
                    lines[b:b] = lines[a:b]
            return "\n".join(lines)
        tokens = TOKEN.findall(text) or [""]
        at = draw.choice([i for i, t in enumerate(tokens) if t.strip()] or [0])
        match draw.randrange(6):
            case 0:
                del tokens[at]
            case 1:
                tokens.insert(at, draw.choice(self.tokens))
            case 2:
                tokens[at] = draw.choice(tokens)
            case 3:
                # Text in quotes stays quoted, so that it is parsed.
                inside = tokens[at].startswith('"') and len(tokens[at]) > 1
                new = draw.choice(self.tokens).strip('"')
                tokens[at] = f'"{new}"' if inside else new
            case 4 if tokens[at].startswith('"'):
                inner = TOKEN.findall(tokens[at][1:-1]) or [""]
                inner[draw.randrange(len(inner))] = draw.choice(self.tokens).strip('"')
                tokens[at] = f'"{"".join(inner)}"'
            case _:
                tokens[at] = draw.choice(self.tokens)
        return "".join(tokens)


# --- a run ----------------------------------------------------------------------------------------


class Run:
    """Calls a target, and stores the findings."""

    def __init__(self, name: str, seconds: float, most: int) -> None:
        self.name, self.target, self.most = name, TARGETS[name], most
        self.end = time.monotonic() + seconds if seconds else float("inf")
        self.began, self.count, self.accepted = time.monotonic(), 0, 0
        self.found: dict[str, int] = {}
        self.slowest = 0.0
        self.memory = _peak()

    def __call__(self, data: bytes) -> None:
        began = time.monotonic()
        if began > self.end or self.count == self.most:
            self.leave()
        self.count += 1
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            self.accepted += self.target(data)
        except (Exception, Slow) as fault:
            signal.setitimer(signal.ITIMER_REAL, 0)
            self.keep(data, fault)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        self.slowest = max(self.slowest, time.monotonic() - began)
        if _peak() - self.memory > MEMORY:
            self.keep(data, MemoryError(f"{_peak()} bytes"))
            self.leave()

    def keep(self, data: bytes, fault: BaseException) -> None:
        """Print and store a finding, once for each position in the code."""
        places = [f"{f.filename}:{f.lineno}" for f in traceback.extract_tb(fault.__traceback__)]
        own = [p for p in places if "/eomc/" in p] or places
        key = f"{type(fault).__name__} {own[-1] if own else ''}"
        self.found[key] = self.found.get(key, 0) + 1
        if self.found[key] > 1:
            return
        folder = OUTPUT_FOLDER / "finds"
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{self.name}-{hashlib.sha256(key.encode()).hexdigest()[:12]}"
        file.write_bytes(data)
        text = "".join(traceback.format_exception(fault))
        print(f"\n--- a find, kept as {file}\n{text}", file=sys.stderr, flush=True)

    def leave(self) -> None:
        """Print the final line and end the process: libFuzzer prints none."""
        seconds = time.monotonic() - self.began
        print(
            f"{self.name}: {self.count} inputs in {seconds:.0f} s, {self.accepted} accepted, "
            f"{len(self.found)} finds, "
            f"slowest {self.slowest:.2f} s, memory {_peak() / 2**20:.0f} MB "
            f"({(_peak() - self.memory) / 2**20:.0f} more than at the start)"
        )
        for key, times in self.found.items():
            print(f"    {times} times {key}")
        sys.stdout.flush()
        os._exit(1 if self.found else 0)


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _slow(_: int, __: FrameType | None) -> None:
    raise Slow


@contextlib.contextmanager
def folder_of_its_own(name: str) -> Iterator[None]:
    """Change into a folder with a scene, a robot, and the scene's module, so that commands can
    run.
    """
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        if name == "command":
            os.environ["EOMC_CFLAGS"] = "-O0"
            for file in (ROOT / "scenes" / "simple_pendulum.toml", HERE / "corpus/urdf/arm.urdf"):
                shutil.copy(file, place)
            Path("bad.toml").write_text("eomc = 1\n", encoding="utf-8")
            with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
                main.main(args=["build", "simple_pendulum.toml"], prog_name="eomc")
            os.environ["CC"] = "false"  # compilation fails, because it would take seconds
        yield


def fuzz(name: str, seconds: float, seed: int, runs: int) -> None:
    """Fuzz a target; does not return."""
    grown = OUTPUT_FOLDER / "corpus" / ("scene" if name == "read" else name)
    grown.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    sys.stdin = io.StringIO()
    signal.signal(signal.SIGALRM, _slow)
    words = [
        sys.argv[0], str(grown), *map(str, seeds(name)), f"-seed={seed}", "-timeout=0",
        "-max_len=20000", "-rss_limit_mb=0", "-verbosity=0", "-len_control=0",
    ]  # fmt: skip
    run = Run(name, seconds, runs or -1)  # libFuzzer's own -runs= ends without output
    with folder_of_its_own(name):
        atheris.Setup(words, run, custom_mutator=Mutator(name))
        atheris.Fuzz()
    run.leave()


def show(name: str, file: Path) -> None:
    """Print the result of one input."""
    data = file.read_bytes()
    with folder_of_its_own(name):
        TARGETS[name](data)
    print("accepted, or refused by name")


def run_command(arguments: Sequence[str]) -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("target", choices=[*TARGETS])
    parser.add_argument("--seconds", type=float, default=0.0, help="0: without end")
    parser.add_argument("--seed", type=int, default=1, help="0: another each time")
    parser.add_argument("--runs", type=int, default=0, help="so many inputs at most")
    parser.add_argument("--show", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    if options.show:
        show(options.target, options.show.resolve())
    else:
        fuzz(options.target, options.seconds, options.seed, options.runs)


if __name__ == "__main__":
    run_command(sys.argv[1:])
