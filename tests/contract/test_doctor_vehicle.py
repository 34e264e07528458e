"""The doctor on the autopilot twin over MAVLink: bad parameters found and remedied by the file, states, take-over."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from morpheyes_daemon.clock import run_virtual
from morpheyes_daemon.config.vehicle import AutopilotConfig, NoServoConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.devices.autopilot.parameters import parameter_file
from morpheyes_daemon.devices.link import Link, OnBytes, OnLost
from morpheyes_daemon.doctor.findings import Finding, Severity, Verdict, remedies, verdict
from morpheyes_daemon.doctor.takeover import HandOver, TakeoverTest
from morpheyes_daemon.doctor.vehicle import VehicleExamination
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.parameters import RECOMMENDED
from tests.support.connection_bench import ConnectionBench
from tests.unit.doctor.test_doctor_parameters import BAD


def config(**autopilot: object) -> VehicleConfig:
    return VehicleConfig(
        camera=SimCameraConfig(),
        servo=NoServoConfig(backend="none"),
        autopilot=AutopilotConfig(**autopilot),
    )


async def examine(bench: ConnectionBench, **autopilot: object) -> list[Finding]:
    async with VehicleExamination(config(**autopilot), bench.clock, bench.open) as vehicle:
        return await vehicle.examine()


def on_bench(story: Callable[[ConnectionBench], Awaitable[None]], parameters: dict[str, float] | None = None) -> None:
    async def tell() -> None:
        async with ConnectionBench({**RECOMMENDED, **(parameters or {})}, run_hub=False) as bench:
            await bench.sleep(3.0)
            await story(bench)

    run_virtual(tell())


def ids(findings: list[Finding]) -> set[str]:
    return {finding.id for finding in findings}


def test_recommended_vehicle_may_fly() -> None:
    async def story(bench: ConnectionBench) -> None:
        findings = await examine(bench)
        assert verdict(findings) is Verdict.FLY, findings

    on_bench(story)


def batches() -> list[dict[str, float]]:
    """All bad parameters in as few sets as their names allow; the unit tests have each alone."""
    merged: list[dict[str, float]] = []
    for changes, _, _ in BAD:
        for batch in merged:
            if not batch.keys() & changes.keys():
                batch |= changes
                break
        else:
            merged.append(dict(changes))
    return merged


def expected(batch: dict[str, float]) -> set[str]:
    return {name for changes, name, _ in BAD if changes.items() <= batch.items()}


@pytest.mark.parametrize("batch", batches())
def test_bad_parameters_are_found_and_the_file_remedies_them(batch: dict[str, float], tmp_path: Path) -> None:
    async def story(bench: ConnectionBench) -> None:
        findings = await examine(bench)
        assert expected(batch) <= ids(findings)
        file = tmp_path / "remedy.parm"
        file.write_text(parameter_file(remedies(findings), "why"))
        for line in file.read_text().splitlines():
            if not line.startswith("#"):
                parameter, value = line.split(",")
                assert bench.twin.parameters.set(parameter, float(value))
        assert not expected(batch) & ids(await examine(bench))

    on_bench(story, batch)


def test_nobody_there() -> None:
    async def story(bench: ConnectionBench) -> None:
        bench.plugged = False
        [finding] = await examine(bench, url="serial:/dev/nothing")
        assert finding.id == "autopilot-missing"
        assert "unplugged" in finding.evidence

    on_bench(story)


def test_states_of_the_vehicle() -> None:
    async def story(bench: ConnectionBench) -> None:
        bench.twin.radio.switch(on=True)
        bench.twin.battery_low(0.1)
        bench.twin.lose_flow()
        await bench.sleep(2.0)
        found = {finding.id: finding for finding in await examine(bench)}
        assert found["battery-low"].severity is Severity.STOP
        assert "10%" in found["battery-low"].evidence
        assert "RC channel 7" in found["switch-on"].evidence
        assert "fix is of type 1" in found["no-position-yet"].evidence

    on_bench(story)


def test_radio_without_the_switch_channel() -> None:
    async def story(bench: ConnectionBench) -> None:
        bench.twin.radio.set(7, 0)
        await bench.sleep(0.5)
        assert "no-switch" in ids(await examine(bench))

    on_bench(story)


def test_slow_link_is_noticed() -> None:
    async def story(bench: ConnectionBench) -> None:
        async def thin(url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
            count = 0

            def pass_some(data: bytes) -> None:
                nonlocal count
                count += 1
                if data[7] not in (30, 65) or count % 3 == 0:
                    on_bytes(data)

            return await bench.open(url, pass_some, on_lost)

        async with VehicleExamination(config(), bench.clock, thin) as vehicle:
            findings = await vehicle.examine()
        slow = [finding for finding in findings if finding.id == "link-slow"]
        assert any("attitude" in finding.evidence for finding in slow)

    on_bench(story)


class Pilot:
    """Does what the take-over test says, a moment later and in its order."""

    def __init__(self, bench: ConnectionBench) -> None:
        self._bench = bench
        self.read: list[str] = []
        self._heard: deque[str] = deque()
        self.obeys = 99

    def say(self, text: str) -> None:
        self.read.append(text)
        self._heard.append(text)
        asyncio.get_running_loop().call_later(0.7, self._act)

    def _act(self) -> None:
        text = self._heard.popleft()
        self.obeys -= 1
        if self.obeys < 0:
            return
        if "switch" in text and "mode" not in text:
            self._bench.twin.radio.switch(on="on:" in text)
        elif "mode" in text:
            self._bench.twin.set_mode(Mode.ALT_HOLD)


async def take_over(bench: ConnectionBench, pilot: Pilot, **autopilot: object) -> tuple[list[HandOver], list[Finding]]:
    settings = config(**autopilot)
    async with VehicleExamination(settings, bench.clock, bench.open) as vehicle:
        await vehicle.wait(lambda: vehicle.connection.parameters.complete, 10.0)
        output = vehicle.connection.claim_stick_output()
        result = await TakeoverTest(vehicle.connection, output, settings.autopilot, bench.clock, pilot.say).run()
        await bench.sleep(0.05)  # the last release is still on its way
        return result


def test_takeover_is_measured_both_ways() -> None:
    async def story(bench: ConnectionBench) -> None:
        pilot = Pilot(bench)
        times, findings = await take_over(bench, pilot)
        assert findings == []
        assert [each.way for each in times] == ["switch", "mode"]
        # one frame of the link there and back, one period of RC_CHANNELS at 20 Hz
        assert all(0.0 < each.seconds < 0.1 for each in times)
        assert bench.sent_of("RC_CHANNELS_OVERRIDE")[-1].chan1_raw == 0
        assert any("ms" in text for text in pilot.read)
        rolls = {m.chan3_raw for m in bench.sent_of("RC_CHANNELS_OVERRIDE")}
        assert rolls == {0, 1000}  # throttle low or released, never anything else

    on_bench(story)


def test_pilot_who_does_nothing_leaves_a_finding_and_a_release() -> None:
    async def story(bench: ConnectionBench) -> None:
        pilot = Pilot(bench)
        pilot.obeys = 0
        times, [finding] = await take_over(bench, pilot)
        assert times == []
        assert finding.id == "takeover-failed"
        assert "switch was not seen on" in finding.evidence
        assert bench.sent_of("RC_CHANNELS_OVERRIDE")[-1].chan1_raw == 0

    on_bench(story)


def test_overrides_that_are_ignored_fail_the_takeover_test() -> None:
    async def story(bench: ConnectionBench) -> None:
        _, [finding] = await take_over(bench, Pilot(bench), override_sysid=9)
        assert "do not come back" in finding.evidence

    on_bench(story)


@pytest.mark.parametrize("obeyed", [0, 2])
def test_armed_vehicle_ends_the_takeover_test_at_once(obeyed: int) -> None:
    async def story(bench: ConnectionBench) -> None:
        pilot = Pilot(bench)
        pilot.obeys = obeyed
        running = asyncio.create_task(take_over(bench, pilot))
        await bench.sleep(8.0)
        assert bool(bench.sent_of("RC_CHANNELS_OVERRIDE")) == (obeyed == 2)
        assert bench.twin.autopilot.arm() is None
        took = await bench.until(running.done)
        assert took < 0.3  # a heartbeat every 0.1 s
        _, [finding] = await running
        assert "armed" in finding.evidence
        assert bench.sent_of("RC_CHANNELS_OVERRIDE")[-1].chan1_raw == 0

    on_bench(story)
