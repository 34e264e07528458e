"""`morpheyes analyze`: the error analysis of the paper (section II), for its rig or a calibrated one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from morpheyes_daemon.stereo.calibration_file import read_calibration


def command(
    rig: Annotated[Path | None, typer.Option(help="Calibration file to analyse instead of the paper's rig.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the pictures and analysis.json.")] = Path("out/analysis"),
    as_json: Annotated[bool, typer.Option("--json", help="Print all numbers as JSON.")] = False,
) -> None:
    """Draw the depth error, the errors of a wrong calibration (figures 2, 3, table I) and speed bounds (figure 5)."""
    import json

    from morpheyes_daemon.errors import InputError
    from morpheyes_daemon.paper.error_analysis import analysis, paper_subject, rig_subject
    from morpheyes_daemon.paper.figures import draw_all

    subject = paper_subject() if rig is None else rig_subject(read_calibration(rig), rig.name)
    numbers = analysis(subject)
    text = json.dumps(numbers, indent=2, allow_nan=False)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "analysis.json").write_text(text + "\n", encoding="utf-8")
        pictures = draw_all(out, subject, numbers)
    except OSError as error:
        raise InputError(f"{out}: the results cannot be written there ({error.strerror}); name another --out.") from None
    if as_json:
        typer.echo(text)
        return
    table = numbers["table_1"]
    ratios = ", ".join(f"{name} {value:.3g}" for name, value in table["intrinsic"].items())
    typer.echo(f"Table I ({table['statistic']}): e_y/e_x {ratios}")
    for direction, row in table["extrinsic"].items():
        typer.echo(f"  left/right in {direction}: " + ", ".join(f"{name} {value:.3g}" for name, value in row.items()))
    for picture in pictures:
        typer.echo(str(picture))
