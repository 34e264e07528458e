"""MAVLink 2 frames to messages and back, over pymavlink's ardupilotmega dialect; and the one stick message.

pymavlink decodes and packs single frames. Finding frames in a noisy stream and verifying signatures is done here:
its own parser throws away up to 280 good bytes after a false start, and its signature check stores the sender's
time stamp before it has compared the signature, so that one forged frame locks a stream out. No port is opened here
and no clock is read.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
from dataclasses import dataclass
from typing import Any

os.environ["MAVLINK20"] = "1"  # read by pymavlink on import; without it some tools fall back to MAVLink 1

from pymavlink.dialects.v20 import ardupilotmega as dialect

from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.safety import NARROWEST_US, WIDEST_US

__all__ = [
    "LEAVE",
    "RELEASE",
    "ChannelOverride",
    "Decoder",
    "Encoder",
    "Identity",
    "Message",
    "Signing",
    "dialect",
    "frame_number",
    "frame_source",
    "override_message",
    "source",
    "text_of",
]

Message = Any
"""A pymavlink message object of the ardupilotmega dialect."""

LEAVE = 65535
"""RC_CHANNELS_OVERRIDE: the autopilot keeps what it has on this channel (1 to 8)."""
BACKLOG_BYTES = 256 * 1024
"""Received bytes that a decoder keeps unread; 2.8 s of a serial line at 921600 baud."""
SIGNING_EPOCH_S = 1_420_070_400
"""Signature stamps count 10 us since 2015-01-01 UTC."""

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_SIGNATURE_LENGTH = 13
_ONE_MINUTE = 6_000_000
_MARKER = re.compile(rb"\xfe|\xfd.[\x00\x01]", re.DOTALL)
"""What a frame can start with; a version 2 frame has a length and then flags of which only the signature's is known."""


@dataclass(frozen=True, slots=True)
class ChannelOverride:
    """Pulse widths of radio channels 1 to 4: all four valued, or all four 0, which releases them.

    Channels 5 to 8 always go out as 65535 and 9 to 18 as 0, which both mean: leave alone. Overriding only some
    sticks has crashed vehicles (ArduPilot issue 33125), so it cannot be expressed.
    """

    channels_us: tuple[int, int, int, int]

    def __post_init__(self) -> None:
        widths = self.channels_us
        if widths != (0, 0, 0, 0) and not all(NARROWEST_US <= width <= WIDEST_US for width in widths):
            raise ValueError(f"channels 1 to 4 must all be {NARROWEST_US} to {WIDEST_US} us or all 0, not {widths}")

    @property
    def releases(self) -> bool:
        """True when it hands the sticks back."""
        return self.channels_us == (0, 0, 0, 0)


RELEASE = ChannelOverride((0, 0, 0, 0))


