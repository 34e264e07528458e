"""The stereo camera of the simulator: what two real, imperfect eyes make of the rendered world.

Each eye renders an ideal pinhole a bit wider than its image, along its true axis, and resamples it through its lens;
then come vignetting, exposure, photon and read noise. The right eye exposes a little later than the left, from where
the vehicle is by then. Every picture is a pure function of pose, time, frame number and seed. Truth comes out beside
the picture, for judges only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import Mount
from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole, RawPair, frozen
from morpheyes_daemon.simulation.camera.sensor import NOISE, develop
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.simulation.rendering.renderer import Rendered, Renderer
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.transforms import Array

PoseAt = Callable[[int], Array]
"""T_ned_frd (4, 4) of the vehicle at a time in nanoseconds."""

MARGIN_PX = 3
"""Border of the wide picture beyond what the lens sees, for the resampling's reach."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """What the sensor does to light; electrons as of an OV5647 with 2x2 binning, f/2.6."""

    full_well_e: float = 16000.0
    read_noise_e: float = 8.0
    vignetting: float = 0.25
    exposure: float = 1.0
    auto_exposure: bool = True
    target_mean: float = 0.20
    gain_mismatch: float = 0.02
    flicker: float = 0.0
    sync_offset_s: float = 0.002
    exposure_time_s: float = 0.0
    sub_exposures: int = 1


