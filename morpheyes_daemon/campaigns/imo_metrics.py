"""What a moving-object flight is measured by: in which frames the object was found, and how far off its depth was.

Looks on at a simulated flight with the simulator's truth; the daemon hears nothing of it. The object counts as found
when this very frame's measurement lies within max(0.3 m, 5 % of its depth) of the middle of the visible face. The
truth of depth is the median over the pixels of the visible face, along the rectified left eye's axis.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.daemon.composition import Daemon
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.messages.core import Perception, Pinhole, StereoFrame, Track
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.simulation.worlds.loader import load_world
from morpheyes_daemon.simulation.worlds.room_world import RoomWorld
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.stereo.rectify import Rectifier
from morpheyes_daemon.strategies.imo.strategy import ImoPercept
from morpheyes_daemon.transforms import Array, inverse, pose

NEAR_ENOUGH_M, NEAR_ENOUGH_SHARE = 0.3, 0.05
MOVES_M_S = 0.02
"""Slower than this the object stands, and need not be found."""

IN_VIEW = 0.5
"""Share of the visible face that must lie in the left image for the frame to count."""

FRAMES_KEPT = 16
GRID_PX = 2


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """The visible face in one frame: its middle point (3,) in rect axes at its median depth, and its share in view."""

    p_rect: Array
    in_view: float


@dataclass(frozen=True, slots=True)
class Sample:
    """One frame that counts: when, the true and the measured depth (None: not found), and the true baseline."""

    t_s: float
    true_m: float
    measured_m: float | None
    baseline_m: float


class ImoMeasures:
    """Attach to a flight's watchers; `row` afterwards."""

    def __init__(self, plan: FlightPlan) -> None:
        size = (plan.config.camera.width_px, plan.config.camera.height_px)
        self._rectifier = Rectifier(read_calibration(plan.calibration), size)
        world = load_world(plan.scenario.world).world
        room = world if isinstance(world, RoomWorld) else None
        self._edge_m = room.cube.edge_mm / 1e3 if room and room.cube else 0.0
        self._columns = _columns(room) if room else []
        self._frames: dict[int, StereoFrame] = {}
        self._samples: list[Sample] = []
        self._watched = 0
        self._false = 0

    def attach(self, daemon: Daemon, stage: SimVehicle) -> None:
        """Look on at this flight."""
        daemon.topics.frame.tap(self._keep)
        daemon.topics.perception.tap(lambda seen: self._compare(seen, daemon, stage))

    def row(self) -> dict[str, Any]:
        """Return the columns of a moving-object flight."""
        found = [s for s in self._samples if s.measured_m is not None]
        errors = [_error(s) for s in found]
        return {
            "frames_with_object": len(self._samples),
            "detected": len(found),
            "detection_rate": round(len(found) / len(self._samples), 4) if self._samples else None,
            "median_rel_error": percentile(errors, 50),
            "p95_rel_error": percentile(errors, 95),
            "longest_loss_s": _longest_loss_s(self._samples),
            "frames_watched": self._watched,
            "false_frames": self._false,
            "range_bins": range_bins(self._samples),
            "samples": [
                [round(s.t_s, 2), round(s.true_m, 4), s.measured_m and round(s.measured_m, 4), round(s.baseline_m, 4)]
                for s in self._samples
            ],
        }

    def _keep(self, frame: StereoFrame) -> None:
        self._frames[frame.seq] = frame
        while len(self._frames) > FRAMES_KEPT:
            del self._frames[next(iter(self._frames))]

    def _compare(self, seen: Perception, daemon: Daemon, stage: SimVehicle) -> None:
        frame = self._frames.get(seen.summary.seq)
        if daemon.monitor.state is not State.ENGAGED or frame is None or not isinstance(seen.percept, ImoPercept):
            return
        self._watched += 1
        face, track = self._face(frame, stage), seen.percept.track
        found = track is not None and track.seen and face is not None and _is_it(track, face)
        self._false += track is not None and track.seen and not found
        if face is not None and face.in_view >= IN_VIEW and self._moves(frame, stage):
            measured = track.p_rect_m[2] if found and track is not None else None
            t_s = stage.world_s(frame.t_ns)
            self._samples.append(Sample(t_s, float(face.p_rect[2]), measured, stage.baseline_m(frame.t_ns)))

    def _moves(self, frame: StereoFrame, stage: SimVehicle) -> bool:
        t_s = stage.world_s(frame.t_ns)
        T = stage.world.scene.moving[0].T_ned_object
        return bool(np.linalg.norm(T(t_s)[:3, 3] - T(t_s - 0.1)[:3, 3]) > 0.1 * MOVES_M_S)

    def _face(self, frame: StereoFrame, stage: SimVehicle) -> Face | None:
        """Return what the left eye really sees of the object at the frame's exposure."""
        if not stage.world.scene.moving or not self._edge_m:
            return None
        rectified = self._rectifier.at(frame.baseline.baseline_m)
        t_ns = frame.t_ns
        T_ned_cam0 = stage.camera.T_ned_eye(0, stage.truth(t_ns).T_ned_frd, stage.baseline_m(t_ns))
        T_ned_rect = T_ned_cam0 @ inverse(pose(rectified.R_rect_cam0, np.zeros(3)))
        T_ned_object = stage.world.scene.moving[0].T_ned_object(stage.world_s(t_ns))
        return visible_face(T_ned_rect, rectified.pinhole, T_ned_object, self._edge_m, self._columns)


