"""Frames to depth and percepts, through the vision worker."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.messages.core import Event, Perception
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.perception.pipeline import VisionJob
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.supervisor.supervisor import Pulse

UNUSABLE_IMAGES = frozenset({Reason.IMAGE_BAD, Reason.EYES_APART, Reason.DEPTH_SCALE})
"""Depth from images with these faults is not flown on."""


class Worker(Protocol):
    """Where the vision pipeline runs."""

    async def compute(self, job: VisionJob) -> Perception:
        """Return what the pipeline makes of the job; raises a DeviceError when the worker hung or died."""


@dataclass(slots=True)
class DepthTask:
    """Has every newest frame looked at; bad images renew no lease, so they end in neutral sticks.

    A depth map counts for `lease_ns` from its exposure. `image_rate_hz` is how often the small pictures are kept.
    Row offsets that drift are only reported here; the pipeline corrects them and tells so in its events.
    """

    worker: Worker
    poses: PoseHistory
    topics: Topics
    events: EventLog
    gate: Gate
    clock: Clock
    lease_ns: int
    image_rate_hz: float

    async def run(self, pulse: Pulse) -> None:
        """Compute until cancelled; raises the worker's DeviceError."""
        frames = self.topics.frame.reader()
        next_image_ns = 0
        faults: tuple[Reason, ...] = ()
        while True:
            frame = await frames.next()
            keep = self.image_rate_hz > 0.0 and frame.t_ns >= next_image_ns
            next_image_ns = frame.t_ns + round(S / self.image_rate_hz) if keep else next_image_ns
            seen = await self.worker.compute(VisionJob(frame, self.poses.at(frame.t_ns), keep))
            seen = replace(seen, summary=replace(seen.summary, done_ns=self.clock.now_ns()))
            self._report(seen, faults)
            faults = seen.image_faults
            if not UNUSABLE_IMAGES & set(faults):
                self.gate.renew(Lease.DEPTH, frame.t_ns + self.lease_ns)
            self.topics.perception.publish(seen)
            pulse.beat()

    def _report(self, seen: Perception, known: tuple[Reason, ...]) -> None:
        """Publish image faults that are new, and the pipeline's own events."""
        for reason in (reason for reason in seen.image_faults if reason not in known):
            self.events.publish(Event(self.clock.now_ns(), "depth", reason, reason.text))
        for event in seen.events:
            self.events.publish(event)
