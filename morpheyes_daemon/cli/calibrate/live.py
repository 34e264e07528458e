"""`morpheyes calibrate capture`, `check` and `repeatability`: the commands that use a rig or its recordings."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from morpheyes_daemon.cli.calibrate.options import (
    BoardOption,
    ConfigOption,
    JsonOption,
    MarkerOption,
    SquareOption,
    ViewsOption,
)
from morpheyes_daemon.stereo.calibration_file import read_calibration

if TYPE_CHECKING:
    from morpheyes_daemon.config.vehicle import VehicleConfig
    from morpheyes_daemon.messages.core import Image
    from morpheyes_daemon.perception.calibration_check import CalibrationCheck, CalibrationCheckResult
    from morpheyes_daemon.rig_capture.board_capture import BoardFolder, CaptureStatus


def capture(
    out: Annotated[Path, typer.Argument(help="Folder for the pictures; an interrupted capture is continued.")],
    config: ConfigOption = None,
    baselines_mm: Annotated[
        str, typer.Option("--baselines", help="Number of baselines, or lengths in mm such as 100,200.")
    ] = "10",
    views: ViewsOption = None,
    mount: Annotated[
        bool, typer.Option("--mount", help="Fixed board, vehicle rotated by hand: for `calibrate mount`.")
    ] = False,
    visits: Annotated[
        int,
        typer.Option(
            "--visits", min=0, max=100, help="Visits to each baseline with a fixed board: for `calibrate repeatability`."
        ),
    ] = 0,
    board: BoardOption = None,
    square_mm: SquareOption = None,
    marker_mm: MarkerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take board pictures at all baselines with the rig's own cameras and servo, keeping those that add information.

    With --mount the board is fixed, and the vehicle, its autopilot on and its propellers off, is rotated by hand.
    """
    import asyncio

    from morpheyes_daemon.calibration.mount import MOUNT_VIEWS
    from morpheyes_daemon.calibration.solver.pipeline import read_board_file
    from morpheyes_daemon.calibration.targets.capture_guide import BASELINE_VIEWS
    from morpheyes_daemon.cli.calibrate.options import choose_baselines_m, choose_board
    from morpheyes_daemon.config.packaged import load_config
    from morpheyes_daemon.rig_capture.board_capture import BoardFolder

    vehicle = load_config(config)
    known = read_board_file(out) if out.is_dir() else {}
    chosen = choose_board(known, board, square_mm, marker_mm, ask=not as_json and sys.stdin.isatty())
    low_m, high_m = vehicle.baseline_range_m
    nominal_m = [low_m] if low_m == high_m else choose_baselines_m(baselines_mm, (low_m, high_m))
    folder = BoardFolder(out, chosen)
    if mount:
        counts = asyncio.run(_capture_mount(vehicle, folder, views or MOUNT_VIEWS))
    else:
        counts = asyncio.run(_capture_boards(vehicle, folder, nominal_m, views or BASELINE_VIEWS, visits))
    if as_json:
        typer.echo(json.dumps({"folder": str(out), "pairs": counts}, indent=2))
    else:
        following = f"mount FILE {out}" if mount else f"solve {out}"
        typer.echo(f"{sum(counts.values())} pairs are in {out}; next: morpheyes calibrate {following}")


async def _capture_mount(config: VehicleConfig, folder: BoardFolder, wanted: int) -> dict[str, int]:
    from morpheyes_daemon.clock import running_clock
    from morpheyes_daemon.devices.link import open_link
    from morpheyes_daemon.rig_capture.mount_capture import AttitudeSource, HandHeldVehicle, capture_mount
    from morpheyes_daemon.rig_capture.rig_session import RigSession

    clock = running_clock()
    async with RigSession.of(config, clock, open_link) as session, HandHeldVehicle(config, clock, open_link) as held:
        source = AttitudeSource(lambda: held.state, clock)
        return {folder.path.name: await capture_mount(session, source, folder, wanted, _show_attitudes)}


