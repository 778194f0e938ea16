"""The C of a batch: vectorized loops, strict compilers, no instances."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from cases import SCENES, fast_kit
from conftest import needs, tiers

import eomc


def test_no_instances_in_c_read_nothing(tmp_path: Path) -> None:
    """No parameters are there either: a NULL that is followed would end the program."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    (tmp_path / "cartpole.toml").write_text(
        text.replace("[run]\n", "[run]\nbatch = true\n"), encoding="utf-8"
    )
    for file, made in fast_kit(eomc.sources(eomc.read(tmp_path / "cartpole.toml"))).items():
        (tmp_path / file).write_text(made, encoding="utf-8")
    call = "cartpole_rk4_batch(0, 0, 0, 0.01, 0, 5, 0, 0, 0, 0, 0, 1, 0, 0);"
    (tmp_path / "none.c").write_text(
        f'#include "cartpole.h"\nint main(void)\n{{\n    {call}\n    return 0;\n}}\n',
        encoding="utf-8",
    )
    subprocess.run(
        ["cc", "-std=c99", "none.c", "cartpole.c", "-o", "none", "-lm"], cwd=tmp_path, check=True
    )
    assert subprocess.run(["./none"], cwd=tmp_path).returncode == 0


def test_only_scenes_that_ask_have_it() -> None:
    plain = eomc.sources(eomc.read(SCENES / "cartpole.toml"))
    assert "batch" not in plain.files["fast/cartpole.c"] and "batch.py" not in plain.files


@pytest.mark.skipif(
    shutil.which("gcc") is None or platform.system() != "Linux" or platform.machine() != "x86_64",
    reason="asks gcc about AVX2",
)
def test_single_precision_is_taken_at_full_width(tmp_path: Path) -> None:
    """Nothing is wider than a float and nothing is called from a tile's loop."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    file = tmp_path / "cartpole.toml"
    file.write_text(text.replace("[run]\n", '[run]\nreal = "float"\nbatch = true\n'))
    for name, content in fast_kit(eomc.sources(eomc.read(file))).items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    said = subprocess.run(
        ["gcc", "-std=c99", "-O3", "-mavx2", "-mfma", "-fno-math-errno", "-fno-trapping-math",
         "-fno-tree-slp-vectorize", "-fopt-info-vec-optimized", "-Wdouble-promotion",
         "-Wconversion", "-Werror", "-c", "cartpole.c"],
        cwd=tmp_path, check=True, capture_output=True, text=True,
    ).stderr  # fmt: skip
    lines = (tmp_path / "cartpole.c").read_text(encoding="utf-8").splitlines()
    at = next(k for k, line in enumerate(lines) if "_rk4_stages(" in line)
    end = lines.index("}", at)
    loops = [k for k, line in enumerate(lines[:end], 1) if k > at and "for (int i" in line]
    assert len(loops) == 10  # four of angles, four stages, the end, and who was no good
    for k in loops:
        assert re.search(rf"cartpole\.c:{k}:\d+: optimized: loop vectorized using 32 byte", said)


@pytest.mark.slow
def test_no_loop_over_a_tile_has_a_rest(tmp_path: Path) -> None:
    """gcc sees that they end at a multiple of a block; where it can't it writes one."""
    scene = tmp_path / "cartpole.toml"
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    scene.write_text(text.replace("[run]\n", "[run]\nbatch = true\n"), encoding="utf-8")
    sources = eomc.sources(eomc.read(scene))
    for file, content in fast_kit(sources).items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    text = fast_kit(sources)[f"{sources.name}.c"]
    rounded = "used = (int)(m + CARTPOLE_BLOCK - 1) & -CARTPOLE_BLOCK"
    assert rounded in text
    (tmp_path / "blind.c").write_text(text.replace(rounded, "used = (int)m"), encoding="utf-8")
    sizes = []
    for file in (f"{sources.name}.c", "blind.c"):
        subprocess.run(
            [needs("gcc"), "-std=gnu99", "-O3", "-mavx2", "-mfma", "-fno-math-errno",
             "-fno-trapping-math", "-fno-tree-slp-vectorize", "-c", file, "-o", "made.o"],
            cwd=tmp_path, check=True,
        )  # fmt: skip
        sizes.append((tmp_path / "made.o").stat().st_size)
    assert sizes[0] < 0.9 * sizes[1]


@pytest.mark.parametrize("name", tiers(("cartpole", "kepler_orbit", "furuta_pendulum"), "cartpole"))
@pytest.mark.parametrize("real", ["double", "float"])
def test_strict_compilers_have_no_complaint(name: str, real: str, tmp_path: Path) -> None:
    """With angles that are turned and without, steppers by stages and by rates."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    run = f'[run]\nreal = "{real}"\nbatch = true\nmethod = ["rk4", "dp8"]\n'
    (tmp_path / "strict.toml").write_text(text.replace("[run]\n", run), encoding="utf-8")
    for file, content in fast_kit(eomc.sources(eomc.read(tmp_path / "strict.toml"))).items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    warnings = "-Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Werror".split()
    for compiler in filter(shutil.which, ("gcc", "clang")):
        given = [compiler, "-std=c99", *warnings, "-c", f"{name}.c", "-o", "out.o"]
        subprocess.run(given, cwd=tmp_path, check=True)
