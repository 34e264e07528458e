"""The service in a booted Debian: package installed, unit started by a real systemd, a whole vehicle at its ports.

    python3 start.py test -m slow tests/e2e/test_service_container.py

Wants root, the network for Debian's and PyPI's packages, mmdebstrap and systemd-container; minutes long.
MORPHEYES_DEBIAN_PACKAGE names a package that is there already, MORPHEYES_BOOT_ROOT a Debian root (it is copied).
"""

from __future__ import annotations

import itertools
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from morpheyes_daemon.messages.core import Perception
from morpheyes_daemon.recorder.reader import read_flight
from morpheyes_daemon.stereo.calibration_file import write_calibration
from tests.support.booted_debian import (
    Container,
    NoContainerError,
    booted,
    make_root,
    missing,
    process_status,
    until,
)
from tests.support.sandbox_probe import WANTED

pytest.importorskip("numba")

ROOT = Path(__file__).parents[2]
UNIT = "morpheyes.service"
STATE, LOGS, CONFIG = Path("var/lib/morpheyes"), Path("var/log/morpheyes"), Path("etc/morpheyes/config.yaml")
RELEASE = [0, 0, 0, 0]
WORKER_NICE = 0
"""The unit's -10 and the worker's own 10; the observer lowers itself by 15."""
START_S = 60.0
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(bool(missing()), reason=missing() or "it can be booted"),
]

VEHICLE = """
calibration: /var/lib/morpheyes/calibration/rig.yaml
servo: {backend: serial}
autopilot: {url: 'tcp:127.0.0.1:5760', mavsdk: MAVSDK}
camera: {width_px: 320, height_px: 240, rate_hz: 5.0, CAMERA}
"""
RECORDED = VEHICLE.replace("CAMERA", "backend: recording, path: /var/lib/morpheyes/scenes") + "hold_baseline_mm: 200\n"
FLYING = VEHICLE.replace("CAMERA", "backend: sim, address: 'tcp:127.0.0.1:5770'") + (
    "safety: {frame_periods: 20, depth_periods: 20, mission_periods: 20}\n"  # the machine need not be calm
)


