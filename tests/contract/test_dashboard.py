"""The page shows what is, commands nothing, and neither garbage nor a slow browser touches the daemon."""

import asyncio
import json
import re
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from aiohttp import ClientSession, WSMsgType, WSServerHandshakeError
from aiohttp.test_utils import TestClient, TestServer, unused_port

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import MonotonicClock, S
from morpheyes_daemon.config.vehicle import DashboardConfig
from morpheyes_daemon.dashboard import server
from morpheyes_daemon.dashboard.server import CLIENTS, PAGES, Dashboard
from morpheyes_daemon.dashboard.snapshot import STRIPS
from morpheyes_daemon.errors import DeviceNotFoundError
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Health, State
from tests.support.hand_clock import HandClock
from tests.support.synthetic_flight import SyntheticFlight


class Bench:
    """A dashboard over made-up topics, served on a free port of the loopback."""

    def __init__(self) -> None:
        self.topics, self.events, self.clock = Topics.create(), EventLog(), HandClock()
        self.dashboard = Dashboard(self.topics, self.events, self.clock, {"mission": "forest", "calibration": "5f1e"})
        self.flight = SyntheticFlight(self.topics, self.events, self.clock)

    def fly(self, seconds: float = 1.0) -> None:
        self.flight.fly(seconds)
        t = self.clock.t_ns
        report = Health(
            t, State.ENGAGED, Reason.ENGAGED, None, {"frame": float("nan")}, {"frame": 5.0}, {"depth": 1}, 0.4, 7.0
        )
        self.topics.health.publish(report)

    async def show(self) -> None:
        self.dashboard.take_snapshot()
        await self.dashboard._take_images()
        await asyncio.sleep(0)


@asynccontextmanager
async def served(bench: Bench) -> AsyncIterator[TestClient[Any, Any]]:
    async with TestClient(TestServer(bench.dashboard.application())) as client:
        yield client


async def received(socket: Any, wanted: str) -> Any:
    """The first JSON message that has `wanted`."""
    while True:
        message = await asyncio.wait_for(socket.receive(), 20)
        assert message.type in (WSMsgType.TEXT, WSMsgType.BINARY), message
        if message.type is WSMsgType.TEXT and wanted in (content := json.loads(message.data)):
            return content[wanted]


async def test_a_page_hears_the_past_and_then_the_present() -> None:
    bench = Bench()
    bench.fly()
    bench.dashboard.take_snapshot()
    async with served(bench) as client, client.ws_connect("/ws") as socket:
        hello = await received(socket, "hello")
        assert hello["identity"] == {"mission": "forest", "calibration": "5f1e"}
        assert tuple(hello["columns"]) == STRIPS
        assert len(hello["rows"]) == 1
        bench.fly()
        await bench.show()
        shown = await received(socket, "snapshot")
    assert shown["state"] == "engaged"
    assert shown["reason"]["text"] == Reason.ENGAGED.text
    assert shown["baseline"]["baseline_mm"] == pytest.approx(1e3 * bench.topics.baseline.get().baseline_m, abs=0.1)
    assert shown["health"]["ages_s"] == {"frame": None}
    assert shown["depth"]["calibration_hash"] == "5f1e"
    assert len(shown["depth"]["sectors_m"]) == 72


async def test_events_arrive_once_each_and_in_order() -> None:
    bench = Bench()
    bench.events.publish(Event(bench.clock.t_ns, "safety", Reason.READY))
    async with served(bench) as client, client.ws_connect("/ws") as socket:
        first = await received(socket, "events")
        for reason in (Reason.ENGAGED, Reason.CAMERA_LOST):
            bench.events.publish(Event(bench.clock.t_ns + S, "test", reason, "<b>x</b>"))
        await bench.show()
        later = await received(socket, "events")
    assert [event["code"] for event in first] == ["ready"]
    assert [event["code"] for event in later] == ["engaged", "camera_lost"]
    assert [event["fault"] for event in later] == [False, True]


async def test_images_come_as_jpeg_and_only_while_somebody_looks() -> None:
    bench = Bench()
    bench.fly()
    await bench.show()
    assert bench.dashboard._images.count == 0
    async with served(bench) as client, client.ws_connect("/ws") as socket:
        await received(socket, "hello")
        kinds = {}
        await bench.show()
        while len(kinds) < 2:
            message = await asyncio.wait_for(socket.receive(), 20)
            if message.type is WSMsgType.BINARY:
                kinds[message.data[:1]] = message.data[1:4]
        await bench.show()
        assert bench.dashboard._images.count == 1  # not twice within the period
    assert kinds == {b"L": b"\xff\xd8\xff", b"D": b"\xff\xd8\xff"}


async def test_a_daemon_that_has_nothing_yet_is_shown_too() -> None:
    bench = Bench()
    async with served(bench) as client:
        state = await (await client.get("/api/state")).json()
        assert state["state"] is None
        assert state["vehicle"] is None
        async with client.ws_connect("/ws") as socket:
            await received(socket, "hello")
            await bench.show()
            assert (await received(socket, "snapshot"))["depth"] is None


