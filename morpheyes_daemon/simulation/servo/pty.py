"""A serial port without hardware: the twin holds one end, the daemon opens the other by name like any device.

For real time only; lockstep uses devices.link.MemoryLink. Works where there are Unix pseudo-terminals.
"""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Callable

CHUNK = 4096


class PseudoTerminal:
    """The device's end of a serial cable; `path` is what the daemon opens. Bytes arrive at `on_bytes`."""

    def __init__(self, on_bytes: Callable[[bytes], None]) -> None:
        self._on_bytes = on_bytes
        self._master, self._slave = os.openpty()  # our own slave keeps the master readable while nobody is there
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.lost_bytes = 0
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._master, self._read)

    def write(self, data: bytes) -> None:
        """Send without waiting; what nobody reads is dropped and counted, as on a real wire."""
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        self.lost_bytes += len(data) - sent

    def close(self) -> None:
        """Unplug; the daemon's end sees a hang-up. May be called twice."""
        if self._master >= 0:
            self._loop.remove_reader(self._master)
            os.close(self._master)
            os.close(self._slave)
            self._master = -1

    def _read(self) -> None:
        self._on_bytes(os.read(self._master, CHUNK))
