"""The velocity loop through connection and link on the autopilot twin: steps and a stop, judged by the truth."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress

import pytest

from morpheyes_daemon.clock import MS, S, Ticker, run_virtual
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.control.velocity import VelocityController, VelocitySetpoint
from morpheyes_daemon.devices.autopilot.stick_output import ChannelMap
from morpheyes_daemon.devices.link import MemoryLink
from morpheyes_daemon.simulation.autopilot.parameters import FLOW_SETUP, RECOMMENDED
from morpheyes_daemon.simulation.crew.scripted import GroundCrew
from tests.support.connection_bench import ConnectionBench

HEIGHT_M = 2.4
ESTIMATOR_M_S = 0.1
GPS = dict(RECOMMENDED)
FLOW = {**RECOMMENDED, **FLOW_SETUP}


class Flight:
    """The bench in the air, and the true speed along north at every stick period."""

    def __init__(self, bench: ConnectionBench) -> None:
        self.bench = bench
        self.track: list[tuple[float, float]] = []
        self.output = bench.connection.claim_stick_output()
        parameters = bench.connection.parameters.values
        self.model = LoiterModel.from_parameters(parameters)
        self.channels = ChannelMap.from_parameters(parameters)
        self.controller = VelocityController(self.model)

    async def fly(self, seconds: float, north_m_s: float) -> list[float]:
        """Ask for a speed to the north and return the true ones."""
        clock, speeds = self.bench.clock, []
        ticker = Ticker(clock, 50.0)
        for _ in range(round(seconds * 50)):
            await ticker.wait()
            now_ns = clock.now_ns()
            state = self.bench.vehicle
            s = self.controller.step(VelocitySetpoint((north_m_s, 0.0, 0.0), 0.0, HEIGHT_M), state, now_ns)
            self.output(self.channels.override((s.roll_us, s.pitch_us, s.throttle_us, s.yaw_us)))
            truth = self.bench.twin.truth_at(now_ns - 20 * MS)
            speeds.append(truth.v_ned_m_s[0])
            assert abs(truth.v_ned_m_s[1]) < 0.35
            assert abs(-truth.p_ned_m[2] - HEIGHT_M) < 0.4
        return speeds


async def take_off(bench: ConnectionBench) -> Flight:
    near, far = MemoryLink.pair(0.0)
    crew = GroundCrew(bench.twin.radio, near, bench.clock, without_gps=bench.twin.parameters.flow_only)
    near.on_bytes = crew.on_bytes
    far.on_bytes = bench.twin.attach(far)
    station = asyncio.create_task(crew.run())
    await bench.ready()
    await crew.take_off(HEIGHT_M)
    station.cancel()
    with suppress(asyncio.CancelledError):
        await station
    return Flight(bench)


def rise_s(speeds: list[float], before: float, after: float) -> float:
    """Time to nine tenths of the step."""
    return next(i for i, v in enumerate(speeds) if (v - before) / (after - before) >= 0.9) / 50.0


def overshoot(speeds: list[float], before: float, after: float) -> float:
    """Share of the step; the estimator's noise and drift, which nobody can steer against, is taken off."""
    sign = math.copysign(1.0, after - before)
    return (max(sign * (v - after) for v in speeds) - ESTIMATOR_M_S) / abs(after - before)


@pytest.mark.parametrize("parameters", [GPS, FLOW], ids=["gps", "flow"])
def test_steps_up_and_down_and_the_stop(parameters: dict[str, float]) -> None:
    async def story() -> None:
        async with ConnectionBench(parameters) as bench:
            flight = await take_off(bench)
            up = await flight.fly(4.0, 2.9)
            down = await flight.fly(3.0, 1.0)
            again = await flight.fly(3.0, 2.5)
            start = bench.twin.truth_at(bench.clock.now_ns() - 20 * MS)
            stop = await flight.fly(4.0, 0.0)
            end = bench.twin.truth_at(bench.clock.now_ns() - 20 * MS)
        assert rise_s(up, 0.0, 2.9) < 1.8
        assert overshoot(up, 0.0, 2.9) < 0.10
        assert rise_s(down, up[-1], 1.0) < 1.5
        assert overshoot(down, up[-1], 1.0) < 0.10
        # the noise and slow drift of the velocity that Loiter holds it by
        assert max(abs(v) for v in stop[-50:]) < 0.35
        distance = math.dist(start.p_ned_m[:2], end.p_ned_m[:2])
        reserved = flight.model.stopping_distance_m(again[-1], HEIGHT_M, reaction_s=0.1)
        # the reserve covers it; the twin's airframe stops a little sooner than its reference
        assert 0.65 * reserved < distance < reserved

    run_virtual(story())


def test_speed_of_the_governor_stops_within_the_distance() -> None:
    async def story() -> None:
        async with ConnectionBench(GPS) as bench:
            flight = await take_off(bench)
            speed = flight.model.speed_for_distance_m(1.5, HEIGHT_M, reaction_s=0.1)
            await flight.fly(4.0, speed)
            start = bench.twin.truth_at(bench.clock.now_ns() - 20 * MS)
            await flight.fly(4.0, 0.0)
            end = bench.twin.truth_at(bench.clock.now_ns() - 20 * MS)
            assert start.t_ns < end.t_ns - 3 * S
            assert math.dist(start.p_ned_m[:2], end.p_ned_m[:2]) < 1.5

    run_virtual(story())
