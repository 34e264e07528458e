"""The gate: the one place from which sticks reach the autopilot, and the last word on them.

It obeys the stricter of the state and the leases: sticks pass only in ENGAGED while every lease is fresh and the
values are sane; otherwise neutral while we hold the sticks, or release. Releasing asks nobody and always passes.
It holds no task and awaits nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages import Sticks
from morpheyes_daemon.reasons import Reason
from morpheyes_daemon.safety.states import EFFECTS, Action, State

RELEASE_REPEAT_S = 1.0
"""A lost release datagram leaves the last stick in force, so it is repeated for this long."""


class Lease(StrEnum):
    """Inputs without which no stick is deflected; `reason` of each stands in `LEASE_REASONS`."""

    FRAME = "frame"
    DEPTH = "depth"
    MISSION = "mission"
    VEHICLE = "vehicle"
    LINK = "link"
    SWITCH = "switch"
    SUPERVISOR = "supervisor"


LEASE_REASONS: dict[Lease, Reason] = {
    Lease.FRAME: Reason.FRAME_STALE,
    Lease.DEPTH: Reason.DEPTH_STALE,
    Lease.MISSION: Reason.MISSION_STALE,
    Lease.VEHICLE: Reason.VEHICLE_STALE,
    Lease.LINK: Reason.LINK_LOST,
    Lease.SWITCH: Reason.SWITCH_STALE,
    Lease.SUPERVISOR: Reason.SUPERVISOR_STALE,
}


@dataclass(frozen=True, slots=True)
class StickLimits:
    """Bounds of the four sticks in microseconds, from the autopilot's own RCn parameters.

    `neutral` is (roll trim, pitch trim, throttle mid-range, yaw trim). Away from neutral the sticks move at most
    `slew_us_s`; towards neutral they may jump.
    """

    minimum: tuple[int, int, int, int]
    maximum: tuple[int, int, int, int]
    neutral: tuple[int, int, int, int]
    slew_us_s: float = 4000.0


@dataclass(frozen=True, slots=True)
class GateOutput:
    """What went out at one stick period; the four widths are what was sent, 0 for release and silence."""

    t_ns: int
    state: State
    action: Action
    reason: Reason | None
    roll_us: int = 0
    pitch_us: int = 0
    throttle_us: int = 0
    yaw_us: int = 0

    @property
    def widths_us(self) -> tuple[int, int, int, int]:
        """Roll, pitch, throttle, yaw."""
        return self.roll_us, self.pitch_us, self.throttle_us, self.yaw_us


class Gate:
    """Owns the autopilot's stick output, given to it as `output` and to nobody else."""

    def __init__(self, output: Callable[[GateOutput], None]) -> None:
        self._output = output
        self._limits: StickLimits | None = None
        self._expiry: dict[Lease, int] = dict.fromkeys(Lease, 0)
        self._offer: Sticks | None = None
        self._last: tuple[int, int, int, int] | None = None
        self._last_ns = 0
        self._released_since_ns: int | None = None
        self.rejected = 0

    @property
    def has_limits(self) -> bool:
        """True once the autopilot's stick ranges are known; before that only a release can be sent."""
        return self._limits is not None

    def set_limits(self, limits: StickLimits) -> None:
        """Take the autopilot's stick ranges."""
        self._limits = limits

    def renew(self, lease: Lease, expires_ns: int) -> None:
        """Extend (never shorten) a lease."""
        self._expiry[lease] = max(self._expiry[lease], expires_ns)

    def revoke(self, lease: Lease) -> None:
        """End a lease now."""
        self._expiry[lease] = 0

    def stale(self, now_ns: int) -> Lease | None:
        """Return the first lease that has run out, None when all are fresh."""
        return next((lease for lease in Lease if now_ns >= self._expiry[lease]), None)

    def offer(self, sticks: Sticks) -> None:
        """Put stick positions before the gate; they count until they expire."""
        if all(math.isfinite(w) for w in (sticks.roll_us, sticks.pitch_us, sticks.throttle_us, sticks.yaw_us)):
            self._offer = sticks
        else:
            self._offer = None
            self.rejected += 1

    def step(self, state: State, reason: Reason, now_ns: int) -> GateOutput:
        """Send what the state and the leases allow at this stick period and return it."""
        effect = EFFECTS[state]
        if effect is Action.RELEASE and self._released_since_ns is None:
            self._released_since_ns = now_ns
        if effect in (Action.RELEASE, Action.SILENT) or self._limits is None:
            return self._let_go(state, reason, now_ns)
        if effect is Action.NEUTRAL:
            return self._send(state, Action.NEUTRAL, reason, self._limits.neutral, now_ns)
        lease = self.stale(now_ns)
        if lease is not None:
            return self._send(state, Action.NEUTRAL, LEASE_REASONS[lease], self._limits.neutral, now_ns)
        offer = self._offer
        if offer is None or now_ns >= offer.expires_ns:
            return self._send(state, Action.NEUTRAL, Reason.MISSION_STALE, self._limits.neutral, now_ns)
        wanted = (offer.roll_us, offer.pitch_us, offer.throttle_us, offer.yaw_us)
        return self._send(state, Action.STICKS, None, self._bounded(wanted, now_ns), now_ns)

    def release(self, state: State, reason: Reason, now_ns: int) -> GateOutput:
        """Let go now, whatever the state; called on the spot when the pilot takes over and on the way out."""
        self._released_since_ns = now_ns
        return self._let_go(state, reason, now_ns)

    def _let_go(self, state: State, reason: Reason, now_ns: int) -> GateOutput:
        """Repeat a release that is still young, else say nothing."""
        self._last = None
        self._offer = None
        since_ns = self._released_since_ns
        if since_ns is None or now_ns - since_ns > RELEASE_REPEAT_S * S:
            return GateOutput(now_ns, state, Action.SILENT, reason)
        out = GateOutput(now_ns, state, Action.RELEASE, reason)
        self._output(out)
        return out

    def _send(
        self, state: State, action: Action, reason: Reason | None, widths: tuple[int, int, int, int], now_ns: int
    ) -> GateOutput:
        self._released_since_ns = None
        self._last, self._last_ns = widths, now_ns
        out = GateOutput(now_ns, state, action, reason, *widths)
        self._output(out)
        return out

    def _bounded(self, wanted: tuple[int, int, int, int], now_ns: int) -> tuple[int, int, int, int]:
        assert self._limits is not None
        limits = self._limits
        last = self._last or limits.neutral
        dt_s = min(0.1, (now_ns - self._last_ns) / S) if self._last else 0.02
        step = limits.slew_us_s * dt_s
        bounded = []
        for i in range(4):
            neutral = limits.neutral[i]
            want = max(limits.minimum[i], min(limits.maximum[i], round(wanted[i]))) - neutral
            had = last[i] - neutral
            reach = (abs(had) if want * had > 0 else 0.0) + step
            bounded.append(neutral + round(math.copysign(min(abs(want), reach), want)))
        return bounded[0], bounded[1], bounded[2], bounded[3]
