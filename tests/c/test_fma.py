"""Which multiply-add the sines use, and their error where double precision has no hardware FMA."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from support.cases import fast_kit
from support.session import ROOT, needs, tiers

import eomc
from eomc.model import system
from eomc.scene import read as scene
from eomc.toolchain.files import write_files

# Includes both headers and prints which variant each one selects.
PROBE = f"""
#include "{ROOT / "csrc" / "sincos" / "sincos.h"}"
#undef EOMC_INLINE
#include "{ROOT / "csrc" / "sincos" / "sincosf.h"}"
int in_double = EOMC_FAST_FMA, in_float = EOMC_FAST_FMAF;
"""
# Macros that a compiler defines for a processor, and whether FMA exists: in double, in float.
MACROS = {
    "Cortex-M4F, M33": ("-D__ARM_FEATURE_FMA=1 -D__ARM_FP=4 -D__FP_FAST_FMAF=1", (0, 1)),
    "Cortex-M4F, clang": ("-D__ARM_FEATURE_FMA=1 -D__ARM_FP=6", (0, 1)),
    "Cortex-M7, A53": ("-D__ARM_FEATURE_FMA=1 -D__ARM_FP=14", (1, 1)),
    "Cortex-A9": ("-D__ARM_FP=12", (0, 0)),
    "without __ARM_FP": ("-D__ARM_FEATURE_FMA=1", (0, 0)),
    "x86 with FMA": ("-D__FMA__=1", (1, 1)),
    "double by gcc's word": ("-D__FP_FAST_FMA=1 -D__FP_FAST_FMAF=1", (1, 1)),
    "none": ("", (0, 0)),
}
ONE_WAY = "__FMA__ __FP_FAST_FMA __FP_FAST_FMAF __ARM_FEATURE_FMA __ARM_FP".split()
# Flags of arm-none-eabi-gcc, and whether the processor has FMA: in double, in float.
BOARDS = {
    "M3": ("-mcpu=cortex-m3", (0, 0)),
    "M4F": ("-mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard", (0, 1)),
    "M33": ("-mcpu=cortex-m33 -mfpu=fpv5-sp-d16 -mfloat-abi=hard", (0, 1)),
    "M7, single": ("-mcpu=cortex-m7 -mfpu=fpv5-sp-d16 -mfloat-abi=hard", (0, 1)),
    "M7": ("-mcpu=cortex-m7 -mfpu=fpv5-d16 -mfloat-abi=hard", (1, 1)),
}
# Runs a bare-metal program as a Linux process in user-mode qemu: the system calls of newlib.
PROCESS = """
static long call(long number, long a, long b, long c)
{
    register long r7 __asm__("r7") = number, r0 __asm__("r0") = a;
    register long r1 __asm__("r1") = b, r2 __asm__("r2") = c;
    __asm__ volatile("svc 0" : "+r"(r0) : "r"(r7), "r"(r1), "r"(r2) : "memory");
    return r0;
}
int main(void);
void exit(int);
int _write(int f, const char *s, int n) { return (int)call(4, f, (long)s, n); }
void _exit(int status) { call(1, status, 0, 0); for (;;) ; }
static char heap[1 << 16], *end = heap;
void *_sbrk(int n) { char *old = end; end += n; return old; }
void _fini(void) {}
void _start(void) { exit(main()); }
"""
# Prints the largest error of both functions, in ulp relative to libm, whose error is below one.
ERRORS = """
#include "sincos.h"
#include <stdio.h>

static double off(double got, double exact)
{
    int e;

    (void)frexp(exact, &e);
    return fabs(got - exact)/ldexp(1.0, e - 53);
}

