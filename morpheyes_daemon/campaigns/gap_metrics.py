"""What a gap flight is measured by, beside what every flight is: how it went through, and how well it saw the opening.

Looks on at a simulated flight with the simulator's truth; the daemon hears nothing of it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from morpheyes_daemon.campaigns.gap_ground_truth import filled, iou, true_masks
from morpheyes_daemon.daemon.composition import Daemon
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.messages.core import Perception, StereoFrame
from morpheyes_daemon.messages.safety import GateOutput, State
from morpheyes_daemon.simulation.worlds.gap_world import GapWorld, drawn_shape
from morpheyes_daemon.simulation.worlds.loader import load_world
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.stereo.rectify import Rectifier
from morpheyes_daemon.strategies.gap.perception import GapPercept
from morpheyes_daemon.transforms import Array, inverse, rpy_from_R

BESIDE_M = 0.6
"""The vehicle's centre this near to the wall's plane: it is in the opening."""

BEFORE_M, BEHIND_M, APART_M = 6.8, 2.6, 0.5
"""The stretch of the way that the figure shows, and how far apart the vehicles in it are."""

FRAMES_KEPT = 16


class GapMeasures:
    """Attach to a flight's watchers; `row` afterwards."""

    def __init__(self, plan: FlightPlan) -> None:
        size = (plan.config.camera.width_px, plan.config.camera.height_px)
        self._rectifier = Rectifier(read_calibration(plan.calibration), size)
        self._plan = plan
        self._frames: dict[int, StereoFrame] = {}
        self._ious: list[float] = []
        self._clearance_m = math.inf
        self._crossing_m_s = math.nan
        self._before_m = math.nan
        self._sequence: list[list[float]] = []

    def attach(self, daemon: Daemon, stage: SimVehicle) -> None:
        """Look on at this flight."""
        daemon.topics.frame.tap(self._keep)
        daemon.topics.perception.tap(lambda seen: self._compare(seen, daemon, stage))
        daemon.topics.gate.tap(lambda out: self._watch(out, stage))

    def row(self) -> dict[str, Any]:
        """Return the columns of a gap flight."""
        shape, motion = _world_of(self._plan)
        return {
            "clearance_m": _rounded(self._clearance_m),
            "crossing_speed_m_s": _rounded(self._crossing_m_s),
            "contour_iou": _rounded(float(np.median(self._ious)) if self._ious else math.nan),
            "shape": shape,
            "motion": motion,
            "sequence": self._sequence,
        }

    def _keep(self, frame: StereoFrame) -> None:
        self._frames[frame.seq] = frame
        while len(self._frames) > FRAMES_KEPT:
            del self._frames[next(iter(self._frames))]

    def _compare(self, seen: Perception, daemon: Daemon, stage: SimVehicle) -> None:
        """Hold every opening seen whole against the true one that it covers best, until the wall is behind."""
        frame = self._frames.get(seen.summary.seq)
        if daemon.monitor.state is not State.ENGAGED or frame is None or not isinstance(seen.percept, GapPercept):
            return
        openings = [opening for opening in seen.percept.openings if not opening.cut]
        gap, t_ns = stage.world.gaps[0], frame.t_ns
        T_ned_wall = gap.T_ned_wall(stage.world_s(t_ns))
        T_ned_frd = stage.truth(t_ns).T_ned_frd
        if not openings or _past_wall_m(T_ned_wall, T_ned_frd) > 0.0:
            return
        rectified = self._rectifier.at(frame.baseline.baseline_m)
        T_ned_cam0 = stage.camera.T_ned_eye(0, T_ned_frd, stage.baseline_m(t_ns))
        masks = true_masks(gap, T_ned_wall, T_ned_cam0, rectified)
        for opening in openings:
            contour = filled(opening.contour_px, rectified.pinhole)
            self._ious.append(max(iou(contour, mask) for mask in masks))

    def _watch(self, out: GateOutput, stage: SimVehicle) -> None:
        gap = stage.world.gaps[0]
        truth = stage.truth(out.t_ns)
        T_wall_frd = inverse(gap.T_ned_wall(stage.world_s(out.t_ns))) @ truth.T_ned_frd
        past_m = float(T_wall_frd[0, 3])
        if self._before_m < 0.0 <= past_m:
            self._crossing_m_s = math.hypot(*truth.v_ned_m_s)
        self._before_m = past_m
        self._note(T_wall_frd, stage.baseline_m(out.t_ns))
        if abs(past_m) < BESIDE_M:
            self._clearance_m = min(self._clearance_m, stage.clearance_m(out.t_ns))

    def _note(self, T_wall_frd: Array, baseline_m: float) -> None:
        """Keep a pose for the figure wherever the vehicle has come on by `APART_M` towards the wall or behind it."""
        x, y, z = (float(c) for c in T_wall_frd[:3, 3])
        if -BEFORE_M < x < BEHIND_M and (not self._sequence or x > self._sequence[-1][0] + APART_M):
            pose = (x, y, z, *rpy_from_R(T_wall_frd[:3, :3]), baseline_m)
            self._sequence.append([round(value, 4) for value in pose])


def _past_wall_m(T_ned_wall: Array, T_ned_frd: Array) -> float:
    """Return how far the vehicle's centre is behind the wall's middle plane."""
    return float((inverse(T_ned_wall) @ T_ned_frd)[0, 3])


def _world_of(plan: FlightPlan) -> tuple[str, str]:
    """Return the shapes and the motion of the wall that the plan flies at."""
    world = load_world(plan.scenario.world).world
    if not isinstance(world, GapWorld):
        return "", ""
    shapes = [drawn_shape(opening.shape, plan.scenario.seed) for opening in world.openings]
    return "+".join(shapes), world.motion.kind


def _rounded(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
