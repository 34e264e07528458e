"""`morpheyes calibrate solve`, `report`, `render` and `evaluate`: the commands that need no rig."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from morpheyes_daemon.cli.calibrate.live import capture, check, repeatability
from morpheyes_daemon.cli.calibrate.mount import mount
from morpheyes_daemon.cli.calibrate.options import (
    BoardOption,
    JsonOption,
    MarkerOption,
    SquareOption,
    ViewsOption,
    choose_baselines_m,
    choose_board,
    parse_image_size,
)
from morpheyes_daemon.stereo.calibration_file import read_calibration

if TYPE_CHECKING:
    from morpheyes_daemon.benchmarks.calibration_error import RigTruth
    from morpheyes_daemon.calibration.solver.result import CalibrationResult

app = typer.Typer(help="Calibrate the stereo rig and check it.", no_args_is_help=True, rich_markup_mode=None)


@app.command()
def solve(
    folder: Annotated[Path, typer.Argument(help="One sub-folder per baseline (100mm, ...), or one folder of pairs.")],
    out: Annotated[Path, typer.Option("--out", help="Calibration file to write.")] = Path("calibration.yaml"),
    board: BoardOption = None,
    square_mm: SquareOption = None,
    marker_mm: MarkerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Solve all baselines together from pictures of a board and write the calibration file."""
    import datetime

    from morpheyes_daemon.calibration.solver.pipeline import read_board_file, solve_folder
    from morpheyes_daemon.cli.terminal.progress import progress_line
    from morpheyes_daemon.clock import wall_time_s

    known = read_board_file(folder) if folder.is_dir() else {}
    chosen = choose_board(known, board, square_mm, marker_mm, ask=not as_json and sys.stdin.isatty())
    today = datetime.datetime.fromtimestamp(wall_time_s(), datetime.UTC).date()
    header = {"rig": str(known.get("rig", folder.resolve().name)), "date": today.isoformat()}
    with progress_line() as progress:
        solved = solve_folder(folder, chosen, out, progress, header)
    if as_json:
        typer.echo(json.dumps({**solved.figures(), "file": str(out)}, indent=2))
    else:
        _print_solved(solved, out)


@app.command()
def report(
    file: Annotated[Path, typer.Argument(help="Calibration file.")],
    out: Annotated[Path | None, typer.Option("--out", help="Page to write, .html or .png.")] = None,
    matcher_px: Annotated[
        float, typer.Option("--matcher-px", min=0.01, max=5, help="Matcher noise, one sigma, px.")
    ] = 0.25,
    servo_mm: Annotated[
        float, typer.Option("--servo-mm", min=0, max=5, help="Servo repeatability, one sigma, mm.")
    ] = 0.1,
    sync_ms: Annotated[
        float, typer.Option("--sync-ms", min=0, max=100, help="Time offset between the cameras, ms.")
    ] = 2.0,
    sideways_m_s: Annotated[float, typer.Option("--sideways", min=0, max=20, help="Sideways speed, m/s.")] = 0.5,
) -> None:
    """Write a report of a calibration: its quality, the depth errors to expect, and the pictures to retake."""
    from morpheyes_daemon.calibration.report.depth_error_budget import Conditions
    from morpheyes_daemon.calibration.report.html import write_report

    page = file.with_suffix(".html") if out is None else out
    conditions = Conditions(matcher_px, servo_mm / 1e3, sync_ms / 1e3, sideways_m_s)
    write_report(read_calibration(file), page, conditions)
    typer.echo(f"{page}")


