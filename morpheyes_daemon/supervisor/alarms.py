"""Which events of devices and image checks end a flight, and what a servo in trouble keeps the daemon from."""

from __future__ import annotations

from morpheyes_daemon.control.baseline import BaselineModel
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.safety.monitor import SafetyMonitor

ALARMS = frozenset(
    {
        Reason.OVERRIDE_IGNORED,
        Reason.AUTOPILOT_REBOOTED,
        Reason.BASELINE_STALE,
        Reason.SERVO_LOST,
        Reason.WORKER_LOST,
        Reason.EYES_APART,
        Reason.DEPTH_SCALE,
    }
)
"""Events that end a flight in HOLD, though the part that reported may work again a moment later."""


class Alarms:
    """Hands events to the safety monitor; subscribe `on_event` to the event log.

    `baseline` is the servo's model, None for a rig that does not move.
    """

    def __init__(self, monitor: SafetyMonitor, baseline: BaselineModel | None) -> None:
        self._monitor = monitor
        self._baseline = baseline

    def on_event(self, event: Event) -> None:
        """Raise the alarm for an event that calls for one; the safety monitor's own transitions do not."""
        if event.source == "monitor":
            return
        if event.reason in ALARMS:
            self._monitor.alarm(event.reason, event.t_ns)
        if event.source == "servo":
            self._on_servo_event(event)

    def on_baseline_known(self, known: bool) -> None:
        """Until the baseline is known neither depth nor the image checks mean anything, and nobody may engage."""
        self._monitor.set_missing(None if known else Reason.BASELINE_UNKNOWN, "baseline")

    def _on_servo_event(self, event: Event) -> None:
        """Until the Teensy answers again the cameras may be anywhere between two targets, and nobody may engage."""
        lost = event.reason in ALARMS
        self._monitor.set_missing(event.reason if lost else None, "servo")
        if lost and self._baseline is not None:
            self._baseline.on_unconfirmed(self._baseline.at(event.t_ns).target_m, event.t_ns)
