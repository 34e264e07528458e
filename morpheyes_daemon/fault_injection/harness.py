"""A simulated flight that can be brought into any state and broken there, and what is measured when it is.

Everything is lockstep: the real daemon, the twins, a virtual clock. What left the daemon is read off the wire, not
asked of the daemon.
"""

from __future__ import annotations

import asyncio
import math
import random
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Self

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S, VirtualLoop, running_clock
from morpheyes_daemon.daemon.composition import Daemon, Parts
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.servo import build_servo
from morpheyes_daemon.errors import DeviceTimeoutError
from morpheyes_daemon.fault_injection.injectors import FaultyCamera, FaultyWorker, Wire, lose
from morpheyes_daemon.flights.lockstep import (
    AUTOPILOT_URL,
    TAKE_OFF_HEIGHT_M,
    FlightPlan,
    make_crew,
    memory_opener,
)
from morpheyes_daemon.flights.render_cache import CachedVehicle
from morpheyes_daemon.flights.sim_vehicle import SimVehicle, SimVehicleCamera
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.perception.pipeline import PipelineFactory
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.recorder import Recorder
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.vision_worker.inline import InlineWorker

NEUTRAL_US = (1500, 1500, 1500, 1500)
"""The twin's RCn_TRIM and the middle of its throttle."""

AT_REST_M_S = 0.15
SAMPLE_S = 0.05
OVERRIDE_ID = 70
CRUISE_S = 4.0
"""After engaging, before a fault: enough for the forest's usual speed."""

STANDOFF_M = 0.15
"""What the governor keeps in front of an obstacle (GovernorLimits.standoff_m)."""


class Sent(StrEnum):
    """What an RC_CHANNELS_OVERRIDE on the wire asks for."""

    STICKS = "sticks"
    NEUTRAL = "neutral"
    RELEASE = "release"


@dataclass(frozen=True, slots=True)
class Measured:
    """What one fault did. Times count from the fault; None: it did not happen.

    `reaction_s`: the first message that deflects no stick; `quiet_s`: the first after which none did. `release_s`: the
    first release. `neutrals` counts neutral messages, `sticks_after` the others after the reaction; `left` tells whether
    the daemon was ever in another state than ENGAGED. `stop_m`: flown
    from the fault to standstill; `reserved_m`: what the governor had kept free for that at the moment of the fault.
    """

    state: State
    reason: Reason
    reaction_s: float | None
    quiet_s: float | None
    release_s: float | None
    neutrals: int
    left: bool
    sticks_after: int
    last: Sent | None
    last_s: float | None
    stop_m: float
    stopped: bool
    reserved_m: float
    clearance_m: float
    events: tuple[Reason, ...]


