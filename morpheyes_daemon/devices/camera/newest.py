"""One slot between whoever receives pairs and the one who reads them: newest wins, failures arrive in turn."""

from __future__ import annotations

import asyncio

from morpheyes_daemon.errors import DeviceError, DeviceTimeoutError
from morpheyes_daemon.messages.core import RawPair


class NewestPair:
    """Filled from the event loop; `dropped` counts pairs that nobody took."""

    def __init__(self) -> None:
        self.dropped = 0
        self._pair: RawPair | None = None
        self._failure: DeviceError | None = None
        self._changed = asyncio.Event()

    def put(self, pair: RawPair) -> None:
        """Replace what is there."""
        self.dropped += self._pair is not None
        self._pair = pair
        self._changed.set()

    def fail(self, error: DeviceError) -> None:
        """Let every read from now on raise `error`, after a pair that is still there was taken."""
        self._failure = error
        self._changed.set()

    async def take(self, timeout_s: float, silence: str) -> RawPair:
        """Wait for a pair; DeviceTimeoutError saying `silence` after `timeout_s`."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._changed.wait()
        except TimeoutError:
            raise DeviceTimeoutError(silence) from None
        pair, self._pair = self._pair, None
        if self._failure is None:
            self._changed.clear()
        if pair is not None:
            return pair
        assert self._failure is not None
        raise self._failure
