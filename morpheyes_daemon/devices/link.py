"""Byte links to the Teensy and the autopilot, named by URL, and the in-memory pair that lockstep runs on.

`tcp:HOST:PORT` connects, `udp:HOST:PORT` connects and sends first, `udpin:HOST:PORT` listens,
`serial:DEVICE[:BAUD]` opens a port through pyserial-asyncio. A link knows nothing of what the bytes mean.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Protocol

OnBytes = Callable[[bytes], None]
OnLost = Callable[[str], None]


class Link(Protocol):
    """An open byte link. Reception and loss arrive through the callbacks given on opening."""

    def write(self, data: bytes) -> None:
        """Send without blocking; a link whose buffer is full drops the bytes and counts them."""

    def close(self) -> None:
        """Close; `on_lost` is not called for a close that was asked for."""


LinkOpener = Callable[[str, OnBytes, OnLost], Awaitable[Link]]
"""(url, on_bytes, on_lost) -> open link; raises DeviceNotFoundError or ConfigError (unknown scheme)."""


class MemoryLink:
    """One end of an in-memory link on the running loop; bytes arrive at the other end after `delay_s`."""

    def __init__(self, delay_s: float = 0.0) -> None:
        self._loop = asyncio.get_running_loop()
        self._delay_s = delay_s
        self._peer: MemoryLink | None = None
        self.on_bytes: OnBytes | None = None
        self.on_lost: OnLost | None = None
        self.closed = False

    @classmethod
    def pair(cls, delay_s: float = 0.0) -> tuple[MemoryLink, MemoryLink]:
        """Return two connected ends; set `on_bytes` on each before writing to the other."""
        a, b = cls(delay_s), cls(delay_s)
        a._peer, b._peer = b, a
        return a, b

    def write(self, data: bytes) -> None:
        if self.closed or self._peer is None:
            return
        self._loop.call_later(self._delay_s, self._peer._deliver, data)

    def _deliver(self, data: bytes) -> None:
        if not self.closed and self.on_bytes is not None:
            self.on_bytes(data)

    def close(self) -> None:
        self.closed = True
