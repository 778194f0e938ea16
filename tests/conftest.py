"""Fixtures that several test files share: scenes compiled once, scenes from text, C compilers."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import importlib
import os
import shutil
import signal
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any

import precompiled
import pytest
from cases import SCENES
from hypothesis import HealthCheck, settings

import eomc
from eomc.model.from_scene import from_scene
from eomc.model.system import System
from eomc.scene.read import parse
from eomc.toolchain import compiler, extension
from eomc.verify.sampling import Sampler

if TYPE_CHECKING:
    from eomc.emit.render import Sources
    from eomc.toolchain.compiler import Compiler
    from eomc.verify.reference import ReferenceModel, Vector
    from eomc.verify.sampling import SampleBudget

# Background jobs of a shell ignore SIGINT, and tests of Ctrl-C would never end.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ["builds"]

gc.set_threshold(100_000, 20, 100)  # SymPy creates many objects and few cycles

ROOT = Path(__file__).parent.parent
os.environ.setdefault("HYPOTHESIS_STORAGE_DIRECTORY", str(ROOT / "build" / ".hypothesis"))
# Slow generation of inputs on a busy machine is no error of the tested code.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
# Runtime files are identical in all built modules: compile them to bytecode once.
_get_code = SourceFileLoader.get_code
_codes: dict[bytes, CodeType] = {}


def _code_once(loader: SourceFileLoader, name: str) -> CodeType | None:
    path = Path(loader.get_filename(name))
    if not (path.parent / "build.json").exists():
        return _get_code(loader, name)
    text = path.read_bytes()
    if text not in _codes:
        _codes[text] = loader.source_to_code(text, str(path))
    return _codes[text]


SourceFileLoader.get_code = _code_once  # type: ignore[method-assign]


def _binding_flags() -> tuple[str, ...]:
    """Compile the binding without optimisation, in half the time; its speed does not matter."""
    flags = compiler.user_flags()
    if os.environ.get("CC") or (flags is not None and flags != ("-O0",)):
        return flags or ("-O0",)
    return ("-O0", *precompiled.precompiled_header_flags())


extension.binding_flags = _binding_flags
_run, _build, _try = extension.run, extension.build, extension.try_load
_libraries: dict[str, bytes] = {}


def _build_once(
    sources: Sources, name: str, folder: Path, library: str, by: Compiler, *how: Any
) -> None:
    """Reuse the result for the same C and compiler, unless a test sets one."""
    if os.environ.get("CC"):
        _build(sources, name, folder, library, by, *how)
        return
    if len(how) == 1 and compiler.user_flags() == ("-O0",):
        how = (*how, precompiled.UNOPTIMISED)
    parts = (sources.files, sources.cdef, name, library, by, how, compiler.user_flags())
    key = hashlib.sha256(repr(parts).encode()).hexdigest()
    if key in _libraries:
        (folder / library).write_bytes(_libraries[key])
        return
    _build(sources, name, folder, library, by, *how)
    _libraries[key] = (folder / library).read_bytes()


def _link(name: str, folder: Path, *commands: Sequence[str]) -> None:
    """Omit startup files when linking a library that Python loads; this saves time."""
    if not os.environ.get("CC"):
        for words in commands:
            if words[-3].endswith("binding.c") and words[-1] == "binding.o" and "-O0" in words:
                file = folder / words[-3]
                file.write_text(precompiled.shorten_binding(file.read_text("utf-8")), "utf-8")
    plain = os.environ.get("CC") or sys.platform != "linux" or "-shared" not in commands[0]
    _run(name, folder, *commands if plain else [[*commands[0], "-nostdlib"]])


def _trial(*what: Any) -> None:
    """Skip the trial for the default compiler, because its library is loaded next."""
    if os.environ.get("CC"):
        _try(*what)


extension.build, extension.run, extension.try_load = _build_once, _link, _trial

_original_ranges = Sampler._predicted_ranges
_cached_ranges: dict[tuple[int, SampleBudget], tuple[ReferenceModel, Vector]] = {}


def _predicted_ranges_once(sampler: Sampler, effort: SampleBudget) -> Vector:
    """Cache the predicted ranges, which take most of the time of drawing a few states."""
    key = (id(sampler.reference), effort)
    if key not in _cached_ranges:
        # The stored reference keeps its id valid.
        _cached_ranges[key] = (sampler.reference, _original_ranges(sampler, effort))
    return _cached_ranges[key][1]


Sampler._predicted_ranges = _predicted_ranges_once  # type: ignore[method-assign]

# reused in later sessions
MODULES = ROOT / "build" / "tests" / "modules"
UNOPTIMISED = ROOT / "build" / "tests" / "unoptimised"

# Every function of the formula language, explicit time, friction, a part of K without velocities,
# an input that depends on the state, and names that are awkward in C and Python.
EVERYTHING = """
eomc = 1
name = "everything"
title = "Every function of the formula language"
[coordinates]
x     = { unit = "m", start = 0.3, rate = 0.2, note = "a note with */ in it and an é" }
theta = { unit = "rad", start = 0.4, rate = -0.1 }
q     = { start = 0.5, rate = 0.3 }
[parameters]
m      = 1.5
g      = 9.81
I      = 0.7
E      = 0.2
S      = 0.3
N      = 0.25
beta   = 0.4
gamma  = 0.15
zeta   = 0.05
values = 0.6
h      = 0.35
y0     = 0.45
index  = 0.55
[constants]
third = "1/3"
[inputs]
u    = { unit = "N", signal = "sin(2*t) + x/10" }
push = { unit = "N" }
[definitions]
px = "x*cos(theta) + tanh(q)*S + E*cos(3*t)"
py = "x*sin(theta) + N*sinh(q/4)*cosh(q/5)"
a  = "atan(q) + asin(q/4) + acos(q/5) + atan2(q + 2, x + 3)"
turning = "(I*theta_dot**2 + beta*q_dot**2*(2 + sin(theta)) + values*(theta_dot + h*x)**2)/2"
b  = "exp(-q**2) + log(2 + q**2) + sqrt(1 + x**2) + tan(q/7) + third"
[energy]
kinetic     = "m*(dot(px)**2 + dot(py)**2)/2 + turning + y0*t*q_dot/10"
potential   = "m*g*py + gamma*a**2 + index*b + zeta*x**4 + (1 + x**2)**1.5/20"
dissipation = "zeta*theta_dot**2/2 + gamma*dot(py)**2/2"
[forces]
x     = "u - zeta*x_dot*abs(x_dot)"
theta = "-gamma*sign(theta_dot)/10 + push*heaviside(x) + pi/100"
q     = "min(x, theta, 0.3)/5 - max(q_dot, 0.1)/7"
[outputs]
tip   = { formula = "py + dot(px)", unit = "m" }
pull  = "m*(dot(dot(px)) + g) + theta_ddot*push"
whole = "energy + t"
[run]
h        = 0.01
duration = 2.0
"""


@cache
def _loaded(name: str) -> ModuleType:
    return _compiled(SCENES / f"{name}.toml", MODULES, None)


@cache
def _compiled_system(system: System, optimised: bool) -> ModuleType:
    """Build in a folder of its own, because tests may give two scenes the same name."""
    root, flags = (MODULES, None) if optimised else (UNOPTIMISED, "-O0")
    return _compiled(system, root / system.digest[:16], flags)


def _compiled(source: Path | System, root: Path, flags: str | None) -> ModuleType:
    """Build with these flags, or the default ones, regardless of the flags that a test has set."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("EOMC_CFLAGS", raising=False)
        if flags is not None:
            patch.setenv("EOMC_CFLAGS", flags)
        return eomc.load(source, root)


class Modules:
    """Compiled scenes, each built once per session and reused by the next session."""

    def __call__(self, name: str) -> ModuleType:
        """Return the module of scenes/<name>.toml."""
        return _loaded(name)

    def of_text(self, text: str) -> ModuleType:
        """Return the module of a scene given as text."""
        return _compiled_system(from_scene(parse(text, "test.toml")), True)

    def unoptimised(self, source: str | System) -> ModuleType:
        """Return the module of a text or a system, compiled without optimisation in half the
        time.
        """
        system = from_scene(parse(source, "test.toml")) if isinstance(source, str) else source
        return _compiled_system(system, False)


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


def tiers(values: Iterable[Any], *quick: Any) -> list[Any]:
    """Return parameters, marking as slow those whose first value is not one of `quick`."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=() if row[0] in quick else pytest.mark.slow) for row in rows]


def needs(compiler: str) -> str:
    """Return the path of a program, possibly installed by pip; skip the test if it is missing."""
    path = shutil.which(compiler) or shutil.which(compiler, path=str(Path(sys.executable).parent))
    if path is None:
        pytest.skip(f"{compiler} is not installed")
    return path
