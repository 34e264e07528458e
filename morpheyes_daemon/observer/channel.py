"""A bounded one-way channel over a stream socket: the writer never waits, the oldest is dropped and counted.

Records are pickled when they are sent, so that a record that is dropped costs nothing but its place. The socket is
non-blocking on the writer's side; a reader that stops reading, or dies, only makes the writer drop.
"""

from __future__ import annotations

import pickle
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from morpheyes_daemon.errors import InputError

HEADER = struct.Struct("<I")
LARGEST_RECORD = 16 << 20
"""Bytes; larger ones are not sent. Chosen: a pair of pictures of 4096 x 2048 fits."""
QUEUE_LIMIT = 2000
"""Records; chosen: some five seconds of everything the daemon says."""
BATCH_BYTES = 1 << 18
"""Bytes packed before they are handed to the socket; chosen: what a socket buffer takes at once."""


class ChannelWriter:
    """The flight side. `put` keeps a record, `flush` sends what the socket takes; neither waits nor raises."""

    def __init__(self) -> None:
        self._queue: deque[Any] = deque()
        self._packed = memoryview(b"")
        self._socket: socket.socket | None = None
        self.dropped = 0
        self.failed = 0

    @property
    def pending(self) -> bool:
        """True while something is left to be sent."""
        return bool(self._packed) or bool(self._queue)

    @property
    def connected(self) -> bool:
        """True while somebody may be reading."""
        return self._socket is not None

    def connect(self, reader: socket.socket) -> None:
        """Send to a new reader from now on, beginning with a whole record."""
        reader.setblocking(False)
        self.disconnect()
        self._socket = reader

    def disconnect(self) -> None:
        """Forget the reader; records are kept for the next one as far as there is room."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._packed = None, memoryview(b"")

    def put(self, record: Any) -> None:
        """Keep a record; when there is no room the oldest is dropped."""
        if len(self._queue) >= QUEUE_LIMIT:
            self._queue.popleft()
            self.dropped += 1
        self._queue.append(record)

    def flush(self, allowed: Callable[[], bool] = lambda: True) -> None:
        """Send as much as the socket takes at once, while `allowed()` says that there is time."""
        while self._socket is not None and (self._packed or self._queue):
            if not self._packed and not (allowed() and self._pack()):
                return
            try:
                sent = self._socket.send(self._packed)
            except BlockingIOError:
                return
            except OSError:
                self.disconnect()
                return
            self._packed = self._packed[sent:]

    def _pack(self) -> bool:
        """Pickle the oldest records into one batch; a record that cannot be pickled is counted and left out."""
        batch = bytearray()
        while self._queue and len(batch) < BATCH_BYTES:
            record = self._queue.popleft()
            try:
                data = pickle.dumps(record, protocol=pickle.HIGHEST_PROTOCOL)
            except Exception:  # noqa: BLE001 -- a value that cannot be told must not end the flight
                self.failed += 1
                continue
            if len(data) <= LARGEST_RECORD:
                batch += HEADER.pack(len(data)) + data
            else:
                self.failed += 1
        self._packed = memoryview(bytes(batch))
        return bool(batch)


class RecordReader:
    """The observer's side: bytes in, records out."""

    def __init__(self) -> None:
        self._pending = bytearray()
        self.failed = 0

    def feed(self, data: bytes) -> Iterator[Any]:
        """Yield the records that are complete; raises InputError when the stream cannot be one of ours."""
        self._pending += data
        while len(self._pending) >= HEADER.size:
            (length,) = HEADER.unpack_from(self._pending)
            if length > LARGEST_RECORD:
                raise InputError("the observer's channel is out of step.")
            end = HEADER.size + length
            if len(self._pending) < end:
                return
            body = bytes(self._pending[HEADER.size : end])
            del self._pending[:end]
            try:
                record = pickle.loads(body)
            except Exception:  # noqa: BLE001 -- a strategy's class that is not importable here; the rest is told
                self.failed += 1
                continue
            yield record
