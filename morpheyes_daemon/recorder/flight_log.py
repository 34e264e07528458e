"""One flight as an MCAP file: chunks of at most 256 KB that are readable alone, a header that says what flew.

The header stands at the beginning and again at the end, each time with its own checksum.

Knows nothing of topics, threads or failure events; `recorder.py` does.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from morpheyes_daemon import __version__
from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.recorder.channels import Entry
from morpheyes_daemon.recorder.mcap_writer import ChunkedWriter
from morpheyes_daemon.recorder.spool import Spool

CHUNK_BYTES = 256 * 1024
"""Largest chunk: what a power cut or SIGKILL can cost at most, besides the second since the last sync."""
LARGEST_BACKLOG_BYTES = 8 * 1024 * 1024
"""What is kept in memory while the disk refuses."""
HEADER = "flight"
HEADER_CRC = "crc32"
"""Key of the header's own checksum; MCAP gives none to metadata."""
RECORD_BYTES = 256
"""Upper bound of what a message, its channel and its schema take beside their content."""
LIBRARY = f"morpheyes {__version__}"


def flight_path(folder: Path, mission: str, wall_s: float) -> Path:
    """Return flights/2026-05-01T12-30-00Z_forest.mcap, with a number when that is taken.

    A relative `folder` lies below the LOGS_DIRECTORY that systemd names, if it does. The name is taken by an empty
    file, so that two daemons started in the same second do not share it.
    """
    folder = Path(os.environ.get("LOGS_DIRECTORY", "")) / folder
    stamp = datetime.fromtimestamp(wall_s, UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    return _free_name(folder / f"{stamp}_{Path(mission).stem}.mcap")


def flight_header(
    mission: str, mission_file: MissionFile, config: VehicleConfig, calibration_hash: str, wall_s: float, **more: str
) -> dict[str, str]:
    """Return the log's header: version, config and mission as JSON, the calibration's hash and the wall time.

    `more` may hold `scene=ObstacleMap(...).as_json()` where the surroundings are known, for the map.
    """
    return {
        "version": __version__,
        "mission": mission,
        "mission_file": mission_file.model_dump_json(),
        "config": config.model_dump_json(),
        "calibration_hash": calibration_hash,
        "wall_time": datetime.fromtimestamp(wall_s, UTC).isoformat(),
        **more,
    }


def with_checksum(header: Mapping[str, str]) -> dict[str, str]:
    """Return a header with its checksum in it."""
    return {**header, HEADER_CRC: _checksum(header)}


def checked_header(metadata: Mapping[str, str]) -> dict[str, str] | None:
    """Return a header without its checksum, None when that does not fit; older logs have none."""
    header = {key: value for key, value in metadata.items() if key != HEADER_CRC}
    return header if metadata.get(HEADER_CRC) in (_checksum(header), None) else None


def _checksum(header: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(header.items())).encode()):08x}"


def _free_name(path: Path) -> Path:
    """Return `path`, or with a number the first that is free, taken at once unless the disk refuses."""
    number, free = 1, path
    while True:
        try:
            free.parent.mkdir(parents=True, exist_ok=True)
            os.close(os.open(free, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644))
            return free
        except FileExistsError:
            if not free.exists():
                return free  # the folder's own name is a file: the first sync will say so
            number += 1
            free = path.with_name(f"{path.stem}.{number}{path.suffix}")
        except OSError:
            return free


class FlightLog:
    """Writes entries; the disk is touched by `sync` and `close` alone, which raise OSError and can be repeated."""

    _spool: Spool
    _writer: ChunkedWriter
    _unsafe: int
    _finished: bool

    def __init__(self, path: Path, header: Mapping[str, str]) -> None:
        self._header = dict(header)
        self.written = 0
        self.lost = 0
        self._begin(path)

    @property
    def path(self) -> Path:
        """The file being written."""
        return self._spool.path

    @property
    def full(self) -> bool:
        """Whether the disk has refused for so long that only events should still be added."""
        return self._spool.pending_bytes > LARGEST_BACKLOG_BYTES

    def add(self, entry: Entry, log_ns: int, publish_ns: int) -> None:
        """Append one entry; `publish_ns` is its own stamp, `log_ns` when it was seen."""
        data = json.dumps(entry.payload, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
        if self._writer.chunk_bytes + len(data) + len(entry.schema) + RECORD_BYTES > CHUNK_BYTES:
            self._writer.end_chunk()
        channel = self._channel(entry)
        self._sequence[channel] = self._sequence.get(channel, 0) + 1
        self._writer.message(channel, log_ns, publish_ns, self._sequence[channel], data)
        self.written += 1
        self._unsafe += 1

    def sync(self, *, durable: bool) -> None:
        """End the chunk and give everything to the disk; raises OSError, and then keeps it for the next call.

        When the file itself is gone the flight goes on in a new one, named with a number.
        """
        self._writer.end_chunk()
        try:
            self._spool.sync(durable=durable)
        except FileNotFoundError:
            self.lost += self._unsafe
            self._begin(_free_name(self.path))
            raise
        self._unsafe = 0

    def close(self) -> None:
        """Write the index and sync once more; raises OSError when the disk does not take it."""
        if not self._finished:
            self._writer.metadata(HEADER, with_checksum(self._header))
            self._writer.finish()
            self._finished = True
        try:
            self._spool.sync(durable=True)
        finally:
            self._spool.close()

    def _begin(self, path: Path) -> None:
        self._spool = Spool(path)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence: dict[int, int] = {}
        self._unsafe = 0
        self._finished = False
        self._writer = ChunkedWriter(self._spool, LIBRARY)
        self._writer.metadata(HEADER, with_checksum(self._header))

    def _channel(self, entry: Entry) -> int:
        if entry.channel not in self._channels:
            if entry.schema_name not in self._schemas:
                schema = self._writer.schema(entry.schema_name, "jsonschema", entry.schema)
                self._schemas[entry.schema_name] = schema
            self._channels[entry.channel] = self._writer.channel(entry.channel, "json", self._schemas[entry.schema_name])
        return self._channels[entry.channel]
