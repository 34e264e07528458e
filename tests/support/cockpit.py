"""What a monitor is driven with in tests: `Actor` does one thing at a time, `Cockpit` whole stick periods.

Both tell the witness the same as the monitor, so that every test of the monitor also checks the rules.
"""

from __future__ import annotations

import math
from typing import Any

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.messages.core import Sticks, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.safety.gate import Gate, StickLimits
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitor, SafetyMonitorLimits
from morpheyes_daemon.safety.states import Transition
from tests.safety.monitor_witness import Witness

LIMITS = StickLimits((1000, 1010, 1020, 1000), (2000, 1990, 1980, 2000), (1500, 1490, 1500, 1510))
OTHER_LIMITS = StickLimits((1100, 1100, 1100, 1100), (1900, 1900, 1900, 1900), (1480, 1520, 1500, 1500), 2500.0)
HEALTHY = {"custom_mode": 5, "armed": True, "landed": False, "system_status": 4, "ekf_flags": 0x08, "rc_rssi": 200}
OFF_US, ON_US = 1000, 1900


class Actor:
    """A monitor, its gate, the witness and the time; every method does one thing to both."""

    def __init__(self, limits: SafetyMonitorLimits | None = None, now_ns: int = 1000 * S) -> None:
        self.limits = limits or SafetyMonitorLimits()
        self.now_ns = now_ns
        self.said: dict[str, Any] = {}
        self.sent: list[GateOutput] = []
        self.transitions: list[Transition] = []
        self.witness = Witness(self.limits)
        self.monitor = SafetyMonitor(Gate(self._output), self.limits, self.transitions.append)

    def _output(self, out: GateOutput) -> None:
        self.witness.check(out)
        self.sent.append(out)

    @property
    def state(self) -> State:
        return self.monitor.state

    def wait(self, dt_ns: int) -> None:
        self.now_ns += dt_ns

    def hear(self, **changes: Any) -> None:
        """Bring a message from the autopilot; a pilot's edge must release in this very call."""
        self.said.update(changes, t_ns=self.now_ns)
        vehicle = VehicleState(**self.said)
        held, count = self.witness.held is not None, len(self.sent)
        taken_over = self.witness.hear(vehicle)
        self.monitor.on_vehicle(vehicle, self.now_ns)
        if taken_over and held:
            assert [out.action for out in self.sent[count:]] == [Action.RELEASE], "not released on reception"
            assert self.witness.held is None

    def heartbeat(self, **changes: Any) -> None:
        self.hear(heartbeat_t_ns=self.now_ns, **changes)

    def rc(self, width: float, stamp_ns: int | None = None) -> None:
        widths = (1500, 1500, 1500, 1500, 1700, 1500, width, 1500)
        self.hear(rc_t_ns=self.now_ns if stamp_ns is None else stamp_ns, rc_us=widths)

    def motion(self, **changes: Any) -> None:
        self.hear(attitude_t_ns=self.now_ns, position_t_ns=self.now_ns, **changes)

    def renew(self, lease: Lease, for_ns: int) -> None:
        self.witness.lease(lease, self.now_ns + for_ns)
        self.monitor.gate.renew(lease, self.now_ns + for_ns)

    def revoke(self, lease: Lease) -> None:
        self.witness.revoke(lease)
        self.monitor.gate.revoke(lease)

    def offer(self, widths: tuple[float, float, float, float], for_ns: int = 100 * MS) -> None:
        sticks = Sticks(self.now_ns, self.now_ns + for_ns, *widths)  # type: ignore[arg-type]
        if not any(math.isnan(w) or math.isinf(w) for w in widths):
            self.witness.offer = sticks
        else:
            self.witness.offer = None
        self.monitor.gate.offer(sticks)

    def set_limits(self, limits: StickLimits) -> None:
        self.witness.sticks = limits
        self.monitor.gate.set_limits(limits)

    def set_missing(self, reason: Reason | None) -> None:
        self.witness.missing = reason
        self.monitor.set_missing(reason)

    def fault(self, reason: Reason, source: str = "") -> None:
        self.witness.faults.add((reason, source))
        self.witness.grounded = True
        self.monitor.fault(reason, self.now_ns, source)

    def clear(self, reason: Reason, source: str = "") -> None:
        self.witness.faults.discard((reason, source))
        self.monitor.clear(reason, self.now_ns, source)

    def mission_over(self, reason: Reason) -> None:
        self.witness.grounded = True
        self.monitor.mission_over(reason, self.now_ns)

    def shutdown(self) -> None:
        self.witness.grounded = self.witness.leaving = True
        self.monitor.shutdown(self.now_ns)

    def release_now(self, reason: Reason) -> None:
        self.witness.grounded = self.witness.leaving = True
        count = len(self.sent)
        out = self.monitor.release_now(reason, self.now_ns)
        assert out.action is Action.RELEASE
        assert self.sent[count:]
        assert all(sent.action is Action.RELEASE for sent in self.sent[count:]), "release always passes"

    def step(self) -> GateOutput:
        self.witness.begin_step(self.now_ns)
        count = len(self.sent)
        out = self.monitor.step(self.now_ns)
        assert out.action is Action.SILENT or self.sent[-1] is out
        assert out.action is not Action.SILENT or all(o.action is Action.RELEASE for o in self.sent[count:])
        if self.state is State.HOLD:
            self.witness.grounded = True
        return out