async def _capture_boards(
    config: VehicleConfig, folder: BoardFolder, nominal_m: list[float], wanted: int, visits: int
) -> dict[str, int]:
    from morpheyes_daemon.clock import running_clock
    from morpheyes_daemon.devices.link import open_link
    from morpheyes_daemon.rig_capture.board_capture import capture_boards, capture_visits
    from morpheyes_daemon.rig_capture.rig_session import RigSession

    async with RigSession.of(config, running_clock(), open_link) as session:
        if visits:
            return await capture_visits(session, folder, nominal_m, visits, _show)
        return await capture_boards(session, folder, nominal_m, wanted, _show)


def check(
    file: Annotated[Path, typer.Argument(help="Calibration file.")],
    folder: Annotated[
        Path | None, typer.Argument(help="Recorded pairs, in folders such as 100mm; default: the rig itself.")
    ] = None,
    config: ConfigOption = None,
    frames: Annotated[int, typer.Option("--frames", min=1, max=1000, help="Pairs per baseline from the rig.")] = 10,
    baseline_mm: Annotated[
        float | None, typer.Option("--baseline-mm", help="Nominal baseline of a recording whose folder names none.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a calibration on any static textured scene, without a board: row offsets at every baseline, and the yaw."""
    from morpheyes_daemon.cli.terminal.progress import progress_line

    rig = read_calibration(file)
    with progress_line() as progress:
        if folder is not None:
            result = _check_recorded(rig, folder, baseline_mm, progress)
        else:
            from morpheyes_daemon.config.packaged import load_config

            result = _check_live(rig, load_config(config), frames, progress)
    if as_json:
        typer.echo(json.dumps(result.figures(), indent=2))
    else:
        _print_check(result)
    if not result.passed:
        raise typer.Exit(1)


def repeatability(
    file: Annotated[Path, typer.Argument(help="Calibration file.")],
    folder: Annotated[Path, typer.Argument(help="One folder per target, one pair per visit (capture --visits 10).")],
    out: Annotated[Path, typer.Option("--out", help="Picture to write.")] = Path("repeatability.png"),
    board: BoardOption = None,
    square_mm: SquareOption = None,
    marker_mm: MarkerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure target against achieved baseline: mean and 10 sigma band over the visits, as in the paper's figure."""
    from morpheyes_daemon.calibration.solver.pipeline import read_board_file
    from morpheyes_daemon.calibration.solver.repeatability import draw, figures, positions
    from morpheyes_daemon.calibration.targets.detection import observe
    from morpheyes_daemon.calibration.targets.image_pairs import read_folder
    from morpheyes_daemon.cli.calibrate.options import choose_board
    from morpheyes_daemon.cli.terminal.progress import progress_line

    rig = read_calibration(file)
    known = read_board_file(folder) if folder.is_dir() else {}
    chosen = choose_board(known, board, square_mm, marker_mm, ask=not as_json and sys.stdin.isatty())
    with progress_line() as progress:
        folders, problems = read_folder(folder)
        found = positions(rig, observe(folders, chosen, None, progress, problems), progress)
    out.parent.mkdir(parents=True, exist_ok=True)
    draw(found).savefig(out, dpi=150)
    shown = figures(found)
    if as_json:
        typer.echo(json.dumps({**shown, "picture": str(out)}, indent=2))
        return
    for row in shown["positions"]:
        achieved = f"{row['mean_mm']:.2f} mm, sigma {row['sigma_mm']:.2f} mm"
        typer.echo(f"{row['target_mm']:g} mm: {achieved}, {row['samples']} visits")
    worst = f"{shown['largest_error_mm']:.2f} mm ({shown['largest_error_pct']:.2f} %)"
    typer.echo(f"largest error {worst}; paper: {shown['paper_largest_error_mm']:g} mm; figure: {out}")


def _check_recorded(rig: Any, folder: Path, baseline_mm: float | None, progress: Any) -> CalibrationCheckResult:
    from morpheyes_daemon.errors import UsageError
    from morpheyes_daemon.perception.calibration_check import CalibrationCheck

    check: CalibrationCheck | None = None
    pairs = list(_recorded_pairs(folder))
    for done, (nominal_m, left, right) in enumerate(pairs, start=1):
        at_m = nominal_m if baseline_mm is None else baseline_mm / 1e3
        if at_m is None:
            at_m = rig.range_m[0]
            if rig.range_m[0] != rig.range_m[1]:
                raise UsageError(f"{folder}: names no baseline; give --baseline-mm, or put the pairs in 150mm.")
        check = check or CalibrationCheck(rig, (left.shape[1], left.shape[0]))
        check.add(at_m, left, right)
        progress("measuring row offsets", done, len(pairs))
    if check is None:
        raise UsageError(f"{folder}: holds no readable pairs.")
    return check.result()


def _recorded_pairs(folder: Path) -> Iterator[tuple[float | None, Image, Image]]:
    from morpheyes_daemon.calibration.targets.image_pairs import read_folder, read_pair

    folders, _ = read_folder(folder)
    for one in folders:
        for files in one.pairs:
            if files.left is not None and files.right is not None:
                left, right = read_pair(files)
                yield one.nominal_m, left, right


def _check_live(rig: Any, config: VehicleConfig, frames: int, progress: Any) -> CalibrationCheckResult:
    import asyncio

    from morpheyes_daemon.clock import running_clock
    from morpheyes_daemon.devices.link import open_link
    from morpheyes_daemon.perception.calibration_check import CalibrationCheck
    from morpheyes_daemon.rig_capture.rig_session import RigSession

    async def run() -> CalibrationCheck:
        check = CalibrationCheck(rig, (config.camera.width_px, config.camera.height_px))
        async with RigSession.of(config, running_clock(), open_link) as session:
            low_m, high_m = rig.range_m
            places = [low_m] if low_m == high_m else [low_m, (low_m + high_m) / 2, high_m]
            for index, place_m in enumerate(places):
                await session.place(place_m)
                for number in range(frames):
                    pair = await session.pair()
                    check.add(place_m, pair.left, pair.right)
                    progress("measuring row offsets", index * frames + number + 1, len(places) * frames)
        return check

    return asyncio.run(run()).result()


def _print_check(result: CalibrationCheckResult) -> None:
    for one in result.baselines:
        row = one.figures()
        rows = "no texture" if row["epipolar_median_px"] is None else f"rows {row['epipolar_median_px']:.3f} px"
        turn = ""
        if row["pitch_deg"] is not None:
            turn = f", pitch {row['pitch_deg']:+.3f} deg, roll {row['roll_deg']:+.3f} deg"
        typer.echo(f"{row['nominal_mm']:g} mm, {row['pairs']} pairs: {rows}{turn}")
    if result.bias_px is not None:
        typer.echo(f"disparity bias (yaw): {result.bias_px:+.3f} ± {result.bias_sigma_px:.3f} px")
    for finding in result.findings:
        typer.echo(finding)
    typer.echo(result.acceptance)


def _map(counts: Any) -> str:
    """Return the coverage as text, row by row, a dot for a cell without corners."""
    return "/".join("".join(".:*#"[min(int(count), 3)] for count in row) for row in counts)


def _show_attitudes(kept: int, text: str) -> None:
    """Show the number of kept pictures and the advice in one line that is overwritten."""
    line = f"{kept} kept  {text}"
    sys.stderr.write(f"\r\x1b[K{line}" if sys.stderr.isatty() else (f"{line}\n" if text == "kept" else ""))
    sys.stderr.flush()


def _show(status: CaptureStatus) -> None:
    """Show the state of the capture in one line that is overwritten, with the coverage of both cameras."""
    guide = status.guide
    maps = "  ".join(_map(guide.covered(side)) for side in (0, 1))
    line = f"{status.nominal_m * 1e3:g} mm  {guide.kept}/{guide.wanted}  {status.hint.text:44} {maps}"
    sys.stderr.write(f"\r\x1b[K{line}" if sys.stderr.isatty() else (f"{line}\n" if status.hint.kept else ""))
    sys.stderr.flush()
