"""Serves the camera twin's pairs on a socket, so that a daemon in another process sees them.

Each pair goes to every daemon that has taken the previous one; one that is slow misses pairs instead of getting old
ones. Pairs are rendered only while somebody is connected. What is rendered, and how fast, is the source's business.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Awaitable, Callable

from morpheyes_daemon.clock import Clock, Ticker
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.wire.frames import TcpAddress, encode_pair, parse_address


class FrameServer:
    """Calls `source` at `rate_hz` and sends what it returns; `dropped` counts pairs a client was too slow for."""

    def __init__(self, address: str, source: Callable[[], Awaitable[RawPair]], clock: Clock, rate_hz: float) -> None:
        self._address, self._source = parse_address(address), source
        self._clock, self._rate_hz = clock, rate_hz
        self._clients: set[asyncio.StreamWriter] = set()
        self._somebody = asyncio.Event()
        self.listening = asyncio.Event()
        self.sent = 0
        self.dropped = 0

    async def run(self) -> None:
        """Serve until cancelled; OSError when the address cannot be listened on."""
        async with self._listening():
            while True:
                await self._somebody.wait()
                ticker = Ticker(self._clock, self._rate_hz)
                while self._clients:
                    await ticker.wait()
                    self._broadcast(await self._source())

    @contextlib.asynccontextmanager
    async def _listening(self) -> AsyncIterator[None]:
        if isinstance(self._address, TcpAddress):
            server = await asyncio.start_server(self._serve, self._address.host, self._address.port)
        else:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self._address.path)  # of a simulator that was killed
            server = await asyncio.start_unix_server(self._serve, self._address.path)
        self.listening.set()
        try:
            yield
        finally:
            self.listening.clear()
            server.close()
            for client in self._clients:
                client.close()
            await server.wait_closed()
            if not isinstance(self._address, TcpAddress):
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(self._address.path)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients.add(writer)
        self._somebody.set()
        try:
            await reader.read()  # clients say nothing; this ends when they go
        except OSError:
            pass
        finally:
            self._clients.discard(writer)
            if not self._clients:
                self._somebody.clear()
            writer.close()

    def _broadcast(self, pair: RawPair) -> None:
        frame = encode_pair(pair)
        for client in self._clients:
            if client.transport.get_write_buffer_size() > 0:
                self.dropped += 1
            else:
                client.write(frame)
                self.sent += 1