@app.command()
def render(
    out: Annotated[Path, typer.Argument(help="New folder for the pictures.")],
    baselines_mm: Annotated[
        str, typer.Option("--baselines", help="Number of baselines over 100-300 mm, or lengths in mm such as 100,200.")
    ] = "10",
    views: ViewsOption = None,
    mount: Annotated[
        bool, typer.Option("--mount", help="Fixed board, vehicle rotated by hand: for `calibrate mount`.")
    ] = False,
    visits: Annotated[bool, typer.Option("--visits", help="Move the servo away and back before every pair.")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the simulated rig.")] = 0,
    size: Annotated[str, typer.Option("--size", help="Image size, WIDTHxHEIGHT.")] = "640x480",
    board: BoardOption = None,
    square_mm: SquareOption = None,
    marker_mm: MarkerOption = None,
) -> None:
    """Render boards in front of the simulated cameras, as folders for `calibrate solve`."""
    from morpheyes_daemon.calibration.mount import MOUNT_VIEWS
    from morpheyes_daemon.calibration.targets.capture_guide import BASELINE_VIEWS
    from morpheyes_daemon.cli.terminal.progress import progress_line
    from morpheyes_daemon.flights.sim_boards import (
        DEFAULT_BOARD,
        render_folder,
        render_mount_folder,
    )
    from morpheyes_daemon.simulation.camera.true_rig import RANGE_M

    usual = {"board": DEFAULT_BOARD.label, "square_mm": 25.0 if square_mm is None else square_mm}
    chosen = choose_board(usual, board, square_mm, marker_mm)
    if mount:
        with progress_line() as progress:
            render_mount_folder(out, seed, views or MOUNT_VIEWS, chosen, parse_image_size(size), progress)
        typer.echo(f"{views or MOUNT_VIEWS} pairs and attitudes: {out}; next: morpheyes calibrate mount FILE {out}")
        return
    nominal_m = choose_baselines_m(baselines_mm, RANGE_M)
    with progress_line() as progress:
        render_folder(out, seed, nominal_m, views or BASELINE_VIEWS, chosen, parse_image_size(size), visits, progress)
    typer.echo(
        f"{len(nominal_m)} baselines, {views or BASELINE_VIEWS} pairs each: {out}; next: morpheyes calibrate solve {out}"
    )


@app.command()
def evaluate(
    file: Annotated[Path, typer.Argument(help="Calibration file solved from rendered boards.")],
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Seed of the simulated rig; default: that of the file.")
    ] = None,
    separate: Annotated[
        Path | None, typer.Option("--separate", help="Folder of rendered boards: also solve every baseline separately.")
    ] = None,
    watch: Annotated[
        bool,
        typer.Option("--watch", help="Also run the extrinsics monitor on a bent rig and on time offsets."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Compare a solved file with the ground truth of the simulated rig, at 41 baselines."""
    from morpheyes_daemon.benchmarks.calibration_error import compare_separate, evaluate_rig, twin_of
    from morpheyes_daemon.cli.terminal.progress import progress_line

    rig = read_calibration(file)
    twin = twin_of(rig, seed, file)
    truth = evaluate_rig(rig, twin)
    figures: dict[str, Any] = truth.figures()
    if separate is not None:
        from morpheyes_daemon.calibration.solver.pipeline import read_board_file

        chosen = choose_board(read_board_file(separate), None, None, None)
        with progress_line() as progress:
            figures["at_calibrated_baselines"] = compare_separate(separate, chosen, rig, twin, progress)
    if watch:
        from morpheyes_daemon.cli.terminal.extras import require_simulator

        require_simulator()
        from morpheyes_daemon.benchmarks.online_calibration import watch_figures

        with progress_line() as progress:
            figures["watch"] = watch_figures(rig, twin.seed, progress)
    if as_json:
        typer.echo(json.dumps(figures, indent=2))
        return
    _print_truth(truth)
    if watch:
        _print_watch(figures["watch"])
    for name, row in figures.get("at_calibrated_baselines", {}).items():
        typer.echo(f"{name}: " + ", ".join(f"{key} {value}" for key, value in row.items()))


def _print_truth(truth: RigTruth) -> None:
    _print_table(
        ("baseline", "row error, median", "row error, 95 %", "length error", "disparity bias"),
        [
            (
                f"{row.nominal_mm:g} mm",
                f"{row.epipolar_median_px:.3f} px",
                f"{row.epipolar_p95_px:.3f} px",
                f"{row.baseline_error_mm:+.3f} mm",
                f"{row.disparity_bias_px:+.3f} px",
            )
            for row in truth.rows[::4]
        ],
    )
    typer.echo(
        f"all 41: rows {truth.epipolar_median_px:.3f} px median, {truth.epipolar_p95_px:.3f} px at 95 %; length "
        f"within {truth.baseline_error_max_mm:.3f} mm; disparity bias within {truth.disparity_bias_max_px:.3f} px"
    )
    near, far = truth.pointing_error_deg
    typer.echo(
        f"pointing error of the left camera {near:.2f} degrees at the smallest baseline, {far:.2f} at the largest"
    )


def _print_solved(solved: CalibrationResult, out: Path) -> None:
    calibration = solved.calibration
    rows = []
    for index, nominal in enumerate(calibration.nominal_m):
        sigma = solved.uncertainty[index]
        rows.append(
            (
                f"{nominal * 1e3:g} mm",
                f"{calibration.lengths_m[index] * 1e3:.2f} ± {sigma.length_m * 1e3:.2f} mm",
                f"{calibration.rms_px[index]:.3f} px",
                f"± {sigma.disparity_px:.3f} px",
            )
        )
    _print_table(("nominal", "length", "rms", "disparity at infinity"), rows)
    unseen = solved.held_out
    typer.echo(f"held-out boards: rows {unseen.median_px:.3f} px median, {unseen.p95_px:.3f} px at 95 %")
    for outlier in calibration.outliers:
        typer.echo(f"outlier: {outlier.name} ({outlier.rms_px:.2f} px)")
    for problem in solved.problems:
        typer.echo(f"left out: {problem}", err=True)
    for advice in solved.acceptance.retake:
        typer.echo(f"advice: {advice}")
    typer.echo(f"{solved.acceptance.text}")
    typer.echo(f"written: {out}; report: morpheyes calibrate report {out}")


def _print_watch(figures: dict[str, Any]) -> None:
    drift = figures["drift"]
    for text in drift["said"]:
        typer.echo(text)
    typer.echo(
        f"bent by {drift['bent_pitch_deg']:g} deg in pitch and yaw: rows {drift['before_epipolar_median_px']:.3f} px, "
        f"disparity bias {drift['before_disparity_bias_px']:.3f} px; corrected: {drift['epipolar_median_px']:.3f} px "
        f"and {drift['disparity_bias_px']:.3f} px"
    )
    for late in figures["late"]:
        measured = f"{late['measured_ms']:.2f} ± {late['sigma_ms']:.2f} ms"
        typer.echo(f"right camera {late['true_ms']:g} ms after the left one: measured {measured}")


def _print_table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    for row in [header, *rows]:
        typer.echo("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)))


app.command()(capture)
app.command()(check)
app.command()(repeatability)
app.command()(mount)