class FaultFlight:
    """`async with FaultFlight(plan) as flight`, then `reach` a state, break something, and `measure`."""

    def __init__(self, plan: FlightPlan, folder: Path) -> None:
        self.clock = running_clock()
        self.plan = plan
        self.rng = random.Random(f"faults {plan.scenario.seed}")
        topics, events = Topics.create(), EventLog()
        self.topics = topics
        self.stage = CachedVehicle(plan.scenario, plan.config, self.clock, folder)
        self.stage.autopilot.parameters.set("RSSI_TYPE", 3)
        self.crew = make_crew(self.stage)
        opener = memory_opener(self.stage)
        self.wire, self.servo_wire = Wire(opener), Wire(opener)
        self.camera = FaultyCamera(SimVehicleCamera(self.stage, plan.config.camera.rate_hz))
        pipeline = PipelineFactory(plan.config, plan.mission, read_calibration(plan.calibration))()
        latency_ns = round(plan.config.stereo.latency_ms * S / 1e3)
        self.worker = FaultyWorker(InlineWorker(pipeline.perceive, latency_ns, self.clock), self.clock)
        self._parts = Parts(
            clock=self.clock,
            camera=self.camera,
            servo=build_servo(plan.config.servo, DeviceContext(self.clock, events, topics, self.servo_wire.open)),
            opener=self.wire.open,
            worker=self.worker,
        )
        self.daemon = Daemon(plan.config, plan.mission, self._parts, topics, events)
        header = flight_header(plan.mission_name, plan.mission, plan.config, "", 0.0)
        log = folder / "flight.mcap"
        self.recorder = Recorder(topics, events, self.clock, log, header, image_rate_hz=None, threaded=False)
        self.stop = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []
        self._sent: list[tuple[int, Sent]] = []
        self._events: list[Event] = []
        self.wire.on_sent = self._note
        events.subscribe(self._events.append)

    async def __aenter__(self) -> Self:
        self.crew_task = asyncio.create_task(self.crew.run())
        self._life = asyncio.create_task(self.daemon.run(self.stop))
        twins = [asyncio.create_task(job) for job in (self.stage.autopilot.run(), self.stage.teensy.run())]
        self._tasks = [self.crew_task, self._life, *twins]
        return self

    async def __aexit__(self, *error: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.recorder.close()
        self.stage.close()

    @property
    def state(self) -> State:
        """Where the daemon is."""
        return self.daemon.monitor.state

    @property
    def sent(self) -> list[tuple[int, Sent]]:
        """Every override on the wire: when, and what it asked for."""
        return self._sent

    # -- getting there ------------------------------------------------------------------------------------------

    async def reach(self, state: State) -> None:
        """Bring the flight into a state by ways that happen; PREFLIGHT is on the ground, all others in the air."""
        if state is State.PREFLIGHT:
            return
        await self.crew.take_off(TAKE_OFF_HEIGHT_M)
        await self._until(lambda: self.state is State.STANDBY)
        if state is State.STANDBY:
            return
        self.crew.engage()
        await self._until(lambda: self.state is State.ENGAGED)
        await self.sleep(CRUISE_S + self.rng.uniform(0.0, 0.5))
        if state in (State.BRAKING, State.HOLD):
            self.camera.stalled = True
            await self._until(lambda: self.state is state)
            self.camera.stalled = state is State.BRAKING
            await self.sleep(0.2 if state is State.BRAKING else 1.0)
            self.camera.stalled = False

    async def sleep(self, seconds: float) -> None:
        """Let simulated time pass."""
        await self.clock.sleep_until_ns(self.clock.now_ns() + round(seconds * S))

    async def _until(self, done: Callable[[], bool], limit_s: float = 30.0) -> None:
        end_ns = self.clock.now_ns() + round(limit_s * S)
        while not done():
            if self.clock.now_ns() > end_ns:
                reason = self.daemon.monitor.reason.text
                raise DeviceTimeoutError(f"The flight did not get there: it is in {self.state} ({reason}).")
            await self.sleep(0.02)

    # -- what faults do that is not a matter of one part ----------------------------------------------------------

    def block_loop(self, seconds: float) -> None:
        """Nothing runs for a while, as when a call into native code does not return."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        loop.leap(seconds)

    def die(self) -> None:
        """The daemon is gone from one instant to the next; what it would still say is not said."""
        self.wire.on_sent = lambda data: None
        self.wire.incoming = self.wire.outgoing = lose
        self.servo_wire.incoming = self.servo_wire.outgoing = lose
        self._life.cancel()

    def restart(self) -> None:
        """A new daemon takes the place of one that died, on links that work."""
        opener = memory_opener(self.stage)
        self.wire = Wire(opener)
        self.wire.on_sent = self._note
        parts, events = self._parts, EventLog()
        parts.opener = self.wire.open
        topics = Topics.create()
        parts.servo = build_servo(self.plan.config.servo, DeviceContext(self.clock, events, topics, Wire(opener).open))
        self.daemon = Daemon(self.plan.config, self.plan.mission, parts, topics, events)
        self._life = asyncio.create_task(self.daemon.run(self.stop))
        self._tasks.append(self._life)

    # -- measuring ----------------------------------------------------------------------------------------------

    async def measure(self, seconds: float) -> Measured:
        """Watch for a while from now, the moment of the fault."""
        began_ns, first, heard = self.clock.now_ns(), len(self._sent), len(self._events)
        reserved_m = self._reserved_m()
        states: list[State] = []
        self.topics.gate.tap(lambda out: states.append(out.state))
        path = TruePath(self.stage)
        while self.clock.now_ns() - began_ns < seconds * S:
            path.sample(self.clock.now_ns())
            await self.sleep(SAMPLE_S)
        sent = [((t_ns - began_ns) / S, kind) for t_ns, kind in self._sent[first:] if t_ns >= began_ns]
        quiet = [t_s for t_s, kind in sent if kind is not Sent.STICKS]
        released = [t_s for t_s, kind in sent if kind is Sent.RELEASE]
        after = [kind for t_s, kind in sent if quiet and t_s > quiet[0]]
        return Measured(
            state=self.state,
            reason=self.daemon.monitor.reason,
            reaction_s=quiet[0] if quiet else None,
            quiet_s=_quiet_s(sent),
            release_s=released[0] if released else None,
            neutrals=[kind for _, kind in sent].count(Sent.NEUTRAL),
            left=any(state is not State.ENGAGED for state in states),
            sticks_after=after.count(Sent.STICKS),
            last=sent[-1][1] if sent else None,
            last_s=sent[-1][0] if sent else None,
            stop_m=path.to_rest_m,
            stopped=path.at_rest,
            reserved_m=reserved_m,
            clearance_m=path.clearance_m,
            events=tuple(dict.fromkeys(event.reason for event in self._events[heard:])),
        )

    def _reserved_m(self) -> float:
        """What the governor believes to be free in front of the vehicle; inf while it does not govern."""
        governed = self.topics.governed.get()
        if governed is None or self.clock.now_ns() - governed.t_ns > S // 10:
            return math.inf
        return min(governed.clear_m, governed.trust_m) - STANDOFF_M

    def _note(self, data: bytes) -> None:
        """Keep what an RC_CHANNELS_OVERRIDE says; its first eight fields are the channels (MAVLink 2 framing)."""
        if len(data) > 18 and int.from_bytes(data[7:10], "little") == OVERRIDE_ID:
            widths = struct.unpack_from("<4H", data, 10)
            kind = {NEUTRAL_US: Sent.NEUTRAL, (0, 0, 0, 0): Sent.RELEASE}.get(widths, Sent.STICKS)
            self._sent.append((self.clock.now_ns(), kind))


def _quiet_s(sent: list[tuple[float, Sent]]) -> float | None:
    """Return when the first message after the last deflected stick went out; None when there is none."""
    sticks = [index for index, (_, kind) in enumerate(sent) if kind is Sent.STICKS]
    after = sent[sticks[-1] + 1 if sticks else 0 :]
    return after[0][0] if after else None


class TruePath:
    """The true way of the vehicle from where it is.

    What comes near counts in Loiter alone: in LAND or RTL nobody but the autopilot steers, and without a position it
    drifts.
    """

    def __init__(self, stage: SimVehicle) -> None:
        self._stage = stage
        self._last: tuple[float, float] | None = None
        self._flown_m = 0.0
        self.to_rest_m = 0.0
        self.at_rest = False
        self.clearance_m = math.inf

    def sample(self, t_ns: int) -> None:
        """Take the vehicle's true state at `t_ns` into account."""
        truth = self._stage.truth(t_ns)
        place = float(truth.p_ned_m[0]), float(truth.p_ned_m[1])
        if self._last is not None:
            self._flown_m += math.dist(place, self._last)
        self._last = place
        if not self.at_rest:
            self.to_rest_m = self._flown_m
            self.at_rest = math.hypot(truth.v_ned_m_s[0], truth.v_ned_m_s[1]) < AT_REST_M_S
        if self._stage.autopilot.autopilot.mode is Mode.LOITER:
            self.clearance_m = min(self.clearance_m, self._stage.clearance_m(t_ns))


__all__ = ["AUTOPILOT_URL", "FaultFlight", "Measured", "Sent", "TruePath"]
