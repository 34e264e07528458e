"""A burst on the link: what is dear is done once a second."""

from __future__ import annotations

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.wire.mavlink import Encoder, Identity, dialect
from tests.support.connection_bench import ConnectionBench

VEHICLE = Identity(1, 1)


def test_changing_parameter_is_told_once_a_second() -> None:
    async def story() -> tuple[list[float], float]:
        told: list[float] = []
        async with ConnectionBench() as bench:
            await bench.ready()
            await bench.sleep(1.5)
            bench.connection.parameters.on_change(lambda values: told.append(values["RTL_ALT"]))
            encoder = Encoder()
            assert bench.link is not None
            for i in range(500):
                bench.link.write(
                    encoder.pack(dialect.MAVLink_param_value_message(b"RTL_ALT", float(i), 9, 1, 0), VEHICLE)
                )
            await bench.sleep(2.5)
        return told, told[-1]

    told, last = run_virtual(story())
    assert len(told) == 2
    assert last == 499.0


def test_boot_time_that_goes_to_and_fro_is_one_event_a_second() -> None:
    async def story() -> list[Reason]:
        async with ConnectionBench() as bench:
            await bench.ready()
            encoder = Encoder()
            assert bench.link is not None
            bench.events.clear()
            for i in range(400):
                boot_ms = 10**7 if i % 2 else 1
                bench.link.write(encoder.pack(dialect.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0), VEHICLE))
            await bench.sleep(0.5)
            return bench.reasons

    assert run_virtual(story()).count(Reason.AUTOPILOT_REBOOTED) == 1
