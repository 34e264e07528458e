"""`morpheyes experiment`: one mission over many seeds and baselines, as a table and a file of rows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from morpheyes_daemon.campaigns.forest_table import Row


def command(
    mission: Annotated[str, typer.Argument(help="A shipped mission by name, or a mission file.")],
    baselines: Annotated[str, typer.Option(help="'variable' and fixed ones in metres, with commas.")] = "variable",
    seeds: Annotated[str, typer.Option(help="One seed or an inclusive range.")] = "0-9",
    rate_hz: Annotated[float, typer.Option(min=0.2, max=60.0, help="Stereo pairs per second.")] = 5.0,
    size: Annotated[str, typer.Option(help="Image size, WIDTHxHEIGHT in pixels (4:3).")] = "320x240",
    jobs: Annotated[int, typer.Option(help="Parallel flights; -1: one per core.")] = -1,
    scheduler: Annotated[
        str | None, typer.Option(help="Fly on a running Dask scheduler, tcp://HOST:PORT, without pictures.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the campaign; an unfinished one is continued.")] = None,
    config: Annotated[Path | None, typer.Option(help="Vehicle configuration.")] = None,
    calibration: Annotated[
        str | None, typer.Option(help="'solved', 'mounted' (default for gaps), 'exact', or a calibration file.")
    ] = None,
    world: Annotated[str | None, typer.Option(help="World by name or path, instead of the mission's own.")] = None,
    wind_m_s: Annotated[float, typer.Option(min=0.0, max=15.0, help="Mean wind speed; gusts are added.")] = 2.0,
    latency_ms: Annotated[
        float | None, typer.Option(min=0.0, help="Latency from frame to depth in lockstep; default: the configured one.")
    ] = None,
    disparities: Annotated[
        int | None, typer.Option(min=16, max=320, help="Number of disparities at 640 px; smaller images in proportion.")
    ] = None,
    limit_s: Annotated[float, typer.Option(min=1.0, help="Simulated seconds until a flight counts as failed.")] = 180.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print rows and cells as JSON and nothing else.")] = False,
) -> None:
    """Fly a mission over many seeds in lockstep; an interrupted campaign is continued."""
    from morpheyes_daemon.cli.terminal.extras import require_simulator
    from morpheyes_daemon.cli.terminal.progress import progress_line

    require_simulator()
    from morpheyes_daemon.campaigns.results import RESULTS
    from morpheyes_daemon.campaigns.runner import Campaign, parse_baselines, parse_seeds, require_jobs, run_campaign
    from morpheyes_daemon.flights.flight_plan import make_plan

    modes, numbers = parse_baselines(baselines), parse_seeds(seeds)
    require_jobs(jobs)
    with progress_line() as report:
        plan = make_plan(
            mission,
            rate_hz=rate_hz,
            size=size,
            config=config,
            calibration=calibration,
            world=world,
            wind_m_s=wind_m_s,
            latency_ms=latency_ms,
            disparities=disparities,
            limit_s=limit_s,
            progress=report,
        )
        campaign = Campaign(plan, modes, numbers)
        folder = out or Path("out") / f"experiment-{plan.mission_name}"

        def done(row: Row, have: int, total: int) -> None:
            report(f"{plan.mission_name} flights", have, total)

        results = run_campaign(campaign, folder, jobs, scheduler, done)
    typer.echo(json.dumps(results.as_json(), indent=2) if as_json else f"{results.table}\n\n{folder}/{RESULTS}")
