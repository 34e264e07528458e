"""Flight logs read back: as the messages they were made of, also from a file that a power cut left unfinished.

Reads from the front, chunk by chunk, so a missing index does not matter and a damaged chunk costs that chunk alone;
`mcap_scan` finds the next one.
"""

from __future__ import annotations

import json
import mmap
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Metadata, Schema

from morpheyes_daemon.errors import InputError, RecordingError
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.recorder.channels import EVENTS
from morpheyes_daemon.recorder.encoding import find_type, from_plain
from morpheyes_daemon.recorder.flight_log import CHUNK_BYTES, HEADER, LIBRARY, checked_header, with_checksum
from morpheyes_daemon.recorder.mcap_scan import ChunkEnd, Damage, looks_like_mcap, scan
from morpheyes_daemon.recorder.mcap_writer import ChunkedWriter
from morpheyes_daemon.recorder.series import FlightSeries

__all__ = ["Damage", "Flight", "Record", "Recovered", "read_flight", "read_header", "recover"]

_NOT_UNDERSTOOD = (RecordingError, ValueError, KeyError, TypeError, RecursionError)


@dataclass(frozen=True, slots=True)
class Record:
    """One recorded value: our dataclass again, or a plain dict where the log follows Foxglove's schemas."""

    topic: str
    log_ns: int
    value: Any


@dataclass(slots=True)
class Flight:
    """A whole log in memory; `header` is what `flight_log.flight_header` wrote."""

    path: Path
    header: dict[str, str] = field(default_factory=dict)
    records: list[Record] = field(default_factory=list)
    damage: Damage = field(default_factory=Damage)

    def values(self, topic: str) -> list[Any]:
        """Return what was recorded of a topic, oldest first."""
        return [record.value for record in self.records if record.topic == topic]

    @property
    def events(self) -> list[Event]:
        """The events, oldest first."""
        return self.values("events")

    def series(self) -> FlightSeries:
        """Return the flight as columns, for the pictures."""
        series = FlightSeries()
        for record in self.records:
            series.add(record.topic, record.value)
        return series


def read_flight(path: Path) -> Flight:
    """Read a log; raises InputError when it is none. Messages that cannot be understood are counted and left out."""
    flight = Flight(path)
    contents = _Contents()
    with _opened(path) as data:
        for record in scan(data, flight.damage, str(path)):
            message = contents.take(record)
            if message is None:
                continue
            channel, schema_name = message
            try:
                flight.records.append(_record(channel.topic, schema_name, record))
            except _NOT_UNDERSTOOD:
                flight.damage.bad_messages += 1
    flight.header = contents.header
    return flight


def read_header(path: Path) -> dict[str, str]:
    """Return a log's header alone; raises InputError when the file is no log."""
    contents = _Contents()
    with _opened(path) as data:
        for record in scan(data, Damage(), str(path)):
            contents.take(record)
            if contents.header:
                break
    return contents.header


class _Contents:
    """The header, and the schemas and channels met so far."""

    def __init__(self) -> None:
        self.header: dict[str, str] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def take(self, record: Any) -> tuple[Channel, str] | None:
        """Take note of a record; returns channel and schema name of a message that has a channel, None otherwise."""
        if isinstance(record, Message):
            channel = self.channels.get(record.channel_id)
            if channel is None:
                return None
            schema = self.schemas.get(channel.schema_id)
            return channel, schema.name if schema else ""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Metadata) and record.name == HEADER and not self.header:
            self.header = checked_header(record.metadata) or {}
        return None


@contextmanager
def _opened(path: Path) -> Iterator[mmap.mmap]:
    """Yield the bytes of a log; raises InputError with a sentence."""
    try:
        with path.open("rb") as stream:
            content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if _is_filled(stream.fileno()) else None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    if content is None:
        raise InputError(f"{path}: is not a flight log (an MCAP file).")
    with closing(content):
        if not looks_like_mcap(content):
            raise InputError(f"{path}: is not a flight log (an MCAP file).")
        yield content


