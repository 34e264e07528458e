"""The places where a fault can get between the daemon and its simulated hardware: links, camera, worker.

Each stands in for the real thing, does nothing until it is told to, and is told by a function, so that
`faults.py` can say in a line what a fault does. The daemon cannot tell the difference.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import replace

from morpheyes_daemon.clock import Clock
from morpheyes_daemon.devices.camera import Camera
from morpheyes_daemon.devices.link import Link, LinkOpener, OnBytes, OnLost
from morpheyes_daemon.errors import DeviceLostError, DeviceNotFoundError
from morpheyes_daemon.messages.core import Perception, RawPair
from morpheyes_daemon.perception.pipeline import VisionJob
from morpheyes_daemon.vision_worker.inline import VisionWorker, WorkerLost

Passage = Callable[[bytes, OnBytes], None]
"""What becomes of bytes on their way: it hands on to the second argument whatever arrives."""

Retouch = Callable[[RawPair], RawPair]


def pass_on(data: bytes, deliver: OnBytes) -> None:
    """Nothing happens on the way."""
    deliver(data)


def lose(data: bytes, deliver: OnBytes) -> None:
    """Nothing arrives."""


def double(data: bytes, deliver: OnBytes) -> None:
    """Everything arrives twice."""
    deliver(data)
    deliver(data)


def cut_short(rng: random.Random) -> Passage:
    """Every fifth piece loses its end."""

    def passage(data: bytes, deliver: OnBytes) -> None:
        deliver(data[: rng.randrange(len(data))] if rng.random() < 0.2 else data)

    return passage


def add_noise(rng: random.Random) -> Passage:
    """Random bytes arrive between the pieces."""

    def passage(data: bytes, deliver: OnBytes) -> None:
        deliver(rng.randbytes(rng.randrange(60)))
        deliver(data)

    return passage


def swap_neighbours() -> Passage:
    """Every second piece is overtaken by the next."""
    held: list[bytes] = []

    def passage(data: bytes, deliver: OnBytes) -> None:
        if not held:
            held.append(data)
            return
        deliver(data)
        deliver(held.pop())

    return passage


class Wire:
    """A link to the autopilot or the Teensy, with a passage each way; `on_sent` sees what the daemon sends."""

    def __init__(self, opener: LinkOpener) -> None:
        self._opener = opener
        self.incoming: Passage = pass_on
        self.outgoing: Passage = pass_on
        self.on_sent: OnBytes = lambda data: None
        self.plugged = True
        self._links: list[tuple[Link, OnBytes, OnLost]] = []

    async def open(self, url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
        """Open the link behind it; raises DeviceNotFoundError while unplugged."""
        if not self.plugged:
            raise DeviceNotFoundError(f"{url} is not there: plug it in.")
        link = await self._opener(url, lambda data: self.incoming(data, on_bytes), on_lost)
        self._links.append((link, on_bytes, on_lost))
        return _WireEnd(self, link)

    def inject(self, data: bytes) -> None:
        """Let bytes arrive at the daemon that nobody sent."""
        if self._links:
            self._links[-1][1](data)

    def unplug(self) -> None:
        """The port goes away."""
        self.plugged = False
        self.incoming = self.outgoing = lose
        for _, _, on_lost in self._links[-1:]:
            on_lost("unplugged")

    def send(self, link: Link, data: bytes) -> None:
        """Pass on what the daemon sends."""
        self.on_sent(data)
        self.outgoing(data, link.write)


class _WireEnd:
    def __init__(self, wire: Wire, link: Link) -> None:
        self._wire, self._link = wire, link

    def write(self, data: bytes) -> None:
        self._wire.send(self._link, data)

    def close(self) -> None:
        self._link.close()


class FaultyCamera:
    """A camera that can stall, go away, or see what is not there."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.stalled = False
        self.plugged = True
        self.retouch: Retouch = lambda pair: pair

    async def open(self) -> None:
        """See Camera."""
        if not self.plugged:
            raise DeviceNotFoundError("The camera is not there: plug it in.")
        await self._camera.open()

    async def read(self) -> RawPair:
        """See Camera; a pair that was exposed while stalled is never delivered."""
        pair = await self._camera.read()
        while self.stalled:
            await asyncio.sleep(0.02)
            if not self.stalled:
                pair = await self._camera.read()
        if not self.plugged:
            raise DeviceLostError("The camera went away: plug it in again.")
        return self.retouch(pair)

    async def close(self) -> None:
        """See Camera."""
        await self._camera.close()


def frozen_picture() -> Retouch:
    """The same picture for ever, with new stamps."""
    first: list[RawPair] = []

    def retouch(pair: RawPair) -> RawPair:
        first.append(pair)
        return replace(pair, left=first[0].left, right=first[0].right)

    return retouch


def swapped_eyes(pair: RawPair) -> RawPair:
    """The right eye's picture comes from the left and the other way round."""
    return replace(pair, left=pair.right, right=pair.left)


def black_eye(pair: RawPair) -> RawPair:
    """The right eye sees nothing."""
    return replace(pair, right=pair.right * 0)


class FaultyWorker:
    """A vision worker that can be slow, hung until it is killed, or gone: `gone` is raised by every job while set."""

    def __init__(self, worker: VisionWorker[VisionJob, Perception], clock: Clock) -> None:
        self._worker, self._clock = worker, clock
        self.extra_ns = 0
        self.hung_s: float | None = None
        self.gone: Exception | None = None

    async def start(self) -> None:
        """See VisionWorker."""
        await self._worker.start()

    async def compute(self, job: VisionJob) -> Perception:
        """See VisionWorker."""
        if self.hung_s is not None:
            await asyncio.sleep(self.hung_s)
            raise WorkerLost(f"The vision worker did not finish within {self.hung_s:g} s and was killed.")
        if self.gone is not None:
            raise self.gone
        result = await self._worker.compute(job)
        if self.extra_ns:
            await self._clock.sleep_until_ns(self._clock.now_ns() + self.extra_ns)
        return result

    async def close(self) -> None:
        """See VisionWorker."""
        await self._worker.close()
