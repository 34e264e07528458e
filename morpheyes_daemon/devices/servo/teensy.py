"""The servos behind the Teensy: acknowledged targets over a byte link that may go away and come back.

The last target asked for is repeated as long as the servo is open, so that a Teensy that restarted goes there
again; the caller is told by an event and by the exception of `move`. This module knows nothing of how long a
motion takes: that is control.baseline.

Two ages are watched. `heard` is the last frame that only a Teensy sends: an echo of our own frames is none. `answered`
is the last answer to what we keep sending: a Teensy that reports its state and acknowledges something else is as good
as silent.
"""

from __future__ import annotations

import asyncio
from functools import partial

from morpheyes_daemon.bus import EventLog
from morpheyes_daemon.clock import MS, Clock, S
from morpheyes_daemon.config.vehicle import SerialServoConfig, ServoMotion
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import Link, LinkOpener
from morpheyes_daemon.errors import DeviceError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.wire import servo as wire

ANSWER_TIMEOUT_S = 0.1
TRIES = 3
HELLO_TRIES = 20
"""A Teensy that was just plugged in needs a second or so until it answers."""
BEAT_NS = 250 * MS
"""How often the last target is repeated; the Teensy counts the host as silent after 1 s."""
SILENT_NS = S
"""STATUS comes five times a second and every beat is answered."""
REOPEN_NS = 3 * S
"""A link that has been silent for so long is closed and opened again."""
BACKOFF_S = (0.25, 0.5, 1.0, 2.0)
ROUNDING_M = 1 / wire.UNITS_PER_M


