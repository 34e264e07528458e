"""What the flight process tells the observer: every topic, thinned as the log wants it, and every event."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock
from morpheyes_daemon.messages.core import Event, Perception, StereoFrame
from morpheyes_daemon.observer.channel import ChannelWriter
from morpheyes_daemon.recorder.recorder import FrameStamp

EVENTS = "events"


@dataclass(frozen=True, slots=True)
class Told:
    """One value of a topic, or one event, with the time at which it was published."""

    topic: str
    t_ns: int
    value: Any


class Feed:
    """Taps topics and events into a channel; what it cannot tell is dropped there and counted."""

    def __init__(self, topics: Topics, events: EventLog, clock: Clock) -> None:
        self.channel = ChannelWriter()
        self._clock = clock
        events.subscribe(self._take_event)
        for topic in fields(topics):
            every = topic.metadata["log_every"]
            if every:
                getattr(topics, topic.name).tap(self._taker(topic.name, every))

    def _take_event(self, event: Event) -> None:
        self.channel.put(Told(EVENTS, self._clock.now_ns(), event))

    def _taker(self, name: str, every: int) -> Callable[[Any], None]:
        count = 0

        def take(value: Any) -> None:
            nonlocal count
            if count % every == 0:
                self.channel.put(Told(name, self._clock.now_ns(), without_full_images(value)))
            count += 1

        return take


def without_full_images(value: Any) -> Any:
    """Return the value without the camera's own pictures, which are too large to be told at every frame."""
    if isinstance(value, StereoFrame):
        return FrameStamp(value.seq, value.t_ns, value.baseline.baseline_m, value.baseline.sigma_m)
    if isinstance(value, Perception) and value.left_rect is None and value.depth_m is not None:
        return dataclasses.replace(value, depth_m=None)
    return value
