"""`morpheyes results`: the tables of campaigns as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    folders: Annotated[list[Path], typer.Argument(help="Folders of finished `morpheyes experiment` campaigns.")],
    out: Annotated[Path, typer.Option(help="Page to write; its other sections are kept.")] = Path("docs/results.md"),
) -> None:
    """Write the sections of the missions of a results page: the paper's figures, the measured ones, and remarks."""
    from morpheyes_daemon.campaigns.results_page import write_page

    typer.echo(write_page(folders, out))