class Cockpit(Actor):
    """An actor whose autopilot and tasks all work, in stick periods of 20 ms, as long as nothing else is said."""

    PERIOD_NS = 20 * MS
    LEASE_NS = 300 * MS

    def __init__(self, limits: SafetyMonitorLimits | None = None) -> None:
        super().__init__(limits)
        self.switch_us: float = OFF_US
        self.silent: set[Lease] = set()
        self.wanted: tuple[float, float, float, float] | None = (1600, 1400, 1550, 1520)
        self.said = {**HEALTHY, "ekf_t_ns": self.now_ns, "gcs_t_ns": self.now_ns, "v_ned_m_s": (1.0, 0.0, 0.0)}

    def period(self) -> GateOutput:
        """One stick period in which everything that is not in `silent` is heard and done."""
        self.wait(self.PERIOD_NS)
        if Lease.LINK not in self.silent:
            self.heartbeat()
        if Lease.SWITCH not in self.silent:
            self.rc(self.switch_us)
        if Lease.VEHICLE not in self.silent:
            self.motion()
        for lease in (Lease.SUPERVISOR, Lease.FRAME, Lease.DEPTH, Lease.MISSION):
            if lease not in self.silent:
                self.renew(lease, self.LEASE_NS)
        if self.wanted is not None and self.state is State.ENGAGED:
            self.offer(self.wanted)
        return self.step()

    def run(self, seconds: float) -> list[GateOutput]:
        """Live through `seconds` and return what each stick period let out."""
        return [self.period() for _ in range(round(seconds * S / self.PERIOD_NS))]

    def stand_by(self) -> Cockpit:
        """Get ready in the air, having seen the vehicle on the ground."""
        self.set_limits(LIMITS)
        self.set_missing(None)
        self.monitor.boot_done(self.now_ns)
        self.heartbeat(armed=False, landed=True)
        self.heartbeat(armed=True, landed=False)
        self.run(0.3)
        assert self.state is State.STANDBY, self.monitor.reason
        return self

    def engage(self) -> Cockpit:
        """Stand by, flip the switch, and fly until the sticks are where they are wanted."""
        if self.state is not State.STANDBY:
            self.stand_by()
        self.switch_us = ON_US
        self.run(0.3)
        assert self.state is State.ENGAGED, self.monitor.reason
        return self

    def into(self, state: State) -> Cockpit:
        """Get into any state by ways that happen."""
        ways = {
            State.BOOT: lambda: None,
            State.PREFLIGHT: lambda: self.monitor.boot_done(self.now_ns),
            State.STANDBY: self.stand_by,
            State.ENGAGED: self.engage,
            State.BRAKING: lambda: (self.engage(), self._lose(Lease.DEPTH, 0.4)),
            State.HOLD: lambda: (self.engage(), self._lose(Lease.DEPTH, 5.0)),
            State.PILOT: lambda: (self.engage(), self.heartbeat(custom_mode=2)),
            State.RELEASED: lambda: (self.engage(), self._switch_off()),
            State.FAULT: lambda: (self.stand_by(), self.fault(Reason.CAMERA_LOST, "capture")),
        }
        ways[state]()
        assert self.state is state
        return self

    def _lose(self, lease: Lease, seconds: float) -> None:
        self.silent.add(lease)
        self.run(seconds)

    def _switch_off(self) -> None:
        self.switch_us = OFF_US
        self.rc(OFF_US)
