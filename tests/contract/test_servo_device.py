"""The serial servo against the Teensy twin: acknowledged moves, every fault of the twin, loss and recovery."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from morpheyes_daemon.bus import EventLog
from morpheyes_daemon.clock import S, run_virtual, running_clock
from morpheyes_daemon.config.vehicle import NoServoConfig, ServoMotion
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import Link, MemoryLink, OnBytes, OnLost
from morpheyes_daemon.devices.servo import build_servo
from morpheyes_daemon.devices.servo.teensy import SerialServo
from morpheyes_daemon.errors import DeviceError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.simulation.servo.teensy import ServoFault, ServoTruth, TeensyTwin
from morpheyes_daemon.wire import servo as wire

MOTION = ServoMotion()


@dataclass
class Bench:
    """A servo, its twin, the cable between them, and what the servo told the event log."""

    servo: SerialServo
    twin: TeensyTwin
    cable: Cable
    events: list[Event] = field(default_factory=list)

    def reasons(self) -> list[Reason]:
        return [event.reason for event in self.events]

    def truth_mm(self) -> float:
        return self.twin.baseline_at(running_clock().now_ns()) * 1e3


class Cable:
    """Opens in-memory links to a twin; can be pulled and plugged in again."""

    def __init__(self, twin: TeensyTwin) -> None:
        self._twin = twin
        self._on_lost: OnLost | None = None
        self._host: MemoryLink | None = None
        self._device: MemoryLink | None = None
        self.plugged = True
        self.opened = 0

    async def open(self, url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
        if not self.plugged:
            raise DeviceNotFoundError(f"{url} is not there.")
        self.opened += 1
        self._host, device = MemoryLink.pair(0.001)
        self._host.on_bytes, device.on_bytes = on_bytes, self._twin.receive
        self._twin.connect(device.write)
        self._device = device
        self._on_lost = on_lost
        return self._host

    def echo(self) -> None:
        """From now on the line returns what the host sends, and the Teensy is dead."""
        device = self._device
        assert device is not None
        self._twin.inject(ServoFault.SILENT)
        device.on_bytes = device.write

    def renumber(self) -> None:
        """From now on acknowledgements carry the number of another target."""
        device, decoder = self._device, wire.Decoder()
        assert device is not None

        def passed_on(data: bytes) -> None:
            for message in decoder.feed(data):
                wrong = isinstance(message, wire.Ack)
                device.write(wire.encode(replace(message, seq=(message.seq + 1) % 256) if wrong else message))  # type: ignore[arg-type]

        self._twin.connect(passed_on)

    def pull(self) -> None:
        self.plugged = False
        assert self._host is not None
        assert self._on_lost is not None
        self._host.close()
        self._on_lost("unplugged")


@asynccontextmanager
async def bench(motion: ServoMotion = MOTION, truth: ServoTruth | None = None) -> AsyncIterator[Bench]:
    clock, log = running_clock(), EventLog()
    twin = TeensyTwin(truth or ServoTruth(), clock, seed=3)
    cable = Cable(twin)
    servo = SerialServo("memory:", motion, cable.open, clock, log)
    made = Bench(servo, twin, cable)
    log.subscribe(made.events.append)
    status = asyncio.create_task(twin.run())
    try:
        yield made
    finally:
        await servo.close()
        await servo.close()
        status.cancel()


def flies(scene: Coroutine[Any, Any, None]) -> None:
    run_virtual(scene)


async def passes(seconds: float) -> None:
    clock = running_clock()
    await clock.sleep_until_ns(clock.now_ns() + round(seconds * S))


def test_a_move_is_acknowledged_and_the_eyes_arrive() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await b.servo.move(0.250)
            assert b.truth_mm() == pytest.approx(200, abs=0.01)
            await passes(1.5)
            assert b.truth_mm() == pytest.approx(250, abs=0.8)  # play 0.5, repeatability 0.1
            assert b.events == []
            assert b.servo.status is not None
            assert b.servo.status.target_m == 0.25

    flies(scene())


def test_the_same_seed_moves_the_same_way() -> None:
    async def scene() -> list[float]:
        async with bench() as b:
            await b.servo.open()
            places = []
            for target_m in (0.25, 0.11, 0.3):
                await b.servo.move(target_m)
                await passes(0.7)
                places.append(b.truth_mm())
            return places

    assert run_virtual(scene()) == run_virtual(scene())


def test_nobody_answers_on_opening() -> None:
    async def scene() -> None:
        async with bench() as b:
            b.twin.inject(ServoFault.SILENT)
            with pytest.raises(DeviceNotFoundError, match="no servo controller answers"):
                await b.servo.open()
            with pytest.raises(DeviceLostError):
                await b.servo.move(0.2)
            b.twin.repair()
            await b.servo.open()
            await b.servo.move(0.2)

    flies(scene())


def test_the_device_is_not_there() -> None:
    async def scene() -> None:
        async with bench() as b:
            b.cable.plugged = False
            with pytest.raises(DeviceNotFoundError, match="not there"):
                await b.servo.open()

    flies(scene())


def test_a_sketch_for_another_rig_is_refused() -> None:
    async def scene() -> None:
        async with bench(truth=ServoTruth(max_m=0.25)) as b:
            with pytest.raises(DeviceNotFoundError, match="100 to 250 mm"):
                await b.servo.open()

    flies(scene())


def test_a_target_outside_the_stroke_is_told() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            with pytest.raises(DeviceError, match=r"went to 300\.0 mm"):
                await b.servo.move(0.32)

    flies(scene())


def test_silence_is_noticed_once_and_recovery_once() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await b.servo.move(0.15)
            b.twin.inject(ServoFault.SILENT)
            await passes(1.5)
            assert b.reasons() == [Reason.BASELINE_STALE]
            with pytest.raises(DeviceTimeoutError, match="did not acknowledge"):
                await b.servo.move(0.25)
            b.twin.repair()
            await passes(1.0)
            assert b.reasons() == [Reason.BASELINE_STALE, Reason.RECOVERED]
            await passes(3.0)
            assert b.truth_mm() == pytest.approx(250, abs=0.8)  # the target goes on being sent

    flies(scene())


def test_an_echoing_line_does_not_hide_a_dead_teensy() -> None:
    """Guards the silence timer: our own frames coming back counted as the Teensy's, and nothing was noticed."""

    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await b.servo.move(0.2)
            b.cable.echo()
            await passes(1.6)
            assert b.reasons() == [Reason.BASELINE_STALE]
            assert "silent" in b.events[0].text
            assert "echoes" in b.events[0].text
            await passes(2.4)
            with pytest.raises((DeviceLostError, DeviceTimeoutError)):
                await b.servo.move(0.21)
            assert b.cable.opened >= 2
            assert b.reasons() == [Reason.BASELINE_STALE]

    flies(scene())


