"""The autopilot twin against the measured stops from 3 m/s (field facts, "Stopping"), within 10 %."""

import math
from dataclasses import dataclass

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from tests.support.autopilot_bench import NEUTRAL, AutopilotBench

QUICK = {"LOIT_SPEED": 500, "LOIT_BRK_DELAY": 0.2}


@dataclass
class Stop:
    """How a stop went: time until LOCAL_POSITION_NED says less than 0.1 m/s, way until at rest, least speed."""

    time_s: float
    way_m: float
    least_m_s: float
    after_one_second_m_s: float


def stop_from_three(changes: dict[str, float], *, opposite_us: int | None = None, brake: bool = False) -> Stop:
    bench = AutopilotBench(changes)
    bench.take_off()
    bench.station.stream(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50)
    bench.reach(3.0, 1340 if changes.get("LOIT_SPEED", 1250) == 1250 else 1170)
    start, start_ns, stick_us = bench.truth, bench.clock.t_ns, opposite_us
    if brake:
        assert bench.twin.set_mode(Mode.BRAKE)
    speeds: list[tuple[float, float]] = []
    while bench.clock.t_ns - start_ns < 6e9:
        if bench.truth.v_ned_m_s[0] < 0.15:
            stick_us = None
        bench.hold(0.02, *((1500, stick_us, 1500, 1500) if stick_us else NEUTRAL))
        reported = bench.station.heard["LOCAL_POSITION_NED"][-1]
        speeds.append(((bench.clock.t_ns - start_ns) / 1e9, reported.vx))
    return Stop(
        time_s=next(t for t, v in speeds if abs(v) < 0.1),
        way_m=math.dist(start.p_ned_m, bench.truth.p_ned_m),
        least_m_s=min(v for _, v in speeds),
        after_one_second_m_s=next(v for t, v in speeds if t >= 1.0),
    )


@pytest.mark.parametrize(
    ("changes", "time_s", "way_m"),
    [({}, 3.2, 5.0), ({"LOIT_BRK_DELAY": 0.1}, 2.7, 3.4), (QUICK, 1.4, 2.7)],
    ids=["defaults", "short delay", "recommended"],
)
def test_neutral_sticks_stop_as_measured(changes: dict[str, float], time_s: float, way_m: float) -> None:
    stop = stop_from_three(changes)
    assert stop.time_s == pytest.approx(time_s, rel=0.1)
    assert stop.way_m == pytest.approx(way_m, rel=0.1)


def test_with_the_defaults_the_vehicle_coasts_for_a_second() -> None:
    assert stop_from_three({}).after_one_second_m_s == pytest.approx(2.4, rel=0.1)


def test_opposite_stick_stops_sooner_and_overshoots() -> None:
    """The stick of the recording is not given; the one that stops in its 1.3 s shows its overshoot."""
    stop = stop_from_three(QUICK, opposite_us=1700)
    assert stop.time_s == pytest.approx(1.3, rel=0.1)
    assert stop.way_m == pytest.approx(2.4, rel=0.1)
    assert stop.least_m_s == pytest.approx(-0.17, abs=0.05)


def test_brake_mode_is_slow_and_deaf() -> None:
    stop = stop_from_three({}, brake=True)
    assert stop.time_s == pytest.approx(3.6, rel=0.1)
    assert stop.way_m == pytest.approx(5.2, rel=0.1)


def test_brake_mode_ignores_the_pilot() -> None:
    bench = AutopilotBench()
    bench.take_off()
    bench.twin.set_mode(Mode.BRAKE)
    bench.hold(3.0, 1700, 1300, 1700, 1700)
    assert bench.speed_m_s < 0.02
    assert bench.truth.yaw_rad == pytest.approx(0.0, abs=0.01)
