"""The records of an MCAP file that may be damaged anywhere: what is broken is passed over up to the next chunk.

MCAP has no synchronization marks. A chunk is recognized by its compression's name at a fixed place and by two
lengths that must agree, its content by its CRC. A record is trusted only if it fits into the file, is made as its
kind is, is followed by another record or by the end, and no chunk begins inside it; otherwise reading goes on at
the next chunk. What chunks unpack to is bounded, so that a small file cannot fill the memory.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from morpheyes_daemon.errors import InputError

LARGEST_CHUNK = 64 * 1024 * 1024
"""No chunk of any sensible writer unpacks to more."""
UNPACKED_FREE, UNPACKED_SHARE = 16 * 1024 * 1024, 200
"""A whole file unpacks to no more than this many bytes plus this many times its size; flight logs reach 30 times."""

_PREFIX = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_MARK = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_MARK_AT = _PREFIX.size + _CHUNK.size
_LAST_OPCODE = 0x0F
_FOOTER_BYTES = 20
_END_BYTES = _PREFIX.size + _FOOTER_BYTES + len(MCAP0_MAGIC)
_BROKEN = (McapError, struct.error, ValueError, zstandard.ZstdError, RuntimeError)
_KINDS: dict[int, Any] = {Opcode.METADATA: Metadata, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}


@dataclass(slots=True)
class Damage:
    """What was wrong with a log; `finished` is whether its end is there.

    Chunks and messages that could not be unpacked, and other records that were passed over.
    """

    bad_chunks: int = 0
    bad_messages: int = 0
    bad_records: int = 0
    finished: bool = False


@dataclass(frozen=True, slots=True)
class ChunkEnd:
    """Stands behind the records of a chunk, whether it could be read or not."""


def looks_like_mcap(data: Any) -> bool:
    """Whether a file begins as MCAP does, one flipped bit allowed."""
    start = bytes(data[: len(MCAP0_MAGIC)])
    wrong = sum((a ^ b).bit_count() for a, b in zip(start, MCAP0_MAGIC, strict=False))
    return len(start) == len(MCAP0_MAGIC) and wrong <= 1


def scan(data: Any, damage: Damage, name: str) -> Iterator[Any]:
    """Yield Metadata, Schema, Channel and Message records and a ChunkEnd after each chunk of `data` (bytes or mmap).

    `damage` notes what was not readable. Raises InputError, naming the file, when it unpacks to absurd sizes.
    """
    damage.finished = _ends_whole(data)
    budget = _Budget(UNPACKED_FREE + UNPACKED_SHARE * len(data), name)
    at, end = len(MCAP0_MAGIC), len(data) - (_END_BYTES if damage.finished else 0)
    while at + _PREFIX.size <= end:
        opcode, length = _PREFIX.unpack_from(data, at)
        body, after = at + _PREFIX.size, at + _PREFIX.size + length
        if not _trusted(data, at, opcode, after, end):
            found = _next_chunk(data, at + 1, end)
            if found is None and not damage.finished:
                return  # cut off in the middle of this record
            _count(damage, opcode)
            if found is None:
                return
            at = found
            continue
        if opcode == Opcode.CHUNK:
            yield from _unpacked(data, body, after, damage, budget)
        elif opcode in _KINDS or opcode == Opcode.MESSAGE:
            yield from _alone(opcode, bytes(data[body:after]), damage)
        at = after


def _ends_whole(data: Any) -> bool:
    """Whether the file ends in a footer and the magic, one flipped bit in them allowed."""
    if len(data) < _END_BYTES + len(MCAP0_MAGIC):
        return False
    tail = bytes(data[-_END_BYTES:])
    fixed = tail[: _PREFIX.size] + tail[-len(MCAP0_MAGIC) :]
    wanted = _PREFIX.pack(Opcode.FOOTER, _FOOTER_BYTES) + MCAP0_MAGIC
    return sum((a ^ b).bit_count() for a, b in zip(fixed, wanted, strict=True)) <= 1


def _count(damage: Damage, opcode: int) -> None:
    if opcode == Opcode.CHUNK:
        damage.bad_chunks += 1
    else:
        damage.bad_records += 1


def _trusted(data: Any, at: int, opcode: int, after: int, end: int) -> bool:
    if not 0 < opcode <= _LAST_OPCODE or after > end:
        return False
    if opcode == Opcode.CHUNK and not _is_chunk(data, at, after):
        return False
    if after + _PREFIX.size <= end:
        following, length = _PREFIX.unpack_from(data, after)
        if not 0 < following <= _LAST_OPCODE or length > end - after:
            # what follows may be what is damaged: a record whose own lengths agree is trusted all the same
            return opcode == Opcode.CHUNK or (
                opcode in _KINDS and bool(_alone(opcode, bytes(data[at + _PREFIX.size : after]), Damage()))
            )
    if opcode in (Opcode.CHUNK, Opcode.ATTACHMENT):
        return True
    return _next_chunk(data, at + 1, after) is None


def _is_chunk(data: Any, at: int, after: int) -> bool:
    """Whether the length of the record and the length of the packed data in it agree."""
    body = at + _PREFIX.size + _CHUNK.size
    if body + 4 > after:
        return False
    (name_bytes,) = struct.unpack_from("<I", data, body)
    size_at = body + 4 + name_bytes
    return size_at + 8 <= after and bool(size_at + 8 + struct.unpack_from("<Q", data, size_at)[0] == after)


def _next_chunk(data: Any, start: int, end: int) -> int | None:
    """Return where the next chunk record begins, at `start` or later and before `end`; None when there is none."""
    mark = _MARK.search(data, start + _MARK_AT, min(end + _MARK_AT + 8, len(data)))
    while mark is not None:
        at = mark.start() - _MARK_AT
        opcode, length = _PREFIX.unpack_from(data, at)
        after = at + _PREFIX.size + length
        if at < end and opcode == Opcode.CHUNK and after <= len(data) and _is_chunk(data, at, after):
            return at
        mark = _MARK.search(data, mark.end(), min(end + _MARK_AT + 8, len(data)))
    return None


@dataclass(slots=True)
class _Budget:
    """How much may still be unpacked of one file."""

    left: int
    name: str

    def take(self, size: int) -> None:
        self.left -= size
        if self.left < 0:
            raise InputError(f"{self.name}: unpacks to more than {UNPACKED_SHARE} times its size; it is no flight log.")


def _unpacked(data: Any, body: int, after: int, damage: Damage, budget: _Budget) -> Iterator[Any]:
    try:
        records = _chunk_records(_plain(data, body, after, budget))
    except _BROKEN:
        damage.bad_chunks += 1
        records = []
    yield from records
    yield ChunkEnd()


def _plain(data: Any, body: int, after: int, budget: _Budget) -> bytes:
    """Return what a chunk unpacks to, its CRC checked; raises one of _BROKEN."""
    _, _, size, crc = _CHUNK.unpack_from(data, body)
    name_at = body + _CHUNK.size + 4
    (name_bytes,) = struct.unpack_from("<I", data, name_at - 4)
    compression = bytes(data[name_at : name_at + name_bytes])
    packed = bytes(data[name_at + name_bytes + 8 : after])
    if size > LARGEST_CHUNK:
        raise ValueError("a chunk of absurd size")
    budget.take(size)
    plain = _decompressed(compression, packed, size)
    if len(plain) != size or (crc and zlib.crc32(plain) != crc):
        raise ValueError("the chunk's checksum does not fit")
    return plain


def _decompressed(compression: bytes, packed: bytes, size: int) -> bytes:
    """Return at most `size` + 1 bytes; the sizes that packed data claim of themselves are not trusted."""
    if compression == b"zstd":
        with zstandard.ZstdDecompressor(max_window_size=2 * LARGEST_CHUNK).stream_reader(packed) as stream:
            return bytes(stream.read(size + 1))
    if compression == b"lz4":
        try:
            import lz4.frame
        except ImportError:
            raise ValueError("lz4 is not installed") from None
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1))
    if compression == b"":
        return packed
    raise ValueError("an unknown compression")


def _chunk_records(plain: bytes) -> list[Any]:
    """Return the schemas, channels and messages of a chunk; raises one of _BROKEN for anything else in it."""
    records, at = [], 0
    while at < len(plain):
        opcode, length = _PREFIX.unpack_from(plain, at)
        at += _PREFIX.size + length
        if at > len(plain):
            raise ValueError("a record longer than its chunk")
        records.append(_parsed(opcode, plain[at - length : at]))
    return records


def _alone(opcode: int, body: bytes, damage: Damage) -> list[Any]:
    """Return a record that stands in no chunk, nothing when it is damaged."""
    try:
        return [_parsed(opcode, body)]
    except _BROKEN:
        damage.bad_records += 1
        return []


def _parsed(opcode: int, body: bytes) -> Any:
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_ns, publish_ns = struct.unpack_from("<HIQQ", body)
        return Message(channel, log_ns, body[22:], publish_ns, sequence)
    if opcode not in _KINDS:
        raise ValueError("a record that does not belong here")
    stream = ReadDataStream(BytesIO(body))
    record = _KINDS[opcode].read(stream)
    if stream.count != len(body):
        raise ValueError("a record with a rest")
    return record