int main(void)
{
    double worst = 0;
    int i;

    for (i = 1; i <= 3000; i++) {
        const double x = 349.52529296875*i;
        double s, c;

        eomc_sincos(x, &s, &c);
        worst = fmax(worst, fmax(off(s, sin(x)), off(c, cos(x))));
    }
    printf("%g\\n", worst);
    return 0;
}
"""
# A multiply-add with two roundings, like newlib's where the hardware has none.
TWO_ROUNDINGS = """
double fma(double, double, double);
float fmaf(float, float, float);
double fma(double a, double b, double c) { volatile double ab = a*b; return ab + c; }
float fmaf(float a, float b, float c) { volatile float ab = a*b; return ab + c; }
"""
PENDULUM = """
eomc = 1
name = "pendulum"
[coordinates]
theta = { unit = "rad", start = 1 }
[parameters]
g = 9.8
[energy]
kinetic = "theta_dot**2/2"
potential = "-g*cos(theta)"
[run]
"""


def uses_fma(*command: str, cwd: Path) -> tuple[int, int]:
    """Return whether the sines use a multiply-add in double and in float."""
    (cwd / "probe.c").write_text(PROBE)
    process = subprocess.run(
        [*command, "-E", "-P", "probe.c"], cwd=cwd, capture_output=True, text=True, check=True
    )
    match = re.search(r"in_double = (\d), in_float = (\d)", process.stdout)
    assert match
    return int(match[1]), int(match[2])


@pytest.mark.parametrize("processor", MACROS)
def test_fma_is_used_where_it_is_one_instruction(processor: str, tmp_path: Path) -> None:
    macros, expected = MACROS[processor]
    undefined = [f"-U{name}" for name in ONE_WAY if f"-D{name}=" not in macros]
    assert uses_fma("cc", *undefined, *macros.split(), cwd=tmp_path) == expected


@pytest.mark.parametrize("board", BOARDS)
def test_fma_choice_of_cross_compiler(board: str, tmp_path: Path) -> None:
    flags, expected = BOARDS[board]
    assert uses_fma(needs("arm-none-eabi-gcc"), *flags.split(), cwd=tmp_path) == expected


@pytest.mark.parametrize("board", BOARDS)
def test_error_of_sines_on_cortex_m(board: str, tmp_path: Path) -> None:
    """Check angles up to 2^20 rad against newlib's sines."""
    (tmp_path / "process.c").write_text(PROCESS)
    (tmp_path / "errors.c").write_text(ERRORS)
    command = [
        *(needs("arm-none-eabi-gcc"), *BOARDS[board][0].split(), "-mthumb", "-O2"),
        *("--specs=nosys.specs", "-nostartfiles", f"-I{ROOT / 'csrc' / 'sincos'}"),
        *("errors.c", "process.c", "-lm", "-o", "errors"),
    ]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    run = [needs("qemu-arm"), "-cpu", "max", "./errors"]
    process = subprocess.run(run, cwd=tmp_path, check=True, capture_output=True, text=True)
    assert float(process.stdout) <= 2.6


def outcome(text: str, folder: Path, *flags: str) -> tuple[int, str]:
    """Return the exit status and the output of the self-test of a scene."""
    s = system.from_scene(scene.parse(text))
    write_files(fast_kit(eomc.sources(s)), folder)
    (folder / "fma.c").write_text(TWO_ROUNDINGS)
    command = ["cc", "-std=c99", "-O0", "-I.", *flags, "selftest.c", f"{s.name}.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    process = subprocess.run(["./a.out"], cwd=folder, capture_output=True, text=True)
    return process.returncode, process.stdout


def texts() -> dict[str, str]:
    """Return scene texts with angles: a pendulum, and some files of scenes/."""
    scenes = {"pendulum": PENDULUM}
    for name in ("cartpole", "double_pendulum", "chain", "furuta_pendulum", "bead_on_hoop"):
        scenes[name] = (ROOT / "scenes" / f"{name}.toml").read_text(encoding="utf-8")
    return scenes


@pytest.mark.parametrize("real", tiers(["double", "float"], "double"))
@pytest.mark.parametrize("name", tiers(texts(), "pendulum"))
def test_self_test_detects_fma_with_two_roundings(name: str, real: str, tmp_path: Path) -> None:
    """The error appears at large angles only and is at most 6e-11 (6e-5 in float)."""
    text = texts()[name].replace("[run]\n", f'[run]\nreal = "{real}"\n')
    assert f'real = "{real}"' in text
    status, words = outcome(text, tmp_path)
    assert status == 0 and re.fullmatch(rf"{system_name(text)}: right in \d+ cases\n", words)
    assert outcome(text, tmp_path, "-march=native", "-O1", "-std=gnu99")[0] == 0
    status, words = outcome(text, tmp_path, "-D__FMA__=1", "-fno-builtin", "fma.c")
    assert status == 1
    assert re.search(r"WRONG in \d+ cases\n$", words)


def system_name(text: str) -> str:
    match = re.search(r'^name\s*=\s*"(\w+)"', text, re.MULTILINE)
    assert match
    return match[1]
