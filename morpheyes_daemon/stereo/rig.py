"""The stereo rig whose baseline moves: two cameras, and the pose between them at any baseline.

Poses are known at a few baselines and interpolated by ScLERP between neighbours (paper, section III-B). The
parameter is the *nominal* baseline: the commanded or modelled position of the servo. The true distance between the
cameras is the length of the pose's translation, so the calibration includes a non-linear servo. The poses are found
by `calibration`; the file format is defined by `calibration_file`.
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.screw import dual_quaternion, pose_from_dual_quaternion, sclerp
from morpheyes_daemon.transforms import Array, R_from_rotvec, q_from_R

__all__ = ["CalibratedBaseline", "CameraIntrinsics", "CameraMount", "RigModel"]

RANGE_TOLERANCE_M = 1.5e-3
"""Distance outside the calibrated range up to which poses are extrapolated, metres; chosen: backlash of two servos
and the play at the stops."""

METHODS = ("solved", "exact")


@dataclass(frozen=True)
class CalibratedBaseline:
    """Pose between the cameras at one nominal baseline; what the calibration does not state is None.

    `q_cam0_cam1` (w, x, y, z) and `t_cam0_cam1_m` take cam1 coordinates to cam0. `sigma_length_m` and
    `sigma_yaw_rad` are one standard deviation of the solved length and of the yaw between the cameras.
    """

    nominal_m: float
    q_cam0_cam1: tuple[float, float, float, float]
    t_cam0_cam1_m: tuple[float, float, float]
    rms_px: float | None = None
    sigma_length_m: float | None = None
    sigma_yaw_rad: float | None = None

    @classmethod
    def from_pose(cls, nominal_m: float, T_cam0_cam1: Array, **measures: float | None) -> CalibratedBaseline:
        """Return the baseline of a pose (4, 4); `measures` are the optional fields."""
        w, x, y, z = (float(c) for c in q_from_R(T_cam0_cam1[:3, :3]))
        tx, ty, tz = (float(c) for c in T_cam0_cam1[:3, 3])
        return cls(float(nominal_m), (w, x, y, z), (tx, ty, tz), **measures)

    @property
    def dual_quaternion(self) -> Array:
        """The pose as a unit dual quaternion (8,)."""
        return dual_quaternion(np.array(self.q_cam0_cam1), np.array(self.t_cam0_cam1_m))


@dataclass(frozen=True)
class CameraMount:
    """Orientation of the left camera on the bar: rotation vector (3,) of R_rig_cam0 with one sigma, rad, camera axes."""

    rotation_rad: tuple[float, float, float]
    sigma_rad: tuple[float, float, float]


@dataclass(frozen=True)
class RigModel:
    """Intrinsics of both cameras and the pose between them over the calibrated range of baselines.

    `method` is "solved" (from images) or "exact" (known, a simulator's truth). Boards do not
    determine the orientation on the vehicle: without a `mount` the left camera is assumed parallel to the bar.
    `details` is plain data for reports (board, date, coverage, uncertainties); it is stored and not used for geometry.
    Raises CalibrationError on inconsistent content.
    """

    cam0: CameraIntrinsics
    cam1: CameraIntrinsics
    baselines: tuple[CalibratedBaseline, ...]
    method: str = "solved"
    details: Mapping[str, Any] = field(default_factory=dict)
    mount: CameraMount | None = None

    def __post_init__(self) -> None:
        nominal = [baseline.nominal_m for baseline in self.baselines]
        if not nominal:
            raise CalibrationError("A rig needs at least one calibrated baseline.")
        if any(b <= a for a, b in itertools.pairwise(nominal)):
            raise CalibrationError("The calibrated baselines must grow from one to the next, none twice.")
        if (self.cam0.width, self.cam0.height) != (self.cam1.width, self.cam1.height):
            raise CalibrationError("Both cameras of a rig must have the same image size.")
        if self.method not in METHODS:
            raise CalibrationError(f"The calibration method {self.method!r} is none of {', '.join(METHODS)}.")
        for baseline in self.baselines:
            _check(baseline)
        if self.mount is not None and not np.all(np.isfinite([*self.mount.rotation_rad, *self.mount.sigma_rad])):
            raise CalibrationError("The left camera's rotation on the bar is not finite.")

    @classmethod
    def from_poses(
        cls,
        cam0: CameraIntrinsics,
        cam1: CameraIntrinsics,
        nominal_m: Sequence[float],
        T_cam0_cam1: Sequence[Array],
        method: str = "exact",
        details: Mapping[str, Any] | None = None,
    ) -> RigModel:
        """Return the rig of nominal baselines and their poses (4, 4)."""
        pairs = zip(nominal_m, T_cam0_cam1, strict=True)
        baselines = tuple(CalibratedBaseline.from_pose(nominal, T) for nominal, T in pairs)
        return cls(cam0, cam1, baselines, method, details or {})

    @property
    def size(self) -> tuple[int, int]:
        """Image size (width, height) of both cameras in pixels."""
        return self.cam0.width, self.cam0.height

    @cached_property
    def baselines_m(self) -> tuple[float, ...]:
        """The calibrated nominal baselines, growing."""
        return tuple(baseline.nominal_m for baseline in self.baselines)

    @property
    def range_m(self) -> tuple[float, float]:
        """The nominal baselines that are covered, smallest and largest."""
        return self.baselines_m[0], self.baselines_m[-1]

    @property
    def origin(self) -> str:
        """Origin of the calibration: its method, or "mounted" where the mount was measured as well."""
        return self.method if self.mount is None else "mounted"

    @property
    def R_rig_cam0(self) -> Array:
        """Rotation (3, 3) of the left camera on the bar; the identity where it was not measured."""
        return np.eye(3) if self.mount is None else R_from_rotvec(np.array(self.mount.rotation_rad))

    def T_cam0_cam1(self, baseline_m: float) -> Array:
        """Return the pose (4, 4) of the right camera in the left one at a nominal baseline.

        Raises CalibrationError outside the calibrated range; see `dual_quaternion`.
        """
        return pose_from_dual_quaternion(self.dual_quaternion(baseline_m))

    def dual_quaternion(self, baseline_m: float) -> Array:
        """Return T_cam0_cam1 as a unit dual quaternion (8,), by ScLERP between the calibrated neighbours.

        Raises CalibrationError outside the calibrated range (paper, section III-B).
        """
        self._require(baseline_m)
        if len(self.baselines) == 1:
            return self.baselines[0].dual_quaternion
        i, t = self._bracket(baseline_m)
        return sclerp(self.baselines[i].dual_quaternion, self.baselines[i + 1].dual_quaternion, t)

    def length_m(self, baseline_m: float) -> float:
        """Return the true baseline at a nominal one; raises CalibrationError outside the calibrated range."""
        return float(np.linalg.norm(self.T_cam0_cam1(baseline_m)[:3, 3]))

    def sigma_length_m(self, baseline_m: float) -> float:
        """Return the stated sigma of the true baseline, metres, at a nominal one; 0 where none is stated."""
        return self._interpolated([b.sigma_length_m for b in self.baselines], baseline_m)

    def sigma_yaw_rad(self, baseline_m: float) -> float:
        """Return the stated sigma of the yaw between the cameras, rad, at a nominal baseline; 0 where none is stated."""
        return self._interpolated([b.sigma_yaw_rad for b in self.baselines], baseline_m)

    def rescaled(self, width: int, height: int) -> RigModel:
        """Return the rig at another image size; raises CalibrationError when the aspect ratio differs."""
        if (width, height) == self.size:
            return self
        cam0, cam1 = self.cam0.rescaled(width, height), self.cam1.rescaled(width, height)
        return replace(self, cam0=cam0, cam1=cam1)

    def _interpolated(self, values: Sequence[float | None], baseline_m: float) -> float:
        return float(np.interp(baseline_m, self.baselines_m, [value or 0.0 for value in values]))

    def _bracket(self, baseline_m: float) -> tuple[int, float]:
        """Return the left neighbour's index and the place between it and the next; a little outside extrapolates."""
        nominal = self.baselines_m
        i = min(max(bisect.bisect_right(nominal, baseline_m) - 1, 0), len(nominal) - 2)
        return i, (baseline_m - nominal[i]) / (nominal[i + 1] - nominal[i])

    def _require(self, baseline_m: float) -> None:
        low, high = self.range_m
        if not low - RANGE_TOLERANCE_M <= baseline_m <= high + RANGE_TOLERANCE_M:
            covered = f"{low * 1e3:g} mm" if low == high else f"{low * 1e3:g} to {high * 1e3:g} mm"
            raise CalibrationError(
                f"The calibration covers a baseline of {covered}, not {baseline_m * 1e3:g} mm; "
                "stay within it or calibrate there as well."
            )


def _check(baseline: CalibratedBaseline) -> None:
    name = f"The pose at the nominal baseline of {baseline.nominal_m * 1e3:g} mm"
    if not np.all(np.isfinite([baseline.nominal_m, *baseline.q_cam0_cam1, *baseline.t_cam0_cam1_m])):
        raise CalibrationError(f"{name} is not finite.")
    if abs(np.linalg.norm(baseline.q_cam0_cam1) - 1.0) > 1e-6:
        raise CalibrationError(f"{name} has a rotation that is no unit quaternion.")
    if baseline.t_cam0_cam1_m[0] <= 0:
        raise CalibrationError(
            f"{name} has the right camera left of the left one: exchange the left and right images and solve again."
        )