class SerialServo:
    """A `Servo` over any byte link; `status` is the newest that the Teensy said of itself."""

    @classmethod
    def from_config(cls, config: SerialServoConfig, context: DeviceContext) -> SerialServo:
        """Build the backend `serial`."""
        return cls(config.url, config.motion, context.opener, context.clock, context.events)

    def __init__(self, url: str, motion: ServoMotion, opener: LinkOpener, clock: Clock, events: EventLog) -> None:
        self._url, self._opener, self._clock, self._events = url, opener, clock, events
        self._range_m = motion.min_baseline_mm / 1e3, motion.max_baseline_mm / 1e3
        self.status: wire.Status | None = None
        self._decoder = wire.Decoder()
        self._link: Link | None = None
        self._links_opened = 0
        self._keeper: asyncio.Task[None] | None = None
        self._target: wire.SetTarget | None = None
        self._seq = 0
        self._ack: asyncio.Future[wire.Ack] | None = None
        self._welcome: asyncio.Future[wire.Welcome] | None = None
        self._heard_ns = 0
        self._answered_ns = 0
        self._echoes = False
        self._trouble: str | None = None

    @property
    def dropped_frames(self) -> int:
        """Damaged frames received since the link was opened."""
        return self._decoder.dropped_frames

    async def open(self) -> None:
        """Open the link and greet the Teensy; DeviceNotFoundError when nothing fitting answers there."""
        if self._keeper is None:
            await self._connect()
            self._keeper = asyncio.get_running_loop().create_task(self._keep(), name="servo link")

    async def move(self, baseline_m: float) -> None:
        """Send a target and wait for its acknowledgement.

        DeviceLostError and DeviceTimeoutError leave open whether the servos move; the target goes on being sent.
        DeviceError when the Teensy would not go there.
        """
        self._seq = (self._seq + 1) % 256
        self._target = wire.SetTarget(self._seq, baseline_m)
        ack = await self._acknowledgement(self._target)
        if abs(ack.applied_m - baseline_m) > ROUNDING_M:
            raise DeviceError(
                f"The Teensy on {self._url} was asked for a baseline of {baseline_m * 1e3:.1f} mm and went to "
                f"{ack.applied_m * 1e3:.1f} mm; set servo.motion to the range that its sketch was built for."
            )

    async def close(self) -> None:
        """Close the link and end its keeper; may be called twice."""
        keeper, self._keeper = self._keeper, None
        if keeper is not None:
            keeper.cancel()
            await asyncio.gather(keeper, return_exceptions=True)
        self._drop_link("The servo was closed.")

    async def _acknowledgement(self, target: wire.SetTarget) -> wire.Ack:
        for _ in range(TRIES):
            if self._link is None:
                raise DeviceLostError(f"The servo link {self._url} is down: {self._trouble or 'not open'}.")
            self._ack = asyncio.get_running_loop().create_future()
            self._link.write(wire.encode(target))
            try:
                async with asyncio.timeout(ANSWER_TIMEOUT_S):
                    return await self._ack
            except TimeoutError:
                continue
        self._lost(Reason.BASELINE_STALE, "a target was not acknowledged")
        raise DeviceTimeoutError(
            f"The Teensy on {self._url} did not acknowledge a target in {TRIES} tries; check cable and sketch."
        )

    async def _keep(self) -> None:
        """Repeat the target, notice silence, and open the link again when it is gone."""
        failures = 0
        while True:
            pause_ns = BEAT_NS if self._link else round(BACKOFF_S[min(failures, len(BACKOFF_S) - 1)] * S)
            await self._clock.sleep_until_ns(self._clock.now_ns() + pause_ns)
            if self._link is not None:
                failures = 0
                self._beat(self._link)
                continue
            try:
                await self._connect()
            except DeviceError:
                failures += 1

    def _beat(self, link: Link) -> None:
        now_ns = self._clock.now_ns()
        if now_ns - self._heard_ns > REOPEN_NS:
            self._drop_link(f"it was silent{self._echo_words()}")
            return
        if now_ns - self._heard_ns > SILENT_NS:
            self._lost(Reason.BASELINE_STALE, f"the Teensy is silent{self._echo_words()}")
        elif now_ns - self._answered_ns > SILENT_NS:
            self._lost(Reason.BASELINE_STALE, "the Teensy does not acknowledge its target")
        link.write(wire.encode(self._target or wire.Hello()))

    def _echo_words(self) -> str:
        return ", the line echoes what is sent" if self._echoes else ""

    async def _connect(self) -> None:
        self._links_opened += 1
        self._echoes = False
        self._decoder = wire.Decoder()
        link = await self._opener(self._url, self._on_bytes, partial(self._on_lost, self._links_opened))
        self._link, self._heard_ns = link, self._clock.now_ns()
        self._answered_ns = self._heard_ns
        try:
            self._check(await self._greet(link))
        except (DeviceError, asyncio.CancelledError):
            self._drop_link("nothing fitting answered")
            raise
        self._recovered()

    async def _greet(self, link: Link) -> wire.Welcome:
        for _ in range(HELLO_TRIES):
            self._welcome = asyncio.get_running_loop().create_future()
            link.write(wire.encode(wire.Hello()))
            try:
                async with asyncio.timeout(ANSWER_TIMEOUT_S):
                    return await self._welcome
            except TimeoutError:
                continue
        raise DeviceNotFoundError(
            f"{self._url} opens, but no servo controller answers there; "
            "check that the Teensy runs firmware/morpheyes_servo and that the device name is right."
        )

    def _check(self, welcome: wire.Welcome) -> None:
        if welcome.version != wire.VERSION:
            raise DeviceNotFoundError(
                f"The Teensy on {self._url} speaks version {welcome.version} of the servo protocol, this daemon "
                f"{wire.VERSION}; flash firmware/morpheyes_servo of the same release."
            )
        low_m, high_m = self._range_m
        if low_m < welcome.min_m - ROUNDING_M or high_m > welcome.max_m + ROUNDING_M:
            raise DeviceNotFoundError(
                f"The Teensy on {self._url} moves {welcome.min_m * 1e3:g} to {welcome.max_m * 1e3:g} mm, but "
                f"servo.motion says {low_m * 1e3:g} to {high_m * 1e3:g} mm; make one fit the other."
            )

    def _on_bytes(self, data: bytes) -> None:
        for message in self._decoder.feed(data):
            if isinstance(message, wire.FROM_TEENSY):
                self._heard_ns = self._clock.now_ns()
                self._on_message(message)
            else:
                self._echoes = True

    def _on_message(self, message: wire.Message) -> None:
        if isinstance(message, wire.Status):
            self._on_status(message)
        elif isinstance(message, wire.Welcome):
            if self._target is None:
                self._on_answer()
            if self._welcome is not None and not self._welcome.done():
                self._welcome.set_result(message)
        elif isinstance(message, wire.Ack) and self._target is not None and message.seq == self._target.seq:
            if self._ack is not None and not self._ack.done():
                self._ack.set_result(message)
            self._on_answer()

    def _on_answer(self) -> None:
        """What the keeper repeats was answered: the target by its acknowledgement, Hello before there is one."""
        self._answered_ns = self._clock.now_ns()
        self._recovered()

    def _on_status(self, status: wire.Status) -> None:
        """A Teensy that restarted stood still meanwhile, even if a repeated target has reached it since."""
        before, self.status = self.status, status
        restarted = before is not None and status.uptime_ms < before.uptime_ms
        if (restarted or wire.StatusFlag.COLD in status.flags) and self._target is not None and self._link is not None:
            self._lost(Reason.SERVO_LOST, "the Teensy restarted and had forgotten its target; it is sent again")
            self._link.write(wire.encode(self._target))

    def _on_lost(self, link_number: int, reason: str) -> None:
        if link_number == self._links_opened:
            self._drop_link(reason)

    def _drop_link(self, reason: str) -> None:
        link, self._link = self._link, None
        if link is None:
            return
        link.close()
        self.status = None
        if self._keeper is not None:
            self._lost(Reason.SERVO_LOST, reason)
        for waiting in (self._ack, self._welcome):
            if waiting is not None and not waiting.done():
                waiting.set_exception(DeviceLostError(f"The servo link {self._url} went away: {reason}."))

    def _lost(self, reason: Reason, text: str) -> None:
        if self._trouble is None:
            self._events.publish(Event(self._clock.now_ns(), "servo", reason, text))
        self._trouble = text

    def _recovered(self) -> None:
        if self._trouble is not None:
            self._trouble = None
            self._events.publish(Event(self._clock.now_ns(), "servo", Reason.RECOVERED, "the Teensy answers again"))
