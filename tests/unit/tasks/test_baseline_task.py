"""The baseline task: the eyes first go where they are known to be, and only then where the mission wants them."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import pytest

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import S, run_virtual, running_clock
from morpheyes_daemon.config.vehicle import ServoMotion
from morpheyes_daemon.control.baseline import BaselineModel
from morpheyes_daemon.control.baseline_planner import BaselinePlanner
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.core import Intent, MissionCommand
from morpheyes_daemon.supervisor.supervisor import Pulse
from morpheyes_daemon.tasks.baseline import BaselineTask


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


class SlowServo(ListeningServo):
    """Takes a while over the targets after the first, and notes where the model has the eyes meanwhile."""

    def __init__(self, model: BaselineModel, *, dies: bool = False) -> None:
        super().__init__()
        self.model, self.dies = model, dies
        self.unacknowledged: list[tuple[float, float, float]] = []

    async def move(self, target_m: float) -> None:
        """Take the target at once, acknowledge it late or never."""
        await super().move(target_m)
        if target_m == self.targets_m[0]:
            return
        clock = running_clock()
        await clock.sleep_until_ns(clock.now_ns() + 4 * S)
        self.unacknowledged.append((target_m, *interval_m(self.model, clock.now_ns())))
        if self.dies:
            raise DeviceError("servo: no acknowledgement.")


def interval_m(model: BaselineModel, t_ns: int) -> tuple[float, float]:
    """The edges between which the model has the true baseline."""
    here = model.at(t_ns)
    half_m = math.sqrt(3) * here.sigma_m
    return here.baseline_m - half_m, here.baseline_m + half_m


def moved_by(servo: ListeningServo, model: BaselineModel, told: Callable[[bool], None]) -> None:
    """Run the task for twenty seconds under a wavering mission."""
    motion, topics = ServoMotion(), Topics.create()

    async def run() -> None:
        clock = running_clock()
        work = BaselineTask(servo, model, BaselinePlanner(motion), 0.1, topics, clock, told)
        task = asyncio.create_task(work.run(Pulse(clock)))
        await wavering(topics)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(run())


@pytest.mark.parametrize("dies", [False, True], ids=["late", "never"])
def test_until_a_target_is_acknowledged_the_eyes_may_be_on_the_way_or_not(dies: bool) -> None:
    model = BaselineModel(ServoMotion())
    servo = SlowServo(model, dies=dies)
    moved_by(servo, model, lambda known: None)
    target_m, low_m, high_m = servo.unacknowledged[0]
    assert low_m < 0.101, "the target may not have arrived"
    assert high_m > target_m - 0.001, "or it may long have been reached"
    if dies:
        assert interval_m(model, 20 * S)[0] < 0.101, "and nothing is learned afterwards"


def test_a_wavering_mission_is_followed_once_the_eyes_are_known_to_be_at_the_first_place() -> None:
    servo = ListeningServo()
    told: list[tuple[bool, int]] = []
    moved_by(servo, BaselineModel(ServoMotion()), lambda known: told.append((known, len(servo.targets_m))))
    assert [known for known, _ in told] == [False, True]
    moves_before = told[1][1]
    assert moves_before >= 1
    assert set(servo.targets_m[:moves_before]) == {0.1}, "nothing but the first place until it is reached"
    assert min(servo.targets_m[moves_before:]) > 0.1, "then the mission's"
