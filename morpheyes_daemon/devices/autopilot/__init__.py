"""Autopilot backends: each owns the link to one kind of autopilot."""

from __future__ import annotations

from typing import TYPE_CHECKING

from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.devices.family import DeviceContext, Family

if TYPE_CHECKING:
    from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection

AUTOPILOTS = Family("autopilot", {"mavlink": "morpheyes_daemon.devices.autopilot.connection:AutopilotConnection"})


def build_connection(config: AutopilotConfig, context: DeviceContext) -> AutopilotConnection:
    """Return the configured backend, nothing open yet; raises ConfigError."""
    connection: AutopilotConnection = AUTOPILOTS.build(config, context)
    return connection
