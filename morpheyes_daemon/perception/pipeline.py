"""What happens to one stereo frame: rectify, match, judge the images, let the strategy look.

Runs in the vision worker (another process) in real time and inline in lockstep; the same object either way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from morpheyes_daemon.clock import stopwatch_s
from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.messages.core import (
    DepthMap,
    DepthSummary,
    Event,
    FloatMap,
    Image,
    Perception,
    StereoFrame,
    VehicleState,
    frozen,
)
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.perception.camera_motion import CameraMotion, camera_motion
from morpheyes_daemon.perception.craft import build_craft, build_strategy
from morpheyes_daemon.perception.depth_scale_monitor import DepthScaleMonitor, Sight
from morpheyes_daemon.perception.extrinsics_monitor import ExtrinsicsFault, ExtrinsicsLimits, ExtrinsicsMonitor
from morpheyes_daemon.perception.image_checks import (
    FrozenCheck,
    ImageFault,
    PairCheck,
    exposure_faults,
    matching_faults,
)
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.stereo.depth import DepthEstimator, RectifiedPair, disparity_of
from morpheyes_daemon.stereo.epipolar import RowOffsets, row_offsets
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.strategies.base import View

_REASONS = {ImageFault.MISALIGNED: Reason.CALIBRATION_DRIFT, ImageFault.APART: Reason.EYES_APART}
"""What is no fault of the images but of the rig."""

SECTORS = 72
"""Sectors of OBSTACLE_DISTANCE over the horizontal field of view."""


@dataclass(frozen=True, slots=True, eq=False)
class VisionJob:
    """One frame with the vehicle's state at its exposure; `keep_images` asks for the small pictures."""

    frame: StereoFrame
    vehicle: VehicleState
    keep_images: bool


@dataclass(frozen=True, slots=True)
class PipelineFactory:
    """Builds a `Pipeline` in whichever process it is needed; picklable."""

    config: VehicleConfig
    mission: MissionFile
    calibration: Path

    def __call__(self) -> Pipeline:
        """Return a pipeline; raises CalibrationError when the file cannot be used."""
        return Pipeline(self.config, self.mission, read_calibration(self.calibration))


class Pipeline:
    """The image side of the daemon for one mission and one rig."""

    def __init__(self, config: VehicleConfig, mission: MissionFile, rig: RigModel) -> None:
        self._estimator = DepthEstimator(rig, config.stereo, (config.camera.width_px, config.camera.height_px))
        self._frozen, self._alike, self._scale = FrozenCheck(), PairCheck(), DepthScaleMonitor()
        self._still_scene = mission.still_scene
        limits = ExtrinsicsLimits(late_s=config.camera.sync_error_ms / 1e3, watch_yaw=mission.still_scene)
        self._drift = ExtrinsicsMonitor(self._estimator.rig, limits)
        self._strategy = build_strategy(mission, config)
        self._T_frd_rig = build_craft(config).T_frd_rig

    def perceive(self, job: VisionJob) -> Perception:
        """Return what one frame shows. Raises CalibrationError when the rig does not cover the frame's baseline."""
        started_s = stopwatch_s()
        pair = self._estimator.rectified(job.frame)
        depth = self._estimator.depth(job.frame, pair)
        motion = camera_motion(job.vehicle, self._T_frd_rig, depth.T_rig_rect)
        offsets = row_offsets(pair.left, pair.right, disparity_of(depth))
        events = self._watch_calibration(job.frame, pair, depth, offsets, motion)
        faults = self._image_faults(job.frame, pair, depth, offsets, motion)
        view = View(depth, pair.left, pair.right, job.vehicle, self._T_frd_rig)
        percept = self._strategy.perceive(view)
        return Perception(
            summary=summarize(depth, stopwatch_s() - started_s),
            percept=percept,
            sectors_m=sectors(depth),
            image_faults=faults,
            left_rect=_small(job.frame.left) if job.keep_images else None,
            depth_m=frozen(depth.depth_m[::2, ::2].copy()) if job.keep_images else None,
            events=events,
        )

    def _watch_calibration(
        self, frame: StereoFrame, pair: RectifiedPair, depth: DepthMap, offsets: RowOffsets, motion: CameraMotion
    ) -> tuple[Event, ...]:
        """Return what the drift watch noticed; the next frame is rectified by what it corrected."""
        seen = self._drift.update(pair, depth, offsets, frame.baseline.moving, motion)
        if seen.rig_changed:
            self._estimator = self._estimator.turned(self._drift.rig)
        return tuple(
            Event(
                frame.t_ns,
                "calibration",
                Reason.EYES_LATE if finding.what is ExtrinsicsFault.LATE else Reason.CALIBRATION_DRIFT,
                finding.text,
            )
            for finding in seen.findings
        )

    def _image_faults(
        self, frame: StereoFrame, pair: RectifiedPair, depth: DepthMap, offsets: RowOffsets, motion: CameraMotion
    ) -> tuple[Reason, ...]:
        """Return why the frame must not be flown on, empty when it may."""
        found = exposure_faults(pair.left, pair.right)
        found |= matching_faults(pair.left, pair.right, depth.valid_fraction)
        left_over = self._drift.unexplained(offsets, depth)
        found |= self._alike.check(pair.left, left_over, depth.pinhole.f_px, self._drift.doubt_rad(frame.baseline))
        if self._frozen.check(frame.left, frame.right):
            found.add(ImageFault.FROZEN)
        reasons = {_REASONS.get(fault, Reason.IMAGE_BAD) for fault in found}
        if self._drift.broken or self._drift.late:
            reasons.add(Reason.EYES_APART)
        if self._still_scene and self._scale.check(Sight(pair.left, depth, motion)):
            reasons.add(Reason.DEPTH_SCALE)
        return tuple(sorted(reasons, key=lambda reason: reason.number))


