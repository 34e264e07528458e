"""Enlarged pieces of the map where the vehicle came nearest to something, with its outline every few centimetres."""

from __future__ import annotations

from typing import Any

import numpy as np

from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.recorder.pictures.outline import Track, boxes, placed
from morpheyes_daemon.recorder.pictures.scene import ObstacleMap
from morpheyes_daemon.stereo.colours import baseline_bgr

LEFT_IN, BOTTOM_IN, WIDTH_IN, HEIGHT_IN, APART_IN = 4.3, 0.12, 1.9, 1.48, 0.15
NORTH_M = 3.2
EVERY_M = 0.45
INK = "#30343a"
NEAREST = {"lw": 1.2, "alpha": 1.0, "zorder": 6}
AROUND = {"lw": 0.6, "alpha": 0.6, "zorder": 4}
PLATE = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
CIRCLE = {"boxstyle": "circle,pad=0.18", "facecolor": "white", "edgecolor": INK, "linewidth": 0.7}


def draw_closeups(
    figure: Any, axes: Any, track: Track, scene: ObstacleMap, footprint: Footprint, passes: list[tuple[int, float]]
) -> None:
    """Draw one panel for each pass (index into the track, clearance in metres), lettered on the map as well."""
    w, h = figure.get_size_inches()
    for n, (i, clearance_m) in enumerate(passes):
        left = LEFT_IN + n * (WIDTH_IN + APART_IN)
        panel = figure.add_axes((left / w, BOTTOM_IN / h, WIDTH_IN / w, HEIGHT_IN / h))
        _frame(panel, track, i)
        _draw(panel, track, scene, footprint, i)
        letter = "abcdef"[n]
        room = f"{1e2 * clearance_m:.0f} cm" if clearance_m > 0 else "touched"
        panel.text(
            0.03, 0.95, f"{letter}   {room}", transform=panel.transAxes, va="top", fontsize=9, bbox=PLATE, zorder=9
        )
        _letter(axes, track, scene, i, letter)
    if passes:
        text = "closest passes: outline to trunk"
        figure.text(LEFT_IN / w, (BOTTOM_IN + HEIGHT_IN + 0.07) / h, text, fontsize=9, va="bottom")


def _frame(panel: Any, track: Track, i: int) -> None:
    (x, y), half = track.xy_m[i], NORTH_M / 2
    tall = half * HEIGHT_IN / WIDTH_IN
    panel.set_xlim(x - half, x + half)
    panel.set_ylim(y + tall, y - tall)
    panel.set_xticks([])
    panel.set_yticks([])
    panel.set_facecolor("#f6f7f2")
    for spine in panel.spines.values():
        spine.set_color("#888888")
        spine.set_linewidth(0.8)
    panel.plot([x + half - 1.15, x + half - 0.15], [y + tall - 0.14] * 2, color=INK, linewidth=1.6, zorder=9)
    panel.text(x + half - 0.65, y + tall - 0.2, "1 m", ha="center", va="bottom", fontsize=7.5, color=INK, zorder=9)


def _draw(panel: Any, track: Track, scene: ObstacleMap, footprint: Footprint, i: int) -> None:
    from matplotlib.patches import Circle, Polygon

    for disc in scene.discs:
        panel.add_patch(Circle((disc.x_m, disc.y_m), disc.radius_m, facecolor="#66785f", edgecolor="#3f4d3a", lw=0.8))
    for corners in scene.polygons:
        panel.add_patch(Polygon(corners, closed=True, facecolor="#a79a8b", edgecolor="#6d6257", lw=0.8))
    panel.plot(*track.xy_m.T, color="#9aa1ab", linewidth=0.8, zorder=2)
    around = track.spaced(i, EVERY_M, 6)
    for j in range(len(around)):
        _draw_vehicle(panel, around, j, footprint, AROUND)
    _draw_vehicle(panel, track, i, footprint, NEAREST)


def _draw_vehicle(panel: Any, track: Track, j: int, footprint: Footprint, strength: dict[str, Any]) -> None:
    from matplotlib.patches import Polygon

    baseline_m, at, yaw = float(track.baseline_m[j]), track.xy_m[j], float(track.yaw_rad[j])
    hull, bar = boxes(footprint, baseline_m)
    b, g, r = (c / 255 for c in baseline_bgr(baseline_m))
    panel.add_patch(Polygon(placed(hull, at, yaw), facecolor="white", edgecolor=INK, **strength))
    panel.add_patch(Polygon(placed(bar, at, yaw), facecolor=(r, g, b), edgecolor=INK, **{**strength, "lw": 0.5}))


def _letter(axes: Any, track: Track, scene: ObstacleMap, i: int, letter: str) -> None:
    """Letter the pass on the map, on the side of the path that is away from the trunk."""
    x, y = track.xy_m[i]
    discs = scene.disc_array()
    nearest = discs[np.argmin(np.hypot(discs[:, 0] - x, discs[:, 1] - y) - discs[:, 2])]
    up = 14 if nearest[1] > y else -14
    axes.annotate(
        letter,
        (x, y),
        xytext=(0, up),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=9,
        bbox=CIRCLE,
        zorder=9,
    )
