"""Multipliers, reactions and their outputs are undefined where D is negative along constraints."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import eomc
from eomc.model.symbols import Reaction
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.toolchain.files import write_files

SYSTEM = from_scene(
    parse("""eomc = 1
name = "lighter"
[coordinates]
x = { start = 0.6 }
y = { start = -0.8 }
[parameters]
m = 1.0
[energy]
kinetic = "(m - 0.5*x)*(x_dot**2 + y_dot**2)/2"
potential = "9.81*y"
[constraints]
rod = "x**2 + y**2 - 1"
[outputs]
pull = "2*lambda_rod"
[run]
h = 0.01
duration = 0.1
""")
)
(CONSTRAINT,) = SYSTEM.constraints
REACTION = Reaction(
    "pull", (CONSTRAINT.multiplier, 0 * CONSTRAINT.multiplier, 0 * CONSTRAINT.multiplier)
)
LIGHTER = replace(SYSTEM, reactions=(REACTION,), plane=True)
PROGRAM = """#include <lighter.h>
#include <stdio.h>
int main(void)
{
    lighter_params p = lighter_defaults;
    double lambda[1] = { -7 }, outputs[1] = { -7 }, qdd[2];
    p.m = 0.1;
    printf("%d %d %d ", lighter_acceleration(qdd, lighter_q0, lighter_qd0, &p),
        lighter_multipliers(lambda, lighter_q0, lighter_qd0, &p),
        lighter_outputs(outputs, lighter_q0, lighter_qd0, &p));
    printf("%g %g\\n", lambda[0], outputs[0]);
    return 0;
}
"""


@pytest.fixture(scope="module")
def lighter(unoptimised_file: None, tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    return eomc.load(LIGHTER, tmp_path_factory.mktemp("lighter"))


@pytest.mark.parametrize("name", ["acceleration", "multipliers", "reactions"])
def test_functions_refuse_with_the_same_message(lighter: ModuleType, name: str) -> None:
    q, qd = lighter.start
    with pytest.raises(lighter.MotionError, match=r"at q = \[ 0.6 .*D is not positive") as error:
        getattr(lighter, name)(q, qd, params={"m": 0.1})
    assert error.value.status == "singular"
    with pytest.raises(lighter.MotionError, match=r"at q = \[ 0.6 "):
        getattr(lighter, name)([[-0.6, -0.8], q], [qd, qd], params={"m": 0.1})


def test_outputs_of_multipliers_are_nan(lighter: ModuleType) -> None:
    q, qd = lighter.start
    outputs = lighter.output([q, [-0.6, -0.8]], [qd, qd], params={"m": 0.1})
    assert np.isnan(outputs[0, 0]) and np.isfinite(outputs[1, 0])


def test_c_of_both_forms_reports_it_and_writes_nothing(tmp_path: Path) -> None:
    sources = eomc.sources(LIGHTER).files
    (tmp_path / "fast").mkdir()
    write_files(
        {file: text for file, text in sources.items() if file.endswith((".c", ".h"))}, tmp_path
    )
    (tmp_path / "asked.c").write_text(PROGRAM)
    for folder in (".", "fast"):
        command = [
            "cc",
            "-std=gnu99",
            "-O0",
            f"-I{folder}",
            "asked.c",
            f"{folder}/lighter.c",
            "-lm",
        ]
        subprocess.run(command, cwd=tmp_path, check=True)
        process = subprocess.run(
            ["./a.out"], cwd=tmp_path, check=True, capture_output=True, text=True
        )
        assert process.stdout == "1 1 1 -7 -7\n"
