"""A vehicle that the doctor says not to fly is not flown, and a part that never worked is missing, not broken."""

from __future__ import annotations

import pytest

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.config import NoServoConfig, SerialServoConfig
from morpheyes_daemon.reasons import Reason
from morpheyes_daemon.safety.states import State
from tests.noisy_daemon import NoisyDaemon


@pytest.mark.parametrize(("name", "bad", "finding"), [
    ("FS_THR_ENABLE", 0.0, "throttle-failsafe-off"),
    ("RC_OVERRIDE_TIME", -1.0, "override-time-off"),
])
def test_a_dangerous_parameter_keeps_it_from_standing_by(name: str, bad: float, finding: str) -> None:
    async def life() -> None:
        async with NoisyDaemon(NoServoConfig(backend="none")) as noisy:
            guardian, hub = noisy.daemon.guardian, noisy.daemon.hub
            await noisy.pass_time(0.5)
            assert guardian.missing is None
            assert guardian.state is State.STANDBY
            good = hub.parameters.values[name]
            await hub.set_parameter(name, bad)
            await noisy.pass_time(0.5)
            assert guardian.state is State.PREFLIGHT
            assert guardian.reason is Reason.DOCTOR_SAYS_NO
            said = [event.text for event in noisy.events if event.reason is Reason.DOCTOR_SAYS_NO]
            assert [text for text in said if text.startswith(finding)]
            await hub.set_parameter(name, good)
            await noisy.pass_time(0.5)
            assert guardian.state is State.STANDBY

    run_virtual(life())


def test_a_servo_that_never_answered_is_waited_for_in_preflight() -> None:
    async def life() -> None:
        async with NoisyDaemon(SerialServoConfig(backend="serial", url="memory:servo")) as noisy:
            guardian = noisy.daemon.guardian
            for _ in range(20):
                await noisy.pass_time(0.5)
            assert guardian.missing is Reason.SERVO_LOST
            assert guardian.state is State.PREFLIGHT
            assert State.FAULT not in noisy.states

    run_virtual(life())
