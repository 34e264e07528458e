"""The channel to the observer: the writer never waits, the oldest is dropped, and what arrives is whole."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from morpheyes_daemon.errors import InputError
from morpheyes_daemon.observer.channel import HEADER, LARGEST_RECORD, QUEUE_LIMIT, ChannelWriter, RecordReader
from morpheyes_daemon.observer.requests import Request, RequestReader, send_request


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A connected pair of stream sockets."""
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    yield ours, theirs
    ours.close()
    theirs.close()


def received(reader: RecordReader, theirs: socket.socket) -> list[object]:
    """Everything that can be read at once."""
    found: list[object] = []
    while True:
        try:
            data = theirs.recv(1 << 16)
        except BlockingIOError:
            return found
        if not data:
            return found
        found += reader.feed(data)


def test_records_arrive_whole_and_in_order_however_the_bytes_are_cut(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    writer, reader = ChannelWriter(), RecordReader()
    writer.connect(ours)
    for k in range(50):
        writer.put((k, "x" * k))
    writer.flush()
    data = theirs.recv(1 << 20)
    found: list[object] = []
    for at in range(0, len(data), 7):
        found += reader.feed(data[at : at + 7])
    assert found == [(k, "x" * k) for k in range(50)]


def test_a_reader_that_does_not_read_makes_the_writer_drop_the_oldest(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    ours, theirs = pair
    writer, reader = ChannelWriter(), RecordReader()
    writer.connect(ours)
    for k in range(QUEUE_LIMIT + 500):
        writer.put((k, b"x" * 5000))
        writer.flush()
    assert writer.connected
    assert writer.dropped > 0
    found = received(reader, theirs)
    while writer.pending:
        writer.flush()
        found += received(reader, theirs)
    numbers = [record[0] for record in found if isinstance(record, tuple)]
    assert numbers == sorted(numbers), "in order, with a gap"
    assert numbers[-1] == QUEUE_LIMIT + 499, "the newest is there"
    assert len(numbers) == QUEUE_LIMIT + 500 - writer.dropped


def test_a_reader_that_died_disconnects_without_raising(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    writer = ChannelWriter()
    writer.connect(ours)
    theirs.close()
    writer.put(1)
    writer.flush()
    assert not writer.connected
    writer.put(2)
    writer.flush()
    assert writer.pending, "kept for the next reader"


def test_what_cannot_be_told_is_counted_and_the_rest_is_told(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    writer, reader = ChannelWriter(), RecordReader()
    writer.connect(ours)
    writer.put(lambda: None)
    writer.put(b"x" * (LARGEST_RECORD + 1))
    writer.put("good")
    writer.flush()
    assert writer.failed == 2
    assert received(reader, theirs) == ["good"]


def test_no_more_time_no_more_records(pair: tuple[socket.socket, socket.socket]) -> None:
    writer = ChannelWriter()
    writer.connect(pair[0])
    writer.put(1)
    writer.flush(lambda: False)
    assert writer.pending


def test_a_stream_out_of_step_is_refused() -> None:
    with pytest.raises(InputError):
        list(RecordReader().feed(HEADER.pack(LARGEST_RECORD + 1)))


def test_requests_are_read_whole_and_what_is_none_is_thrown_away(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    ours.setblocking(False)
    reader = RequestReader()
    assert reader.poll(ours) == []
    theirs.send(b"arm\n\xff\xfe\nst")
    assert reader.poll(ours) == []
    theirs.send(b"op\n")
    assert reader.poll(ours) == [Request.STOP]
    assert send_request(theirs, Request.STOP)
    assert reader.poll(ours) == [Request.STOP]


def test_a_flood_of_requests_takes_a_bounded_bite(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    ours.setblocking(False)
    theirs.send(b"x" * 100_000)
    reader = RequestReader()
    assert [reader.poll(ours) for _ in range(5)] == [[]] * 5
    assert len(reader._pending) <= 256
