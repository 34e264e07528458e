"""The observer process: mirrors topics and events, and from them writes the log, serves the page, prints the journal.

Started by `observer.task`, which never waits for it. It ends when the flight process closes the channel, after it has
written what came; a second observer of the same daemon goes on in a new log beside the first.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, fields
from multiprocessing import reduction
from pathlib import Path
from typing import Any

from morpheyes_daemon.bus import EventLog, Latest, Topics
from morpheyes_daemon.clock import MonotonicClock, S
from morpheyes_daemon.config.vehicle import DashboardConfig
from morpheyes_daemon.dashboard.server import Dashboard
from morpheyes_daemon.errors import DeviceError, InputError, RecordingError, printable
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.observer.channel import RecordReader
from morpheyes_daemon.observer.feed import EVENTS, Told
from morpheyes_daemon.observer.requests import Request, send_request
from morpheyes_daemon.recorder.recorder import Recorder

READ_BYTES = 1 << 18
LINES_PER_S = 50
"""Journal lines a second; more are counted. Chosen: journald's own limit is 10 000 in 30 s."""
NICENESS = 15
"""Below the vision worker's: the log may wait, depth may not."""


@dataclass(frozen=True, slots=True)
class ObserverJob:
    """What an observer does: `log` None writes none, `page` None serves none, `journal` gets events as lines.

    `header` goes into the log, `identity` onto the page; `image_rate_hz` None keeps no pictures in the log.
    """

    log: Path | None
    header: Mapping[str, str]
    image_rate_hz: float | None
    page: DashboardConfig | None
    identity: Mapping[str, str]
    journal: InheritedFile | None
    began_ns: int


class InheritedFile:
    """A file descriptor that goes along to a spawned process."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[Any, ...]:
        return _inherited, (reduction.DupFd(self.number),)


def _inherited(copy: Any) -> InheritedFile:
    return InheritedFile(copy.detach())


class StampClock(MonotonicClock):
    """The time at which the value being replayed was published, so that the log has the publisher's times."""

    def __init__(self) -> None:
        super().__init__()
        self.stamp_ns: int | None = None

    def now_ns(self) -> int:
        """Return the present value's time; the real one before the first value."""
        return super().now_ns() if self.stamp_ns is None else self.stamp_ns


def observe(job: ObserverJob, channel: socket.socket) -> None:
    """Run until the other end is closed; the entry point of the process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the flight process decides when it is over
    logging.disable()  # aiohttp would write a traceback for every request that is none
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    asyncio.run(_observe(job, channel))


async def _observe(job: ObserverJob, channel: socket.socket) -> None:
    mirror = _Mirror(job)
    tasks = [asyncio.create_task(_serve_page(job.page, mirror, channel, job))] if job.page else []
    try:
        with closing(mirror):
            await _read(channel, mirror)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class _Mirror:
    """Topics and events of the flight process, published again here."""

    def __init__(self, job: ObserverJob) -> None:
        self.topics, self.events = Topics.create(), EventLog()
        self.clock = StampClock()
        self._journal = Journal(job.journal.number, job.began_ns) if job.journal else None
        if self._journal is not None:
            self.events.subscribe(self._journal.line)
        self._recorder: Recorder | None = None
        self._topics: dict[str, Latest[Any]] = {f.name: getattr(self.topics, f.name) for f in fields(self.topics)}
        self._open_log(job)

    def _open_log(self, job: ObserverJob) -> None:
        if job.log is None:
            return
        try:
            self._recorder = Recorder(
                self.topics,
                self.events,
                self.clock,
                job.log,
                job.header,
                image_rate_hz=job.image_rate_hz,
                threaded=True,
                log_every=dict.fromkeys(self._topics, 1),
            )
        except (RecordingError, OSError) as error:
            self.events.publish(Event(self.clock.now_ns(), "recorder", Reason.RECORDER_FAILED, str(error)))

    def take(self, told: Told) -> None:
        """Publish one value or event."""
        self.clock.stamp_ns = told.t_ns
        if told.topic == EVENTS:
            self.events.publish(told.value)
        elif told.topic in self._topics:
            self._topics[told.topic].publish(told.value)

    def close(self) -> None:
        """Write what is left of the log."""
        if self._recorder is not None:
            self._recorder.close()


async def _read(channel: socket.socket, mirror: _Mirror) -> None:
    loop = asyncio.get_running_loop()
    channel.setblocking(False)
    reader = RecordReader()
    while True:
        try:
            data = await loop.sock_recv(channel, READ_BYTES)
        except OSError:
            return
        if not data:
            return
        try:
            for told in reader.feed(data):
                mirror.take(told)
        except InputError:
            return


async def _serve_page(page: DashboardConfig, mirror: _Mirror, channel: socket.socket, job: ObserverJob) -> None:
    """Serve the page; an address that is taken is tried again, since the daemon flies without a page too."""
    dashboard = Dashboard(mirror.topics, mirror.events, MonotonicClock(), job.identity)
    dashboard.on_stop = lambda: send_request(channel, Request.STOP)
    while True:
        try:
            await dashboard.run(page)
        except DeviceError as error:
            mirror.events.publish(Event(mirror.clock.now_ns(), "dashboard", Reason.TASK_DIED, str(error)))
            await asyncio.sleep(5.0)


class Journal:
    """Events as lines on a file descriptor, at most `LINES_PER_S`; whoever closed it reads none."""

    def __init__(self, number: int, began_ns: int) -> None:
        self._number = number
        self._began_ns = began_ns
        self._second = 0
        self._lines = 0
        self._left_out = 0

    def line(self, event: Event) -> None:
        """Print one event."""
        second = event.t_ns // S
        if second != self._second:
            self._flush_left_out()
            self._second, self._lines = second, 0
        self._lines += 1
        if self._lines > LINES_PER_S:
            self._left_out += 1
            return
        self._write(event_line(event, self._began_ns))

    def _flush_left_out(self) -> None:
        if self._left_out:
            self._write(f"{self._left_out} more events in that second")
            self._left_out = 0

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError):
            os.write(self._number, (printable(text) + "\n").encode(errors="replace"))


def event_line(event: Event, began_ns: int) -> str:
    """Return an event as a line for a person; what repeats the reason is left out."""
    seconds = (event.t_ns - began_ns) / 1e9
    text = event.text if event.reason.text in event.text else f"{event.reason.text}; {event.text}".rstrip("; ")
    return f"{seconds:9.2f} s  {event.source:<10} {text}"
