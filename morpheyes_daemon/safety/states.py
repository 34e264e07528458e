"""The states of the daemon and every way between them, as one table.

The diagram in docs/safety.md is generated from this table. A state says what the gate may at most let out; the
gate itself (`gate.py`) is stricter still when a lease has run out.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, State


class Trigger(StrEnum):
    """What can happen to the daemon; `CAUSE` says when each is fired."""

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
    STOP_REQUESTED = "stop_requested"
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
"""The most that each state lets out. Who held no stick releases none; a release is repeated, then silence."""

HOLDING = tuple(state for state, effect in EFFECTS.items() if effect in (Action.STICKS, Action.NEUTRAL))
"""The states in which the sticks are ours."""

MEANING: dict[State, str] = {
    State.BOOT: "starting; nothing is sent",
    State.PREFLIGHT: "something needed is missing; nothing is sent",
    State.STANDBY: "ready; waits for the pilot's switch, armed, flying and in Loiter",
    State.ENGAGED: "the mission flies",
    State.BRAKING: "neutral sticks; resumes only if an input of our own returns in time and nothing else happened",
    State.HOLD: "neutral sticks at a standstill; waits for the pilot",
    State.PILOT: "the pilot (or a failsafe) took over in flight; released until the switch has been seen off",
    State.RELEASED: "let go; waits until the switch has been seen off",
    State.FAULT: "a fault outside flight; nothing is sent until it is mended",
}

CAUSE: dict[Trigger, str] = {
    Trigger.BOOTED: "every task has been started",
    Trigger.READY: "nothing needed is missing",
    Trigger.NOT_READY: "something needed is missing",
    Trigger.ENGAGE: "the switch went from off to on, both steadily, with the vehicle armed, flying, in Loiter",
    Trigger.SWITCH_OFF: "the switch is heard off",
    Trigger.MODE_LEFT: "a heartbeat says another mode than Loiter",
    Trigger.DISARMED: "a heartbeat says disarmed",
    Trigger.FOUND_FLYING: "armed and in the air before the daemon has ever heard the vehicle disarmed",
    Trigger.STALE: "a lease has run out",
    Trigger.FRESH: "every lease is fresh again, soon enough, and the reason allows it",
    Trigger.FAULT: "a part failed, the autopilot reports trouble, or a clock or loop was late",
    Trigger.CLEARED: "the last part that had failed works again",
    Trigger.MISSION_OVER: "the mission is done, or refuses",
    Trigger.STOP_REQUESTED: "somebody pressed STOP on the page",
    Trigger.STOPPED: "at rest, or the time for braking is over",
    Trigger.LET_GO: "neutral for long enough on the way out, or the autopilot is no longer heard",
    Trigger.SHUTDOWN: "the daemon was asked to stop",
}

_T, _S = Trigger, State

TRANSITIONS: dict[tuple[State, Trigger], State] = {
    (_S.BOOT, _T.BOOTED): _S.PREFLIGHT,
    (_S.PREFLIGHT, _T.READY): _S.STANDBY,
    (_S.PREFLIGHT, _T.NOT_READY): _S.PREFLIGHT,
    (_S.STANDBY, _T.NOT_READY): _S.PREFLIGHT,
    (_S.STANDBY, _T.ENGAGE): _S.ENGAGED,
    (_S.ENGAGED, _T.STALE): _S.BRAKING,
    (_S.ENGAGED, _T.FAULT): _S.BRAKING,
    (_S.ENGAGED, _T.MISSION_OVER): _S.BRAKING,
    (_S.ENGAGED, _T.STOP_REQUESTED): _S.BRAKING,
    (_S.BRAKING, _T.STALE): _S.BRAKING,
    (_S.BRAKING, _T.FAULT): _S.BRAKING,
    (_S.BRAKING, _T.MISSION_OVER): _S.BRAKING,
    (_S.BRAKING, _T.STOP_REQUESTED): _S.BRAKING,
    (_S.BRAKING, _T.FRESH): _S.ENGAGED,
    (_S.BRAKING, _T.STOPPED): _S.HOLD,
    **{(state, _T.SWITCH_OFF): _S.RELEASED for state in HOLDING},
    **{(state, _T.DISARMED): _S.RELEASED for state in HOLDING},
    **{(state, _T.MODE_LEFT): _S.PILOT for state in HOLDING},
    **{(state, _T.LET_GO): _S.RELEASED for state in HOLDING},
    **{(state, _T.SHUTDOWN): _S.BRAKING for state in HOLDING},
    (_S.PILOT, _T.SWITCH_OFF): _S.PREFLIGHT,
    (_S.RELEASED, _T.SWITCH_OFF): _S.PREFLIGHT,
    **{(state, _T.FOUND_FLYING): _S.PILOT for state in (_S.BOOT, _S.PREFLIGHT, _S.STANDBY)},
    **{(state, _T.FAULT): _S.FAULT for state in (_S.BOOT, _S.PREFLIGHT, _S.STANDBY, _S.FAULT)},
    (_S.FAULT, _T.CLEARED): _S.PREFLIGHT,
    **{(state, _T.SHUTDOWN): _S.RELEASED for state in (_S.BOOT, _S.PREFLIGHT, _S.STANDBY, _S.PILOT, _S.FAULT)},
}
"""(state, trigger) -> next state; a pair that is not here changes nothing."""


@dataclass(frozen=True, slots=True)
class Transition:
    """One step of the machine; `before` and `after` are the same when only the reason changed."""

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
    """Return the table as a Mermaid state diagram; ways that only change the reason are left out."""
    arrows: dict[tuple[State, State], list[Trigger]] = {}
    for (before, trigger), after in TRANSITIONS.items():
        if after is not before:
            arrows.setdefault((before, after), []).append(trigger)
    lines = ["stateDiagram-v2", f"    [*] --> {State.BOOT}"]
    lines += [f"    {before} --> {after}: {', '.join(triggers)}" for (before, after), triggers in arrows.items()]
    return "\n".join(lines)
