"""Objects with big arrays across a process border, through one piece of shared memory.

Arrays travel as raw bytes beside the pickle (protocol 5, out of band), so a stereo frame costs one copy on each
side. The memory is an unlinked file: nothing is left behind, however the processes die. Who may write when is
agreed elsewhere.
"""

from __future__ import annotations

import mmap
import os
import pickle
import struct
import tempfile
from typing import Any

_COUNT = struct.Struct("<Q")
_SHARED_MEMORY = "/dev/shm"
_GRAIN = 1 << 20


class Mailbox:
    """Holds one object at a time; made by one process with `create`, by the other from the file descriptor."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map: mmap.mmap | None = None

    @classmethod
    def create(cls) -> Mailbox:
        """Return an empty mailbox in memory, or in a temporary file where there is no shared-memory folder."""
        folder = _SHARED_MEMORY if os.path.isdir(_SHARED_MEMORY) else None
        with tempfile.TemporaryFile(dir=folder) as file:
            return cls(os.dup(file.fileno()))

    def put(self, content: Any) -> None:
        """Write an object over whatever was there."""
        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(content, protocol=5, buffer_callback=buffers.append)
        parts = [memoryview(head), *(buffer.raw() for buffer in buffers)]
        sizes = [part.nbytes for part in parts]
        index = _COUNT.pack(len(parts)) + struct.pack(f"<{len(parts)}Q", *sizes)
        target = self._mapped(len(index) + sum(sizes))
        target[: len(index)] = index
        at = len(index)
        for part in parts:
            target[at : at + part.nbytes] = part
            at += part.nbytes

    def take(self) -> Any:
        """Return the object as this process's own copy; its arrays are read-only."""
        source = memoryview(self._mapped(0))
        try:
            (count,) = _COUNT.unpack_from(source)
            sizes = struct.unpack_from(f"<{count}Q", source, _COUNT.size)
            at = _COUNT.size * (1 + count)
            parts = []
            for size in sizes:
                parts.append(bytes(source[at : at + size]))
                at += size
            return pickle.loads(parts[0], buffers=parts[1:])
        finally:
            source.release()

    def close(self) -> None:
        """Give the memory back; may be called twice."""
        if self._map is not None:
            self._map.close()
            self._map = None
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1

    def _mapped(self, size: int) -> mmap.mmap:
        """Return the memory, grown to at least `size`, and as large as the other side has made it."""
        have = os.fstat(self.fd).st_size
        if size > have:
            have = -(-size // _GRAIN) * _GRAIN
            os.ftruncate(self.fd, have)
        if self._map is None or len(self._map) < have:
            if self._map is not None:
                self._map.close()
            self._map = mmap.mmap(self.fd, have)
        return self._map
