"""What a row of the fault matrix is, how a fault may end, and the rule for each ending. The rows are in `faults`.

Class A: the daemon lives and must act within 250 ms of noticing. Class B: it is dead or cut off, the autopilot's own
time-out acts, and the vehicle must stop within what the governor had kept free.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

from morpheyes_daemon.fault_injection import faults as actions
from morpheyes_daemon.fault_injection.harness import Measured, Sent
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.states import HOLDING

REACTION_S = 0.25
"""From noticing to neutral sticks on the wire."""

RELEASE_S = 0.05
"""From the pilot's message to the release."""

SETTLED_S = {State.PREFLIGHT: 4.2, State.STANDBY: 2.2, State.HOLD: 2.8, State.BRAKING: 4.2}
"""How long it takes to see the end of a fault that was noticed: on the ground the daemon starts, an autopilot restarts
in two seconds, out of HOLD neutral lasts two seconds before the release, and braking ends after four."""

STILL_S = 0.1
"""A stream whose last message is older than this has ended."""


class FaultOutcome(StrEnum):
    """How a fault in a state must end; `complaints` checks each."""

    FLIES = "flies on"
    FLIES_WITH_PAUSES = "flies on, neutral whenever too much is missing"
    RESUMES = "neutral, then flies on"
    HOLDS = "neutral until the pilot acts"
    HOLDS_IF_IT_MATTERS = "flies on, or neutral until the pilot acts"
    RELEASES = "released at once"
    LETS_GO = "neutral, then released"
    READY = "stays ready, sends nothing"
    UNREADY = "is not ready, sends nothing"
    STOPS = "the autopilot stops it"
    REFUSES = "the daemon does not start"


@dataclass(frozen=True, slots=True)
class Fault:
    """One row: `begin` breaks something, `end` mends it after `lasts_s`. `notice_s` is the declared detection time.

    `watch_s` is how long to look on; what is not ENGAGED `settles` sooner. `falls`: the motors stop, so
    that hitting something says nothing. `rig_seed` flies another rig than the one that was calibrated, None the
    calibration missing; `without_gps` flies on optical flow.
    """

    name: str
    what: str
    notice_s: float
    endings: Mapping[State, FaultOutcome]
    begin: actions.Act = lambda flight: None
    end: actions.Act = lambda flight: None
    lasts_s: float | None = None
    watch_s: float = 7.0
    settles: bool = True
    falls: bool = False
    rig_seed: int | None = 0
    without_gps: bool = False

    def watched_s(self, state: State) -> float:
        """How long to look on: less where nothing moves that would have to stop."""
        if state is State.ENGAGED or not self.settles:
            return self.watch_s
        return min(self.watch_s, self.notice_s + (self.lasts_s or 0.0) + SETTLED_S[state])

    @property
    def kind(self) -> str:
        """A: the daemon lives. B: it is dead or cut off."""
        return "B" if FaultOutcome.STOPS in self.endings.values() else "A"


NOT_OURS = (FaultOutcome.RELEASES, FaultOutcome.READY, FaultOutcome.UNREADY)
"""The pilot flies, so what is hit is hit by him; that we sent nothing is asked of each."""


def complaints(fault: Fault, state: State, seen: Measured) -> list[str]:
    """Return what did not end as the table says; empty when all did."""
    ending = fault.endings[state]
    found = list(_RULES[ending](fault, state, seen))
    ours = not fault.falls and ending not in NOT_OURS
    if seen.clearance_m < 0.0 and ours:
        found.append(f"hit an obstacle ({seen.clearance_m:.2f} m)")
    return found


Complaints = Iterator[str]
_Rule = Callable[[Fault, State, Measured], Complaints]


def _expect(holds: bool, complaint: str) -> Complaints:
    if not holds:
        yield complaint


def _in(seen: Measured, *states: State) -> Complaints:
    yield from _expect(seen.state in states, f"ended in {seen.state} ({seen.reason})")


