"""The supervisor owns every task: starts them, restarts what dies with back-off, and says so to the monitor.

It also renews the gate's SUPERVISOR lease, so that a supervisor that no longer runs means neutral sticks. A part
that has never worked yet is missing; one that worked and died is a fault. Flight is judged by the monitor.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any

from morpheyes_daemon.bus import EventLog
from morpheyes_daemon.clock import Clock, S, Ticker
from morpheyes_daemon.errors import MorphEyesError, mistake
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.safety.monitor import SafetyMonitor

RATE_HZ = 20.0
FIRST_BACKOFF_S = 0.5
LAST_BACKOFF_S = 5.0


class Pulse:
    """A task calls `beat` once per turn of its loop; the first beat after a restart clears its fault."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.count = 0
        self.last_ns = 0
        self.on_first: Callable[[], None] | None = None

    def beat(self) -> None:
        """Say that the task has just done its work."""
        self.count += 1
        self.last_ns = self._clock.now_ns()
        if self.on_first is not None:
            first, self.on_first = self.on_first, None
            first()


@dataclass(slots=True)
class Task:
    """One row of the task table. `run` gets the pulse to beat; `fault` is the reason its death is given."""

    name: str
    run: Callable[[Pulse], Coroutine[Any, Any, None]]
    fault: Reason
    essential: bool = True
    restarts: int = field(default=0, init=False)


class Supervisor:
    """Runs a table of tasks until cancelled."""

    def __init__(self, monitor: SafetyMonitor, gate: Gate, events: EventLog, clock: Clock, lease_s: float) -> None:
        self.tasks: list[Task] = []
        self.pulses: dict[str, Pulse] = {}
        self._monitor = monitor
        self._gate = gate
        self._events = events
        self._clock = clock
        self._lease_ns = round(lease_s * S)

    def add(self, *tasks: Task) -> None:
        """Take rows of the task table, before `run`."""
        for task in tasks:
            self.tasks.append(task)
            self.pulses[task.name] = Pulse(self._clock)

    @property
    def restarts(self) -> dict[str, int]:
        """How often each task was restarted, by name."""
        return {task.name: task.restarts for task in self.tasks}

    async def run(self) -> None:
        """Keep every task running; returns only by cancellation, with every task ended."""
        async with asyncio.TaskGroup() as group:
            for task in self.tasks:
                group.create_task(self._keep(task), name=task.name)
            group.create_task(self._renew(), name="supervisor")

    async def _renew(self) -> None:
        ticker = Ticker(self._clock, RATE_HZ)
        while True:
            self._gate.renew(Lease.SUPERVISOR, self._clock.now_ns() + self._lease_ns)
            await ticker.wait()

    async def _keep(self, task: Task) -> None:
        pulse = self.pulses[task.name]
        backoff_s = FIRST_BACKOFF_S
        while True:
            beats = pulse.count
            try:
                await task.run(pulse)
                text = f"{task.name}: ended unexpectedly"
            except MorphEyesError as error:
                text = f"{task.name}: {error}"
            except Exception as error:  # noqa: BLE001 -- the task boundary
                text = f"{task.name}: {mistake(error)}"
            self._report(task, pulse, text)
            backoff_s = FIRST_BACKOFF_S if pulse.count > beats else min(LAST_BACKOFF_S, backoff_s * 2)
            await self._clock.sleep_until_ns(self._clock.now_ns() + round(backoff_s * S))
            task.restarts += 1

    def _report(self, task: Task, pulse: Pulse, text: str) -> None:
        now_ns = self._clock.now_ns()
        if pulse.on_first is None:
            self._events.publish(Event(now_ns, task.name, task.fault, text))
        if task.essential and pulse.count == 0:
            self._monitor.set_missing(task.fault, task.name)
        elif task.essential:
            self._monitor.fault(task.fault, now_ns, task.name)
        pulse.on_first = lambda: self._recovered(task)

    def _recovered(self, task: Task) -> None:
        now_ns = self._clock.now_ns()
        self._events.publish(Event(now_ns, task.name, Reason.RECOVERED, f"{task.name}: works again"))
        if task.essential:
            self._monitor.set_missing(None, task.name)
            self._monitor.clear(task.fault, now_ns, task.name)
