"""The states of the daemon and every way between them, as one table.

The diagram in docs/safety.md is generated from this table. A state says what the gate may at most let out; the
gate itself (`gate.py`) is stricter still when a lease has run out.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from morpheyes_daemon.reasons import Reason


class State(StrEnum):
    """Where the daemon is; `effect` of each stands in `EFFECTS`."""

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


class Trigger(StrEnum):
    """What can happen to the daemon."""

    BOOTED = "booted"
    READY = "ready"
    NOT_READY = "not_ready"
    ENGAGE = "engage"
    SWITCH_OFF = "switch_off"
    MODE_LEFT = "mode_left"
    DISARMED = "disarmed"
    FOUND_FLYING = "found_flying"
    STALE = "stale"
    FRESH = "fresh"
    FAULT = "fault"
    CLEARED = "cleared"
    MISSION_OVER = "mission_over"
    STOPPED = "stopped"
    LET_GO = "let_go"
    SHUTDOWN = "shutdown"


EFFECTS: dict[State, Action] = {
    State.BOOT: Action.SILENT,
    State.PREFLIGHT: Action.SILENT,
    State.STANDBY: Action.SILENT,
    State.ENGAGED: Action.STICKS,
    State.BRAKING: Action.NEUTRAL,
    State.HOLD: Action.NEUTRAL,
    State.PILOT: Action.RELEASE,
    State.RELEASED: Action.RELEASE,
    State.FAULT: Action.SILENT,
}
"""The most that each state lets out. The gate repeats a release for a while, then falls silent."""

MEANING: dict[State, str] = {
    State.BOOT: "starting; nothing is sent",
    State.PREFLIGHT: "something needed is missing; nothing is sent",
    State.STANDBY: "ready; waits for the pilot's switch, armed and in Loiter",
    State.ENGAGED: "the mission flies",
    State.BRAKING: "neutral sticks; resumes only if the missing input returns before the vehicle has stopped",
    State.HOLD: "neutral sticks at a standstill; waits for the pilot",
    State.PILOT: "the pilot took over in flight; released until the switch has been seen off",
    State.RELEASED: "released on purpose",
    State.FAULT: "a fault outside flight; nothing is sent until it is mended",
}

_T, _S = Trigger, State
_HOLDING = (_S.ENGAGED, _S.BRAKING, _S.HOLD)

TRANSITIONS: dict[tuple[State, Trigger], State] = {
    (_S.BOOT, _T.BOOTED): _S.PREFLIGHT,
    (_S.BOOT, _T.FOUND_FLYING): _S.PILOT,
    (_S.BOOT, _T.FAULT): _S.FAULT,
    (_S.BOOT, _T.SHUTDOWN): _S.RELEASED,
    (_S.PREFLIGHT, _T.READY): _S.STANDBY,
    (_S.PREFLIGHT, _T.FOUND_FLYING): _S.PILOT,
    (_S.PREFLIGHT, _T.FAULT): _S.FAULT,
    (_S.PREFLIGHT, _T.SHUTDOWN): _S.RELEASED,
    (_S.STANDBY, _T.NOT_READY): _S.PREFLIGHT,
    (_S.STANDBY, _T.ENGAGE): _S.ENGAGED,
    (_S.STANDBY, _T.FAULT): _S.FAULT,
    (_S.STANDBY, _T.SHUTDOWN): _S.RELEASED,
    (_S.ENGAGED, _T.STALE): _S.BRAKING,
    (_S.ENGAGED, _T.MISSION_OVER): _S.BRAKING,
    (_S.BRAKING, _T.FRESH): _S.ENGAGED,
    (_S.BRAKING, _T.STOPPED): _S.HOLD,
    (_S.BRAKING, _T.LET_GO): _S.RELEASED,
    (_S.HOLD, _T.LET_GO): _S.RELEASED,
    (_S.PILOT, _T.SWITCH_OFF): _S.PREFLIGHT,
    (_S.PILOT, _T.SHUTDOWN): _S.RELEASED,
    (_S.RELEASED, _T.SWITCH_OFF): _S.PREFLIGHT,
    (_S.FAULT, _T.CLEARED): _S.PREFLIGHT,
    (_S.FAULT, _T.SHUTDOWN): _S.RELEASED,
    **{(state, _T.SWITCH_OFF): _S.RELEASED for state in _HOLDING},
    **{(state, _T.DISARMED): _S.RELEASED for state in _HOLDING},
    **{(state, _T.MODE_LEFT): _S.PILOT for state in _HOLDING},
    **{(state, _T.FAULT): _S.BRAKING for state in (_S.ENGAGED, _S.BRAKING)},
    **{(state, _T.SHUTDOWN): _S.BRAKING for state in _HOLDING},
}
"""(state, trigger) -> next state; a pair that is not here changes nothing."""


@dataclass(frozen=True, slots=True)
class Transition:
    """One step of the machine."""

    t_ns: int
    before: State
    trigger: Trigger
    after: State
    reason: Reason


class Machine:
    """Holds the state; `handle` is the only way to change it."""

    def __init__(self) -> None:
        self.state = State.BOOT
        self.reason = Reason.STARTED
        self.since_ns = 0

    def handle(self, trigger: Trigger, reason: Reason, now_ns: int) -> Transition | None:
        """Apply a trigger; returns the transition, or None where the table has none or nothing would change."""
        after = TRANSITIONS.get((self.state, trigger))
        if after is None or (after is self.state and reason is self.reason):
            return None
        step = Transition(now_ns, self.state, trigger, after, reason)
        if after is not self.state:
            self.since_ns = now_ns
        self.state, self.reason = after, reason
        return step


def mermaid() -> str:
    """Return the table as a Mermaid state diagram."""
    lines = ["stateDiagram-v2", "    [*] --> boot"]
    lines += [f"    {before} --> {after}: {trigger}" for (before, trigger), after in TRANSITIONS.items()]
    return "\n".join(lines)
