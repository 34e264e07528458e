"""Links over the real thing: TCP and UDP sockets on the loopback, and a pseudo-terminal as serial port."""

from __future__ import annotations

import asyncio
import os
import socket
import tty
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.devices.link import WRITE_LIMIT_BYTES, Link, MemoryLink, open_link
from morpheyes_daemon.errors import ConfigError, DeviceNotFoundError

Received = asyncio.Queue[bytes]


@dataclass
class Ear:
    """What a link's owner hears."""

    data: asyncio.Queue[bytes] = field(default_factory=asyncio.Queue)
    lost: asyncio.Queue[str] = field(default_factory=asyncio.Queue)

    async def open(self, url: str) -> Link:
        return await open_link(url, self.data.put_nowait, self.lost.put_nowait)

    async def hears(self, count: int) -> bytes:
        got = b""
        while len(got) < count:
            got += await self.data.get()
        return got


class Server:
    """A TCP peer that keeps its connections."""

    def __init__(self) -> None:
        self.connected: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()
        self.port = 0

    async def __aenter__(self) -> Server:
        self._server = await asyncio.start_server(lambda r, w: self.connected.put_nowait((r, w)), "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *error: object) -> None:
        self._server.close()
        while not self.connected.empty():
            self.connected.get_nowait()[1].close()


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    async with Server() as running:
        yield running


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for fd in (master, slave):
        try:
            os.close(fd)
        except OSError:
            pass  # a test closed it: the cable was pulled


async def test_tcp_carries_bytes_both_ways_and_tells_of_the_loss(server: Server) -> None:
    ear = Ear()
    link = await ear.open(f"tcp:127.0.0.1:{server.port}")
    reader, writer = await server.connected.get()
    link.write(b"hello")
    assert await reader.readexactly(5) == b"hello"
    writer.write(b"\x00\xff" * 1000)
    assert await ear.hears(2000) == b"\x00\xff" * 1000
    writer.close()
    assert "other side" in await ear.lost.get()
    link.write(b"into the void")
    link.close()


async def test_close_that_was_asked_for_is_no_loss(server: Server) -> None:
    ear = Ear()
    link = await ear.open(f"tcp:127.0.0.1:{server.port}")
    reader, writer = await server.connected.get()
    link.write(b"last words")
    link.close()
    link.close()
    assert await reader.read() == b"last words"
    assert ear.lost.empty()
    writer.close()


async def test_peer_that_stops_reading_costs_a_bounded_buffer(server: Server) -> None:
    ear = Ear()
    link = await ear.open(f"tcp:127.0.0.1:{server.port}")
    _, writer = await server.connected.get()
    for _ in range(200_000):
        link.write(bytes(100))
        if link.dropped_bytes:  # type: ignore[attr-defined]
            break
    assert link.dropped_bytes > 0  # type: ignore[attr-defined]
    assert link._transport.get_write_buffer_size() <= WRITE_LIMIT_BYTES  # type: ignore[attr-defined]
    link.close()
    writer.close()


async def test_udp_and_udpin_find_each_other() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    listening, talking, stranger = Ear(), Ear(), Ear()
    inward = await listening.open(f"udpin:127.0.0.1:{port}")
    inward.write(b"nobody is there yet")
    outward = await talking.open(f"udp:127.0.0.1:{port}")
    outward.write(b"ping")
    assert await listening.hears(4) == b"ping"
    inward.write(b"pong")
    assert await talking.hears(4) == b"pong"
    other = await stranger.open(f"udp:127.0.0.1:{port}")
    other.write(b"intruder")
    outward.write(b"still me")
    assert await listening.hears(8) == b"still me"
    for link in (inward, outward, other):
        link.close()


async def test_serial_over_a_pty(pty: tuple[int, str]) -> None:
    master, name = pty
    ear = Ear()
    link = await ear.open(f"serial:{name}:921600")
    link.write(b"to the teensy")  # at once: the port must be ready when open_link returns
    loop = asyncio.get_running_loop()
    assert await _readable(loop, master) == b"to the teensy"
    os.write(master, b"and back")
    assert await ear.hears(8) == b"and back"
    link.write(b"release")
    link.close()
    assert await _readable(loop, master) == b"release"
    assert ear.lost.empty()


async def test_serial_port_that_is_pulled_is_lost(pty: tuple[int, str]) -> None:
    master, name = pty
    ear = Ear()
    link = await ear.open(f"serial:{name}")
    os.close(master)
    assert await ear.lost.get()
    link.write(b"gone")
    link.close()


async def test_serial_port_has_one_owner(pty: tuple[int, str]) -> None:
    ear = Ear()
    link = await ear.open(f"serial:{pty[1]}:115200")
    with pytest.raises(DeviceNotFoundError, match="another program"):
        await ear.open(f"serial:{pty[1]}:115200")
    link.close()


async def _readable(loop: asyncio.AbstractEventLoop, fd: int) -> bytes:
    ready: asyncio.Future[None] = loop.create_future()
    loop.add_reader(fd, lambda: ready.done() or ready.set_result(None))
    try:
        await ready
    finally:
        loop.remove_reader(fd)
    return os.read(fd, 1000)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("bluetooth:abc", "unknown link 'bluetooth', write tcp:"),
        ("/dev/ttyACM0", "unknown link"),
        ("tcp:127.0.0.1", "write tcp:HOST:PORT"),
        ("tcp::5760", "write tcp:HOST:PORT"),
        ("udp:127.0.0.1:70000", "write udp:HOST:PORT"),
        ("udpin:x:y", "write udpin:HOST:PORT"),
        ("serial:", "write serial:/dev/NAME:BAUD"),
    ],
)
async def test_addresses_that_cannot_be_meant(url: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        await Ear().open(url)


def _closed_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp:127.0.0.1:{probe.getsockname()[1]}"


@pytest.mark.parametrize(
    ("url", "words"),
    [
        (lambda tmp: "serial:/dev/no-such-port:57600", "no such device"),
        (lambda tmp: f"serial:{tmp / 'file'}:57600", "cannot be opened"),
        (lambda tmp: _closed_port(), "nobody listens there"),
    ],
)
async def test_what_cannot_be_opened_is_one_sentence(url: Callable[[Path], str], words: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a port")
    with pytest.raises(DeviceNotFoundError, match=words) as caught:
        await Ear().open(url(tmp_path))
    assert "\n" not in str(caught.value)


def test_memory_link_keeps_the_order_of_what_is_written_at_once() -> None:
    async def story() -> bytes:
        near, far = MemoryLink.pair(0.004)
        heard = bytearray()
        far.on_bytes = heard.extend
        for i in range(200):
            near.write(bytes([i]))
        await asyncio.sleep(0.004)
        await asyncio.sleep(0.004)
        return bytes(heard)

    assert run_virtual(story()) == bytes(range(200))
