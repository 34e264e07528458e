"""`morpheyes bench gap` and `gap-images`: speed and accuracy of gap detection."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from morpheyes_daemon.cli.terminal.figures import print_figures, times_text


def gap(
    size: Annotated[str, typer.Option(help="Image size, WIDTHxHEIGHT in pixels (4:3).")] = "640x480",
    repeats: Annotated[int, typer.Option(min=3, help="Number of views, of walls with every shape of opening.")] = 24,
    calibration: Annotated[str, typer.Option(help="'solved', 'mounted', 'exact', or a calibration file.")] = "solved",
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON and nothing else.")] = False,
) -> None:
    """Time gap detection on one core, with and without depth, beside a detector by stacked optical flow."""
    from morpheyes_daemon.cli.terminal.extras import require_simulator
    from morpheyes_daemon.cli.terminal.progress import progress_line

    require_simulator()
    from morpheyes_daemon.benchmarks.gap_detection import bench_gap
    from morpheyes_daemon.flights.flight_plan import make_plan

    with progress_line() as report:
        plan = make_plan("gap", size=size, calibration=calibration, progress=report)
        found = bench_gap(plan, repeats, report)
    rows = [
        ("images", f"{found.size}, {found.views} views"),
        ("detection", times_text(found.detection)),
        ("processor time", times_text(found.detection_cpu)),
        ("depth", times_text(found.depth)),
        ("by stacked flow", times_text(found.flow)),
        ("ratio", f"{found.ratio:.0f} without the depth, {found.ratio_with_depth:.1f} with it"),
        ("contour IoU", f"{found.contour_iou:.3f}; by flow {found.flow_iou:.3f} (medians)"),
    ]
    print_figures(asdict(found), rows, as_json)


def gap_images(
    data: Annotated[Path | None, typer.Option(help="Folder of real images; default: MORPHEYES_DATA.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON and nothing else.")] = False,
) -> None:
    """Detect the gap in GapFlyt's real frames and compare its contour with masks drawn by hand."""
    from morpheyes_daemon.benchmarks.gap_on_real_images import gap_images as judge_images

    found = judge_images(data or Path(os.environ.get("MORPHEYES_DATA", "../shared/data")))
    if as_json:
        typer.echo(json.dumps([asdict(row) for row in found], indent=2))
        return
    for row in found:
        typer.echo(f"scene {row.scene}, {row.flow:>8} flow: IoU {row.iou:.3f}, Ashman's D {row.separation:.1f}")
