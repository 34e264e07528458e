"""What the safety monitor and the gate tell: state, action, gate output, health."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from morpheyes_daemon.messages.reasons import Reason


class State(StrEnum):
    """Where the daemon is; `EFFECTS` says what each lets out and `MEANING` what it is."""

    BOOT = "boot"
    PREFLIGHT = "preflight"
    STANDBY = "standby"
    ENGAGED = "engaged"
    BRAKING = "braking"
    HOLD = "hold"
    PILOT = "pilot"
    RELEASED = "released"
    FAULT = "fault"


class Action(StrEnum):
    """What the gate sends at one stick period."""

    SILENT = "silent"
    STICKS = "sticks"
    NEUTRAL = "neutral"
    RELEASE = "release"


Widths = tuple[int, int, int, int]
"""Roll, pitch, throttle, yaw in microseconds."""

NARROWEST_US, WIDEST_US = 800, 2200
"""Range of RCn_MIN and RCn_MAX, and of every valid pulse width.

0 means an absent channel or a release, 65534 and 65535 mean other things than a width (MAVLink RC_CHANNELS,
RC_CHANNELS_OVERRIDE). Source: data sheet, ArduPilot parameter list, RCn_MIN and RCn_MAX.
"""


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
    def widths_us(self) -> Widths:
        """Roll, pitch, throttle, yaw."""
        return self.roll_us, self.pitch_us, self.throttle_us, self.yaw_us


@dataclass(frozen=True, slots=True)
class Health:
    """`ages_s` since each topic's newest message, `rates_hz` since the last report, `restarts` per task.

    `lateness_ms` is the longest that the loop was held up since the last report.
    """

    t_ns: int
    state: State
    reason: Reason
    missing: Reason | None
    ages_s: dict[str, float]
    rates_hz: dict[str, float]
    restarts: dict[str, int]
    lateness_ms: float
    worst_lateness_ms: float
