"""Frames in noise, signatures, identities, and the override that cannot say the wrong thing."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.messages.core import SECTORS
from morpheyes_daemon.wire.mavlink import (
    RELEASE,
    ChannelOverride,
    Decoder,
    Encoder,
    Identity,
    Message,
    Signing,
    dialect,
    override_message,
    source,
    text_of,
)
from morpheyes_daemon.wire.obstacle_distance import MIN_CM, obstacle_distance_message

ME = Identity(1, 197)
KEY = bytes(range(32))
NOW_S = 1_750_000_000.0


def attitude(boot_ms: int = 1, roll: float = 0.5) -> Message:
    return dialect.MAVLink_attitude_message(boot_ms, roll, -0.25, 2.0, 0.0, 0.0, 0.125)


floats32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


@given(st.integers(0, 2**32 - 1), floats32, st.integers(1, 255), st.integers(1, 255))
def test_what_is_packed_is_decoded(boot_ms: int, roll: float, sysid: int, compid: int) -> None:
    [message] = Decoder().feed(Encoder().pack(attitude(boot_ms, roll), Identity(sysid, compid)))
    assert source(message) == Identity(sysid, compid)
    assert (message.time_boot_ms, message.roll, message.yawspeed) == (boot_ms, roll, 0.125)


@given(st.lists(st.binary(max_size=60), min_size=1, max_size=12), st.lists(st.integers(1, 90), min_size=1))
def test_no_frame_is_lost_in_garbage_however_the_stream_is_cut(noise: list[bytes], cuts: list[int]) -> None:
    encoder, decoder = Encoder(), Decoder()
    stream = b"".join(chunk + encoder.pack(attitude(i), ME) for i, chunk in enumerate(noise))
    stream += bytes(300)  # whatever the noise pretends to start has to end somewhere
    got: list[int] = []
    for cut in itertools.cycle(cuts):
        got += [m.time_boot_ms for m in decoder.feed(stream[:cut]) if m.get_type() == "ATTITUDE"]
        stream = stream[cut:]
        if not stream:
            break
    assert [i for i in got if i < len(noise)] == list(range(len(noise)))


def test_ten_million_random_bytes_raise_nothing() -> None:
    decoder, noise = Decoder(), np.random.default_rng(11)
    found = 0
    for _ in range(1000):
        found += len(decoder.feed(noise.bytes(10_000)))
    # a 16-bit checksum lets one in 65536 of the plausible starts through
    assert found < 10
    assert decoder.bad_bytes > 9_990_000


@settings(max_examples=200)
@given(st.integers(0, 39), st.integers(1, 255))
def test_damaged_frame_is_no_message_and_the_next_one_is(position: int, flip: int) -> None:
    encoder, decoder = Encoder(), Decoder()
    damaged = bytearray(encoder.pack(attitude(1), ME))
    position %= len(damaged)
    damaged[position] ^= flip
    good = encoder.pack(attitude(2), ME)
    got = decoder.feed(bytes(damaged) + good + bytes(300))
    assert [m.time_boot_ms for m in got if m.get_type() == "ATTITUDE"] == [2]


def test_sequence_numbers_count_per_sender() -> None:
    encoder, decoder = Encoder(), Decoder()
    order = [ME, ME, Identity(255, 191), ME]
    numbers = [m.get_seq() for m in decoder.feed(b"".join(encoder.pack(attitude(), who) for who in order))]
    assert numbers == [0, 1, 0, 2]


def test_newer_dialects_longer_message_is_read_as_far_as_known() -> None:
    longer = type("Longer", (dialect.MAVLink_attitude_message,), {})(1, 0.5, 0, 0, 0, 0, 0)
    mav = dialect.MAVLink(None, 1, 1)
    frame = longer._pack(mav, longer.crc_extra, longer.unpacker.pack(1, 0.5, 0, 0, 0, 0, 0) + b"\x01\x02\x03\x04")
    [message] = Decoder().feed(bytes(frame))
    assert message.roll == 0.5


def signed(stamp_s: float = NOW_S, key: bytes = KEY) -> tuple[Encoder, Signing]:
    signing = Signing(key, stamp_s)
    return Encoder(signing), signing


def test_signed_frames_pass_and_others_do_not() -> None:
    decoder = Decoder(Signing(KEY, NOW_S))
    assert len(decoder.feed(signed()[0].pack(attitude(), ME))) == 1
    assert decoder.feed(Encoder().pack(attitude(), ME)) == []
    assert decoder.feed(signed(key=bytes(32))[0].pack(attitude(), ME)) == []
    assert decoder.rejected == 2


def test_replayed_and_old_frames_are_rejected() -> None:
    decoder = Decoder(Signing(KEY, NOW_S))
    encoder = signed()[0]
    first, second = encoder.pack(attitude(1), ME), encoder.pack(attitude(2), ME)
    assert [m.time_boot_ms for m in decoder.feed(second + first + second)] == [2]
    assert decoder.feed(signed(NOW_S - 61)[0].pack(attitude(), Identity(1, 9))) == []


def test_forged_future_stamp_does_not_lock_the_stream_out() -> None:
    decoder = Decoder(Signing(KEY, NOW_S))
    forger = signed(NOW_S + 10**8, key=bytes(32))[0]
    assert decoder.feed(forger.pack(attitude(), ME)) == []
    assert len(decoder.feed(signed()[0].pack(attitude(), ME))) == 1


def test_our_stamps_follow_a_verified_peer_when_our_clock_is_behind() -> None:
    ours = Signing(KEY, 0.0)
    Decoder(ours).feed(signed(NOW_S)[0].pack(attitude(), ME))
    peer = Decoder(Signing(KEY, NOW_S))
    assert len(peer.feed(Encoder(ours).pack(attitude(), Identity(255, 191)))) == 1


def test_unusable_keys_are_one_sentence() -> None:
    for text in ("zz" * 32, "00" * 31, ""):
        with pytest.raises(ConfigError, match="64"):
            Signing.from_hex(text, NOW_S)
    assert Signing.from_hex(KEY.hex() + "\n", NOW_S).key == KEY


widths = st.integers(-10, 70_000)


@given(st.tuples(widths, widths, widths, widths))
def test_an_override_values_all_four_sticks_or_releases_them(channels: tuple[int, int, int, int]) -> None:
    if channels == (0, 0, 0, 0) or all(800 <= width <= 2200 for width in channels):
        override = ChannelOverride(channels)
        message = override_message(override, 1)
        assert [message.chan5_raw, message.chan6_raw, message.chan7_raw, message.chan8_raw] == [65535] * 4
        assert message.chan9_raw == message.chan18_raw == 0
    else:
        with pytest.raises(ValueError, match="channels 1 to 4"):
            ChannelOverride(channels)


def test_release() -> None:
    assert RELEASE.releases
    assert not ChannelOverride((1500, 1500, 1500, 1500)).releases


@given(st.text("aZ0 _äß€漢🚁\0", max_size=20))
def test_text_fields_of_either_type(text: str) -> None:
    clean = text.replace("\0", "")
    assert text_of(clean.encode() + b"\0junk") == clean


def test_characters_that_pymavlink_could_not_read_stay_text() -> None:
    message = dialect.MAVLink_param_value_message(b"RC1_\xf4\x80MIN", 1.0, 9, 1, 0)
    assert text_of(message.param_id) == "RC1_\ufffd\ufffdMIN"


def test_obstacles_never_look_free_because_they_are_near() -> None:
    sectors = np.full(SECTORS, np.nan, np.float32)
    sectors[:6] = [0.0, 0.01, 0.5, 9.99, 10.5, math.inf]
    message = obstacle_distance_message(sectors, math.radians(46.8), 10.0, 5_000_000)
    assert message.distances[:6] == [MIN_CM + 1, MIN_CM + 1, 50, 999, 1001, 1001]
    assert set(message.distances[6:]) == {65535}
    assert (message.min_distance, message.max_distance, message.frame) == (MIN_CM, 1000, 12)
    assert message.increment_f * SECTORS == pytest.approx(46.8)
    assert message.angle_offset == pytest.approx(-23.4)
    assert message.time_usec == 5000
    with pytest.raises(ValueError, match="72"):
        obstacle_distance_message(sectors[:10], 1.0, 10.0, 0)
