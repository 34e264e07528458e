"""The autopilot twin on a TCP port, as ArduPilot's own simulator offers it.

Every client is a telemetry port of its own: a daemon, a ground station and a ground crew can be connected at once.
A client that does not read loses bytes, never the others' time.
"""

from __future__ import annotations

import asyncio
from types import TracebackType

from morpheyes_daemon.errors import DeviceNotFoundError
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin

_MOST_BUFFERED = 256 * 1024
_CHUNK = 4096


class _Client:
    """One connection as a byte link; what does not fit the buffer is dropped and counted."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        self.dropped = 0

    def write(self, data: bytes) -> None:
        transport = self._writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > _MOST_BUFFERED:
            self.dropped += len(data)
            return
        transport.write(data)


class MavlinkServer:
    """Serves `twin` on `host:port` while it is open: `async with MavlinkServer(twin, port=0) as server:`."""

    def __init__(self, twin: AutopilotTwin, host: str = "127.0.0.1", port: int = 5760) -> None:
        self._twin = twin
        self._host, self._port = host, port
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._serving: set[asyncio.Task[None]] = set()

    @property
    def url(self) -> str:
        """Where a daemon connects, `tcp:HOST:PORT`."""
        assert self._server is not None, "the server is not open"
        return f"tcp:{self._host}:{self._server.sockets[0].getsockname()[1]}"

    async def __aenter__(self) -> MavlinkServer:
        """Open the port; raises DeviceNotFoundError when it is taken."""
        try:
            self._server = await asyncio.start_server(self._serve, self._host, self._port)
        except OSError as error:
            reason = error.strerror or error
            raise DeviceNotFoundError(
                f"port {self._port} cannot be opened for the simulated autopilot ({reason}); choose another."
            ) from None
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port and every connection."""
        assert self._server is not None
        self._server.close()
        for writer in list(self._writers):
            writer.close()
        await asyncio.gather(*self._serving, return_exceptions=True)
        await self._server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client, task = _Client(writer), asyncio.current_task()
        assert task is not None
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)
        receive = self._twin.attach(client)
        self._writers.add(writer)
        try:
            while data := await reader.read(_CHUNK):
                receive(data)
        except ConnectionError:
            pass
        finally:
            self._twin.detach(client)
            self._writers.discard(writer)
            writer.close()
