"""The fault matrix as a page: one row per fault and state, the worst over the seeds."""

from __future__ import annotations

from morpheyes_daemon.fault_injection.expectations import Fault, FaultOutcome
from morpheyes_daemon.fault_injection.matrix import FAULTS
from morpheyes_daemon.fault_injection.runner import STATES, Row
from morpheyes_daemon.messages.safety import State

_HEAD = (
    "fault",
    "class",
    "state",
    "must end",
    "ended (reason)",
    "neutral after",
    "allowed",
    "stopped in / reserved",
    "",
)


def page(rows: list[Row], settings: str, faults: tuple[Fault, ...] = FAULTS) -> str:
    """Return docs/faults.md: every row of the matrix, with what was measured where it has been flown."""
    passed = sum(row.passed for row in rows)
    places = [(fault, state) for fault in faults for state in STATES if state in fault.endings]
    flown = {
        (fault.name, state): [r for r in rows if (r.fault, r.state) == (fault.name, state)] for fault, state in places
    }
    each = [len(group) for group in flown.values()]
    seeds = f"{min(each)}" if min(each) == max(each) else f"{min(each)} to {max(each)}"
    return "\n".join(
        (
            "# Fault matrix",
            "",
            f"{len(faults)} faults in {len(places)} rows, {len(rows)} flights ({seeds} seeds each), {passed} ended as"
            f" the table says ({passed / len(rows):.1%}), in the lockstep simulator (`morpheyes faults {settings}`).",
            "",
            "Class A: the daemon lives; from the fault to neutral sticks on the wire it may take 250 ms on top of what"
            " it takes to notice (*allowed* is the sum; for the pilot, 50 ms on top of his message's period). Class B:"
            " it is dead or cut off; the autopilot's time-out counts, and the vehicle must stop within what the"
            " governor had kept free at the moment of the fault. Times and distances are the worst over the seeds,"
            " counted from the fault, in ENGAGED, where there is something to stop. Touching anything fails a row while"
            " the autopilot is in Loiter. States and reasons: docs/safety.md.",
            "",
            _line(_HEAD),
            _line(("---",) * len(_HEAD)),
            *(_group(fault, state, flown[fault.name, state]) for fault, state in places),
            "",
        )
    )


def _group(fault: Fault, state: State, rows: list[Row]) -> str:
    ending = fault.endings[state]
    named = f"{fault.name}: {fault.what}", fault.kind, state, ending
    if not rows:
        return _line((*named, "", "", "", "", "not flown"))
    ended = ", ".join(dict.fromkeys(f"{row.ended} ({row.reason})" for row in rows if row.ended)) or "not started"
    released = ending is FaultOutcome.RELEASES
    times = [row.release_s if released else row.reaction_s for row in rows]
    known = [time for time in times if time is not None]
    stops = [row for row in rows if row.stop_m is not None and ending not in (FaultOutcome.FLIES, FaultOutcome.RESUMES)]
    tightest = max(stops, key=lambda row: (row.stop_m or 0.0) - (row.reserved_m or 0.0), default=None)
    timed = bool(known) and fault.kind == "A" and ending not in (FaultOutcome.FLIES, FaultOutcome.HOLDS_IF_IT_MATTERS)
    return _line(
        (
            *named,
            ended,
            f"{max(known):.2f} s" if timed else "",
            f"{rows[0].allowed_s:.2f} s" if timed else "",
            _stop(tightest),
            "; ".join(dict.fromkeys(text for row in rows for text in row.complaints)) or "ok",
        )
    )


def _stop(row: Row | None) -> str:
    if row is None or row.stop_m is None:
        return ""
    reserved = "" if row.reserved_m is None else f" / {row.reserved_m:.1f}"
    return f"{row.stop_m:.1f}{reserved} m"


def _line(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"
