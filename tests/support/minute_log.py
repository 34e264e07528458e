"""A small flight log of a minute, written as the recorder writes it: a chunk a second, all kinds of channels."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import BaselineEstimate, Event, Sticks, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.recorder.channels import entries
from morpheyes_daemon.recorder.flight_log import FlightLog

HEADER = {"mission": "forest", "config": '{"mission": "forest"}'}
SECONDS = 60


@cache
def minute_log() -> bytes:
    """Return the bytes of the log."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        log = FlightLog(path, HEADER)
        for second in range(1, SECONDS + 1):
            for tenth in (0, 5):
                add_messages(log, second * S + tenth * S // 10)
            add(log, "events", Event(second * S, "test", Reason.RECOVERED, f"second {second}"))
            log.sync(durable=False)
        log.close()
        return path.read_bytes()


def add_messages(log: FlightLog, t_ns: int) -> None:
    """Add one message of three topics."""
    s = t_ns / S
    add(log, "sticks", Sticks(t_ns, t_ns + S // 5, 1500, round(1500 - 90 * math.sin(s)), 1500, 1510))
    add(log, "baseline", BaselineEstimate(t_ns, 0.2, 0.2 + 0.01 * math.sin(s), 0.0015, True))
    position = (s, math.sin(s / 7), -1.5)
    add(log, "vehicle", VehicleState(t_ns=t_ns, yaw_rad=math.sin(s), position_t_ns=t_ns, p_ned_m=position))


def add(log: FlightLog, topic: str, value: object) -> None:
    """Add what a value leaves in the log."""
    t_ns = value.t_ns  # type: ignore[attr-defined]
    for entry in entries(topic, t_ns, value, images=False):
        log.add(entry, t_ns, t_ns)
