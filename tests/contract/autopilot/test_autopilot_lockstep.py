"""The twin and its ground crew on the virtual loop: a whole flight, the same bytes for the same seed."""

import asyncio
import hashlib
import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import MS, Clock, S, run_virtual, running_clock
from morpheyes_daemon.devices.link import MemoryLink
from morpheyes_daemon.errors import DeviceTimeoutError
from morpheyes_daemon.simulation.airframe.dynamics import Vehicle
from morpheyes_daemon.simulation.airframe.wind import WindConditions
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP, RECOMMENDED
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin
from morpheyes_daemon.simulation.crew.scripted import GroundCrew


class Field:
    """A twin, a crew, and a companion's link, all on the running virtual loop."""

    def __init__(self, seed: int, parameters: dict[str, float] | None = None, **crew: bool) -> None:
        self.clock: Clock = running_clock()
        vehicle = Vehicle(wind=WindConditions(3.0, 1.0), seed=seed)
        self.twin = AutopilotTwin(vehicle, self.clock, parameters, seed)
        near, far = MemoryLink.pair()
        far.on_bytes = self.twin.attach(far)
        self.crew = GroundCrew(self.twin.radio, near, self.clock, **crew)
        near.on_bytes = self.crew.on_bytes
        self.companion, end = MemoryLink.pair()
        end.on_bytes = self.twin.attach(end)
        self.received = hashlib.sha256()
        self.companion.on_bytes = self.received.update
        self._mav = mavlink.MAVLink(None, 255, 191)
        self._tasks = [asyncio.create_task(task) for task in (self.twin.run(), self.crew.run())]

    def send(self, message: mavlink.MAVLink_message) -> None:
        self.companion.write(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256

    async def override(self, pitch_us: int, seconds: float) -> None:
        for _ in range(round(seconds * 50)):
            channels = [1500, pitch_us, 1500, 1500, *[65535] * 4, *[0] * 10]
            self.send(mavlink.MAVLink_rc_channels_override_message(1, 1, *channels))
            await self.clock.sleep_until_ns(self.clock.now_ns() + 20 * MS)

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


async def whole_flight(seed: int) -> tuple[str, tuple[float, float, float]]:
    field = Field(seed)
    await field.crew.take_off(1.5)
    assert field.twin.truth_at(field.clock.now_ns()).height_m == pytest.approx(1.5, abs=0.25)
    field.crew.engage()
    for message_id in (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_RC_CHANNELS):
        command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        field.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, message_id, 20_000, 0, 0, 0, 0, 0))
    await field.override(1300, 5.0)
    truth = field.twin.truth_at(field.clock.now_ns())
    assert math.hypot(*truth.v_ned_m_s[:2]) == pytest.approx(1.77, rel=0.2), "wind of 3 m/s and gusts"
    await field.crew.land()
    truth = field.twin.truth_at(field.clock.now_ns())
    await field.close()
    assert truth.height_m == 0.0
    return field.received.hexdigest(), truth.p_ned_m


def test_a_flight_is_the_same_for_the_same_seed_bit_for_bit() -> None:
    first, second, other = (run_virtual(whole_flight(seed)) for seed in (11, 11, 12))
    assert first == second
    assert first != other


def test_the_crew_takes_off_without_gps_too() -> None:
    async def flight() -> None:
        field = Field(3, {**RECOMMENDED, **FLOW_SETUP}, without_gps=True)
        await field.crew.take_off(2.0)
        assert field.twin.autopilot.mode is Mode.LOITER
        assert field.twin.truth_at(field.clock.now_ns()).height_m == pytest.approx(2.0, abs=0.25)
        await field.close()

    run_virtual(flight())


def test_the_crew_says_why_it_cannot_take_off() -> None:
    async def flight() -> None:
        field = Field(3, {**RECOMMENDED, **FLOW_SETUP})
        try:
            with pytest.raises(DeviceTimeoutError, match="did not get ready to arm within 60 s"):
                await field.crew.take_off(2.0)
        finally:
            await field.close()

    run_virtual(flight())


def test_the_switch_is_off_until_the_crew_engages() -> None:
    radio = Radio()
    assert radio.channels_us[Radio.SWITCH_CHANNEL - 1] < 1200
    radio.switch(on=True)
    assert radio.channels_us[Radio.SWITCH_CHANNEL - 1] > 1700
    radio.switch(on=False)
    assert radio.channels_us[Radio.SWITCH_CHANNEL - 1] < 1200


def test_wind_is_mostly_rejected_in_loiter() -> None:
    async def flight() -> float:
        field = Field(5)
        await field.crew.take_off(1.5)
        worst, start_ns = 0.0, field.clock.now_ns()
        place = field.twin.truth_at(start_ns).p_ned_m
        while field.clock.now_ns() < start_ns + 30 * S:
            await field.clock.sleep_until_ns(field.clock.now_ns() + 100 * MS)
            worst = max(worst, math.dist(place[:2], field.twin.truth_at(field.clock.now_ns()).p_ned_m[:2]))
        await field.close()
        return worst

    assert 0.02 < run_virtual(flight()) < 1.0
