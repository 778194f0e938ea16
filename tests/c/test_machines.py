"""The generated C on other machines: cross-compiled, and its self-test run by QEMU.

Compilers are Debian's cross compilers, else ziglang for code that is not linked. Machines whose
tools are not installed are skipped, with the name of the tool.
"""

from __future__ import annotations

import importlib.util
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from support.cases import SCENES
from support.session import ROOT, needs

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.toolchain import sizes
from eomc.toolchain.compiler import Compiler
from eomc.toolchain.files import write_files

pytestmark = pytest.mark.slow
CORTEX = ROOT / "docs" / "examples" / "cortex_m"
CACHE = ROOT / "build" / "tests" / "zig"  # of ziglang's libraries


@dataclass(frozen=True)
class Machine:
    """How to compile and run for a machine; with ziglang for `target`.

    bare: files and flags that a program is linked with if there is no operating system.
    """

    gcc: str
    target: str
    run: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    bare: tuple[str, ...] = ()


def _cortex(cpu: str, fpu: str, board: str) -> Machine:
    return Machine(
        "arm-none-eabi-gcc",
        "",
        ("qemu-system-arm", "-M", board, "-semihosting", "-nographic", "-kernel"),
        (f"-mcpu={cpu}", "-mthumb", f"-mfpu={fpu}", "-mfloat-abi=hard"),
        bare=(str(CORTEX / "start.c"), "-T", str(CORTEX / "mps2.ld"), "--specs=rdimon.specs"),
    )


def _risc_v(cpu: str, abi: str) -> Machine:
    """Use picolibc, whose startup code and semihosting fit QEMU's board."""
    memory = "__flash=0x80000000,__flash_size=4M,__ram=0x80400000,__ram_size=4M".split(",")
    return Machine(
        "riscv64-unknown-elf-gcc",
        "",
        (f"qemu-system-riscv{cpu[2:4]}", "-M", "virt", "-bios", "none",
         "-display", "none", "-chardev", "stdio,id=out", "-serial", "none", "-monitor", "none",
         "-semihosting-config", "enable=on,chardev=out", "-kernel"),
        ("--specs=picolibc.specs", f"-march={cpu}", f"-mabi={abi}", "-mcmodel=medany"),
        bare=("--crt0=semihost", "--oslib=semihost", *(f"-Wl,--defsym={x}" for x in memory)),
    )  # fmt: skip


MACHINES = {
    "aarch64": Machine("aarch64-linux-gnu-gcc", "aarch64-linux-musl", ("qemu-aarch64",)),
    "armhf": Machine("arm-linux-gnueabihf-gcc", "arm-linux-musleabihf", ("qemu-arm",)),
    "riscv64": Machine("riscv64-linux-gnu-gcc", "riscv64-linux-musl", ("qemu-riscv64",)),
    "s390x": Machine("s390x-linux-gnu-gcc", "s390x-linux-musl", ("qemu-s390x",)),
    "ppc64": Machine("powerpc64-linux-gnu-gcc", "powerpc64-linux-musl", ("qemu-ppc64",)),
    "i386": Machine("i686-linux-gnu-gcc", "x86-linux-musl", ("qemu-i386",)),
    "cortex-m4f": _cortex("cortex-m4", "fpv4-sp-d16", "mps2-an386"),
    "cortex-m7": _cortex("cortex-m7", "fpv5-d16", "mps2-an500"),
    "rv32imac": _risc_v("rv32imac", "ilp32"),
    "rv32imafc": _risc_v("rv32imafc", "ilp32f"),
    "rv64gc": _risc_v("rv64imafdc", "lp64d"),
    "windows": Machine("x86_64-w64-mingw32-gcc", "x86_64-windows-gnu", ("wine",)),
}
SCENE_NAMES = ("double_pendulum", "cartpole_driven")
REALS = ("double", "float")


@cache
def generated(name: str, real: str) -> dict[str, str]:
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    text = text.replace("[run]\n", f'[run]\nreal = "{real}"\nbatch = true\n')
    return eomc.sources(from_scene(parse(text, f"{name}.toml"))).embeddable


