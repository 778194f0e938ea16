"""Co-simulation of two FMUs: an arm by eomc and a PID controller by PythonFMU3.

python docs/examples/fmu_pid.py        (pip install ".[fmu]" installs FMPy and PythonFMU3)
"""

import sys
import tempfile
from pathlib import Path

from fmpy import extract, read_model_description
from fmpy.simulation import instantiate_fmu
from pythonfmu3 import FmuBuilder

import eomc

PERIOD = 0.005  # s, communication step
HERE = Path(__file__).parent


class Unit:
    """A co-simulation instance with access to its variables by name."""

    def __init__(self, file: Path, folder: Path) -> None:
        extract(str(file), str(folder))
        described = read_model_description(str(folder))
        self.of = {v.name: v.valueReference for v in described.modelVariables}
        self.unit = instantiate_fmu(str(folder), described, "CoSimulation")
        self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()

    def __getitem__(self, name: str) -> float:
        return float(self.unit.getFloat64([self.of[name]])[0])

    def __setitem__(self, name: str, value: float) -> None:
        self.unit.setFloat64([self.of[name]], [value])

    def step(self, t: float) -> None:
        """Simulate one communication step."""
        self.unit.doStep(t, PERIOD)


with tempfile.TemporaryDirectory() as folder:
    at = Path(folder)
    arm_file = eomc.export_fmu(HERE / "servo.toml", at / "servo.fmu", fmi=3).file
    pid_file = FmuBuilder.build_FMU(HERE / "pid_unit.py", dest=at)
    arm, pid = Unit(arm_file, at / "arm"), Unit(at / pid_file, at / "pid")
    pid["target"] = 1.2
    arm["m"] = 1.5  # instead of the scene's value
    highest = 0.0
    for k in range(800):
        pid["measured"], pid["rate"] = arm["phi"], arm["phi_dot"]
        pid.step(k * PERIOD)
        arm["torque"] = pid["output"]
        arm.step(k * PERIOD)
        highest = max(highest, arm["phi"])
    print(f"after {800 * PERIOD:g} s the arm is at {arm['phi']:.4f} rad, at most {highest:.3f};")
    print(f"the motor holds {arm['torque']:.4f} N m, the weight pulls {arm['load']:.4f} N m")
    sys.stdout.flush()
    for unit in (arm, pid):
        unit.unit.terminate()
        unit.unit.freeInstance()
