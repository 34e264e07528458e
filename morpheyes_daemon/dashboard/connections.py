"""How many connections the page's server takes, in all and from one address, and for how long an idle one stays."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

CONNECTIONS, CONNECTIONS_EACH = 64, 24
"""Open connections in all, and from one address; further ones are closed at once. Chosen: a browser opens six."""
IDLE_S = 15.0
"""A connection without a request is closed after this."""


def limited(factory: Callable[[], asyncio.Protocol], open_now: Counter[str]) -> Callable[[], asyncio.Protocol]:
    """Return a protocol factory whose connections are counted in `open_now` and closed at once beyond the limits."""

    def make() -> asyncio.Protocol:
        return _Limited(factory(), open_now)

    return make


class _Limited(asyncio.Protocol):
    """Passes everything on to aiohttp's protocol, unless there are too many connections; idle ones are cut."""

    def __init__(self, inner: asyncio.Protocol, open_now: Counter[str]) -> None:
        self._inner = inner
        self._open = open_now
        self._address: str | None = None
        self._idle: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        peer = transport.get_extra_info("peername")
        address = str(peer[0]) if peer else ""
        if self._open.total() >= CONNECTIONS or self._open[address] >= CONNECTIONS_EACH:
            assert isinstance(transport, asyncio.Transport)
            transport.abort()
            return
        self._address = address
        self._open[address] += 1
        self._idle = asyncio.get_running_loop().call_later(IDLE_S, self._cut, transport)
        self._inner.connection_made(transport)

    def _cut(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.abort()

    def data_received(self, data: bytes) -> None:
        if self._idle is not None:
            self._idle.cancel()  # from the first byte on aiohttp's own time limits hold
            self._idle = None
        if self._address is not None:
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return self._inner.eof_received() if self._address is not None else None

    def pause_writing(self) -> None:
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._idle is not None:
            self._idle.cancel()
        if self._address is not None:
            self._open[self._address] -= 1
            self._inner.connection_lost(exc)
