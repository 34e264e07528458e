"""Byte links to the Teensy and the autopilot, named by URL, and the in-memory pair that lockstep runs on.

`tcp:HOST:PORT` connects, `udp:HOST:PORT` connects and sends first, `udpin:HOST:PORT` listens,
`serial:DEVICE[:BAUD]` opens a port through pyserial-asyncio. A link knows nothing of what the bytes mean.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import termios
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any, Protocol, cast

import serial
import serial_asyncio

from morpheyes_daemon.errors import ConfigError, DeviceNotFoundError

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
        self._arriving: deque[bytes] = deque()

    @classmethod
    def pair(cls, delay_s: float = 0.0) -> tuple[MemoryLink, MemoryLink]:
        """Return two connected ends; set `on_bytes` on each before writing to the other."""
        a, b = cls(delay_s), cls(delay_s)
        a._peer, b._peer = b, a
        return a, b

    def write(self, data: bytes) -> None:
        """Deliver `data` to the other end after the delay; dropped when either end is closed."""
        if self.closed or self._peer is None:
            return
        self._peer._arriving.append(data)
        self._loop.call_later(self._delay_s, self._peer._deliver)

    def _deliver(self) -> None:
        """Hand over the oldest; asyncio does not keep the order of timers that are due at the same time."""
        data = self._arriving.popleft()
        if not self.closed and self.on_bytes is not None:
            self.on_bytes(data)

    def close(self) -> None:
        """Close this end; what is still under way is dropped."""
        self.closed = True


WRITE_LIMIT_BYTES = 4096
"""Bytes that may wait in a link; more means that the port has stopped taking them, and old sticks help nobody."""
CONNECT_TIMEOUT_S = 3.0
CLOSE_TIMEOUT_S = 0.2


async def open_link(url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
    """Open the link that `url` names, see the module's text.

    Raises ConfigError for an address that cannot be meant, DeviceNotFoundError when nothing can be opened there.
    """
    scheme, _, address = url.partition(":")
    opener = _OPENERS.get(scheme)
    if opener is None:
        raise ConfigError(f"{url}: unknown link '{scheme}', write {', '.join(f'{s}:' for s in _OPENERS)}.")
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            return await opener(url, address, on_bytes, on_lost)
    except TimeoutError:
        raise DeviceNotFoundError(f"{url}: nobody answers; check the address and that the other side runs.") from None
    except (OSError, serial.SerialException) as error:
        raise DeviceNotFoundError(f"{url}: cannot be opened ({_cause(error)}).") from None


_CAUSES = {
    errno.EAGAIN: "another program has it open",
    errno.EACCES: "permission denied: is the user in the group of the device?",
    errno.ENOENT: "there is no such device: is it plugged in?",
    errno.ECONNREFUSED: "nobody listens there",
}


def _cause(error: Exception) -> str:
    """Return what the system says of an error, without the port's name that pyserial repeats."""
    number = getattr(error, "errno", None)
    if not isinstance(number, int) or number <= 0:
        return str(error)
    return _CAUSES.get(number, os.strerror(number))


class _StreamLink(asyncio.Protocol):
    """A TCP connection or a serial port. `made` resolves on connection_made, which serial calls only later."""

    def __init__(self, on_bytes: OnBytes, on_lost: OnLost) -> None:
        self._on_bytes = on_bytes
        self._on_lost = on_lost
        self._transport: asyncio.Transport | None = None
        self._closing = False
        self.made: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.dropped_bytes = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        if not self.made.done():
            self.made.set_result(None)

    def data_received(self, data: bytes) -> None:
        if not self._closing:
            self._on_bytes(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if not self._closing:
            self._on_lost("the other side closed it" if exc is None else _cause(exc))

    def write(self, data: bytes) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        if transport.get_write_buffer_size() + len(data) > WRITE_LIMIT_BYTES:
            self.dropped_bytes += len(data)
            return
        transport.write(data)

    def close(self) -> None:
        """Let what is written go out, then close; a port that takes no more bytes is cut a moment later."""
        self._closing = True
        if self._transport is not None:
            self._transport.close()
            asyncio.get_running_loop().call_later(CLOSE_TIMEOUT_S, self._cut)

    def _cut(self) -> None:
        transport = self._transport
        if transport is None:
            return
        port = transport.get_extra_info("serial")
        if port is not None:
            with contextlib.suppress(OSError, termios.error, serial.SerialException):
                port.reset_output_buffer()  # or pyserial would wait for a stuck port to drain, blocking the loop
        transport.abort()


class _DatagramLink(asyncio.DatagramProtocol):
    """UDP; when listening, the first sender becomes the peer until the link is opened again."""

    def __init__(self, on_bytes: OnBytes, on_lost: OnLost, listens: bool) -> None:
        self._on_bytes = on_bytes
        self._on_lost = on_lost
        self._listens = listens
        self._peer: Any = None
        self._transport: asyncio.DatagramTransport | None = None
        self._closing = False
        self._paused = False
        self.dropped_bytes = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._listens and self._peer is None:
            self._peer = addr
        if not self._closing and (not self._listens or addr == self._peer):
            self._on_bytes(data)

    def pause_writing(self) -> None:
        self._paused = True

    def resume_writing(self) -> None:
        self._paused = False

    def error_received(self, exc: Exception) -> None:
        """A datagram was refused: the other side is not up yet; silence is judged by the link's owner."""

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if not self._closing:
            self._on_lost("the socket closed" if exc is None else _cause(exc))

    def write(self, data: bytes) -> None:
        if self._transport is None or (self._listens and self._peer is None):
            return
        if self._paused:
            self.dropped_bytes += len(data)
            return
        self._transport.sendto(data, self._peer if self._listens else None)

    def close(self) -> None:
        self._closing = True
        if self._transport is not None:
            self._transport.close()


async def _open_tcp(url: str, address: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
    host, port = _host_port(url, address)
    _, link = await asyncio.get_running_loop().create_connection(lambda: _StreamLink(on_bytes, on_lost), host, port)
    return link


async def _open_udp(url: str, address: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
    where = _host_port(url, address)
    _, link = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: _DatagramLink(on_bytes, on_lost, listens=False), remote_addr=where
    )
    return link


async def _open_udpin(url: str, address: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
    where = _host_port(url, address)
    _, link = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: _DatagramLink(on_bytes, on_lost, listens=True), local_addr=where
    )
    return link


async def _open_serial(url: str, address: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
    device, colon, baud = address.rpartition(":")
    if not colon or not baud.isdigit():
        device, baud = address, "115200"
    if not device:
        raise ConfigError(f"{url}: no device, write serial:/dev/NAME:BAUD.")
    link = _StreamLink(on_bytes, on_lost)
    try:
        await serial_asyncio.create_serial_connection(
            asyncio.get_running_loop(), lambda: link, device, baudrate=int(baud), exclusive=True
        )
    except ValueError as error:
        raise ConfigError(f"{url}: not a serial port that can be set up ({error}).") from None
    await link.made
    return link


def _host_port(url: str, address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ConfigError(f"{url}: not an address, write {url.partition(':')[0]}:HOST:PORT.")
    return host.strip("[]"), int(port)


_OPENERS: dict[str, Callable[[str, str, OnBytes, OnLost], Awaitable[Link]]] = {
    "tcp": _open_tcp,
    "udp": _open_udp,
    "udpin": _open_udpin,
    "serial": _open_serial,
}
