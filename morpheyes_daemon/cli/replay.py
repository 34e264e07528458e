"""`morpheyes replay`: runs the strategy on the recorded observations of a flight and compares its commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from morpheyes_daemon.recorder.replay import Replay

SHOWN = 10
"""Differences that are listed; chosen: a screen."""


def command(
    file: Annotated[Path, typer.Argument(help="A flight log (.mcap).")],
    mission: Annotated[
        str | None, typer.Option(help="Another mission, by name or path; default: the one that was flown.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Run the strategy on every recorded observation again; exit code 1 when a command differs."""
    from dataclasses import asdict

    from morpheyes_daemon.recorder.replay import replay
    from morpheyes_daemon.strategies.missions import load_mission

    result = replay(file, load_mission(mission) if mission else None)
    typer.echo(json.dumps({**asdict(result), "same": not result.differences}) if as_json else _page(result))
    if result.differences:
        raise typer.Exit(1)


def _page(result: Replay) -> str:
    lines = [f"{result.mission}: {result.decisions} decisions replayed, {len(result.differences)} differ"]
    if result.without_percept:
        lines.append(f"{result.without_percept} decisions left out: their percepts are not in the log")
    for difference in result.differences[:SHOWN]:
        changes = "; ".join(f"{name}: {was} -> {now}" for name, (was, now) in difference.fields.items())
        lines.append(f"{difference.t_s:9.3f} s  {changes}")
    if len(result.differences) > SHOWN:
        lines.append(f"… and {len(result.differences) - SHOWN} more")
    return "\n".join(lines)
