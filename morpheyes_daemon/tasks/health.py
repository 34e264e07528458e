"""Ages, rates and lateness of everything, for the log, the page, the autopilot's log and systemd."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Protocol

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import MS, Clock, S, Ticker
from morpheyes_daemon.messages.safety import Health
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.supervisor.supervisor import Pulse

REPORT_HZ = 4.0

LISTEN_HZ = 40.0
"""How often the loop is listened to; a hold-up shorter than its period may be missed."""


class Restarts(Protocol):
    """Knows how often each task was restarted."""

    @property
    def restarts(self) -> dict[str, int]:
        """Restarts by task."""


@dataclass(slots=True)
class HealthTask:
    """Publishes a `Health` four times a second and hands it to `on_report` (the autopilot's log, systemd)."""

    supervisor: Restarts
    monitor: SafetyMonitor
    topics: Topics
    clock: Clock
    on_report: Callable[[Health], None]

    async def run(self, pulse: Pulse) -> None:
        """Report until cancelled."""
        ticker = Ticker(self.clock, LISTEN_HZ)
        counts = self._counts()
        worst_ms = 0.0
        before_ns = self.clock.now_ns()
        while True:
            late_ms = max([await ticker.wait() for _ in range(round(LISTEN_HZ / REPORT_HZ))]) / MS
            worst_ms = max(worst_ms, late_ms)
            now_ns = self.clock.now_ns()
            elapsed_s = max(1e-3, (now_ns - before_ns) / S)
            before_ns, before = now_ns, counts
            counts = self._counts()
            report = Health(
                t_ns=now_ns,
                state=self.monitor.state,
                reason=self.monitor.reason,
                missing=self.monitor.missing,
                ages_s={name: _age_s(getattr(self.topics, name).get(), now_ns) for name in counts},
                rates_hz={name: (count - before[name]) / elapsed_s for name, count in counts.items()},
                restarts=self.supervisor.restarts,
                lateness_ms=late_ms,
                worst_lateness_ms=worst_ms,
            )
            self.topics.health.publish(report)
            self.on_report(report)
            pulse.beat()

    def _counts(self) -> dict[str, int]:
        return {f.name: getattr(self.topics, f.name).count for f in fields(self.topics)}


def _age_s(value: object, now_ns: int) -> float:
    """Age of a message by its own stamp; NaN before the first."""
    stamp = getattr(value, "t_ns", None) or getattr(getattr(value, "summary", None), "t_ns", None)
    return (now_ns - stamp) / S if stamp else math.nan
