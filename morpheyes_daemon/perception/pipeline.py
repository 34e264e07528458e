"""Processing of one stereo frame: rectification, matching, monitors, image checks, and the strategy's `perceive`.

Runs in the vision worker (another process) in real time and inline in lockstep; the same object either way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.clock import stopwatch_s
from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.messages.core import (
    SECTORS,
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
from morpheyes_daemon.perception.depth_scale_monitor import DepthScaleMonitor, ScaleObservation
from morpheyes_daemon.perception.extrinsics_monitor import ExtrinsicsFault, ExtrinsicsLimits, ExtrinsicsMonitor
from morpheyes_daemon.perception.image_checks import (
    FrozenCheck,
    ImageFault,
    PairCheck,
    exposure_faults,
    matching_faults,
)
from morpheyes_daemon.stereo.depth import DepthEstimator, RectifiedPair, disparity_of
from morpheyes_daemon.stereo.epipolar import RowOffsets, row_offsets
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.strategies.base import View

_REASONS = {ImageFault.MISALIGNED: Reason.CALIBRATION_DRIFT, ImageFault.ROW_MISMATCH: Reason.EYES_APART}
"""Faults of the rig; all others are IMAGE_BAD."""

_OUTLIER_PIXELS = 4
"""Nearest pixels of a column that a sector ignores; chosen: single false matches; more would miss thin branches."""
_RECORDED_WIDTH_PX = 320
"""Width of recorded images, pixels; chosen: size of the log against detail."""


@dataclass(frozen=True, slots=True, eq=False)
class VisionJob:
    """One raw frame with the vehicle state at its mid-exposure; `keep_images` asks for the images of the recorder."""

    frame: StereoFrame
    vehicle: VehicleState
    keep_images: bool


@dataclass(frozen=True, slots=True)
class PipelineFactory:
    """Builds a `Pipeline`; picklable, so that the vision worker can build its own."""

    config: VehicleConfig
    mission: MissionFile
    rig: RigModel

    def __call__(self) -> Pipeline:
        """Return the pipeline; raises ConfigError when the mission is invalid."""
        return Pipeline(self.config, self.mission, self.rig)


class Pipeline:
    """Image processing of the daemon for one mission and one rig."""

    def __init__(self, config: VehicleConfig, mission: MissionFile, rig: RigModel) -> None:
        self._estimator = DepthEstimator(rig, config.stereo, (config.camera.width_px, config.camera.height_px))
        self._frozen, self._pair_check, self._depth_scale = FrozenCheck(), PairCheck(), DepthScaleMonitor()
        self._still_scene = mission.still_scene
        limits = ExtrinsicsLimits(time_offset_s=config.camera.sync_error_ms / 1e3, watch_yaw=mission.still_scene)
        self._extrinsics = ExtrinsicsMonitor(self._estimator.rig, limits)
        self._strategy = build_strategy(mission, config)
        self._T_frd_rig = build_craft(config).T_frd_rig

    def perceive(self, job: VisionJob) -> Perception:
        """Return depth, percept, faults and events of one frame.

        Raises InputError on a wrong image size, CalibrationError when the rig does not cover the baseline.
        """
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
        """Return the findings of the extrinsics monitor as events; the next frame is rectified by the corrected rig."""
        seen = self._extrinsics.update(pair, depth, offsets, frame.baseline.moving, motion)
        if seen.rig_changed:
            self._estimator = self._estimator.with_rig(self._extrinsics.rig)
        return tuple(
            Event(
                frame.t_ns,
                "calibration",
                Reason.EYES_LATE if finding.what is ExtrinsicsFault.TIME_OFFSET else Reason.CALIBRATION_DRIFT,
                finding.text,
            )
            for finding in seen.findings
        )

    def _image_faults(
        self, frame: StereoFrame, pair: RectifiedPair, depth: DepthMap, offsets: RowOffsets, motion: CameraMotion
    ) -> tuple[Reason, ...]:
        """Return the reasons why the frame must not be used, empty for a good one."""
        found = exposure_faults(pair.left, pair.right)
        found |= matching_faults(pair.left, pair.right, depth.valid_fraction)
        remaining = self._extrinsics.compensated(offsets, depth)
        uncertainty_rad = self._extrinsics.row_uncertainty_rad(frame.baseline)
        found |= self._pair_check.check(pair.left, remaining, depth.pinhole.f_px, uncertainty_rad)
        if self._frozen.check(frame.left, frame.right):
            found.add(ImageFault.FROZEN)
        reasons = {_REASONS.get(fault, Reason.IMAGE_BAD) for fault in found}
        if self._extrinsics.broken or self._extrinsics.out_of_sync:
            reasons.add(Reason.EYES_APART)
        if self._still_scene and self._depth_scale.check(ScaleObservation(pair.left, depth, motion)):
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
    """Return the nearest obstacle (SECTORS,) float32 metres per sector of the view, NaN where none.

    Sectors are equal in angle over the horizontal field of view, left to right; only the middle third of the rows
    counts. Pixels nearer than the near limit count as the near limit. Each column gives its fifth nearest pixel.
    """
    height = depth.depth_m.shape[0]
    rows = slice(height // 3, 2 * height // 3)
    middle = np.where(depth.near[rows], np.float32(depth.near_limit_m), depth.depth_m[rows])
    filled = np.where(np.isfinite(middle), middle, np.inf)
    columns = np.partition(filled, _OUTLIER_PIXELS, axis=0)[_OUTLIER_PIXELS]
    pinhole = depth.pinhole
    angle = np.arctan((np.arange(pinhole.width) - pinhole.cx_px) / pinhole.f_px)
    left = -math.atan((pinhole.cx_px + 0.5) / pinhole.f_px)
    index = np.clip(((angle - left) / pinhole.h_fov_rad * SECTORS).astype(np.int64), 0, SECTORS - 1)
    nearest = np.full(SECTORS, np.inf)
    np.minimum.at(nearest, index, columns / np.cos(angle))
    return frozen(np.where(np.isfinite(nearest), nearest, np.nan).astype(np.float32))


def _small(image: Image) -> Image:
    scale = _RECORDED_WIDTH_PX / image.shape[1]
    if scale >= 1.0:
        return frozen(image.copy())
    return frozen(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8))
