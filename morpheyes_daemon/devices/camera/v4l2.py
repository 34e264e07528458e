"""A side-by-side UVC camera: both eyes in one image, so they are exposed together by construction.

OpenCV's capture blocks, so it lives in a thread that hands each pair to the event loop. A camera that hangs is left
to its thread and reported; nothing here waits for it.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import cv2
import numpy as np

from morpheyes_daemon.clock import MS, Clock, S
from morpheyes_daemon.config.vehicle import V4l2CameraConfig
from morpheyes_daemon.devices.camera.newest import NewestPair
from morpheyes_daemon.devices.camera.recording import halves
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.errors import DeviceError, DeviceLostError, DeviceNotFoundError, InputError
from morpheyes_daemon.messages.core import RawPair, frozen

PATIENCE_PERIODS = 5.0
SHORTEST_PATIENCE_S = 1.0
CLOSE_PATIENCE_S = 1.0
STAMP_CREDIBLE_NS = S
"""A driver's stamp older than this against our clock counts another clock's time."""


class Capture(Protocol):
    """The part of cv2.VideoCapture that is used."""

    def isOpened(self) -> bool:
        """Return whether the device is open."""
        ...

    def grab(self) -> bool:
        """Take the next frame without decoding it; False when there is none."""
        ...

    def retrieve(self) -> tuple[bool, Any]:
        """Return whether the frame taken could be decoded, and the image."""
        ...

    def get(self, prop: int) -> float:
        """Return a property (cv2.CAP_PROP_*)."""
        ...

    def set(self, prop: int, value: float) -> bool:
        """Set a property (cv2.CAP_PROP_*); False when the driver refuses."""
        ...

    def release(self) -> None:
        """Close the device."""
        ...


def open_capture(device: str) -> Capture:
    """Open a V4L2 device by path through OpenCV."""
    capture: Capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
    return capture


class V4l2Camera:
    """A `Camera` over a V4L2 device; `opener` is for another source of the same shape."""

    @classmethod
    def from_config(cls, config: V4l2CameraConfig, context: DeviceContext) -> V4l2Camera:
        """Build the backend `v4l2`."""
        return cls(config, context.clock)

    def __init__(self, config: V4l2CameraConfig, clock: Clock, opener: Callable[[str], Capture] = open_capture) -> None:
        self._config, self._clock, self._opener = config, clock, opener
        self._patience_s = max(SHORTEST_PATIENCE_S, PATIENCE_PERIODS / config.rate_hz)
        self._newest = NewestPair()
        self._grabber: _Grabber | None = None

    async def open(self) -> None:
        """Open and configure the camera; DeviceNotFoundError, or DeviceError when it cannot do the size."""
        if self._grabber is None:
            capture = await asyncio.to_thread(self._configured)
            self._newest = NewestPair()
            self._grabber = _Grabber(capture, self._config, self._clock, self._newest)
            self._grabber.start()

    async def read(self) -> RawPair:
        """Return the newest pair; DeviceTimeoutError when the camera is silent, DeviceLostError when it is gone."""
        if self._grabber is None:
            raise DeviceLostError(f"The camera {self._config.device} is not open.")
        return await self._newest.take(
            self._patience_s,
            f"The camera {self._config.device} delivered no image for {self._patience_s:g} s; check its cable.",
        )

    async def close(self) -> None:
        """Stop the thread; one that hangs in the driver is abandoned after a moment."""
        grabber, self._grabber = self._grabber, None
        if grabber is not None:
            grabber.stop.set()
            await asyncio.to_thread(grabber.join, CLOSE_PATIENCE_S)

    def _configured(self) -> Capture:
        config = self._config
        capture = self._opener(config.device)
        if not capture.isOpened():
            raise DeviceNotFoundError(
                f"The camera {config.device} cannot be opened; check that it is plugged in and not in use, "
                "and that this user is in the group video."
            )
        fourcc = cv2.VideoWriter.fourcc(*"MJPG")  # uncompressed pairs do not fit USB 2 at useful rates
        capture.set(cv2.CAP_PROP_FOURCC, fourcc)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, 2 * config.width_px)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height_px)
        capture.set(cv2.CAP_PROP_FPS, config.rate_hz)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        size = round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if size != (2 * config.width_px, config.height_px):
            capture.release()
            raise DeviceError(
                f"The camera {config.device} offers images of {size[0]}×{size[1]} instead of two times "
                f"{config.width_px}×{config.height_px} side by side; set camera.width_px and camera.height_px."
            )
        return capture


class _Grabber(threading.Thread):
    """Waits in the driver so that nobody else must; owns the capture and releases it."""

    def __init__(self, capture: Capture, config: V4l2CameraConfig, clock: Clock, newest: NewestPair) -> None:
        super().__init__(name=f"camera {config.device}", daemon=True)
        self._capture, self._config, self._clock, self._newest = capture, config, clock, newest
        self._loop = asyncio.get_running_loop()
        self._seq = 0
        self.stop = threading.Event()

    def run(self) -> None:
        try:
            while not self.stop.is_set():
                self._hand_over(partial(self._newest.put, self._next()))
        except (DeviceError, InputError, cv2.error) as error:
            lost = error if isinstance(error, DeviceError) else DeviceLostError(f"{self._config.device}: {error}")
            self._hand_over(partial(self._newest.fail, lost))
        finally:
            self._capture.release()

    def _next(self) -> RawPair:
        if not self._capture.grab():
            raise DeviceLostError(f"The camera {self._config.device} stopped delivering images; is it unplugged?")
        t_ns = self._stamp_ns(self._clock.now_ns())
        good, image = self._capture.retrieve()
        if not good:
            raise DeviceLostError(f"The camera {self._config.device} delivers images that cannot be decoded.")
        left, right = halves(np.asarray(image, dtype=np.uint8), self._config.device)
        if self._config.swap_eyes:
            left, right = right, left
        self._seq += 1
        return RawPair(self._seq, t_ns, frozen(left), frozen(right))

    def _stamp_ns(self, now_ns: int) -> int:
        """Return the driver's stamp (V4L2 counts the monotonic clock), or the time of arrival when it has none."""
        driver_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * MS)
        return driver_ns if 0 <= now_ns - driver_ns < STAMP_CREDIBLE_NS else now_ns

    def _hand_over(self, action: Callable[[], None]) -> None:
        if not self.stop.is_set() and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(action)
