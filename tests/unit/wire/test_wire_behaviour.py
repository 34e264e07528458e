"""Frames of every wrong length, signatures on frames that say they are unsigned, and the minute of a new stream."""

from __future__ import annotations

import hashlib
import struct

import numpy as np
import pytest

from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.wire.frames import HEADER_BYTES, decode_header, decode_pair, encode_pair
from morpheyes_daemon.wire.mavlink import Encoder, Identity, Signing, dialect
from morpheyes_daemon.wire.servo import Decoder, SetTarget, cobs_decode, cobs_encode, decode_body, encode

KEY = bytes(range(32))
NOW_S = 1_800_000_000.0


def signed_frame(stamp_s: float = NOW_S) -> bytes:
    message = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
    return bytes(Encoder(Signing(KEY, stamp_s)).pack(message, Identity(1, 1)))


def test_a_frame_that_says_it_is_unsigned_is_refused_whatever_its_last_bytes() -> None:
    frame = bytearray(signed_frame())
    assert Signing(KEY, NOW_S).accept(bytes(frame))
    frame[2] &= ~1
    frame[-6:] = hashlib.sha256(KEY + frame[:-6]).digest()[:6]
    assert not Signing(KEY, NOW_S).accept(bytes(frame))


def stamped(stamp: int) -> bytes:
    """A frame signed with a stamp in 10 us."""
    frame = bytearray(signed_frame())
    frame[-12:-6] = stamp.to_bytes(6, "little")
    frame[-6:] = hashlib.sha256(KEY + frame[:-6]).digest()[:6]
    return bytes(frame)


@pytest.mark.parametrize(("behind", "accepted"), [(6_000_000, True), (6_000_001, False)])
def test_a_new_stream_may_be_a_minute_behind_and_no_more(behind: int, accepted: bool) -> None:
    signing = Signing(KEY, NOW_S)
    assert signing.accept(stamped(signing.stamp - behind)) is accepted


def test_a_stream_never_repeats_a_stamp_and_moves_ours_on() -> None:
    signing = Signing(KEY, NOW_S)
    later = signing.stamp + 10
    assert signing.accept(stamped(later))
    assert signing.stamp == later
    assert not signing.accept(stamped(later))
    assert signing.accept(stamped(later + 1))


@pytest.mark.parametrize("message", [SetTarget(7, 0.2), SetTarget(0, 0.1)])
def test_a_servo_frame_of_every_wrong_length_is_refused_and_the_next_one_heard(message: SetTarget) -> None:
    whole = encode(message)
    for cut in range(1, len(whole) - 1):
        decoder = Decoder()
        found = decoder.feed(whole[:cut] + b"\0" + whole)
        assert [m for m in found if not isinstance(m, Exception)] == [message], cut
    for more in range(1, 40):
        decoder = Decoder()
        found = decoder.feed(whole[:-1] + b"\x01" * more + b"\0" + whole)
        assert found[-1] == message


@pytest.mark.parametrize("length", range(40))
def test_a_servo_body_of_a_length_that_no_message_has_is_refused(length: int) -> None:
    body = cobs_decode(encode(SetTarget(7, 0.2))[:-1])[:-2]
    if length != len(body):
        with pytest.raises(ValueError):
            decode_body((body + bytes(40))[:length])
    else:
        assert decode_body(body) == SetTarget(7, 0.2)


@pytest.mark.parametrize("bad", [b"\x00", b"\x03\x01", b"\x03\x01\x00", b"\x02\x01\x05", b"\xff" + b"\x01" * 253])
def test_what_cobs_cannot_have_made_is_refused(bad: bytes) -> None:
    with pytest.raises(ValueError, match="not COBS"):
        cobs_decode(bad)


@pytest.mark.parametrize("length", [0, 1, 2, 252, 253, 254, 255, 256, 508, 509, 510])
def test_cobs_comes_back_at_every_length_of_its_blocks(length: int) -> None:
    for data in (bytes(length), b"\x01" * length, (b"\x01" * 253 + b"\0") * (length // 254 + 1)):
        coded = cobs_encode(data)
        assert 0 not in coded
        assert cobs_decode(coded) == data


def test_a_frame_header_of_every_wrong_value_is_refused() -> None:
    image = np.zeros((4, 6), np.uint8)
    data = encode_pair(RawPair(5, 77, image, image))
    header = decode_header(data[:HEADER_BYTES])
    assert (header.seq, header.t_ns, header.width_px, header.height_px, header.channels) == (5, 77, 6, 4, 1)
    for cut in range(HEADER_BYTES):
        with pytest.raises(struct.error):
            decode_header(data[:cut])
    for at in (0, 4, 5):
        wrong = bytearray(data[:HEADER_BYTES])
        wrong[at] ^= 2
        if at != 5:
            with pytest.raises(ValueError, match="no frames of version"):
                decode_header(bytes(wrong))
        else:
            assert decode_header(bytes(wrong)).channels == 3
    pixels = data[HEADER_BYTES:]
    for length in [*range(len(pixels)), len(pixels) + 1]:
        with pytest.raises(ValueError, match="bytes of pixels"):
            decode_pair(header, (pixels + b"\0")[:length])
    assert np.array_equal(decode_pair(header, pixels).left, image)
