"""The vehicle from above, hull and stereo bar as two boxes, and how near it came to the trunks.

Two-dimensional and level: the simulator's own collision check is the exact one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.recorder.pictures.scene import ObstacleMap
from morpheyes_daemon.recorder.series import FlightSeries

Array = NDArray[np.float64]
BAR_FORWARD_M = 0.09


@dataclass(frozen=True, slots=True)
class Track:
    """The flight from above: times (N,), north and east (N, 2), heading (N,), baseline (N,)."""

    times_s: Array
    xy_m: Array
    yaw_rad: Array
    baseline_m: Array

    @classmethod
    def of(cls, series: FlightSeries) -> Track:
        """Return the track of a flight; baseline NaN where unknown."""
        times_s, path = series.path_ned_m()
        yaw, baseline = series.at(times_s, "vehicle", "yaw_rad"), series.at(times_s, "baseline", "baseline_m")
        return cls(times_s, path[:, :2], yaw, baseline)

    def __len__(self) -> int:
        return len(self.times_s)

    def nearest(self, time_s: float) -> int:
        """Return the index of the sample nearest in time."""
        return int(np.argmin(np.abs(self.times_s - time_s)))

    def spaced(self, i: int, apart_m: float, count: int) -> Track:
        """Return the track around sample `i`, `count` samples to either side, `apart_m` of path from each other."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.xy_m, axis=0), axis=1))])
        wanted = along[i] + apart_m * np.arange(-count, count + 1)
        wanted = wanted[(wanted >= along[0]) & (wanted <= along[-1])]
        x, y, t, yaw, baseline = (
            np.interp(wanted, along, column)
            for column in (self.xy_m[:, 0], self.xy_m[:, 1], self.times_s, self.yaw_rad, self.baseline_m)
        )
        return Track(t, np.stack([x, y], axis=1), yaw, baseline)


def boxes(footprint: Footprint, baseline_m: float) -> tuple[Array, Array]:
    """Return the corners (4, 2) of hull and bar in the body frame: forward, right."""
    hull = _box(0.0, footprint.hull_length_mm / 1e3, footprint.hull_width_mm / 1e3)
    width_m = (0.0 if math.isnan(baseline_m) else baseline_m) + footprint.camera_width_mm / 1e3
    return hull, _box(BAR_FORWARD_M, footprint.bar_depth_mm / 1e3, width_m)


def _box(forward_m: float, length_m: float, width_m: float) -> Array:
    half_l, half_w = length_m / 2, width_m / 2
    corners = [(half_l, -half_w), (half_l, half_w), (-half_l, half_w), (-half_l, -half_w)]
    return np.asarray(np.array(corners) + np.array([forward_m, 0.0]))


def placed(box: Array, xy_m: Array, yaw_rad: float) -> Array:
    """Return body-frame corners (4, 2) as north and east."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.asarray(box @ np.array([[c, s], [-s, c]]) + xy_m)


def clearances(track: Track, scene: ObstacleMap, footprint: Footprint) -> Array:
    """Return (N,) metres between the vehicle's boxes and the nearest disc, inf without discs."""
    discs = scene.disc_array()
    if len(discs) == 0:
        return np.full(len(track), np.inf)
    offset = discs[None, :, :2] - track.xy_m[:, None, :]
    c, s = np.cos(track.yaw_rad)[:, None], np.sin(track.yaw_rad)[:, None]
    forward, right = c * offset[..., 0] + s * offset[..., 1], -s * offset[..., 0] + c * offset[..., 1]
    hull = _distance(forward, right, footprint.hull_length_mm / 2e3, footprint.hull_width_mm / 2e3)
    half_bar = (np.nan_to_num(track.baseline_m) + footprint.camera_width_mm / 1e3)[:, None] / 2
    bar = _distance(forward - BAR_FORWARD_M, right, footprint.bar_depth_mm / 2e3, half_bar)
    return np.asarray((np.minimum(hull, bar) - discs[None, :, 2]).min(axis=1))


def _distance(x: Array, y: Array, half_x: float, half_y: float | Array) -> Array:
    """Distance of points to a box around the origin, 0 inside."""
    return np.hypot(np.maximum(np.abs(x) - half_x, 0.0), np.maximum(np.abs(y) - half_y, 0.0))


def closest_passes(
    track: Track, clearance_m: Array, count: int, apart_m: float = 4.0, within_m: float = 1.5
) -> list[int]:
    """Return the indices of at most `count` passes nearer than `within_m`, in order of flight and `apart_m` apart."""
    chosen: list[int] = []
    for i in np.argsort(clearance_m, kind="stable"):
        if clearance_m[i] >= within_m:
            break
        if all(np.linalg.norm(track.xy_m[i] - track.xy_m[j]) >= apart_m for j in chosen):
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return sorted(chosen)
