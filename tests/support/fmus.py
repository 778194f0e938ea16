"""FMUs for tests: scenes exported once, and one interface to FMPy for both versions of FMI."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import eomc
from eomc import pipeline
from eomc.derive import lagrange
from eomc.emit import render
from eomc.model.system import from_scene
from eomc.program import program
from eomc.program.program import Program
from eomc.scene.read import parse
from eomc.toolchain import archives
from support.cases import SCENES
from support.session import ROOT

VERSIONS = (2, 3)
BUILT = ROOT / "build" / "tests" / "fmu"
FOLDER = Path(tempfile.mkdtemp(prefix="eomc-fmus-"))  # of this process

# A ball thrown against a wall: jumps, a stop, an input with limits and a signal, an output.
BALL = """
eomc = 1
name = "ball"
[coordinates]
y = { unit = "m", start = 1.0 }
x = { unit = "m", rate = 0.5 }
[parameters]
m = { value = 1.0, unit = "kg" }
g = { value = 9.81, unit = "m/s^2" }
e = 0.8
wall = { value = 0.9, unit = "m" }
[inputs]
wind = { unit = "N", signal = "0.1*sin(t)", limits = [-5, 5] }
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "m*g*y"
[forces]
x = "wind - 0.1*x_dot"
[outputs]
ax = { formula = "x_ddot", unit = "m/s^2" }
height = { formula = "y + 0.1*x", unit = "m" }
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[[event]]
name = "wall"
when = "x - wall - 0.01*wind"
action = "stop"
[[event]]
name = "top"
when = "y_dot"
direction = "falling"
[run]
tolerance = 1e-9
h = 0.01
duration = 3
linearize = true
"""

# Limits, initial values that are formulas of parameters, derivatives by parameters.
RIG = """
eomc = 1
name = "rig"
[coordinates]
x = { unit = "m", start = "2*x0 + w", rate = "w" }
y = { unit = "m", start = 0.3 }
[parameters]
k = 4.0
most = 3.0
x0 = 0.1
w = 0.05
[inputs]
force = { unit = "N", limits = [-1, 1.5], signal = "2*k*cos(t)" }
pull = { unit = "N", limits = ["-most", "most"] }
push = { limits = [0, inf] }
[energy]
kinetic = "x_dot**2/2 + k*y_dot**2/2"
potential = "k*x**2/2 + w*y**4"
[forces]
x = "force + pull"
y = "w*push"
[outputs]
load = "k*(x + y) + x_ddot*w"
where = "x"
[run]
h = 0.01
linearize = "parameters"
"""

# Single precision, the implicit method, and an input that depends on the state.
FLOAT = """
eomc = 1
name = "soft"
[coordinates]
phi = { unit = "rad", start = 0.5 }
[parameters]
k = { value = 3.0, unit = "N m/rad" }
[inputs]
push = { unit = "N m", signal = "-0.3*phi_dot" }
[energy]
kinetic = "phi_dot**2/2"
potential = "k*phi**2/2"
[forces]
phi = "push"
[run]
h = 0.01
real = "float"
"""


def _unoptimised(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile without optimisation, in a third of the time: strict C99 gives equal bits."""

    @cache
    @wraps(function)
    def called(*arguments: Any) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("EOMC_CFLAGS", "-O0")
            return function(*arguments)

    return called


@cache
def derived_of(scene: str) -> Program:
    """Return the program of a scene in scenes/ by its name, or of a scene as text."""
    if "\n" not in scene:
        system = pipeline.read(SCENES / f"{scene}.toml")
    else:
        system = from_scene(parse(scene, "test.toml"))
    return program.build(lagrange.derive(system))


@_unoptimised
def plain(scene: str) -> ModuleType:
    """Return the module of portable C, of a scene in scenes/ or of a text."""
    if "\n" not in scene:
        return eomc.load(SCENES / f"{scene}.toml", BUILT, form="plain")
    system = from_scene(parse(scene, "test.toml"))
    return eomc.load(system, BUILT / system.digest[:12], form="plain")


