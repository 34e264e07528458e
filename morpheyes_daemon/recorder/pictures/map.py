"""The map of a flight: seen from above, the path in the colours of the baseline, as in the paper's forest figure.

To scale: the path is as wide as the hull, trunks have their true radius. North points right and east down, which is
how a map lies when one looks along the course. Below it, the closest passes enlarged, with the vehicle's outline.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.recorder.pictures.closeups import draw_closeups
from morpheyes_daemon.recorder.pictures.outline import Track, clearances, closest_passes
from morpheyes_daemon.recorder.pictures.scene import ObstacleMap
from morpheyes_daemon.recorder.series import FlightSeries
from morpheyes_daemon.stereo.colours import MAX_BASELINE_M, MIN_BASELINE_M

Points = NDArray[np.float64]
Limits = tuple[float, float, float, float]

WIDTH_IN, LEFT_IN, RIGHT_IN, TOP_IN, AXIS_IN = 10.5, 0.62, 0.2, 0.38, 0.5
LOWER_IN, SCALE_IN, CLOSEUPS = 1.92, 0.75, 3
DPI = 180
BESIDE_PATH_M = 5.0
"""How much of the scene is shown on either side of the path."""
TREE, TREE_EDGE, WALL, WALL_EDGE, GROUND = "#66785f", "#3f4d3a", "#a79a8b", "#6d6257", "#f6f7f2"
RED = "#b3123a"


def draw_map(
    out: Path, series: FlightSeries, scene: ObstacleMap, footprint: Footprint, *, title: str = "", collided: bool = False
) -> None:
    """Write the map of `series` as a PNG; a flight without any position gives a map of the scene alone."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    track = Track.of(series)
    clearance_m = clearances(track, scene, footprint)
    passes = closest_passes(track, clearance_m, CLOSEUPS)
    limits = _limits(track.xy_m, scene)
    inch_per_m = (WIDTH_IN - LEFT_IN - RIGHT_IN) / (limits[1] - limits[0])
    map_in, lower_in = (limits[3] - limits[2]) * inch_per_m, LOWER_IN if passes else SCALE_IN
    figure = Figure(figsize=(WIDTH_IN, TOP_IN + map_in + AXIS_IN + lower_in), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = inches(figure, LEFT_IN, AXIS_IN + lower_in, WIDTH_IN - LEFT_IN - RIGHT_IN, map_in)
    _frame(axes, limits, title)
    draw_scene(axes, scene)
    draw_track(axes, track, footprint, 72 * inch_per_m)
    _draw_marks(axes, series, track, collided=collided)
    _draw_ends(axes, scene)
    _draw_legend(figure, axes, lower_in)
    draw_closeups(figure, axes, track, scene, footprint, [(i, float(clearance_m[i])) for i in passes])
    figure.savefig(out)


def inches(figure: Any, left: float, bottom: float, width: float, height: float) -> Any:
    """Return new axes of `figure` at a place given in inches."""
    w, h = figure.get_size_inches()
    return figure.add_axes((left / w, bottom / h, width / w, height / h))


def _limits(path: Points, scene: ObstacleMap) -> Limits:
    """North from, to, east from, to: path, start and goal with room around."""
    ends = [p for p in (scene.start_m, scene.goal_m) if p is not None]
    points = np.vstack([path.reshape(-1, 2), np.array(ends).reshape(-1, 2)])
    if len(points) == 0:
        points = np.vstack([scene.disc_array()[:, :2], np.zeros((1, 2))])
    (north_0, east_0), (north_1, east_1) = points.min(axis=0), points.max(axis=0)
    room = max(BESIDE_PATH_M, 0.1 * (north_1 - north_0) - 0.5 * (east_1 - east_0))
    along = max(2.5, 3.0 * room - 0.5 * (north_1 - north_0))
    return north_0 - along, north_1 + along, east_0 - room, east_1 + room


def _frame(axes: Any, limits: Limits, title: str) -> None:
    axes.set_xlim(limits[0], limits[1])
    axes.set_ylim(limits[3], limits[2])
    axes.set_xlabel("north [m]", fontsize=9)
    axes.set_ylabel("east [m]", fontsize=9, labelpad=1)
    axes.tick_params(labelsize=8, length=3, color="#888888")
    axes.yaxis.get_major_locator().set_params(integer=True)
    quiet(axes)
    axes.set_title(title, fontsize=10, loc="left", pad=6)


def quiet(axes: Any) -> None:
    """Pale ground and thin grey borders."""
    axes.set_facecolor(GROUND)
    for spine in axes.spines.values():
        spine.set_color("#888888")
        spine.set_linewidth(0.8)


def draw_scene(axes: Any, scene: ObstacleMap) -> None:
    """Draw trunks and walls to scale."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle
    from matplotlib.patches import Polygon as Patch

    trunks = [Circle((d.x_m, d.y_m), d.radius_m) for d in scene.discs]
    walls = [Patch(corners, closed=True) for corners in scene.polygons]
    axes.add_collection(PatchCollection(trunks, facecolor=TREE, edgecolor=TREE_EDGE, linewidth=0.6, zorder=3))
    axes.add_collection(PatchCollection(walls, facecolor=WALL, edgecolor=WALL_EDGE, linewidth=0.6, zorder=3))


def draw_track(axes: Any, track: Track, footprint: Footprint, points_per_m: float) -> None:
    """Draw the path as wide as the hull, in the colours of the baseline."""
    from matplotlib.collections import LineCollection

    if len(track) < 2:
        return
    width = max(2.0, footprint.hull_width_mm / 1e3 * points_per_m)
    x, y = track.xy_m.T
    axes.plot(x, y, color="#30343a", linewidth=width + 0.9, solid_capstyle="round", solid_joinstyle="round", zorder=4)
    pieces = np.stack([track.xy_m[:-1], track.xy_m[1:]], axis=1)
    line = LineCollection(list(pieces), cmap="jet", linewidth=width, capstyle="round", zorder=5)
    line.set_array(1e3 * track.baseline_m[:-1])
    line.set_clim(1e3 * MIN_BASELINE_M, 1e3 * MAX_BASELINE_M)
    axes.add_collection(line)


def _draw_marks(axes: Any, series: FlightSeries, track: Track, *, collided: bool) -> None:
    if len(track) == 0:
        return
    style = {"linestyle": "none", "markeredgecolor": RED, "markersize": 6, "markeredgewidth": 1.3, "zorder": 7}
    for times, fill, label in ((series.stops(), "white", "stopped to look"), (series.braking(), RED, "braked")):
        if times:
            where = track.xy_m[[track.nearest(t) for t, _ in times]]
            axes.plot(where[:, 0], where[:, 1], marker="v", color=fill, label=label, **style)
    if collided:
        style = {"color": RED, "markeredgecolor": "white", "markersize": 12}
        axes.plot(*track.xy_m[-1], "X", zorder=8, label="collided", **style)


def _draw_ends(axes: Any, scene: ObstacleMap) -> None:
    style = {"linestyle": "none", "markeredgecolor": "black", "zorder": 6}
    if scene.start_m is not None:
        axes.plot(*scene.start_m, marker="o", color="white", markersize=8, label="start", **style)
    if scene.goal_m is not None:
        axes.plot(*scene.goal_m, marker="*", color="#ffd23f", markersize=15, label="goal", **style)


def _draw_legend(figure: Any, axes: Any, lower_in: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(1e3 * MIN_BASELINE_M, 1e3 * MAX_BASELINE_M), cmap="jet")
    bar = figure.colorbar(scale, cax=inches(figure, LEFT_IN, lower_in - 0.3, 3.2, 0.13), orientation="horizontal")
    bar.set_label("baseline [mm]", fontsize=9, labelpad=2)
    bar.ax.tick_params(labelsize=8, length=2)
    bar.outline.set_linewidth(0.5)
    w, h = figure.get_size_inches()
    if axes.get_legend_handles_labels()[0]:
        beside = ((LEFT_IN - 0.1) / w, (lower_in - 1.05) / h) if lower_in > 1 else (0.45, (lower_in - 0.45) / h)
        figure.legend(
            loc="center left",
            bbox_to_anchor=beside,
            ncol=4,
            fontsize=9,
            frameon=False,
            handletextpad=0.2,
            columnspacing=1.2,
        )
