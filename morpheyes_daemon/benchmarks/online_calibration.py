"""What the drift watch makes of a rig that was bent, and of eyes that expose at different times, against the truth.

Both trials render the forest before the twin and feed the watch what it gets in flight; the bent rig stands still and
changes its baseline, the late one flies with the shaking of a small vehicle. The daemon around the watch is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from morpheyes_daemon.benchmarks.calibration_error import evaluate_rig
from morpheyes_daemon.clock import S
from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import Mount, ServoMotion
from morpheyes_daemon.messages.core import BaselineEstimate, StereoFrame, VehicleState
from morpheyes_daemon.perception.camera_motion import CameraMotion, camera_motion
from morpheyes_daemon.perception.extrinsics_monitor import ExtrinsicsLimits, ExtrinsicsMonitor, ExtrinsicsReport
from morpheyes_daemon.perception.yaw_estimator import STATIONARY, MotionUncertainty
from morpheyes_daemon.progress import Progress, silent
from morpheyes_daemon.simulation.camera.stereo_camera import CameraTwin, Sensor
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.simulation.rendering.renderer import Renderer
from morpheyes_daemon.simulation.worlds.loader import build_world, load_world
from morpheyes_daemon.stereo.depth import DepthEstimator, disparity_of
from morpheyes_daemon.stereo.epipolar import row_offsets
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import Array, R_from_rpy, pose

BENT_DEG = 0.15
LATE_S = (1e-3, 2e-3, 5e-3, 10e-3)
FRAMES = 20
_PLACES_M = (0.1, 0.3)
_FIRST_PLACE = 12
"""Frames at the first baseline; the rest is at the second."""
_HEIGHT_M = 1.2
_RATE_HZ = 10.0
_RUN_UP_M = np.array([4.0, 0.0, 0.0])
"""The flight begins before the start, so that it ends before the first trees."""
_RATE_SIGMA_RAD_S, _SPEED_SIGMA_M_S = 0.2, 0.1
"""How far the autopilot's turn rate (vibration) and velocity are off, as in the simulated flights."""


@dataclass(frozen=True, slots=True)
class DriftTrial:
    """A rig bent after calibration: frames until the turn was noticed and until all was corrected, and what is left.

    Frames are None when it did not happen; errors are the twin's truth at 41 baselines, before and after.
    """

    bent_pitch_deg: float
    bent_yaw_deg: float
    noticed_after: int | None
    pitch_corrected_after: int | None
    yaw_corrected_after: int | None
    before_epipolar_median_px: float
    before_disparity_bias_px: float
    epipolar_median_px: float
    disparity_bias_px: float
    said: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LateTrial:
    """A time between the eyes, what was measured of it in flight (one sigma), and whether it ends trust in depth."""

    true_ms: float
    measured_ms: float
    sigma_ms: float
    ends_trust: bool


class _Watched:
    """The watch with what it needs around it: camera twin, depth, rig as corrected so far."""

    def __init__(
        self, rig: RigModel, twin: RigTwin, time_offset_s: float, seed: int, uncertain: MotionUncertainty | None
    ) -> None:
        world = build_world(load_world("forest"), seed)
        north, east, _ = world.start_ned_m
        self.start_ned_m = np.array([north, east, -_HEIGHT_M])
        self._twin = twin
        self._camera = CameraTwin(Renderer(world.scene), twin, Mount(), Sensor(sync_offset_s=time_offset_s), seed)
        self.monitor = ExtrinsicsMonitor(rig, ExtrinsicsLimits(), uncertain)
        self._estimator = DepthEstimator(rig)

    def look(
        self, seq: int, t_ns: int, nominal_m: float, pose_at: Callable[[int], Array], state: VehicleState | None
    ) -> ExtrinsicsReport:
        """Take one pair and have it watched; a `state` of None is a vehicle that stands."""
        pair = self._camera.render_pair(t_ns, seq, pose_at, self._twin.actual_m(nominal_m))
        sigma_m = ServoMotion().repeatability_sigma_mm / 1e3
        at = BaselineEstimate(t_ns, nominal_m, nominal_m, sigma_m, False)
        frame = StereoFrame(seq, t_ns, pair.left, pair.right, at)
        rectified = self._estimator.rectified(frame)
        depth = self._estimator.depth(frame, rectified)
        offsets = row_offsets(rectified.left, rectified.right, disparity_of(depth))
        mounted = T_frd_rig(Mount())
        if state is None:
            motion = CameraMotion.still(pose_at(t_ns) @ mounted @ depth.T_rig_rect)
        else:
            motion = camera_motion(state, mounted, depth.T_rig_rect)
        report = self.monitor.update(rectified, depth, offsets, False, motion)
        if report.rig_changed:
            self._estimator = self._estimator.with_rig(self.monitor.rig)
        return report