@_unoptimised
def exported(scene: str, version: int) -> Path:
    """Return the file of an exported FMU, of a scene in scenes/ by its name or of a scene as
    text.
    """
    program = derived_of(scene)
    file = FOLDER / f"{program.system.digest[:12]}-{version}.fmu"
    return archives.write_fmu(render.unit(program, version), file).file


@cache
def extracted(file: Path) -> str:
    """Return the folder of the extracted files."""
    from fmpy import extract

    return str(extract(str(file), str(FOLDER / f"{file.stem}-inside")))


class Host:
    """An instance. kind: "CoSimulation" or "ModelExchange"; said: its log messages."""

    def __init__(
        self, file: Path, kind: str = "CoSimulation", logging: bool = False, folder: str = ""
    ) -> None:
        from fmpy import read_model_description
        from fmpy.simulation import instantiate_fmu

        folder = folder or extracted(file)
        described = read_model_description(folder)
        self.said: list[tuple[str, str]] = []
        self.three = described.fmiVersion != "2.0"
        logger = self._logged3 if self.three else self._logged2
        self.unit: Any = instantiate_fmu(
            folder, described, kind, logger=logger, debug_logging=logging
        )
        self.of = {v.name: v.valueReference for v in described.modelVariables}
        self.t = 0.0
        self.returned_early = False  # early return of the last step in FMI 3.0

    def _logged2(self, _: Any, name: bytes, status: int, category: bytes, message: bytes) -> None:
        self.said.append((category.decode(), message.decode()))

    def _logged3(self, _: Any, status: int, category: bytes, message: bytes) -> None:
        self.said.append((category.decode(), message.decode()))

    def references(self, names: Sequence[str]) -> list[int]:
        return [self.of[n] for n in names]

    def get(self, *names: str) -> list[float]:
        read = self.unit.getFloat64 if self.three else self.unit.getReal
        return list(read(self.references(names)))

    def set(self, **values: float) -> None:
        self.set_all(values)

    def set_all(self, values: Mapping[str, float]) -> None:
        write = self.unit.setFloat64 if self.three else self.unit.setReal
        write(self.references([*values]), [*values.values()])

    def follow_signals(self, on: bool = True) -> None:
        self.unit.setBoolean([self.of["inputs.follow_signals"]], [on])

    def start(self, t: float = 0.0, tolerance: float | None = None) -> None:
        self.t = t
        if self.three:
            self.unit.enterInitializationMode(tolerance=tolerance, startTime=t)
        else:
            self.unit.setupExperiment(tolerance=tolerance, startTime=t)
            self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()

    def step(self, size: float) -> bool:
        """Do a communication step; return True if the FMU requests termination."""
        result = None
        if self.three:
            result = self.unit.doStep(self.t, size)
        else:
            from fmpy.fmi1 import FMICallException

            try:
                self.unit.doStep(self.t, size)
            except FMICallException:
                if not self.unit.getBooleanStatus(3):  # fmi2Terminated
                    raise
                self.t = self.unit.getRealStatus(2)  # fmi2LastSuccessfulTime
                return True
        self.returned_early = bool(result and result[2])
        self.t = result[3] if result else self.t + size
        return bool(result and result[1])

    def saved_state(self) -> Any:
        return self.unit.getFMUState()

    def restore(self, state: Any) -> None:
        self.unit.setFMUState(state)

    def slope(
        self, unknown: Sequence[str], known: Sequence[str], seeds: Sequence[float]
    ) -> list[float]:
        return list(
            self.unit.getDirectionalDerivative(
                self.references(unknown), self.references(known), seeds
            )
        )

    def free(self) -> None:
        self.unit.terminate()
        self.unit.freeInstance()


def needs_fmpy() -> None:
    """Skip the test, with the reason, if FMPy is not installed."""
    pytest.importorskip("fmpy", reason="FMPy is not installed: pip install '.[fmu]'")


def rows(host: Host, names: Sequence[str], size: float, count: int) -> np.ndarray:
    """Return the initial values and those after each of `count` steps."""
    values = [host.get(*names)]
    for _ in range(count):
        host.step(size)
        values.append(host.get(*names))
    return np.array(values)
