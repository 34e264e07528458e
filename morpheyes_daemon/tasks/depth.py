"""Frames to depth and percepts, through the vision worker."""

from __future__ import annotations

from dataclasses import replace
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


async def depth(
    worker: Worker,
    track: PoseHistory,
    topics: Topics,
    events: EventLog,
    gate: Gate,
    clock: Clock,
    lease_ns: int,
    image_rate_hz: float,
    pulse: Pulse,
) -> None:
    """Have every newest frame looked at; bad images renew no lease, so they end in neutral sticks.

    Rows that drift are reported only: correcting them is the pipeline's, and what it did comes as its events.
    """
    frames = topics.frame.reader()
    next_image_ns = 0
    faults: tuple[Reason, ...] = ()
    while True:
        frame = await frames.next()
        keep = image_rate_hz > 0.0 and frame.t_ns >= next_image_ns
        next_image_ns = frame.t_ns + round(S / image_rate_hz) if keep else next_image_ns
        seen = await worker.compute(VisionJob(frame, track.at(frame.t_ns), keep))
        seen = replace(seen, summary=replace(seen.summary, done_ns=clock.now_ns()))
        for reason in (reason for reason in seen.image_faults if reason not in faults):
            events.publish(Event(clock.now_ns(), "depth", reason, reason.text))
        faults = seen.image_faults
        for event in seen.events:
            events.publish(event)
        if not UNUSABLE_IMAGES & set(faults):
            gate.renew(Lease.DEPTH, frame.t_ns + lease_ns)
        topics.perception.publish(seen)
        pulse.beat()
