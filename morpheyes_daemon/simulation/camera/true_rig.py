"""The true stereo rig of the simulator: lenses, mounting errors, and how they change along the rail.

Only the camera twin and the judges know it. The daemon reads a calibration file, which is either solved from
pictures or, for comparison, written here as the exact one. Servo dynamics belong to the Teensy twin.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import Array, R_from_rotvec, inverse, pose

FOCAL_SHARE = 740.0 / 640.0
"""Focal length over image width: 3.96 mm lens on an OV5647, 56.8 deg diagonal (paper, section III-A)."""

RANGE_M = (0.100, 0.300)

EXACT_STEPS = 81
"""Baselines in an exact calibration file; between two of them the interpolation errs by less than 1e-4 px."""


@dataclass(frozen=True, slots=True)
class RigErrors:
    """How badly the twin is built, as one sigma (amplitude for the servo's non-linearity)."""

    rotation_deg: float = 0.25
    rotation_along_rail_deg: float = 0.08
    offset_mm: float = 0.5
    offset_along_rail_mm: float = 0.15
    nonlinearity_mm: float = 0.8
    focal: float = 0.004
    centre: float = 0.006
    skew: float = 4e-4
    distortion: float = 1.0

    @classmethod
    def none(cls) -> RigErrors:
        """A perfect rig: no misalignment, no distortion, both lenses alike."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class RigTwin:
    """A rig built with seeded errors. Each eye rides its own carriage and moves by half of the change."""

    def __init__(self, width: int = 640, height: int = 480, seed: int = 0, errors: RigErrors | None = None) -> None:
        self.seed = seed
        self.errors = RigErrors() if errors is None else errors
        rng = np.random.default_rng([seed, 200])
        self._rotation = self._wander(rng, self.errors.rotation_deg, self.errors.rotation_along_rail_deg)
        self._rotation *= math.pi / 180.0
        self._offset = self._wander(rng, self.errors.offset_mm, self.errors.offset_along_rail_mm) / 1e3
        self._phase = rng.uniform(0, 2 * math.pi, (2, 3))
        self._servo = rng.uniform(-1, 1, 2)
        lenses = [self._lens(rng), self._lens(rng)]
        self.cam0, self.cam1 = (lens.rescaled(width, height) for lens in lenses)

    @staticmethod
    def _wander(rng: np.random.Generator, constant: float, along: float) -> Array:
        """Amplitudes (2 eyes, 3 axes, 3): constant, linear along the rail, a slow wave along the rail."""
        return np.asarray(rng.standard_normal((2, 3, 3)) * [constant, along, 0.35 * along])

    def _lens(self, rng: np.random.Generator) -> CameraIntrinsics:
        e = self.errors
        f = 740.0 * (1.0 + e.focal * rng.standard_normal())
        fy = f * (1.0 + 0.3 * e.focal * rng.standard_normal())
        cx, cy = 319.5 + 640 * e.centre * rng.standard_normal(), 239.5 + 480 * e.centre * rng.standard_normal()
        spread = np.array([0.01, 0.01, 3e-4, 3e-4, 0.005]) * rng.standard_normal(5)
        k = e.distortion * (np.array([-0.18, 0.06, 4e-4, -3e-4, 0.0]) + spread)
        alpha = e.skew * rng.standard_normal()
        return CameraIntrinsics(640, 480, f, fy, cx, cy, alpha, (k[0], k[1], k[2], k[3], k[4]))

    def bent(self, pitch_rad: float, yaw_rad: float, roll_rad: float = 0.0) -> RigTwin:
        """Return the same rig after a knock that turned its right eye."""
        knocked = copy.copy(self)
        knocked._rotation = self._rotation.copy()
        knocked._rotation[1, :, 0] += (pitch_rad, yaw_rad, roll_rad)
        return knocked

    def actual_m(self, nominal_m: float) -> float:
        """Return the true distance between the eyes when the servos stand at `nominal_m` on their own scale."""
        s = self._along(nominal_m)
        wave = self._servo[0] * math.sin(1.1 * math.pi * s) + self._servo[1] * math.cos(0.9 * math.pi * s)
        return float(nominal_m + 0.5e-3 * self.errors.nonlinearity_mm * wave)

    @staticmethod
    def _along(baseline_m: float) -> float:
        """Place on the rail, -1 at the smallest baseline, 1 at the largest."""
        return (2.0 * baseline_m - RANGE_M[0] - RANGE_M[1]) / (RANGE_M[1] - RANGE_M[0])

    def T_rig_eye(self, eye: int, baseline_m: float) -> Array:
        """Return the true pose (4, 4) of the left (0) or right (1) eye on the bar at a true baseline."""
        s = self._along(baseline_m)
        basis = np.stack([np.ones((2, 3)), np.full((2, 3), s), np.sin(2.2 * s + self._phase)], axis=-1)
        rotation, offset = (self._rotation * basis).sum(axis=-1)[eye], (self._offset * basis).sum(axis=-1)
        across = offset[1, 1:] - offset[0, 1:]
        # the carriages move so that the distance between the eyes is the baseline in spite of the offsets
        half = 0.5 * math.sqrt(baseline_m**2 - float(across @ across))
        t = np.array([half if eye else -half, offset[eye, 1], offset[eye, 2]])
        return pose(R_from_rotvec(rotation), t)

    def T_cam0_cam1(self, baseline_m: float) -> Array:
        """Return the true pose (4, 4) of the right eye in the left at a true baseline."""
        return inverse(self.T_rig_eye(0, baseline_m)) @ self.T_rig_eye(1, baseline_m)

    def exact_rig(self, steps: int = EXACT_STEPS) -> RigModel:
        """Return the calibration that a perfect solver would find, over the nominal range."""
        nominal = np.linspace(*RANGE_M, steps)
        poses = [self.T_cam0_cam1(self.actual_m(float(b))) for b in nominal]
        return RigModel.from_poses(self.cam0, self.cam1, nominal.tolist(), poses, method="exact")