def drift_trial(rig: RigModel, seed: int, bent_deg: float = BENT_DEG, progress: Progress = silent) -> DriftTrial:
    """Bend the twin of `seed` in pitch and yaw, let the watch look at it for 20 frames at two baselines."""
    bent = RigTwin(*rig.size, seed=seed).bent(math.radians(bent_deg), math.radians(bent_deg))
    watched = _Watched(rig, bent, 0.0, seed, STATIONARY)
    place = pose(np.eye(3), watched.start_ned_m)
    told: dict[str, int] = {}
    said: list[str] = []
    for number in range(FRAMES):
        progress("watching a bent rig", number, FRAMES)
        nominal_m = _PLACES_M[number >= _FIRST_PLACE]
        report = watched.look(number, round(number * S / _RATE_HZ), nominal_m, lambda _: place, None)
        for finding in report.findings:
            told.setdefault(finding.what, number + 1)
            said.append(f"frame {number + 1}: {finding.text}")
    before, after = evaluate_rig(rig, bent), evaluate_rig(watched.monitor.rig, bent)
    return DriftTrial(
        bent_deg,
        bent_deg,
        min(told.values(), default=None),
        told.get("turned"),
        told.get("yaw"),
        round(before.epipolar_median_px, 4),
        round(before.disparity_bias_max_px, 4),
        round(after.epipolar_median_px, 4),
        round(after.disparity_bias_max_px, 4),
        tuple(said),
    )


def late_trials(rig: RigModel, seed: int, progress: Progress = silent) -> Iterator[LateTrial]:
    """Fly 20 frames with each time of `LATE_S` between the eyes, 2 ms declared, and yield what was measured."""
    for done, time_offset_s in enumerate(LATE_S):
        progress("measuring the time between the eyes", done, len(LATE_S))
        watched = _Watched(rig, RigTwin(*rig.size, seed=seed), time_offset_s, seed, None)
        flight = _Flight(watched.start_ned_m - _RUN_UP_M, seed)
        for number in range(FRAMES):
            t_ns = round(number * S / _RATE_HZ)
            report = watched.look(number, t_ns, _PLACES_M[1], flight.T_ned_frd, flight.reported(t_ns))
        measured_ms, sigma_ms = round(report.time_offset_s * 1e3, 3), round(report.time_offset_sigma_s * 1e3, 3)
        yield LateTrial(time_offset_s * 1e3, measured_ms, sigma_ms, watched.monitor.out_of_sync)


class _Flight:
    """Forwards at 4 m/s, swaying and shaking, as the autopilot reports it: late by nothing, but with its errors."""

    _V_NED_M_S = np.array([4.0, 0.3, -0.1])
    _SWAY_RAD, _SWAY_HZ = np.array([0.05, 0.04, 0.03]), np.array([1.1, 1.7, 0.6])
    _SHAKE_RAD, _SHAKE_HZ = np.array([0.002, 0.002, 0.001]), np.array([17.0, 23.0, 19.0])

    def __init__(self, start_ned_m: Array, seed: int) -> None:
        self._start_ned_m = start_ned_m
        self._rng = np.random.default_rng([seed, 530])

    def T_ned_frd(self, t_ns: int) -> Array:
        """Return the true pose."""
        t = t_ns / S
        return pose(R_from_rpy(*self._rpy(t)), self._start_ned_m + self._V_NED_M_S * t)

    def reported(self, t_ns: int) -> VehicleState:
        """Return what the autopilot says at that time."""
        t, step = t_ns / S, 1e-4
        roll, pitch, yaw = self._rpy(t)
        # small angles: body rates are those of roll, pitch and yaw, to a share far below the noise
        rates = (self._rpy(t + step) - self._rpy(t)) / step + _RATE_SIGMA_RAD_S * self._rng.standard_normal(3)
        v = self._V_NED_M_S + _SPEED_SIGMA_M_S * self._rng.standard_normal(3)
        p = self._start_ned_m + self._V_NED_M_S * t
        return VehicleState(
            t_ns=t_ns,
            roll_rad=roll,
            pitch_rad=pitch,
            yaw_rad=yaw,
            rates_frd_rad_s=(rates[0], rates[1], rates[2]),
            p_ned_m=(p[0], p[1], p[2]),
            v_ned_m_s=(v[0], v[1], v[2]),
        )

    def _rpy(self, t: float) -> Array:
        turn = 2 * math.pi * t
        return np.asarray(
            self._SWAY_RAD * np.sin(turn * self._SWAY_HZ) + self._SHAKE_RAD * np.sin(turn * self._SHAKE_HZ)
        )


def watch_figures(rig: RigModel, seed: int, progress: Progress = silent) -> dict[str, Any]:
    """Return both trials as `calibrate evaluate --watch --json` prints them."""
    drift = drift_trial(rig, seed, progress=progress)
    return {
        "drift": asdict(drift) | {"said": list(drift.said)},
        "late": [asdict(trial) for trial in late_trials(rig, seed, progress)],
    }
