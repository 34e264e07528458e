"""The mission task decides on the newest percept, and only when a stick message has just gone out."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

from morpheyes_daemon.bus import StickPulse, Topics
from morpheyes_daemon.clock import MS, S, run_virtual, running_clock
from morpheyes_daemon.control.pose_history import PoseHistory
from morpheyes_daemon.control.stick_controller import StickController
from morpheyes_daemon.messages.core import DepthSummary, Intent, Perception
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.supervisor.supervisor import Pulse
from morpheyes_daemon.tasks.mission import MissionTask

STICKS_NS, FRAMES_NS = 20 * MS, 37 * MS


def percept(seq: int, t_ns: int) -> Perception:
    """A percept that is its own number."""
    summary = DepthSummary(seq, t_ns, t_ns, 0.2, 1e-4, 300.0, 1.2, 0.2, 0.8, 1.0, 0.0, 5.0, 0.01, "")
    return Perception(summary, seq, None)  # type: ignore[arg-type]


class Listed:
    """In the place of strategy and monitor: notes when it was asked and what it was told."""

    state = State.ENGAGED

    def __init__(self) -> None:
        self.decided: list[tuple[int, int]] = []
        self.leases: list[tuple[Lease, int]] = []
        self.over: Reason | None = None
        self.gate = SimpleNamespace(renew=lambda *lease: self.leases.append(lease))

    def track(self, percept: int) -> None:
        """Nothing is followed."""

    def decide(self, observation: Any) -> Any:
        """Done at the tenth percept."""
        self.decided.append((observation.now_ns, observation.percept))
        intent = Intent.DONE if observation.percept >= 10 else Intent.FLY
        return SimpleNamespace(expires_ns=observation.now_ns + 60 * S, intent=intent, reason=None)

    def mission_over(self, reason: Reason, now_ns: int) -> None:
        """The flight is over."""
        self.over = reason


async def fly(listed: Listed, topics: Topics, last_s: float) -> None:
    clock = running_clock()
    began_ns = clock.now_ns()

    sent = StickPulse()

    async def publish(topic: Any, period_ns: int, make: Any, then: Any = lambda: None) -> None:
        for count in range(1, 100):
            await clock.sleep_until_ns(began_ns + count * period_ns)
            topic.publish(make(count, clock.now_ns()))
            then()

    jobs = [
        MissionTask(
            strategy=listed,  # type: ignore[arg-type]
            poses=PoseHistory(),
            stopping=StickController(None, None),  # type: ignore[arg-type]  # no parameters yet
            monitor=listed,  # type: ignore[arg-type]
            gate=listed.gate,  # type: ignore[arg-type]
            topics=topics,
            sticks_sent=sent,
            clock=clock,
            reaction_s=0.3,
            longest_s=0.5,
        ).run(Pulse(clock)),
        publish(topics.perception, FRAMES_NS, percept),
        publish(topics.gate, STICKS_NS, lambda count, t_ns: t_ns, sent.strike),
    ]
    tasks = [asyncio.create_task(job) for job in jobs]
    await clock.sleep_until_ns(began_ns + round(last_s * S))
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def test_it_decides_on_every_percept_right_after_a_stick_message() -> None:
    listed, topics = Listed(), Topics.create()
    sent_ns: set[int] = set()
    topics.gate.tap(sent_ns.add)  # type: ignore[arg-type]
    run_virtual(fly(listed, topics, 1.0))
    assert [seq for _, seq in listed.decided[:20]] == list(range(1, 21))
    assert {t_ns for t_ns, _ in listed.decided} <= sent_ns


def test_no_command_lasts_longer_than_it_may() -> None:
    listed = Listed()
    run_virtual(fly(listed, Topics.create(), 1.0))
    wanted = [(Lease.MISSION, t_ns + S // 2) for t_ns, _ in listed.decided]
    assert listed.leases == wanted


def test_a_mission_that_is_done_says_so() -> None:
    listed = Listed()
    run_virtual(fly(listed, Topics.create(), 1.0))
    assert listed.over is Reason.GOAL_REACHED
