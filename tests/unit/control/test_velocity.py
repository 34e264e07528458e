"""The velocity loop on the Loiter plant, with the delays and the noise of a real link."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.velocity import VelocityController, VelocitySetpoint, VelocityTuning, height_above_ground_m
from morpheyes_daemon.messages.core import Sticks, VehicleState
from tests.support.copter_parameters import copter_parameters
from tests.support.loiter_plant import LoiterPlant

VELOCITY_LATENCY_MS = 60
ATTITUDE_LATENCY_MS = 10
NOISE_M_S = 0.05

Profile = Callable[[float], tuple[float, float, float | None]]


class Flight:
    """One run of the loop at 50 Hz: wanted (north, east, yaw) over time against a plant stepped every millisecond."""

    def __init__(self, loit_speed: float = 500, tuning: VelocityTuning | None = None, delay_s: float = 0.2) -> None:
        parameters = copter_parameters(LOIT_SPEED=loit_speed, LOIT_BRK_DELAY=delay_s)
        self.model = LoiterModel.from_parameters(parameters)
        self.controller = VelocityController(self.model, tuning)
        self.plant = LoiterPlant(loit_speed / 100, self.model.lean_max_rad, delay_s)
        self.track: list[tuple[float, float]] = []
        self.sticks: list[Sticks] = []

    def fly(self, seconds: float, profile: Profile, seed: int = 1, latency_ms: int = VELOCITY_LATENCY_MS) -> None:
        noise = random.Random(seed)
        past: list[tuple[list[float], list[float], float]] = []
        for ms in range(round(seconds * 1000)):
            plant = self.plant
            past.append((list(plant.v), list(plant.lean), plant.yaw))
            if ms % 20 == 0:
                v = past[max(0, ms - latency_ms)][0]
                _, lean, yaw = past[max(0, ms - ATTITUDE_LATENCY_MS)]
                now = 1000 * S + ms * MS
                state = VehicleState(
                    pitch_rad=-lean[0],
                    roll_rad=lean[1],
                    yaw_rad=yaw,
                    position_t_ns=now - latency_ms * MS,
                    p_ned_m=(0.0, 0.0, -1.5),
                    v_ned_m_s=(v[0] + noise.gauss(0, NOISE_M_S), v[1] + noise.gauss(0, NOISE_M_S), 0.0),
                )
                north, east, heading = profile(ms / 1000)
                s = self.controller.step(VelocitySetpoint((north, east, 0.0), heading, 1.5), state, now)
                self.sticks.append(s)
            plant.step_ms(
                -self.model.pitch.deflection(s.pitch_us),
                self.model.roll.deflection(s.roll_us),
                self.model.yaw_rate_rad_s(s.yaw_us),
            )
            self.track.append((plant.v[0], plant.v[1]))

    def deflections(self, sticks: Sticks) -> tuple[float, float]:
        return self.model.roll.deflection(sticks.roll_us), self.model.pitch.deflection(sticks.pitch_us)

    def rise_s(self, start_s: float, before: float, after: float) -> float:
        """Time to 90 % of a step in the north speed."""
        steps = enumerate(self.track[round(start_s * 1000) :])
        return next(ms / 1000 for ms, (v, _) in steps if (v - before) / (after - before) >= 0.9)

    def overshoot(self, start_s: float, end_s: float, before: float, after: float) -> float:
        part = self.track[round(start_s * 1000) : round(end_s * 1000)]
        return max((v - after) / (after - before) for v, _ in part)


@pytest.mark.parametrize(("loit_speed", "rise_s"), [(300, 2.2), (500, 1.5), (1250, 1.4)])
@pytest.mark.parametrize("latency_ms", [30, 100, 200])
def test_steps_rise_in_time_without_overshoot(loit_speed: float, rise_s: float, latency_ms: int) -> None:
    flight = Flight(loit_speed)
    flight.fly(9.0, lambda t: (2.9 if t < 5 else 1.0, 0.0, 0.0), latency_ms=latency_ms)
    assert flight.rise_s(0.0, 0.0, 2.9) < rise_s
    assert flight.overshoot(0.0, 5.0, 0.0, 2.9) < 0.10
    assert flight.rise_s(5.0, 2.9, 1.0) < 1.3
    assert flight.overshoot(5.0, 9.0, 2.9, 1.0) < 0.10


@pytest.mark.parametrize(("north", "east"), [(3.7, -1.4), (1.0, 3.8), (-2.5, 2.9)])
def test_a_bounded_lean_keeps_the_wanted_course(north: float, east: float) -> None:
    flight = Flight()
    flight.fly(1.2, lambda t: (north, east, 0.0))
    most = max(math.hypot(*flight.deflections(s)) for s in flight.sticks)
    assert most * flight.model.lean_max_rad > math.radians(19.5)
    way = [sum(v[axis] for v in flight.track) / 1000 for axis in (0, 1)]
    across = (way[1] * north - way[0] * east) / math.hypot(north, east)
    # 0.05 m/s of noise on the velocity; bounded axis by axis it would be 0.3 to 0.5 m
    assert abs(across) < 0.1


def test_course_is_held_while_the_vehicle_turns() -> None:
    flight = Flight()
    flight.fly(8.0, lambda t: (1.5, 0.0, 0.4 * t))
    # 0.15 m/s across is the turn during the 60 ms of latency and the lean's own lag
    assert max(abs(east) for _, east in flight.track[3000:]) < 0.25
    assert flight.plant.yaw == pytest.approx(0.4 * 8.0, abs=0.3)


def test_stop_is_neutral_sticks_and_comes_to_rest() -> None:
    flight = Flight()
    flight.fly(7.0, lambda t: (2.5 if t < 3 else 0.0, 0.0, None))
    assert all((s.roll_us, s.pitch_us) == (1500, 1500) for s in flight.sticks[151:])
    assert math.hypot(*flight.plant.v) < 0.05
    assert min(v for v, _ in flight.track) > -0.02


def test_an_active_stop_is_shorter_and_hardly_reverses() -> None:
    ends = []
    for lean_deg in (0.0, 15.0):
        flight = Flight(tuning=VelocityTuning(stop_lean_rad=math.radians(lean_deg)))
        flight.fly(7.0, lambda t: (2.5 if t < 3 else 0.0, 0.0, None))
        ends.append(sum(v for v, _ in flight.track[3000:]) / 1000)
        assert min(v for v, _ in flight.track) > -0.1
    assert ends[1] < 0.85 * ends[0]


def test_lean_stays_bounded() -> None:
    flight = Flight(1250, VelocityTuning(max_lean_rad=math.radians(10), brake_lean_rad=math.radians(5)))
    flight.fly(8.0, lambda t: (3.0, 3.0, 0.0) if t < 4 else (0.3, 0.3, 0.0))
    for s in flight.sticks:
        roll, pitch = (axis * flight.model.lean_max_rad for axis in flight.deflections(s))
        push = math.hypot(math.tan(roll), math.tan(pitch))
        assert push <= math.tan(math.radians(10)) + 0.003  # one microsecond of rounding an axis
    for s in flight.sticks[230:]:
        roll, pitch = (axis * flight.model.lean_max_rad for axis in flight.deflections(s))
        assert math.hypot(roll, pitch) <= math.radians(5) + 0.003


def test_coast_keeps_pitch_and_roll_neutral() -> None:
    model = LoiterModel.from_parameters(copter_parameters())
    state = VehicleState(p_ned_m=(0, 0, -1.0), v_ned_m_s=(1.0, 0.5, 0.0))
    s = VelocityController(model).step(VelocitySetpoint((3.0, 0.0, 0.0), 0.5, 1.5, coast=True), state, S)
    assert (s.roll_us, s.pitch_us) == (1500, 1500)
    assert s.yaw_us > 1520
    assert s.throttle_us > 1600


def test_a_height_error_within_tolerance_keeps_the_throttle_neutral() -> None:
    controller = VelocityController(LoiterModel.from_parameters(copter_parameters()))

    def throttle(height_m: float) -> int:
        vehicle = VehicleState(p_ned_m=(0, 0, -height_m))
        return controller.step(VelocitySetpoint((0.0, 0.0, 0.0), height_m=1.5), vehicle, S).throttle_us

    assert throttle(1.46) == 1500
    assert throttle(1.0) > 1600
    assert throttle(2.0) < 1400


def test_the_rangefinder_is_used_while_it_is_fresh() -> None:
    state = VehicleState(height_m=1.2, height_t_ns=10 * S, p_ned_m=(0, 0, -2.0))
    assert height_above_ground_m(state, 10 * S + 100 * MS) == 1.2
    assert height_above_ground_m(state, 11 * S) == 2.0
