"""The bytes of stereo pairs between a simulator process and the daemon.

A frame is a header and the raw pixels of the left, then the right image. Both processes run on one machine, so stamps
are its monotonic clock. An address is `unix:PATH` (or a bare path) or `tcp:HOST:PORT`. This module opens nothing.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.core import Image, RawPair

MAGIC = b"MEYE"
VERSION = 1
MAX_SIDE_PX = 8192
_HEADER = struct.Struct("<4sBBHQqII")
HEADER_BYTES = _HEADER.size


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """What comes before the pixels; `channels` is 1 (grey) or 3 (BGR)."""

    seq: int
    t_ns: int
    width_px: int
    height_px: int
    channels: int

    @property
    def image_bytes(self) -> int:
        """Bytes of one of the two images."""
        return self.width_px * self.height_px * self.channels

    @property
    def pair_bytes(self) -> int:
        """Bytes that follow the header."""
        return 2 * self.image_bytes


@dataclass(frozen=True, slots=True)
class UnixAddress:
    """A socket in the file system."""

    path: str


@dataclass(frozen=True, slots=True)
class TcpAddress:
    """A TCP port."""

    host: str
    port: int


def parse_address(text: str) -> UnixAddress | TcpAddress:
    """Return what an address names; ConfigError when it is none."""
    scheme, colon, rest = text.partition(":")
    if scheme == "tcp":
        host, _, port = rest.rpartition(":")
        if host and port.isdecimal() and 0 < int(port) < 65536:
            return TcpAddress(host, int(port))
    elif scheme == "unix" and rest:
        return UnixAddress(rest)
    elif text and (not colon or "/" in scheme):
        return UnixAddress(text)
    raise ConfigError(f"{text!r} is no frame address; write unix:PATH or tcp:HOST:PORT.")


def encode_pair(pair: RawPair) -> bytes:
    """Return the frame of a pair of equal uint8 images (H, W) or (H, W, 3); ValueError for anything else."""
    left, right = pair.left, pair.right
    channels = left.shape[2] if left.ndim == 3 else 1
    if left.shape != right.shape or left.dtype != np.uint8 or right.dtype != np.uint8 or channels not in (1, 3):
        raise ValueError(f"not a stereo pair: {left.shape} {left.dtype} and {right.shape} {right.dtype}")
    height, width = left.shape[:2]
    header = _HEADER.pack(MAGIC, VERSION, channels, 0, pair.seq, pair.t_ns, width, height)
    return header + left.tobytes() + right.tobytes()


def decode_header(data: bytes) -> FrameHeader:
    """Return the header in HEADER_BYTES of data; ValueError when it is not ours or asks for absurd sizes."""
    magic, version, channels, _, seq, t_ns, width, height = _HEADER.unpack(data)
    if magic != MAGIC or version != VERSION:
        raise ValueError(f"these are no frames of version {VERSION}")
    if channels not in (1, 3) or not 0 < width <= MAX_SIDE_PX or not 0 < height <= MAX_SIDE_PX:
        raise ValueError(f"impossible image size {width}×{height}×{channels}")
    return FrameHeader(seq, t_ns, width, height, channels)


def decode_pair(header: FrameHeader, pixels: bytes) -> RawPair:
    """Return the pair, its images read-only views of `pixels`; ValueError when their number does not fit."""
    if len(pixels) != header.pair_bytes:
        raise ValueError(f"{len(pixels)} bytes of pixels instead of {header.pair_bytes}")
    shape: tuple[int, ...] = (header.height_px, header.width_px)
    if header.channels == 3:
        shape = (*shape, 3)
    both: Image = np.frombuffer(pixels, dtype=np.uint8).reshape(2, *shape)
    return RawPair(header.seq, header.t_ns, both[0], both[1])