def visible_face(
    T_ned_rect: Array, pinhole: Pinhole, T_ned_cube: Array, edge_m: float, columns: list[tuple[Array, Array]]
) -> Face | None:
    """Return the cube's visible face seen from a pose (4, 4), None when nothing of it is in view.

    `columns` are boxes (pose, edges (3,)) that may hide it. What lies outside the image counts for its share in view.
    """
    T_rect_cube = inverse(T_ned_rect) @ T_ned_cube
    middle = T_rect_cube[:3, 3]
    if middle[2] <= 0.05:
        return None
    reach_px = edge_m * pinhole.f_px / max(float(middle[2]) - 0.87 * edge_m, 0.1) + 2
    u0 = pinhole.f_px * middle[0] / middle[2] + pinhole.cx_px
    v0 = pinhole.f_px * middle[1] / middle[2] + pinhole.cy_px
    step = GRID_PX if reach_px > 40 else 0.5
    u, v = np.meshgrid(np.arange(u0 - reach_px, u0 + reach_px, step), np.arange(v0 - reach_px, v0 + reach_px, step))
    rays = np.stack([(u - pinhole.cx_px) / pinhole.f_px, (v - pinhole.cy_px) / pinhole.f_px, np.ones_like(u)], axis=-1)
    depth = _box_depth(rays, inverse(T_rect_cube), np.full(3, edge_m))
    whole = np.isfinite(depth)
    for T_ned_box, edges in columns:
        whole &= ~(_box_depth(rays, inverse(T_ned_box) @ T_ned_rect, edges) < depth)
    inside = whole & (u >= 0) & (u <= pinhole.width - 1) & (v >= 0) & (v <= pinhole.height - 1)
    if not inside.any():
        return None
    z = float(np.median(depth[inside]))
    x, y = float(rays[..., 0][inside].mean()) * z, float(rays[..., 1][inside].mean()) * z
    return Face(np.array([x, y, z]), float(inside.sum() / np.isfinite(depth).sum()))


def range_bins(samples: list[Sample]) -> list[dict[str, Any]]:
    """Return one row per metre of true depth: frames, how many found, median and 95th percentile of the error."""
    rows = []
    for start in sorted({int(s.true_m) for s in samples}):
        here = [s for s in samples if int(s.true_m) == start]
        errors = [_error(s) for s in here if s.measured_m is not None]
        rows.append(
            {
                "from_m": start,
                "to_m": start + 1,
                "frames": len(here),
                "detected": len(errors),
                "median_rel_error": percentile(errors, 50),
                "p95_rel_error": percentile(errors, 95),
            }
        )
    return rows


def percentile(values: list[float], share_pct: float) -> float | None:
    """Return a percentile, None of nothing."""
    return round(float(np.percentile(values, share_pct)), 5) if values else None


def _is_it(track: Track, face: Face) -> bool:
    off_m = float(np.linalg.norm(np.array(track.p_rect_m) - face.p_rect))
    return off_m < max(NEAR_ENOUGH_M, NEAR_ENOUGH_SHARE * float(face.p_rect[2]))


def _error(sample: Sample) -> float:
    assert sample.measured_m is not None
    return abs(sample.measured_m - sample.true_m) / sample.true_m


def _longest_loss_s(samples: list[Sample]) -> float:
    """Return the longest time between two frames in which the object was found."""
    times = [s.t_s for s in samples if s.measured_m is not None]
    return round(max((b - a for a, b in itertools.pairwise(times)), default=0.0), 2)


def _box_depth(rays: Array, T_box_eye: Array, edges_m: Array) -> NDArray[np.float64]:
    """Return the depth (...) at which rays (..., 3) with z = 1 enter a box, inf where they miss it (slab method)."""
    origin, directions = T_box_eye[:3, 3], rays @ T_box_eye[:3, :3].T
    with np.errstate(divide="ignore"):
        a, b = (-edges_m / 2 - origin) / directions, (edges_m / 2 - origin) / directions
    first, last = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    return np.where((first < last) & (first > 0.0), first, np.inf)


def _columns(room: RoomWorld) -> list[tuple[Array, Array]]:
    return [
        (pose(np.eye(3), np.array([x, y, -room.height_m / 2])), np.array([edge, edge, room.height_m]))
        for x, y, edge in room.pillars
    ]
