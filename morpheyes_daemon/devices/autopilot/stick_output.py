"""The gate's output on the radio's channels: the only place that knows which channel each stick is on.

It exists from the start. Until the autopilot's RCMAP parameters are known every output is a release, which needs no
channel map; the gate sends no sticks before that either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.safety import Action, GateOutput, Widths
from morpheyes_daemon.wire.mavlink import RELEASE, ChannelOverride

RCMAP = ("RCMAP_ROLL", "RCMAP_PITCH", "RCMAP_THROTTLE", "RCMAP_YAW")


@dataclass(frozen=True, slots=True)
class ChannelMap:
    """Radio channel (1 to 4) of roll, pitch, throttle and yaw."""

    numbers: Widths

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, float]) -> ChannelMap:
        """Read RCMAP_*; raises DeviceError when one is missing or the sticks are not on channels 1 to 4."""
        missing = [name for name in RCMAP if name not in parameters]
        if missing:
            raise DeviceError(f"The autopilot has no parameter {missing[0]}: check that it runs ArduCopter.")
        roll, pitch, throttle, yaw = (round(parameters[name]) for name in RCMAP)
        if sorted((roll, pitch, throttle, yaw)) != [1, 2, 3, 4]:
            raise DeviceError(
                f"The four sticks must be on channels 1 to 4, but they are on {roll, pitch, throttle, yaw}."
            )
        return cls((roll, pitch, throttle, yaw))

    def override(self, sticks_us: Widths) -> ChannelOverride:
        """Return roll, pitch, throttle, yaw in the order of channels 1 to 4."""
        by_channel = dict(zip(self.numbers, sticks_us, strict=True))
        return ChannelOverride((by_channel[1], by_channel[2], by_channel[3], by_channel[4]))


class StickOutput:
    """Turns what the gate lets out into RC_CHANNELS_OVERRIDE; `send` is the connection's claimed stick output."""

    def __init__(self, send: Callable[[ChannelOverride], None]) -> None:
        self._send = send
        self._map: ChannelMap | None = None

    def set_channel_map(self, channel_map: ChannelMap) -> None:
        """Take the autopilot's channel map; it counts from the next output on."""
        self._map = channel_map

    def release(self) -> None:
        """Send a release, whatever the gate last said; for the way out of a process in which it may have failed."""
        self._send(RELEASE)

    def __call__(self, out: GateOutput) -> None:
        """Send one output of the gate."""
        if out.action is Action.RELEASE or self._map is None:
            self._send(RELEASE)
        else:
            self._send(self._map.override(out.widths_us))