def override_message(override: ChannelOverride, target_system: int) -> Message:
    """Return the RC_CHANNELS_OVERRIDE message for the vehicle `target_system`."""
    return dialect.MAVLink_rc_channels_override_message(target_system, 1, *override.channels_us, *(LEAVE,) * 4)


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a message is from."""

    sysid: int
    compid: int


def source(message: Message) -> Identity:
    """Return who sent a decoded message."""
    return Identity(message.get_srcSystem(), message.get_srcComponent())


def text_of(field: bytes | str) -> str:
    """Return a character field as text; pymavlink gives either type, and what is past a NUL is no text."""
    text = field if isinstance(field, str) else field.decode("utf-8", "replace")
    return text.split("\0")[0]


class Signing:
    """The shared key and the time stamps of every signed stream (link, system, component).

    `stamp` is the sender's time in 10 us since 2015; it is moved on by verified frames alone.
    """

    def __init__(self, key: bytes, wall_time_s: float) -> None:
        if len(key) != 32:
            raise ConfigError(f"A signing key has 32 bytes, not {len(key)}: write 64 hexadecimal digits.")
        self.key = key
        self.stamp = max(0, round((wall_time_s - SIGNING_EPOCH_S) * 1e5))
        self._newest: dict[tuple[int, int, int], int] = {}

    @classmethod
    def from_hex(cls, text: str, wall_time_s: float) -> Signing:
        """Read a key of 64 hexadecimal digits; raises ConfigError."""
        try:
            key = bytes.fromhex(text.strip())
        except ValueError:
            raise ConfigError("The signing key is not hexadecimal: write 64 digits 0-9 a-f.") from None
        return cls(key, wall_time_s)

    def accept(self, frame: bytes) -> bool:
        """Return whether a MAVLink 2 frame is signed with our key and newer than the last of its stream.

        The signature is compared first; nothing is remembered of a frame that fails it.
        """
        if frame[0] != _V2 or not frame[2] & _SIGNED:
            return False
        digest = hashlib.sha256(self.key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, frame[-6:]):
            return False
        stream = (frame[-13], frame[5], frame[6])
        stamp = int.from_bytes(frame[-12:-6], "little")
        newest = self._newest.get(stream)
        if stamp <= newest if newest is not None else stamp + _ONE_MINUTE < self.stamp:
            return False
        self._newest[stream] = stamp
        self.stamp = max(self.stamp, stamp)
        return True


class Decoder:
    """Bytes as they arrive to messages; whatever is not a whole valid frame is counted in `bad_bytes` and skipped.

    `add` takes bytes, `next_frame` finds the frames in them one by one, and `decode` makes a message of one; a
    frame whose message nobody wants costs its checksum alone. `feed` does all three. After a frame that fails its
    checksum the search goes on one byte later, so no good frame behind it is lost. With `signing`, unsigned and
    wrongly signed frames are counted in `rejected` and dropped; `signed` counts those that carry a signature.
    """

    def __init__(self, signing: Signing | None = None) -> None:
        self._mav = dialect.MAVLink(None)
        self._signing = signing
        self._buffer = bytearray()
        self._at = 0
        self._waits = True
        self.bad_bytes = 0
        self.rejected = 0
        self.signed = 0

    def feed(self, data: bytes) -> list[Message]:
        """Add received bytes and return the messages that are now complete; never raises on any input."""
        self.add(data)
        messages = []
        while (frame := self.next_frame()) is not None:
            message = self.decode(frame)
            if message is not None:
                messages.append(message)
        return messages

    def add(self, data: bytes) -> None:
        """Take received bytes; what is kept unread beyond BACKLOG_BYTES is dropped, the oldest first."""
        del self._buffer[: self._at]
        self._at = 0
        self._buffer += data
        self._waits = False
        excess = len(self._buffer) - BACKLOG_BYTES
        if excess > 0:
            self.bad_bytes += excess
            del self._buffer[:excess]

    @property
    def pending(self) -> bool:
        """True while `next_frame` may find another frame, or more garbage, in what has been received."""
        return not self._waits

    def next_frame(self, most_bad_bytes: int = BACKLOG_BYTES) -> bytes | None:
        """Return the next whole valid frame; None when there is none, or after `most_bad_bytes` of garbage."""
        buffer, limit = self._buffer, self.bad_bytes + most_bad_bytes
        while self.bad_bytes < limit:
            start = _MARKER.search(buffer, self._at)
            if start is None:
                self._skip_garbage()
                return None
            self.bad_bytes += start.start() - self._at
            at = self._at = start.start()
            length = _frame_length(buffer, at)
            if length is None or at + length > len(buffer):
                self._waits = True
                return None
            frame = bytes(buffer[at : at + length])
            if not length or not _checksum_fits(frame):
                self.bad_bytes += 1
                self._at += 1
                continue
            self._at += length
            if self._admits(frame):
                return frame
        return None

    def decode(self, frame: bytes) -> Message | None:
        """Return the message of a frame of `next_frame`, None when its payload cannot be read."""
        try:
            return self._mav.decode(bytearray(frame))
        except dialect.MAVError:
            self.bad_bytes += len(frame)
            return None

    def _skip_garbage(self) -> None:
        """No frame starts in the rest, unless its last bytes are the first ones of a header."""
        keep = len(self._buffer)
        for at in range(max(self._at, keep - 2), keep):
            if self._buffer[at] in (_V1, _V2):
                keep = at
                break
        self.bad_bytes += keep - self._at
        self._at = keep
        self._waits = True

    def _admits(self, frame: bytes) -> bool:
        if frame[0] == _V2 and frame[2] & _SIGNED:
            self.signed += 1
        if self._signing is None or self._signing.accept(frame):
            return True
        self.rejected += 1
        return False


def frame_source(frame: bytes) -> Identity:
    """Return who sent a frame of `Decoder.next_frame`."""
    return Identity(frame[5], frame[6]) if frame[0] == _V2 else Identity(frame[3], frame[4])


def frame_number(frame: bytes) -> int:
    """Return the message id of a frame of `Decoder.next_frame`."""
    return frame[7] | frame[8] << 8 | frame[9] << 16 if frame[0] == _V2 else frame[5]


def _checksum_fits(frame: bytes) -> bool:
    end = len(frame) - (_SIGNATURE_LENGTH if frame[0] == _V2 and frame[2] & _SIGNED else 0)
    crc = dialect.x25crc(frame[1 : end - 2])
    crc.accumulate(bytes((dialect.mavlink_map[frame_number(frame)].crc_extra,)))
    return bool(crc.crc == frame[end - 2] | frame[end - 1] << 8)


def _frame_length(buffer: bytearray, at: int) -> int | None:
    """Length of the frame that may start at the marker `at`; 0: none can; None: more bytes are needed to tell.

    A payload longer than ours is a message that a newer dialect has extended, and is read as far as we know it.
    """
    is_v2 = buffer[at] == _V2
    header = 10 if is_v2 else 6
    if len(buffer) - at < header:
        return None
    if is_v2:
        number = int.from_bytes(buffer[at + 7 : at + 10], "little")
        known = number in dialect.mavlink_map and not buffer[at + 2] & ~_SIGNED
        signature = _SIGNATURE_LENGTH if buffer[at + 2] & _SIGNED else 0
    else:
        known, signature = buffer[at + 5] in dialect.mavlink_map, 0
    return header + buffer[at + 1] + 2 + signature if known else 0


class Encoder:
    """Messages to frames; numbers and signs each sender's stream by itself."""

    def __init__(self, signing: Signing | None = None, link_id: int = 0) -> None:
        self._signing = signing
        self._link_id = link_id
        self._streams: dict[Identity, Any] = {}

    def pack(self, message: Message, sender: Identity) -> bytes:
        """Return the MAVLink 2 frame of `message` as sent by `sender`."""
        stream = self._streams.get(sender)
        if stream is None:
            stream = self._streams[sender] = self._new_stream(sender)
        if self._signing is not None:
            stream.signing.timestamp = self._signing.stamp
        frame = bytes(message.pack(stream))
        stream.seq = (stream.seq + 1) % 256
        if self._signing is not None:
            self._signing.stamp = stream.signing.timestamp
        return frame

    def _new_stream(self, sender: Identity) -> Any:
        stream = dialect.MAVLink(None, srcSystem=sender.sysid, srcComponent=sender.compid)
        if self._signing is not None:
            stream.signing.secret_key = self._signing.key
            stream.signing.link_id = self._link_id
            stream.signing.sign_outgoing = True
        return stream