def test_acknowledgements_of_other_targets_do_not_hide_that_ours_is_lost() -> None:
    """Guards the same timer: STATUS kept it running while no target was ever acknowledged."""

    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await b.servo.move(0.2)
            b.cable.renumber()
            await passes(1.6)
            assert [(event.reason, event.text) for event in b.events] == [
                (Reason.BASELINE_STALE, "the Teensy does not acknowledge its target")
            ]
            with pytest.raises(DeviceTimeoutError):
                await b.servo.move(0.21)
            await passes(5.0)
            assert b.reasons() == [Reason.BASELINE_STALE]
            assert b.cable.opened == 1
            b.twin.connect(b.cable._device.write)
            await passes(0.5)
            assert b.reasons() == [Reason.BASELINE_STALE, Reason.RECOVERED]

    flies(scene())


def test_an_idle_servo_without_a_target_is_answered_by_its_greeting() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await passes(10.0)
            assert b.events == []

    flies(scene())


def test_garbage_is_counted_and_survived() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            b.twin.inject(ServoFault.GARBAGE)
            with pytest.raises(DeviceTimeoutError):
                await b.servo.move(0.25)
            await passes(1.0)
            assert b.servo.dropped_frames > 0
            b.twin.repair()
            await passes(0.5)
            await b.servo.move(0.2)
            assert b.reasons() == [Reason.BASELINE_STALE, Reason.RECOVERED]

    flies(scene())


