"""The fault matrix as a page: one row per fault and state, the worst over the seeds."""

from __future__ import annotations

from collections import Counter
from itertools import groupby

from morpheyes_daemon.experiments.fault_run import Row
from morpheyes_daemon.experiments.faults import FAULTS

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


def page(rows: list[Row], settings: str) -> str:
    """Return docs/faults.md for the rows of a run, sorted by fault and state."""
    passed = sum(row.passed for row in rows)
    faults = len({row.fault for row in rows})
    each = Counter((row.fault, row.state) for row in rows).values()
    seeds = f"{min(each)}" if min(each) == max(each) else f"{min(each)} to {max(each)}"
    return "\n".join(
        (
            "# Fault matrix",
            "",
            f"{faults} faults in {len(each)} rows, {len(rows)} flights ({seeds} seeds each), {passed} ended as the"
            f" table says ({passed / len(rows):.1%}), in the lockstep simulator (`morpheyes faults {settings}`).",
            "",
            "Class A: the daemon lives; from the fault to neutral sticks on the wire it may take 250 ms on top of what"
            " it takes to notice (*allowed* is the sum; for the pilot, 50 ms on top of his message's period). Class B:"
            " it is dead or cut off; the autopilot's time-out counts, and the vehicle must stop within what the"
            " governor had kept free at the moment of the fault. Times and distances are the worst over the seeds,"
            " counted from the fault, in ENGAGED, where there is something to stop. States and reasons: docs/safety.md.",
            "",
            _line(_HEAD),
            _line(("---",) * len(_HEAD)),
            *(_group(list(group)) for _, group in groupby(rows, key=lambda row: (row.fault, row.state))),
            "",
        )
    )


def _group(rows: list[Row]) -> str:
    first = rows[0]
    what = next(fault.what for fault in FAULTS if fault.name == first.fault)
    ended = ", ".join(dict.fromkeys(f"{row.ended} ({row.reason})" for row in rows if row.ended)) or "not started"
    released = first.ending == "released at once"
    times = [row.release_s if released else row.reaction_s for row in rows]
    known = [time for time in times if time is not None]
    stops = [
        row for row in rows if row.stop_m is not None and row.ending not in ("flies on", "neutral, then flies on")
    ]
    tightest = max(stops, key=lambda row: (row.stop_m or 0.0) - (row.reserved_m or 0.0), default=None)
    timed = bool(known) and first.kind == "A" and first.ending != "flies on"
    return _line(
        (
            f"{first.fault}: {what}" if first.state else first.fault,
            first.kind,
            first.state,
            first.ending,
            ended,
            f"{max(known):.2f} s" if timed else "",
            f"{first.allowed_s:.2f} s" if timed else "",
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
