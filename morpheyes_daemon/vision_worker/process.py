"""Vision in a process of its own, so that a hang or a crash of native code is a fault the daemon survives.

Jobs and results pass through two mailboxes; a socket pair carries only "here is one" and "done". A worker that
does not answer in time is killed; one that is gone is started again with back-off. Nothing here waits in the event
loop, and nothing is left behind when either process dies.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import socket
import struct
import threading
import traceback
from collections.abc import Callable
from enum import IntEnum
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, Protocol

from morpheyes_daemon.errors import MorphEyesError, mistake
from morpheyes_daemon.vision_worker.inline import Job, JobIn, Result, ResultOut, WorkerFailed, WorkerLost
from morpheyes_daemon.vision_worker.shared_memory import Mailbox

BACKOFF_S = (0.0, 0.25, 0.5, 1.0, 2.0, 5.0)
CLOSE_TIMEOUT_S = 1.0
_REPLY = struct.Struct("<B")
_JOB = b"j"


class _Verdict(IntEnum):
    DONE = 0
    FAILED = 1


class Perceiver(Protocol[JobIn, ResultOut]):
    """What runs in the worker."""

    def perceive(self, job: JobIn) -> ResultOut:
        """Return what the job asks for."""


class ProcessWorker(Generic[Job, Result]):
    """A `VisionWorker` that builds `factory()` in another process and calls its `perceive` there.

    `factory` and what it needs must be picklable, jobs and results too. A MorphEyesError raised there is raised here
    as it is, anything else as WorkerFailed. `on_idle_death` hears of a death that no job would tell of, `on_remark`
    once of what a process could not do that it can do without.
    """

    def __init__(
        self,
        factory: Callable[[], Perceiver[Job, Result]],
        *,
        job_timeout_s: float,
        start_timeout_s: float = 60.0,
        niceness: int = 10,
        on_idle_death: Callable[[str], None] = lambda text: None,
        on_remark: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._factory, self._niceness = factory, niceness
        self._job_timeout_s, self._start_timeout_s = job_timeout_s, start_timeout_s
        self._on_idle_death, self._on_remark = on_idle_death, on_remark
        self._remarked = ""
        self._turn = asyncio.Lock()
        self._child: _Child | None = None
        self._starting: asyncio.Task[_Child] | None = None
        self._failures = 0
        self._closed = False
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """The worker's process id, None while there is none."""
        return self._child.process.pid if self._child else None

    async def start(self) -> None:
        """Start the process and wait until it has built its object; raises what that raised."""
        await self._ready()

    async def compute(self, job: Job) -> Result:
        """Return the result; waits for a worker that is just being started again."""
        async with self._turn:
            child = await self._ready()
            try:
                async with asyncio.timeout(self._job_timeout_s):
                    result: Result = await child.compute(job)
            except TimeoutError:
                self._lose(child)
                raise WorkerLost(
                    f"The vision worker did not finish within {self._job_timeout_s:g} s and was killed; "
                    "a new one is being started."
                ) from None
            except (EOFError, ConnectionError):
                end = await child.end()
                self._lose(child)
                raise WorkerLost(f"The vision worker died ({end}); a new one is being started.") from None
            self._failures = 0
            return result

    async def close(self) -> None:
        """End the process; may be called twice."""
        self._closed = True
        starting, self._starting = self._starting, None
        if starting is not None:
            starting.cancel()
            await asyncio.gather(starting, return_exceptions=True)
        child, self._child = self._child, None
        if child is not None:
            await child.close()

    async def _ready(self) -> _Child:
        if self._closed:
            raise WorkerLost("The vision worker was closed.")
        if self._child is not None:
            return self._child
        if self._starting is None or self._starting.done():
            self._starting = asyncio.get_running_loop().create_task(self._start_one(), name="vision worker start")
        try:
            async with asyncio.timeout(self._start_timeout_s):
                return await asyncio.shield(self._starting)
        except TimeoutError:
            raise WorkerLost(f"The vision worker was not ready within {self._start_timeout_s:g} s.") from None

    async def _start_one(self) -> _Child:
        """Start a process after the pause that is due, and let this worker know of it."""
        await asyncio.sleep(BACKOFF_S[min(self._failures, len(BACKOFF_S) - 1)])
        self._failures += 1
        child = _Child()
        try:
            async with asyncio.timeout(self._start_timeout_s):
                self._remark(await child.start(self._factory, self._niceness))
        except (EOFError, ConnectionError):
            raise WorkerLost(f"The vision worker died while starting ({await child.end()}).") from None
        except TimeoutError:
            raise WorkerLost("The vision worker took too long to start and was killed.") from None
        else:
            self._child = child
            child.on_exit(lambda: self._on_child_exit(child))
            return child
        finally:
            if self._child is not child:
                child.kill()
                await child.close()

    def _remark(self, text: str) -> None:
        """Pass on what a process said of its start, unless the one before it said the same."""
        if text and text != self._remarked:
            self._on_remark(text)
        self._remarked = text

    def _on_child_exit(self, child: _Child) -> None:
        if self._child is child and not self._turn.locked() and not self._closed:
            self._on_idle_death(f"The vision worker died while idle ({child.cause}); a new one is being started.")
        self._lose(child)

    def _lose(self, child: _Child) -> None:
        """Kill a child that is of no more use and begin to start another."""
        if self._child is not child or self._closed:
            return
        self._child = None
        self.restarts += 1
        child.kill()
        self._starting = asyncio.get_running_loop().create_task(self._replace(child), name="vision worker restart")
        self._starting.add_done_callback(_retrieved)

    async def _replace(self, dead: _Child) -> _Child:
        await dead.close()
        while True:
            try:
                return await self._start_one()
            except MorphEyesError:
                continue


