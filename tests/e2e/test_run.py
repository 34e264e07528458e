"""`morpheyes run` as systemd would start it: a process of its own, ended by signals."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import aiohttp
import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from morpheyes_daemon.cli import build
from morpheyes_daemon.clock import MonotonicClock
from morpheyes_daemon.daemon.service import ending_by_signal
from morpheyes_daemon.messages.core import Perception
from morpheyes_daemon.messages.safety import Action, GateOutput
from morpheyes_daemon.recorder.reader import Flight, read_flight
from morpheyes_daemon.simulation.airframe.dynamics import Vehicle
from morpheyes_daemon.simulation.autopilot.tcp_server import MavlinkServer
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.stereo.calibration_file import write_calibration
from tests.support.fixed_rig import fixed_rig
from tests.support.real_images import real_images

WIDTH, HEIGHT = 320, 240
BASELINE_MM = 65.0
NOBODY = "tcp:127.0.0.1:9"


def write_config(folder: Path, images: Path, autopilot: str, servo: str = "") -> Path:
    rig = fixed_rig(folder / "rig.yaml", WIDTH, HEIGHT, 200.0, BASELINE_MM / 1e3)
    servo = servo or f"{{backend: none, baseline_mm: {BASELINE_MM}}}"
    path = folder / "config.yaml"
    path.write_text(
        f"calibration: {rig}\n"
        f"camera: {{backend: recording, path: {images}, width_px: {WIDTH}, height_px: {HEIGHT}, rate_hz: 5.0}}\n"
        f"servo: {servo}\n"
        f"autopilot: {{url: '{autopilot}', mavsdk: false}}\n"
        f"recorder: {{folder: {folder / 'flights'}}}\n"
    )
    return path


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """Four side-by-side pictures of a textured wall at a constant disparity."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    rng = np.random.default_rng(5)
    wall = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH + 8), dtype=np.uint8), (5, 5), 1.0)
    for k in range(4):
        cv2.imwrite(str(folder / f"scene_{k}.png"), np.hstack([wall[:, :WIDTH], wall[:, 8:]]))
    return folder


class Running:
    """A daemon process and what it says."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.lines: list[str] = []

    async def until(self, said: Callable[[list[str]], bool], limit_s: float = 120.0) -> None:
        """Read until `said` is true of the lines so far."""
        assert self.process.stderr is not None
        async with asyncio.timeout(limit_s):
            while not said(self.lines):
                line = await self.process.stderr.readline()
                assert line, f"it ended: {self.lines}"
                self.lines.append(line.decode())

    async def end(self, number: int = signal.SIGTERM) -> int:
        """Send the signal and return the exit code."""
        self.process.send_signal(number)
        assert self.process.stderr is not None
        async with asyncio.timeout(60.0):
            self.lines += (await self.process.stderr.read()).decode().splitlines()
            return await self.process.wait()


@asynccontextmanager
async def running(config: Path) -> AsyncIterator[Running]:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", "from morpheyes_daemon.cli import main; main()", "run", "--config", str(config),
        stderr=asyncio.subprocess.PIPE, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    try:
        yield Running(process)
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def depth_on_the_page(port: int, limit_s: float = 240.0) -> None:
    """Ask the daemon's page until it shows a depth with something in it."""
    async with asyncio.timeout(limit_s), aiohttp.ClientSession() as session:
        while True:
            with suppress(aiohttp.ClientConnectionError):
                async with session.get(f"http://127.0.0.1:{port}/api/state") as answer:
                    shown = await answer.json()
                    if shown["depth"] is not None:
                        return
            await asyncio.sleep(0.2)


def the_log(folder: Path) -> Flight:
    (path,) = (folder / "flights").glob("*.mcap")
    return read_flight(path)


def test_without_a_calibration_there_is_one_sentence_and_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("camera: {backend: recording, path: nowhere}\nservo: {backend: none}\n")
    from morpheyes_daemon.cli import main

    monkeypatch.setattr(sys, "argv", ["morpheyes", "run", "--config", str(path)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    words = capsys.readouterr().err
    assert words.count("\n") == 1
    assert "calibrate solve" in words


def test_a_calibration_of_another_rig_is_refused(tmp_path: Path, scenes: Path) -> None:
    path = write_config(tmp_path, scenes, NOBODY, servo="{backend: none, baseline_mm: 200}")
    result = CliRunner().invoke(build(), ["run", "--config", str(path)])
    assert result.exception is not None
    assert getattr(result.exception, "exit_code", None) == 2


@pytest.mark.slow
async def test_what_is_missing_is_waited_for_and_said_once(tmp_path: Path, scenes: Path) -> None:
    servo = "{backend: serial, url: 'serial:/dev/no-such-teensy:115200'}"
    config = write_config(tmp_path, scenes, NOBODY, servo)
    write_calibration(RigTwin(WIDTH, HEIGHT, 0).exact_rig(), tmp_path / "rig.yaml")
    async with running(config) as daemon:
        for words in ("no-such-teensy", NOBODY, "preflight"):
            await daemon.until(lambda said, words=words: any(words in line for line in said))
        assert await daemon.end() == 0
    text = "".join(daemon.lines)
    assert text.count("no-such-teensy") == 1
    assert text.count(NOBODY) == 1
    assert "fault" not in text
    states = {out.state for out in the_log(tmp_path).values("gate")}
    assert states <= {"boot", "preflight", "released"}


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("images", ["synthetic", "stereopi_scenes"])
async def test_depth_lives_and_no_stick_is_sent_as_long_as_nobody_engages(
    tmp_path: Path, scenes: Path, images: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = scenes if images == "synthetic" else real_images(images)
    twin = AutopilotTwin(Vehicle(), MonotonicClock())
    overrides: list[list[int]] = []
    monkeypatch.setattr(twin.autopilot.rc, "override", lambda t_ns, values: overrides.append(values))
    async with MavlinkServer(twin, port=0) as server:
        beat = asyncio.create_task(twin.run())
        config, port = write_config(tmp_path, folder, server.url), free_port()
        with config.open("a") as file:
            file.write(f"dashboard: {{enabled: true, port: {port}}}\n")
        async with running(config) as daemon:
            await daemon.until(lambda said: any("is heard" in line for line in said))
            await depth_on_the_page(port)
            assert await daemon.end() == 0
        beat.cancel()
        await asyncio.gather(beat, return_exceptions=True)
    assert all(values[:4] == [0, 0, 0, 0] for values in overrides)  # a release on the way out, and no stick
    log = the_log(tmp_path)
    depths = [value for value in log.values("perception") if isinstance(value, Perception)]
    assert len(depths) >= 1
    outputs = [value for value in log.values("gate") if isinstance(value, GateOutput)]
    assert outputs
    assert all(out.action in (Action.SILENT, Action.RELEASE) for out in outputs)


async def test_the_first_signal_asks_and_the_second_ends() -> None:
    stop = asyncio.Event()
    seen: list[str] = []

    async def life() -> None:
        with ending_by_signal(stop):
            try:
                await stop.wait()
                seen.append("asked")
                await asyncio.Event().wait()
            finally:
                seen.append("let go")

    alive = asyncio.create_task(life())
    await asyncio.sleep(0)
    os.kill(os.getpid(), signal.SIGTERM)
    await stop.wait()
    os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(asyncio.CancelledError):
        await alive
    assert seen == ["asked", "let go"]
