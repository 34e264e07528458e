"""The flight process's side of the observer: start it, feed it, poll what a person asks, start another when it dies.

Nothing here waits for the observer: its process is started in a thread, the channel drops what is not read, and its
death is an event. The task is not essential; a daemon without an observer flies.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import socket
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.context import SpawnProcess
from pathlib import Path

from morpheyes_daemon.clock import MS, Clock, S, Ticker
from morpheyes_daemon.errors import DeviceLostError
from morpheyes_daemon.observer.feed import Feed
from morpheyes_daemon.observer.process import ObserverJob, observe
from morpheyes_daemon.observer.requests import Request, RequestReader
from morpheyes_daemon.supervisor.supervisor import Pulse

FLUSH_HZ = 50.0
"""Chosen: what a flight process that is killed has not told yet is 20 ms old at most."""
FLUSH_NS = 2 * MS
"""Time that one flush may take of the event loop; a tenth of a stick period."""
CLOSE_S = 6.0
"""How long a daemon that ends lets its observer finish the log; the recorder itself gives a hung disk 5 s."""


@dataclass(slots=True)
class ObserverTask:
    """Keeps one observer running; `on_request` hears what a person asks. `started` counts the observers so far."""

    job: ObserverJob
    feed: Feed
    clock: Clock
    on_request: Callable[[Request], None]
    started: int = 0
    _process: SpawnProcess | None = None
    _socket: socket.socket | None = None

    async def run(self, pulse: Pulse) -> None:
        """Feed until cancelled; raises DeviceLostError when the observer died."""
        ours = await self._start()
        requests = RequestReader()
        ticker = Ticker(self.clock, FLUSH_HZ)
        while True:
            self.flush()
            for request in requests.poll(ours):
                self.on_request(request)
            if not self.feed.channel.connected:
                raise DeviceLostError("the observer (page, log, journal) died; another one is started.")
            pulse.beat()
            await ticker.wait()

    @property
    def pid(self) -> int | None:
        """Process id of the present observer, None while there is none."""
        return self._process.pid if self._process is not None else None

    async def start(self) -> None:
        """Start the observer before the tasks run, so that nothing goes untold."""
        if not self.feed.channel.connected:
            await self._start()

    def flush(self) -> None:
        """Send what there is, for `FLUSH_NS` at most."""
        end_ns = self.clock.now_ns() + FLUSH_NS
        self.feed.channel.flush(lambda: self.clock.now_ns() < end_ns)

    async def close(self) -> None:
        """Tell the rest, close the channel and let the observer finish its log; one that does not is killed."""
        end_ns = self.clock.now_ns() + S // 5
        self.flush()
        while self.feed.channel.pending and self.feed.channel.connected and self.clock.now_ns() < end_ns:
            await asyncio.sleep(0.005)
            self.flush()
        self.feed.channel.disconnect()
        process = self._process
        if process is not None:
            await asyncio.to_thread(process.join, CLOSE_S)
            if process.is_alive():
                process.kill()

    async def _start(self) -> socket.socket:
        """Start a process; one that was started before and lives is used."""
        if self._socket is not None and self.feed.channel.connected:
            return self._socket
        self.kill()
        ours, theirs = socket.socketpair()
        context = multiprocessing.get_context("spawn")
        job = replace(self.job, log=numbered(self.job.log, self.started)) if self.job.log else self.job
        process = context.Process(target=observe, args=(job, theirs), name="morpheyes-observer", daemon=True)
        await asyncio.to_thread(process.start)
        theirs.close()
        self._process, self._socket = process, ours
        self.started += 1
        self.feed.channel.connect(ours)
        return ours

    def kill(self) -> None:
        """End the process at once, if it still runs."""
        if self._process is not None and self._process.is_alive():
            with contextlib.suppress(OSError):
                self._process.kill()


def numbered(log: Path, started: int) -> Path:
    """Return the log of the n-th observer: the name as it is, then NAME-2, NAME-3 and so on."""
    return log if started == 0 else log.with_stem(f"{log.stem}-{started + 1}")
