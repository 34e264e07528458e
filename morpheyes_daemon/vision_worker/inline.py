"""Where vision runs: a job in, a result out, and the caller never blocks the event loop.

`InlineWorker` calls a function in the loop and lets the result appear after a stated latency of the injected clock;
lockstep runs on it. `supervisor.worker_process.ProcessWorker` does the same in another process.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from typing import Generic, Protocol, TypeVar

from morpheyes_daemon.clock import Clock
from morpheyes_daemon.errors import DeviceError

Job = TypeVar("Job")
Result = TypeVar("Result")
JobIn = TypeVar("JobIn", contravariant=True)
ResultOut = TypeVar("ResultOut", covariant=True)


class WorkerLost(DeviceError):
    """The worker hung, died, or has not come up again yet; the job is lost, a later one may be done."""


class WorkerFailed(DeviceError):
    """The computation raised something unforeseen; the worker lives on. `remote_traceback` is its own, as text."""

    def __init__(self, message: str, remote_traceback: str = "") -> None:
        super().__init__(message)
        self.remote_traceback = remote_traceback


class VisionWorker(Protocol[JobIn, ResultOut]):
    """Computes one job at a time."""

    async def start(self) -> None:
        """Get ready; returns when the first job can be taken. Raises WorkerLost or what building raised."""

    async def compute(self, job: JobIn) -> ResultOut:
        """Return the result of `job`. Raises WorkerLost or WorkerFailed."""

    async def close(self) -> None:
        """End; may be called twice."""


class InlineWorker(Generic[Job, Result]):
    """Calls `function` on the spot; the result is handed out `latency_ns` after the call, on `clock`.

    With a `pool`, one of its threads computes while the virtual time of the latency passes: the same results at the
    same virtual times, in less real time.
    """

    def __init__(
        self, function: Callable[[Job], Result], latency_ns: int, clock: Clock, pool: Executor | None = None
    ) -> None:
        self._function, self._latency_ns, self._clock, self._pool = function, latency_ns, clock, pool

    async def start(self) -> None:
        """Nothing to get ready."""

    async def compute(self, job: Job) -> Result:
        """Return the function's result after the latency; what it raises is raised as it is."""
        done_ns = self._clock.now_ns() + self._latency_ns
        if self._pool is not None:
            pending = self._pool.submit(self._function, job)
            await self._clock.sleep_until_ns(done_ns)
            return pending.result()
        result = self._function(job)
        await self._clock.sleep_until_ns(done_ns)
        return result

    async def close(self) -> None:
        """Nothing to end."""
