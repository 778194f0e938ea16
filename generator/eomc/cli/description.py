"""eomc dof and eomc show: print the degrees of freedom and the equations of a scene."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from eomc import pipeline
from eomc.cli import options
from eomc.cli.terminal import say, status_line, warn
from eomc.toolchain import cache


@click.command("dof")
@options.SCENE
@options.JSON
def dof_command(scene: Path, as_json: bool) -> None:
    """Count a scene's freedoms, from its bodies and joints, and say which are redundant.

    Of a scene with constraints or loops also the rank of their rows and the freedoms that they
    leave, which rows are redundant, how near the start is to a singular position, and with one
    freedom its whole way, and where it is assembled.

    \b
    eomc dof scenes/arm.toml
    eomc dof scenes/slider_crank.toml
    """
    from eomc.mechanism import mobility
    from eomc.scene import read as scenes

    checked_scene = scenes.read(scene)
    counted: dict[str, Any] = {"scene": checked_scene.name}
    lines = []
    if not checked_scene.constrained or (checked_scene.assembly and checked_scene.assembly.bodies):
        mobility_count = mobility.compute_mobility(checked_scene)
        counted, lines = mobility_count.as_dict(), [mobility_count.table()]
    if checked_scene.constrained:
        from eomc import pipeline
        from eomc.mechanism import ranks

        system = pipeline.read(scene)
        assert system.closure is not None
        counted["constraints"] = {
            **system.closure.as_dict(),
            "q": {c.name: c.start for c in system.coordinates},
            "qd": {f"{c.name}_dot": c.rate for c in system.coordinates},
        }
        lines.append(system.closure.table())
        if closest_singularity := ranks.closest_singularity(system):
            counted["constraints"]["nearest_singular"] = vars(closest_singularity)
            lines.append(str(closest_singularity))
        start = (f"{c.name} = {c.start:.9g}" for c in system.coordinates)
        lines.append(f"  assembled start: {', '.join(start)}")
    say(json.dumps(counted, indent=1) if as_json else "\n".join(lines))


# --- show -----------------------------------------------------------------------------------------


@click.command("show")
@options.SCENE
@options.BUILD
@click.option("--latex", "form", flag_value="latex", help="LaTeX, for amsmath.")
@click.option(
    "--python", "form", flag_value="python", help="Python source that makes the matrices."
)
@click.option("--cost", "form", flag_value="cost", help="Operations of each generated function.")
@click.option(
    "--sizes", "form", flag_value="sizes",
    help="Bytes of code and stack of each function of the plain C, as $CC makes them by -Os.",
)  # fmt: skip
def show_command(scene: Path, root: Path, form: str | None) -> None:
    """Print the equations of motion, L, D, C, g and the rest, as text for a terminal.

    \b
    eomc show scenes/cartpole.toml
    eomc show scenes/cartpole.toml --latex
    """
    if form == "sizes":
        say(_sizes(scene))
        return
    name, digest = pipeline.name_and_digest(scene)

    def make() -> dict[str, str]:
        from eomc.report import equations_text

        system = pipeline.read(scene)
        if form == "cost":
            text = equations_text.write_costs(system)
        else:
            text = equations_text.write_equations(system, form or "text")
        return {"text": text, "warnings": "\n".join(map(str, system.warnings))}

    with status_line("deriving", False):
        stored = cache.cache_texts(root, name, form or "text", digest, make)
    if stored["warnings"]:
        say(stored["warnings"], err=True)
    say(stored["text"])


def _sizes(scene: Path) -> str:
    """Return a table of the sizes of the compiled portable C."""
    import shlex

    from eomc.toolchain import sizes
    from eomc.toolchain.compiler import find_compiler

    compiler = find_compiler()
    with status_line("deriving", False):
        sources = pipeline.sources(pipeline.read(scene), warn=warn)
        measured = sizes.measure(sources.files, sources.name, compiler)
    rows: list[tuple[str, ...]] = [("function", "code", "stack", "with calls")]
    for f in measured.functions:
        numbers = (f.code, f.stack, f.total_stack)
        rows.append((f.name, *("-" if n is None else str(n) for n in numbers)))
    width = max(len(row[0]) for row in rows)
    library = sorted(
        {x for f in measured.functions for x in f.calls} - {f.name for f in measured.functions}
    )
    lines = [
        f"{sources.name}.c: bytes of code and stack, by {shlex.join(measured.command)}", "",
        *(f"{name:{width}}  {code:>6}  {stack:>6}  {deep:>10}" for name, code, stack, deep in rows),
        "",
        f"in all {measured.code} of code, {measured.constants} of constants, "
        f"{measured.writable} writable",
    ]  # fmt: skip
    lines += [f"stack of libraries left out: {', '.join(library)}"] if library else []
    return "\n".join((*lines, *measured.faults))
