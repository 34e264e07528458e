"""One flight as an MCAP file: channels on first use, chunks of at most 256 KB, a header that says what flew.

Knows nothing of topics, threads or failure events; `recorder.py` does.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, cast

from mcap.writer import CompressionType, Writer

from morpheyes_daemon import __version__
from morpheyes_daemon.config.vehicle import MissionFile, VehicleConfig
from morpheyes_daemon.recorder.channels import Entry
from morpheyes_daemon.recorder.spool import Spool

CHUNK_BYTES = 256 * 1024
"""Largest chunk: what a power cut or SIGKILL can cost at most, besides the second since the last sync."""
LARGEST_BACKLOG_BYTES = 8 * 1024 * 1024
"""What is kept in memory while the disk refuses."""
HEADER = "flight"
LIBRARY = f"morpheyes {__version__}"


def flight_path(folder: Path, mission: str, wall_s: float) -> Path:
    """Return flights/2026-05-01T12-30-00Z_forest.mcap, with a number when that is taken.

    A relative `folder` lies below the LOGS_DIRECTORY that systemd names, if it does.
    """
    folder = Path(os.environ.get("LOGS_DIRECTORY", "")) / folder
    stamp = datetime.fromtimestamp(wall_s, UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    return _free_name(folder / f"{stamp}_{Path(mission).stem}.mcap")


def flight_header(
    mission: str, mission_file: MissionFile, config: VehicleConfig, calibration_hash: str, wall_s: float, **more: str
) -> dict[str, str]:
    """Return the log's header: version, config and mission as JSON, the calibration's hash and the wall time.

    `more` may hold `scene=Scene(...).as_json()` where the surroundings are known, for the map.
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


def _free_name(path: Path) -> Path:
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}.{number}{path.suffix}")
    return free


class FlightLog:
    """Writes entries; the disk is touched by `sync` and `close` alone, which raise OSError and can be repeated."""

    _spool: Spool
    _writer: Any
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
        if self._chunk_bytes + len(data) > CHUNK_BYTES:
            self._end_chunk()
        self._chunk_bytes += len(data) + 31  # opcode, length and the fixed fields of a message record
        channel = self._channel(entry)
        self._sequence[channel] = self._sequence.get(channel, 0) + 1
        self._writer.add_message(channel, log_ns, data, publish_ns, self._sequence[channel])
        self.written += 1
        self._unsafe += 1

    def sync(self, *, durable: bool) -> None:
        """End the chunk and give everything to the disk; raises OSError, and then keeps it for the next call.

        When the file itself is gone the flight goes on in a new one, named with a number.
        """
        self._end_chunk()
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
        self._chunk_bytes = 0
        self._unsafe = 0
        self._finished = False
        self._writer = Writer(cast(IO[bytes], self._spool), 2 * CHUNK_BYTES, CompressionType.ZSTD)
        self._writer.start(library=LIBRARY)
        self._writer.add_metadata(HEADER, self._header)

    def _end_chunk(self) -> None:
        self._writer.flush()
        self._chunk_bytes = 0

    def _channel(self, entry: Entry) -> int:
        if entry.channel not in self._channels:
            if entry.schema_name not in self._schemas:
                schema = self._writer.register_schema(entry.schema_name, "jsonschema", entry.schema)
                self._schemas[entry.schema_name] = schema
            self._channels[entry.channel] = self._writer.register_channel(
                entry.channel, "json", self._schemas[entry.schema_name]
            )
        return self._channels[entry.channel]
