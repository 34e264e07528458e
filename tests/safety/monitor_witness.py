"""A second, independent statement of the rules of safety/, which watches everything that the gate lets out.

It keeps no states: it remembers what was heard and judges each output by the rules in docs/safety.md. It shares no
code with the monitor.
"""

from __future__ import annotations

import math
from collections import Counter
from itertools import groupby

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.messages.core import Sticks, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput
from morpheyes_daemon.safety.gate import StickLimits
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitorLimits

BELIEVABLE_NS = 10 * S


class Witness:
    """Told of everything just before the monitor is; `check` raises AssertionError for an output that may not be."""

    def __init__(self, limits: SafetyMonitorLimits) -> None:
        self.limits = limits
        self.sticks: StickLimits | None = None
        self.vehicle = VehicleState()
        self.now_ns = 0
        self.stepped_ns: int | None = None
        self.output_ns = 0
        self.renewals: dict[Lease, list[int]] = {lease: [] for lease in Lease}
        self.rc: list[tuple[int, bool | None]] = []
        self.newest_rc_ns = 0
        self.used_flip_ns = -1
        self.held: tuple[int, ...] | None = None
        self.grounded = False
        self.leaving = False
        self.faults: set[tuple[Reason, str]] = set()
        self.missing: Reason | None = Reason.STARTED
        self.offer: Sticks | None = None
        self.counts: Counter[str] = Counter()

    # -- what it is told ----------------------------------------------------------------------------------------

    def hear(self, vehicle: VehicleState) -> bool:
        """Take a vehicle state; returns whether it hands the sticks back to the pilot."""
        width = vehicle.rc_us[6] if len(vehicle.rc_us) > 6 else 0
        news = vehicle.rc_t_ns and (vehicle.rc_t_ns, vehicle.rc_us) != (self.vehicle.rc_t_ns, self.vehicle.rc_us)
        self.vehicle = vehicle
        if news:
            self._update_switch(vehicle.rc_t_ns, width)
        if vehicle.heartbeat_t_ns:
            self._lease(Lease.LINK, vehicle.heartbeat_t_ns + round(self.limits.link_timeout_s * S))
        measured = min(vehicle.attitude_t_ns, vehicle.position_t_ns)
        numbers = (vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad, *vehicle.v_ned_m_s, *vehicle.p_ned_m)
        if measured and math.isfinite(sum(numbers)):
            self._lease(Lease.VEHICLE, measured + round(self.limits.vehicle_timeout_s * S))
        return bool(news and self.rc and self.rc[-1][1] is False) or not self._may_hold()

    def _update_switch(self, t_ns: int, width: float) -> None:
        newest = self.newest_rc_ns
        if not 800 <= width <= 2200:
            self.rc.append((newest, None))
            return
        on = width > self.limits.engage_above_us
        self._lease(Lease.SWITCH, t_ns + round(self.limits.switch_timeout_s * S))
        if on and t_ns < newest:
            return
        self.newest_rc_ns = max(t_ns, newest)
        self.rc.append((self.newest_rc_ns, on))
        del self.rc[:-200]

    def _lease(self, lease: Lease, expires_ns: int) -> None:
        self.renewals[lease].append(expires_ns)
        del self.renewals[lease][:-8]

    def lease(self, lease: Lease, expires_ns: int) -> None:
        self._lease(lease, expires_ns)

    def revoke(self, lease: Lease) -> None:
        self.renewals[lease].clear()

    def begin_step(self, now_ns: int) -> None:
        """A stick period begins: ages are judged now."""
        if self.stepped_ns is not None and now_ns < self.stepped_ns:
            self.rc.clear()
            self.newest_rc_ns = 0
            self.used_flip_ns = -1
            for lease in Lease:
                self.revoke(lease)
            self.grounded = True
        if self.stepped_ns is not None and now_ns - self.stepped_ns > 0.5 * S:
            self.grounded = True
        if self.trouble(now_ns) or not self.fresh(Lease.LINK, now_ns) or not self.fresh(Lease.SWITCH, now_ns):
            self.grounded = True
        self.stepped_ns = now_ns

    # -- what it knows ------------------------------------------------------------------------------------------

    def fresh(self, lease: Lease, now_ns: int) -> bool:
        return any(now_ns < expires <= now_ns + BELIEVABLE_NS for expires in self.renewals[lease])

    def trouble(self, now_ns: int) -> bool:
        vehicle = self.vehicle
        position = vehicle.ekf_t_ns and vehicle.ekf_flags & 0x18 and not vehicle.ekf_flags & 0x80
        gcs_lost = self.limits.gcs_timeout_s is not None and (now_ns - vehicle.gcs_t_ns >= self.limits.gcs_timeout_s * S)
        empty = 0.0 <= vehicle.battery_fraction < self.limits.battery_low
        return not position or vehicle.system_status > 4 or vehicle.rc_rssi == 0 or empty or gcs_lost

    def _may_hold(self) -> bool:
        """As far as heard: armed, in Loiter."""
        return not self.vehicle.heartbeat_t_ns or (self.vehicle.custom_mode == 5 and self.vehicle.armed)

    def flip_ns(self, now_ns: int) -> int | None:
        """When the switch was flipped on, if a steady off came before, a steady on after, and no gap between."""
        runs = [(on, [t for t, _ in run]) for on, run in groupby(self._unbroken(), key=lambda heard: heard[1])]
        if len(runs) < 2 or runs[-1][0] is not True or runs[-2][0] is not False:
            return None
        off, on = runs[-2][1], runs[-1][1]
        steady = on[0] - off[0] >= 200 * MS and on[-1] - on[0] >= 200 * MS
        return on[0] if steady and now_ns - on[0] <= S else None

    def _unbroken(self) -> list[tuple[int, bool | None]]:
        """The newest messages that follow one another within the time-out."""
        tail: list[tuple[int, bool | None]] = []
        for t_ns, on in reversed(self.rc):
            if tail and tail[-1][0] - t_ns > self.limits.switch_timeout_s * S:
                break
            tail.append((t_ns, on))
        return tail[::-1]

    # -- what it judges -----------------------------------------------------------------------------------------

    def check(self, out: GateOutput) -> None:
        """Referee what has just gone out to the autopilot."""
        self.counts[out.action] += 1
        if out.action is Action.RELEASE:
            assert out.widths_us == (0, 0, 0, 0)
            self.held = self.offer = None
            return
        assert out.action in (Action.STICKS, Action.NEUTRAL)
        assert self.sticks is not None, "sticks before their ranges are known"
        assert self._may_hold(), "sticks in another mode or disarmed"
        assert not self.rc or self.rc[-1][1] is not False, "sticks with the switch off"
        self._check_values(out)
        if self.held is None:
            self._check_engagement(out)
        if out.action is Action.STICKS:
            self._check_sticks(out)
        else:
            assert out.widths_us == self.sticks.neutral
            self.offer = None
        self.held, self.output_ns = out.widths_us, out.t_ns

    def _check_values(self, out: GateOutput) -> None:
        assert self.sticks is not None
        limits = self.sticks
        had = self.held or limits.neutral
        free_us = limits.slew_us_s * max(0, out.t_ns - self.output_ns) / S + 1e-6
        for i, width in enumerate(out.widths_us):
            assert type(width) is int
            assert limits.minimum[i] <= width <= limits.maximum[i]
            away, before = width - limits.neutral[i], had[i] - limits.neutral[i]
            kept = abs(before) if (away > 0) == (before > 0) else 0
            assert abs(away) <= kept + free_us, "faster than the rate limit"

    def _check_engagement(self, out: GateOutput) -> None:
        vehicle, now_ns = self.vehicle, out.t_ns
        flip_ns = self.flip_ns(now_ns)
        assert flip_ns is not None, "engaged without a flip of the switch"
        assert flip_ns > self.used_flip_ns, "one flip engaged twice"
        assert vehicle.armed
        assert vehicle.custom_mode == 5
        assert not vehicle.landed
        assert all(self.fresh(lease, now_ns) for lease in Lease), "engaged on a stale lease"
        assert not self.trouble(now_ns)
        assert not self.faults
        assert self.missing is None
        assert not self.leaving
        assert out.action is Action.NEUTRAL, "the first thing after engaging is neutral"
        self.used_flip_ns = flip_ns
        self.grounded = False
        self.counts["engagements"] += 1

    def _check_sticks(self, out: GateOutput) -> None:
        assert not self.grounded, "flying on after what only the pilot may end"
        stale = [lease for lease in Lease if not self.fresh(lease, out.t_ns)]
        assert not stale, f"sticks on stale {stale}"
        assert self.offer is not None, "sticks that nobody offered since the last neutral"
        assert out.t_ns < self.offer.expires_ns <= out.t_ns + BELIEVABLE_NS
