"""The page in a real browser: shows state, strips and images, asks nobody outside, says when it hears nothing."""

import asyncio
import shutil
from collections.abc import AsyncIterator

import pytest
from aiohttp.test_utils import TestServer

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.dashboard.server import Dashboard
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Health, State
from tests.support.hand_clock import HandClock
from tests.support.synthetic_flight import SyntheticFlight

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
PHONE = {"width": 390, "height": 844}
playwright = pytest.importorskip("playwright.async_api", reason="playwright is not installed")

expect = playwright.expect
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


@pytest.fixture
async def page() -> AsyncIterator[object]:
    """A phone-sized page of the system's Chromium; a script error or an outside request fails the test."""
    complaints: list[str] = []
    async with playwright.async_playwright() as tools:
        browser = await tools.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = await browser.new_page(viewport=PHONE)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda line: complaints.append(line.text) if line.type == "error" else None)
        page.on("request", lambda request: complaints.append(request.url) if not _ours(request.url) else None)
        yield page
        await browser.close()
    assert [c for c in complaints if "ERR_CONNECTION" not in c and "WebSocket" not in c] == []


def _ours(url: str) -> bool:
    return url.startswith(("http://127.0.0.1:", "blob:http://127.0.0.1:", "data:"))


async def test_the_page_shows_a_flight_and_notices_silence(page) -> None:
    topics, events, clock = Topics.create(), EventLog(), HandClock()
    dashboard = Dashboard(topics, events, clock, {"mission": "forest", "calibration": "5f1e (solved)"})
    async with TestServer(dashboard.application()) as server:
        SyntheticFlight(topics, events, clock).fly(2.0)
        events.publish(Event(clock.t_ns, "camera", Reason.CAMERA_LOST, "<img src=x onerror=alert(1)>"))
        ages = {"frame": 0.1, "command": 4.0}
        report = Health(clock.t_ns, State.ENGAGED, Reason.ENGAGED, None, ages, ages, {"depth": 2}, 0.4, 7.0)
        topics.health.publish(report)
        talking = asyncio.create_task(_talk(dashboard, clock))
        await page.goto(str(server.make_url("/")))
        await expect(page.locator("#state")).to_have_text("engaged")
        await expect(page.locator("#reason")).to_have_text(Reason.ENGAGED.text)
        await expect(page.locator("#left")).to_have_js_property("naturalWidth", 320)
        await expect(page.locator("#depth")).to_have_js_property("naturalWidth", 320)
        await expect(page.locator("#strips canvas")).to_have_count(3)
        assert "5f1e" in await page.inner_text("#identity")
        assert "<img src=x" in await page.inner_text("#events li .fault")
        assert await page.locator("#health tr.old").inner_text() == "command\t4.00 s\t4.0 Hz"
        assert await page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        drawn = await page.evaluate(
            "(() => { const c = document.querySelector('#topview');"
            "return c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(v => v > 0); })()"
        )
        assert drawn
        await page.click("#theme")
        assert await page.evaluate("document.documentElement.dataset.theme") == "dark"
        talking.cancel()
        await expect(page.locator("#state")).to_have_text("no connection")
        await expect(page.locator("body")).to_have_class("stale")


async def _talk(dashboard: Dashboard, clock: HandClock) -> None:
    while True:
        clock.t_ns += 200_000_000
        dashboard.take_snapshot()
        await dashboard._take_images()
        await asyncio.sleep(0.05)  # the browser has its own clock
