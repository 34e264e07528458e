"""Flights at the clock's pace: on the twin, and on a real ArduPilot SITL where there is one.

`MORPHEYES_SITL=tcp:127.0.0.1:5760 pytest tests/e2e/test_realtime_flight.py`; the SITL stands on the ground, disarmed,
with GPS or with optical flow. Nothing here asserts how fast this machine is.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import S, Ticker, running_clock
from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.flights.realtime import RealtimeFlight, fly_realtime, realtime_daemon
from morpheyes_daemon.flights.simulator_process import PilotAct
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, State

pytest.importorskip("numba")
SITL = os.environ.get("MORPHEYES_SITL", "")
on_sitl = pytest.mark.skipif(not SITL, reason="no ArduPilot SITL: set MORPHEYES_SITL to its address")
twin, sitl = pytest.param(None, id="twin"), pytest.param(SITL, id="sitl", marks=on_sitl)
both = pytest.mark.parametrize("autopilot", [twin, sitl])
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

CRUISE_M_S, FAST_M_S = 1.0, 2.5
FLY_LIMIT_S = 120.0
AFTER_S = 8.0
STANDOFF_M = 0.15
"""The governor never plans to come nearer to anything than this."""
ESTIMATE_M = 0.5
"""How far the autopilot's own position may be off over such a stop, and the wind may push."""


@pytest.fixture
def plan() -> FlightPlan:
    return make_plan("forest", size="320x240", calibration="exact", limit_s=240.0)


@asynccontextmanager
async def cruising(plan: FlightPlan, folder: Path, autopilot: str | None) -> AsyncIterator[RealtimeFlight]:
    """A flight that goes through the forest at more than a walk."""
    async with realtime_daemon(plan, folder / "flight.mcap", autopilot, lambda progress: None) as flight:
        await until(flight, lambda: flight.daemon.monitor.state is State.ENGAGED and speed(flight) > CRUISE_M_S)
        yield flight


def speed(flight: RealtimeFlight) -> float:
    vehicle = flight.daemon.topics.vehicle.get()
    return math.hypot(*vehicle.v_ned_m_s[:2]) if vehicle is not None else 0.0


async def until(flight: RealtimeFlight, done: Callable[[], bool], limit_s: float = FLY_LIMIT_S) -> None:
    clock = running_clock()
    ticker, end_ns = Ticker(clock, 50.0), clock.now_ns() + round(limit_s * S)
    while not done():
        assert clock.now_ns() < end_ns, f"{flight.daemon.monitor.state}: {flight.daemon.monitor.reason.text}"
        assert not flight.running.done()
        if flight.simulator.verdict.done():
            flight.simulator.verdict.result()  # raises what ended the simulator
        await ticker.wait()


@both
def test_the_forest_mission_is_reached(plan: FlightPlan, tmp_path: Path, autopilot: str | None) -> None:
    summary = fly_realtime(plan, tmp_path, autopilot, lambda progress: None)
    assert summary.outcome == "reached", summary.reason
    assert summary.min_clearance_m > 0.0
    for name in ("summary.json", "flight.mcap", "map.png", "strips.png", "flight.mp4"):
        assert (tmp_path / name).stat().st_size > 0
    written = json.loads((tmp_path / "summary.json").read_text())
    assert len(written["sticks_sha256"]) == 64
    assert written["max_stick_interval_s"] >= written["p99_stick_interval_s"] > 0.0


@both
@pytest.mark.parametrize("act", list(PilotAct))
async def test_the_pilot_takes_over(plan: FlightPlan, tmp_path: Path, autopilot: str | None, act: PilotAct) -> None:
    async with cruising(plan, tmp_path, autopilot) as flight:
        outputs: list[GateOutput] = []
        flight.daemon.topics.gate.tap(outputs.append)
        flight.simulator.ask_pilot(act)
        wanted = State.RELEASED if act is PilotAct.SWITCH_OFF else State.PILOT
        await until(flight, lambda: flight.daemon.monitor.state is wanted, 10.0)
        held = [out.action in (Action.STICKS, Action.NEUTRAL) for out in outputs]
        await asyncio.sleep(1.0)
        later = [out.action for out in outputs[len(held) :]]
        assert set(later) <= {Action.RELEASE, Action.SILENT}
        assert Action.RELEASE in [out.action for out in outputs]


@both
async def test_a_daemon_cut_off_leaves_a_vehicle_that_stops_within_the_reserve(
    plan: FlightPlan, tmp_path: Path, autopilot: str | None
) -> None:
    async with cruising(plan, tmp_path, autopilot) as flight:
        daemon = flight.daemon
        before, governed = daemon.topics.vehicle.get(), daemon.topics.governed.get()
        assert before is not None
        assert governed is not None
        reserve_m = min(governed.clear_m, governed.trust_m) - STANDOFF_M
        daemon.connection.transmitter.link = None  # nothing of ours goes out any more; what comes in still does
        farthest_m = 0.0
        clock = running_clock()
        end_ns = clock.now_ns() + round(AFTER_S * S)
        while clock.now_ns() < end_ns:
            await asyncio.sleep(0.02)
            now = daemon.topics.vehicle.get()
            assert now is not None
            farthest_m = max(farthest_m, math.dist(now.p_ned_m[:2], before.p_ned_m[:2]))
        assert speed(flight) < 0.3
        assert farthest_m <= reserve_m + ESTIMATE_M


@pytest.mark.parametrize("autopilot", [sitl])
async def test_lost_aiding_is_braked_for_while_there_is_something_to_brake_on(
    plan: FlightPlan, tmp_path: Path, autopilot: str
) -> None:
    async with cruising(plan, tmp_path, autopilot) as flight:
        on_gps = flight.daemon.connection.parameters.values["GPS1_TYPE"] != 0
        sensor = "SIM_GPS1_ENABLE" if on_gps else "SIM_FLOW_ENABLE"
        await until(flight, lambda: speed(flight) > FAST_M_S)
        before_m_s = speed(flight)
        clock = running_clock()
        lost_ns = clock.now_ns()
        simulate_sensor(flight, sensor, on=False)
        try:
            await until(flight, lambda: flight.daemon.monitor.state is State.BRAKING, 2.0)
            braking_s = (clock.now_ns() - lost_ns) / S
            assert flight.daemon.monitor.reason is Reason.AIDING_LOST
            await until(flight, lambda: flight.daemon.monitor.state is State.PILOT, 15.0)
            failsafe_s, left_m_s = (clock.now_ns() - lost_ns) / S, speed(flight)
            print(f"{sensor}: brakes after {braking_s:.2f} s from {before_m_s:.2f} m/s,", end=" ")
            print(f"failsafe after {failsafe_s:.2f} s at {left_m_s:.2f} m/s")
            assert left_m_s < before_m_s / 2.0
        finally:
            simulate_sensor(flight, sensor, on=True)


def simulate_sensor(flight: RealtimeFlight, name: str, *, on: bool) -> None:
    """Give SITL its sensor or take it away, over the daemon's own link."""
    link = flight.daemon.connection.transmitter.link
    assert link is not None
    message = mavlink.MAVLink_param_set_message(1, 1, name.encode(), float(on), mavlink.MAV_PARAM_TYPE_INT8)
    link.write(message.pack(mavlink.MAVLink(None, 255, 190)))
