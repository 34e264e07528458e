"""The Teensy twin on a real pseudo-terminal, opened as the daemon opens its ports, in real time."""

from __future__ import annotations

import asyncio
import sys

import pytest

from morpheyes_daemon.bus import EventLog
from morpheyes_daemon.clock import MonotonicClock
from morpheyes_daemon.config.vehicle import ServoMotion
from morpheyes_daemon.devices.link import open_link
from morpheyes_daemon.devices.servo.teensy import SerialServo
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.simulation.servo.pty import PseudoTerminal
from morpheyes_daemon.simulation.servo.teensy import ServoTruth, TeensyTwin

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals here")


async def test_the_twin_answers_on_its_port_and_a_pulled_cable_is_noticed() -> None:
    events: list[Event] = []
    noticed = asyncio.Event()

    def note(event: Event) -> None:
        events.append(event)
        noticed.set()

    log = EventLog()
    log.subscribe(note)
    clock = MonotonicClock()
    twin = TeensyTwin(ServoTruth(), clock, seed=1)
    terminal = PseudoTerminal(twin.receive)
    twin.connect(terminal.write)
    servo = SerialServo(f"serial:{terminal.path}:115200", ServoMotion(), open_link, clock, log)
    await servo.open()
    await servo.move(0.25)
    twin.receive(b"noise without an end")
    await servo.move(0.3)
    assert twin.baseline_at(clock.now_ns()) > 0.19
    assert servo.dropped_frames == 0
    terminal.close()
    terminal.close()
    async with asyncio.timeout(20):
        await noticed.wait()
    assert events[0].reason is Reason.SERVO_LOST
    await servo.close()


async def test_a_port_that_nobody_reads_drops_what_is_too_much() -> None:
    terminal = PseudoTerminal(lambda data: None)
    for _ in range(100):
        terminal.write(bytes(1000))
    assert terminal.lost_bytes > 0
    terminal.close()
