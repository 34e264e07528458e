"""The tables and the figure of a moving-object campaign: where it is found, and how far off its depth is, by range."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from morpheyes_daemon.campaigns.forest_table import Row, cause_lines, causes, wilson
from morpheyes_daemon.campaigns.imo_metrics import Sample, percentile, range_bins

SPANS_M = ((0.0, 10.0), (10.0, 16.0))
"""Ranges that the table sums up: near and far."""

SMALLEST_M, LARGEST_M = 0.1, 0.3
"""Ends of the colour scale of baselines, as in the paper's figures."""


def imo_cells(rows: Sequence[Row]) -> list[Row]:
    """Return one cell per baseline: rates and errors over all its flights, near and far, and by metre."""
    modes = list(dict.fromkeys(row["baseline_mode"] for row in rows))
    return [_cell(mode, [row for row in rows if row["baseline_mode"] == mode]) for mode in modes]


def imo_table(cells: Sequence[Row]) -> str:
    """Return the cells as Markdown tables: one line per baseline, detection and error by range, what ended flights."""
    names = ("baseline", "flights", "frames", "found (95 %)", "median error to 10 m", "p95", "beyond 10 m", "p95",
             "longest loss s", "false frames")  # fmt: skip
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for cell in cells:
        rate = "–"
        if cell["frames"]:
            rate = f"{cell['detection_rate']:.1%} ({cell['detection_low']:.1%} to {cell['detection_high']:.1%})"
        errors = " | ".join(
            f"{_pct(span['median_rel_error'])} | {_pct(span['p95_rel_error'])}" for span in cell["spans"]
        )
        false = f"{cell['false_frames']} of {cell['frames_watched']}"
        lines.append(
            f"| {cell['baseline_mode']} | {cell['flights']} | {cell['frames']} | {rate} | {errors} "
            f"| {cell['longest_loss_s']:.1f} | {false} |"
        )
    ended = [line for cell in cells for line in cause_lines(cell["baseline_mode"], cell["causes"])]
    return "\n".join([*lines, "", *_by_range(cells), *ended])


def draw_trajectories(rows: Sequence[Row], path: Path) -> None:
    """Draw, for each baseline, the measured depth's error over time against the truth, with the places of loss.

    As the paper's figure: the truth is the horizontal line, dots on it are frames in which the object was not found,
    and the curve has the colour of its baseline.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    modes = list(dict.fromkeys(row["baseline_mode"] for row in rows))
    figure, axes = plt.subplots(len(modes), 1, figsize=(8, 2.6 * len(modes)), squeeze=False, sharex=True)
    for axis, mode in zip(axes[:, 0], modes, strict=True):
        samples = [s for row in rows if row["baseline_mode"] == mode for s in _samples(row)]
        found = [s for s in samples if s.measured_m is not None]
        lost = [s.true_m for s in samples if s.measured_m is None]
        axis.axhline(0.0, color="black", linewidth=0.8)
        dots = axis.scatter(
            [s.true_m for s in found], [100.0 * ((s.measured_m or 0.0) / s.true_m - 1.0) for s in found],
            c=[s.baseline_m for s in found], cmap="jet", vmin=SMALLEST_M, vmax=LARGEST_M, s=5,
        )  # fmt: skip
        axis.plot(lost, np.zeros(len(lost)), "k.", markersize=7, label=f"not found: {len(lost)} of {len(samples)}")
        axis.set_ylim(-6.0, 6.0)
        axis.set_ylabel("depth error, %")
        axis.set_title(f"baseline {mode}", fontsize=9)
        axis.legend(loc="upper left", fontsize=8)
        figure.colorbar(dots, ax=axis, label="baseline, m")
    axes[-1, 0].set_xlabel("true depth of the visible face, m")
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)


def _cell(mode: str, rows: Sequence[Row]) -> Row:
    samples = [s for row in rows for s in _samples(row)]
    found = sum(s.measured_m is not None for s in samples)
    low, high = wilson(found, len(samples))
    return {
        "baseline_mode": mode,
        "flights": len(rows),
        "outcomes": dict(Counter(row["outcome"] for row in rows)),
        "frames": len(samples),
        "detected": found,
        "detection_rate": round(found / len(samples), 4) if samples else None,
        "detection_low": round(low, 4),
        "detection_high": round(high, 4),
        "spans": [_span(samples, *span) for span in SPANS_M],
        "longest_loss_s": max((row["longest_loss_s"] for row in rows), default=0.0),
        "frames_watched": sum(row["frames_watched"] for row in rows),
        "false_frames": sum(row["false_frames"] for row in rows),
        "range_bins": range_bins(samples),
        "causes": causes(rows),
    }


def _span(samples: Sequence[Sample], from_m: float, to_m: float) -> Row:
    errors = [
        abs(s.measured_m / s.true_m - 1.0) for s in samples if s.measured_m is not None and from_m <= s.true_m < to_m
    ]
    return {
        "from_m": from_m,
        "to_m": to_m,
        "median_rel_error": percentile(errors, 50),
        "p95_rel_error": percentile(errors, 95),
    }


def _by_range(cells: Sequence[Row]) -> list[str]:
    """Return the lines of a table with a row per metre and, for each baseline, found and median error."""
    with_object = [cell for cell in cells if cell["frames"]]
    if not with_object:
        return []
    names = [f"{cell['baseline_mode']}: found | error | p95" for cell in with_object]
    lines = ["| range m | " + " | ".join(names) + " |", "|---|" + "---|---|---|" * len(with_object)]
    for start in sorted({part["from_m"] for cell in with_object for part in cell["range_bins"]}):
        shown = [_bin(cell, start) for cell in with_object]
        lines.append(f"| {start} to {start + 1} | " + " | ".join(shown) + " |")
    return lines


def _bin(cell: Row, start: int) -> str:
    part = next((part for part in cell["range_bins"] if part["from_m"] == start), None)
    if part is None:
        return "– | – | –"
    found = f"{part['detected']} of {part['frames']}"
    return f"{found} | {_pct(part['median_rel_error'])} | {_pct(part['p95_rel_error'])}"


def _samples(row: Row) -> list[Sample]:
    return [Sample(*sample) for sample in row["samples"]]


def _pct(value: Any) -> str:
    return "–" if value is None else f"{100.0 * value:.2f} %"
