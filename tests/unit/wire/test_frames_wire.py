"""Frames between simulator and daemon: golden header, round trips, sizes checked before anything is read."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.wire.frames import (
    HEADER_BYTES,
    TcpAddress,
    UnixAddress,
    decode_header,
    decode_pair,
    encode_pair,
    parse_address,
)

sides = st.integers(1, 12)
shapes = st.one_of(st.tuples(sides, sides), st.tuples(sides, sides, st.just(3)))


@st.composite
def pairs(draw: st.DrawFn) -> RawPair:
    shape = draw(shapes)
    images = [draw(arrays(np.uint8, shape)) for _ in range(2)]
    return RawPair(draw(st.integers(0, 2**64 - 1)), draw(st.integers(-(2**63), 2**63 - 1)), *images)


@given(pairs())
def test_a_pair_comes_back(pair: RawPair) -> None:
    frame = encode_pair(pair)
    back = decode_pair(decode_header(frame[:HEADER_BYTES]), frame[HEADER_BYTES:])
    assert (back.seq, back.t_ns) == (pair.seq, pair.t_ns)
    np.testing.assert_array_equal(back.left, pair.left)
    np.testing.assert_array_equal(back.right, pair.right)
    assert not back.left.flags.writeable


def test_golden_bytes() -> None:
    left, right = np.array([[1, 2, 3]], np.uint8), np.array([[4, 5, 6]], np.uint8)
    frame = encode_pair(RawPair(7, 8, left, right))
    stamps = "0700000000000000" + "0800000000000000"
    assert frame.hex() == "4d455945" + "01010000" + stamps + "03000000" + "01000000" + "010203040506"


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (np.zeros((2, 3), np.uint8), np.zeros((3, 2), np.uint8)),
        (np.zeros((2, 3), np.uint8), np.zeros((2, 3), np.uint16)),
        (np.zeros((2, 3, 4), np.uint8), np.zeros((2, 3, 4), np.uint8)),
    ],
)
def test_what_is_no_pair_is_not_sent(left: np.ndarray, right: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not a stereo pair"):
        encode_pair(RawPair(0, 0, left, right))


def header(magic: bytes = b"MEYE", version: int = 1, channels: int = 3, width: int = 4, height: int = 4) -> bytes:
    return struct.pack("<4sBBHQqII", magic, version, channels, 0, 0, 0, width, height)


@pytest.mark.parametrize(
    "data",
    [
        header(magic=b"HTTP"),
        header(version=2),
        header(channels=2),
        header(width=0),
        header(width=1 << 31, height=1 << 31),
        header(height=8193),
    ],
)
def test_a_header_that_cannot_be_is_refused_before_its_pixels(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"no frames|impossible"):
        decode_header(data)


@given(st.binary(min_size=HEADER_BYTES, max_size=HEADER_BYTES))
def test_noise_is_a_value_error_or_a_small_frame(data: bytes) -> None:
    try:
        assert decode_header(data).pair_bytes <= 2 * 3 * 8192**2
    except ValueError:
        pass


def test_pixels_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="instead of 96"):
        decode_pair(decode_header(header()), bytes(95))


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("unix:/run/morpheyes/frames", UnixAddress("/run/morpheyes/frames")),
        ("/tmp/frames", UnixAddress("/tmp/frames")),
        ("frames.sock", UnixAddress("frames.sock")),
        ("tcp:127.0.0.1:9000", TcpAddress("127.0.0.1", 9000)),
        ("tcp:[::1]:9000", TcpAddress("[::1]", 9000)),
    ],
)
def test_addresses(text: str, address: UnixAddress | TcpAddress) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["", "unix:", "tcp:9000", "tcp:host:port", "tcp:host:70000", "udp:host:9000"])
def test_what_is_no_address_is_told(text: str) -> None:
    with pytest.raises(ConfigError, match="no frame address"):
        parse_address(text)
