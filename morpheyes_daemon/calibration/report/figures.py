"""Figures of a calibration report, drawn from the content of the calibration file.

Every function takes the rig and returns a matplotlib figure, or None where the file lacks the data (an exact file,
a single baseline). The page around them is `html`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from morpheyes_daemon.calibration.report.depth_error_budget import DISTANCES_M, Conditions, depth_errors
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel
from morpheyes_daemon.transforms import R_FRD_CAM, rpy_from_R

INK, MUTED, GRID = "#1c2430", "#66707f", "#e3e7ec"
BLUE, ORANGE, GREEN, RED, PURPLE = "#2f6fde", "#e8833a", "#2a9d6f", "#d1453b", "#8a63d2"
CAUSES = (("matcher", BLUE), ("yaw", ORANGE), ("baseline length", GREEN), ("time offset", PURPLE))
_WIDE, _HALF = (9.6, 3.1), (4.7, 3.1)
"""Sizes of figures, inches; chosen: the width of the page at 100 dpi."""
_GOOD_ROW_PX = 0.2
"""Least upper end of the colour scale of row errors, pixels; chosen: a good rig appears pale."""
_FEWEST_BARS = 5
"""Bars that a plot has room for at least; chosen: a single bar would fill it."""


def calibrated(rig: RigModel) -> list[CalibratedBaseline]:
    """Return the baselines at which pictures were taken, without those interpolated by the rail model."""
    return [baseline for baseline in rig.baselines if baseline.rms_px is not None] or list(rig.baselines)


def coverage_map(rig: RigModel) -> Figure | None:
    """Return the map of corners per cell in the image of each camera."""
    seen = rig.details.get("coverage")
    if not seen:
        return None
    figure = Figure(figsize=_WIDE, layout="constrained")
    axes = figure.subplots(1, 2)
    most = max(np.max(seen["left"]), np.max(seen["right"]), 1)
    for ax, side in zip(axes, ("left", "right"), strict=True):
        counts = np.array(seen[side])
        shown = np.where(counts > 0, counts, np.nan)
        image = _cells(ax, shown, rig, "YlGnBu", (0, float(most)))
        for row, column in np.argwhere(counts == 0):
            at = _cell_centre(rig, counts.shape, row, column)
            ax.text(*at, "none", ha="center", va="center", color=RED, size=8)
        ax.set_title(f"{side} camera: {np.mean(counts > 0):.0%} of the image", loc="left")
    _colour_bar(figure, image, axes, "corners seen")
    return figure


def rms_bars(rig: RigModel) -> Figure | None:
    """Return the rms of the corners at each baseline, beside the row errors of held-out boards."""
    chosen = [baseline for baseline in rig.baselines if baseline.rms_px is not None]
    if not chosen:
        return None
    figure, ax = _plot(_WIDE)
    x = np.arange(len(chosen))
    ax.bar(x - 0.2, [b.rms_px or 0.0 for b in chosen], 0.38, color=BLUE, label="rms of all corners")
    rows = rig.details.get("held_out", {}).get("median_by_baseline_px")
    if rows:
        ax.bar(x + 0.2, [v or 0.0 for v in rows], 0.38, color=ORANGE, label="rows on held-out boards, median")
    views = rig.details.get("views", [])
    labels = [f"{b.nominal_m * 1e3:g}" for b in chosen]
    if len(views) == len(chosen):
        labels = [f"{label}\n{count} views" for label, count in zip(labels, views, strict=True)]
    ax.set_xticks(x, labels)
    _limit_bar_width(ax, len(chosen))
    ax.set_xlabel("nominal baseline, mm")
    ax.set_ylabel("px")
    ax.legend(loc="upper left", bbox_to_anchor=(0, 1.18), ncols=2)
    return figure


def held_out_map(rig: RigModel) -> Figure | None:
    """Return the map of the row error on held-out boards over the left image."""
    cells = rig.details.get("held_out", {}).get("median_by_cell_px")
    if not cells:
        return None
    values = np.array([[np.nan if value is None else value for value in row] for row in cells], dtype=float)
    figure, ax = _plot(_HALF)
    top = max(_GOOD_ROW_PX, float(np.nanpercentile(values, 95)) * 1.15)
    image = _cells(ax, values, rig, "YlOrRd", (0.0, top))
    for (row, column), value in np.ndenumerate(values):
        text, color = ("–", MUTED) if np.isnan(value) else (f"{value:.2f}", "white" if value > 0.65 * top else INK)
        ax.text(*_cell_centre(rig, values.shape, row, column), text, ha="center", va="center", color=color, size=7)
    ax.set_title("left image, median of |row difference|", loc="left")
    _colour_bar(figure, image, ax, "px")
    return figure


def leave_one_out_curve(rig: RigModel) -> Figure | None:
    """Return the errors of each inner baseline predicted by the others."""
    rows: Sequence[Mapping[str, float]] = rig.details.get("leave_one_out") or []
    if not rows:
        return None
    figure = Figure(figsize=_WIDE, layout="constrained")
    axes = figure.subplots(1, 3)
    x = [row["baseline_mm"] for row in rows]
    axes[0].plot(x, [row["epipolar_median_px"] for row in rows], "o-", color=ORANGE, label="left out")
    axes[0].plot(x, [row["full_epipolar_median_px"] for row in rows], "o-", color=BLUE, label="all baselines")
    axes[0].legend()
    axes[1].plot(x, [row["baseline_error_mm"] for row in rows], "o-", color=GREEN)
    axes[2].plot(x, [row["disparity_bias_px"] for row in rows], "o-", color=PURPLE)
    titles = ("row error on its boards, px", "error of its length, mm", "disparity bias at infinity, px")
    for ax, title in zip(axes, titles, strict=True):
        _style(ax)
        ax.set_title(title, loc="left")
        ax.set_xlabel("baseline left out, mm")
        ax.set_ylim(bottom=0)
    return figure


def rail_curves(rig: RigModel) -> Figure | None:
    """Return the angles and offsets of the right camera along the rail."""
    if len(rig.baselines) < 2:
        return None
    figure = Figure(figsize=_WIDE, layout="constrained")
    axes = figure.subplots(1, 3)
    b = np.array(rig.baselines_m)
    poses = [rig.T_cam0_cam1(nominal) for nominal in b]
    known = [rig.baselines_m.index(baseline.nominal_m) for baseline in calibrated(rig)]
    angles = np.degrees([_angles(T[:3, :3]) for T in poses])
    shifts = np.array([T[:3, 3] for T in poses]) * 1e3
    length = np.linalg.norm(shifts, axis=1) - b * 1e3
    curves = (
        (axes[0], length[:, None], ("length",), (BLUE,)),
        (axes[1], angles, ("pitch", "yaw", "roll"), (BLUE, ORANGE, GREEN)),
        (axes[2], shifts[:, 1:], ("down", "forward"), (BLUE, ORANGE)),
    )
    for ax, values, names, colours in curves:
        _style(ax)
        for column, (name, colour) in enumerate(zip(names, colours, strict=True)):
            ax.plot(b * 1e3, values[:, column], "-", color=colour, label=name)
            ax.plot(b[known] * 1e3, values[known, column], "o", color=colour, ms=4)
        ax.set_xlabel("nominal baseline, mm")
    axes[0].set_title("true length minus nominal, mm", loc="left")
    axes[1].set_title("right camera relative to left, degrees", loc="left")
    axes[2].set_title("right camera's offset, mm", loc="left")
    for ax in axes[1:]:
        ax.legend()
    return figure


def depth_error_bars(rig: RigModel, conditions: Conditions) -> Figure:
    """Return the depth error to expect at `DISTANCES_M` by cause; the parts of a bar are shares of the variance."""
    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    chosen = {baseline.nominal_m for baseline in calibrated(rig)}
    errors = [error for error in depth_errors(rig, conditions) if error.nominal_m in chosen]
    for ax, distance in zip(axes, DISTANCES_M, strict=True):
        _style(ax)
        at = [error for error in errors if error.distance_m == distance]
        x, bottom = np.arange(len(at)), np.zeros(len(at))
        total = np.array([error.total_m for error in at])
        parts = np.array([[e.disparity_m, e.yaw_m, e.baseline_m, e.sync_m] for e in at])
        for column, (name, colour) in enumerate(CAUSES):
            height = parts[:, column] ** 2 / total * 100
            ax.bar(x, height, 0.72, bottom=bottom, color=colour, label=name)
            bottom = bottom + height
        for place, value in zip(x, total, strict=True):
            ax.text(place, value * 100, f"{value / distance:.1%}", ha="center", va="bottom", size=7, color=MUTED)
        ax.set_xticks(x, [f"{error.nominal_m * 1e3:g}" for error in at], size=8)
        ax.set_title(f"at {distance:g} m: one sigma, cm", loc="left")
        ax.margins(y=0.15)
        _limit_bar_width(ax, len(at))
    axes[0].legend(ncols=2, fontsize=8)
    figure.supxlabel("nominal baseline, mm", size=9, color=MUTED)
    return figure


def _plot(size: tuple[float, float]) -> tuple[Figure, Axes]:
    figure = Figure(figsize=size, layout="constrained")
    ax = figure.subplots()
    _style(ax)
    return figure, ax


def _style(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(GRID)
    ax.tick_params(colors=MUTED, labelsize=8, length=0)
    ax.grid(axis="y", color=GRID, lw=0.8)
    ax.set_axisbelow(True)
    ax.xaxis.label.set_color(MUTED)
    ax.xaxis.label.set_fontsize(9)
    ax.yaxis.label.set_color(MUTED)
    ax.yaxis.label.set_fontsize(9)
    ax.title.set_fontsize(10)
    ax.title.set_color(INK)


def _limit_bar_width(ax: Axes, count: int) -> None:
    """Limit the width of few bars."""
    half = max(count, _FEWEST_BARS) / 2
    ax.set_xlim((count - 1) / 2 - half, (count - 1) / 2 + half)


def _colour_bar(figure: Figure, image: Any, ax: Any, label: str) -> None:
    bar = figure.colorbar(image, ax=ax, shrink=0.9)
    bar.set_label(label, size=9, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=MUTED, length=0)
    bar.outline.set_visible(False)


def _cells(ax: Axes, values: Any, rig: RigModel, colours: str, limits: tuple[float, float]) -> Any:
    _style(ax)
    ax.grid(False)
    width, height = rig.size
    ax.set_facecolor("#f3f5f7")
    image = ax.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], extent=(0, width, height, 0), aspect="equal")
    ax.set_xticks([0, width])
    ax.set_yticks([0, height])
    return image


def _cell_centre(rig: RigModel, shape: tuple[int, ...], row: int, column: int) -> tuple[float, float]:
    width, height = rig.size
    return (column + 0.5) * width / shape[1], (row + 0.5) * height / shape[0]


def _angles(R_cam0_cam1: Any) -> tuple[float, float, float]:
    """Return pitch (about x), yaw (about y, to the right) and roll (about z) of the right camera in the left, rad."""
    roll, pitch, yaw = rpy_from_R(R_FRD_CAM @ R_cam0_cam1 @ R_FRD_CAM.T)
    return pitch, yaw, roll
