"""What a person may ask of the flight process through the page: one line of text each, bounded and polled.

The flight process reads at most `POLL_BYTES` at a poll; whatever is no known request is thrown away.
"""

from __future__ import annotations

import socket
from enum import StrEnum

POLL_BYTES = 256
"""Chosen: more requests than a person can make between two polls."""


class Request(StrEnum):
    """A request; each is a trigger of the state table."""

    STOP = "stop"


def send_request(channel: socket.socket, request: Request) -> bool:
    """Write one request; False when the flight process takes no more, or is gone."""
    line = f"{request}\n".encode()
    try:
        return channel.send(line) == len(line)
    except OSError:
        return False


class RequestReader:
    """The flight side: non-blocking, never raises."""

    def __init__(self) -> None:
        self._pending = b""

    def poll(self, channel: socket.socket) -> list[Request]:
        """Return the requests that came since the last poll."""
        try:
            data = channel.recv(POLL_BYTES)
        except OSError:
            return []
        *lines, rest = (self._pending + data).split(b"\n")
        self._pending = rest[-POLL_BYTES:]
        known = {request.value.encode(): request for request in Request}
        return [known[line] for line in lines if line in known]