class _Lens:
    """One eye's way from the wide pinhole picture to the sensor."""

    def __init__(self, lens: CameraIntrinsics, vignetting: float) -> None:
        border = lens.normalised_border
        low, high = border.min(axis=0), border.max(axis=0)
        f = lens.fx
        size = np.ceil((high - low) * f).astype(int) + 2 * MARGIN_PX
        cx, cy = (float(c) for c in MARGIN_PX - low * f)
        self.pinhole = Pinhole(int(size[0]), int(size[1]), f, cx, cy)
        v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
        xy = lens.normalised_from_pixels(np.stack([u, v], axis=-1))
        self.map = np.ascontiguousarray(xy * f + (cx, cy), dtype=np.float32)
        radius2 = (xy**2).sum(axis=-1)
        self.vignette = (1.0 - vignetting * radius2 / radius2.max()).astype(np.float32)

    def depth(self, rendered: Rendered) -> FloatMap:
        """Return depth along z at the distorted pixels (nearest sample)."""
        # the second map must be None: OpenCV 5 makes rubbish of an empty array there
        nearest = cv2.remap(rendered.depth_m, self.map, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
        return np.asarray(nearest, dtype=np.float32)


class CameraTwin:
    """Takes raw pairs in a scene; both eyes may be drawn by two threads (`workers=2`), with the same bits."""

    def __init__(
        self,
        renderer: Renderer,
        rig: RigTwin,
        mount: Mount | None = None,
        sensor: Sensor | None = None,
        seed: int = 0,
        epoch_ns: int = 0,
        workers: int = 1,
    ) -> None:
        self.rig = rig
        self.sensor = Sensor() if sensor is None else sensor
        self._renderers = (renderer, renderer.sibling())
        self._T_frd_rig = T_frd_rig(Mount() if mount is None else mount)
        self._lenses = tuple(_Lens(lens, self.sensor.vignetting) for lens in (rig.cam0, rig.cam1))
        self._seed = seed
        self._epoch_ns = epoch_ns
        gains = np.random.default_rng([seed, 300]).standard_normal(2)
        self._gains = 1.0 + self.sensor.gain_mismatch * gains
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None

    def close(self) -> None:
        """End the worker threads, if any."""
        if self._pool is not None:
            self._pool.shutdown()

    def T_ned_eye(self, eye: int, T_ned_frd: Array, baseline_true_m: float) -> Array:
        """Return the true pose (4, 4) of an eye."""
        return np.asarray(T_ned_frd @ self._T_frd_rig @ self.rig.T_rig_eye(eye, baseline_true_m))

    def render_pair(self, t_ns: int, seq: int, pose_at: PoseAt, baseline_true_m: float) -> RawPair:
        """Return the raw pair (BGR uint8) exposed at `t_ns`, the right eye a sync offset later."""
        views = self._views(t_ns, pose_at, baseline_true_m)
        exposure = self._exposure(views[0], t_ns)
        left, right = (self._develop(eye, views[eye], seq, exposure) for eye in (0, 1))
        return RawPair(seq, t_ns, frozen(left), frozen(right))

    def instants_ns(self, t_ns: int) -> list[int]:
        """Return the times at which `render_pair` asks where the vehicle is."""
        return self._exposed_ns(t_ns) + self._exposed_ns(self._right_ns(t_ns))

    def true_depth(self, t_ns: int, pose_at: PoseAt, baseline_true_m: float) -> FloatMap:
        """Return the true depth (H, W) along z of every pixel of the raw left image, inf for sky; for judges."""
        return self._lenses[0].depth(self._view(0, t_ns, pose_at, baseline_true_m))

    def _views(self, t_ns: int, pose_at: PoseAt, baseline_true_m: float) -> tuple[Rendered, Rendered]:
        right_ns = self._right_ns(t_ns)
        if self._pool is None:
            left = self._view(0, t_ns, pose_at, baseline_true_m)
            return left, self._view(1, right_ns, pose_at, baseline_true_m)
        left_job = self._pool.submit(self._view, 0, t_ns, pose_at, baseline_true_m)
        right_job = self._pool.submit(self._view, 1, right_ns, pose_at, baseline_true_m)
        return left_job.result(), right_job.result()

    def _right_ns(self, t_ns: int) -> int:
        return t_ns + round(self.sensor.sync_offset_s * 1e9)

    def _exposed_ns(self, t_ns: int) -> list[int]:
        """Return the moments of which the picture of one eye is the mean."""
        n = self.sensor.sub_exposures
        return [t_ns + round(((k + 0.5) / n - 0.5) * self.sensor.exposure_time_s * 1e9) for k in range(n)]

    def _view(self, eye: int, t_ns: int, pose_at: PoseAt, baseline_true_m: float) -> Rendered:
        n = self.sensor.sub_exposures
        views = [self._instant(eye, at_ns, pose_at, baseline_true_m) for at_ns in self._exposed_ns(t_ns)]
        if n == 1:
            return views[0]
        mean = sum((view.radiance for view in views[1:]), views[0].radiance) / np.float32(n)
        return replace(views[n // 2], radiance=mean)

    def _instant(self, eye: int, t_ns: int, pose_at: PoseAt, baseline_true_m: float) -> Rendered:
        T_ned_frd = pose_at(t_ns)
        T_ned_eye = self.T_ned_eye(eye, T_ned_frd, baseline_true_m)
        t_s = (t_ns - self._epoch_ns) / 1e9
        middle = (T_ned_frd @ self._T_frd_rig)[:3, 3]
        return self._renderers[eye].render(T_ned_eye, self._lenses[eye].pinhole, t_s, middle)

    def _exposure(self, view: Rendered, t_ns: int) -> float:
        """Exposure common to both eyes: automatic from the left picture's mean, and a slow flicker."""
        s = self.sensor
        exposure = s.exposure
        if s.auto_exposure:
            mean = float(view.radiance[::8, ::8].mean(dtype=np.float64))
            exposure = min(max(s.target_mean / max(mean, 1e-6), 0.25), 4.0)
        t_s = t_ns / 1e9
        return exposure * (1.0 + s.flicker * (math.sin(2.1 * t_s) + math.sin(5.3 * t_s + 1.0)) / 2.0)

    def _develop(self, eye: int, view: Rendered, seq: int, exposure: float) -> Image:
        lens, s = self._lenses[eye], self.sensor
        image = np.empty((*lens.map.shape[:2], 3), np.uint8)
        key = np.uint64((self._seed * 1_000_003 + seq) * 2 + eye)
        gain = exposure * self._gains[eye]
        # amplified light carries more noise: fewer electrons make a full signal
        shot, read = gain / s.full_well_e, (gain * s.read_noise_e / s.full_well_e) ** 2
        develop(view.radiance, lens.map, lens.vignette, gain, shot, read, NOISE, key, image)
        return image
