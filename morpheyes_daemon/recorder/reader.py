"""Flight logs read back: as the messages they were made of, also from a file that a power cut left unfinished.

Reads from the front, chunk by chunk, so a missing index does not matter and a damaged chunk costs that chunk alone.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, RecordLengthLimitExceeded, UnsupportedCompressionError
from mcap.records import Channel, Chunk, Footer, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from morpheyes_daemon.errors import InputError, RecordingError
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.recorder.channels import EVENTS
from morpheyes_daemon.recorder.encoding import find_type, from_plain
from morpheyes_daemon.recorder.flight_log import CHUNK_BYTES, HEADER, LIBRARY
from morpheyes_daemon.recorder.series import FlightSeries

LARGEST_RECORD = 64 * 1024 * 1024
_CUT = (EndOfFile, InvalidMagic, struct.error, RecordLengthLimitExceeded, ValueError)
_BAD_CHUNK = (*_CUT, CRCValidationError, UnsupportedCompressionError, zstandard.ZstdError, RuntimeError)


@dataclass(slots=True)
class Damage:
    """What was wrong with a log: chunks and messages that could not be unpacked, and whether the end is there."""

    bad_chunks: int = 0
    bad_messages: int = 0
    finished: bool = False


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
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with open_log(path) as stream:
        for record in records(stream, flight.damage):
            if isinstance(record, Metadata) and record.name == HEADER:
                flight.header = dict(record.metadata)
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id)
                try:
                    flight.records.append(_record(channel.topic, schema.name if schema else "", record))
                except (RecordingError, ValueError, KeyError):
                    flight.damage.bad_messages += 1
    return flight


def read_header(path: Path) -> dict[str, str]:
    """Return a log's header alone; raises InputError when the file is no log."""
    with open_log(path) as stream:
        for record in records(stream, Damage()):
            if isinstance(record, Metadata) and record.name == HEADER:
                return dict(record.metadata)
    return {}


def open_log(path: Path) -> IO[bytes]:
    """Open a log for reading; raises InputError with a sentence."""
    try:
        stream = path.open("rb")
        start = stream.read(len(MCAP0_MAGIC))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    if start != MCAP0_MAGIC:
        stream.close()
        raise InputError(f"{path}: is not a flight log (an MCAP file).")
    stream.seek(0)
    return stream


def records(stream: IO[bytes], damage: Damage) -> Iterator[Any]:
    """Yield the MCAP records of a log as far as they go, noting in `damage` what was not readable."""
    reader = StreamReader(stream, emit_chunks=True, record_size_limit=LARGEST_RECORD).records
    while True:
        try:
            record = next(reader)
        except (StopIteration, *_CUT):
            return
        if isinstance(record, Chunk):
            yield from _unpacked(record, damage)
        else:
            damage.finished = damage.finished or isinstance(record, Footer)
            yield record


def _unpacked(chunk: Chunk, damage: Damage) -> list[Any]:
    try:
        return list(breakup_chunk(chunk, validate_crc=True))
    except _BAD_CHUNK:
        damage.bad_chunks += 1
        return []


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
    damage, messages, events, times = Damage(), 0, 0, [2**63, 0]
    with open_log(path) as stream, out.open("wb") as target:
        writer: Any = Writer(target, CHUNK_BYTES // 2, CompressionType.ZSTD)
        writer.start(library=LIBRARY)
        numbers = _Numbers(writer)
        for record in records(stream, damage):
            if isinstance(record, Message):
                topic = numbers.copy_message(record)
                messages += topic is not None
                events += topic == EVENTS
                times = [min(times[0], record.log_time), max(times[1], record.log_time)]
            else:
                numbers.copy(record)
        writer.finish()
    return Recovered(messages, events, damage.bad_chunks, max(0, times[1] - times[0]) / 1e9, damage.finished)


class _Numbers:
    """Schemas and channels get new numbers in the copy; those repeated in a log's summary are copied once."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, tuple[int, str]] = {}

    def copy(self, record: Any) -> None:
        if isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema = self._schemas.get(record.schema_id, 0)
            number = self._writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
            self._channels[record.id] = (number, record.topic)

    def copy_message(self, message: Message) -> str | None:
        """Return the topic, None when its channel stood in a damaged chunk."""
        if message.channel_id not in self._channels:
            return None
        number, topic = self._channels[message.channel_id]
        self._writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
        return topic