def _is_filled(descriptor: int) -> bool:
    return os.fstat(descriptor).st_size > 0


def _record(topic: str, schema_name: str, message: Message) -> Record:
    plain = json.loads(message.data)
    if topic == EVENTS:
        return Record("events", message.log_time, from_plain(plain["event"], Event))
    cls = find_type(schema_name)
    value = plain if cls is None else from_plain(plain, cls)
    return Record(topic.removeprefix("/"), message.log_time, value)


@dataclass(frozen=True, slots=True)
class Recovered:
    """What `recover` saved."""

    messages: int
    events: int
    bad_chunks: int
    seconds: float
    was_finished: bool


def recover(path: Path, out: Path) -> Recovered:
    """Copy every readable message of a log into a new, finished one; raises InputError when nothing can be done."""
    if out.exists():
        raise InputError(f"{out}: is there already; choose another name with --out.")
    with _opened(path) as data:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            target = out.open("xb")
        except OSError as error:
            raise _unwritable(out, error) from None
        try:
            with target:
                return _copied(scan(data, damage := Damage(), str(path)), ChunkedWriter(target, LIBRARY), damage)
        except OSError as error:
            out.unlink()
            raise _unwritable(out, error) from None
        except InputError:
            out.unlink()
            raise


def _unwritable(out: Path, error: OSError) -> InputError:
    return InputError(f"{out}: cannot be written ({error.strerror}); name another --out.")


def _copied(source: Iterator[Any], writer: ChunkedWriter, damage: Damage) -> Recovered:
    """Copy the records, a chunk for a chunk, so that damage to the copy costs as little as to the log."""
    messages, events, first_ns, last_ns = 0, 0, 2**64, 0
    numbers = _Numbers(writer)
    for record in source:
        if isinstance(record, Message):
            topic = numbers.copy_message(record)
            if topic is not None:
                messages += 1
                events += topic == EVENTS
                first_ns, last_ns = min(first_ns, record.log_time), max(last_ns, record.log_time)
        elif isinstance(record, ChunkEnd):
            writer.end_chunk()
        else:
            numbers.copy(record)
    numbers.finish()
    writer.finish()
    return Recovered(messages, events, damage.bad_chunks, max(0, last_ns - first_ns) / 1e9, damage.finished)


class _Numbers:
    """Schemas and channels get new numbers in the copy; those repeated in each chunk are the same."""

    def __init__(self, writer: ChunkedWriter) -> None:
        self._writer = writer
        self._contents = _Contents()
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[Any, ...], int] = {}

    def copy(self, record: Any) -> None:
        known = self._contents.header
        self._contents.take(record)
        if self._contents.header and not known:
            self._write_header()
        elif isinstance(record, Metadata) and record.name != HEADER:
            self._writer.metadata(record.name, record.metadata)

    def copy_message(self, message: Message) -> str | None:
        """Return the topic, None when its channel stood in a damaged chunk."""
        found = self._contents.take(message)
        if found is None:
            return None
        number = self._number(found[0])
        if self._writer.chunk_bytes + len(message.data) > CHUNK_BYTES:
            self._writer.end_chunk()
        self._writer.message(number, message.log_time, message.publish_time, message.sequence, message.data)
        return str(found[0].topic)

    def finish(self) -> None:
        """Write the header once more, as the flight log does."""
        if self._contents.header:
            self._write_header()

    def _write_header(self) -> None:
        self._writer.metadata(HEADER, with_checksum(self._contents.header))

    def _number(self, channel: Channel) -> int:
        schema = self._contents.schemas.get(channel.schema_id)
        schema_number = 0
        if schema is not None:
            key = (schema.name, schema.encoding, schema.data)
            if key not in self._schemas:
                self._schemas[key] = self._writer.schema(*key)
            schema_number = self._schemas[key]
        signature = (channel.topic, channel.message_encoding, schema_number, *sorted(channel.metadata.items()))
        if signature not in self._channels:
            number = self._writer.channel(channel.topic, channel.message_encoding, schema_number, channel.metadata)
            self._channels[signature] = number
        return self._channels[signature]