class Vehicle:
    """What is outside the container's daemon: the test's end of `vehicle_of_container`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._said: queue.Queue[dict[str, Any]] = queue.Queue()
        self.overrides: list[list[int]] = []
        """The first four channels of every override that the autopilot took."""
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            words = json.loads(line)
            if "override" in words:
                self.overrides.append(words["override"])
            else:
                self._said.put(words)
        self._said.put({"ended": self._process.wait()})

    def wait(self, done: str, limit_s: float = 180.0) -> None:
        assert self._said.get(timeout=limit_s) == {"done": done}

    def ask(self, word: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(word + "\n")
        self._process.stdin.flush()
        self.wait(word)

    @property
    def deflected(self) -> bool:
        """Whether the last override asks for a motion."""
        return bool(self.overrides) and kind_of(self.overrides[-1]) == "deflected"


def kind_of(sticks: list[int]) -> str:
    neutral = all(abs(width - 1500) <= 1 for width in sticks)
    return "release" if sticks == RELEASE else "neutral" if neutral else "deflected"


@contextmanager
def vehicle_at(container: Container) -> Iterator[Vehicle]:
    command = container.in_its_network(sys.executable, "-m", "tests.support.vehicle_of_container", container.inside)
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        vehicle = Vehicle(process)
        vehicle.wait("ready")
        yield vehicle
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if "MORPHEYES_DEBIAN_PACKAGE" in os.environ:
        return Path(os.environ["MORPHEYES_DEBIAN_PACKAGE"])
    build = [sys.executable, ROOT / "systemd/debian/build.py", "--out", tmp_path_factory.mktemp("dist")]
    done = subprocess.run(build, capture_output=True, text=True, timeout=1200)  # type: ignore[arg-type]
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.strip().splitlines()[-1])


@pytest.fixture(scope="module")
def container(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    folder = tmp_path_factory.mktemp("booted")
    try:
        if "MORPHEYES_BOOT_ROOT" in os.environ:
            subprocess.run(["cp", "-a", os.environ["MORPHEYES_BOOT_ROOT"], folder / "root"], check=True)
        else:
            make_root(folder / "root")
        with booted(folder / "root", folder / "console") as running:
            yield running
    except NoContainerError as error:
        pytest.skip(str(error))
    finally:
        shutil.rmtree(folder / "root", ignore_errors=True)


@pytest.fixture(scope="module")
def installed(container: Container, package: Path, scenes: list[np.ndarray]) -> Container:
    """The container with the package, a calibration and a recording; the service is not started."""
    shutil.copy(package, container.inside / "root/morpheyes.deb")
    said = container.run("dpkg", "--install", "/root/morpheyes.deb")
    assert "not found" not in said
    assert container.run("systemctl", "is-active", UNIT, code=None).strip() == "inactive"
    assert container.run("systemctl", "is-enabled", UNIT, code=None).strip() == "disabled"
    from morpheyes_daemon.simulation.camera.true_rig import RigTwin

    write_calibration(RigTwin(320, 240, 0).exact_rig(), container.inside / STATE / "calibration/rig.yaml")
    (container.inside / STATE / "scenes").mkdir()
    for number, picture in enumerate(scenes):
        cv2.imwrite(str(container.inside / STATE / f"scenes/scene_{number:02d}.png"), picture)
    return container


@pytest.fixture(scope="module")
def scenes() -> list[np.ndarray]:
    """A recording: the forest from a place above its ground, side by side, each picture with its own noise."""
    from morpheyes_daemon.clock import MonotonicClock
    from morpheyes_daemon.flights.sim_vehicle import Scenario
    from morpheyes_daemon.flights.simulator_process import TwinVehicle
    from tests.support.vehicle_of_container import simulated_vehicle

    stage = TwinVehicle(Scenario("forest", 0), simulated_vehicle(), MonotonicClock())
    pose = stage.truth(stage.clock.now_ns()).T_ned_frd.copy()
    pose[2, 3] -= 1.5
    pairs = [stage.camera.render_pair(stage.clock.now_ns(), seq, lambda t_ns: pose, 0.2) for seq in range(8)]
    stage.close()
    return [np.hstack([pair.left, pair.right]) for pair in pairs]


@pytest.fixture(scope="module")
def vehicle(installed: Container) -> Iterator[Vehicle]:
    with vehicle_at(installed) as served:
        yield served


class Service:
    """The unit as systemd sees it."""

    def __init__(self, container: Container) -> None:
        self.container = container

    def start(self, config: str, mavsdk: bool = False) -> None:
        """Start it anew; returns after READY."""
        self.write(config, mavsdk)
        self.container.run("systemctl", "start", UNIT, timeout_s=100.0)

    def write(self, config: str, mavsdk: bool = False) -> None:
        """Configure it, stopped."""
        self.stop()
        (self.container.inside / CONFIG).write_text(config.replace("MAVSDK", str(mavsdk).lower()))
        self.container.run("systemctl", "reset-failed", UNIT, code=None)

    def stop(self) -> None:
        self.container.run("systemctl", "stop", UNIT)

    def __getitem__(self, name: str) -> str:
        return self.container.shown(UNIT, name)[name]

    @property
    def pid(self) -> int:
        """The daemon as seen from here, 0 while there is none."""
        return self.to_here(int(self["MainPID"]))

    def to_here(self, inside: int) -> int:
        """A process of the container by its number there."""
        for folder in Path("/proc").iterdir():
            numbers = process_status(folder).get("NSpid", "").split() if folder.name.isdigit() else []
            same = len(numbers) > 1 and int(numbers[-1]) == inside
            if same and (folder / "root").samefile(self.container.inside):
                return int(folder.name)
        return 0

    @property
    def worker(self) -> int:
        """The vision worker's process as seen from here, 0 while there is none; the observer has another nice value."""
        for thread in Path(f"/proc/{self.pid}/task").glob("*/children"):
            for child in thread.read_text().split():
                spawned = b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
                if spawned and os.getpriority(os.PRIO_PROCESS, int(child)) == WORKER_NICE:
                    return int(child)
        return 0

    def status(self, *states: str, limit_s: float = START_S) -> str:
        """Wait until STATUS names one of the states, and return it."""
        until(lambda: self["StatusText"].split(":")[0] in states, limit_s, self.journal)
        return self["StatusText"]

    def journal(self) -> str:
        lines = self.container.run("journalctl", "--boot", "--identifier=morpheyes", "--lines=60", "--output=cat")
        return f"{self['StatusText']}\n{lines}"

    def log(self) -> Path:
        """The newest flight log."""
        return max((self.container.inside / LOGS / "flights").glob("*.mcap"), key=lambda path: path.stat().st_mtime)