def _retrieved(task: asyncio.Task[_Child]) -> None:
    """Whoever waits for the restart sees its exception; when nobody does, it need not be reported twice."""
    if not task.cancelled():
        task.exception()


class _Child:
    """One process and the two mailboxes and socket that reach it."""

    process: SpawnProcess

    def __init__(self) -> None:
        self._jobs, self._results = Mailbox.create(), Mailbox.create()
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._awaited = 0
        self._exit_code: int | None = None
        self._exited = asyncio.Event()
        self._callback: Callable[[], None] | None = None
        self._started = False

    async def start(self, factory: Callable[[], Any], niceness: int) -> str:
        """Start the process, wait until it is ready and return its remark; EOFError when it dies, or what it raised."""
        ours, theirs = socket.socketpair()
        with theirs:
            socket.send_fds(ours, [_JOB], [self._jobs.fd, self._results.fd])
            ours.setblocking(False)
            self._reader, self._writer = await asyncio.open_connection(sock=ours)
            context = multiprocessing.get_context("spawn")
            self.process = context.Process(
                target=serve, args=(factory, theirs, niceness), name="morpheyes-vision", daemon=True
            )
            await asyncio.to_thread(self.process.start)  # it forks and execs: tens of milliseconds
        self._started = True
        asyncio.get_running_loop().add_reader(self.process.sentinel, self._on_exited)
        self._awaited = 1
        remark: str = await self._answer()
        return remark

    def on_exit(self, callback: Callable[[], None]) -> None:
        """Call back when the process ends, at once when it already has."""
        self._callback = callback
        if self._exited.is_set():
            callback()

    async def compute(self, job: Any) -> Any:
        """Hand over a job and return its result; EOFError or ConnectionError when the process is gone."""
        assert self._writer is not None
        while self._awaited:  # of a caller that was cancelled
            try:
                await self._answer()
            except MorphEyesError:
                continue
        self._jobs.put(job)
        self._writer.write(_JOB)
        self._awaited += 1
        return await self._answer()

    async def _answer(self) -> Any:
        assert self._reader is not None
        (verdict,) = _REPLY.unpack(await self._reader.readexactly(_REPLY.size))
        self._awaited -= 1
        content = self._results.take()
        if verdict == _Verdict.DONE:
            return content
        if isinstance(content, MorphEyesError):
            raise content
        summary, trace = content
        raise WorkerFailed(f"The vision worker failed: {summary}.", trace)

    def kill(self) -> None:
        """Send SIGKILL, to which even hung native code listens."""
        if self._started and not self._exited.is_set():
            self.process.kill()

    async def end(self) -> str:
        """Return how the process ended, which may become known a moment after its socket closed."""
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._exited.wait()
        except TimeoutError:
            return "it closed its socket"
        return self.cause

    @property
    def cause(self) -> str:
        """How the process ended, once it has."""
        assert self._exit_code is not None
        killed = self._exit_code < 0
        return f"killed by {signal.Signals(-self._exit_code).name}" if killed else f"exit code {self._exit_code}"

    async def close(self) -> None:
        """Let the process end by itself, kill it when it does not, and give everything back."""
        if self._writer is not None:
            self._writer.close()
        if self._started:
            try:
                async with asyncio.timeout(CLOSE_TIMEOUT_S):
                    await self._exited.wait()
            except TimeoutError:
                self.kill()
                await self._exited.wait()
        self._jobs.close()
        self._results.close()

    def _on_exited(self) -> None:
        asyncio.get_running_loop().remove_reader(self.process.sentinel)
        self.process.join()
        self._exit_code = self.process.exitcode
        self.process.close()
        self._exited.set()
        if self._callback is not None:
            self._callback()


def serve(factory: Callable[[], Perceiver[Any, Any]], link: socket.socket, niceness: int) -> None:
    """The worker's whole life: build the object, answer jobs, end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the whole group; the parent decides
    remark = _give_way(niceness)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _, (jobs_fd, results_fd), _, _ = socket.recv_fds(link, 1, 2)
    jobs, results = Mailbox(jobs_fd), Mailbox(results_fd)
    built: list[Perceiver[Any, Any]] = []

    def build() -> str:
        built.append(factory())
        return remark

    _reply(link, results, build)
    try:
        while built and link.recv(1):
            _reply(link, results, lambda: built[0].perceive(jobs.take()))
    except ConnectionError:
        return  # the parent died while it waited for an answer


def _give_way(niceness: int) -> str:
    """Lower the priority of this process; a service manager's filter may refuse that, which is said and lived with."""
    try:
        os.nice(niceness)
    except OSError as error:
        return (
            f"The vision worker could not lower its priority by {niceness} ({error.strerror}) and runs at that of the "
            "daemon; allow the system call setpriority in the unit."
        )
    return ""


def _reply(link: socket.socket, results: Mailbox, work: Callable[[], Any]) -> None:
    try:
        results.put(work())
        verdict = _Verdict.DONE
    except Exception as error:  # noqa: BLE001 -- the worker's task boundary
        told = isinstance(error, MorphEyesError)
        results.put(error if told else (mistake(error), traceback.format_exc()))
        verdict = _Verdict.FAILED
    link.sendall(_REPLY.pack(verdict))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(0)