@pytest.mark.parametrize("path", ["/", "/ws", "/api/state", "/pages/page.js", "/engage"])
async def test_nothing_can_be_commanded(path: str) -> None:
    async with served(Bench()) as client:
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            answer = await client.request(method, path, data=b"engage")
            assert answer.status in (404, 405), (method, path)


async def test_garbage_from_a_client_is_ignored_and_others_go_on() -> None:
    bench = Bench()
    bench.fly()
    async with served(bench) as client, client.ws_connect("/ws") as good, client.ws_connect("/ws") as bad:
        await received(good, "hello")
        for garbage in ("{", "engage", "\x00" * 3000):
            await bad.send_str(garbage)
        await bad.send_bytes(b"\xff" * 4000)
        await bench.show()
        assert await received(bad, "snapshot")
        await bad.send_str("x" * 100_000)
        await bench.show()
        assert await received(good, "snapshot")
        reader, writer = await asyncio.open_connection(client.host, client.port)
        writer.write(b"\x16\x03\x01 not http at all\r\n\r\n" * 50)
        await writer.drain()
        await reader.read(1000)
        writer.close()
        await bench.show()
        assert await received(good, "snapshot")


async def test_too_many_pages_are_refused_with_a_sentence() -> None:
    bench = Bench()
    async with served(bench) as client:
        sockets = [await client.ws_connect("/ws") for _ in range(CLIENTS)]
        answer = await client.get("/ws")
        assert answer.status == 503
        assert "close one" in await answer.text()
        await sockets[0].close()
        await asyncio.sleep(0)
        async with client.ws_connect("/ws") as socket:
            await received(socket, "hello")
        for socket in sockets[1:]:
            await socket.close()


async def test_a_foreign_page_may_not_look() -> None:
    async with served(Bench()) as client:
        with pytest.raises(WSServerHandshakeError) as refused:
            await client.ws_connect("/ws", headers={"Origin": "http://evil.example"})
        assert refused.value.status == 403
        origin = f"http://{client.host}:{client.port}"
        async with client.ws_connect("/ws", headers={"Origin": origin}) as socket:
            await received(socket, "hello")


async def test_a_client_that_stops_reading_is_dropped_and_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "SEND_TIMEOUT_S", 0.05)
    bench = Bench()
    bench.fly()
    async with served(bench) as client:
        reader, writer = await asyncio.open_connection(client.host, client.port, limit=1024)
        writer.write(
            f"GET /ws HTTP/1.1\r\nHost: {client.host}:{client.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
        )
        await reader.readline()
        assert bench.dashboard.clients == 1
        rounds = 0
        while bench.dashboard.clients and rounds < 100_000:
            bench.dashboard._shown.publish("y" * 100_000)
            await asyncio.sleep(0)
            rounds += 1
        assert bench.dashboard.clients == 0
        writer.close()


async def test_a_taken_port_is_a_sentence() -> None:
    bench = Bench()
    async with served(bench) as client:
        with pytest.raises(DeviceNotFoundError, match=f"127.0.0.1:{client.port}"):
            await bench.dashboard.run(DashboardConfig(port=client.port))


async def test_it_serves_until_cancelled_and_lets_its_port_go() -> None:
    topics, events = Topics.create(), EventLog()
    dashboard = Dashboard(topics, events, MonotonicClock(), {})
    port = unused_port()
    running = asyncio.create_task(dashboard.run(DashboardConfig(port=port)))
    async with ClientSession() as session:
        while True:
            try:
                async with session.ws_connect(f"http://127.0.0.1:{port}/ws") as socket:
                    assert await received(socket, "snapshot")
                    running.cancel()
                    closed = await asyncio.wait_for(_closed(socket), 20)
                    assert closed
                break
            except OSError:
                await asyncio.sleep(0)
    with pytest.raises(asyncio.CancelledError):
        await running
    (await asyncio.start_server(lambda r, w: None, "127.0.0.1", port)).close()


async def _closed(socket: Any) -> bool:
    async for _ in socket:
        pass
    return bool(socket.closed)


def _own_pages() -> Iterator[Path]:
    return (path for path in PAGES.iterdir() if path.is_file())


def test_no_page_asks_for_anything_outside() -> None:
    for path in _own_pages():
        for address in re.findall(r"(?:https?:)?//[\w.-]+\.\w+", path.read_text()):
            assert address == "http://www.w3.org", f"{path.name}: {address}"  # the name of SVG, never fetched


def test_the_vendored_plotter_keeps_its_licence() -> None:
    assert "MIT License" in (PAGES / "uplot" / "LICENSE").read_text()
    assert "v1.6." in (PAGES / "uplot" / "uPlot.iife.min.js").read_text()[:200]


async def test_headers_shut_the_page_in() -> None:
    async with served(Bench()) as client:
        for path in ("/", "/pages/page.js", "/api/state"):
            answer = await client.get(path)
            assert answer.status == 200
            assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        assert (await client.get("/pages/../server.py")).status == 404
        assert (await client.get("/pages/%2e%2e/server.py")).status in (403, 404)
