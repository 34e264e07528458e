"""A vehicle that the doctor says not to fly is not flown, and a part that never worked is missing, not broken."""

from __future__ import annotations

import pytest

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.config.vehicle import NoServoConfig, SerialServoConfig
from morpheyes_daemon.doctor.findings import Severity
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.supervisor.alarms import ALARMS
from tests.safety.noisy_daemon import NoisyDaemon
from tests.unit.doctor.test_doctor_parameters import BAD

DANGEROUS = [
    (*changes.popitem(), finding)
    for changes, finding, severity in ((dict(changes), finding, severity) for changes, finding, severity in BAD)
    if severity is Severity.STOP and len(changes) == 1
]
"""Every single parameter that the doctor says not to fly with, beside what it is called."""


@pytest.mark.parametrize(("name", "bad", "finding"), DANGEROUS, ids=[f"{row[0]}={row[1]}" for row in DANGEROUS])
def test_a_dangerous_parameter_keeps_it_from_standing_by(name: str, bad: float, finding: str) -> None:
    async def life() -> None:
        async with NoisyDaemon(NoServoConfig(backend="none")) as noisy:
            monitor, connection = noisy.daemon.monitor, noisy.daemon.connection
            await noisy.pass_time(0.5)
            assert monitor.missing is None
            assert monitor.state is State.STANDBY
            good = connection.parameters.values[name]
            await connection.set_parameter(name, bad)
            await noisy.pass_time(0.5)
            assert monitor.state is State.PREFLIGHT
            assert monitor.reason is Reason.DOCTOR_SAYS_NO
            said = [event.text for event in noisy.events if event.reason is Reason.DOCTOR_SAYS_NO]
            assert [text for text in said if text.startswith(finding)]
            await connection.set_parameter(name, good)
            await noisy.pass_time(0.5)
            assert monitor.state is State.STANDBY

    run_virtual(life())


def test_a_servo_that_never_answered_is_waited_for_in_preflight() -> None:
    async def life() -> None:
        async with NoisyDaemon(SerialServoConfig(backend="serial", url="memory:servo")) as noisy:
            monitor = noisy.daemon.monitor
            for _ in range(20):
                await noisy.pass_time(0.5)
            assert monitor.missing is Reason.SERVO_LOST
            assert monitor.state is State.PREFLIGHT
            assert State.FAULT not in noisy.states

    run_virtual(life())


@pytest.mark.parametrize("trouble", [Reason.BASELINE_STALE, Reason.SERVO_LOST])
def test_nobody_engages_while_the_servo_is_in_trouble(trouble: Reason) -> None:
    async def life() -> None:
        async with NoisyDaemon(NoServoConfig(backend="none")) as noisy:
            monitor = noisy.daemon.monitor
            await noisy.pass_time(0.5)
            assert monitor.state is State.STANDBY
            for reason, state in ((trouble, State.PREFLIGHT), (Reason.RECOVERED, State.STANDBY)):
                noisy.daemon.events.publish(Event(noisy.clock.now_ns(), "servo", reason))
                await noisy.pass_time(0.1)
                assert monitor.state is state
                assert monitor.missing is (trouble if state is State.PREFLIGHT else None)

    run_virtual(life())


@pytest.mark.parametrize("reason", sorted(ALARMS))
def test_what_devices_and_images_tell_stops_a_flight_on_the_spot(reason: Reason) -> None:
    async def life() -> None:
        async with NoisyDaemon(NoServoConfig(backend="none")) as noisy:
            monitor = noisy.daemon.monitor
            await noisy.pass_time(0.5)
            monitor.machine.state = State.ENGAGED
            noisy.daemon.events.publish(Event(noisy.clock.now_ns(), "somebody", reason))
            assert monitor.state is State.BRAKING
            assert monitor.reason is reason
            assert noisy.overrides[-1] == (1500, 1500, 1500, 1500), "neutral on the spot"

    run_virtual(life())
