"""The table of a gap campaign: how many went through, how fast and how close, by shape and motion of the opening."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from morpheyes_daemon.experiments.campaign import Row, wilson


def gap_cells(rows: Sequence[Row]) -> list[Row]:
    """Return one cell for every baseline and motion, over all shapes and for each."""
    cells = []
    groups = dict.fromkeys((row["baseline_mode"], row["motion"]) for row in rows)
    for mode, motion in groups:
        group = [row for row in rows if (row["baseline_mode"], row["motion"]) == (mode, motion)]
        shapes = list(dict.fromkeys(row["shape"] for row in group))
        cells.append(_cell(mode, motion, "all", group))
        if len(shapes) > 1:
            cells += [_cell(mode, motion, s, [row for row in group if row["shape"] == s]) for s in sorted(shapes)]
    return cells


def gap_table(cells: Sequence[Row]) -> str:
    """Return the cells as a Markdown table."""
    names = ("baseline", "motion", "shape", "flights", "through", "refused", "touched", "other", "success (95 %)",
             "crossing m/s", "slowest", "clearance mm", "smallest", "contour IoU")  # fmt: skip
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for cell in cells:
        rate = f"{cell['success_rate']:.0%} ({cell['success_low']:.0%} to {cell['success_high']:.0%})"
        counts = " | ".join(str(cell[key]) for key in ("flights", "reached", "refused", "collided", "others"))
        speeds = f"{_shown(cell['crossing_speed_m_s'])} | {_shown(cell['crossing_speed_min_m_s'])}"
        room = f"{_shown(cell['clearance_m'], 1e3, 0)} | {_shown(cell['clearance_min_m'], 1e3, 0)}"
        lines.append(
            f"| {cell['baseline_mode']} | {cell['motion']} | {cell['shape']} | {counts} | {rate} | {speeds} | {room} "
            f"| {_shown(cell['contour_iou'])} |"
        )
    return "\n".join(lines)


def _cell(mode: str, motion: str, shape: str, rows: Sequence[Row]) -> Row:
    through = [row for row in rows if row["outcome"] == "reached"]
    low, high = wilson(len(through), len(rows))
    count = {name: sum(row["outcome"] == name for row in rows) for name in ("refused", "collided")}
    speeds = _values(through, "crossing_speed_m_s")
    rooms = _values(through, "clearance_m")
    return {
        "baseline_mode": mode,
        "motion": motion,
        "shape": shape,
        "flights": len(rows),
        "reached": len(through),
        **count,
        "others": len(rows) - len(through) - sum(count.values()),
        "success_rate": round(len(through) / len(rows), 4),
        "success_low": round(low, 4),
        "success_high": round(high, 4),
        "crossing_speed_m_s": _median(speeds),
        "crossing_speed_min_m_s": min(speeds, default=None),
        "clearance_m": _median(rooms),
        "clearance_min_m": min(rooms, default=None),
        "contour_iou": _median(_values(rows, "contour_iou")),
        "causes": _causes(rows),
    }


def _causes(rows: Sequence[Row]) -> dict[str, int]:
    causes: dict[str, int] = {}
    for row in rows:
        if row["outcome"] != "reached":
            cause = row["outcome"] if row["outcome"] == "collided" else f"{row['outcome']}: {row['reason']}"
            causes[cause] = causes.get(cause, 0) + 1
    return causes


def _values(rows: Sequence[Row], key: str) -> list[float]:
    return [row[key] for row in rows if row[key] is not None]


def _median(values: Sequence[float]) -> float | None:
    return round(float(np.median(values)), 4) if values else None


def _shown(value: Any, scale: float = 1.0, digits: int = 2) -> str:
    return "–" if value is None else f"{scale * value:.{digits}f}"
