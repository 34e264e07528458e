"""The surroundings from above, around the vehicle, quickly enough for every frame of a video (1 ms, OpenCV).

North is up. For the one large picture of a whole flight see `map.py`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.recorder.pictures.outline import boxes, placed
from morpheyes_daemon.recorder.pictures.scene import ObstacleMap
from morpheyes_daemon.stereo.colours import baseline_bgr

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

SHIFT = 4
"""Fractional bits of the coordinates handed to OpenCV, for drawing finer than a pixel."""
GROUND: Colour = (242, 247, 246)
GRID: Colour = (226, 231, 230)
TREE: Colour = (95, 120, 102)
TREE_EDGE: Colour = (58, 77, 63)
WALL: Colour = (139, 154, 167)
SEEN: Colour = (246, 226, 204)
INK: Colour = (58, 52, 48)
GOAL: Colour = (63, 210, 255)
TRAIL_POINTS = 400


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the vehicle is and how far it sees: north, east, heading, speed over ground, baseline, range, view."""

    x_m: float
    y_m: float
    yaw_rad: float
    v_x_m_s: float
    v_y_m_s: float
    baseline_m: float
    seen_m: float
    h_fov_rad: float


class TopView:
    """Draws the window around the vehicle; remembers the trail it left."""

    def __init__(
        self, scene: ObstacleMap, footprint: Footprint, size: tuple[int, int] = (480, 360), height_m: float = 10.0
    ) -> None:
        self._scene = scene
        self._footprint = footprint
        self._width, self._height = size
        self._px_per_m = self._height / height_m
        self._blank = np.full((self._height, self._width, 3), np.array(GROUND, np.uint8))
        self._discs = scene.disc_array()
        self._trail: deque[tuple[float, float, float]] = deque(maxlen=TRAIL_POINTS)

    def draw(self, pose: Pose) -> Image:
        """Return (H, W, 3) BGR around `pose`."""
        self._trail.append((pose.x_m, pose.y_m, pose.baseline_m))
        picture = self._blank.copy()
        self._draw_grid(picture, pose)
        self._draw_view(picture, pose)
        self._draw_scene(picture, pose)
        self._draw_trail(picture, pose)
        self._draw_vehicle(picture, pose)
        self._draw_scale(picture)
        return picture

    def _pixels(self, xy_m: Array, pose: Pose) -> NDArray[np.int32]:
        """North and east (N, 2) to OpenCV's fixed-point pixels; the vehicle stands low in the middle."""
        u = self._width / 2 + (xy_m[:, 1] - pose.y_m) * self._px_per_m
        v = self._height * 0.74 - (xy_m[:, 0] - pose.x_m) * self._px_per_m
        return np.round(np.stack([u, v], axis=1) * (1 << SHIFT)).astype(np.int32)

    def _draw_grid(self, picture: Image, pose: Pose) -> None:
        """A line every two metres, so that motion is seen over empty ground."""
        reach = 2 + (self._width + self._height) / self._px_per_m
        steps = 2.0 * np.arange(-reach // 2, reach // 2 + 1)
        ends = np.tile([-reach, reach], len(steps))
        north = np.stack([np.repeat(2.0 * (pose.x_m // 2) + steps, 2), pose.y_m + ends], axis=1)
        east = np.stack([pose.x_m + ends, np.repeat(2.0 * (pose.y_m // 2) + steps, 2)], axis=1)
        lines = self._pixels(np.vstack([north, east]), pose).reshape(-1, 2, 2)
        cv2.polylines(picture, list(lines), False, GRID, 1, cv2.LINE_AA, SHIFT)

    def _draw_view(self, picture: Image, pose: Pose) -> None:
        """The field of view as far as depth is trusted."""
        if not math.isfinite(pose.seen_m) or pose.seen_m <= 0:
            return
        angles = pose.yaw_rad + np.linspace(-0.5, 0.5, 17) * pose.h_fov_rad
        arc = np.stack([pose.x_m + pose.seen_m * np.cos(angles), pose.y_m + pose.seen_m * np.sin(angles)], axis=1)
        corners = np.vstack([[pose.x_m, pose.y_m], arc])
        cv2.fillPoly(picture, [self._pixels(corners, pose)], SEEN, cv2.LINE_AA, SHIFT)

    def _draw_scene(self, picture: Image, pose: Pose) -> None:
        for corners in self._scene.polygons:
            outline = [self._pixels(np.array(corners, dtype=np.float64), pose)]
            cv2.fillPoly(picture, outline, WALL, cv2.LINE_AA, SHIFT)
        reach_m = (self._width + self._height) / self._px_per_m
        discs = self._discs[np.abs(self._discs[:, :2] - (pose.x_m, pose.y_m)).max(axis=1) < reach_m]
        for centre, radius_m in zip(self._pixels(discs, pose).tolist(), discs[:, 2], strict=True):
            radius = round(float(radius_m) * self._px_per_m * (1 << SHIFT))
            cv2.circle(picture, centre, radius, TREE, -1, cv2.LINE_AA, SHIFT)
            cv2.circle(picture, centre, radius, TREE_EDGE, 1, cv2.LINE_AA, SHIFT)
        if self._scene.goal_m is not None:
            centre = self._pixels(np.array([self._scene.goal_m]), pose)[0].tolist()
            cv2.circle(picture, centre, 8 << SHIFT, GOAL, -1, cv2.LINE_AA, SHIFT)
            cv2.circle(picture, centre, 8 << SHIFT, INK, 1, cv2.LINE_AA, SHIFT)

    def _draw_trail(self, picture: Image, pose: Pose) -> None:
        trail = np.array(self._trail)
        pixels = self._pixels(trail, pose)
        for start, end, baseline_m in zip(pixels[:-1].tolist(), pixels[1:].tolist(), trail[1:, 2], strict=True):
            cv2.line(picture, start, end, baseline_bgr(float(baseline_m)), 3, cv2.LINE_AA, SHIFT)

    def _draw_vehicle(self, picture: Image, pose: Pose) -> None:
        at = np.array([pose.x_m, pose.y_m])
        tip = at + 0.6 * np.array([pose.v_x_m_s, pose.v_y_m_s])
        cv2.polylines(picture, [self._pixels(np.stack([at, tip]), pose)], False, INK, 1, cv2.LINE_AA, SHIFT)
        hull, bar = boxes(self._footprint, pose.baseline_m)
        for box, colour in ((hull, (255, 255, 255)), (bar, baseline_bgr(pose.baseline_m))):
            corners = [self._pixels(placed(box, at, pose.yaw_rad), pose)]
            cv2.fillPoly(picture, corners, colour, cv2.LINE_AA, SHIFT)
            cv2.polylines(picture, corners, True, INK, 1, cv2.LINE_AA, SHIFT)

    def _draw_scale(self, picture: Image) -> None:
        right, low = self._width - 14, self._height - 14
        cv2.line(picture, (right - round(2 * self._px_per_m), low), (right, low), INK, 2, cv2.LINE_AA)
        cv2.putText(picture, "2 m", (right - 42, low - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, INK, 1, cv2.LINE_AA)
