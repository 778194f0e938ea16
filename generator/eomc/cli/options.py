"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path

import click

SCENE = click.argument("scene", type=click.Path(path_type=Path))
SCENES = click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
BUILD = click.option(
    "--build", "root", default="build", show_default=True, type=click.Path(path_type=Path),
    help="Where built modules lie.",
)  # fmt: skip
QUIET = click.option("--quiet", "-q", is_flag=True, help="Print errors only.")
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
