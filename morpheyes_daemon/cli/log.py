"""`morpheyes log`: content and events of a flight log, and recovery of a truncated one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from morpheyes_daemon.errors import printable

if TYPE_CHECKING:
    from morpheyes_daemon.recorder.reader import Flight

app = typer.Typer(help="Inspect flight logs and recover damaged ones.", no_args_is_help=True, rich_markup_mode=None)

LogFile = Annotated[Path, typer.Argument(help="A flight log (.mcap).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print as JSON.")]


@app.command()
def info(file: LogFile, as_json: AsJson = False) -> None:
    """Show mission, duration and number of messages per topic of a flight log."""
    from morpheyes_daemon.recorder.reader import read_flight

    content = _content(read_flight(file))
    typer.echo(json.dumps(content, indent=2) if as_json else _page(content))


def _content(flight: Flight) -> dict[str, Any]:
    counts: dict[str, int] = {}
    for record in flight.records:
        counts[record.topic] = counts.get(record.topic, 0) + 1
    times = [record.log_ns for record in flight.records]
    config = flight.header.get("config")
    return {
        "file": str(flight.path),
        "mission": flight.header.get("mission", ""),
        "wall_time": flight.header.get("wall_time", ""),
        "version": flight.header.get("version", ""),
        "calibration_hash": flight.header.get("calibration_hash", ""),
        "seconds": round((max(times) - min(times)) / 1e9, 3) if times else 0.0,
        "finished": flight.damage.finished,
        "bad_chunks": flight.damage.bad_chunks,
        "bad_messages": flight.damage.bad_messages,
        "topics": dict(sorted(counts.items())),
        "config": json.loads(config) if config else None,
    }


def _page(content: dict[str, Any]) -> str:
    shown = {key: value for key, value in content.items() if key not in ("topics", "config")}
    lines = [printable(f"{key:17} {value}") for key, value in shown.items() if value != ""]
    lines += [printable(f"  {count:8d}  {topic}") for topic, count in content["topics"].items()]
    if not content["finished"]:
        lines.append(f"The log is truncated; `morpheyes log recover {content['file']}` writes a complete one.")
    return "\n".join(lines)


@app.command()
def events(file: LogFile, as_json: AsJson = False) -> None:
    """List every event with its time since the first message, source and reason."""
    from morpheyes_daemon.recorder.reader import read_flight

    flight = read_flight(file)
    start_ns = min((record.log_ns for record in flight.records), default=0)
    rows = [
        {"t_s": round((e.t_ns - start_ns) / 1e9, 3), "source": e.source, "reason": e.reason.value, "text": e.text}
        for e in flight.events
    ]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        for row, event in zip(rows, flight.events, strict=True):
            typer.echo(printable(f"{row['t_s']:9.3f}  {event.source:12} {event.reason.text}{_more(event.text)}"))


def _more(text: str) -> str:
    return f" ({text})" if text else ""


@app.command()
def recover(
    file: LogFile,
    out: Annotated[Path | None, typer.Option(help="Log to write; default: FILE.recovered.mcap.")] = None,
    as_json: AsJson = False,
) -> None:
    """Copy everything readable of a truncated log into a new, complete one."""
    from dataclasses import asdict

    from morpheyes_daemon.recorder.reader import recover as copy_readable

    target = out or file.with_suffix(".recovered.mcap")
    saved = copy_readable(file, target)
    if as_json:
        typer.echo(json.dumps({"out": str(target), **asdict(saved)}, indent=2))
    else:
        damage = f", {saved.bad_chunks} damaged chunks left out" if saved.bad_chunks else ""
        typer.echo(f"{target}: {saved.messages} messages over {saved.seconds:.1f} s, {saved.events} events{damage}")
