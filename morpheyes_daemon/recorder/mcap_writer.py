"""MCAP files whose chunks can each be read alone: a chunk repeats every schema and channel that its messages use.

The `mcap` package's own writer puts a schema and a channel where they are first used and nowhere else before the
summary, so that one damaged chunk takes the messages of all later ones with it. What is written here is plain MCAP
(mcap.dev/spec): repeated records with equal content are allowed there. Nothing here knows of flights or files.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC


class Output(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes, /) -> int:
        """Append `data`."""

    def tell(self) -> int:
        """Return how many bytes came before."""


class ChunkedWriter:
    """Writes one file; the caller decides where a chunk ends."""

    def __init__(self, output: Output, library: str) -> None:
        self._output = output
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._counts: dict[int, int] = {}
        self._chunk_indices: list[Any] = []
        self._metadata_indices: list[Any] = []
        self._times_ns: tuple[int, int] | None = None
        self._begin_chunk()
        output.write(MCAP0_MAGIC)
        self._write(Header("", library))

    @property
    def chunk_bytes(self) -> int:
        """Size of the open chunk, uncompressed."""
        return int(self._chunk.count)

    def metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Write a metadata record; ends the open chunk."""
        self.end_chunk()
        at = self._output.tell()
        self._metadata_indices.append(MetadataIndex(at, self._write(Metadata(name, dict(content))), name))

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Return the number of a new schema; it is written with the first message of each chunk that needs it."""
        number = len(self._schemas) + 1
        self._schemas[number] = Schema(number, data, encoding, name)
        return number

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str] | None = None) -> int:
        """Return the number of a new channel of a schema's number, 0 for none."""
        number = len(self._channels) + 1
        self._channels[number] = Channel(number, topic, encoding, dict(metadata or {}), schema)
        return number

    def message(self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes) -> None:
        """Append a message to the open chunk."""
        if channel not in self._offsets:
            self._introduce(self._channels[channel])
        self._offsets[channel].append((log_ns, self._chunk.count))
        Message(channel, log_ns, data, publish_ns, sequence).write(self._chunk)
        self._counts[channel] = self._counts.get(channel, 0) + 1

    def end_chunk(self) -> None:
        """Write the open chunk and its index, if there is a message in it."""
        if not self._offsets:
            return
        times = [t for rows in self._offsets.values() for t, _ in rows]
        span = min(times), max(times)
        plain = self._chunk.end()
        packed = zstandard.compress(plain)
        at = self._output.tell()
        size = self._write(Chunk("zstd", packed, span[1], span[0], zlib.crc32(plain), len(plain)))
        offsets, index_at = {}, self._output.tell()
        for channel, rows in self._offsets.items():
            offsets[channel] = self._output.tell()
            self._write(MessageIndex(channel, rows))
        index_bytes = self._output.tell() - index_at
        self._chunk_indices.append(
            ChunkIndex(size, at, "zstd", len(packed), span[1], index_bytes, offsets, span[0], len(plain))
        )
        known = self._times_ns or span
        self._times_ns = min(known[0], span[0]), max(known[1], span[1])
        self._begin_chunk()

    def finish(self) -> None:
        """End the chunk and write the summary that viewers seek with."""
        self.end_chunk()
        self._write(DataEnd(0))
        start = self._output.tell()
        groups: list[Any] = []
        summary: Any = RecordBuilder()
        for opcode, rows in self._summary():
            before = summary.count
            for row in rows:
                row.write(summary)
            groups.append(SummaryOffset(opcode, start + before, summary.count - before))
        offsets_at = start + summary.count
        for group in groups:
            group.write(summary)
        content = summary.end()
        closing: Any = RecordBuilder()
        Footer(start, offsets_at, 0).write(closing)
        crc = zlib.crc32(closing.end()[:-4], zlib.crc32(content))
        self._output.write(content)
        self._write(Footer(start, offsets_at, crc))
        self._output.write(MCAP0_MAGIC)

    def _summary(self) -> list[tuple[Any, list[Any]]]:
        first, last = self._times_ns or (0, 0)
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunk_indices),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata_indices),
            message_start_time=first,
            message_end_time=last,
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indices),
            (Opcode.METADATA_INDEX, self._metadata_indices),
        ]

    def _begin_chunk(self) -> None:
        self._chunk: Any = RecordBuilder()
        self._offsets: dict[int, list[tuple[int, int]]] = {}
        self._schemas_in_chunk: set[int] = set()

    def _introduce(self, channel: Any) -> None:
        """Put a channel, and its schema before it, into the open chunk."""
        if channel.schema_id in self._schemas and channel.schema_id not in self._schemas_in_chunk:
            self._schemas[channel.schema_id].write(self._chunk)
            self._schemas_in_chunk.add(channel.schema_id)
        channel.write(self._chunk)
        self._offsets[channel.id] = []

    def _write(self, record: Any) -> int:
        builder: Any = RecordBuilder()
        record.write(builder)
        return self._output.write(builder.end())
