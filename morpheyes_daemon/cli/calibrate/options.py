"""Options that the calibrate commands share, and their interpretation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from morpheyes_daemon.calibration.targets.boards import Board


def choose_board(
    known: Any,
    board: str | None,
    square_mm: float | None,
    marker_mm: float | None,
    ask: bool = False,
) -> Board:
    """Return the board of the options, else of `known`, the content of board.yaml.

    `ask` allows a prompt for a missing square size. Raises UsageError when the size is missing or both disagree.
    """
    from morpheyes_daemon.calibration.targets.boards import parse_board
    from morpheyes_daemon.errors import UsageError

    written = known.get("square_mm")
    if square_mm is None and written is None and ask:
        square_mm = typer.prompt("Side of one square in mm, measured over several squares", type=float)
    if square_mm is None and written is None:
        raise UsageError("The size of the squares is missing; measure one and give it, such as --square-mm 25.")
    if square_mm is not None and written is not None and abs(square_mm / float(written) - 1) > 1e-3:
        raise UsageError(f"--square-mm {square_mm:g} and board.yaml ({written:g} mm) disagree; correct one of them.")
    side_mm = float(written if square_mm is None else square_mm)
    marker = known.get("marker_mm") if marker_mm is None else marker_mm
    label = board or str(known.get("board", "9x6"))
    return parse_board(label, side_mm / 1e3, None if marker is None else float(marker) / 1e3)


def choose_baselines_m(text: str, range_m: tuple[float, float]) -> list[float]:
    """Return the nominal baselines of `--baselines`, metres: a number of them over the range, or lengths in mm.

    Raises UsageError for anything else.
    """
    import numpy as np

    from morpheyes_daemon.errors import UsageError

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--baselines {text!r} is not understood; give 10, or lengths such as 100,200.") from None
    if len(numbers) == 1 and 2 <= numbers[0] <= 50 and numbers[0].is_integer():
        return [round(float(b), 4) for b in np.linspace(*range_m, int(numbers[0]))]
    low_mm, high_mm = (round(length * 1e3, 4) for length in range_m)
    if not all(low_mm <= number <= high_mm for number in numbers):
        raise UsageError(f"--baselines must lie within the rail's {low_mm:g} to {high_mm:g} mm.")
    if len({round(number, 1) for number in numbers}) < len(numbers):
        raise UsageError("--baselines names a length twice.")
    return [round(number / 1e3, 4) for number in sorted(numbers)]


def parse_image_size(text: str) -> tuple[int, int]:
    """Return (width, height) in pixels of WIDTHxHEIGHT; raises UsageError for anything else."""
    from morpheyes_daemon.errors import UsageError

    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and 160 <= int(width) <= 4096 and 120 <= int(height) <= 3072):
        raise UsageError(f"--size {text!r} is not understood; give WIDTHxHEIGHT such as 640x480.")
    return int(width), int(height)


BoardOption = Annotated[
    str | None, typer.Option("--board", help="Inner corners such as 9x6, or squares such as charuco:10x7:5X5_1000.")
]


SquareOption = Annotated[float | None, typer.Option("--square-mm", help="Measured side of one square, mm.")]


MarkerOption = Annotated[
    float | None, typer.Option("--marker-mm", help="Measured side of one marker of a ChArUco board, mm.")
]


ViewsOption = Annotated[
    int | None, typer.Option("--views", min=3, max=200, help="Pairs per baseline; default: 12, for the mount 48.")
]


JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]


ConfigOption = Annotated[Path | None, typer.Option("--config", help="Vehicle configuration; default: config.yaml.")]
