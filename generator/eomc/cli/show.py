"""eomc show: the equations as text."""

from __future__ import annotations

from pathlib import Path

import click

from eomc import pipeline
from eomc.cli import options
from eomc.cli.terminal import say, status_line, warn
from eomc.toolchain import cache


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
def command(scene: Path, root: Path, form: str | None) -> None:
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
        from eomc.report import equations, equations_text

        system = pipeline.read(scene)
        if form == "cost":
            text = equations_text.cost(system)
        else:
            text = equations.write_equations(system, form or "text")
        return {"text": text, "warnings": "\n".join(map(str, system.warnings))}

    with status_line("deriving", False):
        texts = cache.cached_texts(root, name, form or "text", digest, make)
    if texts["warnings"]:
        say(texts["warnings"], err=True)
    say(texts["text"])


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
