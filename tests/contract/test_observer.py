"""The observer as a process of its own: it writes the log, prints the journal, and its death is told, not felt."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import aiohttp
import pytest

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S, running_clock
from morpheyes_daemon.config.vehicle import DashboardConfig, MissionFile, NoServoConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.errors import DeviceLostError
from morpheyes_daemon.messages.core import Event, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.observer.feed import Feed
from morpheyes_daemon.observer.process import InheritedFile, ObserverJob
from morpheyes_daemon.observer.requests import Request
from morpheyes_daemon.observer.task import ObserverTask
from morpheyes_daemon.recorder.flight_log import flight_header
from morpheyes_daemon.recorder.reader import read_flight
from morpheyes_daemon.supervisor.supervisor import Pulse
from tests.e2e.test_run import free_port

pytestmark = pytest.mark.timeout(120)


class Watched:
    """A daemon's topics and events with an observer; `asked` are the requests that came back."""

    def __init__(self, folder: Path, page: DashboardConfig | None = None) -> None:
        self.topics, self.events, self.clock = Topics.create(), EventLog(), running_clock()
        self.read, write = os.pipe()
        config = VehicleConfig(camera=SimCameraConfig(), servo=NoServoConfig(backend="none"))
        job = ObserverJob(
            log=folder / "flight.mcap",
            header=flight_header("forest", MissionFile(strategy="forest"), config, "", 0.0),
            image_rate_hz=None,
            page=page,
            identity={"mission": "forest"},
            journal=InheritedFile(write),
            began_ns=self.clock.now_ns(),
        )
        self.write = write
        self.asked: list[Request] = []
        self.observer = ObserverTask(job, Feed(self.topics, self.events, self.clock), self.clock, self.asked.append)

    def say(self, text: str) -> None:
        """Publish an event."""
        self.events.publish(Event(self.clock.now_ns(), "test", Reason.RECOVERED, text))

    async def journal(self, wanted: str) -> str:
        """Read the journal until it has a text."""
        text = ""
        while wanted not in text:
            text += (await asyncio.to_thread(os.read, self.read, 1 << 16)).decode()
        return text


@asynccontextmanager
async def watched(folder: Path, page: DashboardConfig | None = None) -> AsyncIterator[Watched]:
    found = Watched(folder, page)
    await found.observer.start()
    running = asyncio.create_task(found.observer.run(Pulse(found.clock)))
    try:
        yield found
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        await found.observer.close()
        os.close(found.write)
        os.close(found.read)


async def test_events_are_printed_and_everything_is_in_the_log(tmp_path: Path) -> None:
    async with watched(tmp_path) as daemon:
        for k in range(50):
            daemon.topics.vehicle.publish(VehicleState(t_ns=k + 1, roll_rad=0.01 * k))
        daemon.say("\x1b[2J hello")
        text = await daemon.journal("hello")
        assert "\x1b" not in text, "no terminal obeys what is printed"
    log = read_flight(tmp_path / "flight.mcap")
    rolls = [state.roll_rad for state in log.values("vehicle")]
    assert rolls == pytest.approx([0.01 * k for k in range(0, 50, 5)]), "thinned as the topic says"
    assert any("hello" in event.text for event in log.values("events"))


async def test_its_death_is_told_and_another_one_goes_on_in_a_log_beside(tmp_path: Path) -> None:
    async with watched(tmp_path) as daemon:
        daemon.say("first")
        await daemon.journal("first")
    found = Watched(tmp_path / "second")
    await found.observer.start()
    task = asyncio.create_task(found.observer.run(Pulse(found.clock)))
    found.say("before")
    await found.journal("before")
    assert found.observer.pid is not None
    os.kill(found.observer.pid, signal.SIGKILL)
    async with asyncio.timeout(10.0):
        while not task.done():
            found.say("still publishing")
            await asyncio.wait({task}, timeout=0.05)
    with pytest.raises(DeviceLostError, match="another one is started"):
        task.result()
    again = asyncio.create_task(found.observer.run(Pulse(found.clock)))
    found.say("after")
    await found.journal("after")
    again.cancel()
    await asyncio.gather(again, return_exceptions=True)
    await found.observer.close()
    os.close(found.write)
    os.close(found.read)
    logs = sorted(path.name for path in (tmp_path / "second").glob("*.mcap"))
    assert "flight-2.mcap" in logs, "the first one may have died before it wrote anything"
    assert any("after" in event.text for event in read_flight(tmp_path / "second" / "flight-2.mcap").values("events"))


async def test_a_stopped_observer_and_a_reader_of_nothing_hold_up_nobody(tmp_path: Path) -> None:
    async with watched(tmp_path) as daemon:
        daemon.say("up")
        await daemon.journal("up")
        assert daemon.observer.pid is not None
        os.kill(daemon.observer.pid, signal.SIGSTOP)
        try:
            longest_ns, end_ns = 0, daemon.clock.now_ns() + 2 * S
            while daemon.clock.now_ns() < end_ns:
                before_ns = daemon.clock.now_ns()
                for _ in range(200):
                    daemon.topics.vehicle.publish(VehicleState(t_ns=before_ns))
                longest_ns = max(longest_ns, daemon.clock.now_ns() - before_ns)
                await asyncio.sleep(0.005)
        finally:
            os.kill(daemon.observer.pid, signal.SIGCONT)
        assert daemon.observer.feed.channel.dropped > 0
        assert daemon.observer.feed.channel.connected


async def test_stop_on_the_page_comes_back_and_foreign_pages_are_refused(tmp_path: Path) -> None:
    port = free_port()
    async with watched(tmp_path, DashboardConfig(enabled=True, port=port)) as daemon:
        url = f"http://127.0.0.1:{port}/api/stop"
        async with aiohttp.ClientSession() as session, asyncio.timeout(30.0):
            while True:
                with suppress(aiohttp.ClientConnectionError):
                    async with session.post(url) as answer:
                        assert answer.status == 403, "without the page's own header"
                        break
                await asyncio.sleep(0.1)
            foreign = {"X-MorphEyes": "stop", "Origin": "http://elsewhere.example"}
            async with session.post(url, headers=foreign) as answer:
                assert answer.status == 403
            async with session.post(url, headers={"X-MorphEyes": "stop"}) as answer:
                assert answer.status == 200
            while not daemon.asked:  # noqa: ASYNC110 -- another process answers
                await asyncio.sleep(0.02)
        assert daemon.asked == [Request.STOP]
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"\x00\xff GET nothing HTTP/9.9\r\n\r\n")
        await writer.drain()
        writer.close()
        daemon.say("end")
        text = await daemon.journal("end")
        assert "Traceback" not in text
