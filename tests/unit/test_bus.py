"""Topics: the newest wins, a slow reader is told what it missed, taps and events see everything in order."""

import asyncio
from dataclasses import fields

from morpheyes_daemon.bus import EventLog, Latest, Topics
from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason


def test_a_slow_reader_gets_the_newest_and_the_count_of_the_missed() -> None:
    async def read() -> tuple[int, int]:
        topic: Latest[int] = Latest("numbers")
        reader = topic.reader()
        for number in range(5):
            topic.publish(number)
        return await reader.next(), reader.dropped

    assert run_virtual(read()) == (4, 4)


def test_a_reader_waits_for_what_comes_after_it() -> None:
    async def read() -> int:
        topic: Latest[int] = Latest("numbers")
        topic.publish(1)
        reader = topic.reader()
        asyncio.get_running_loop().call_later(0.1, topic.publish, 2)
        return await reader.next()

    assert run_virtual(read()) == 2


def test_taps_see_every_value_before_publish_returns() -> None:
    topic: Latest[int] = Latest("numbers")
    seen: list[int] = []
    topic.tap(seen.append)
    for number in range(3):
        topic.publish(number)
        assert seen[-1] == number
    assert seen == [0, 1, 2]


def test_events_reach_every_handler_in_order() -> None:
    log, first, second = EventLog(), [], []
    log.subscribe(first.append)
    log.subscribe(second.append)
    events = [Event(k, "test", Reason.STARTED) for k in range(4)]
    for event in events:
        log.publish(event)
    assert first == second == events


def test_every_topic_has_a_row_in_the_table() -> None:
    for field in fields(Topics):
        assert field.metadata["log_every"] >= 0
        assert field.metadata["description"]
