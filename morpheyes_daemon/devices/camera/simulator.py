"""The cameras of a simulator in another process: a client of its frame socket."""

from __future__ import annotations

import asyncio
import contextlib

from morpheyes_daemon.config.vehicle import CameraBase, SimCameraConfig
from morpheyes_daemon.devices.camera.newest import NewestPair
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.errors import ConfigError, DeviceLostError, DeviceNotFoundError
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.wire.frames import (
    HEADER_BYTES,
    TcpAddress,
    decode_header,
    decode_pair,
    parse_address,
)

READ_BUFFER_BYTES = 8 << 20
"""A 1280×960 colour pair; smaller buffers make the loop wake more often per frame."""
PATIENCE_PERIODS = 5.0
SHORTEST_PATIENCE_S = 1.0


class SimulatorCamera:
    """A `Camera` that receives what simulation.frame_server sends. ConfigError when the address is none."""

    @classmethod
    def from_config(cls, config: SimCameraConfig, context: DeviceContext) -> SimulatorCamera:
        """Build the backend `sim`; raises ConfigError without the address of a simulator's socket."""
        if config.address is None:
            raise ConfigError(
                "camera.backend is sim without an address, which only `morpheyes sim` can fly; "
                "set camera.backend to v4l2 or recording, or camera.address to a simulator's socket."
            )
        return cls(config.address, config)

    def __init__(self, address: str, config: CameraBase) -> None:
        self._text, self._address, self._config = address, parse_address(address), config
        self._patience_s = max(SHORTEST_PATIENCE_S, PATIENCE_PERIODS / config.rate_hz)
        self._newest = NewestPair()
        self._receiver: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Connect; DeviceNotFoundError when no simulator listens there."""
        if self._receiver is not None:
            return
        try:
            reader, writer = await self._connect()
        except OSError as error:
            raise DeviceNotFoundError(
                f"No simulator serves frames at {self._text} ({error.strerror or error}); start it first."
            ) from None
        self._newest = NewestPair()
        self._receiver = asyncio.get_running_loop().create_task(
            self._receive(reader, writer, self._newest), name="simulated camera"
        )

    async def read(self) -> RawPair:
        """Return the newest pair; DeviceTimeoutError when none comes, DeviceLostError when the simulator is gone."""
        if self._receiver is None:
            raise DeviceLostError("The simulated camera is not open.")
        return await self._newest.take(
            self._patience_s, f"The simulator at {self._text} sent no frame for {self._patience_s:g} s."
        )

    async def close(self) -> None:
        """Disconnect."""
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.cancel()
            await asyncio.gather(receiver, return_exceptions=True)

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        if isinstance(self._address, TcpAddress):
            return await asyncio.open_connection(self._address.host, self._address.port, limit=READ_BUFFER_BYTES)
        return await asyncio.open_unix_connection(self._address.path, limit=READ_BUFFER_BYTES)

    async def _receive(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, newest: NewestPair) -> None:
        try:
            while True:
                newest.put(await self._next(reader))
        except (EOFError, OSError):
            newest.fail(DeviceLostError(f"The simulator at {self._text} closed its frame socket."))
        except ValueError as error:
            newest.fail(DeviceLostError(f"What {self._text} sends cannot be used: {error}."))
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def _next(self, reader: asyncio.StreamReader) -> RawPair:
        header = decode_header(await reader.readexactly(HEADER_BYTES))
        config = self._config
        if (header.width_px, header.height_px) != (config.width_px, config.height_px):
            raise ValueError(
                f"its images are {header.width_px}×{header.height_px}, "
                f"camera.width_px and height_px say {config.width_px}×{config.height_px}"
            )
        return decode_pair(header, await reader.readexactly(header.pair_bytes))
