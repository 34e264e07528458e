"""Bytes on their way to a file: kept until the disk has taken them, so that a full disk loses nothing.

Looks like a stream to the MCAP writer (write, tell, flush) and never raises there. Only `sync` touches the disk.
"""

from __future__ import annotations

import os
from pathlib import Path


class Spool:
    """An append-only file whose tail lives in memory until `sync` succeeds."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._pending = bytearray()
        self._on_disk = 0
        self._fd: int | None = None

    @property
    def pending_bytes(self) -> int:
        """Bytes that the disk has not taken yet."""
        return len(self._pending)

    def write(self, data: bytes) -> int:
        """Append `data`."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Return the length of the file once everything is on disk."""
        return self._on_disk + len(self._pending)

    def flush(self) -> None:
        """Nothing: the disk is only touched by `sync`."""

    def sync(self, *, durable: bool) -> None:
        """Give the disk what is pending, and when `durable` wait until it survives a power cut.

        Raises OSError and keeps the bytes when the disk does not take them; call again later.
        Raises FileNotFoundError when the file was replaced or cut short by somebody else.
        """
        try:
            self._write_pending(self._open())
            if durable:
                os.fsync(self._open())
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Close the file; what is pending stays pending."""
        if self._fd is not None:
            fd, self._fd = self._fd, None
            try:
                os.close(fd)
            except OSError:
                pass  # the device is gone; the descriptor is free all the same

    def _open(self) -> int:
        if self._fd is None:
            if self._on_disk == 0:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
            else:
                self._fd = os.open(self.path, os.O_WRONLY | os.O_CLOEXEC)
                if os.fstat(self._fd).st_size < self._on_disk:
                    raise FileNotFoundError(f"{self.path} is shorter than what was written to it")
        return self._fd

    def _write_pending(self, fd: int) -> None:
        """Positioned writes: a half-written tail of a failed attempt is written over by the next one."""
        while self._pending:
            taken = os.pwrite(fd, self._pending, self._on_disk)
            del self._pending[:taken]
            self._on_disk += taken
