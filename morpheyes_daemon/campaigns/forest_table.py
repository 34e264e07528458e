"""The table of a campaign over baselines: how many flights reached the goal, how fast and how close, and why not.

The forest and every strategy without a table of its own are reported like this; what is common to all tables is here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Row = dict[str, Any]


def flight_cells(rows: Sequence[Row], set_speed_m_s: float, trees_per_ha: float | None = None) -> list[Row]:
    """Return one cell per baseline: counts, success rate with its 95 % Wilson interval, speeds, clearance.

    `set_speed_m_s` is the last bound on the speed, `trees_per_ha` the world's density, None where it has no trees.
    """
    modes = list(dict.fromkeys(row["baseline_mode"] for row in rows))
    variable = {row["seed"]: row for row in rows if row["baseline_mode"] == "variable"}
    flown_in = {"trees_per_ha": trees_per_ha, "set_speed_m_s": set_speed_m_s}
    cells = [_cell(mode, [row for row in rows if row["baseline_mode"] == mode], variable) for mode in modes]
    return [{**cell, **flown_in} for cell in cells]


def flight_table(cells: Sequence[Row]) -> str:
    """Return the cells as a Markdown table; with several baselines, how much faster the variable one was, by seed."""
    wooded = any(cell["trees_per_ha"] for cell in cells)
    compared = len(cells) > 1
    names = ["baseline", *(["trees/ha", "set m/s"] if wooded else [])]
    names += ["flights", "reached", "collided", "success (95 %)", "m/s", "peak", "time s", "clearance m"]
    names += ["variable faster (95 %)"] if compared else []
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for cell in cells:
        figures = [cell[key] for key in ("mean_speed_m_s", "peak_speed_m_s", "mean_time_s", "min_clearance_m")]
        parts = [
            cell["baseline_mode"],
            *([f"{cell['trees_per_ha']:g}", f"{cell['set_speed_m_s']:g}"] if wooded else []),
            *(str(cell[key]) for key in ("flights", "reached", "collided")),
            shown_rate(cell),
            *("–" if value is None else f"{value:.2f}" for value in figures),
            *([_faster(cell)] if compared else []),
        ]
        lines.append("| " + " | ".join(parts) + " |")
    for cell in cells:
        lines += cause_lines(cell["baseline_mode"], cell["causes"])
    return "\n".join(lines)


def wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """Return the Wilson score interval of a success rate; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    p, n = successes / trials, trials
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def success(rows: Sequence[Row], wanted: str = "reached") -> Row:
    """Return the columns of how many of the flights ended as wanted, with the 95 % Wilson interval."""
    good = sum(row["outcome"] == wanted for row in rows)
    low, high = wilson(good, len(rows))
    return {
        "success_rate": round(good / len(rows), 4) if rows else 0.0,
        "success_low": round(low, 4),
        "success_high": round(high, 4),
    }


def shown_rate(cell: Row) -> str:
    """Return a cell's success rate with its interval, in percent."""
    return f"{cell['success_rate']:.0%} ({cell['success_low']:.0%} to {cell['success_high']:.0%})"


def causes(rows: Sequence[Row], wanted: str = "reached") -> dict[str, int]:
    """Return how often each cause kept a flight from ending as wanted; every collision is one of its own."""
    found: dict[str, int] = {}
    for row in rows:
        if row["outcome"] != wanted:
            # no two collisions are alike
            which = f"collided in seed {row['seed']}" if row["outcome"] == "collided" else row["outcome"]
            cause = f"{which}: {row['reason']}"
            found[cause] = found.get(cause, 0) + 1
    return found


def cause_lines(label: str, counts: Mapping[str, int]) -> list[str]:
    """Return the lines below a table that say how often each cause was met, each a paragraph of its own."""
    return [f"\n{label}: {count} x {cause}" for cause, count in counts.items()]


def _cell(mode: str, rows: Sequence[Row], variable: dict[int, Row]) -> Row:
    good = [row for row in rows if row["outcome"] == "reached"]
    others = ("collided", "refused", "timeout", "aborted")
    return {
        "baseline_mode": mode,
        "flights": len(rows),
        "reached": len(good),
        **{name: sum(row["outcome"] == name for row in rows) for name in others},
        **success(rows),
        "mean_speed_m_s": _mean(good, "mean_speed_m_s"),
        "peak_speed_m_s": max((row["peak_speed_m_s"] for row in rows), default=None),
        "mean_time_s": _mean(good, "time_s"),
        "min_clearance_m": min((row["min_clearance_m"] for row in rows), default=None),
        "braking_events": sum(row["braking_events"] for row in rows),
        "speed_ratio_to_variable": _ratio(good, variable),
        "causes": causes(rows),
    }


def _mean(rows: Sequence[Row], key: str) -> float | None:
    return round(sum(row[key] for row in rows) / len(rows), 4) if rows else None


def _ratio(rows: Sequence[Row], variable: dict[int, Row]) -> list[float] | None:
    """Variable speed over this baseline's, flight by flight of the same seed: mean and its 95 % interval."""
    pairs = [
        variable[row["seed"]]["mean_speed_m_s"] / row["mean_speed_m_s"]
        for row in rows
        if row["seed"] in variable and variable[row["seed"]]["outcome"] == "reached"
    ]
    if not pairs:
        return None
    mean = sum(pairs) / len(pairs)
    spread = math.sqrt(sum((x - mean) ** 2 for x in pairs) / max(1, len(pairs) - 1))
    half = 1.96 * spread / math.sqrt(len(pairs))
    return [round(mean, 3), round(mean - half, 3), round(mean + half, 3)]


def _faster(cell: Row) -> str:
    if cell["speed_ratio_to_variable"] is None or cell["baseline_mode"] == "variable":
        return "–"
    mean, low, high = cell["speed_ratio_to_variable"]
    return f"{mean:.2f}× ({low:.2f} to {high:.2f})"
