"""Output of measured figures: rows for a person, or JSON and nothing else."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from morpheyes_daemon.benchmarks.vision_latency import Times


def print_figures(document: dict[str, Any], rows: Sequence[tuple[str, str]], as_json: bool) -> None:
    """Print `document` as JSON, or `rows` of name and value."""
    if as_json:
        typer.echo(json.dumps(document, indent=2))
        return
    for name, value in rows:
        typer.echo(f"{name:>18}  {value}")


def times_text(times: Times) -> str:
    """Return median, 95th percentile and largest of timed runs as text."""
    p95, most = f"p95 {times.p95_ms:.1f} ms", f"largest {times.max_ms:.1f} ms"
    return f"{times.median_ms:.1f} ms median, {p95}, {most} of {times.repeats}"