@pytest.fixture
def service(installed: Container, vehicle: Vehicle) -> Iterator[Service]:
    shown = Service(installed)
    yield shown
    installed.run("systemctl", "stop", UNIT, code=None)


def test_ready_status_worker_depth_and_folders(service: Service) -> None:
    service.start(RECORDED, mavsdk=True)
    assert service["ActiveState"] == "active"
    service.status("standby")
    until(lambda: service.worker != 0, 20.0)
    for pid, niceness in ((service.pid, -10), (service.worker, 0)):
        assert (
            process_status(Path(f"/proc/{pid}"))["Uid"].split()[0]
            == service.container.run("id", "-u", "morpheyes").strip()
        )
        assert os.getpriority(os.PRIO_PROCESS, pid) == niceness
    service.stop()
    assert service["Result"] == "success"
    log = read_flight(service.log())
    depths = [value for value in log.values("perception") if isinstance(value, Perception)]
    assert len(depths) >= 5
    assert all(np.isfinite(depth.summary.nearest_m) for depth in depths)
    folders = ["/var/lib/morpheyes", "/var/lib/morpheyes/calibration", "/var/log/morpheyes", "/var/cache/morpheyes"]
    shown = service.container.run("stat", "--format=%U:%G %a", *folders).splitlines()
    assert shown == [f"morpheyes:morpheyes {mode}" for mode in (750, 770, 750, 755)]
    name = f"/{service.log().relative_to(service.container.inside)}"
    assert service.container.run("stat", "--format=%U %a", name).split() == ["morpheyes", "640"]


def test_a_worker_that_is_killed_is_replaced_and_the_daemon_stays(service: Service) -> None:
    service.start(RECORDED)
    service.status("standby")
    daemon, worker = service.pid, service.worker
    assert worker, "killing process 0 would kill this test"
    os.kill(worker, signal.SIGKILL)
    until(lambda: service.worker not in (0, worker), 30.0, service.journal)
    service.status("standby")
    assert service.pid == daemon


def test_a_killed_daemon_is_started_again(service: Service) -> None:
    service.start(RECORDED)
    killed = service.pid
    os.kill(killed, signal.SIGKILL)
    until(lambda: service["NRestarts"] == "1" and service["ActiveState"] == "active", START_S, service.journal)
    assert service.pid not in (0, killed)
    service.status("standby")


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("camera: {backend: v4l2}\nservo: {backend: nonsense}\n", "nonsense"),
        (RECORDED.replace("rig.yaml", "nowhere.yaml"), "nowhere.yaml"),
        (RECORDED.replace("/var/lib/morpheyes/scenes", "/var/lib/morpheyes/nothing"), "nothing"),
    ],
)
def test_a_wrong_configuration_is_one_sentence_and_not_tried_again(service: Service, config: str, words: str) -> None:
    service.write(config)
    service.container.run("systemctl", "start", UNIT, code=1)
    assert (service["ActiveState"], service["ExecMainStatus"], service["NRestarts"]) == ("failed", "2", "0")
    said = service.container.run("journalctl", "--boot", "--unit", UNIT, "--identifier=morpheyes", "--output=cat")
    last = said.strip().splitlines()[-1]
    assert last.startswith("morpheyes: ")
    assert words in last
    assert "Traceback" not in said


def test_sigterm_in_flight_is_neutral_then_release_and_a_hung_daemon_is_replaced_observing(
    service: Service, vehicle: Vehicle
) -> None:
    service.start(FLYING)
    service.status("standby")
    try:
        vehicle.ask("take_off")
        fly_and_stop(service, vehicle)
    finally:
        vehicle.ask("land")
    assert (service["Result"], service["ExecMainStatus"]) == ("success", "0")
    kinds = [(kind, len(list(group))) for kind, group in itertools.groupby(vehicle.overrides, kind_of)]
    assert [kind for kind, _ in kinds[-3:]] == ["deflected", "neutral", "release"], (kinds, vehicle.overrides[-150:])


