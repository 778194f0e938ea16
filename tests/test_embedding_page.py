"""docs/embedding.md: files and commands of each section are run in an empty folder."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from support.pages import follow
from support.session import ROOT, needs

pytestmark = pytest.mark.slow
PAGE = (ROOT / "docs" / "embedding.md").read_text(encoding="utf-8")
EXAMPLES = ROOT / "docs" / "examples"
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
CONTROL_LOOP = "A control loop with an extended Kalman filter (EKF) in C"
TOOLS = {
    "In a C program": ["cc"],
    "Change parameters at run time": ["cc"],
    "In a CMake project": ["cmake", "g++", "pkg-config"],
    "Cross-compile with a CMake toolchain file": ["cmake", "make", "arm-none-eabi-gcc"],
    "On a microcontroller": ["arm-none-eabi-gcc", "qemu-system-arm"],
    "Interrupts, threads and execution time": ["arm-none-eabi-gcc", "qemu-system-arm"],
    "On a bare-metal RISC-V core": ["riscv64-unknown-elf-gcc", "qemu-system-riscv32"],
    CONTROL_LOOP: ["cc"],
    "A Python wheel": ["cc"],
}


def test_every_section_is_run() -> None:
    assert set(SECTIONS) == set(TOOLS)


@pytest.mark.parametrize("section", TOOLS)
def test_section_works_as_documented(section: str, tmp_path: Path) -> None:
    for tool in TOOLS[section]:
        needs(tool)
    if section in ("On a microcontroller", "Interrupts, threads and execution time"):
        shutil.copytree(EXAMPLES / "cortex_m", tmp_path / "cortex_m")
    if section == CONTROL_LOOP:
        pytest.importorskip("scipy")
        for file in (*(EXAMPLES / "control_loop").iterdir(), EXAMPLES / "balance.toml"):
            shutil.copy(file, tmp_path)
    output = follow(SECTIONS[section], tmp_path)
    if section == CONTROL_LOOP:
        match = re.search(r"angle within (\S+) rad, its rate known to (\S+) rad/s", output)
        assert match and float(match[1]) < 2e-3 and float(match[2]) < 2e-3, output
        usual, _, worst = map(float, re.findall(r"(\S+) us", output))
        assert 0 < usual < 1000 and usual <= worst, "within a period of 1 ms"
    if section == "Interrupts, threads and execution time":
        least, most = map(int, re.findall(r"takes (\d+) to (\d+) instructions", output)[0])
        assert 0 < least <= most < 1.1 * least, output
