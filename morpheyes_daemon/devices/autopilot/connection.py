"""The autopilot link's one owner: it opens the port, keeps it open, and everything passes through it.

What arrives is handled on the spot, in the call that brings the bytes: the vehicle's state is published and every
listener has heard of a mode change before the next byte is looked at. What must wait (parameters, rates,
reconnecting) runs in `run`. Nothing is decided here: the connection reports, the gate decides.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.bus import EventLog, OnError, Topics, call_each, raise_it
from morpheyes_daemon.clock import MS, Clock, S, Ticker, wall_time_s
from morpheyes_daemon.config.vehicle import AutopilotConfig
from morpheyes_daemon.config.yaml_reader import read_text
from morpheyes_daemon.devices.autopilot.commands import CommandClient
from morpheyes_daemon.devices.autopilot.message_intervals import STREAMS, request_streams
from morpheyes_daemon.devices.autopilot.override_echo import OverrideEcho
from morpheyes_daemon.devices.autopilot.parameters import ParameterClient
from morpheyes_daemon.devices.autopilot.telemetry import Telemetry
from morpheyes_daemon.devices.autopilot.transmitter import Transmitter, may_relay
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from morpheyes_daemon.messages.core import Event, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.wire.mavlink import (
    ChannelOverride,
    Decoder,
    Identity,
    Message,
    Signing,
    dialect,
    frame_number,
    frame_source,
    source,
    text_of,
)
from morpheyes_daemon.wire.obstacle_distance import obstacle_distance_message

WATCH_HZ = 20.0
ONCE_A_SECOND_NS = S
FIRST_WORD_S = 3.0
"""Before the rates are granted only heartbeats come, once a second."""
REOPEN_S = 5.0
"""A port silent for this long is closed and opened again."""
BACK_OFF_S = (0.2, 5.0)
STREAM_GONE_NS = 2 * S
AUTOPILOT_COMPONENT = 1
GARBAGE_BYTES = 2000
"""Bytes that belong to no frame are skipped in pieces of this size."""


class AutopilotConnection:
    """See the module's text. `run` is the task; the rest may be called from the same loop at any time."""

    def __init__(
        self, config: AutopilotConfig, clock: Clock, topics: Topics, events: EventLog, opener: LinkOpener
    ) -> None:
        """Open nothing yet; raises ConfigError when the signing key cannot be read."""
        signing = None
        if config.signing_key_file is not None:
            signing = Signing.from_hex(read_text(config.signing_key_file), wall_time_s())
        self._config = config
        self._clock = clock
        self._topic = topics.vehicle
        self._events = events
        self._opener = opener
        self._vehicle = Identity(config.vehicle_sysid, AUTOPILOT_COMPONENT)
        self._gcs = Identity(config.gcs_sysid, config.gcs_compid)
        self._signing = signing
        self._decoder = Decoder(signing)
        self._relayed = Decoder()
        self._telemetry = Telemetry()
        self._echo = OverrideEcho()
        self._echo_lost = False
        self.transmitter = Transmitter(config, signing)
        self.parameters = ParameterClient(self.transmitter.send_status, clock, config.vehicle_sysid)
        self.commands = CommandClient(self.transmitter.send_status, config.vehicle_sysid)
        self._on_vehicle: list[Callable[[VehicleState], None]] = []
        self._on_text: list[Callable[[int, str], None]] = []
        self._on_frame: list[Callable[[bytes], None]] = []
        self._heard_ns = 0
        self._seen_ns = {stream.number: 0 for stream in STREAMS}
        self._up = False
        self._reported_lost = False
        self._lost_reason: str | None = None
        self._greet = asyncio.Event()
        self._want_parameters = True
        self._greeted_ns = 0
        self._timesync_ns = 0
        self._rebooted_ns: int | None = None
        self._reboots = 0
        self.refused_streams: list[str] = []
        self.on_error: OnError = raise_it

    @classmethod
    def from_config(cls, config: AutopilotConfig, context: DeviceContext) -> AutopilotConnection:
        """Build the backend `mavlink`."""
        return cls(config, context.clock, context.topics, context.events, context.opener)

    # -- what others hear ---------------------------------------------------------------------------------------

    @property
    def up(self) -> bool:
        """True while the vehicle is heard."""
        return self._up

    @property
    def bad_bytes(self) -> int:
        """Bytes since the port was opened that belonged to no valid frame."""
        return self._decoder.bad_bytes

    @property
    def rejected_frames(self) -> int:
        """Frames dropped for a missing or wrong signature."""
        return self._decoder.rejected

    def on_vehicle(self, callback: Callable[[VehicleState], None]) -> None:
        """Call `callback` with every new state on reception, before the topic has it; it must not raise."""
        self._on_vehicle.append(callback)

    def on_text(self, callback: Callable[[int, str], None]) -> None:
        """Call `callback` with the severity (0 worst) and text of the vehicle's STATUSTEXTs."""
        self._on_text.append(callback)

    def on_frame(self, callback: Callable[[bytes], None]) -> None:
        """Call `callback` with every frame that passed the checks (for mavsdk)."""
        self._on_frame.append(callback)

    def forget_frames(self, callback: Callable[[bytes], None]) -> None:
        """Undo `on_frame`."""
        self._on_frame = [listener for listener in self._on_frame if listener != callback]

    # -- what others send ---------------------------------------------------------------------------------------

    def claim_stick_output(self) -> Callable[[ChannelOverride], None]:
        """Return the one function that sends sticks; raises RuntimeError when it has been claimed already."""
        return self.transmitter.claim_stick_output(lambda override: self._echo.sent(override, self._clock.now_ns()))

    def send_statustext(self, severity: int, text: str) -> None:
        """Show up to 50 bytes of text on ground stations and in the autopilot's log; severity as in syslog."""
        self.transmitter.send_status(dialect.MAVLink_statustext_message(severity, text.encode()[:50]))

    def send_named_float(self, name: str, value: float) -> None:
        """Put a value into the autopilot's log under a name of up to ten characters."""
        self.transmitter.send_status(
            dialect.MAVLink_named_value_float_message(self._boot_ms(), name.encode()[:10], value)
        )

    def send_named_int(self, name: str, value: int) -> None:
        """Put a whole number into the autopilot's log under a name of up to ten characters."""
        self.transmitter.send_status(dialect.MAVLink_named_value_int_message(self._boot_ms(), name.encode()[:10], value))

    def send_debug_vector(self, name: str, x: float, y: float, z: float) -> None:
        """Show three values under a name of up to ten characters on ground stations; the autopilot acts on none."""
        stamp_us = self._clock.now_ns() // 1000
        self.transmitter.send_status(dialect.MAVLink_debug_vect_message(name.encode()[:10], stamp_us, x, y, z))

    def send_obstacle_distance(self, sectors_m: NDArray[np.float32], h_fov_rad: float, max_m: float) -> None:
        """Send the nearest obstacle of 72 sectors (see wire/obstacle_distance.py); call at 10 Hz or more."""
        message = obstacle_distance_message(sectors_m, h_fov_rad, max_m, self._clock.now_ns())
        self.transmitter.send(message, self.transmitter.proximity)

    def relay(self, data: bytes) -> None:
        """Send on what mavsdk wants to say, except heartbeats, sticks and message rates, which are ours."""
        for message in self._relayed.feed(data):
            if may_relay(message):
                self.transmitter.send(message, source(message))

    async def send_command(self, command: int, *parameters: float) -> None:
        """Send a MAV_CMD and wait until it is accepted; raises DeviceError or DeviceTimeoutError."""
        await self.commands.send(command, *parameters)

    async def set_aux_function(self, function: int, position: int) -> None:
        """Switch an RCx_OPTION function to 0 low, 1 middle or 2 high."""
        await self.send_command(dialect.MAV_CMD_DO_AUX_FUNCTION, float(function), float(position))

    async def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter; raises DeviceError or DeviceTimeoutError."""
        await self.parameters.set(name, value)

    # -- reception ----------------------------------------------------------------------------------------------

    def _on_bytes(self, data: bytes) -> None:
        now_ns = self._clock.now_ns()
        self._decoder.add(data)
        while (frame := self._decoder.next_frame(GARBAGE_BYTES)) is not None or self._decoder.pending:
            if frame is not None:
                self._take_frame(frame, now_ns)

    def _take_frame(self, frame: bytes, now_ns: int) -> None:
        """Only what the vehicle sends, and the ground station's heartbeat, is worth decoding."""
        sender = frame_source(frame)
        if sender == self._vehicle:
            message = self._decoder.decode(frame)
            if message is not None:
                call_each([lambda heard: self._take(heard, now_ns)], message, self.on_error)
        elif sender == self._gcs and frame_number(frame) == dialect.MAVLINK_MSG_ID_HEARTBEAT:
            self._publish(self._telemetry.take_gcs(now_ns))
        for pass_on in self._on_frame:
            pass_on(frame)

    def _take(self, message: Message, now_ns: int) -> None:
        self._heard_ns = now_ns
        if message.get_msgId() in self._seen_ns:
            self._seen_ns[message.get_msgId()] = now_ns
        if not self._up:
            self._come_up()
        kind = message.get_type()
        if kind == "PARAM_VALUE":
            self.parameters.take(message)
        elif kind == "COMMAND_ACK":
            self.commands.take(message)
        elif kind == "STATUSTEXT":
            for listen in self._on_text:
                listen(message.severity, text_of(message.text))
        elif kind == "TIMESYNC":
            self._take_timesync(message, now_ns)
        else:
            self._take_state(message, now_ns)

    def _take_state(self, message: Message, now_ns: int) -> None:
        boot_ms = getattr(message, "time_boot_ms", None)
        if boot_ms is not None and self._telemetry.boot.rebooted(boot_ms):
            self._telemetry.boot.reset()
            self._report_reboot(boot_ms, now_ns)
        state = self._telemetry.take(message, now_ns)
        if state is None:
            return
        if message.get_type() == "RC_CHANNELS":
            self._echo.seen(state.rc_us, now_ns)
        self._publish(state)

    def _report_reboot(self, boot_ms: int, now_ns: int) -> None:
        """Say so once a second at most: a boot time that goes to and fro says nothing new each time."""
        self._reboots += 1
        if self._rebooted_ns is not None and now_ns - self._rebooted_ns < ONCE_A_SECOND_NS:
            return
        more = f" ({self._reboots - 1} more since the last report)" if self._reboots > 1 else ""
        self._rebooted_ns, self._reboots = now_ns, 0
        self._event(Reason.AUTOPILOT_REBOOTED, f"it has been up for {boot_ms / 1000:.1f} s{more}")
        self._ask_all()

    def _take_timesync(self, message: Message, now_ns: int) -> None:
        if message.tc1 != 0 and message.ts1 == self._timesync_ns:
            self._telemetry.boot.add_round_trip(message.ts1, message.tc1, now_ns)

    def _publish(self, state: VehicleState) -> None:
        call_each(self._on_vehicle, state, self.on_error)
        self._topic.publish(state)

    def _come_up(self) -> None:
        self._up, self._reported_lost = True, False
        self._event(Reason.RECOVERED, "the autopilot is heard")
        self._greet.set()

    def _on_lost(self, reason: str) -> None:
        self._lost_reason = reason

    def close(self) -> None:
        """Let what is written go out and close the link; call it after `run` has been cancelled."""
        link, self.transmitter.link = self.transmitter.link, None
        if link is not None:
            link.close()

    # -- the task -----------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Keep the link for ever; ends only by cancellation. ConfigError (a wrong address) passes through.

        Cancelled, it leaves the link open, since whoever cancels it may still have a release to send: `close` it then.
        """
        back_off_s = BACK_OFF_S[0]
        while True:
            try:
                await self._session()
            except* DeviceError as errors:
                self._report_lost(str(errors.exceptions[0]))
            back_off_s = BACK_OFF_S[0] if self._heard_ns else min(BACK_OFF_S[1], 2 * back_off_s)
            self._heard_ns = 0
            await self._clock.sleep_until_ns(self._clock.now_ns() + round(back_off_s * S))

    async def _session(self) -> None:
        """From opening the port to losing it; raises DeviceError."""
        self.close()  # a link that was left open by a task that was ended
        self._lost_reason = None
        self._decoder = Decoder(self._signing)
        link = await self._opener(self._config.url, self._on_bytes, self._on_lost)
        self.transmitter.link = link
        self._ask_all()
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._watch())
                group.create_task(self._keep_greeting())
        except BaseExceptionGroup:
            self.close()
            raise

    async def _watch(self) -> None:
        """Twenty times a second: is it still there, does it echo, does it still stream?"""
        ticker = Ticker(self._clock, WATCH_HZ)
        opened_ns = spoke_ns = self._clock.now_ns()
        self._hello(spoke_ns)
        while True:
            await ticker.wait()
            now_ns = self._clock.now_ns()
            if self._lost_reason is not None:
                raise DeviceLostError(f"{self._config.url}: {self._lost_reason}.")
            silent_ns = now_ns - max(self._heard_ns, opened_ns)
            if silent_ns > REOPEN_S * S:
                raise DeviceLostError(f"{self._config.url}: the autopilot is silent; opening the port again.")
            streaming = self._seen_ns[dialect.MAVLINK_MSG_ID_ATTITUDE] > opened_ns
            if self._up and silent_ns > (self._config.link_timeout_s if streaming else FIRST_WORD_S) * S:
                self._report_lost(f"nothing from the autopilot for {silent_ns / S:.1f} s")
            if now_ns - spoke_ns >= ONCE_A_SECOND_NS:
                spoke_ns = now_ns
                self._hello(now_ns)
                self._check_streams(now_ns, opened_ns)
            self._check_echo(now_ns)
            self.parameters.tell_due(now_ns)

    def _hello(self, now_ns: int) -> None:
        self._timesync_ns = now_ns
        self.transmitter.heartbeat()
        self.transmitter.send_status(dialect.MAVLink_timesync_message(0, now_ns))

    def _check_streams(self, now_ns: int, opened_ns: int) -> None:
        """A stream that must always be there and is not: the rates were forgotten."""
        last = min(max(self._seen_ns[s.number], opened_ns, self._greeted_ns) for s in STREAMS if s.always)
        if self._up and now_ns - last > STREAM_GONE_NS:
            self._greet.set()

    def _check_echo(self, now_ns: int) -> None:
        ignored = self._up and self._echo.ignored(now_ns, self._seen_ns[dialect.MAVLINK_MSG_ID_RC_CHANNELS])
        if ignored and not self._echo_lost:
            self._event(
                Reason.OVERRIDE_IGNORED,
                f"overrides from system {self._config.override_sysid} do not come back in RC_CHANNELS:"
                " compare with MAV_GCS_SYSID (SYSID_MYGCS) and RC_OPTIONS",
            )
        elif self._echo_lost and not ignored:
            self._event(Reason.RECOVERED, "overrides are echoed again or no longer sent")
        self._echo_lost = ignored

    async def _keep_greeting(self) -> None:
        """Whenever asked: request the rates, and the parameters when they may have changed; try until it works."""
        while True:
            await self._greet.wait()
            self._greet.clear()
            wants_parameters, self._want_parameters = self._want_parameters, False
            try:
                self.refused_streams = await request_streams(self.commands)
                self._greeted_ns = self._clock.now_ns()
                if wants_parameters:
                    await self.parameters.read_all()
            except DeviceTimeoutError:
                self._want_parameters |= wants_parameters
                await self._clock.sleep_until_ns(self._clock.now_ns() + S)
                self._greet.set()

    # -- small print --------------------------------------------------------------------------------------------

    def _ask_all(self) -> None:
        self._want_parameters = True
        self._greet.set()

    def _report_lost(self, text: str) -> None:
        self._up = False
        if not self._reported_lost:
            self._reported_lost = True
            self._event(Reason.LINK_LOST, text)

    def _event(self, reason: Reason, text: str) -> None:
        self._events.publish(Event(self._clock.now_ns(), "autopilot", reason, text))

    def _boot_ms(self) -> int:
        return self._clock.now_ns() // MS % 2**32
