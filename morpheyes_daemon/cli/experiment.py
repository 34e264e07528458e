"""`morpheyes experiment`: the same flight over many seeds and baselines, as a table and a file of rows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from morpheyes_daemon.experiments.campaign import Row
    from morpheyes_daemon.experiments.flight import FlightPlan


def command(
    mission: Annotated[str, typer.Argument(help="A shipped mission by name, or a mission file.")],
    baselines: Annotated[
        str, typer.Option(help="Comma-separated: 'variable' and lengths in metres to hold.")
    ] = "variable",
    seeds: Annotated[str, typer.Option(help="One seed or a range, both ends flown.")] = "0-9",
    rate_hz: Annotated[float, typer.Option(min=0.2, max=60.0, help="Stereo pairs per second.")] = 5.0,
    size: Annotated[str, typer.Option(help="Image size, WIDTHxHEIGHT in pixels (4:3).")] = "320x240",
    jobs: Annotated[int, typer.Option(help="Flights at once; -1: one per core.")] = -1,
    scheduler: Annotated[str | None, typer.Option(help="A running Dask scheduler, tcp://HOST:PORT.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder; a campaign found there is continued.")] = None,
    config: Annotated[Path | None, typer.Option(help="Vehicle configuration.")] = None,
    calibration: Annotated[
        str | None, typer.Option(help="'solved', 'mounted' (usual for gaps), 'exact', or a calibration file.")
    ] = None,
    world: Annotated[str | None, typer.Option(help="World by name or path, instead of the mission's own.")] = None,
    wind_m_s: Annotated[float, typer.Option(min=0.0, max=15.0, help="Mean wind, with its gusts.")] = 2.0,
    latency_ms: Annotated[float | None, typer.Option(min=0.0, help="Frame to depth in lockstep.")] = None,
    disparities: Annotated[
        int | None, typer.Option(min=16, max=320, help="Searched for, at 640 px; smaller images in proportion.")
    ] = None,
    limit_s: Annotated[float, typer.Option(min=1.0, help="Simulated seconds until a flight is lost.")] = 180.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print rows and cells as JSON and nothing else.")] = False,
) -> None:
    """Fly a mission over many seeds in lockstep; continues where it stopped."""
    from morpheyes_daemon.cli.extras import require_simulator
    from morpheyes_daemon.cli.progress import progress_line

    require_simulator()
    from morpheyes_daemon.experiments.campaign import Campaign, parse_seeds, run_campaign
    from morpheyes_daemon.experiments.plan import make_plan

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
        campaign = Campaign(plan, tuple(baselines.split(",")), parse_seeds(seeds))
        folder = out or Path("out") / f"experiment-{plan.mission_name}"
        outcomes: dict[str, int] = {}

        def done(row: Row, have: int, total: int) -> None:
            outcomes[row["outcome"]] = outcomes.get(row["outcome"], 0) + 1
            report(f"{plan.mission_name} flights", have, total)

        rows = run_campaign(campaign, folder, jobs, scheduler, done)
    found, text = _tabled(plan, rows, folder)
    result = {"flights": rows, "cells": found}
    (folder / "results.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    (folder / "table.md").write_text(text + "\n", encoding="utf-8")
    typer.echo(json.dumps(result, indent=2) if as_json else f"{text}\n\n{folder}/results.json")


def _tabled(plan: FlightPlan, rows: list[Row], folder: Path) -> tuple[list[Row], str]:
    """Return the cells of a campaign and the table that its field reports them in; figures go to `folder`."""
    strategy = plan.mission.strategy
    if strategy == "gap":
        from morpheyes_daemon.experiments.gap_figure import draw_sequences
        from morpheyes_daemon.experiments.gap_table import gap_cells, gap_table

        draw_sequences(folder / "sequences.png", plan, rows)
        return (found := gap_cells(rows)), gap_table(found)
    if strategy == "imo":
        from morpheyes_daemon.experiments.imo_table import draw_trajectories, imo_cells, imo_table

        draw_trajectories(rows, folder / "trajectories.png")
        return (found := imo_cells(rows)), imo_table(found)
    from morpheyes_daemon.experiments.campaign import cells

    return (found := cells(rows)), table(found)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the cells as a Markdown table; with several baselines, how much faster the variable one was, by seed."""
    names = ["baseline", "flights", "reached", "collided", "success (95 %)", "m/s", "peak", "time s", "clearance m"]
    compared = len(rows) > 1
    names += ["variable faster (95 %)"] if compared else []
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for row in rows:
        interval = f"{row['success_rate']:.0%} ({row['success_low']:.0%} to {row['success_high']:.0%})"
        figures = [row[key] for key in ("mean_speed_m_s", "peak_speed_m_s", "mean_time_s", "min_clearance_m")]
        shown = " | ".join("–" if value is None else f"{value:.2f}" for value in figures)
        counts = f"{row['baseline_mode']} | {row['flights']} | {row['reached']} | {row['collided']}"
        lines.append(f"| {counts} | {interval} | {shown} |" + (f" {_faster(row)} |" if compared else ""))
    for row in rows:
        for cause, count in row["causes"].items():
            lines.append(f"\n{row['baseline_mode']}: {count} x {cause}")
    return "\n".join(lines)


def _faster(row: dict[str, Any]) -> str:
    if row["speed_ratio_to_variable"] is None or row["baseline_mode"] == "variable":
        return "–"
    mean, low, high = row["speed_ratio_to_variable"]
    return f"{mean:.2f}× ({low:.2f} to {high:.2f})"
