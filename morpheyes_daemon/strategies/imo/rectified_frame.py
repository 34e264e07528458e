"""One stereo frame as the search for moving things needs it: images, depth, lens, pose, and from pixels to points.

Points are in the axes of the frame's rectified left eye (`rect`); an observation is (u, v, d), pixel and disparity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.transforms import Array


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A rectified pair with its depth map and the pose that the autopilot gives for it."""

    t_ns: int
    left: Image
    right: Image
    depth_m: FloatMap
    pinhole: Pinhole
    baseline_m: float
    baseline_sigma_m: float
    T_ned_rect: Array

    @classmethod
    def of(cls, view: View) -> Frame:
        """Take what is needed of a view."""
        depth = view.depth
        return cls(
            depth.t_ns, view.left, view.right, depth.depth_m, depth.pinhole, depth.baseline_m,
            depth.baseline_sigma_m, view.T_ned_rect,
        )  # fmt: skip

    @property
    def bf_m_px(self) -> float:
        """Baseline times focal length: depth times disparity."""
        return self.baseline_m * self.pinhole.f_px

    @property
    def scale(self) -> float:
        """Image width as a share of 640, for lengths in pixels that belong to the lens rather than to the grid."""
        return self.pinhole.width / 640.0

    def project(self, p_rect: Array) -> Array:
        """Return (u, v, d) (..., 3) of points (..., 3); NaN behind the eye."""
        z = np.where(p_rect[..., 2] > 1e-3, p_rect[..., 2], np.nan)
        u = self.pinhole.f_px * p_rect[..., 0] / z + self.pinhole.cx_px
        v = self.pinhole.f_px * p_rect[..., 1] / z + self.pinhole.cy_px
        return np.stack([u, v, self.bf_m_px / z], axis=-1)

    def points(self, uvd: Array) -> Array:
        """Return points (..., 3) of observations (..., 3); NaN where the disparity is not positive."""
        z = self.bf_m_px / np.where(uvd[..., 2] > 1e-3, uvd[..., 2], np.nan)
        x = (uvd[..., 0] - self.pinhole.cx_px) * z / self.pinhole.f_px
        y = (uvd[..., 1] - self.pinhole.cy_px) * z / self.pinhole.f_px
        return np.stack([x, y, z], axis=-1)

    def derivative(self, p_rect: Array) -> Array:
        """Return (N, 3, 3), how (u, v, d) change with points (N, 3)."""
        f, z = self.pinhole.f_px, p_rect[:, 2]
        J = np.zeros((len(p_rect), 3, 3))
        J[:, 0, 0] = J[:, 1, 1] = f / z
        J[:, 0, 2] = -f * p_rect[:, 0] / z**2
        J[:, 1, 2] = -f * p_rect[:, 1] / z**2
        J[:, 2, 2] = -self.bf_m_px / z**2
        return J

    def holds(self, uv: Array, margin_px: float = 0.0) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return (N,) which pixels (N, 2) lie inside the image; NaN does not."""
        size = np.array([self.pinhole.width - 1, self.pinhole.height - 1])
        with np.errstate(invalid="ignore"):
            return np.asarray(((uv >= margin_px) & (uv <= size - margin_px)).all(axis=-1))
