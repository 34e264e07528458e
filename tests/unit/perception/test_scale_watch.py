"""Depth out of scale shows in how fast the image grows; a vehicle that stands still tells nothing."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from morpheyes_daemon.messages.core import DepthMap, Pinhole
from morpheyes_daemon.perception.camera_motion import CameraMotion
from morpheyes_daemon.perception.depth_scale_monitor import DepthScaleMonitor, ScaleObservation, scale_between
from morpheyes_daemon.transforms import R_from_rotvec, pose

PINHOLE = Pinhole(320, 240, 370.0, 159.5, 119.5)
PERIOD_S = 0.2
WALL_M, SLOPE = 5.0, 0.3
"""A slanted wall: Z = WALL_M + SLOPE x."""


def texture() -> np.ndarray:
    rng = np.random.default_rng(4)
    rough = cv2.resize(rng.uniform(0, 255, (300, 400)).astype(np.float32), (800, 600), interpolation=cv2.INTER_CUBIC)
    return np.clip(rough, 0, 255)


TEXTURE = texture()


def sight(
    t_s: float, way_m: np.ndarray, turn_rad: np.ndarray, told_turn_rad: np.ndarray, v: np.ndarray
) -> ScaleObservation:
    """The wall from a camera that has gone `way_m` and turned; the autopilot tells `told_turn_rad` and `v`."""
    v_pixel, u_pixel = np.mgrid[0:240, 0:320]
    x, y = (u_pixel - PINHOLE.cx_px) / PINHOLE.f_px, (v_pixel - PINHOLE.cy_px) / PINHOLE.f_px
    R = R_from_rotvec(turn_rad)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ R.T
    along = (WALL_M + SLOPE * way_m[0] - way_m[2]) / (rays[..., 2] - SLOPE * rays[..., 0])
    places = way_m + rays * along[..., None]
    map_u, map_v = ((places[..., i] * 100.0 + centre).astype(np.float32) for i, centre in ((0, 400.0), (1, 300.0)))
    image = cv2.remap(TEXTURE, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    depth = along.astype(np.float32)  # along the optical axis, since a ray's third part is 1 in the camera's own axes
    told = R_from_rotvec(told_turn_rad)
    return ScaleObservation(
        image.astype(np.uint8), depth_map(t_s, depth), CameraMotion(pose(told, way_m), told.T @ v, np.zeros(3))
    )


def depth_map(t_s: float, depth_m: np.ndarray) -> DepthMap:
    nothing = np.zeros(depth_m.shape, np.bool_)
    return DepthMap(
        seq=0, t_ns=round(t_s * 1e9), depth_m=depth_m, near=nothing, half_occluded=nothing, pinhole=PINHOLE,
        T_rig_rect=np.eye(4), baseline_m=0.3, baseline_sigma_m=0.0, sigma_disparity_px=0.25, near_limit_m=1.0,
        valid_fraction=1.0, ceiling_fraction=0.0, calibration_hash="",
    )  # fmt: skip


def stretched(one: ScaleObservation, factor: float) -> ScaleObservation:
    return replace(one, depth=replace(one.depth, depth_m=one.depth.depth_m * np.float32(factor)))


def flight(v: tuple[float, float, float], count: int = 8, gyro_error_rad: float = 0.0) -> list[ScaleObservation]:
    speed, rng = np.array(v), np.random.default_rng(2)
    turns = [np.array([0.02, -0.015, 0.01]) * n for n in range(count)]
    told = [turn + gyro_error_rad * rng.standard_normal(3) for turn in turns]
    return [sight(PERIOD_S * n, speed * PERIOD_S * n, turns[n], told[n], speed) for n in range(count)]


FORWARD = flight((0.0, 0.0, 2.0))


@pytest.mark.parametrize("factor", [0.4, 0.8, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("seen", [FORWARD, flight((0.8, 0.2, 1.5)), flight((0.0, 0.0, 2.0), 4, 0.005)])
def test_the_factor_is_found(factor: float, seen: list[ScaleObservation]) -> None:
    fit = scale_between(stretched(seen[1], factor), stretched(seen[2], factor))
    assert fit is not None
    # a tenth of a pixel of 6 that a point moves
    assert fit.factor == pytest.approx(factor, rel=0.06)
    assert fit.sigma < 0.1


def test_standing_still_tells_nothing() -> None:
    first, second = flight((0.0, 0.0, 0.0), 2)
    fit = scale_between(stretched(first, 3.0), stretched(second, 3.0))
    assert fit is None or fit.sigma > 0.5


@pytest.mark.parametrize("seconds", [0.0, -0.2, 1.5])
def test_frames_too_far_apart_or_out_of_order_tell_nothing(seconds: float) -> None:
    first, second = FORWARD[:2]
    assert scale_between(first, replace(second, depth=replace(second.depth, t_ns=round(seconds * 1e9)))) is None


def test_images_without_texture_or_depth_tell_nothing() -> None:
    first, second = FORWARD[:2]
    grey = replace(first, left=np.full_like(first.left, 128))
    unknown = replace(first, depth=replace(first.depth, depth_m=np.full_like(first.depth.depth_m, np.nan)))
    assert scale_between(grey, second) is None
    assert scale_between(unknown, second) is None
    assert scale_between(first, replace(second, left=np.full_like(first.left, 128))) is None


@pytest.mark.parametrize(("factor", "wrong"), [(0.85, False), (1.0, False), (1.15, False), (2.0, True), (0.4, True)])
def test_most_of_the_telling_frames_must_agree(factor: float, wrong: bool) -> None:
    watch = DepthScaleMonitor()
    told = [watch.check(stretched(one, factor)) for one in FORWARD]
    assert told == ([False] * 4 + [True] * 4 if wrong else [False] * 8), "four pairs of frames"


def test_one_odd_frame_is_no_proof() -> None:
    watch = DepthScaleMonitor()
    assert not any(watch.check(stretched(one, 3.0 if n == 3 else 1.0)) for n, one in enumerate(FORWARD))
