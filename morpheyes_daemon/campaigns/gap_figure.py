"""Sequences through the gaps, as the paper's figure: the vehicle on its way, in the colours of the baseline.

Above, along the way, with the true opening and the vehicle's silhouettes in the wall's own frame, to scale; below,
from the side. Opacity grows with time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morpheyes_daemon.campaigns.forest_table import Row
from morpheyes_daemon.campaigns.gap_metrics import BEFORE_M, BEHIND_M
from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import Footprint, Mount
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.simulation.worlds.gap_world import GapWorld, gap_truth
from morpheyes_daemon.simulation.worlds.loader import load_world
from morpheyes_daemon.stereo.colours import baseline_bgr
from morpheyes_daemon.transforms import Array, R_from_rpy, pose

WALL_COLOUR, OPEN_COLOUR = "#a79a8b", "#f6f7f2"
AROUND_M = 0.75
COLUMN_IN, DPI = 3.2, 150


def draw_sequences(out: Path, plan: FlightPlan, rows: Sequence[Row]) -> bool:
    """Write one column for the first flight through every shape; False when there is none to draw."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    world = load_world(plan.scenario.world).world
    shown: dict[str, Row] = {}
    for row in rows:
        if row["outcome"] == "reached" and row["sequence"]:
            shown.setdefault(row["shape"], row)
    if not isinstance(world, GapWorld) or not shown:
        return False
    figure = Figure(figsize=(COLUMN_IN * len(shown), 4.6), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(shown), squeeze=False, height_ratios=(2, 1))
    for column, (shape, row) in enumerate(shown.items()):
        truth = gap_truth(world, row["seed"])
        outline = min(truth.outlines, key=lambda corners: _off(corners, row["sequence"]))
        _draw_along(axes[0][column], outline, row["sequence"], plan.config.footprint, plan.config.camera.mount)
        _draw_side(axes[1][column], outline, row["sequence"], plan.config.footprint, plan.config.camera.mount)
        speed, room = row["crossing_speed_m_s"], row["clearance_m"]
        axes[0][column].set_title(f"{shape}, seed {row['seed']}: {speed:.2f} m/s, {room * 1e3:.0f} mm", fontsize=8)
    figure.savefig(out)
    return True


def _off(corners: Array, sequence: Sequence[Sequence[float]]) -> float:
    """Distance of an opening from where the vehicle went through the wall."""
    through = min(sequence, key=lambda entry: abs(entry[0]))
    return float(np.linalg.norm(corners.mean(axis=0) - through[1:3]))


def _draw_along(
    axes: Any, outline: Array, sequence: Sequence[Sequence[float]], footprint: Footprint, mount: Mount
) -> None:
    middle = outline.mean(axis=0)
    axes.set_facecolor(WALL_COLOUR)
    axes.fill(outline[:, 0], outline[:, 1], color=OPEN_COLOUR, zorder=1)
    _draw_vehicles(axes, sequence, footprint, mount, (1, 2))
    _frame(axes, (middle[0] - AROUND_M, middle[0] + AROUND_M), (middle[1] + AROUND_M, middle[1] - AROUND_M))


def _draw_side(
    axes: Any, outline: Array, sequence: Sequence[Sequence[float]], footprint: Footprint, mount: Mount
) -> None:
    top, bottom = float(outline[:, 1].min()), float(outline[:, 1].max())
    middle = 0.5 * (top + bottom)
    for low, high in ((middle - 2, top), (bottom, middle + 2)):
        axes.fill_between((-0.03, 0.03), low, high, color=WALL_COLOUR)
    _draw_vehicles(axes, sequence, footprint, mount, (0, 2))
    _frame(axes, (-BEFORE_M - 0.2, BEHIND_M + 0.3), (middle + 0.8, middle - 0.8))


def _draw_vehicles(
    axes: Any, sequence: Sequence[Sequence[float]], footprint: Footprint, mount: Mount, plane: tuple[int, int]
) -> None:
    for number, entry in enumerate(sequence):
        blue, green, red = (channel / 255 for channel in baseline_bgr(entry[6]))
        alpha = 0.25 + 0.75 * (number + 1) / len(sequence)
        for corners in silhouettes(entry, footprint, mount):
            flat = cv2.convexHull(corners[:, plane].astype(np.float32))[:, 0]
            face, edge = (red, green, blue, 0.35 * alpha), (red, green, blue, alpha)
            axes.fill(flat[:, 0], flat[:, 1], facecolor=face, edgecolor=edge, linewidth=0.8, zorder=2)


def silhouettes(entry: Sequence[float], footprint: Footprint, mount: Mount) -> tuple[Array, Array]:
    """Return corners (n, 3) of hull and bar in the wall's frame for a pose x, y, z, roll, pitch, yaw and baseline."""
    T = pose(R_from_rpy(entry[3], entry[4], entry[5]), np.array(entry[:3]))
    angle = np.linspace(0.0, 2 * np.pi, 33)
    length, width, height = (size / 2e3 for size in (footprint.hull_length_mm, footprint.hull_width_mm,
                                                     footprint.hull_height_mm))  # fmt: skip
    ring = np.stack([length * np.cos(angle), width * np.sin(angle)], axis=1)
    hull = np.concatenate([np.column_stack([ring, np.full(len(ring), side)]) for side in (-height, height)])
    half = np.array([1e3 * entry[6] + footprint.camera_width_mm, footprint.bar_height_mm, footprint.bar_depth_mm]) / 2e3
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    bar = np.column_stack([signs * half, np.ones(8)]) @ T_frd_rig(mount).T
    return hull @ T[:3, :3].T + T[:3, 3], bar[:, :3] @ T[:3, :3].T + T[:3, 3]


def _frame(axes: Any, across: tuple[float, float], down: tuple[float, float]) -> None:
    axes.set_xlim(*across)
    axes.set_ylim(*down)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=6)
