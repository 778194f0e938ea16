"""The self-test in C covers every function and method, and detects seeded faults."""

from __future__ import annotations

import math
import re
import subprocess
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.compilation import compiled
from support.session import needs, tiers

import eomc
from eomc.emit.selftest import _rounding_error
from eomc.model import system
from eomc.scene import read as scene
from eomc.toolchain.files import write_files


@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_rounding_errors_of_multiples_of_half_pi(real: type) -> None:
    """Powers of two are exact; other multiples err by at most half an ulp of n pi/2."""
    double, half_pi = real is np.float64, real(math.pi / 2)
    for n in (1, 2, 64, 4096):
        assert _rounding_error(n * math.pi / 2 + 0.3, double) == 0
    relative_errors = []
    for n in range(1000, 1100):
        product = real(n) * half_pi
        error = abs(Fraction(float(product)) - n * Fraction(float(half_pi)))
        assert _rounding_error(n * math.pi / 2 - 0.3, double) == float(error)
        relative_errors.append(error / Fraction(float(np.spacing(product))))
    assert 0.4 < max(relative_errors) <= 0.5


BALL = """eomc = 1
name = "ball"
[coordinates]
y = { start = 1.0 }
z = { start = 0.2 }
[parameters]
e = 0.8
k = 1.5
[inputs]
force = { signal = "0.5*sin(2*t)", limits = [-2, 3] }
[energy]
kinetic = "y_dot**2/2 + (2 + cos(z))*z_dot**2/2"
potential = "9.81*y + k*z**2/2 + y*z"
[forces]
y = "-0.2*y_dot - z_dot*y_dot/9"
z = "force - 0.3*z_dot"
[outputs]
height = "2*y + z_dot"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[[event]]
name = "turn"
when = "z_dot - 0.3*z"
direction = "rising"
[run]
tolerance = 1e-9
REAL
h = 0.01
method = ["rk4", "dp8", "gauss4", "gauss16", "euler"]
linearize = "products"
discretize = true
"""


@cache
def sources(real: str) -> dict[str, str]:
    """Return the C of the ball by file."""
    text = BALL.replace("REAL", f'real = "{real}"')
    text = text.replace("1e-9", "1e-5") if real == "float" else text
    return dict(eomc.sources(system.from_scene(scene.parse(text, "ball.toml"))).files)


def outcome(folder: Path, form: str, *flags: str) -> tuple[int, str]:
    """Return status and output of the self-test of the C in a folder."""
    at = "." if form == "plain" else "fast"
    files = ["selftest.c", f"{at}/ball.c", "-lm", "-o", "selftest"]
    compiled(needs("cc"), "-std=gnu99", *flags, f"-I{at}", *files, cwd=folder)
    process = subprocess.run(["./selftest"], cwd=folder, capture_output=True, text=True)
    return process.returncode, process.stdout


def write(folder: Path, real: str = "double") -> None:
    """Write the C of the ball to a folder."""
    write_files({n: x for n, x in sources(real).items() if n.endswith((".c", ".h"))}, folder)


EVERY = """D C g bias tau kinetic_energy potential_energy energy power outputs output_slopes events
event_slopes jumps jump_vjp applied signal signal_vjp sensitivity output_sensitivity acceleration
acceleration_jvp acceleration_vjp linearization adaptive rk4_step rk4_run rk4_derivative dp8_step
dp8_run dp8_derivative gauss4_step gauss4_run gauss4_derivative gauss16_step gauss16_run
gauss16_derivative euler_step euler_run euler_derivative""".split()


@pytest.mark.parametrize("real", tiers(["double", "float"], "double"))
def test_every_function_of_the_header_has_test_cases(real: str) -> None:
    """There are several for each function; runs cross events in both directions."""
    rows = re.findall(r'^    \{ "(\w+)", test_(\w+),', sources(real)["selftest.c"], re.M)
    counts = {name: sum(row[0] == name for row in rows) for name in EVERY}
    assert {row[0] for row in rows} == {*EVERY} and min(counts.values()) >= 2, counts
    header = set(re.findall(r"\bball_(\w+)\(", sources(real)["ball.h"]))
    methods = ("rk4", "dp8", "gauss4", "gauss16", "euler")
    adjoints = {f"{name}_adjoint" for name in methods}  # `eomc check` tests them
    assert header - {*EVERY} == {"integrate", *adjoints}
    assert counts["adaptive"] >= 6


@pytest.mark.parametrize(
    ("form", "real", "flags"),
    tiers(
        [(f, r, x) for f in ("plain", "fast") for r in ("double", "float")
         for x in ("-O0", "-O3 -march=native")],
        ("plain", "double", "-O0"),
    ),
)  # fmt: skip
def test_selftest_passes(form: str, real: str, flags: str, tmp_path: Path) -> None:
    write(tmp_path, real)
    status, words = outcome(tmp_path, form, *flags.split())
    assert status == 0 and re.fullmatch(r"ball: right in \d+ cases\n", words), words


# for each fault a function of the C, a pattern in it and its replacement
FAULTS = {
    "a stage of rk4": ("rk4_step", r"h/2", "h/3"),
    "a weight of rk4": ("rk4_step", r"2\*\(a2", "3*(a2"),
    "the sign of an output": ("outputs", r"2\.0\*y", "-2.0*y"),
    "a term of an energy": ("potential_energy", r"4\.9|9\.81", "9.9"),
    "the frequency of a signal": ("signal", r"sin\(", "sin(1.1*"),
    "a limit": ("applied", r"fmin\(3\.0", "fmin(2.9"),
    "a jump": ("jumps", r"after\[2\] = ([^;]*);", r"after[2] = 0.9*(\1);"),
    "a linearization": ("slopes", r"slopes\[2\] = -", "slopes[2] = -1.5*"),
}
TABLES = {
    "a coefficient of dp8": (r"0\.0197250569", "0.0198250569"),
    "a coefficient of euler": (r"(euler_bA\[1\] = \{ )1\.0", r"\g<1>0.5"),
    "a direction": (r"(ball_direction\[2\] = \{ )-1", r"\g<1>1"),
    "a coefficient of gauss4": (r"0\.5386751345948129", "0.54"),
    "a coefficient of gauss16": (r"(_A\[8\]\[8\] = \{\n    \{ )0\.0253071", r"\g<1>0.0263071"),
}


def seeded(name: str, source: str) -> str:
    """Return the source with a seeded fault."""
    if name in TABLES:
        changed = re.sub(TABLES[name][0], TABLES[name][1], source)
    else:
        function, pattern, instead = FAULTS[name]
        body = re.search(
            rf"^[^\n;]*\bball_{function}\([^;{{]*\)\n\{{\n.*?^\}}", source, re.M | re.S
        )
        assert body, name
        changed = source.replace(body[0], re.sub(pattern, instead, body[0], count=1))
    assert changed != source, name
    return changed


@pytest.mark.parametrize(
    "name", tiers([*FAULTS, *TABLES], "a stage of rk4", "a jump", "a direction")
)
def test_selftest_detects_a_seeded_fault(name: str, tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "ball.c").write_text(seeded(name, sources("double")["ball.c"]), encoding="utf-8")
    status, words = outcome(tmp_path, "plain", "-O0")
    assert status == 1 and re.search(r"is off by|has status", words), words
