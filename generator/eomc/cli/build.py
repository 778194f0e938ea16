"""eomc build: packages and embeddable C."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

import click

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.cli import options
from eomc.cli.terminal import progress_bar, say, shown, warn


@click.command("build")
@options.SCENES
@options.BUILD
@options.QUIET
@options.JSON
def command(scenes: Sequence[Path], root: Path, quiet: bool, as_json: bool) -> None:
    """Derive, generate and compile: a package and embeddable C in build/NAME/.

    \b
    eomc build scenes/cartpole.toml
    PYTHONPATH=build python -c "import cartpole; print(cartpole.simulate())"
    cd build/cartpole && cc -std=c99 -O2 -I. main.c cartpole.c -lm && ./a.out
    """
    named: dict[str, Path] = {}
    for scene in scenes:
        name = pipeline.name_and_digest(scene)[0]
        if name and (other := named.setdefault(name, scene)) != scene:
            raise EomcError(
                f"{shown(other)} and {shown(scene)} are both named '{name}': one would replace "
                "the other"
            )
    done = []
    with progress_bar("building", quiet or as_json) as progress:
        for k, scene in enumerate(scenes):
            begun = time.perf_counter()
            built = pipeline.build(scene, root, warn=warn)
            spent = time.perf_counter() - begun
            progress(k + 1, len(scenes))
            done.append(
                {"scene": str(scene), "name": built.name, "folder": str(built.folder),
                 "fresh": built.fresh, "seconds": round(spent, 3)}
            )  # fmt: skip
            if not quiet and not as_json:
                said = f"built in {spent:.1f} s" if built.fresh else "is up to date"
                say(f"{shown(built.folder)}/: {said}")
    if as_json:
        say(json.dumps(done, indent=1))
