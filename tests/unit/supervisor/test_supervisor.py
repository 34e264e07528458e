"""The supervisor keeps its tasks running, tells the monitor which do not, and renews its own lease while it lives."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest

from morpheyes_daemon.bus import EventLog
from morpheyes_daemon.clock import MS, S, run_virtual, running_clock
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.supervisor.supervisor import Pulse, Supervisor, Task

LEASE_S = 0.25


class Told:
    """In the place of monitor and gate: what it was told, and when in seconds."""

    def __init__(self) -> None:
        self.calls: list[tuple[float, str, object, str | None]] = []
        self.leases: list[tuple[float, Lease, float]] = []

    def now_s(self) -> float:
        return (running_clock().now_ns() - self.began_ns) / S

    def begin(self) -> None:
        self.began_ns = running_clock().now_ns()

    def set_missing(self, reason: Reason | None, name: str) -> None:
        self.calls.append((self.now_s(), "missing", reason, name))

    def fault(self, reason: Reason, now_ns: int, name: str) -> None:
        assert now_ns == running_clock().now_ns()
        self.calls.append((self.now_s(), "fault", reason, name))

    def clear(self, reason: Reason, now_ns: int, name: str) -> None:
        assert now_ns == running_clock().now_ns()
        self.calls.append((self.now_s(), "clear", reason, name))

    def renew(self, lease: Lease, expires_ns: int) -> None:
        self.leases.append((self.now_s(), lease, (expires_ns - running_clock().now_ns()) / S))


class Life:
    """A task whose lives are written down: how long each beats, ten times a second, and how it ends."""

    def __init__(self, *lives: tuple[float, Exception | None]) -> None:
        self.lives, self.started_s, self.told = list(lives), [], cast(Told, None)

    async def run(self, pulse: Pulse) -> None:
        clock = running_clock()
        self.started_s.append(self.told.now_s())
        seconds, end = self.lives.pop(0) if self.lives else (1000.0, None)
        for _ in range(round(seconds * 10)):
            pulse.beat()
            await clock.sleep_until_ns(clock.now_ns() + 100 * MS)
        if end is not None:
            raise end


def supervised(life: Life, seconds: float, *, essential: bool = True) -> tuple[Told, list[Event], Task, Supervisor]:
    """Run a supervisor of one task."""
    told, events = Told(), []
    task = Task("camera", life.run, Reason.CAMERA_LOST, essential)
    made: list[Supervisor] = []

    async def live() -> None:
        told.begin()
        life.told = told
        log = EventLog()
        log.subscribe(events.append)
        clock = running_clock()
        one = Supervisor(cast(SafetyMonitor, told), cast(Gate, told), log, clock, LEASE_S)
        one.add(task)
        made.append(one)
        running = asyncio.create_task(one.run())
        await clock.sleep_until_ns(clock.now_ns() + round(seconds * S))
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running

    run_virtual(live())
    return told, events, task, made[0]


def test_a_task_that_works_is_left_alone_and_the_lease_is_renewed_twenty_times_a_second() -> None:
    told, events, task, one = supervised(Life(), 2.0)
    assert told.calls == []
    assert events == []
    assert task.restarts == 0
    assert len(told.leases) == pytest.approx(40, abs=1)
    assert {(lease, left_s) for _, lease, left_s in told.leases} == {(Lease.SUPERVISOR, LEASE_S)}
    assert one.pulses["camera"].count == pytest.approx(20, abs=1)


def test_one_that_has_never_worked_is_missing_and_no_fault() -> None:
    told, events, _, _ = supervised(Life((0, DeviceError("no camera."))), 0.3)
    assert told.calls == [(0.0, "missing", Reason.CAMERA_LOST, "camera")]
    assert [(event.source, event.reason, event.text) for event in events] == [
        ("camera", Reason.CAMERA_LOST, "camera: no camera.")
    ]


def test_one_that_worked_and_died_is_a_fault_until_it_works_again() -> None:
    told, events, task, _ = supervised(Life((1.0, DeviceError("gone."))), 5.0)
    assert told.calls == [
        (1.0, "fault", Reason.CAMERA_LOST, "camera"),
        (1.5, "missing", None, "camera"),
        (1.5, "clear", Reason.CAMERA_LOST, "camera"),
    ]
    assert [(event.reason, event.text) for event in events] == [
        (Reason.CAMERA_LOST, "camera: gone."), (Reason.RECOVERED, "camera: works again"),
    ]  # fmt: skip
    assert [(event.t_ns - events[0].t_ns) / S for event in events] == [0.0, 0.5]
    assert task.restarts == 1


def test_what_does_not_come_up_is_tried_less_and_less_often_but_every_five_seconds() -> None:
    life = Life(*((0, DeviceError("no camera.")) for _ in range(10)))
    told, events, task, _ = supervised(life, 20.0)
    # half a second after the first death twice as long as the first pause
    assert life.started_s == pytest.approx([0.0, 1.0, 3.0, 7.0, 12.0, 17.0])
    assert task.restarts == 5
    assert len(events) == 1, "said once"
    assert {call[1] for call in told.calls} == {"missing"}


def test_after_it_has_worked_it_is_restarted_soon_again() -> None:
    dead = (0, DeviceError("no camera."))
    life = Life(dead, dead, dead, (1.0, DeviceError("gone.")), dead)
    supervised(life, 20.0)
    assert life.started_s[3:6] == pytest.approx([7.0, 8.5, 9.5])


@pytest.mark.parametrize(
    ("end", "text"),
    [
        (lambda: None, "camera: ended unexpectedly"),
        (lambda: DeviceError("no camera."), "camera: no camera."),
        (lambda: ZeroDivisionError("by zero"), "by zero"),
    ],
)
def test_it_is_said_how_a_task_died_whatever_it_was(end: Callable[[], Any], text: str) -> None:
    life = Life((0.2, end()), (0.2, None))
    _, events, task, _ = supervised(life, 0.4)
    assert text in events[0].text
    assert events[0].text.startswith("camera: ")
    assert task.restarts == 0


def test_one_that_a_flight_does_not_need_is_restarted_and_the_monitor_not_told() -> None:
    told, events, task, _ = supervised(Life((1.0, DeviceError("gone."))), 5.0, essential=False)
    assert told.calls == []
    assert [event.reason for event in events] == [Reason.CAMERA_LOST, Reason.RECOVERED]
    assert task.restarts == 1
    told, _, _, _ = supervised(Life((0, DeviceError("gone."))), 0.3, essential=False)
    assert told.calls == []


def test_a_pulse_knows_when_it_last_beat_and_says_the_first_beat_once() -> None:
    async def live() -> None:
        clock = running_clock()
        pulse, firsts = Pulse(clock), []
        assert (pulse.count, pulse.last_ns) == (0, 0)
        pulse.on_first = lambda: firsts.append(1)
        for count in (1, 2, 3):
            await clock.sleep_until_ns(clock.now_ns() + S)
            pulse.beat()
            assert (pulse.count, pulse.last_ns) == (count, clock.now_ns())
        assert firsts == [1]

    run_virtual(live())


def test_cancelling_ends_every_task() -> None:
    ended: list[str] = []

    async def work(pulse: Pulse) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append("ended")

    async def live() -> None:
        clock = running_clock()
        tasks = [Task(name, work, Reason.CAMERA_LOST) for name in ("a", "b")]
        told = Told()
        told.begin()
        one = Supervisor(cast(SafetyMonitor, told), cast(Gate, told), EventLog(), clock, LEASE_S)
        one.add(*tasks)
        running = asyncio.create_task(one.run())
        await clock.sleep_until_ns(clock.now_ns() + S)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
        renewed = len(told.leases)
        await clock.sleep_until_ns(clock.now_ns() + S)
        assert len(told.leases) == renewed, "a supervisor that has ended renews no lease"

    run_virtual(live())
    assert ended == ["ended", "ended"]


def test_a_new_task_has_no_restarts() -> None:
    assert Task("camera", Life().run, Reason.CAMERA_LOST).restarts == 0
    assert Task("camera", Life().run, Reason.CAMERA_LOST).essential is True
    with pytest.raises(TypeError):
        Task("camera", Life().run, Reason.CAMERA_LOST, True, restarts=3)  # type: ignore[call-arg]
