"""Budget of the depth error at each baseline and distance, by cause.

Based on eps_z = z^2 eps_d / (b f) (paper, section II): the matcher's noise, the disparity bias by
the yaw between the cameras, the error of the baseline (Z sigma_b / b), and the time offset between the cameras while
the vehicle moves sideways (the effective baseline is then b + v dt).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from morpheyes_daemon.stereo.rig import RigModel

DISTANCES_M = (1.0, 2.0, 5.0, 10.0)
"""Distances of the budget, metres; chosen: the range in which missions use depth."""


@dataclass(frozen=True)
class Conditions:
    """Conditions outside the calibration, one sigma each: matcher noise, servo repeatability, time offset, side speed.

    The defaults are chosen: StereoSGBM on texture, `ServoMotion`, two triggered USB cameras, slow sideways flight.
    """

    sigma_disparity_px: float = 0.25
    sigma_servo_m: float = 1e-4
    sync_s: float = 2e-3
    sideways_m_s: float = 0.5


@dataclass(frozen=True)
class DepthError:
    """One sigma of depth at one distance and baseline, by cause and in total (root sum of squares), in metres."""

    nominal_m: float
    distance_m: float
    disparity_m: float
    yaw_m: float
    baseline_m: float
    sync_m: float

    @property
    def total_m(self) -> float:
        """Root sum of squares of all causes, metres."""
        return math.hypot(self.disparity_m, self.yaw_m, self.baseline_m, self.sync_m)


def depth_errors(rig: RigModel, conditions: Conditions) -> list[DepthError]:
    """Return the expected depth error at every calibrated baseline and each of `DISTANCES_M` (paper, section II)."""
    return [_error(rig, nominal, z, conditions) for nominal in rig.baselines_m for z in DISTANCES_M]


def _error(rig: RigModel, nominal_m: float, z: float, conditions: Conditions) -> DepthError:
    b = rig.length_m(nominal_m)
    f = (rig.cam0.fx + rig.cam0.fy + rig.cam1.fx + rig.cam1.fy) / 4
    per_pixel = z * z / (b * f)
    return DepthError(
        nominal_m=nominal_m,
        distance_m=z,
        disparity_m=per_pixel * conditions.sigma_disparity_px,
        yaw_m=per_pixel * f * rig.sigma_yaw_rad(nominal_m),
        baseline_m=z * math.hypot(rig.sigma_length_m(nominal_m), conditions.sigma_servo_m) / b,
        sync_m=z * conditions.sideways_m_s * conditions.sync_s / b,
    )