def compiler(machine: Machine, alone: bool) -> list[str]:
    """Return the cross compiler's command; if `alone` (nothing is linked), ziglang will do."""
    if path := shutil.which(machine.gcc):
        return [path, *machine.flags]
    there = alone and not machine.bare  # ziglang has no headers of a bare machine
    if not there or importlib.util.find_spec("ziglang") is None:
        pytest.skip(f"{machine.gcc} is not installed" + " nor ziglang" * there)
    return [sys.executable, "-m", "ziglang", "cc", "-target", *machine.target.split()]


def runner(machine: Machine) -> list[str]:
    """Return the command that runs a program of the machine."""
    name, *words = machine.run
    if machine.gcc.startswith("i686") and platform.machine() == "x86_64":
        return []
    return [shutil.which(f"{name}-static") or needs(name), *words]


@pytest.fixture(autouse=True)
def zig(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(CACHE))


@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("name", SCENE_NAMES)
@pytest.mark.parametrize("machine", MACHINES)
def test_code_is_small_and_stack_is_bounded(
    machine: str, name: str, real: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Issue no warnings; the double pendulum needs at most 10 kB of code and 1 kB of stack."""
    command = compiler(MACHINES[machine], alone=True)
    strict = "-Os -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror"
    if machine == "windows":  # its isfinite() warns about a conversion
        strict += " -Wno-float-conversion"
    monkeypatch.setenv("EOMC_CFLAGS", strict)
    if machine == "windows":  # no ELF
        with pytest.raises(eomc.EomcError, match="makes no ELF object"):
            sizes.measure(generated(name, real), name, Compiler(tuple(command), ""))
        return
    measurement = sizes.measure(generated(name, real), name, Compiler(tuple(command), ""))
    # The older calling convention of 64-bit PowerPC has a writable descriptor for each function.
    descriptors = 24 * len(measurement.functions) if machine == "ppc64" else 0
    assert measurement.faults == () and measurement.writable in (0, descriptors)
    assert 500 < measurement.code < 10_000
    step = next(f for f in measurement.functions if f.name == f"{name}_rk4_step")
    assert step.stack is not None and 50 < step.stack < 1000


@pytest.mark.parametrize("form", ["plain", "fast"])
@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("name", SCENE_NAMES)
@pytest.mark.parametrize("machine", MACHINES)
def test_self_test_passes(machine: str, name: str, real: str, form: str, tmp_path: Path) -> None:
    """Compare sines up to the angle limit, D, bias and accelerations with those of Python."""
    its = MACHINES[machine]
    run, command = runner(its), compiler(its, alone=False)
    write_files(generated(name, real), tmp_path)
    at = "." if form == "plain" else "fast"
    how = ["-std=c99", "-Os"] if form == "plain" else ["-std=gnu99", "-O2"]
    files = ["selftest.c", f"{at}/{name}.c"]
    if machine == "i386" and form == "fast":
        how += ["-msse2", "-mfpmath=sse"]  # required by its ABI
    words = [
        *command,
        *how,
        f"-I{at}",
        *files,
        *(its.bare or ("-static",)),
        "-lm",
        "-o",
        "selftest",
    ]
    process = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    program = "selftest" if run else "./selftest"
    process = subprocess.run(
        [*run, program], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert re.fullmatch(rf"{name}: right in \d+ cases\s+", process.stdout), (
        process.stdout + process.stderr
    )


@pytest.mark.parametrize("machine", ["cortex-m4f", "rv32imac"])
def test_self_test_detects_a_wrong_number(machine: str, tmp_path: Path) -> None:
    """Use an emulated bare core, to prove that the self-test runs and reports."""
    its = MACHINES[machine]
    run, command = runner(its), compiler(its, alone=False)
    for file, text in generated("double_pendulum", "float").items():
        if "/" not in file:
            (tmp_path / file).write_text(text.replace("9.81f", "9.82f"), encoding="utf-8")
    files = ["selftest.c", "double_pendulum.c", *its.bare, "-lm", "-o", "selftest"]
    subprocess.run([*command, "-std=c99", "-I.", *files], cwd=tmp_path, check=True)
    process = subprocess.run(
        [*run, "selftest"], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert "bias is off by" in process.stdout and process.returncode != 0
