"""The baseline task: the eyes first go where they are known to be, and only then where the mission wants them."""

from __future__ import annotations

import asyncio

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import S, run_virtual, running_clock
from morpheyes_daemon.config import ServoMotion
from morpheyes_daemon.control.baseline import BaselineModel
from morpheyes_daemon.control.baseline_planner import BaselinePlanner
from morpheyes_daemon.messages import Intent, MissionCommand
from morpheyes_daemon.supervisor.supervisor import Pulse
from morpheyes_daemon.tasks.baseline import baseline


class ListeningServo:
    """Acknowledges every target at once."""

    def __init__(self) -> None:
        self.targets_m: list[float] = []

    async def open(self) -> None:
        """Nothing to open."""

    async def move(self, target_m: float) -> None:
        """Take the target."""
        self.targets_m.append(target_m)

    async def close(self) -> None:
        """Nothing to close."""


def wanting(baseline_m: float, t_ns: int) -> MissionCommand:
    """A command that differs from others in its baseline."""
    return MissionCommand(
        seq=1,
        t_ns=t_ns,
        expires_ns=t_ns + S,
        intent=Intent.STOP,
        reason=None,
        v_ned_m_s=(0.0, 0.0, 0.0),
        yaw_rad=None,
        height_m=None,
        baseline_m=baseline_m,
        clear_m=0.0,
        measured_ns=t_ns,
        p_measured_ned_m=(0.0, 0.0, 0.0),
    )


async def wavering(topics: Topics) -> None:
    """A mission that wants now this, now that."""
    clock = running_clock()
    for turn in range(200):
        now_ns = clock.now_ns()
        wanted_m = (0.15, 0.25)[turn % 2]
        topics.command.publish(wanting(wanted_m, now_ns))
        await clock.sleep_until_ns(now_ns + S // 10)


def test_a_wavering_mission_is_followed_once_the_eyes_are_known_to_be_at_the_first_place() -> None:
    servo, motion, topics = ListeningServo(), ServoMotion(), Topics.create()
    told: list[tuple[bool, int]] = []

    async def run() -> None:
        clock = running_clock()
        task = asyncio.create_task(
            baseline(
                servo,  # type: ignore[arg-type]
                BaselineModel(motion),
                BaselinePlanner(motion),
                0.1,
                topics,
                clock,
                lambda known: told.append((known, len(servo.targets_m))),
                Pulse(clock),
            )
        )
        await wavering(topics)
        task.cancel()

    run_virtual(run())
    assert [known for known, _ in told] == [False, True]
    moves_before = told[1][1]
    assert moves_before >= 1
    assert set(servo.targets_m[:moves_before]) == {0.1}, "nothing but the first place until it is reached"
    assert min(servo.targets_m[moves_before:]) > 0.1, "then the mission's"
