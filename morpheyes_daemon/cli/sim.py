"""`morpheyes sim`: fly a mission in the simulator."""

from __future__ import annotations

import json
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from morpheyes_daemon.flights.lockstep import FlightPlan, Summary

Realtime = Annotated[bool, typer.Option("--realtime", help="Fly in real time, over sockets and a pty.")]
Autopilot = Annotated[
    str | None, typer.Option(help="A running ArduPilot SITL, such as tcp:127.0.0.1:5760; implies --realtime.")
]
Config = Annotated[Path | None, typer.Option(help="Vehicle configuration; default: ./config.yaml or the shipped one.")]
Calibration = Annotated[
    str | None,
    typer.Option(
        help="'solved' from rendered boards, 'mounted' with the mount measured as well (default for gaps), "
        "'exact', or a calibration file."
    ),
]


def command(
    mission: Annotated[str, typer.Argument(help="A shipped mission by name, or a mission file.")] = "forest",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the world and of all noise.")] = 0,
    baseline: Annotated[str, typer.Option(help="'variable', or a fixed baseline in metres.")] = "variable",
    realtime: Realtime = False,
    autopilot: Autopilot = None,
    rate_hz: Annotated[float, typer.Option(min=0.2, max=60.0, help="Stereo pairs per second.")] = 5.0,
    size: Annotated[str, typer.Option(help="Image size, WIDTHxHEIGHT in pixels (4:3).")] = "640x480",
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default: out/MISSION-SEED.")] = None,
    config: Config = None,
    calibration: Calibration = None,
    world: Annotated[str | None, typer.Option(help="World by name or path, instead of the mission's own.")] = None,
    wind_m_s: Annotated[float, typer.Option(min=0.0, max=15.0, help="Mean wind speed; gusts are added.")] = 2.0,
    latency_ms: Annotated[
        float | None, typer.Option(min=0.0, help="Latency from frame to depth in lockstep; default: the configured one.")
    ] = None,
    limit_s: Annotated[
        float, typer.Option(min=1.0, help="Simulated seconds until the flight counts as failed.")
    ] = 180.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON and nothing else.")] = False,
) -> None:
    """Fly a mission in the simulator with the real daemon, and write log, map, strips and film into a folder.

    Exit code 0 when the goal was reached (or a too narrow gap refused), 1 when not, 2 on wrong usage.
    """
    from morpheyes_daemon.cli.terminal.extras import require_simulator
    from morpheyes_daemon.cli.terminal.progress import progress_line
    from morpheyes_daemon.errors import UsageError

    if autopilot is not None and not re.fullmatch(r"tcp:[^:/]+:\d+", autopilot):
        raise UsageError(f"--autopilot {autopilot}: write tcp:HOST:PORT with the first port of the SITL, usually 5760.")
    require_simulator()
    from morpheyes_daemon.flights.flight_plan import make_plan

    with progress_line() as report:
        plan = make_plan(
            mission,
            seed=seed,
            baseline=baseline,
            rate_hz=rate_hz,
            size=size,
            config=config,
            calibration=calibration,
            world=world,
            wind_m_s=wind_m_s,
            latency_ms=latency_ms,
            limit_s=limit_s,
            threads=2,
            progress=report,
        )
    folder = out or Path("out") / f"{plan.mission_name}-{seed}"
    if realtime or autopilot:
        summary = _fly_realtime(plan, folder, autopilot, quiet=as_json)
    else:
        summary = _fly_lockstep(plan, folder, quiet=as_json)
    typer.echo(json.dumps(summary.as_json(), indent=2) if as_json else _page(summary, folder))
    if summary.outcome not in ("reached", "refused"):
        raise typer.Exit(1)


def _fly_lockstep(plan: FlightPlan, folder: Path, quiet: bool) -> Summary:
    from morpheyes_daemon.cli.terminal.flight_line import FlightLine
    from morpheyes_daemon.flights.artifacts import FlightArtifacts
    from morpheyes_daemon.flights.lockstep import Watchers, fly

    outputs = FlightArtifacts(folder, plan)
    watchers = Watchers()
    outputs.watch(watchers)
    with FlightLine(quiet) as line:
        watchers.progress = line.show
        summary = fly(plan, watchers)
        line.show_step("drawing the pictures")
        outputs.finish(summary)
    return summary


def _fly_realtime(plan: FlightPlan, folder: Path, autopilot: str | None, quiet: bool) -> Summary:
    from morpheyes_daemon.cli.terminal.flight_line import FlightLine
    from morpheyes_daemon.flights.realtime import fly_realtime

    with FlightLine(quiet) as line:
        return fly_realtime(plan, folder, autopilot, line.show)


def _page(summary: Summary, folder: Path) -> str:
    s = summary
    speedup = s.simulated_s / s.wall_s if s.wall_s else 0.0
    rows = [
        ("outcome", f"{s.outcome} ({s.reason})"),
        *([("why", textwrap.fill(s.text, 90, subsequent_indent=22 * " "))] if s.text else []),
        ("time, path", f"{s.time_s:.1f} s, {s.path_m:.1f} m"),
        ("speed", f"{s.mean_speed_m_s:.2f} m/s mean, {s.peak_speed_m_s:.2f} m/s peak"),
        ("smallest clearance", f"{1e3 * s.min_clearance_m:.0f} mm (from hull and bar to the nearest obstacle)"),
        ("baseline", f"{s.baseline_mode}, {s.baseline_min_m * 1e3:.0f} to {s.baseline_max_m * 1e3:.0f} mm"),
        ("calibration", s.calibration),
        ("vision", f"{s.frames} frames of {s.image_size} at {s.perception_rate_hz:.1f} Hz"),
        ("braking events", str(s.braking_events)),
        ("run time", f"{s.wall_s:.1f} s for {s.simulated_s:.1f} s of flight ({speedup:.1f}x real time)"),
        ("results", f"{folder}/map.png  strips.png  flight.mp4  flight.mcap  summary.json"),
    ]
    return "\n".join(f"{name:>20}  {value}" for name, value in rows)