def test_a_restarted_teensy_is_sent_to_its_target_again() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await b.servo.move(0.3)
            await passes(0.5)
            b.twin.reboot()
            halfway_mm = b.truth_mm()
            await passes(0.4)
            assert b.truth_mm() == pytest.approx(halfway_mm, abs=1e-9)
            await passes(4.0)
            assert b.truth_mm() == pytest.approx(300, abs=0.8)
            assert b.reasons() == [Reason.SERVO_LOST, Reason.RECOVERED]
            assert "restarted" in b.events[0].text

    flies(scene())


@pytest.mark.parametrize("after_ms", range(505, 605, 20))
def test_a_restart_is_noticed_though_a_new_target_comes_before_the_first_status(after_ms: int) -> None:
    """The Teensy stood still while it booted, which the baseline's model must hear of."""

    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await b.servo.move(0.250)
            await passes(0.4)
            b.twin.reboot()
            await passes(after_ms / 1e3)
            await b.servo.move(0.2)
            await passes(1.0)
            assert b.reasons() == [Reason.SERVO_LOST, Reason.RECOVERED]

    flies(scene())


def test_a_pulled_cable_fails_the_move_and_is_opened_again() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            move = asyncio.create_task(b.servo.move(0.25))
            await asyncio.sleep(0)
            b.cable.pull()
            with pytest.raises(DeviceLostError, match="unplugged"):
                await move
            with pytest.raises(DeviceLostError):
                await b.servo.move(0.2)
            await passes(5.0)
            b.cable.plugged = True
            await passes(3.0)
            assert b.cable.opened == 2
            assert b.reasons() == [Reason.SERVO_LOST, Reason.RECOVERED]
            await b.servo.move(0.2)

    flies(scene())


def test_a_long_silence_opens_the_link_anew() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            b.twin.inject(ServoFault.SILENT)
            await passes(8.0)
            assert b.cable.opened > 1
            b.twin.repair()
            await passes(3.0)
            assert b.reasons() == [Reason.BASELINE_STALE, Reason.RECOVERED]

    flies(scene())


def test_a_closed_servo_can_be_opened_again() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            await b.servo.move(0.25)
            await b.servo.close()
            with pytest.raises(DeviceLostError):
                await b.servo.move(0.2)
            await b.servo.open()
            await b.servo.move(0.2)
            assert b.cable.opened == 2
            assert b.events == []

    flies(scene())


def test_stuck_servos_acknowledge_and_stay_and_wrong_ones_go_elsewhere() -> None:
    async def scene() -> None:
        async with bench() as b:
            await b.servo.open()
            b.twin.inject(ServoFault.STUCK)
            await b.servo.move(0.25)
            await passes(2.0)
            assert b.truth_mm() == pytest.approx(200, abs=0.01)
            b.twin.repair()
            await passes(2.0)
            assert b.truth_mm() == pytest.approx(250, abs=0.8)
            b.twin.inject(ServoFault.WRONG_POSITION)
            await b.servo.move(0.2)
            await passes(2.0)
            assert b.truth_mm() == pytest.approx(210, abs=0.8)

    flies(scene())


def test_the_fixed_rig_accepts_its_own_baseline_only() -> None:
    async def no_opener(url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
        raise AssertionError("a fixed rig opens no link")

    async def scene() -> None:
        config = NoServoConfig(backend="none", baseline_mm=57.7)
        servo = build_servo(config, DeviceContext.alone(running_clock(), no_opener))
        await servo.open()
        await servo.move(0.0577)
        with pytest.raises(DeviceError, match=r"fixed at 57\.7 mm"):
            await servo.move(0.1)
        await servo.close()

    flies(scene())
