"""What the flight log holds for each value of a topic: one channel per topic, and extra ones that viewers draw.

`/vehicle`, `/command` … carry our dataclasses; `/pose`, `/image/left`, `/image/depth` and `/events` follow
Foxglove's schemas. Nothing here touches a file.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from morpheyes_daemon.messages.core import Event, FloatMap, Image, Perception, VehicleState
from morpheyes_daemon.recorder.encoding import to_plain, type_name
from morpheyes_daemon.recorder.schemas import dataclass_schema, schema_text, timestamp
from morpheyes_daemon.stereo.colours import colour_depth
from morpheyes_daemon.transforms import R_from_rpy, q_from_R

EVENTS = "/events"
LEFT_IMAGE = "/image/left"
DEPTH_IMAGE = "/image/depth"
IMAGE_WIDTH_PX = 320
JPEG_QUALITY = 70
_WARNING = 3
_INFO = 2


@dataclass(frozen=True, slots=True)
class Entry:
    """One message of the log: where it goes, what describes it, and what it says."""

    channel: str
    schema_name: str
    schema: bytes
    payload: dict[str, Any]


def entries(topic: str, t_ns: int, value: Any, *, images: bool) -> Iterator[Entry]:
    """Yield what `value`, published on `topic`, leaves in the log; `images` lets pictures through."""
    if isinstance(value, Event):
        yield event_entry(value)
        return
    payload = to_plain(value)
    if isinstance(payload, dict):
        cls: type = type(value)
        yield Entry(f"/{topic}", type_name(cls), dataclass_schema(cls), payload)
    if isinstance(value, VehicleState) and value.position_t_ns:
        yield pose_entry(value)
    if isinstance(value, Perception) and images:
        yield from image_entries(value)


def event_entry(event: Event) -> Entry:
    """An event as Foxglove's log line, the event itself inside."""
    payload = {
        "timestamp": timestamp(event.t_ns),
        "level": _INFO if event.reason.number < 20 else _WARNING,
        "message": f"{event.reason.text}: {event.text}" if event.text else event.reason.text,
        "name": event.source,
        "file": "",
        "line": 0,
        "event": to_plain(event),
    }
    return _foxglove(EVENTS, "Log", payload)


def pose_entry(vehicle: VehicleState) -> Entry:
    """Where the vehicle is and how it is turned, in ned."""
    w, x, y, z = (float(c) for c in q_from_R(R_from_rpy(vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad)))
    north, east, down = (float(c) for c in vehicle.p_ned_m)
    pose = {"position": {"x": north, "y": east, "z": down}, "orientation": {"x": x, "y": y, "z": z, "w": w}}
    payload = {"timestamp": timestamp(vehicle.position_t_ns), "frame_id": "ned", "pose": pose}
    return _foxglove("/pose", "PoseInFrame", payload)


def ned_entry(t_ns: int) -> Entry:
    """Tells a viewer, whose z points up, how ned lies in it: east, north, up."""
    half = 0.5**0.5
    payload = {
        "timestamp": timestamp(t_ns),
        "parent_frame_id": "enu",
        "child_frame_id": "ned",
        "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
        "rotation": {"x": half, "y": half, "z": 0.0, "w": 0.0},
    }
    return _foxglove("/frames", "FrameTransform", payload)


def image_entries(perception: Perception) -> Iterator[Entry]:
    """Yield the left image and the coloured depth, when perception carries them."""
    t_ns = perception.summary.t_ns
    if perception.left_rect is not None:
        yield _image_entry(LEFT_IMAGE, t_ns, _small(perception.left_rect))
    if perception.depth_m is not None:
        yield _image_entry(DEPTH_IMAGE, t_ns, colour_depth(_small_depth(perception.depth_m)))


def _small(image: Image) -> Image:
    height, width = image.shape[:2]
    if width <= IMAGE_WIDTH_PX:
        return image
    size = (IMAGE_WIDTH_PX, max(1, round(height * IMAGE_WIDTH_PX / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _small_depth(depth_m: FloatMap) -> FloatMap:
    """Every n-th pixel: an average over an edge would be a depth that nothing has."""
    step = max(1, -(-depth_m.shape[1] // IMAGE_WIDTH_PX))
    return depth_m[::step, ::step]


def _image_entry(channel: str, t_ns: int, image: Image) -> Entry:
    _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    data = base64.b64encode(jpeg.tobytes()).decode("ascii")
    payload = {"timestamp": timestamp(t_ns), "frame_id": "rect", "data": data, "format": "jpeg"}
    return _foxglove(channel, "CompressedImage", payload)


def _foxglove(channel: str, name: str, payload: dict[str, Any]) -> Entry:
    return Entry(channel, f"foxglove.{name}", schema_text(f"foxglove.{name}"), payload)
