"""The page to watch: state, images, strips and health in a browser, over one WebSocket.

It reads topics and never commands; the one thing that may be asked is a stop. A client that cannot keep up gets fewer
snapshots, one that stops reading is dropped; nothing waits for either.
"""

from __future__ import annotations

import asyncio
import json
from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from aiohttp import WSCloseCode, web

from morpheyes_daemon.bus import EventLog, Latest, Topics
from morpheyes_daemon.clock import Clock, S, Ticker
from morpheyes_daemon.config.vehicle import DashboardConfig
from morpheyes_daemon.dashboard.connections import IDLE_S, limited
from morpheyes_daemon.dashboard.snapshot import STRIPS, event_row, snapshot, strip_row
from morpheyes_daemon.errors import DeviceNotFoundError
from morpheyes_daemon.messages.core import Event, Image, Perception
from morpheyes_daemon.stereo.colours import colour_depth

PAGES = Path(__file__).parent / "pages"
RATE_HZ = 5.0
IMAGE_PERIOD_NS = S // 2
HISTORY_S = 60.0
EVENTS_KEPT = 200
CLIENTS = 8
SEND_TIMEOUT_S = 3.0
LARGEST_MESSAGE = 4096
MOST_MESSAGES = 100
"""Messages of a client that are read and thrown away; the page sends none."""
JPEG_QUALITY = 75
LEFT, DEPTH = b"L", b"D"
"""First byte of a binary message: which image follows as JPEG."""

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Dashboard:
    """Serves the page. `identity` is shown as it is: mission, version, calibration."""

    def __init__(self, topics: Topics, events: EventLog, clock: Clock, identity: Mapping[str, str]) -> None:
        self._topics = topics
        self._clock = clock
        self._identity = dict(identity)
        self._start_ns = clock.now_ns()
        self._shown: Latest[str] = Latest("snapshot")
        self._images: Latest[tuple[bytes, bytes]] = Latest("images")
        self._strips: deque[list[float | None]] = deque(maxlen=round(HISTORY_S * RATE_HZ))
        self._events: deque[tuple[int, Event]] = deque(maxlen=EVENTS_KEPT)
        self._event_count = 0
        self._clients: set[web.WebSocketResponse] = set()
        self._next_image_ns = 0
        self._connections: Counter[str] = Counter()
        self.on_stop: Callable[[], bool] = lambda: False
        events.subscribe(self._keep_event)

    @property
    def clients(self) -> int:
        """Browsers connected now."""
        return len(self._clients)

    def application(self) -> web.Application:
        """Return the aiohttp application; its clean-up closes every client."""
        app = web.Application(client_max_size=LARGEST_MESSAGE)
        app.router.add_get("/", self._page)
        app.router.add_get("/ws", self._socket)
        app.router.add_get("/api/state", self._state)
        app.router.add_post("/api/stop", self._stop)
        app.router.add_static("/pages", PAGES)
        app.on_response_prepare.append(_add_headers)
        app.on_shutdown.append(self._close_clients)
        return app

    async def run(self, config: DashboardConfig) -> None:
        """Serve until cancelled; raises DeviceNotFoundError when the address is taken."""
        runner = web.AppRunner(self.application(), access_log=None, shutdown_timeout=1.0, keepalive_timeout=IDLE_S)
        await runner.setup()
        assert runner.server is not None
        listening = None
        try:
            listening = await asyncio.get_running_loop().create_server(
                limited(runner.server, self._connections), config.host, config.port
            )
            await self.watch()
        except OSError as error:
            where = f"{config.host}:{config.port}"
            raise DeviceNotFoundError(f"the dashboard cannot listen on {where} ({error.strerror}).") from None
        finally:
            if listening is not None:
                listening.close()
            await runner.cleanup()

    async def watch(self) -> None:
        """Take a snapshot five times a second and, while somebody looks, new images twice a second."""
        ticker = Ticker(self._clock, RATE_HZ)
        while True:
            self.take_snapshot()
            await self._take_images()
            await ticker.wait()

    def take_snapshot(self) -> None:
        """Publish the present moment to every client."""
        shown = snapshot(self._topics, self._clock.now_ns(), self._start_ns)
        row = strip_row(shown)
        self._strips.append(row)
        self._shown.publish(json.dumps({"snapshot": shown, "row": row}, allow_nan=False))

    async def _take_images(self) -> None:
        seen = self._topics.perception.get()
        if not self._clients or seen is None or seen.left_rect is None or self._clock.now_ns() < self._next_image_ns:
            return
        self._next_image_ns = self._clock.now_ns() + IMAGE_PERIOD_NS
        self._images.publish(await asyncio.get_running_loop().run_in_executor(None, _jpegs, seen))

    def _keep_event(self, event: Event) -> None:
        self._event_count += 1
        self._events.append((self._event_count, event))

    def _events_after(self, seen: int) -> list[dict[str, Any]]:
        return [event_row(event, self._start_ns) for count, event in self._events if count > seen]

    # -- routes -------------------------------------------------------------------------------------------------

    async def _page(self, request: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGES / "index.html")

    async def _state(self, request: web.Request) -> web.Response:
        shown = snapshot(self._topics, self._clock.now_ns(), self._start_ns)
        return web.json_response({"identity": self._identity, **shown, "events": self._events_after(0)})

    async def _stop(self, request: web.Request) -> web.Response:
        """Ask the safety monitor to brake. Only the page itself may: a foreign page cannot set the header."""
        if not _same_origin(request) or request.headers.get("X-MorphEyes") != "stop":
            raise web.HTTPForbidden(text="only this daemon's own page may ask for a stop.")
        if not self.on_stop():
            raise web.HTTPServiceUnavailable(text="the flight process does not take the request.")
        return web.json_response({"asked": True})

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if len(self._clients) >= CLIENTS:
            raise web.HTTPServiceUnavailable(text=f"{CLIENTS} pages are open already; close one.")
        if not _same_origin(request):
            raise web.HTTPForbidden(text="only this daemon's own page may look.")
        socket = web.WebSocketResponse(max_msg_size=LARGEST_MESSAGE, heartbeat=10.0, compress=False)
        self._clients.add(socket)
        try:
            await socket.prepare(request)
            await self._serve(socket, request)
        finally:
            self._clients.discard(socket)
        return socket

    async def _serve(self, socket: web.WebSocketResponse, request: web.Request) -> None:
        """Send until the client goes, or until it has not taken a message for `SEND_TIMEOUT_S`."""
        senders = [
            asyncio.create_task(self._send_snapshots(socket), name="dashboard snapshots"),
            asyncio.create_task(self._send_images(socket), name="dashboard images"),
        ]
        listener = asyncio.create_task(_ignore(socket), name="dashboard listener")
        try:
            await asyncio.wait([*senders, listener], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (*senders, listener):
                task.cancel()
            results = await asyncio.gather(*senders, listener, return_exceptions=True)
            if any(isinstance(result, TimeoutError) for result in results) and request.transport is not None:
                request.transport.abort()

    async def _send_snapshots(self, socket: web.WebSocketResponse) -> None:
        told = self._event_count
        hello = {"identity": self._identity, "columns": STRIPS, "rows": list(self._strips)}
        await _send(socket, json.dumps({"hello": hello, "events": self._events_after(0)}))
        reader = self._shown.reader()
        while True:
            text = await reader.next()
            await _send(socket, text)
            if self._event_count > told:
                rows, told = self._events_after(told), self._event_count
                await _send(socket, json.dumps({"events": rows}))

    async def _send_images(self, socket: web.WebSocketResponse) -> None:
        reader = self._images.reader()
        while True:
            left, depth = await reader.next()
            await _send(socket, LEFT + left)
            if depth:
                await _send(socket, DEPTH + depth)

    async def _close_clients(self, app: web.Application) -> None:
        for socket in set(self._clients):
            await socket.close(code=WSCloseCode.GOING_AWAY, message=b"the daemon stops")


async def _send(socket: web.WebSocketResponse, content: str | bytes) -> None:
    async with asyncio.timeout(SEND_TIMEOUT_S):
        await (socket.send_str(content) if isinstance(content, str) else socket.send_bytes(content))


def _same_origin(request: web.Request) -> bool:
    origin = request.headers.get("Origin")
    return origin is None or origin.partition("://")[2] == request.host


async def _ignore(socket: web.WebSocketResponse) -> None:
    """Read what the client says, so that its goodbye is heard, and throw it away; one that goes on talking is cut."""
    heard = 0
    async for _ in socket:
        heard += 1
        if heard > MOST_MESSAGES:
            return


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


def _jpegs(seen: Perception) -> tuple[bytes, bytes]:
    """Left image and coloured depth, empty when there is none."""
    left = _jpeg(seen.left_rect) if seen.left_rect is not None else b""
    return left, _jpeg(colour_depth(seen.depth_m)) if seen.depth_m is not None else b""


def _jpeg(image: Image) -> bytes:
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()
