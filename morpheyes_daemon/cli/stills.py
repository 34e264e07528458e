"""`morpheyes stills`: path-traced stereo pairs of a world, for figures, beside those of the fast renderer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def command(
    world: Annotated[str, typer.Argument(help="A world by name or path.")],
    seed: Annotated[int, typer.Option(help="Seed of the world.")] = 0,
    first_m: Annotated[float, typer.Option(help="Position of the first pair along the course, metres.")] = 0.0,
    steps: Annotated[int, typer.Option(min=1, help="Number of pairs.")] = 1,
    step_m: Annotated[float, typer.Option(help="Distance between pairs, metres.")] = 1.0,
    height_m: Annotated[float, typer.Option(min=0.1, help="Height of the cameras above ground, metres.")] = 1.5,
    yaw_deg: Annotated[float, typer.Option(help="Viewing direction, 0: along the course.")] = 0.0,
    baseline: Annotated[float, typer.Option(min=0.01, max=1.0, help="Baseline, metres.")] = 0.2,
    size: Annotated[str, typer.Option(help="Image size, WIDTHxHEIGHT in pixels (4:3).")] = "640x480",
    samples: Annotated[int, typer.Option(min=1, max=4096, help="Paths per pixel; 32 take minutes per picture.")] = 32,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out/stills"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the comparison as JSON and nothing else.")] = False,
) -> None:
    """Render stereo pairs with Mitsuba's path tracer and with the fast renderer, and compare their depth."""
    from morpheyes_daemon.cli.terminal.extras import require_figures, require_simulator
    from morpheyes_daemon.cli.terminal.progress import progress_line

    require_simulator()
    require_figures()
    from morpheyes_daemon.flights.flight_plan import parse_size
    from morpheyes_daemon.paper.path_traced_stills import StillPlan, make_stills

    plan = StillPlan(world, seed, first_m, steps, step_m, height_m, yaw_deg, baseline, parse_size(size), samples)
    with progress_line() as report:
        results = [result.as_json() for result in make_stills(plan, out, report)]
    (out / "stills.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    if as_json:
        typer.echo(json.dumps(results, indent=2))
        return
    for row in results:
        typer.echo(
            f"{row['step']:>4}  depth on {row['fast_valid']:.0%} fast, {row['traced_valid']:.0%} traced; "
            f"error {row['fast_error_px']:.2f} px, {row['traced_error_px']:.2f} px; "
            f"difference {row['difference_px']:.2f} px"
        )
    typer.echo(f"{out}/000_compared.png")
