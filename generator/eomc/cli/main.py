"""The command: eomc new, import, build, check, run, fit, sweep, report, show, export and others.

Exit status: 0 for success, 1 if a check failed or a run could not continue, 2 for bad input. A
command's module is imported when the command is called, and slow imports (SymPy, rich)
are made where they are needed: `eomc build` with nothing to do takes a tenth of a second.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

import click

from eomc.base import texts
from eomc.base.errors import EomcError, FolderError, SceneError
from eomc.base.resources import __version__
from eomc.cli import options
from eomc.cli.options import fail, say

# name of each command, and the module with the function <name>_command
COMMANDS = {
    "build": "build", "check": "inspection", "dof": "inspection", "export": "build",
    "fit": "run", "import": "scenes", "list": "scenes", "new": "scenes", "report": "inspection",
    "run": "run", "schema": "scenes", "show": "inspection", "sweep": "run",
}  # fmt: skip


class _Group(options.CommandGroup):
    """Prints errors that the user can correct without a traceback, with exit status 2."""

    def list_commands(self, context: click.Context) -> list[str]:
        """Return the names of all commands in the order of the help text."""
        return [*COMMANDS]

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """Import the module of a command, and return the command; None if it does not exist."""
        if name not in COMMANDS:
            return None
        module = import_module(f"eomc.cli.{COMMANDS[name]}")
        command: click.Command = getattr(module, f"{name}_command")
        return command

    def resolve_command(self, context: click.Context, args: list[str]) -> Any:
        """Resolve a command as click does; suggest a similar one if it does not exist."""
        if args[0] not in COMMANDS:
            from eomc.scene.formulas import suggest

            near = suggest(args[0], [*COMMANDS]) or f": they are {', '.join(COMMANDS)}"
            context.fail(f"No such command '{texts.line(args[0])}'{near}")
        return super().resolve_command(context, args)

    def invoke(self, context: click.Context) -> Any:
        try:
            return super().invoke(context)
        except SceneError as fault:
            count = sum(p.severity == "error" for p in fault.problems)
            say(error_text(fault), err=True)
            fail(f"eomc: {count} error{'s' if count != 1 else ''}, nothing was built or changed")
        except FolderError as fault:
            fail(f"eomc: {fault.what}: choose another place with --build DIR")
        except EomcError as fault:
            fail(f"eomc: {error_text(fault)}")
        except MemoryError as fault:
            fail(f"eomc: {fault}" if str(fault) else "eomc: not enough memory")
        except KeyboardInterrupt:
            say("eomc: interrupted", err=True)
            sys.exit(130)


def error_text(fault: EomcError) -> str:
    """Return the message of an error, followed by the notes that were added to it."""
    return "\n".join([str(fault), *getattr(fault, "__notes__", ())])


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="eomc")
def main() -> None:
    """Derive equations of motion; generate C and Python code and simulate.

    \b
    eomc new pendulum              write a scene to start from
    eomc import robot.urdf         write the scene of a robot file
    eomc run pendulum.toml         derive, compile and simulate it
    eomc check pendulum.toml       compare the code with an independent reference
    """


if __name__ == "__main__":
    main()
