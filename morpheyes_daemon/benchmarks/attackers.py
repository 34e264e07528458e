"""Clients that attack the page, each a process of its own, bounded in time, on loopback only."""

from __future__ import annotations

import base64
import contextlib
import os
import select
import socket
from collections.abc import Callable

from morpheyes_daemon.clock import stopwatch_s

LOOPBACK = "127.0.0.1"
CONNECT_S = 2.0
EMPTY_FRAME = b"\x81\x80\0\0\0\0"
"""A masked WebSocket text frame without payload (RFC 6455, section 5.2)."""
PING = b"\x89\x80\0\0\0\0"
FULL_FRAME = b"\x82\xfe" + (4000).to_bytes(2, "big") + b"\0\0\0\0" + b"x" * 4000


def _connect(port: int) -> socket.socket | None:
    with contextlib.suppress(OSError):
        client = socket.create_connection((LOOPBACK, port), CONNECT_S)
        client.setblocking(False)
        return client
    return None


def _web_socket(port: int) -> socket.socket | None:
    client = _connect(port)
    if client is not None:
        key = base64.b64encode(os.urandom(16)).decode()
        client.send(
            f"GET /ws HTTP/1.1\r\nHost: {LOOPBACK}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
    return client


def _flood(open_one: Callable[[], socket.socket | None], count: int, data: bytes, seconds: float) -> None:
    """Write `data` on `count` connections as fast as they take it; one that is closed is opened again."""
    end_s = stopwatch_s() + seconds
    clients: list[socket.socket] = []
    while stopwatch_s() < end_s:
        while len(clients) < count and stopwatch_s() < end_s:
            client = open_one()
            if client is None:
                break
            clients.append(client)
        readable, writable, _ = select.select(clients, clients, [], 0.1)
        broken = {client for client in readable if not _drained(client)}
        broken |= {client for client in writable if client not in broken and not _sent(client, data)}
        for client in broken:
            client.close()
        clients = [client for client in clients if client not in broken]
    for client in clients:
        client.close()


def _drained(client: socket.socket) -> bool:
    try:
        return bool(client.recv(1 << 16))
    except BlockingIOError:
        return True
    except OSError:
        return False


def _sent(client: socket.socket, data: bytes) -> bool:
    try:
        client.send(data)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return True


def empty_frames(port: int, seconds: float) -> None:
    """Eight WebSocket clients that send empty frames."""
    _flood(lambda: _web_socket(port), 8, EMPTY_FRAME * 500, seconds)


def full_frames(port: int, seconds: float) -> None:
    """Eight WebSocket clients that send frames of 4000 bytes."""
    _flood(lambda: _web_socket(port), 8, FULL_FRAME * 4, seconds)


def pings(port: int, seconds: float) -> None:
    """Eight WebSocket clients that send pings."""
    _flood(lambda: _web_socket(port), 8, PING * 500, seconds)


def requests(port: int, seconds: float) -> None:
    """200 connections with requests one after the other."""
    line = f"GET /api/state HTTP/1.1\r\nHost: {LOOPBACK}:{port}\r\n\r\n".encode()
    _flood(lambda: _connect(port), 200, line * 20, seconds)


def malformed(port: int, seconds: float) -> None:
    """Requests that are none."""
    _flood(lambda: _connect(port), 50, b"\x00\xff GET nothing HTTP/9.9\r\nX: \x01\r\n\r\n", seconds)


def idle_sockets(port: int, seconds: float) -> None:
    """1300 connections on which nothing is said."""
    end_s = stopwatch_s() + seconds
    clients = [client for client in (_connect(port) for _ in range(1300)) if client is not None]
    while stopwatch_s() < end_s:
        select.select([], [], [], 0.2)
    for client in clients:
        client.close()


ATTACKS: dict[str, Callable[[int, float], None]] = {
    "empty frames": empty_frames,
    "full frames": full_frames,
    "pings": pings,
    "requests": requests,
    "malformed": malformed,
    "idle sockets": idle_sockets,
}
