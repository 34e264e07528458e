"""Ages, rates and lateness of everything, for the log, the page, the autopilot's log and systemd."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import MS, Clock, S, Ticker
from morpheyes_daemon.messages.safety import Health
from morpheyes_daemon.safety.monitor import SafetyMonitor
from morpheyes_daemon.supervisor.supervisor import Pulse, Supervisor

REPORT_HZ = 4.0

LISTEN_HZ = 40.0
"""How often the loop is listened to; a hold-up shorter than its period may be missed."""


async def health(
    supervisor: Supervisor,
    monitor: SafetyMonitor,
    topics: Topics,
    clock: Clock,
    tell: Callable[[Health], None],
    pulse: Pulse,
) -> None:
    """Publish a `Health` four times a second and hand it to `tell` (the autopilot's log and systemd)."""
    ticker = Ticker(clock, LISTEN_HZ)
    counts = dict.fromkeys((f.name for f in fields(topics)), 0)
    worst_ms = 0.0
    before_ns = clock.now_ns()
    while True:
        late_ms = max([await ticker.wait() for _ in range(round(LISTEN_HZ / REPORT_HZ))]) / MS
        worst_ms = max(worst_ms, late_ms)
        now_ns = clock.now_ns()
        elapsed_s = max(1e-3, (now_ns - before_ns) / S)
        rates = {name: (getattr(topics, name).count - count) / elapsed_s for name, count in counts.items()}
        counts = {name: getattr(topics, name).count for name in counts}
        before_ns = now_ns
        report = Health(
            t_ns=now_ns,
            state=monitor.state,
            reason=monitor.reason,
            missing=monitor.missing,
            ages_s={name: _age_s(getattr(topics, name).get(), now_ns) for name in counts},
            rates_hz=rates,
            restarts={task.name: task.restarts for task in supervisor.tasks},
            lateness_ms=late_ms,
            worst_lateness_ms=worst_ms,
        )
        topics.health.publish(report)
        tell(report)
        pulse.beat()


def _age_s(value: object, now_ns: int) -> float:
    """Age of a message by its own stamp; NaN before the first."""
    stamp = getattr(value, "t_ns", None) or getattr(getattr(value, "summary", None), "t_ns", None)
    return (now_ns - stamp) / S if stamp else math.nan
