"""The take-over test: on the ground, disarmed, the pilot takes the sticks back and it is measured how fast.

The daemon's part is what it is in flight: overrides stream at the stick rate, and on the message that shows the
switch off or another mode, the release goes out before anything else. The hand-over is over when RC_CHANNELS shows
the pilot's own sticks again. Throttle stays where the pilot's stick would arm nothing: the test ends at once when
the vehicle is armed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from morpheyes_daemon.clock import MS, Clock, S, Ticker
from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.control.loiter import LoiterModel
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.devices.autopilot.stick_output import ChannelMap
from morpheyes_daemon.doctor.findings import Finding, Severity
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.wire.mavlink import RELEASE, ChannelOverride

PATIENCE_S = 60.0
"""How long the pilot has for each step."""
ECHO_S = 1.5
HANDED_OVER_S = 2.0
LIMIT_S = 0.25
"""A hand-over that takes longer than this is worth a look at the link."""
MARK_US = 37
"""Our roll is off the trim by this much, so that our sticks and the pilot's can be told apart."""
RELEASES = 25
THROTTLE_LOW_US = 1000
"""Lower would be read as a lost radio (FS_THR_VALUE)."""


@dataclass(frozen=True, slots=True)
class HandOver:
    """One measured hand-over: from the message that showed the pilot's wish to the pilot's sticks in RC_CHANNELS."""

    way: str
    seconds: float


class TakeoverTest:
    """Leads the pilot through both ways of taking over; `say` is what the pilot reads."""

    def __init__(
        self,
        connection: AutopilotConnection,
        output: Callable[[ChannelOverride], None],
        config: AutopilotConfig,
        clock: Clock,
        say: Callable[[str], None],
    ) -> None:
        """`output` is the connection's claimed stick output. The connection must have read the parameters."""
        self._output = output
        self._config = config
        self._clock = clock
        self._say = say
        model = LoiterModel.from_parameters(connection.parameters.values)
        roll, pitch, _, yaw = model.neutral
        channel_map = ChannelMap.from_parameters(connection.parameters.values)
        sticks = (roll + MARK_US, pitch, max(THROTTLE_LOW_US, model.minimum[2]), yaw)
        self._marked = channel_map.override(sticks).channels_us
        self._state = VehicleState()
        self._wish: Callable[[VehicleState], bool] | None = None
        self._heard_ns = 0
        self._own_ns = 0
        self._released = 0
        connection.on_vehicle(self._hear)

    async def run(self) -> tuple[list[HandOver], list[Finding]]:
        """Return the measured hand-overs, and what did not work."""
        times: list[HandOver] = []
        try:
            await self._until(lambda: self._state.rc_t_ns > 0, "RC_CHANNELS does not come")
            times.append(await self._take_over_by_switch())
            times.append(await self._take_over_by_mode())
        except DeviceError as error:
            return times, [_failed(str(error))]
        finally:
            self._output(RELEASE)
        return times, [_slow(each) for each in times if each.seconds > LIMIT_S]

    async def _take_over_by_switch(self) -> HandOver:
        channel = self._config.engage_channel
        self._say(f"Flip the engage switch (channel {channel}) off, if it is on.")
        await self._until(lambda: not self._switch_on(self._state), "the engage switch was not seen off")
        self._say("Flip the engage switch on: the daemon takes the sticks. The motors stay off.")
        await self._until(lambda: self._switch_on(self._state), "the engage switch was not seen on")
        return await self._hand_over(
            "switch", lambda state: not self._switch_on(state), "Now take over: flip the switch off."
        )

    async def _take_over_by_mode(self) -> HandOver:
        mode = self._state.custom_mode
        return await self._hand_over(
            "mode", lambda state: state.custom_mode != mode, "Now take over by the mode switch: change the mode."
        )

    async def _hand_over(self, way: str, wish: Callable[[VehicleState], bool], words: str) -> HandOver:
        self._wish, self._heard_ns, self._own_ns, self._released = None, 0, 0, 0
        await self._stream_until(self._echoed, ECHO_S, "the overrides do not come back in RC_CHANNELS")
        self._wish = wish
        self._say(words)
        await self._stream_until(lambda: self._heard_ns > 0, PATIENCE_S, f"no take-over by {way} was seen")
        await self._stream_until(lambda: self._own_ns > 0, HANDED_OVER_S, "the pilot's sticks did not come back")
        seconds = (self._own_ns - self._heard_ns) / S
        self._say(f"The sticks were yours after {seconds * 1e3:.0f} ms.")
        return HandOver(way, seconds)

    async def _stream_until(self, done: Callable[[], bool], limit_s: float, failure: str) -> None:
        """Send sticks, or after the pilot's wish releases, at the stick rate until `done`."""
        ticker = Ticker(self._clock, self._config.stick_rate_hz)
        end_ns = self._clock.now_ns() + round(limit_s * S)
        while not done():
            self._check(end_ns, failure)
            if not self._heard_ns:
                self._output(ChannelOverride(self._marked))
            elif self._released < RELEASES:
                self._release()
            await ticker.wait()

    async def _until(self, done: Callable[[], bool], failure: str) -> None:
        end_ns = self._clock.now_ns() + round(PATIENCE_S * S)
        while not done():
            self._check(end_ns, failure)
            await self._clock.sleep_until_ns(self._clock.now_ns() + 20 * MS)

    def _check(self, end_ns: int, failure: str) -> None:
        """Raise DeviceError when time is over, or the vehicle was armed."""
        if self._clock.now_ns() > end_ns:
            raise DeviceError(f"{failure}.")
        if self._state.armed:
            raise DeviceError("the vehicle was armed, so the test was given up.")

    def _hear(self, state: VehicleState) -> None:
        """On reception, as in flight: the release goes out before this returns."""
        fresh_rc = state.rc_t_ns != self._state.rc_t_ns
        self._state = state
        if self._wish is not None and not self._heard_ns and self._wish(state):
            self._heard_ns = self._clock.now_ns()
            self._release()
        elif self._heard_ns and not self._own_ns and fresh_rc and not self._echoed():
            self._own_ns = self._clock.now_ns()

    def _release(self) -> None:
        self._released += 1
        self._output(RELEASE)

    def _echoed(self) -> bool:
        return self._state.rc_us[:4] == self._marked

    def _switch_on(self, state: VehicleState) -> bool:
        index = self._config.engage_channel - 1
        return len(state.rc_us) > index and state.rc_us[index] > self._config.engage_above_us


def _failed(evidence: str) -> Finding:
    return Finding(
        "takeover-failed",
        Severity.STOP,
        evidence,
        "the pilot may not get the sticks back",
        "bind the radio, check autopilot.engage_channel and MAV_GCS_SYSID, then repeat `doctor --takeover-test`",
    )


def _slow(measured: HandOver) -> Finding:
    return Finding(
        "takeover-slow",
        Severity.CARE,
        f"by {measured.way} the sticks came back after {measured.seconds * 1e3:.0f} ms",
        "the pilot waits for the vehicle to obey",
        "raise the baud rate of the link, and let no radio share it",
    )
