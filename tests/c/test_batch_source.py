"""C code of batches: vectorized loops, strict compilers, batches of zero instances."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from support.cases import SCENES, fast_kit
from support.compilation import compiled
from support.nonsmooth_cases import CASES
from support.session import EVERYTHING, needs, tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.toolchain.files import write_files


def test_batch_of_zero_instances_reads_no_memory(tmp_path: Path) -> None:
    """The parameters are NULL too: a read would crash the program."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    (tmp_path / "cartpole.toml").write_text(
        text.replace("[run]\n", "[run]\nbatch = true\n"), encoding="utf-8"
    )
    for file, source in fast_kit(eomc.sources(eomc.read(tmp_path / "cartpole.toml"))).items():
        (tmp_path / file).write_text(source, encoding="utf-8")
    call = "return cartpole_integrate_batch(0, 0, 0, 0, &options, 0);"
    options = "cartpole_options options = { .h = 0.01, .steps = 5, .p_instance = 1 };"
    (tmp_path / "none.c").write_text(
        f'#include "cartpole.h"\nint main(void)\n{{\n    {options}\n    {call}\n}}\n',
        encoding="utf-8",
    )
    subprocess.run(
        ["cc", "-std=c99", "none.c", "cartpole.c", "-o", "none", "-lm"], cwd=tmp_path, check=True
    )
    assert subprocess.run(["./none"], cwd=tmp_path).returncode == 0


def test_only_scenes_with_batch_option_have_batch_functions() -> None:
    plain = eomc.sources(eomc.read(SCENES / "cartpole.toml"))
    assert "batch" not in plain.files["fast/cartpole.c"] and "_runtime/batch.py" not in plain.files


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("gcc") is None or platform.system() != "Linux" or platform.machine() != "x86_64",
    reason="asks gcc about AVX2",
)
@pytest.mark.parametrize(("real", "scalar"), tiers([("float", "ss"), ("double", "sd")], "double"))
def test_step_of_a_tile_uses_vector_instructions_only(
    real: str, scalar: str, tmp_path: Path
) -> None:
    """Check register widths, that no function is called, and that sums use whole registers."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    file = tmp_path / "cartpole.toml"
    file.write_text(text.replace("[run]\n", f'[run]\nreal = "{real}"\nbatch = true\n'))
    write_files(fast_kit(eomc.sources(eomc.read(file))), tmp_path)
    subprocess.run(
        ["gcc", "-std=gnu99", "-O3", "-mavx2", "-mfma", "-fno-math-errno", "-fno-trapping-math",
         "-fno-tree-slp-vectorize", "-S", "cartpole.c"],
        cwd=tmp_path, check=True,
    )  # fmt: skip
    lines = (tmp_path / "cartpole.s").read_text(encoding="utf-8").splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("cartpole_rk4_tile"))
    step = lines[at : next(k for k in range(at, len(lines)) if ".cfi_endproc" in lines[k])]
    instructions = Counter(line.split()[0] for line in step if line.startswith("\t"))
    assert not [name for name in instructions if name.startswith(("call", "vcvt"))]
    packed = {name: n for name, n in instructions.items() if name.endswith("p" + scalar[1])}
    sums = rf"v(f?n?madd|f?n?msub|add|mul).*{scalar}$"
    alone = [n for name, n in instructions.items() if re.match(sums, name)]
    assert sum(packed.values()) > 100 and sum(alone) < 20  # h/6 and the remainder


@pytest.mark.parametrize("name", tiers(("cartpole", "kepler_orbit", "furuta_pendulum"), "cartpole"))
@pytest.mark.parametrize("real", tiers(["double", "float"], "float"))
def test_strict_compilers_issue_no_warnings(name: str, real: str, tmp_path: Path) -> None:
    """Cover scenes with and without rotated angles, with both kinds of steppers."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    run = f'[run]\nreal = "{real}"\nbatch = true\nmethod = ["rk4", "dp8"]\n'
    (tmp_path / "strict.toml").write_text(text.replace("[run]\n", run), encoding="utf-8")
    write_files(fast_kit(eomc.sources(eomc.read(tmp_path / "strict.toml"))), tmp_path)
    warnings = "-Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Werror".split()
    for compiler in filter(shutil.which, ("gcc", "clang")):
        command = [compiler, "-std=c99", *warnings, "-c", f"{name}.c", "-o", "out.o"]
        subprocess.run(command, cwd=tmp_path, check=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "level"), [(EVERYTHING, "-Os"), (CASES["heaviside"].text, "-O1")], ids=["c", "out"]
)
def test_gcc_reports_no_uninitialised_variables(text: str, level: str, tmp_path: Path) -> None:
    """Cover constants of an empty batch and vectors that are filled element by element."""
    sources = eomc.sources(
        from_scene(parse(text.replace("[run]", "[run]\nbatch = true"), "x.toml"))
    )
    write_files(fast_kit(sources), tmp_path)
    flags = ["-std=gnu99", level, "-Wall", "-Wextra", "-Werror"]
    compiled(needs("gcc"), *flags, "-c", f"{sources.name}.c", "-o", "out.o", cwd=tmp_path)
