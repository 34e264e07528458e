"""The camera backends: recordings of every shape, a UVC camera that misbehaves, a simulator behind a socket."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from morpheyes_daemon.clock import MS, MonotonicClock, S, run_virtual, running_clock
from morpheyes_daemon.config.vehicle import RecordingCameraConfig, SimCameraConfig, V4l2CameraConfig
from morpheyes_daemon.devices.camera import build_camera
from morpheyes_daemon.devices.camera.recording import RecordingCamera
from morpheyes_daemon.devices.camera.simulator import SimulatorCamera
from morpheyes_daemon.devices.camera.v4l2 import V4l2Camera
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.errors import (
    ConfigError,
    DeviceError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    InputError,
)
from morpheyes_daemon.messages.core import Image, RawPair
from morpheyes_daemon.simulation.camera.frame_server import FrameServer
from tests.support.hand_clock import HandClock
from tests.support.real_images import real_images

W, H = 160, 120


def eye(value: int, *, width: int = W, colour: bool = True) -> Image:
    """An image of one value; values survive JPEG to within a few levels."""
    return np.full((H, width, 3) if colour else (H, width), value, np.uint8)


def write(path: Path, *eyes: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.hstack(eyes))


def recorded(path: Path, *, loop: bool = True, rate_hz: float = 5.0, width_px: int = W) -> RecordingCameraConfig:
    return RecordingCameraConfig(
        backend="recording", path=path, loop=loop, rate_hz=rate_hz, width_px=width_px, height_px=H
    )


def read_all(config: RecordingCameraConfig, count: int) -> list[RawPair]:
    async def scene() -> list[RawPair]:
        camera = build_camera(config, DeviceContext.alone(running_clock()))
        await camera.open()
        pairs = [await camera.read() for _ in range(count)]
        await camera.close()
        await camera.close()
        return pairs

    return run_virtual(scene())


def values(pairs: list[RawPair]) -> list[tuple[int, int]]:
    """Grey values of left and right, to the nearest ten (JPEG and video are lossy)."""
    return [(10 * round(float(p.left.mean()) / 10), 10 * round(float(p.right.mean()) / 10)) for p in pairs]


def test_side_by_side_files_come_in_natural_order_at_their_rate(tmp_path: Path) -> None:
    for number, suffix in ((1, "png"), (2, "jpg"), (10, "bmp")):
        write(tmp_path / f"scene_{number}.{suffix}", eye(10 * number), eye(10 * number + 100))
    (tmp_path / "notes.txt").write_text("no image")
    pairs = read_all(recorded(tmp_path, rate_hz=4.0), 4)
    assert values(pairs) == [(10, 110), (20, 120), (100, 200), (10, 110)]
    assert [pair.seq for pair in pairs] == [1, 2, 3, 4]
    assert np.diff([pair.t_ns for pair in pairs]).tolist() == pytest.approx([250 * MS] * 3, abs=1000)
    assert pairs[0].left.shape == (H, W, 3)
    assert not pairs[0].left.flags.writeable
    assert pairs[0].right.flags.c_contiguous


@pytest.mark.parametrize(
    "names", [("left_{}.png", "right_{}.png"), ("Left{}.png", "RIGHT{}.png"), ("left/{}.png", "right/{}.png")]
)
def test_left_and_right_files_are_paired_by_the_rest_of_their_names(tmp_path: Path, names: tuple[str, str]) -> None:
    for number in (9, 11):
        write(tmp_path / names[0].format(number), eye(10 * number, colour=False))
        write(tmp_path / names[1].format(number), eye(10 * number + 100, colour=False))
    if "/" not in names[0]:
        write(tmp_path / "pattern.png", eye(5))
    pairs = read_all(recorded(tmp_path), 2)
    assert values(pairs) == [(90, 190), (110, 210)]
    assert pairs[0].left.shape == (H, W)


def test_a_single_picture_is_a_recording_too(tmp_path: Path) -> None:
    write(tmp_path / "one.png", eye(40), eye(50))
    assert values(read_all(recorded(tmp_path / "one.png"), 2)) == [(40, 50)] * 2


def test_a_video_plays_and_begins_again(tmp_path: Path) -> None:
    path = tmp_path / "flight.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (2 * W, H))
    for number in (4, 8, 12):
        video.write(np.hstack([eye(10 * number), eye(10 * number + 50)]))
    video.release()
    assert values(read_all(recorded(path), 4)) == [(40, 90), (80, 130), (120, 170), (40, 90)]


def test_a_recording_that_does_not_loop_ends_and_stays_ended(tmp_path: Path) -> None:
    write(tmp_path / "1.png", eye(10), eye(10))

    async def scene() -> None:
        camera = RecordingCamera(recorded(tmp_path, loop=False), running_clock())
        await camera.open()
        await camera.read()
        for _ in range(2):
            with pytest.raises(DeviceLostError, match="at its end"):
                await camera.read()
            await camera.close()
            with pytest.raises(DeviceLostError, match="not open"):
                await camera.read()
            await camera.open()

    run_virtual(scene())


def test_a_damaged_picture_is_named_and_passed_over(tmp_path: Path) -> None:
    for number in (1, 3):
        write(tmp_path / f"{number}.png", eye(10 * number), eye(10))
    (tmp_path / "2.png").write_bytes((tmp_path / "1.png").read_bytes()[:50])

    async def scene() -> None:
        camera = RecordingCamera(recorded(tmp_path), running_clock())
        await camera.open()
        await camera.read()
        with pytest.raises(InputError, match=r"2\.png: cannot be read as a picture"):
            await camera.read()
        assert values([await camera.read()]) == [(30, 10)]

    run_virtual(scene())


def fill_nothing(folder: Path) -> Path:
    return folder


def fill_absent(folder: Path) -> Path:
    return folder / "absent"


def fill_widowed(folder: Path) -> Path:
    write(folder / "left_1.png", eye(1))
    write(folder / "left_2.png", eye(1))
    write(folder / "right_1.png", eye(1))
    return folder


def fill_unequal(folder: Path) -> Path:
    write(folder / "left_1.png", eye(1))
    write(folder / "right_1.png", eye(1, width=W + 2))
    return folder


def fill_odd(folder: Path) -> Path:
    write(folder / "1.png", eye(1, width=2 * W + 1))
    return folder


def fill_other_size(folder: Path) -> Path:
    write(folder / "1.png", eye(1, width=W), eye(1, width=W))
    return folder / "1.png"


def fill_no_video(folder: Path) -> Path:
    (folder / "flight.mp4").write_bytes(b"no video at all")
    return folder / "flight.mp4"


@pytest.mark.parametrize(
    ("fill", "width_px", "sentence"),
    [
        (fill_nothing, W, r"there are no images"),
        (fill_absent, W, r"there is no such recording"),
        (fill_widowed, W, r"left_2\.png: the right image that belongs to it is missing"),
        (fill_unequal, W, r"left_1\.png is 160×120 and right_1\.png is 162×120; both eyes must have one size"),
        (fill_odd, W, r"a width of 321 px is odd"),
        (fill_other_size, 320, r"images of 160×120 per eye, but the camera is configured as 320×120"),
        (fill_no_video, W, r"cannot be read as a video"),
    ],
)
def test_what_cannot_be_used_is_said_at_once(
    tmp_path: Path, fill: Callable[[Path], Path], width_px: int, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        build_camera(recorded(fill(tmp_path), width_px=width_px), DeviceContext.alone(HandClock()))


@pytest.mark.realdata
def test_real_scenes_are_delivered() -> None:
    folder = real_images("stereopi_scenes")
    config = RecordingCameraConfig(backend="recording", path=folder, width_px=320, height_px=240, rate_hz=10)
    pairs = read_all(config, 9)
    assert {pair.left.shape[:2] for pair in pairs} == {(240, 320)}
    np.testing.assert_array_equal(pairs[0].left, pairs[8].left)
    correlation = np.corrcoef(pairs[0].left.ravel(), pairs[0].right.ravel())[0, 1]
    assert 0.2 < correlation < 0.999  # two views of one scene


class Webcam:
    """A UVC camera whose images the test hands over; None is an unplugged cable."""

    def __init__(self, size: tuple[int, int] = (2 * W, H), present: bool = True) -> None:
        self._size, self._present = size, present
        self.images: queue.Queue[Image | None] = queue.Queue()
        self.stamp_ms = 0.0
        self.settings: dict[int, float] = {}
        self.released = threading.Event()
        self._image: Image | None = None

    def open(self, device: str) -> Webcam:
        return self

    def isOpened(self) -> bool:
        return self._present

    def grab(self) -> bool:
        self._image = self.images.get()
        return self._image is not None

    def retrieve(self) -> tuple[bool, Any]:
        return True, self._image

    def get(self, prop: int) -> float:
        return {
            cv2.CAP_PROP_FRAME_WIDTH: self._size[0],
            cv2.CAP_PROP_FRAME_HEIGHT: self._size[1],
            cv2.CAP_PROP_POS_MSEC: self.stamp_ms,
        }[prop]

    def set(self, prop: int, value: float) -> bool:
        self.settings[prop] = value
        return True

    def release(self) -> None:
        self.released.set()


def v4l2(swap_eyes: bool = False) -> V4l2CameraConfig:
    return V4l2CameraConfig(backend="v4l2", width_px=W, height_px=H, rate_hz=100, swap_eyes=swap_eyes)


@asynccontextmanager
async def plugged(webcam: Webcam, swap_eyes: bool = False) -> AsyncIterator[V4l2Camera]:
    camera = V4l2Camera(v4l2(swap_eyes), MonotonicClock(), webcam.open)
    await camera.open()
    try:
        yield camera
    finally:
        webcam.images.put(None)
        await camera.close()
        await camera.close()


@pytest.mark.parametrize("swap_eyes", [False, True])
async def test_the_webcam_delivers_both_eyes_with_its_own_stamp(swap_eyes: bool) -> None:
    webcam = Webcam()
    clock = MonotonicClock()
    async with plugged(webcam, swap_eyes) as camera:
        exposed_ns = clock.now_ns() - 30 * MS
        webcam.stamp_ms = exposed_ns / MS
        webcam.images.put(np.hstack([eye(10), eye(200)]))
        pair = await camera.read()
        assert values([pair]) == [(200, 10) if swap_eyes else (10, 200)]
        assert pair.t_ns == pytest.approx(exposed_ns, abs=1000)  # milliseconds as a float
        assert webcam.settings[cv2.CAP_PROP_FRAME_WIDTH] == 2 * W
    assert webcam.released.wait(5)


async def test_a_stamp_of_another_clock_is_not_believed() -> None:
    webcam = Webcam()
    clock = MonotonicClock()
    async with plugged(webcam) as camera:
        before_ns = clock.now_ns()
        webcam.stamp_ms = (before_ns + 3600 * S) / MS
        webcam.images.put(np.hstack([eye(1), eye(2)]))
        assert before_ns <= (await camera.read()).t_ns <= clock.now_ns()


async def test_an_unplugged_webcam_is_lost_and_can_come_back() -> None:
    webcam = Webcam()
    async with plugged(webcam) as camera:
        webcam.images.put(None)
        for _ in range(2):
            with pytest.raises(DeviceLostError, match="unplugged"):
                await camera.read()
        await camera.close()
        await camera.open()
        webcam.images.put(np.hstack([eye(1), eye(2)]))
        await camera.read()


async def test_a_webcam_that_hangs_is_a_timeout_and_does_not_hold_up_closing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("morpheyes_daemon.devices.camera.v4l2.SHORTEST_PATIENCE_S", 0.05)
    monkeypatch.setattr("morpheyes_daemon.devices.camera.v4l2.CLOSE_PATIENCE_S", 0.05)
    webcam = Webcam()
    camera = V4l2Camera(v4l2(), MonotonicClock(), webcam.open)
    await camera.open()
    with pytest.raises(DeviceTimeoutError, match=r"delivered no image for 0\.05 s"):
        await camera.read()
    await camera.close()
    assert not webcam.released.is_set()
    webcam.images.put(None)
    assert webcam.released.wait(5)


async def test_a_webcam_that_is_absent_or_cannot_do_the_size_is_told() -> None:
    with pytest.raises(DeviceNotFoundError, match="cannot be opened"):
        await V4l2Camera(v4l2(), MonotonicClock(), Webcam(present=False).open).open()
    with pytest.raises(DeviceError, match=r"offers images of 640×480 instead of two times 160×120"):
        await V4l2Camera(v4l2(), MonotonicClock(), Webcam(size=(640, 480)).open).open()
    missing = V4l2CameraConfig(backend="v4l2", device="/dev/video-of-nobody")
    with pytest.raises(DeviceNotFoundError, match="video-of-nobody"):
        await build_camera(missing, DeviceContext.alone(MonotonicClock())).open()


def sim(address: str, **size: int) -> SimCameraConfig:
    return SimCameraConfig(address=address, rate_hz=50, **({"width_px": W, "height_px": H} | size))


def pairs_from(clock: MonotonicClock) -> Callable[[], Awaitable[RawPair]]:
    """Return a source of numbered pairs."""
    made = 0

    async def source() -> RawPair:
        nonlocal made
        made += 1
        return RawPair(made, clock.now_ns(), eye(made % 250), eye(255 - made % 250))

    return source


@asynccontextmanager
async def serving(address: str, rate_hz: float = 50) -> AsyncIterator[FrameServer]:
    clock = MonotonicClock()
    server = FrameServer(address, pairs_from(clock), clock, rate_hz)
    running = asyncio.create_task(server.run())
    try:
        await server.listening.wait()
        yield server
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_the_simulator_serves_frames_to_the_daemon(tmp_path: Path) -> None:
    address = f"unix:{tmp_path}/frames"
    async with serving(address):
        camera = build_camera(sim(address), DeviceContext.alone(MonotonicClock()))
        await camera.open()
        pairs = [await camera.read() for _ in range(5)]
        await camera.close()
        await camera.close()
    numbers = [pair.seq for pair in pairs]
    assert numbers == sorted(set(numbers))
    for pair in pairs:
        np.testing.assert_array_equal(pair.left, eye(pair.seq % 250))
        np.testing.assert_array_equal(pair.right, eye(255 - pair.seq % 250))
    assert not (tmp_path / "frames").exists()


async def test_a_slow_daemon_gets_the_newest_frame_and_does_not_hold_up_others(tmp_path: Path) -> None:
    address = f"unix:{tmp_path}/frames"
    async with serving(address, rate_hz=200) as server:
        reader, writer = await asyncio.open_unix_connection(str(tmp_path / "frames"))
        reader._transport.pause_reading()  # type: ignore[attr-defined]
        camera = SimulatorCamera(address, sim(address))
        await camera.open()
        while server.dropped == 0:
            newest = await camera.read()
        ahead = await camera.read()
        assert ahead.seq > newest.seq
        await camera.close()
        writer.transport.abort()


async def read_to_the_end(camera: SimulatorCamera) -> None:
    while True:
        await camera.read()


async def test_a_simulator_that_ends_is_lost_and_found_again(tmp_path: Path) -> None:
    address = f"unix:{tmp_path}/frames"
    camera = SimulatorCamera(address, sim(address))
    with pytest.raises(DeviceNotFoundError, match="No simulator serves frames"):
        await camera.open()
    async with serving(address):
        await camera.open()
        await camera.read()
    with pytest.raises(DeviceLostError, match="closed its frame socket"):
        await read_to_the_end(camera)
    await camera.close()
    async with serving(address):
        await camera.open()
        await camera.read()
        await camera.close()


async def test_a_socket_left_by_a_killed_simulator_is_taken_over(tmp_path: Path) -> None:
    (tmp_path / "frames").touch()
    address = f"unix:{tmp_path}/frames"
    async with serving(address):
        camera = SimulatorCamera(address, sim(address))
        await camera.open()
        assert (await camera.read()).left.size > 0
        await camera.close()


async def test_over_tcp_garbage_and_other_sizes_are_told(unused_tcp_port: int) -> None:
    address = f"tcp:127.0.0.1:{unused_tcp_port}"
    async with serving(address):
        camera = SimulatorCamera(address, sim(address, width_px=640))
        await camera.open()
        with pytest.raises(DeviceLostError, match="its images are 160×120"):
            await camera.read()
        await camera.close()

    async def talk_http(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n")
        writer.close()

    async with await asyncio.start_server(talk_http, "127.0.0.1", unused_tcp_port):
        camera = SimulatorCamera(address, sim(address))
        await camera.open()
        with pytest.raises(DeviceLostError, match="no frames of version 1"):
            await camera.read()
        await camera.close()


async def test_a_silent_simulator_is_a_timeout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("morpheyes_daemon.devices.camera.simulator.SHORTEST_PATIENCE_S", 0.05)

    async def say_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    path = str(tmp_path / "frames")
    async with await asyncio.start_unix_server(say_nothing, path):
        camera = SimulatorCamera(path, sim(path))
        await camera.open()
        with pytest.raises(DeviceTimeoutError, match="sent no frame"):
            await camera.read()
        await camera.close()


def test_the_simulated_camera_without_an_address_is_for_the_simulator_alone() -> None:
    with pytest.raises(ConfigError, match="only `morpheyes sim`"):
        build_camera(SimCameraConfig(), DeviceContext.alone(HandClock()))
