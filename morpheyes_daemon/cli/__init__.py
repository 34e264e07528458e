"""The command line: arguments only. One module per command; heavy imports are deferred until a command runs."""

from __future__ import annotations

import importlib
import sys

import typer

from morpheyes_daemon import __version__
from morpheyes_daemon.errors import MorphEyesError

COMMANDS = (
    "sim",
    "run",
    "depth",
    "calibrate",
    "analyze",
    "experiment",
    "results",
    "stills",
    "doctor",
    "faults",
    "bench",
    "log",
    "replay",
    "report",
    "config",
)
"""Commands in the order of `morpheyes --help`; each is a module here with `command` (a function) or `app` (a group)."""


def _version(asked: bool) -> None:
    if asked:
        typer.echo(__version__)
        raise typer.Exit


def build() -> typer.Typer:
    """Return the command line; raises ModuleNotFoundError when the module of a command is missing."""
    root = typer.Typer(
        name="morpheyes",
        help="The onboard daemon of a quadrotor with a variable-baseline stereo camera, and its simulator.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @root.callback()
    def options(
        version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
    ) -> None:
        """Fly a mission in the simulator with `morpheyes sim forest`; run the daemon with `morpheyes run`."""

    for name in COMMANDS:
        module = importlib.import_module(f"{__name__}.{name}")
        if hasattr(module, "app"):
            root.add_typer(module.app, name=name)
        else:
            root.command(name=name)(module.command)
    return root


def main() -> None:
    """Run the command line; a MorphEyesError becomes one sentence and its exit code."""
    try:
        build()()
    except MorphEyesError as error:
        sys.stderr.write(f"morpheyes: {error}\n")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
