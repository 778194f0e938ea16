"""The C on other machines: compiled for each, and its self-test run there by QEMU.

Compilers are Debian's cross compilers, else ziglang's for what is compiled alone. What is not
installed is skipped by its name.
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
from cases import SCENES
from conftest import ROOT, needs

import eomc
from eomc.model.from_scene import from_scene
from eomc.scene.read import parse
from eomc.toolchain import sizes
from eomc.toolchain.compiler import Compiler
from eomc.toolchain.files import write_files

pytestmark = pytest.mark.slow
CORTEX = ROOT / "docs" / "examples" / "cortex_m"
CACHE = ROOT / "build" / "tests" / "zig"  # of ziglang's libraries


@dataclass(frozen=True)
class Machine:
    """How to compile for a machine and to run there; by ziglang for `target`.

    bare: what a program is linked with where no system is beneath it.
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
    """With picolibc, whose start and semihosting suit QEMU's board as they are."""
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
    """The cross compiler's command; alone: of what is not linked, where ziglang will do."""
    if path := shutil.which(machine.gcc):
        return [path, *machine.flags]
    there = alone and not machine.bare  # it has no headers of a bare machine
    if not there or importlib.util.find_spec("ziglang") is None:
        pytest.skip(f"{machine.gcc} is not installed" + " nor ziglang" * there)
    return [sys.executable, "-m", "ziglang", "cc", "-target", *machine.target.split()]


def runner(machine: Machine) -> list[str]:
    """The command that runs a program of the machine."""
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
def test_it_compiles_small_and_bounded(
    machine: str, name: str, real: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a word, its stack known; of a double pendulum less than 10 kB, 1 kB of stack."""
    command = compiler(MACHINES[machine], alone=True)
    strict = "-Os -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror"
    if machine == "windows":  # its isfinite() names the conversion that it does not make
        strict += " -Wno-float-conversion"
    monkeypatch.setenv("EOMC_CFLAGS", strict)
    if machine == "windows":  # no ELF
        with pytest.raises(eomc.EomcError, match="makes no ELF object"):
            sizes.measure(generated(name, real), name, Compiler(tuple(command), ""))
        return
    found = sizes.measure(generated(name, real), name, Compiler(tuple(command), ""))
    # the older convention of 64-bit PowerPC has a writable descriptor for each function
    descriptors = 24 * len(found.functions) if machine == "ppc64" else 0
    assert found.faults == () and found.writable in (0, descriptors)
    assert 500 < found.code < 10_000
    step = next(f for f in found.functions if f.name == f"{name}_rk4_step")
    assert step.stack is not None and 50 < step.stack < 1000


@pytest.mark.parametrize("form", ["plain", "fast"])
@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("name", SCENE_NAMES)
@pytest.mark.parametrize("machine", MACHINES)
def test_the_self_test_passes_there(
    machine: str, name: str, real: str, form: str, tmp_path: Path
) -> None:
    """Angles up to the stated limits, D, bias and accelerations as computed here in Python."""
    its = MACHINES[machine]
    run, command = runner(its), compiler(its, alone=False)
    write_files(generated(name, real), tmp_path)
    at = "." if form == "plain" else "fast"
    how = ["-std=c99", "-Os"] if form == "plain" else ["-std=gnu99", "-O2"]
    files = ["selftest.c", f"{at}/{name}.c"]
    if machine == "i386" and form == "fast":
        how += ["-msse2", "-mfpmath=sse"]  # which it asks for
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
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    program = "selftest" if run else "./selftest"
    done = subprocess.run([*run, program], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert re.fullmatch(rf"{name}: right in \d+ cases\s+", done.stdout), done.stdout + done.stderr


@pytest.mark.parametrize("machine", ["cortex-m4f", "rv32imac"])
def test_a_wrong_number_is_seen_there(machine: str, tmp_path: Path) -> None:
    """On an emulated bare core: the self-test is run, and tells."""
    its = MACHINES[machine]
    run, command = runner(its), compiler(its, alone=False)
    for file, text in generated("double_pendulum", "float").items():
        if "/" not in file:
            (tmp_path / file).write_text(text.replace("9.81f", "9.82f"), encoding="utf-8")
    files = ["selftest.c", "double_pendulum.c", *its.bare, "-lm", "-o", "selftest"]
    subprocess.run([*command, "-std=c99", "-I.", *files], cwd=tmp_path, check=True)
    done = subprocess.run(
        [*run, "selftest"], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert "bias is off by" in done.stdout and done.returncode != 0
