"""The truth of a SITL from its SIM_STATE: local metres, interpolated, and honest about what it does not know."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.errors import DeviceTimeoutError, InputError
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.crew.sitl_vehicle import AHEAD_NS, KEPT, SitlVehicle
from tests.support.hand_clock import HandClock

LAT, LON, ALT = -353632620, 1491652370, 584.0
LATITUDE = math.radians(LAT / 1e7)
PER_UNIT_M = 6_378_137.0 * math.pi / 180.0 / 1e7


class Deaf:
    def write(self, data: bytes) -> None:
        """Nobody reads what is asked for."""


class PassingClock(HandClock):
    """Sleeping moves the time; `meanwhile` happens on the first sleep."""

    def __init__(self) -> None:
        super().__init__()
        self.meanwhile: Callable[[], object] = lambda: None

    async def sleep_until_ns(self, t_ns: int) -> None:
        self.t_ns = t_ns
        self.meanwhile()


class Bench:
    def __init__(self, clock: PassingClock | None = None) -> None:
        self.clock = clock or PassingClock()
        self.vehicle = SitlVehicle(Deaf(), Radio(), self.clock)
        self.sender = mavlink.MAVLink(None, 1, 1)

    def say(self, north_m: float, east_m: float, up_m: float, yaw_rad: float = 0.0, v_m_s: float = 0.0) -> int:
        """Let the SITL say where it is now, and return when."""
        lat = LAT + round(north_m / PER_UNIT_M)
        lon = LON + round(east_m / (PER_UNIT_M * math.cos(LATITUDE)))
        message = mavlink.MAVLink_sim_state_message(
            1, 0, 0, 0, 0.1, -0.2, yaw_rad, 0, 0, 0, 0, 0, 0,
            lat / 1e7, lon / 1e7, ALT + up_m, 0, 0, v_m_s, 0, 0, lat, lon,
        )  # fmt: skip
        self.vehicle.on_bytes(message.pack(self.sender))
        return self.clock.now_ns()


def test_positions_are_metres_from_the_start_in_the_world() -> None:
    bench = Bench()
    bench.say(0.0, 0.0, 0.0)
    bench.clock.t_ns += 10 * MS
    t_ns = bench.say(12.0, -3.0, 1.5)
    bench.vehicle.stand_at(2.0, 1.0)
    truth = bench.vehicle.truth_at(t_ns)
    # SIM_STATE counts in 1e-7 degrees: 11 mm
    assert truth.p_ned_m == pytest.approx((14.0, -2.0, -1.5), abs=0.012)
    assert (truth.roll_rad, truth.pitch_rad) == pytest.approx((0.1, -0.2))


def test_between_two_poses_it_interpolates_across_south_too() -> None:
    bench = Bench()
    first_ns = bench.say(0.0, 0.0, 0.0, yaw_rad=math.pi - 0.1)
    bench.clock.t_ns += 20 * MS
    bench.say(1.0, 0.0, 0.0, yaw_rad=-math.pi + 0.1)
    truth = bench.vehicle.truth_at(first_ns + 10 * MS)
    assert truth.p_ned_m[0] == pytest.approx(0.5, abs=0.012)
    assert abs(truth.yaw_rad) == pytest.approx(math.pi, abs=1e-6)


def test_it_moves_on_for_a_while_and_then_says_that_it_does_not_know() -> None:
    bench = Bench()
    t_ns = bench.say(0.0, 0.0, 0.0, v_m_s=2.0)
    assert bench.vehicle.truth_at(t_ns + S // 10).p_ned_m[0] == pytest.approx(0.2)
    with pytest.raises(InputError, match="not known"):
        bench.vehicle.truth_at(t_ns + AHEAD_NS + 1)
    with pytest.raises(InputError, match="not known"):
        bench.vehicle.truth_at(t_ns - 1)


async def test_a_pose_that_comes_late_is_waited_for() -> None:
    bench = Bench(PassingClock())
    bench.say(0.0, 0.0, 0.0)
    bench.clock.t_ns += 2 * S
    bench.clock.meanwhile = lambda: bench.say(1.0, 0.0, 0.0)
    await bench.vehicle.catch_up()
    assert bench.vehicle.truth_at(bench.clock.now_ns()).p_ned_m[0] == pytest.approx(1.0, abs=0.012)


async def test_a_sitl_that_has_stopped_is_not_waited_for_in_vain() -> None:
    bench = Bench(PassingClock())
    bench.say(0.0, 0.0, 0.0)
    bench.clock.t_ns += S
    with pytest.raises(DeviceTimeoutError, match="stopped"):
        await bench.vehicle.catch_up()


def test_a_first_picture_may_take_longer_than_poses_are_kept() -> None:
    bench = Bench()
    bench.say(0.0, 0.0, 1.5)
    plan = make_plan("forest", size="160x120", calibration="exact")
    stage = SimVehicle(plan.scenario, plan.config, bench.clock, vehicle=bench.vehicle)
    t_ns = bench.clock.now_ns()
    picture = stage.exposure(1, t_ns)
    for _ in range(KEPT):
        bench.clock.t_ns += 10 * MS
        bench.say(0.0, 0.0, 1.5)
    with pytest.raises(InputError, match="is not known"):
        stage.exposure(2, t_ns)
    assert picture().left.shape == (120, 160, 3)
    stage.close()
