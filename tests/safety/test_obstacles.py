"""Obstacles go to the autopilot at their rate while depth is valid, and not one message longer."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from morpheyes_daemon.bus import Topics
from morpheyes_daemon.clock import S, run_virtual, running_clock
from morpheyes_daemon.messages.core import DepthSummary, FloatMap, Perception
from morpheyes_daemon.safety.gate import Gate
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.supervisor.supervisor import Pulse
from morpheyes_daemon.tasks.obstacles import RATE_HZ, obstacles


class Output:
    """What the autopilot would hear, and when."""

    def __init__(self, now_ns: Any) -> None:
        self._now_ns = now_ns
        self.sent: list[tuple[int, float]] = []

    def send_obstacle_distance(self, sectors_m: FloatMap, h_fov_rad: float, max_m: float) -> None:
        self.sent.append((self._now_ns(), float(sectors_m[0])))


def seen(nearest_m: float) -> Perception:
    summary = cast(DepthSummary, SimpleNamespace(h_fov_rad=0.8))
    return Perception(summary, None, np.full(72, nearest_m, np.float32))


def told(valid_s: float, seconds: float) -> list[tuple[float, float]]:
    """Publish one depth whose lease lasts `valid_s`; return (seconds, nearest) of each message."""

    async def live() -> list[tuple[float, float]]:
        clock, topics, gate = running_clock(), Topics.create(), Gate(lambda out: None)
        output, began_ns = Output(clock.now_ns), clock.now_ns()
        task = asyncio.create_task(obstacles(output, topics, gate, clock, Pulse(clock)))
        await clock.sleep_until_ns(began_ns + S // 2)
        assert output.sent == [], "nothing is known yet"
        topics.perception.publish(seen(3.0))
        gate.renew(Lease.DEPTH, clock.now_ns() + round(valid_s * S))
        from_ns = clock.now_ns()
        await clock.sleep_until_ns(from_ns + round(seconds * S))
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return [((t_ns - from_ns) / S, nearest) for t_ns, nearest in output.sent]

    return run_virtual(live())


def test_they_are_repeated_at_their_rate_while_depth_is_valid() -> None:
    messages = told(valid_s=5.0, seconds=2.0)
    assert len(messages) == pytest.approx(2.0 * RATE_HZ, abs=1)
    assert {nearest for _, nearest in messages} == {3.0}
    assert RATE_HZ >= 10.0


def test_they_end_with_the_depth_lease() -> None:
    messages = told(valid_s=0.7, seconds=3.0)
    assert messages
    assert max(t_s for t_s, _ in messages) < 0.7


def test_without_a_lease_there_are_none() -> None:
    assert told(valid_s=0.0, seconds=1.0) == []
