"""The servo protocol: golden bytes, round trips, the cobs package as oracle, and garbage."""

import random

import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.wire.servo import (
    MAX_ENCODED,
    Ack,
    Decoder,
    Hello,
    Message,
    SetTarget,
    Status,
    StatusFlag,
    Verdict,
    Welcome,
    cobs_decode,
    cobs_encode,
    encode,
)

GOLDEN: list[tuple[Message, str]] = [
    (SetTarget(0, 0.1), "0201051027a58200"),
    (SetTarget(255, 0.3), "0701ff307516b000"),
    (Hello(1), "0502016b4c00"),
    (Ack(7, Verdict.APPLIED, 0.2), "03810705204e674c00"),
    (Ack(8, Verdict.CLAMPED, 0.3), "06810801307502d900"),
    (Welcome(1, 1, 0.1, 0.3), "0482010107102730758d8e00"),
    (Status(1000, None, StatusFlag.COLD, 0), "0483e803010101020201037cbf00"),
    (Status(0x01020304, 0.25, StatusFlag(0), 3), "088304030201a861020303976700"),
]

u8, u16 = st.integers(0, 255), st.integers(0, 65535)
length_m = u16.map(lambda units: units / 1e5)
messages = st.one_of(
    st.builds(SetTarget, u8, length_m),
    st.builds(Hello, u8),
    st.builds(Ack, u8, st.sampled_from(Verdict), length_m),
    st.builds(Welcome, u8, u16, length_m, length_m),
    st.builds(
        Status,
        st.integers(0, 2**32 - 1),
        st.one_of(st.none(), st.integers(1, 65535).map(lambda units: units / 1e5)),
        st.integers(0, 3).map(StatusFlag),
        u16,
    ),
)


@pytest.mark.parametrize(("message", "frame"), GOLDEN)
def test_golden_bytes(message: Message, frame: str) -> None:
    assert encode(message).hex() == frame
    assert Decoder().feed(bytes.fromhex(frame)) == [message]


@given(st.lists(messages, max_size=8), st.integers(1, 7))
def test_what_is_encoded_comes_back_in_any_portions(sent: list[Message], portion: int) -> None:
    stream = b"".join(encode(message) for message in sent)
    decoder = Decoder()
    received = [m for i in range(0, len(stream), portion) for m in decoder.feed(stream[i : i + portion])]
    assert received == sent
    assert decoder.dropped_frames == 0


@given(messages, st.integers(0, 200), st.integers(1, 255))
def test_a_changed_byte_is_never_taken_for_a_message(message: Message, position: int, flip: int) -> None:
    frame = bytearray(encode(message))
    frame[position % len(frame)] ^= flip
    assert message not in Decoder().feed(bytes(frame) + b"\0")


@given(messages, st.binary(max_size=60))
def test_garbage_before_a_frame_costs_no_more_than_that_garbage(message: Message, garbage: bytes) -> None:
    decoder = Decoder()
    decoder.feed(garbage + b"\0")
    assert decoder.feed(encode(message)) == [message]


@given(st.binary(max_size=1200))
def test_cobs_agrees_with_the_reference(data: bytes) -> None:
    assert cobs_encode(data) == cobs.encode(data)
    assert cobs_decode(cobs_encode(data)) == data


@given(st.binary(min_size=1, max_size=40).filter(lambda data: 0 not in data))
def test_cobs_refuses_what_the_reference_refuses(encoded: bytes) -> None:
    try:
        expected = cobs.decode(encoded)
    except cobs.DecodeError:
        with pytest.raises(ValueError, match="not COBS"):
            cobs_decode(encoded)
    else:
        assert cobs_decode(encoded) == expected


@pytest.mark.parametrize("seed", [1, 2])
def test_a_stream_of_noise_raises_nothing_and_keeps_little(seed: int) -> None:
    noise, decoder = random.Random(seed), Decoder()
    for _ in range(1000):
        decoder.feed(noise.randbytes(100))
        assert len(decoder._buffer) <= MAX_ENCODED
    assert decoder.dropped_frames > 100
    decoder.feed(b"\0")
    assert decoder.feed(encode(Hello())) == [Hello()]


def test_an_endless_frame_counts_once() -> None:
    decoder = Decoder()
    for _ in range(100):
        decoder.feed(b"\x05" * 1000)
    assert decoder.feed(b"\0") == []
    assert decoder.dropped_frames == 1


@pytest.mark.parametrize("message", [SetTarget(256, 0.1), SetTarget(0, -0.1), SetTarget(0, 0.7), Hello(-1)])
def test_what_does_not_fit_is_refused(message: Message) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode(message)
