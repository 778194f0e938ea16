"""eomc build and eomc export: write packages, C, wheels and FMUs of scenes."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

import click

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.cli import options
from eomc.cli.options import escape_line, say, status_line, warn


@click.command("build")
@options.SCENES
@options.BUILD
@click.option(
    "--c",
    "folder",
    metavar="DIR",
    type=options.PATH,
    help="Write only the C into DIR, without a compiler and without a Python module.",
)
@click.option(
    "--prefix",
    metavar="NAME",
    help="With --c: prefix of names and files, for two versions in one program.",
)
@click.option(
    "--wheel",
    is_flag=True,
    help="Write a wheel of the module for pip; it requires NumPy and cffi, but not eomc.",
)
@options.QUIET
@options.JSON
def build_command(
    scenes: Sequence[Path], root: Path, folder: Path | None, prefix: str | None, wheel: bool,
    quiet: bool, as_json: bool,
) -> None:  # fmt: skip
    """Derive, generate and compile: a package and embeddable C in build/NAME/.

    \b
    eomc build scenes/cartpole.toml
    PYTHONPATH=build python -c "import cartpole; print(cartpole.simulate())"
    cd build/cartpole && cc -std=c99 -O2 -I. main.c cartpole.c -lm && ./a.out
    eomc build scenes/cartpole.toml --c firmware/cartpole
    eomc build scenes/cartpole.toml --wheel && pip install ./cartpole-*.whl
    """
    if wheel and folder is not None:
        raise EomcError("--wheel and --c: choose one")
    if folder is not None:
        _write_c(scenes, folder, prefix, quiet, as_json)
        return
    if prefix is not None:
        raise EomcError("--prefix: goes with --c DIR")
    _refuse_duplicate_names(scenes)
    if wheel:
        _write_wheels(scenes, quiet, as_json)
        return
    results = []
    for k, scene in enumerate(scenes):
        with status_line(_progress_text(scenes, k), quiet or as_json):
            started_at = time.perf_counter()
            built = pipeline.build(scene, root, warn=warn)
            seconds = time.perf_counter() - started_at
        results.append(
            {"scene": str(scene), "name": built.name, "folder": str(built.folder),
             "fresh": built.fresh, "seconds": round(seconds, 3)}
        )  # fmt: skip
        if not quiet and not as_json:
            outcome = f"built in {seconds:.1f} s" if built.fresh else "is up to date"
            say(f"{escape_line(built.folder)}/: {outcome}")
    if as_json:
        say(json.dumps(results, indent=1))


def _progress_text(scenes: Sequence[Path], k: int) -> str:
    """Return the text of the status line for the k-th scene."""
    which = f", {k + 1} of {len(scenes)}" if len(scenes) > 1 else ""
    return f"building {scenes[k].stem}{which}"


def _refuse_duplicate_names(scenes: Sequence[Path]) -> None:
    """Raise EomcError if two scenes have the same name."""
    paths: dict[str, Path] = {}
    for scene in scenes:
        name = pipeline.name_and_digest(scene)[0]
        if name and (other := paths.setdefault(name, scene)) != scene:
            raise EomcError(
                f"{escape_line(other)} and {escape_line(scene)} are both named '{name}': one would "
                "replace the other"
            )


def _write_wheels(scenes: Sequence[Path], quiet: bool, as_json: bool) -> None:
    """Write a wheel of each scene into the current folder."""
    results = []
    for k, scene in enumerate(scenes):
        with status_line(_progress_text(scenes, k), quiet or as_json):
            wheel = pipeline.write_wheel(scene, Path(), warn=warn)
        results.append({"scene": str(scene), "wheel": str(wheel)})
        if not quiet and not as_json:
            say(f"wrote {escape_line(wheel)}")
    if as_json:
        say(json.dumps(results, indent=1))


def _write_c(
    scenes: Sequence[Path], folder: Path, prefix: str | None, quiet: bool, as_json: bool
) -> None:
    """Write the C of one scene into a folder."""
    if len(scenes) > 1:
        raise EomcError(f"--c: takes one scene, since {escape_line(folder)} holds the C of one")
    with status_line(_progress_text(scenes, 0), quiet or as_json):
        files = pipeline.write_c(scenes[0], folder, prefix, warn=warn)
    if as_json:
        say(
            json.dumps(
                {"scene": str(scenes[0]), "folder": str(folder), "files": [*files]}, indent=1
            )
        )
    elif not quiet:
        say(f"wrote {escape_line(folder)}/: {', '.join(files)}")


# --- export ---------------------------------------------------------------------------------------


@click.group("export")
def export_command() -> None:
    """Export a scene to other programs.

    \b
    eomc export fmu scenes/cartpole.toml
    eomc export casadi scenes/cartpole.toml
    """


@export_command.command("fmu")
@options.SCENE
@click.option(
    "--fmi", type=click.Choice(["2", "3"]), default="2", show_default=True,
    help="FMI version: 2.0, which most tools read, or 3.0.",
)  # fmt: skip
@click.option("--out", type=options.PATH, help="The FMU; by default NAME.fmu.")
@click.option("--sources", is_flag=True, help="Sources only, without a binary.")
@options.QUIET
def export_fmu(scene: Path, fmi: str, out: Path | None, sources: bool, quiet: bool) -> None:
    """Write an FMU: co-simulation and model exchange, binary and source.

    \b
    eomc export fmu scenes/cartpole.toml
    eomc export fmu scenes/cartpole.toml --fmi 3 --out cartpole3.fmu
    """
    options.check_target(out, (".fmu",), "--out")
    with status_line("exporting", quiet):
        exported = pipeline.export_fmu(scene, out, int(fmi), binary=not sources, warn=warn)
    if exported.why:
        say(f"sources only: {exported.why}", err=True)
    if not quiet:
        inside = f"sources and a binary for {exported.binary}" if exported.binary else "sources"
        say(f"{escape_line(exported.file)}: FMI {fmi}.0, {inside}")


def _export_package(library: str, title: str, description: str) -> None:
    """Add the command that exports a scene as a package for a library of optimisation."""

    @export_command.command(
        library,
        help=f"{description}\n\n\b\neomc export {library} scenes/cartpole.toml",
        short_help=title,
    )
    @options.SCENE
    @click.option(
        "--out",
        type=options.PATH,
        help=f"Folder of the package, by default NAME_{library}.",
    )
    @click.option("--step-size", "h", type=float, help="Step size, s, by default the scene's h.")
    @options.QUIET
    def command(scene: Path, out: Path | None, h: float | None, quiet: bool) -> None:
        with status_line("exporting", quiet):
            folder = pipeline.export(scene, library, out, h=h, warn=warn)
        if not quiet:
            say(f"{escape_line(folder)}/: import it as {escape_line(folder.name)}")


_export_package(
    "casadi",
    "Write a package for CasADi.",
    "Write a package for CasADi: the accelerations as SX expressions, for IPOPT and acados, and "
    "accelerations and steps as compiled external functions with derivatives.",
)
_export_package(
    "jax",
    "Write a package for JAX.",
    "Write a package for JAX: accelerations and steps as functions with custom derivatives in "
    "reverse mode, for many states at once.",
)
_export_package(
    "torch",
    "Write a package for PyTorch.",
    "Write a package for PyTorch: accelerations and steps as functions with custom derivatives, "
    "for many states at once.",
)
