"""`morpheyes report`: statistics and pictures of a recorded flight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def command(
    file: Annotated[Path, typer.Argument(help="A flight log (.mcap).")],
    out: Annotated[Path | None, typer.Option(help="Folder for the pictures; default: beside FILE.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the statistics as JSON.")] = False,
) -> None:
    """Draw map.png, strips.png and flight.mp4 of a flight log and print its statistics."""
    from dataclasses import asdict

    from morpheyes_daemon.recorder.encoding import to_plain
    from morpheyes_daemon.recorder.reader import read_flight
    from morpheyes_daemon.recorder.report import draw_report, figures

    flight = read_flight(file)
    numbers = figures(flight.series(), flight.header.get("mission", ""))
    written = [str(path) for path in draw_report(flight, out or file.with_suffix(""))]
    if as_json:
        typer.echo(json.dumps({**to_plain(numbers), "written": written}, indent=2))
        return
    for key, value in asdict(numbers).items():
        typer.echo(f"{key:20} {_as_text(value)}")
    typer.echo("\n".join(written))


def _as_text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {share:.0%}" for name, share in value.items())
    return f"{value:.2f}" if isinstance(value, float) else str(value)
