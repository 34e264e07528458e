"""What systemd hears of the daemon: ready, its state and reason, and the watchdog's ping while the chain is fresh.

The ping is withheld when the stick period stands still, or when the daemon calls itself ENGAGED on stale inputs: then
its own logic no longer works and only a restart helps. A missing camera or autopilot is no reason for a restart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Protocol

from morpheyes_daemon.reasons import Reason
from morpheyes_daemon.safety.states import State
from morpheyes_daemon.supervisor.sd_notify import notify

STALE_S = 2.0
"""Longer than any lease: the guardian should have reacted long before."""
STICKS = ("gate",)
INPUTS = ("frame", "perception", "command", "vehicle")


class Report(Protocol):
    """The part of `tasks.health.Health` that systemd is told of."""

    @property
    def state(self) -> State: ...

    @property
    def reason(self) -> Reason: ...

    @property
    def missing(self) -> Reason | None: ...

    @property
    def ages_s(self) -> Mapping[str, float]: ...


class ServiceManager:
    """Call `tell` with every health report and `stopping` before the end."""

    def __init__(self, send: Callable[[str], object] = notify) -> None:
        self._send = send
        self._ready = False
        self._status = ""

    def tell(self, report: Report) -> None:
        """Send what is new of `report`, and the ping if it is deserved."""
        lines = [] if self._ready else ["READY=1"]
        self._ready = True
        status = _status(report)
        if status != self._status:
            self._status = status
            lines.append(f"STATUS={status}")
        if chain_is_fresh(report):
            lines.append("WATCHDOG=1")
        if lines:
            self._send("\n".join(lines))

    def stopping(self) -> None:
        """Say that the daemon is on its way out."""
        self._send("STOPPING=1\nSTATUS=stopping: neutral, then release")


def chain_is_fresh(report: Report) -> bool:
    """Whether everything that must turn in this state does turn."""
    needed = (*STICKS, *INPUTS) if report.state is State.ENGAGED else STICKS
    return all(_fresh(report.ages_s.get(name, math.nan)) for name in needed)


def _fresh(age_s: float) -> bool:
    return age_s < STALE_S  # false for NaN: never heard


def _status(report: Report) -> str:
    missing = report.missing if report.state is State.PREFLIGHT else None
    return f"{report.state}: {(missing or report.reason).text}"
