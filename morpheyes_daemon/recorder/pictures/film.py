"""The film of a flight: left image, depth and the view from above side by side, with a line of figures below.

Fed by taps while flying in lockstep, or by a log afterwards; each perception with images gives one picture.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.messages.core import BaselineEstimate, DepthSummary, Governed, Image, Perception, VehicleState
from morpheyes_daemon.recorder.channels import DEPTH_IMAGE, LEFT_IMAGE
from morpheyes_daemon.recorder.pictures.scene import ObstacleMap
from morpheyes_daemon.recorder.pictures.topview import Pose, TopView
from morpheyes_daemon.recorder.pictures.video import VideoWriter
from morpheyes_daemon.recorder.reader import Flight
from morpheyes_daemon.stereo.colours import MAX_BASELINE_M, MIN_BASELINE_M, baseline_bgr, colour_depth

PANEL_W, PANEL_H, LINE_H = 480, 360, 40
DARK = (38, 34, 32)
WHITE = (240, 240, 240)
DIM = (150, 150, 150)
FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(slots=True)
class Newest:
    """The newest message of each topic that the film shows."""

    vehicle: VehicleState | None = None
    baseline: BaselineEstimate | None = None
    governed: Governed | None = None
    gate: Any = None
    summary: DepthSummary | None = None


class FlightFilm:
    """Makes flight.mp4 as the flight goes on."""

    def __init__(self, path: Path, scene: ObstacleMap, footprint: Footprint) -> None:
        self._video = VideoWriter(path)
        self._topview = TopView(scene, footprint, (PANEL_W, PANEL_H))
        self._newest = Newest()
        self._blank = np.full((PANEL_H + LINE_H, 3 * PANEL_W, 3), np.array(DARK, np.uint8))
        self._start_ns: int | None = None

    def watch(self, topics: Topics) -> None:
        """Film from now on; costs some milliseconds per frame, in whoever publishes."""
        for name in ("vehicle", "baseline", "governed", "gate", "perception"):
            getattr(topics, name).tap(lambda value, name=name: self.add(name, value))

    @classmethod
    def of_log(cls, path: Path, flight: Flight, scene: ObstacleMap, footprint: Footprint) -> int:
        """Make the film of a recorded flight from the pictures in its log; returns their number."""
        film, left, count = cls(path, scene, footprint), None, 0
        for record in flight.records:
            if f"/{record.topic}" == LEFT_IMAGE:
                left = _decoded(record.value)
            elif f"/{record.topic}" == DEPTH_IMAGE and left is not None:
                film.show(record.log_ns, left, _decoded(record.value))
                count += 1
            else:
                film.add(record.topic, record.value)
        film.close()
        return count

    def add(self, topic: str, value: Any) -> None:
        """Take one message; a perception that carries images becomes a picture."""
        if isinstance(value, Perception):
            self._newest.summary = value.summary
            if value.left_rect is not None and value.depth_m is not None:
                self.show(value.summary.t_ns, value.left_rect, colour_depth(value.depth_m))
        elif topic in {f.name for f in fields(Newest)}:
            setattr(self._newest, topic, value)

    def show(self, t_ns: int, left: Image, depth: Image) -> None:
        """Append one picture made of a left image (grey or BGR), a coloured depth map and the newest messages."""
        if self._start_ns is None:
            self._start_ns = t_ns
        seconds = (t_ns - self._start_ns) / S
        canvas = self._blank.copy()
        top = self._topview.draw(_pose(self._newest))
        for k, (panel, label) in enumerate(((left, "left eye"), (depth, "depth"), (top, "from above"))):
            _fit(panel, canvas[:PANEL_H, k * PANEL_W : (k + 1) * PANEL_W])
            _label(canvas, k * PANEL_W, label)
        _figures(canvas, seconds, self._newest)
        self._video.add(seconds, canvas)

    def close(self) -> None:
        """Finish the file."""
        self._video.close()


def _pose(newest: Newest) -> Pose:
    vehicle = newest.vehicle or VehicleState()
    seen_m = newest.governed.trust_m if newest.governed else math.nan
    return Pose(
        x_m=vehicle.p_ned_m[0],
        y_m=vehicle.p_ned_m[1],
        yaw_rad=vehicle.yaw_rad,
        v_x_m_s=vehicle.v_ned_m_s[0],
        v_y_m_s=vehicle.v_ned_m_s[1],
        baseline_m=newest.baseline.baseline_m if newest.baseline else math.nan,
        seen_m=min(seen_m, 50.0),
        h_fov_rad=newest.summary.h_fov_rad if newest.summary else 0.0,
    )


def _decoded(compressed: dict[str, Any]) -> Image:
    """The picture of a recorded foxglove.CompressedImage."""
    data = np.frombuffer(base64.b64decode(compressed["data"]), dtype=np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


def _fit(image: Image, room: Image) -> None:
    """Put an image into its panel, keeping its shape."""
    bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    height, width = bgr.shape[:2]
    scale = min(PANEL_W / width, PANEL_H / height)
    w, h = round(width * scale), round(height * scale)
    u, v = (PANEL_W - w) // 2, (PANEL_H - h) // 2
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    room[v : v + h, u : u + w] = cv2.resize(bgr, (w, h), interpolation=how)


def _label(canvas: Image, u: int, text: str) -> None:
    (width, _), _ = cv2.getTextSize(text, FONT, 0.46, 1)
    canvas[0:26, u : u + width + 18] //= 3
    cv2.putText(canvas, text, (u + 9, 18), FONT, 0.46, WHITE, 1, cv2.LINE_AA)


def _figures(canvas: Image, seconds: float, newest: Newest) -> None:
    """Time, speed, baseline and state, each at its own place so that nothing jumps about."""
    v = newest.vehicle.v_ned_m_s if newest.vehicle else (0.0, 0.0, 0.0)
    limit = newest.governed.limit_m_s if newest.governed else math.nan
    state = str(newest.gate.state).upper() if newest.gate is not None else ""
    reason = newest.gate.reason if newest.gate is not None else None
    _write(canvas, 14, f"{seconds:6.1f} s")
    _write(canvas, 160, f"{math.hypot(v[0], v[1]):4.1f} m/s")
    _write(canvas, 262, f"limit {limit:3.1f}" if math.isfinite(limit) else "", DIM)
    if newest.baseline is not None:
        _slider(canvas, 500, newest.baseline.baseline_m)
        _write(canvas, 742, f"baseline {1e3 * newest.baseline.baseline_m:3.0f} mm")
    _write(canvas, 910, state)
    _write(canvas, 1010, reason.text if reason is not None and state != "ENGAGED" else "", DIM, 0.48)


def _write(canvas: Image, u: int, text: str, colour: tuple[int, int, int] = WHITE, size: float = 0.56) -> None:
    cv2.putText(canvas, text, (u, PANEL_H + 26), FONT, size, colour, 1, cv2.LINE_AA)


def _slider(canvas: Image, u: int, baseline_m: float) -> None:
    """The two eyes drawn apart as they are: 0.7 px per millimetre."""
    middle, v = u + 110, PANEL_H + LINE_H // 2
    widest = round(350 * MAX_BASELINE_M)
    cv2.line(canvas, (middle - widest, v), (middle + widest, v), (90, 84, 80), 2, cv2.LINE_AA)
    half = round(350 * float(np.clip(baseline_m, 0.5 * MIN_BASELINE_M, MAX_BASELINE_M)))
    colour = baseline_bgr(baseline_m)
    cv2.line(canvas, (middle - half, v), (middle + half, v), colour, 4, cv2.LINE_AA)
    for eye in (middle - half, middle + half):
        cv2.circle(canvas, (eye, v), 7, colour, -1, cv2.LINE_AA)
        cv2.circle(canvas, (eye, v), 7, WHITE, 1, cv2.LINE_AA)
