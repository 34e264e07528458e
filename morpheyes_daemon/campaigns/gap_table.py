"""The table of a gap campaign: how many went through, how fast and how close, by shape and motion of the opening."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from morpheyes_daemon.campaigns.forest_table import Row, cause_lines, causes, shown_rate, success


def gap_cells(rows: Sequence[Row], to_refuse: bool = False) -> list[Row]:
    """Return one cell for every baseline and motion, over all shapes and for each.

    `to_refuse` says that no opening is large enough: what is wanted then is a refusal, and success counts these.
    """
    wanted = "refused" if to_refuse else "reached"
    cells = []
    groups = dict.fromkeys((row["baseline_mode"], row["motion"]) for row in rows)
    for mode, motion in groups:
        group = [row for row in rows if (row["baseline_mode"], row["motion"]) == (mode, motion)]
        shapes = sorted({row["shape"] for row in group})
        parts = {"all": group}
        if len(shapes) > 1:
            parts |= {shape: [row for row in group if row["shape"] == shape] for shape in shapes}
        cells += [_cell(mode, motion, shape, part, wanted) for shape, part in parts.items()]
    return cells


def gap_table(cells: Sequence[Row]) -> str:
    """Return the cells as a Markdown table, with the touches and other causes of failure below."""
    names = ("baseline", "motion", "shape", "flights", "through", "refused", "touched", "other", "success (95 %)",
             "crossing m/s", "slowest", "clearance mm", "smallest", "contour IoU")  # fmt: skip
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for cell in cells:
        rate = ("refused: " if cell["wanted"] == "refused" else "") + shown_rate(cell)
        counts = " | ".join(str(cell[key]) for key in ("flights", "reached", "refused", "collided", "others"))
        speeds = f"{_shown(cell['crossing_speed_m_s'])} | {_shown(cell['crossing_speed_min_m_s'])}"
        room = f"{_shown(cell['clearance_m'], 1e3, 0)} | {_shown(cell['clearance_min_m'], 1e3, 0)}"
        lines.append(
            f"| {cell['baseline_mode']} | {cell['motion']} | {cell['shape']} | {counts} | {rate} | {speeds} | {room} "
            f"| {_shown(cell['contour_iou'])} |"
        )
    for cell in cells:
        if cell["shape"] == "all":
            label = f"{cell['baseline_mode']}, motion {cell['motion']}"
            lines += [f"\n{label}: touched in seed {', '.join(cell['touches'])}"] if cell["touches"] else []
            lines += cause_lines(label, cell["causes"])
    return "\n".join(lines)


def _cell(mode: str, motion: str, shape: str, rows: Sequence[Row], wanted: str) -> Row:
    through = [row for row in rows if row["outcome"] == "reached"]
    touched = [row for row in rows if row["outcome"] == "collided"]
    refused = sum(row["outcome"] == "refused" for row in rows)
    speeds = _values(through, "crossing_speed_m_s")
    rooms = _values(through, "clearance_m")
    return {
        "baseline_mode": mode,
        "motion": motion,
        "shape": shape,
        "flights": len(rows),
        "reached": len(through),
        "refused": refused,
        "collided": len(touched),
        "others": len(rows) - len(through) - refused - len(touched),
        "wanted": wanted,
        **success(rows, wanted),
        "crossing_speed_m_s": _median(speeds),
        "crossing_speed_min_m_s": min(speeds, default=None),
        "clearance_m": _median(rooms),
        "clearance_min_m": min(rooms, default=None),
        "contour_iou": _median(_values(rows, "contour_iou")),
        "touches": [_touch(row) for row in touched],
        "causes": causes([row for row in rows if row["outcome"] != "collided"], wanted),
    }


def _touch(row: Row) -> str:
    """Return the seed of a touch with how deep it was; the ground is named."""
    clearance_m = row["min_clearance_m"]
    return f"{row['seed']} by {-1e3 * clearance_m:.0f} mm" if clearance_m <= 0.0 else f"{row['seed']}: {row['reason']}"


def _values(rows: Sequence[Row], key: str) -> list[float]:
    return [row[key] for row in rows if row[key] is not None]


def _median(values: Sequence[float]) -> float | None:
    return round(float(np.median(values)), 4) if values else None


def _shown(value: Any, scale: float = 1.0, digits: int = 2) -> str:
    return "–" if value is None else f"{scale * value:.{digits}f}"