def fly_and_stop(service: Service, vehicle: Vehicle) -> None:
    """Engage, let the daemon hang, be replaced and only observe; engage again and end it by SIGTERM."""
    engage(service, vehicle)
    hung = service.pid
    os.kill(hung, signal.SIGSTOP)
    until(lambda: service["NRestarts"] == "1" and service["ActiveState"] == "active", START_S, service.journal)
    began = len(vehicle.overrides)
    assert service.pid not in (0, hung)
    assert "it only observes" in service.status("pilot", limit_s=30.0)
    assert all(sticks == RELEASE for sticks in vehicle.overrides[began:])
    vehicle.ask("disengage")
    engage(service, vehicle)
    service.stop()


def engage(service: Service, vehicle: Vehicle) -> None:
    """Hand the sticks over, and wait until they ask for a motion."""
    service.status("standby")
    vehicle.overrides.clear()
    vehicle.ask("engage")
    until(lambda: vehicle.deflected, 30.0, service.journal)


def test_every_sandbox_rule_is_in_force(service: Service) -> None:
    """A stranger in the daemon's place: the unit's own lines, with a probe instead of the daemon."""
    container = service.container
    for address in ("203.0.113.7/32", "10.9.9.9/32"):  # on the container's own loopback; the first is no local network
        subprocess.run(container.in_its_network("ip", "address", "add", address, "dev", "lo"), check=True)
    for name, kind, major in (("ttyACM9", "c", 166), ("ttyUSB9", "c", 188), ("video9", "c", 81), ("loop9", "b", 7)):
        container.run("mknod", "--mode=666", f"/dev/{name}", kind, major, 9)
    shutil.copy(ROOT / "tests/support/sandbox_probe.py", container.inside / "usr/local/lib/sandbox_probe.py")
    lines = (container.inside / "usr/lib/systemd/system" / UNIT).read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("Type=", "ExecStart=", "Restart=", "WatchdogSec="))]
    start = "Type=oneshot\nExecStart=/usr/bin/python3 /usr/local/lib/sandbox_probe.py"
    text = "\n".join(kept).replace("[Service]", f"[Service]\n{start}")
    (container.inside / "etc/systemd/system/probe.service").write_text(text)
    container.run("systemctl", "daemon-reload")
    container.run("systemctl", "start", "probe.service")
    said = container.run("journalctl", "--boot", "--unit=probe.service", "--identifier=morpheyes", "--output=cat")
    outcome = json.loads(said.strip().splitlines()[-1])
    for thing, wanted in WANTED.items():
        assert outcome[thing] in wanted.split(), (thing, outcome)
    assert outcome["user"] == "morpheyes"
    assert set(outcome["groups"]) == {"morpheyes", "video", "dialout"}


def test_an_upgrade_leaves_it_running_and_keeps_the_configuration(service: Service) -> None:
    service.start(RECORDED)
    service.status("standby")
    daemon, config = service.pid, (service.container.inside / CONFIG).read_text()
    service.container.run("dpkg", "--force-confold", "--install", "/root/morpheyes.deb")
    assert service["ActiveState"] == "active"
    assert service.pid == daemon
    assert (service.container.inside / CONFIG).read_text() == config
    service.container.run("systemctl", "restart", UNIT)
    assert service.pid not in (0, daemon)
    service.status("standby")


def test_removal_ends_it_in_order_and_purge_leaves_nothing(service: Service) -> None:
    service.start(RECORDED)
    service.status("standby")
    inside = service.container.inside
    service.container.run("dpkg", "--remove", "morpheyes")
    assert service["ActiveState"] != "active"
    assert service.journal().count("the daemon was asked to stop") >= 1
    assert list((inside / LOGS / "flights").glob("*.mcap"))
    assert (inside / STATE / "calibration/rig.yaml").exists()
    service.container.run("dpkg", "--purge", "morpheyes")
    for place in (STATE, LOGS, CONFIG.parent, Path("var/cache/morpheyes"), Path("usr/lib/morpheyes")):
        assert not (inside / place).exists()
    assert service["LoadState"] == "not-found"
