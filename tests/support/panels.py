"""Scenes of flat textured panels, seen exactly through any lens: truth for rectification, matching and depth.

The texture is a sum of waves without detail finer than a few pixels, so it can be evaluated anywhere and no
resampling comes between it and the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.core import Image, Pinhole
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rectify import rays
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.transforms import R_from_rotvec, inverse, pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Panel:
    """A panel facing the left camera: depth z_m at its middle, tilted, and where it lies in x and y (cam0 frame)."""

    z_m: float
    x_m: tuple[float, float] = (-1e3, 1e3)
    y_m: tuple[float, float] = (-1e3, 1e3)
    slope_x: float = 0.0
    slope_y: float = 0.0
    seed: int = 0
    contrast: float = 1.0

    def distance(self, origin: Array, direction: Array) -> Array:
        """Return along each ray (..., 3) from `origin` (3,) how many directions away the panel is, inf beside it."""
        slope = np.array([-self.slope_x, -self.slope_y, 1.0])
        t = (self.z_m - slope @ origin) / (direction @ slope)
        p = origin + t[..., None] * direction
        inside = (p[..., 0] >= self.x_m[0]) & (p[..., 0] <= self.x_m[1])
        inside &= (p[..., 1] >= self.y_m[0]) & (p[..., 1] <= self.y_m[1])
        return np.where(inside & (t > 0), t, np.inf)

    def grey(self, p: Array, pixel_m: float) -> Array:
        """Return the grey level at points (..., 3); the finest wave is about four pixels long."""
        rng = np.random.default_rng([self.seed, 77])
        waves = 40
        length_px = np.exp(rng.uniform(np.log(4.5), np.log(40.0), waves))
        angle, phase = rng.uniform(0, np.pi, waves), rng.uniform(0, 2 * np.pi, waves)
        total = np.zeros(p.shape[:-1])
        for wavelength, a, b in zip(length_px, angle, phase, strict=True):
            k = 2 * np.pi / (wavelength * pixel_m)
            total += np.sin(k * (np.cos(a) * p[..., 0] + np.sin(a) * p[..., 1]) + b)
        return 128.0 + self.contrast * 11.0 * total


def look(panels: list[Panel], T_cam0_eye: Array, direction_eye: Array, f_px: float) -> tuple[Array, Array]:
    """Return grey level (...) and depth (...) in the eye's own frame along rays (..., 3) with z = 1."""
    origin, direction = T_cam0_eye[:3, 3], direction_eye @ T_cam0_eye[:3, :3].T
    distances = np.stack([panel.distance(origin, direction) for panel in panels])
    first = distances.argmin(axis=0)
    grey = np.full(first.shape, 128.0)
    for index, panel in enumerate(panels):
        seen = (first == index) & np.isfinite(distances[index])
        p = origin + distances[index][seen][..., None] * direction[seen]
        grey[seen] = panel.grey(p, panel.z_m / f_px)
    return grey, distances.min(axis=0)


def raw_image(
    panels: list[Panel], lens: CameraIntrinsics, T_cam0_eye: Array, f_px: float, noise: float, seed: int
) -> Image:
    """Return what an eye with a real lens sees (H, W) uint8; `f_px` sets the grain of the textures for both eyes."""
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
    xy = lens.normalised_from_pixels(np.stack([u, v], axis=-1))
    direction = np.concatenate([xy, np.ones_like(u)[..., None]], axis=-1)
    return developed(look(panels, T_cam0_eye, direction, f_px)[0], noise, seed)


def raw_pair(panels: list[Panel], rig: RigModel, baseline_m: float, noise: float = 0.0) -> tuple[Image, Image]:
    """Return the raw images of a rig at a nominal baseline."""
    return (
        raw_image(panels, rig.cam0, np.eye(4), rig.cam0.fx, noise, 1),
        raw_image(panels, rig.cam1, rig.T_cam0_cam1(baseline_m), rig.cam0.fx, noise, 2),
    )


def ideal_pair(
    panels: list[Panel], pinhole: Pinhole, baseline_m: float, noise: float = 0.0, T_right: Array | None = None
) -> tuple[Image, Image, Array]:
    """Return a rectified pair and the true depth of the left image; `T_right` moves the right eye further."""
    v, u = np.mgrid[0 : pinhole.height, 0 : pinhole.width].astype(np.float64)
    direction = rays(pinhole, np.stack([u, v], axis=-1))
    left, depth = look(panels, np.eye(4), direction, pinhole.f_px)
    T_cam0_cam1 = pose(np.eye(3), np.array([baseline_m, 0.0, 0.0])) @ (np.eye(4) if T_right is None else T_right)
    right, _ = look(panels, T_cam0_cam1, direction, pinhole.f_px)
    return developed(left, noise, 1), developed(right, noise, 2), depth


def developed(grey: Array, noise: float, seed: int) -> Image:
    """Return grey levels as uint8 with a sensor's noise."""
    noisy = grey + noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def crooked_rig(width: int = 640, height: int = 480, steps: int = 10) -> RigModel:
    """Return a rig with two different lenses, skew, distortion, and a misalignment that changes along the rail."""
    cam0 = CameraIntrinsics(640, 480, 741.0, 739.0, 322.5, 237.0, 4e-4, (-0.18, 0.06, 4e-4, -3e-4, 0.004))
    cam1 = CameraIntrinsics(640, 480, 737.0, 738.5, 316.0, 243.5, -3e-4, (-0.17, 0.05, -2e-4, 5e-4, -0.003))
    nominal = np.linspace(0.1, 0.3, steps)
    poses = [
        pose(
            R_from_rotvec(np.array([0.006, -0.004 + 0.02 * b, 0.003 - 0.01 * b])),
            np.array([1.004 * b - 0.0003, 0.0008, -0.0012 + 0.004 * b]),
        )
        for b in nominal
    ]
    return RigModel.from_poses(cam0, cam1, nominal.tolist(), poses).rescaled(width, height)


def turned_right(rotvec_rad: tuple[float, float, float]) -> Array:
    """Return a further turn of the right eye, as `ideal_pair` takes it."""
    return inverse(pose(R_from_rotvec(-np.array(rotvec_rad)), np.zeros(3)))
