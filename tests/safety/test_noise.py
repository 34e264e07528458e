"""Noise on either link: nothing is raised past the boundary, the daemon lives on, and no stick moves."""

from __future__ import annotations

import random

import pytest

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.config.vehicle import NoServoConfig, SerialServoConfig, ServoConfig
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from tests.safety.noisy_daemon import (
    STRANGER,
    Noise,
    NoisyDaemon,
    damaged,
    mavlink_frame,
    parameter_frame,
    pure,
    servo_body,
    servo_frame,
    stream,
)

LINKS: dict[str, tuple[Noise, ...]] = {
    "autopilot": (
        pure,
        mavlink_frame,
        mavlink_frame,
        lambda rng: mavlink_frame(rng, STRANGER),
        damaged(mavlink_frame),
        parameter_frame,
    ),
    "servo": (pure, servo_frame, servo_body, damaged(servo_frame)),
}


SERVOS: dict[str, ServoConfig] = {
    "autopilot": NoServoConfig(backend="none"),
    "servo": SerialServoConfig(backend="serial", url="memory:servo"),
}


async def pour(link: str, total: int, seed: int) -> NoisyDaemon:
    """Pour `total` bytes into one link, about a kilobyte per 20 ms, and return the daemon that lived through it."""
    async with NoisyDaemon(SERVOS[link]) as noisy:
        for data in stream(LINKS[link], random.Random(f"{link} {seed}"), total):
            noisy.hear(link, data)
            await noisy.pass_time(0.01)
        await noisy.pass_time(0.1)
        assert {widths for widths in noisy.overrides} <= {(0, 0, 0, 0)}, "a stick was moved"
        assert not [event for event in noisy.events if event.reason is Reason.TASK_DIED]
    return noisy


def test_noise_on_the_autopilots_link_moves_no_stick() -> None:
    noisy = run_virtual(pour("autopilot", 100_000, seed=1))
    assert noisy.states[State.STANDBY] > 10, "it was ready to fly for some of the time"
    assert noisy.states[State.ENGAGED] == 0


def test_noise_on_the_servos_link_harms_nobody() -> None:
    noisy = run_virtual(pour("servo", 100_000, seed=1))
    assert noisy.states[State.ENGAGED] == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("link", LINKS)
def test_ten_million_bytes_of_noise_on_each_link(link: str, seed: int) -> None:
    run_virtual(pour(link, 1_000_000, seed=100 + seed))
