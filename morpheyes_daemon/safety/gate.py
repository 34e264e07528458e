"""The gate: the one place from which sticks reach the autopilot, and the last word on them.

It obeys the stricter of the state and the leases: sticks pass only in ENGAGED while every lease is fresh and the
values are sane; otherwise neutral while we hold the sticks, or release. Releasing asks nobody and always passes.
It holds no task and awaits nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.core import Sticks
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import NARROWEST_US, WIDEST_US, Action, GateOutput, State, Widths
from morpheyes_daemon.safety.leases import LEASE_REASONS, LONGEST_LEASE_NS, Lease
from morpheyes_daemon.safety.states import EFFECTS

RELEASE_REPEAT_S = 1.0
"""A lost release datagram leaves the last stick in force, so it is repeated for this long."""

RELEASE_REPEATS = 20
"""And at least this often, should the loop have been held up meanwhile."""


LATE_NS = 100 * MS
"""After a pause as long as this the sticks start from neutral again."""


@dataclass(frozen=True, slots=True)
class StickLimits:
    """Bounds of the four sticks in microseconds, from the autopilot's own RCn parameters.

    `neutral` is (roll trim, pitch trim, throttle mid-range, yaw trim). Away from neutral the sticks move at most
    `slew_us_s`; towards neutral they may jump. Raises DeviceError for bounds that no radio has.
    """

    minimum: Widths
    maximum: Widths
    neutral: Widths
    slew_us_s: float = 4000.0

    def __post_init__(self) -> None:
        for low, middle, high in zip(self.minimum, self.neutral, self.maximum, strict=True):
            if not NARROWEST_US <= low <= middle <= high <= WIDEST_US:
                raise DeviceError(
                    f"A stick ranges from {low} over {middle} to {high} us, which no radio does:"
                    " calibrate the radio (RCn_MIN, RCn_TRIM, RCn_MAX)."
                )
        if not 0.0 < self.slew_us_s < math.inf:
            raise DeviceError(f"The sticks' rate limit is {self.slew_us_s} us/s: it must be positive and finite.")


class Gate:
    """Owns the autopilot's stick output, given to it as `output` and to nobody else."""

    def __init__(self, output: Callable[[GateOutput], None]) -> None:
        self._output = output
        self._limits: StickLimits | None = None
        self._expiry: dict[Lease, int] = dict.fromkeys(Lease, 0)
        self._offer: Sticks | None = None
        self._sent: Widths | None = None
        self._state: State | None = None
        self._stepped_ns = self._pause_ns = 0
        self._release_ns: int | None = None
        self._releases = 0
        self.rejected = 0

    @property
    def has_limits(self) -> bool:
        """True once the autopilot's stick ranges are known; before that only a release can be sent."""
        return self._limits is not None

    @property
    def silent(self) -> bool:
        """True while we hold no stick and have no release left to repeat."""
        return self._sent is None and self._release_ns is None

    def set_limits(self, limits: StickLimits) -> None:
        """Take the autopilot's stick ranges; they count from the next stick period on."""
        self._limits = limits

    def renew(self, lease: Lease, expires_ns: int) -> None:
        """Extend (never shorten) a lease."""
        self._expiry[lease] = max(self._expiry[lease], expires_ns)

    def revoke(self, lease: Lease) -> None:
        """End a lease now."""
        self._expiry[lease] = 0

    def is_fresh(self, lease: Lease, now_ns: int) -> bool:
        """Tell whether one lease has not run out; one that lasts too long to be true is not fresh."""
        return now_ns < self._expiry[lease] <= now_ns + LONGEST_LEASE_NS

    def stale(self, now_ns: int) -> Lease | None:
        """Return the gravest lease that has run out, None when all are fresh."""
        return next((lease for lease in self._expiry if not self.is_fresh(lease, now_ns)), None)

    def offer(self, sticks: Sticks) -> None:
        """Put stick positions before the gate; they count until they expire or a step lets no stick through."""
        if all(math.isfinite(w) for w in (sticks.roll_us, sticks.pitch_us, sticks.throttle_us, sticks.yaw_us)):
            self._offer = sticks
        else:
            self._offer = None
            self.rejected += 1

    def step(self, state: State, reason: Reason, now_ns: int) -> GateOutput:
        """Send what the state and the leases allow at this stick period and return it."""
        self._begin(state, now_ns)
        effect = EFFECTS[state]
        if self._limits is None or effect in (Action.RELEASE, Action.SILENT):
            return self._let_go(state, reason, now_ns)
        verdict = self._judge(reason, now_ns) if effect is Action.STICKS else reason
        if isinstance(verdict, Sticks):
            return self._send(state, Action.STICKS, None, self._bounded(self._limits, verdict), now_ns)
        self._offer = None
        return self._send(state, Action.NEUTRAL, verdict, self._limits.neutral, now_ns)

    def release(self, state: State, reason: Reason, now_ns: int) -> GateOutput:
        """Let go now, whatever the state; called on the spot when the pilot takes over and on the way out."""
        self._start_release(now_ns)
        return self._let_go(state, reason, now_ns)

    def _begin(self, state: State, now_ns: int) -> None:
        """Forget what a change of state, a pause or a wrong stamp has made worthless."""
        self._pause_ns = now_ns - self._stepped_ns
        if state is not self._state or not 0 <= self._pause_ns <= LATE_NS:
            self._offer = None
        for lease, expires_ns in self._expiry.items():
            if expires_ns > now_ns + LONGEST_LEASE_NS:
                self.revoke(lease)
        self._state, self._stepped_ns = state, now_ns

    def _judge(self, reason: Reason, now_ns: int) -> Sticks | Reason:
        """Return the sticks that may pass, or why none may; without any offer that is the state's own reason."""
        lease = self.stale(now_ns)
        if lease is not None:
            return LEASE_REASONS[lease]
        if self._offer is None:
            return reason
        believed = now_ns < self._offer.expires_ns <= now_ns + LONGEST_LEASE_NS
        return self._offer if believed else Reason.COMMAND_INVALID

    def _let_go(self, state: State, reason: Reason, now_ns: int) -> GateOutput:
        """Release what was held, repeat a release that is still young, else say nothing."""
        if self._sent is not None:
            self._start_release(now_ns)
        self._sent = None
        self._offer = None
        if self._release_ns is None:
            return GateOutput(now_ns, state, Action.SILENT, reason)
        self._releases += 1
        if self._releases >= RELEASE_REPEATS and abs(now_ns - self._release_ns) >= RELEASE_REPEAT_S * S:
            self._release_ns = None
        return self._out(GateOutput(now_ns, state, Action.RELEASE, reason))

    def _start_release(self, now_ns: int) -> None:
        self._release_ns = now_ns
        self._releases = 0

    def _send(self, state: State, action: Action, reason: Reason | None, widths: Widths, now_ns: int) -> GateOutput:
        self._release_ns = None
        self._sent = widths
        return self._out(GateOutput(now_ns, state, action, reason, *widths))

    def _out(self, out: GateOutput) -> GateOutput:
        self._output(out)
        return out

    def _bounded(self, limits: StickLimits, offer: Sticks) -> Widths:
        wanted = (offer.roll_us, offer.pitch_us, offer.throttle_us, offer.yaw_us)
        had = self._sent or limits.neutral
        step_us = limits.slew_us_s * self._pause_ns / S
        roll, pitch, throttle, yaw = (
            _moved(limits.neutral[i], had[i], max(limits.minimum[i], min(limits.maximum[i], wanted[i])), step_us)
            for i in range(4)
        )
        return roll, pitch, throttle, yaw


def _moved(neutral: int, had: int, wanted: float, step_us: float) -> int:
    """Return where a stick goes: away from neutral by `step_us` at most, towards it as far as wanted."""
    away = round(wanted) - neutral
    same_side = (had - neutral) * away > 0
    reach = step_us + (abs(had - neutral) if same_side else 0)
    return neutral + (away if abs(away) <= reach else int(math.copysign(reach, away)))