def summarize(depth: DepthMap, compute_s: float) -> DepthSummary:
    """Return the summary of a depth map; `done_ns` is set by the task that receives it."""
    known = depth.depth_m[np.isfinite(depth.depth_m)]
    return DepthSummary(
        seq=depth.seq,
        t_ns=depth.t_ns,
        done_ns=depth.t_ns,
        baseline_m=depth.baseline_m,
        baseline_sigma_m=depth.baseline_sigma_m,
        f_px=depth.pinhole.f_px,
        h_fov_rad=depth.pinhole.h_fov_rad,
        sigma_disparity_px=depth.sigma_disparity_px,
        near_limit_m=depth.near_limit_m,
        valid_fraction=depth.valid_fraction,
        ceiling_fraction=depth.ceiling_fraction,
        nearest_m=float(np.percentile(known, 1.0)) if known.size else math.nan,
        compute_s=compute_s,
        calibration_hash=depth.calibration_hash,
    )


def sectors(depth: DepthMap) -> FloatMap:
    """Return (72,) the nearest depth per sector of the view in the middle third of the rows, NaN where none.

    Sectors are equal in angle. Pixels at the disparity ceiling count as the near limit.
    """
    height = depth.depth_m.shape[0]
    rows = slice(height // 3, 2 * height // 3)
    middle = np.where(depth.near[rows], np.float32(depth.near_limit_m), depth.depth_m[rows])
    filled = np.where(np.isfinite(middle), middle, np.inf)
    columns = np.partition(filled, 4, axis=0)[4]
    pinhole = depth.pinhole
    angle = np.arctan((np.arange(pinhole.width) - pinhole.cx_px) / pinhole.f_px)
    left = -math.atan((pinhole.cx_px + 0.5) / pinhole.f_px)
    index = np.clip(((angle - left) / pinhole.h_fov_rad * SECTORS).astype(np.int64), 0, SECTORS - 1)
    nearest = np.full(SECTORS, np.inf)
    np.minimum.at(nearest, index, columns / np.cos(angle))
    return frozen(np.where(np.isfinite(nearest), nearest, np.nan).astype(np.float32))


def _small(image: Image) -> Image:
    scale = 320 / image.shape[1]
    if scale >= 1.0:
        return frozen(image.copy())
    return frozen(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8))
