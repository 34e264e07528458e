"""The one place that writes to the autopilot's port: who a message is from, and what may not be sent at all.

Three identities leave the daemon: overrides as the system id that the autopilot takes sticks from, status and
proximity as components of the vehicle. A heartbeat of a ground station's type is never sent, since it would hide
the loss of the real one; sticks leave through one function that is handed out once.
"""

from __future__ import annotations

from collections.abc import Callable

from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.devices.link import Link
from morpheyes_daemon.wire.mavlink import (
    ChannelOverride,
    Encoder,
    Identity,
    Message,
    Signing,
    dialect,
    override_message,
)

STICK_MESSAGES = frozenset({"RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL", "RADIO_RC_CHANNELS"})
"""Messages that move the sticks."""

RELAY_REFUSES = STICK_MESSAGES | {"HEARTBEAT", "TIMESYNC", "PING"}
"""What is never sent on for somebody else."""


def may_relay(message: Message) -> bool:
    """Return whether a message of mavsdk may go out; message rates are the connection's alone."""
    kind = message.get_type()
    if kind in ("COMMAND_LONG", "COMMAND_INT"):
        return bool(message.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL)
    return kind not in RELAY_REFUSES


class Transmitter:
    """Packs, numbers, signs and writes; without a link what is sent is lost, as on any radio."""

    def __init__(self, config: AutopilotConfig, signing: Signing | None) -> None:
        self.link: Link | None = None
        self.status = Identity(config.vehicle_sysid, config.status_compid)
        self.proximity = Identity(config.vehicle_sysid, config.proximity_compid)
        self._override = Identity(config.override_sysid, config.override_compid)
        self._target = config.vehicle_sysid
        self._encoder = Encoder(signing)
        self._claimed = False

    def send(self, message: Message, sender: Identity) -> None:
        """Send a message that moves no stick; raises ValueError for one that does."""
        if message.get_type() in STICK_MESSAGES:
            raise ValueError("sticks leave through the claimed stick output only")
        self._write(message, sender)

    def send_status(self, message: Message) -> None:
        """Send as the vehicle's status component."""
        self.send(message, self.status)

    def heartbeat(self) -> None:
        """Say that an onboard controller is here."""
        self.send_status(
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
            )
        )

    def claim_stick_output(self, note: Callable[[ChannelOverride], None]) -> Callable[[ChannelOverride], None]:
        """Return the function that sends sticks, calling `note` for each; raises RuntimeError the second time."""
        if self._claimed:
            raise RuntimeError("the stick output has been claimed: there is one gate")
        self._claimed = True

        def output(override: ChannelOverride) -> None:
            self._write(override_message(override, self._target), self._override)
            note(override)

        return output

    def _write(self, message: Message, sender: Identity) -> None:
        if self.link is not None:
            self.link.write(self._encoder.pack(message, sender))
