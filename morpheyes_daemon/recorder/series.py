"""A flight as columns, collected while it flies or read back from its log; the pictures are drawn from this.

Keeps the small messages and events, never images. Times are seconds since the first message.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import Event, Intent, Perception
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.monitor import REQUESTED_STOPS

Column = NDArray[np.float64]

KEPT = ("perception", "vehicle", "command", "governed", "gate", "baseline")


class FlightSeries:
    """Everything a picture needs of one flight; `truth` is the simulator's own path, when there is one."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.truth: list[tuple[int, tuple[float, float, float]]] = []
        self._messages: dict[str, list[Any]] = {name: [] for name in KEPT}

    def watch(self, topics: Topics, events: EventLog) -> None:
        """Collect from now on."""
        for name in KEPT:
            getattr(topics, name).tap(self._adder(name))
        events.subscribe(self.events.append)

    def add(self, topic: str, value: Any) -> None:
        """Append one message; topics that no picture needs are passed over."""
        if isinstance(value, Event):
            self.events.append(value)
        elif topic in self._messages:
            self._messages[topic].append(value.summary if isinstance(value, Perception) else value)

    def add_truth(self, t_ns: int, p_ned_m: tuple[float, float, float]) -> None:
        """Append where the simulated vehicle really was."""
        self.truth.append((t_ns, p_ned_m))

    def _adder(self, topic: str) -> Callable[[Any], None]:
        return lambda value: self.add(topic, value)

    @property
    def start_ns(self) -> int:
        """Stamp of the first message, 0 when there is none."""
        return min((rows[0].t_ns for rows in self._messages.values() if rows), default=0)

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        last = max((rows[-1].t_ns for rows in self._messages.values() if rows), default=self.start_ns)
        return (last - self.start_ns) / S

    def seconds(self, t_ns: int) -> float:
        """Return a stamp as seconds since the first message."""
        return (t_ns - self.start_ns) / S

    def messages(self, topic: str) -> list[Any]:
        """Return what was collected of a topic (of perception: its depth summaries), oldest first."""
        return self._messages[topic]

    def times_s(self, topic: str) -> Column:
        """Return the stamps (N,) of a topic's messages."""
        return np.array([self.seconds(m.t_ns) for m in self._messages[topic]], dtype=np.float64)

    def column(self, topic: str, name: str) -> Column:
        """Return one field (N,) or (N, K) of a topic's messages as floats."""
        return np.array([getattr(m, name) for m in self._messages[topic]], dtype=np.float64)

    def words(self, topic: str, name: str) -> list[str]:
        """Return one field of a topic's messages as text, "" where it is None."""
        values = (getattr(m, name) for m in self._messages[topic])
        return ["" if v is None else str(v.value if isinstance(v, StrEnum) else v) for v in values]

    def path_ned_m(self) -> tuple[Column, Column]:
        """Return times (N,) and positions (N, 3): the truth when known, else what the autopilot reported."""
        if self.truth:
            times = [self.seconds(t_ns) for t_ns, _ in self.truth]
            return np.array(times), np.array([p for _, p in self.truth], dtype=np.float64)
        rows = [m for m in self._messages["vehicle"] if m.position_t_ns]
        times = [self.seconds(m.position_t_ns) for m in rows]
        return np.array(times, dtype=np.float64), np.array([m.p_ned_m for m in rows], dtype=np.float64).reshape(-1, 3)

    def at(self, times_s: Column, topic: str, name: str) -> Column:
        """Return a field interpolated at `times_s`, an angle without jumps; NaN when the topic is empty."""
        known, values = self.times_s(topic), self.column(topic, name)
        if known.size == 0:
            return np.full(times_s.shape, np.nan)
        return np.interp(times_s, known, np.unwrap(values) if name.endswith("_rad") else values)

    def spans(self, topic: str, name: str) -> list[tuple[float, float, str]]:
        """Return (from_s, to_s, word) for each stretch over which a field keeps its value."""
        times, words = self.times_s(topic), self.words(topic, name)
        starts = [i for i in range(len(words)) if i == 0 or words[i] != words[i - 1]]
        ends = [float(times[i]) for i in starts[1:]] + [self.duration_s]
        return [(float(times[i]), end, words[i]) for i, end in zip(starts, ends, strict=False)]

    def braking(self) -> list[tuple[float, str]]:
        """Return (second, reason) of each time the gate took the sticks back, the mission's end aside."""
        braked = self._beginnings("gate", lambda output: output.state == State.BRAKING)
        return [(t, reason) for t, reason in braked if reason not in REQUESTED_STOPS]

    def stops(self) -> list[tuple[float, str]]:
        """Return (second, reason) of each time the mission itself stopped to look around."""
        return self._beginnings("command", lambda command: command.intent == Intent.STOP)

    def _beginnings(self, topic: str, holds: Callable[[Any], bool]) -> list[tuple[float, str]]:
        rows = self._messages[topic]
        now = [holds(m) for m in rows]
        first = [m for m, is_so, was_so in zip(rows, now, [False, *now], strict=False) if is_so and not was_so]
        return [(self.seconds(m.t_ns), str(m.reason or "")) for m in first]
