"""The bytes spoken with the Teensy that drives the two linear servos.

A frame is COBS(body + CRC) + 0x00: COBS keeps zero out of the inside, so a receiver that joins late or reads
garbage is in step again at the next zero; the CRC is CRC-16/CCITT-FALSE, big-endian, over the body. A body is one
kind byte and fixed little-endian fields. `firmware/morpheyes_servo/protocol.h` is the same in C.

    host   → Teensy   SET      seq u8, target u16                       move the baseline to the target
                      HELLO    version u8                               who is there?
    Teensy → host     ACK      seq u8, verdict u8, applied u16          answer to SET
                      WELCOME  version u8, firmware u16, min u16, max u16
                      STATUS   uptime u32 ms, target u16, flags u8, dropped u16      five times a second

Lengths on the wire are in units of 0.01 mm. This module opens nothing and knows no time.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum, IntFlag

VERSION = 1
UNITS_PER_M = 100_000
MAX_BODY = 16
"""Longest body of any kind, CRC included; what is longer is garbage."""
MAX_ENCODED = MAX_BODY + 1
NO_TARGET = 0
"""Target in STATUS before the first SET after a boot: the servos get no pulses and hold where they are."""


class Verdict(IntEnum):
    """What the Teensy did with a target."""

    APPLIED = 0
    CLAMPED = 1


class StatusFlag(IntFlag):
    """Conditions that the Teensy reports of itself."""

    HOST_SILENT = 1
    """Nothing valid heard from the host for a second; the last target is held."""
    COLD = 2
    """No target since the boot."""


@dataclass(frozen=True, slots=True)
class SetTarget:
    """Move to a baseline, `target_m` rounded to 0.01 mm."""

    seq: int
    target_m: float


@dataclass(frozen=True, slots=True)
class Hello:
    """Asks who is there."""

    version: int = VERSION


@dataclass(frozen=True, slots=True)
class Ack:
    """Answers SetTarget number `seq`; `applied_m` is what the servos were really sent to."""

    seq: int
    verdict: Verdict
    applied_m: float


@dataclass(frozen=True, slots=True)
class Welcome:
    """Answers Hello with the range of baselines that the sketch was built for."""

    version: int
    firmware: int
    min_m: float
    max_m: float


@dataclass(frozen=True, slots=True)
class Status:
    """The Teensy's own state; `target_m` is None before the first target, `dropped_frames` counts bad frames."""

    uptime_ms: int
    target_m: float | None
    flags: StatusFlag
    dropped_frames: int


Message = SetTarget | Hello | Ack | Welcome | Status
FROM_TEENSY = (Ack, Welcome, Status)
"""What only the Teensy sends; anything else that the host receives is an echo of its own."""

_SET, _HELLO, _ACK, _WELCOME, _STATUS = 0x01, 0x02, 0x81, 0x82, 0x83
_FIELDS = {
    _SET: struct.Struct("<BBH"),
    _HELLO: struct.Struct("<BB"),
    _ACK: struct.Struct("<BBBH"),
    _WELCOME: struct.Struct("<BBHHH"),
    _STATUS: struct.Struct("<BIHBH"),
}


def encode(message: Message) -> bytes:
    """Return the frame of a message; ValueError when a field does not fit its width."""
    try:
        body = _FIELDS[_kind(message)].pack(_kind(message), *_values(message))
    except struct.error as error:
        raise ValueError(f"{message} does not fit the wire: {error}") from None
    return cobs_encode(body + crc_hqx(body, 0xFFFF).to_bytes(2, "big")) + b"\0"


def _kind(message: Message) -> int:
    match message:
        case SetTarget():
            return _SET
        case Hello():
            return _HELLO
        case Ack():
            return _ACK
        case Welcome():
            return _WELCOME
        case Status():
            return _STATUS


def _values(message: Message) -> tuple[int, ...]:
    match message:
        case SetTarget(seq, target_m):
            return seq, _units(target_m)
        case Hello(version):
            return (version,)
        case Ack(seq, verdict, applied_m):
            return seq, verdict, _units(applied_m)
        case Welcome(version, firmware, min_m, max_m):
            return version, firmware, _units(min_m), _units(max_m)
        case Status(uptime_ms, target_m, flags, dropped):
            return uptime_ms, NO_TARGET if target_m is None else _units(target_m), flags, dropped


def _units(length_m: float) -> int:
    return round(length_m * UNITS_PER_M)


def _metres(units: int) -> float:
    return units / UNITS_PER_M


def decode_body(body: bytes) -> Message:
    """Return the message in a body without its CRC; ValueError when it is none."""
    fields = _FIELDS.get(body[0]) if body else None
    if fields is None or len(body) != fields.size:
        raise ValueError(f"not a servo message: {body.hex() or 'empty'}")
    kind, *v = fields.unpack(body)
    if kind == _SET:
        return SetTarget(v[0], _metres(v[1]))
    if kind == _HELLO:
        return Hello(v[0])
    if kind == _ACK:
        return Ack(v[0], Verdict(v[1]), _metres(v[2]))
    if kind == _WELCOME:
        return Welcome(v[0], v[1], _metres(v[2]), _metres(v[3]))
    return Status(v[0], None if v[1] == NO_TARGET else _metres(v[1]), StatusFlag(v[2] & 3), v[3])


class Decoder:
    """Bytes in any portions → messages; what is no frame is counted in `dropped_frames` and passed over."""

    def __init__(self) -> None:
        self.dropped_frames = 0
        self._buffer = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages completed by `data`; never raises, keeps at most one frame's bytes."""
        *complete, rest = data.split(b"\0")
        messages = []
        for part in complete:
            self._append(part)
            if self._overlong or self._buffer:
                messages += self._finish()
        self._append(rest)
        return messages

    def _append(self, part: bytes) -> None:
        room = MAX_ENCODED - len(self._buffer)
        self._overlong |= len(part) > room
        self._buffer += part[:room]

    def _finish(self) -> list[Message]:
        encoded, overlong = bytes(self._buffer), self._overlong
        self._buffer.clear()
        self._overlong = False
        try:
            if overlong:
                raise ValueError("longer than any frame")
            return [decode_frame(encoded)]
        except ValueError:
            self.dropped_frames += 1
            return []


def decode_frame(encoded: bytes) -> Message:
    """Return the message of one frame without its closing zero; ValueError when damaged."""
    checked = cobs_decode(encoded)
    body, crc = checked[:-2], checked[-2:]
    if crc_hqx(body, 0xFFFF).to_bytes(2, "big") != crc:
        raise ValueError("the CRC does not fit")
    return decode_body(body)


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing (Cheshire and Baker 1999): the same data without zeros inside."""
    encoded = bytearray()
    blocks = data.split(b"\0")
    for index, block in enumerate(blocks):
        while len(block) >= 254:
            encoded += b"\xff" + block[:254]
            block = block[254:]
            if not block and index == len(blocks) - 1:
                return bytes(encoded)
        encoded += bytes([len(block) + 1]) + block
    return bytes(encoded)


def cobs_decode(encoded: bytes) -> bytes:
    """Undo `cobs_encode`; ValueError for what it cannot have made."""
    data = bytearray()
    position = 0
    while position < len(encoded):
        code = encoded[position]
        block = encoded[position + 1 : position + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            raise ValueError("not COBS")
        data += block
        position += code
        if code < 0xFF and position < len(encoded):
            data.append(0)
    return bytes(data)
