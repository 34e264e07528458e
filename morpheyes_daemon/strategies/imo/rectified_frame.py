"""Rectified frame: images, depth, lens and pose of one stereo frame, with projection and triangulation.

Points are in the rectified left camera (`rect`), metres; an observation is (u, v, d), pixel and disparity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.transforms import Array

MIN_DEPTH_M, MIN_DISPARITY_PX = 1e-3, 1e-3
"""Depth and disparity below which there is no observation and no point.

Chosen: only avoid divisions by zero."""

LENS_WIDTH_PX = 640.0
"""Image width at which lengths in pixels that are angles are given.

Source: data sheet, OV5647 behind a 3.96 mm lens at 640x480, where f is 740 px (56.8 degrees diagonal)."""


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedFrame:
    """A rectified stereo pair with its depth map and the autopilot's pose at exposure.

    `left`, `right` (H, W) uint8, `depth_m` (H, W), `T_ned_rect` (4, 4).
    """

    t_ns: int
    left: Image
    right: Image
    depth_m: FloatMap
    pinhole: Pinhole
    baseline_m: float
    baseline_sigma_m: float
    T_ned_rect: Array

    @classmethod
    def of(cls, view: View) -> RectifiedFrame:
        """Return the frame of a view."""
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
        """Image width over 640, to scale lengths in pixels that are angles rather than sampling."""
        return self.pinhole.width / LENS_WIDTH_PX

    def project(self, p_rect: Array) -> Array:
        """Return observations (u, v, d) (..., 3), px, of points (..., 3), rect metres; NaN behind the camera."""
        z = np.where(p_rect[..., 2] > MIN_DEPTH_M, p_rect[..., 2], np.nan)
        u = self.pinhole.f_px * p_rect[..., 0] / z + self.pinhole.cx_px
        v = self.pinhole.f_px * p_rect[..., 1] / z + self.pinhole.cy_px
        return np.stack([u, v, self.bf_m_px / z], axis=-1)

    def points(self, uvd: Array) -> Array:
        """Return points (..., 3), rect metres, of observations (..., 3), px; NaN where the disparity is not positive."""
        z = self.bf_m_px / np.where(uvd[..., 2] > MIN_DISPARITY_PX, uvd[..., 2], np.nan)
        x = (uvd[..., 0] - self.pinhole.cx_px) * z / self.pinhole.f_px
        y = (uvd[..., 1] - self.pinhole.cy_px) * z / self.pinhole.f_px
        return np.stack([x, y, z], axis=-1)

    def derivative(self, p_rect: Array) -> Array:
        """Return the derivatives (N, 3, 3), px/m, of (u, v, d) by the points (N, 3), rect metres."""
        f, z = self.pinhole.f_px, p_rect[:, 2]
        J = np.zeros((len(p_rect), 3, 3))
        J[:, 0, 0] = J[:, 1, 1] = f / z
        J[:, 0, 2] = -f * p_rect[:, 0] / z**2
        J[:, 1, 2] = -f * p_rect[:, 1] / z**2
        J[:, 2, 2] = -self.bf_m_px / z**2
        return J

    def contains(self, uv: Array, margin_px: float = 0.0) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return (N,) bool, unitless: which pixels (N, 2) lie inside the image by `margin_px`; NaN does not."""
        size = np.array([self.pinhole.width - 1, self.pinhole.height - 1])
        with np.errstate(invalid="ignore"):
            return np.asarray(((uv >= margin_px) & (uv <= size - margin_px)).all(axis=-1))
