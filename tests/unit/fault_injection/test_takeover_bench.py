"""The bench of take-overs times from the autopilot's own word that the pilot has acted, and from nobody else's."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.fault_injection.takeover_latency import tells_of_the_pilot
from morpheyes_daemon.safety.monitor import LOITER

CHANNEL = 7


def heartbeat(custom_mode: int) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, 3, 81, custom_mode, 4, 3)


def rc_channels(width_us: int) -> mavlink.MAVLink_message:
    widths = [1500] * 18
    widths[CHANNEL - 1] = width_us
    return mavlink.MAVLink_rc_channels_message(0, 16, *widths, 200)


@pytest.mark.parametrize(
    ("message", "sender", "told"),
    [
        (heartbeat(2), (1, 1), True),
        (heartbeat(LOITER), (1, 1), False),
        (heartbeat(0), (255, 190), False),
        (rc_channels(1000), (1, 1), True),
        (rc_channels(2000), (1, 1), False),
        (rc_channels(1000), (42, 1), False),
    ],
)
def test_only_the_autopilot_tells_of_the_pilot(
    message: mavlink.MAVLink_message, sender: tuple[int, int], told: bool
) -> None:
    frame = bytes(message.pack(mavlink.MAVLink(None, *sender)))
    assert tells_of_the_pilot(frame, CHANNEL) is told
