"""On what a benchmark ran, in words."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from eomc.toolchain import compiler

CORES = os.sched_getaffinity(0)


def machine(packages: Sequence[str]) -> str:
    """The processor, versions and flags."""
    info = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    name = next((x.split(":")[1].strip() for x in info.splitlines() if "model name" in x), "")
    width = "AVX-512" if "avx512f" in info else "AVX2, no AVX-512" if "avx2" in info else "no AVX2"
    compiled = subprocess.run(
        [*compiler.find_compiler().command, "--version"], capture_output=True, text=True, check=True
    ).stdout.splitlines()[0]
    versions = ", ".join(f"{p} {version(p)}" for p in packages)
    return (
        f"{name} ({width}), {len(CORES)} virtual cores shared with other work; "
        f"Python {platform.python_version()}, {versions}; {compiled}, "
        f"`{' '.join((compiler.STANDARD, *compiler.flags()))}`."
    )
