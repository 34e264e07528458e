"""The flight recorder: taps every topic and never holds up whoever publishes.

In real time the taps only queue, and one thread encodes, writes and syncs once a second; in lockstep everything
happens on the spot, without a thread. When the disk refuses, the flight goes on: one RECORDER_FAILED event, events
are kept, ordinary values dropped and counted once the queue is full, and a RECOVERED event when the disk is back.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.messages.core import Event, Perception, StereoFrame
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.recorder.channels import entries, ned_entry
from morpheyes_daemon.recorder.flight_log import FlightLog

SYNC_NS = S
DRAIN_S = 0.05
QUEUE_LIMIT = 4000
"""About ten seconds of everything, for a disk that pauses."""
EVENT_LIMIT = 100_000
"""Events beyond this, on top of a full queue, are counted instead of kept: memory is not endless either."""
SOURCE = "recorder"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecorderHealth:
    """How the recorder fares: entries written, values and events it had to drop, and whether the disk refuses."""

    path: str
    written: int
    dropped: int
    lost_events: int
    queued: int
    failed: bool


@dataclass(frozen=True, slots=True)
class _Item:
    topic: str
    log_ns: int
    value: Any
    images: bool


class Recorder:
    """Records from construction until `close`."""

    def __init__(
        self,
        topics: Topics,
        events: EventLog,
        clock: Clock,
        path: Path,
        header: Mapping[str, str],
        *,
        image_rate_hz: float | None,
        threaded: bool,
        log_every: Mapping[str, int] | None = None,
    ) -> None:
        """`log_every` n keeps each n-th value of a topic; None takes what the topics themselves say."""
        self._clock = clock
        self._events = events
        self._log = FlightLog(path, header)
        self._image_period_ns = round(S / image_rate_hz) if image_rate_hz else None
        self._next_image_ns = clock.now_ns()
        self._next_sync_ns = clock.now_ns()
        self._queue: deque[_Item] = deque()
        self._dropped = 0
        self._lost_events = 0
        self._failed = False
        self._closed = False
        self._stop = threading.Event()
        self._loop = asyncio.get_running_loop() if threaded else None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True) if threaded else None
        self._log.add(ned_entry(clock.now_ns()), clock.now_ns(), clock.now_ns())
        self._tap(topics, events, log_every)
        if self._thread is not None:
            self._thread.start()

    @property
    def path(self) -> Path:
        """The file being written."""
        return self._log.path

    def health(self) -> RecorderHealth:
        """Return counts for the health topic."""
        return RecorderHealth(
            path=str(self._log.path),
            written=self._log.written,
            dropped=self._dropped,
            lost_events=self._lost_events,
            queued=len(self._queue),
            failed=self._failed,
        )

    def close(self, timeout_s: float = 5.0) -> None:
        """Write what is queued and the index; a disk that hangs is waited for no longer than `timeout_s`."""
        if self._closed:
            return
        self._closed = True
        self._stop.set()
        if self._thread is None:
            self._finish()
        else:
            self._thread.join(timeout_s)

    # -- the publisher's side -------------------------------------------------------------------------------

    def _tap(self, topics: Topics, events: EventLog, log_every: Mapping[str, int] | None) -> None:
        events.subscribe(self._take_event)
        for topic in fields(topics):
            every = topic.metadata["log_every"] if log_every is None else log_every[topic.name]
            if every:
                getattr(topics, topic.name).tap(self._taker(topic.name, every))

    def _taker(self, name: str, every: int) -> Callable[[Any], None]:
        count = 0

        def take(value: Any) -> None:
            nonlocal count
            if count % every == 0:
                self._take(name, value)
            count += 1

        return take

    def _take(self, topic: str, value: Any) -> None:
        if self._closed:
            return
        if len(self._queue) >= QUEUE_LIMIT or self._log.full:
            self._dropped += 1
            self._report_failure("the disk is too slow")
            return
        now_ns = self._clock.now_ns()
        images = isinstance(value, Perception) and self._image_due(now_ns)
        self._put(_Item(topic, now_ns, _lightened(value, images=images), images))

    def _take_event(self, event: Event) -> None:
        if self._closed:
            return
        if len(self._queue) >= QUEUE_LIMIT + EVENT_LIMIT:
            self._lost_events += 1
            return
        self._put(_Item("events", self._clock.now_ns(), event, False))

    def _image_due(self, now_ns: int) -> bool:
        if self._image_period_ns is None or now_ns < self._next_image_ns:
            return False
        self._next_image_ns = max(self._next_image_ns + self._image_period_ns, now_ns)
        return True

    def _put(self, item: _Item) -> None:
        self._queue.append(item)
        if self._thread is None:
            self._drain()

    # -- the writer's side: the thread in real time, the publisher in lockstep ------------------------------

    def _run(self) -> None:
        while not self._stop.wait(DRAIN_S):
            try:
                self._drain()
            except Exception as error:  # noqa: BLE001 -- the thread's boundary: a strange value must not end the log
                _log.exception("recorder")
                self._report_failure(str(error))
        self._finish()

    def _drain(self) -> None:
        while self._queue:
            item = self._queue.popleft()
            for entry in entries(item.topic, item.log_ns, item.value, images=item.images):
                self._log.add(entry, item.log_ns, getattr(item.value, "t_ns", item.log_ns))
        if self._clock.now_ns() >= self._next_sync_ns:
            self._next_sync_ns = self._clock.now_ns() + SYNC_NS
            self._try(lambda: self._log.sync(durable=self._thread is not None))

    def _finish(self) -> None:
        self._drain()
        self._try(self._log.close)

    def _try(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self._report_failure(error.strerror or str(error))
        else:
            self._report_recovery()

    def _report_failure(self, why: str) -> None:
        if not self._failed:
            self._failed = True
            self._publish(Reason.RECORDER_FAILED, f"{self._log.path}: {why}")

    def _report_recovery(self) -> None:
        if self._failed:
            self._failed = False
            self._publish(Reason.RECOVERED, f"{self._log.path}: {self._dropped} values dropped")

    def _publish(self, reason: Reason, text: str) -> None:
        """Events belong to the loop: from the thread they are handed over, once the loop still runs."""
        event = Event(self._clock.now_ns(), SOURCE, reason, text)
        if self._loop is None:
            self._events.publish(event)
            return
        try:
            self._loop.call_soon_threadsafe(self._events.publish, event)
        except RuntimeError:
            _log.warning("%s: %s", reason.text, text)  # the loop has ended already


def _lightened(value: Any, *, images: bool) -> Any:
    """Let go of the pictures that will not be logged, so that the queue does not hold them."""
    if isinstance(value, StereoFrame):
        return FrameStamp(value.seq, value.t_ns, value.baseline.baseline_m, value.baseline.sigma_m)
    if isinstance(value, Perception) and not images:
        return dataclasses.replace(value, left_rect=None, depth_m=None)
    return value


@dataclass(frozen=True, slots=True)
class FrameStamp:
    """What the log keeps of a stereo frame: its number, mid-exposure and baseline."""

    seq: int
    t_ns: int
    baseline_m: float
    baseline_sigma_m: float