def _reacted(fault: Fault, state: State, after_s: float | None) -> Complaints:
    """Neutral in time; where the sticks were neutral already, they stay so."""
    limit_s = fault.notice_s + REACTION_S
    if state is State.ENGAGED:
        in_time = after_s is not None and after_s <= limit_s
        yield from _expect(in_time, f"neutral after {after_s} s, allowed {limit_s:.2f} s")


def _silent(seen: Measured) -> Complaints:
    yield from _expect(seen.neutrals == 0 and seen.last in (None, Sent.RELEASE), "moved sticks that are not ours")


def _flies(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _in(seen, State.ENGAGED)
    yield from _expect(seen.last is Sent.STICKS, "does not fly")
    yield from _expect(not seen.left, "did not stay engaged")


def _flies_with_pauses(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _in(seen, State.ENGAGED, State.BRAKING)


def _resumes(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _reacted(fault, state, seen.reaction_s)
    yield from _in(seen, State.ENGAGED)
    yield from _expect(seen.sticks_after > 0, "never flew on")


def _holds(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _reacted(fault, state, seen.quiet_s)
    yield from _in(seen, State.HOLD)
    still = seen.last is Sent.NEUTRAL and seen.last_s is not None and seen.last_s > fault.watched_s(state) - STILL_S
    yield from _expect(still, "does not hold the sticks neutral")
    yield from _expect(seen.stopped, "still moves")


def _holds_if_it_matters(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _in(seen, State.ENGAGED, State.BRAKING, State.HOLD)


def _releases(fault: Fault, state: State, seen: Measured) -> Complaints:
    limit_s = fault.notice_s + RELEASE_S
    yield from _expect(seen.state not in HOLDING, f"ended in {seen.state} ({seen.reason})")
    in_time = seen.release_s is not None and seen.release_s <= limit_s
    yield from _expect(in_time, f"released after {seen.release_s} s, allowed {limit_s:.2f} s")
    yield from _gone(fault, state, seen)


def _gone(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _expect(seen.last is Sent.RELEASE, f"the last message was {seen.last}")
    yield from _flown_out(fault, state, seen)


def _flown_out(fault: Fault, state: State, seen: Measured) -> Complaints:
    """Once neutral, no stick again; but a flight that comes out of BRAKING may fly on until it has noticed."""
    if state is not State.BRAKING:
        yield from _expect(seen.sticks_after == 0, "sticks afterwards")
        return
    limit_s = math.inf if fault.kind == "B" else fault.notice_s + REACTION_S
    in_time = seen.quiet_s is None or seen.quiet_s <= limit_s
    yield from _expect(seen.last is not Sent.STICKS and in_time, f"sticks for {seen.quiet_s} s, allowed {limit_s:.2f} s")


def _lets_go(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _reacted(fault, state, seen.quiet_s)
    yield from _in(seen, State.PILOT, State.RELEASED)
    yield from _expect(seen.neutrals > 0, "no neutral before the release")
    yield from _gone(fault, state, seen)


def _ready(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _in(seen, State.STANDBY)
    yield from _silent(seen)


def _unready(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _expect(seen.state not in (State.STANDBY, State.ENGAGED), f"is ready ({seen.state})")
    yield from _silent(seen)


def _stops(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield from _expect(seen.stopped, "still moves")
    yield from _expect(seen.stop_m <= seen.reserved_m, f"stopped after {seen.stop_m:.2f} m of {seen.reserved_m:.2f} m")
    yield from _flown_out(fault, state, seen)


def _refuses(fault: Fault, state: State, seen: Measured) -> Complaints:
    yield "the daemon started"


_RULES: dict[FaultOutcome, _Rule] = {
    FaultOutcome.FLIES: _flies,
    FaultOutcome.FLIES_WITH_PAUSES: _flies_with_pauses,
    FaultOutcome.RESUMES: _resumes,
    FaultOutcome.HOLDS: _holds,
    FaultOutcome.HOLDS_IF_IT_MATTERS: _holds_if_it_matters,
    FaultOutcome.RELEASES: _releases,
    FaultOutcome.LETS_GO: _lets_go,
    FaultOutcome.READY: _ready,
    FaultOutcome.UNREADY: _unready,
    FaultOutcome.STOPS: _stops,
    FaultOutcome.REFUSES: _refuses,
}
