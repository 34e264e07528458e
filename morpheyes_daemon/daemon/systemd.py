"""What systemd is told: READY, STATUS at every change, WATCHDOG while the chain turns."""

from __future__ import annotations

from collections.abc import Callable

from morpheyes_daemon.daemon.sd_notify import notify
from morpheyes_daemon.messages.safety import Health

STICKS_SILENT_S = 1.0
"""The stick task steps fifty times a second, whatever the state."""


CAMERA_ALIVE_S = 2.0


VISION_SILENT_S = 30.0
"""Longer than it takes to kill a hung vision worker and to start another; killing the daemon for it mends nothing."""


class SystemdReport:
    """READY once, STATUS at every change, WATCHDOG while the chain turns."""

    def __init__(self, send: Callable[[str], bool] = notify) -> None:
        self._send = send
        self._status = ""

    def tell(self, report: Health) -> None:
        """Take a health report, four times a second."""
        status = f"STATUS={report.state}: {report.reason.text}"
        words = [] if self._status else ["READY=1"]
        if status != self._status:
            self._status = status
            words.append(status)
        if chain_turns(report):
            words.append("WATCHDOG=1")
        if words:
            self._send("\n".join(words))


def chain_turns(report: Health) -> bool:
    """Whether what only a restart could mend still works: sticks step, and a living camera leads to depth.

    A device that is away and a vision worker that is being replaced are no reason to be killed, in flight least.
    """
    ages = report.ages_s
    if not ages["gate"] <= STICKS_SILENT_S:
        return False
    camera_lives = ages["frame"] <= CAMERA_ALIVE_S
    return not (camera_lives and ages["perception"] > VISION_SILENT_S)
