"""`morpheyes depth`: depth of a stereo pair in files, or of one side-by-side picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from morpheyes_daemon.errors import UsageError
from morpheyes_daemon.stereo.calibration_file import read_calibration


def command(
    left: Annotated[Path, typer.Argument(help="Left picture, or one side-by-side picture.")],
    right: Annotated[Path | None, typer.Argument(help="Right picture.")] = None,
    focal_px: Annotated[float | None, typer.Option(help="Focal length of rectified pictures, pixels.")] = None,
    baseline_m: Annotated[
        float | None, typer.Option(help="Baseline, metres; with --calibration the nominal one.")
    ] = None,
    doffs_px: Annotated[float, typer.Option(help="Difference of the principal points, x right - x left, pixels.")] = 0.0,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file, for raw pictures.")] = None,
    near_m: Annotated[float | None, typer.Option(help="Nearest depth to search, metres.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for depth.npy and depth.png.")] = Path("out/depth"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the statistics as JSON.")] = False,
) -> None:
    """Compute the depth of a stereo pair in metres, and draw it."""
    import json

    from morpheyes_daemon.clock import stopwatch_s
    from morpheyes_daemon.stereo.image_files import read_pair, write_depth
    from morpheyes_daemon.stereo.still import raw_depth, rectified_depth

    _require_positive(**{"--focal-px": focal_px, "--baseline-m": baseline_m, "--near-m": near_m})
    if calibration is not None and (focal_px is not None or doffs_px != 0.0):
        raise UsageError("--calibration contains the focal length and the offset; leave out --focal-px and --doffs-px.")
    pair = read_pair(left, right)
    if calibration is not None:
        rig = read_calibration(calibration)
        started_s = stopwatch_s()
        depth = raw_depth(*pair, rig, baseline_m, near_m)
    elif focal_px is not None and baseline_m is not None:
        started_s = stopwatch_s()
        depth = rectified_depth(*pair, f_px=focal_px, baseline_m=baseline_m, doffs_px=doffs_px, near_m=near_m)
    else:
        raise UsageError("Give --focal-px and --baseline-m for rectified pictures, or --calibration for raw ones.")
    time_s = stopwatch_s() - started_s
    files = write_depth(out, depth, left.name)
    statistics = {
        "valid_fraction": depth.valid_fraction,
        "median_depth_m": depth.median_depth_m,
        "near_limit_m": depth.near_limit_m,
        "ceiling_fraction": depth.ceiling_fraction,
        "time_s": time_s,
        "width_px": depth.depth_m.shape[1],
        "height_px": depth.depth_m.shape[0],
        "focal_px": depth.f_px,
        "baseline_m": depth.baseline_m,
        "files": [str(file) for file in files],
    }
    if as_json:
        typer.echo(json.dumps(statistics, indent=2, allow_nan=False))
        return
    median = "none" if depth.median_depth_m is None else f"{depth.median_depth_m:.2f} m"
    typer.echo(f"depth for {100 * depth.valid_fraction:.1f} % of the pixels, median {median}, in {time_s:.2f} s")
    typer.echo(f"near limit {depth.near_limit_m:.2f} m; {100 * depth.ceiling_fraction:.1f} % of the pixels are nearer")
    for file in files:
        typer.echo(str(file))


def _require_positive(**options: float | None) -> None:
    for name, value in options.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise UsageError(f"{name} must be greater than zero, not {value:g}.")
