"""`morpheyes faults`: flies the fault matrix, every fault in every state of the safety monitor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def command(
    only: Annotated[str | None, typer.Option(help="Prefix of the faults to fly; default: all.")] = None,
    seeds: Annotated[str, typer.Option(help="Seeds, one or a range such as 0-2.")] = "0-2",
    jobs: Annotated[int, typer.Option(min=1, help="Faults flown at the same time.")] = 2,
    size: Annotated[str, typer.Option(help="Image size, WIDTHxHEIGHT in pixels (4:3).")] = "320x240",
    calibration: Annotated[str, typer.Option(help="'solved', 'mounted', 'exact', or a calibration file.")] = "exact",
    out: Annotated[Path | None, typer.Option(help="File to write the table to, such as docs/faults.md.")] = None,
    resume: Annotated[Path | None, typer.Option(help="File of finished rows; these are not flown again.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON and nothing else.")] = False,
) -> None:
    """Fly the fault matrix in the lockstep simulator.

    Exit code 0 when every fault ended as expected, 1 when one did not, 2 on wrong usage.
    """
    from morpheyes_daemon.campaigns.runner import parse_seeds
    from morpheyes_daemon.cli.terminal.progress import progress_line
    from morpheyes_daemon.fault_injection.report import page
    from morpheyes_daemon.fault_injection.runner import Row, choose, flights, load_rows, run_matrix, store_row
    from morpheyes_daemon.flights.flight_plan import make_plan

    faults, wanted = choose(only), parse_seeds(seeds)
    total = flights(faults) * len(wanted)
    known = load_rows(resume) if resume is not None else []
    done: list[Row] = []
    with progress_line() as report:
        plan = make_plan("forest", size=size, calibration=calibration, progress=report)

        def show(row: Row) -> None:
            done.append(row)
            if resume is not None:
                store_row(resume, row)
            report(f"{row.fault}, {row.state}", len(done), total)
            if not row.passed:
                typer.echo(f"{row.fault} in {row.state}, seed {row.seed}: {'; '.join(row.complaints)}", err=True)

        rows = run_matrix(plan, faults, wanted, jobs, show, known)
    text = page(rows, f"--seeds {seeds} --size {size} --calibration {calibration}", faults)
    if out is not None:
        out.write_text(text, encoding="utf-8")
    typer.echo(json.dumps([row.as_json() for row in rows], indent=2) if as_json else text)
    if not all(row.passed for row in rows):
        raise typer.Exit(1)
