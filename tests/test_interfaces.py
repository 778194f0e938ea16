"""docs/interfaces.md is followed as written, if the tools are installed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from support.fmus import plain
from support.session import ROOT, needs

from eomc.cli.main import main

TEXT = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
FINAL_STATE = r"x = (\S+) m, theta = (\S+) rad"
STRICT = "-std=c99 -Wall -Wextra -Werror -Ic -I.".split()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.S)


def run_command(*command: str, at: Path) -> str:
    process = subprocess.run(command, cwd=at, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the page's commands have been run."""
    here = tmp_path_factory.mktemp("interfaces")
    (commands,) = blocks("sh")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        for command in commands.splitlines():
            name, *words = command.split()
            result = CliRunner().invoke(main, words)
            assert (name, result.exit_code) == ("eomc", 0), result.output
    return here


def end() -> tuple[float, float]:
    run = plain("cartpole").simulate(q0=[0.0, 0.1], qd0=[0.0, 0.0], h=0.001, steps=1000)
    return float(run.q[-1, 0]), float(run.q[-1, 1])


def ends_there(text: str) -> bool:
    match = re.search(FINAL_STATE, text)
    return match is not None and [float(x) for x in match.groups()] == pytest.approx(
        end(), rel=1e-10
    )


@pytest.mark.slow
def test_numbers_of_the_page_are_correct() -> None:
    assert ends_there(TEXT)


@pytest.mark.slow
def test_rust(page: Path) -> None:
    cargo = needs("cargo")
    build, program = blocks("rust")
    crate = page / "crate"
    shutil.copytree(page / "c", crate / "c")
    (crate / "src").mkdir()
    (crate / "build.rs").write_text(build, encoding="utf-8")
    (crate / "src" / "main.rs").write_text(program, encoding="utf-8")
    (crate / "Cargo.toml").write_text(
        '[package]\nname = "pole"\nversion = "0.1.0"\nedition = "2021"\n', encoding="utf-8"
    )
    assert ends_there(run_command(cargo, "run", "--offline", "--quiet", at=crate))


def test_julia(page: Path) -> None:
    julia = needs("julia")
    (program,) = blocks("julia")
    (page / "pole.jl").write_text(program, encoding="utf-8")
    assert ends_there(run_command(julia, "pole.jl", at=page))


@pytest.mark.slow
def test_casadi(page: Path) -> None:
    pytest.importorskip("casadi", reason="CasADi is not installed: pip install '.[fmu]'")
    (program,) = blocks("python")
    output = run_command(sys.executable, "-c", program, at=page)
    numbers = [float(x) for x in re.findall(r"[-\d.]+(?:e[-+]\d+)?", output)]
    expected = plain("cartpole").acceleration([0.0, 0.1], [0.0, 0.0])
    assert numbers[:4] == pytest.approx([0, 0, *expected], rel=1e-5)
    # The Jacobian of [qd; qdd] with respect to [q; qd].
    assert numbers[4:12] == [0, 0, 1, 0, 0, 0, 0, 1]
    A, B = [plain("cartpole").acceleration([0.0, 0.1 + d], [0.0, 0.0]) for d in (1e-6, -1e-6)]
    assert [numbers[13], numbers[17]] == pytest.approx((A - B) / 2e-6, rel=1e-5)


def test_c_of_the_simulink_block(page: Path) -> None:
    (header,) = blocks("c")
    (page / "cartpole_block.h").write_text(header, encoding="utf-8")
    (specification,) = blocks("matlab")
    assert "void cartpole_block(" in specification and "void cartpole_block(" in header
    (page / "block.c").write_text(
        '#include "cartpole_block.h"\n#include <stdio.h>\nint main(void)\n{\n'
        "    double a[2], q[2] = { 0, 0.1 }, qd[2] = { 0.3, 0.2 }, p[4] = { 2, 2, 2, 9.8 };\n\n"
        '    cartpole_block(a, q, qd, p);\n    printf("%.17g %.17g\\n", a[0], a[1]);\n}\n',
        encoding="utf-8",
    )
    run_command(needs("cc"), *STRICT, "block.c", "c/cartpole.c", "-lm", "-o", "block", at=page)
    expected = plain("cartpole").acceleration([0.0, 0.1], [0.3, 0.2])
    acceleration = [float(x) for x in run_command("./block", at=page).split()]
    assert acceleration == pytest.approx(list(expected), rel=1e-14)
