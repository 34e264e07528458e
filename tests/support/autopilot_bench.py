"""An autopilot twin on a hand-set clock with one ground-station link, for tests of its behaviour."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.simulation.airframe.dynamics import Airframe, Truth, Vehicle
from morpheyes_daemon.simulation.autopilot.ekf import NOISELESS, EstimatorNoise
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin
from tests.support.hand_clock import HandClock

NEUTRAL = (1500, 1500, 1500, 1500)
KEEP = 65535
TICK_NS = 10 * MS


class Station:
    """A MAVLink peer of the twin with its own identity; keeps what it hears by message type."""

    def __init__(self, bench: AutopilotBench, sysid: int = 255, compid: int = 190) -> None:
        self._bench = bench
        self._mav = mavlink.MAVLink(None, sysid, compid)
        self._mav.robust_parsing = True
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.heard_ns: dict[str, list[int]] = defaultdict(list)
        self._receive = bench.twin.attach(self)

    def write(self, data: bytes) -> None:
        """Take what the twin sends."""
        for message in self._mav.parse_buffer(data) or []:
            self.heard[message.get_type()].append(message)
            self.heard_ns[message.get_type()].append(self._bench.clock.t_ns)

    def send(self, message: Any, sysid: int | None = None, compid: int | None = None) -> None:
        """Send as oneself, or with a borrowed identity."""
        own = self._mav.srcSystem, self._mav.srcComponent
        self._mav.srcSystem = own[0] if sysid is None else sysid
        self._mav.srcComponent = own[1] if compid is None else compid
        self._receive(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        self._mav.srcSystem, self._mav.srcComponent = own

    def command(self, command: int, *params: float) -> int:
        """Send COMMAND_LONG and return the MAV_RESULT of its acknowledgement."""
        values = [float(value) for value in params] + [0.0] * (7 - len(params))
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *values))
        return int(self.heard["COMMAND_ACK"][-1].result)

    def stream(self, message_id: int, rate_hz: float) -> int:
        """Ask for a message at a rate."""
        return self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, round(1e6 / rate_hz))

    def override(self, *channels_us: int, **identity: int) -> None:
        """Send RC_CHANNELS_OVERRIDE; channels not given are left alone (65535 up to 8, 0 from 9 on)."""
        low = [*channels_us[:8], *[KEEP] * (8 - len(channels_us))]
        high = [*channels_us[8:], *[0] * (10 - max(0, len(channels_us) - 8))]
        self.send(mavlink.MAVLink_rc_channels_override_message(1, 1, *low, *high), **identity)


class AutopilotBench:
    """A calm, noise-free vehicle on ArduCopter's defaults, with `changes`."""

    def __init__(
        self,
        changes: Mapping[str, float] | None = None,
        *,
        receiver: bool = True,
        noise: EstimatorNoise = NOISELESS,
        seed: int = 0,
        ready_after_s: float = 0.1,
        old_names: bool = False,
    ) -> None:
        self.clock = HandClock()
        self.vehicle = Vehicle(Airframe(shiver_rad=0.0), seed=seed)
        self.radio = Radio(present=receiver)
        self.twin = AutopilotTwin(
            self.vehicle,
            self.clock,
            {"FLTMODE1": Mode.LOITER, **(changes or {})},
            seed,
            radio=self.radio,
            noise=noise,
            ready_after_s=ready_after_s,
            old_parameter_names=old_names,
        )
        self.station = Station(self)

    @property
    def truth(self) -> Truth:
        return self.twin.truth_at(self.twin.autopilot.t_ns)

    @property
    def speed_m_s(self) -> float:
        return math.hypot(*self.truth.v_ned_m_s[:2])

    @property
    def mode(self) -> Mode:
        return self.twin.autopilot.mode

    @property
    def texts(self) -> list[str]:
        return [message.text for message in self.station.heard["STATUSTEXT"]]

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds * S / TICK_NS)):
            self.clock.t_ns += TICK_NS
            self.twin.advance(self.clock.t_ns)

    def hold(self, seconds: float, *sticks_us: int, rate_hz: float = 50.0) -> None:
        """Stream overrides of roll, pitch, throttle, yaw for a while."""
        for _ in range(round(seconds * rate_hz)):
            self.station.override(*sticks_us)
            self.wait(1.0 / rate_hz)

    def take_off(self, height_m: float = 3.0) -> None:
        """Arm and climb in Loiter by overrides, and centre the receiver's sticks."""
        while not self.twin.autopilot.estimator.has_position:
            self.hold(0.1, 1500, 1500, 1000, 1500)
        if self.twin.parameters.flow_only:
            self.station.send(mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0))
        assert self.station.command(mavlink.MAV_CMD_DO_SET_MODE, 1, Mode.LOITER) == 0, self.texts
        assert self.station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0, self.texts
        self.radio.sticks()
        while self.truth.height_m < height_m - 0.6:
            self.hold(0.1, 1500, 1500, 1800, 1500)
        while self.truth.height_m < height_m - 0.04:
            self.hold(0.1, 1500, 1500, 1620, 1500)
        self.hold(1.0, *NEUTRAL)

    def forward(self, pitch_us: int, seconds: float) -> None:
        """Hold the pitch stick."""
        self.hold(seconds, 1500, pitch_us, 1500, 1500)

    def reach(self, speed_m_s: float, pitch_us: int) -> None:
        """Hold the pitch stick until the vehicle is that fast."""
        for _ in range(3000):
            if self.speed_m_s >= speed_m_s:
                return
            self.forward(pitch_us, 0.02)
        raise AssertionError(f"{pitch_us} us never reaches {speed_m_s} m/s")
