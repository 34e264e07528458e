"""A textured square that moves before a textured wall, as views of a still or moving stereo rig, painted exactly.

Both are fronto-parallel, so every image is a shifted and scaled piece of a texture; depth comes with them.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import DepthMap, Pinhole, VehicleState
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.transforms import R_FRD_CAM, pose

PINHOLE = Pinhole(320, 240, 370.0, 159.5, 119.5)
TEXELS_PER_M = 300.0
WALL_M = 6.0


def texture(size: int, seed: int, *grains: float) -> np.ndarray:
    """Return a random grey texture (size, size) with something to see at every scale of `grains`."""
    total = np.zeros((size, size), dtype=np.float32)
    for k, grain in enumerate(grains):
        noise = np.random.default_rng([seed, k]).standard_normal((size, size)).astype(np.float32)
        smooth = cv2.GaussianBlur(noise, (0, 0), grain)
        total += smooth / smooth.std()
    return np.asarray(128 + 45 * total / total.std(), dtype=np.float32)


WALL = texture(3000, 1, 12.0)
FACE = texture(400, 2, 5.0, 14.0, 36.0)
COVER = texture(400, 3, 5.0, 14.0, 36.0)


@dataclass(frozen=True)
class Square:
    """A square face: middle in ned metres (x is its depth ahead) and edge."""

    p_ned_m: tuple[float, float, float]
    edge_m: float = 0.3


def view(
    k: int, square: Square | None, eye_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0), baseline_m: float = 0.2,
    told_error_m: float = 0.0, hidden: bool = False, cover: Square | None = None,
) -> View:  # fmt: skip
    """Return frame `k` (5 Hz) of a rig at `eye_ned_m` looking north; the autopilot is wrong by `told_error_m` east.

    `cover` is another square before `square`.
    """
    eye = np.array(eye_ned_m)
    shown = [(FACE, square)] if square is not None and not hidden else []
    shown += [(COVER, cover)] if cover is not None else []
    left, depth = _seen(eye, shown, 2 * k)
    right, _ = _seen(eye + (0.0, baseline_m, 0.0), shown, 2 * k + 1)
    t_ns = S + k * S // 5
    vehicle = VehicleState(
        t_ns=t_ns, attitude_t_ns=t_ns, position_t_ns=t_ns, p_ned_m=(eye[0], eye[1] + told_error_m, eye[2])
    )
    found = DepthMap(
        seq=k,
        t_ns=t_ns,
        depth_m=depth,
        near=np.zeros(depth.shape, dtype=np.bool_),
        half_occluded=np.zeros(depth.shape, dtype=np.bool_),
        pinhole=PINHOLE,
        T_rig_rect=np.eye(4),
        baseline_m=baseline_m,
        baseline_sigma_m=0.0002,
        sigma_disparity_px=0.25,
        near_limit_m=baseline_m * PINHOLE.f_px / 80,
        valid_fraction=1.0,
        ceiling_fraction=0.0,
        calibration_hash="",
    )
    return View(found, left, right, vehicle, pose(R_FRD_CAM, np.zeros(3)))


def _seen(eye: np.ndarray, shown: list[tuple[np.ndarray, Square]], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return image and depth of pictures before the wall, the farthest first."""
    image = _plane(eye, WALL, (WALL_M, 0.0, 0.0), WALL.shape[0] / TEXELS_PER_M)
    depth = np.full(image.shape, WALL_M - eye[0], dtype=np.float32)
    for picture, square in shown:
        face = _plane(eye, picture, square.p_ned_m, square.edge_m)
        inside = np.isfinite(face)
        image = np.where(inside, face, image)
        depth = np.where(inside, np.float32(square.p_ned_m[0] - eye[0]), depth)
    noise = np.random.default_rng(seed).standard_normal(image.shape) * 1.5
    return np.clip(np.nan_to_num(image, nan=128.0) + noise, 0, 255).astype(np.uint8), depth


def _plane(eye: np.ndarray, picture: np.ndarray, middle: tuple[float, float, float], edge_m: float) -> np.ndarray:
    """Return the image of a square picture whose middle lies at `middle`, NaN beside it."""
    z = middle[0] - eye[0]
    drawn = edge_m * PINHOLE.f_px / z
    if picture.shape[0] > 2 * drawn:  # as a lens would: no finer than the pixels
        size = math.ceil(2 * drawn)
        picture = cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA)
    v, u = np.mgrid[0 : PINHOLE.height, 0 : PINHOLE.width].astype(np.float32)
    scale = picture.shape[0] / edge_m
    x = ((u - PINHOLE.cx_px) / PINHOLE.f_px * z + eye[1] - middle[1]) * scale + picture.shape[1] / 2
    y = ((v - PINHOLE.cy_px) / PINHOLE.f_px * z + eye[2] - middle[2]) * scale + picture.shape[0] / 2
    found = cv2.remap(picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderValue=math.nan)
    inside = (x > 0) & (y > 0) & (x < picture.shape[1] - 1) & (y < picture.shape[0] - 1)
    return np.where(inside, found, np.nan)


def moved(square: Square, by: tuple[float, float, float]) -> Square:
    """Return the square elsewhere."""
    x, y, z = square.p_ned_m
    return replace(square, p_ned_m=(x + by[0], y + by[1], z + by[2]))
