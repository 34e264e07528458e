"""Which messages we need how often. ArduPilot streams nothing unasked but heartbeats and texts.

SET_MESSAGE_INTERVAL is met per link and forgotten on reboot; the connection asks again after either.
"""

from __future__ import annotations

from dataclasses import dataclass

from morpheyes_daemon.devices.autopilot.commands import CommandClient
from morpheyes_daemon.errors import DeviceError, DeviceTimeoutError
from morpheyes_daemon.wire.mavlink import dialect


@dataclass(frozen=True, slots=True)
class Stream:
    """A message, its rate, and whether its absence on a live link means that the rates were forgotten."""

    number: int
    rate_hz: float
    always: bool = False


STREAMS = (
    Stream(dialect.MAVLINK_MSG_ID_HEARTBEAT, 10.0),
    Stream(dialect.MAVLINK_MSG_ID_ATTITUDE, 50.0, always=True),
    Stream(dialect.MAVLINK_MSG_ID_RC_CHANNELS, 20.0, always=True),
    Stream(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50.0),
    Stream(dialect.MAVLINK_MSG_ID_DISTANCE_SENSOR, 20.0),
    Stream(dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT, 5.0),
    Stream(dialect.MAVLINK_MSG_ID_SYS_STATUS, 10.0),
    Stream(dialect.MAVLINK_MSG_ID_GPS_RAW_INT, 5.0),
    Stream(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2.0),
)


async def request_streams(commands: CommandClient) -> list[str]:
    """Ask for every stream and return what was refused; raises DeviceTimeoutError when nobody answers."""
    refused = []
    for stream in STREAMS:
        try:
            await commands.send(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, float(stream.number), round(1e6 / stream.rate_hz))
        except DeviceTimeoutError:
            raise
        except DeviceError as error:
            refused.append(f"{dialect.mavlink_map[stream.number].msgname}: {error}")
    return refused
