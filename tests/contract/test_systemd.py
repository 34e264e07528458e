"""The unit is sound, well shut in, and fits the daemon it starts."""

import configparser
import re
import shutil
import socket
import subprocess
from pathlib import Path

import pytest

from morpheyes_daemon.config.vehicle import SerialServoConfig
from morpheyes_daemon.daemon.sd_notify import notify

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = SYSTEMD / "morpheyes.service"
LARGEST_EXPOSURE = 3.0

needs_analyze = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not installed")


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


class Unit(configparser.RawConfigParser):
    """A unit file; keys keep their case, repeated keys are joined."""

    def __init__(self) -> None:
        super().__init__(strict=False, delimiters=("=",), comment_prefixes=("#",))
        self.read(UNIT)

    def optionxform(self, optionstr: str) -> str:
        return optionstr


@needs_analyze
def test_unit_verifies() -> None:
    done = run("systemd-analyze", "verify", str(UNIT))
    assert (done.returncode, done.stderr) == (0, "")


@needs_analyze
def test_exposure_is_small() -> None:
    done = run("systemd-analyze", "security", "--offline=true", str(UNIT))
    found = re.search(r"Overall exposure level for morpheyes.service: ([\d.]+)", done.stdout)
    assert found is not None, done.stderr
    assert float(found.group(1)) <= LARGEST_EXPOSURE


OWN_CALLS = {"setpriority"}
"""What the daemon's own code asks of the kernel beyond what any service does: os.nice of the vision worker."""


def system_calls(names: list[str]) -> set[str]:
    """The system calls of a list of names and @groups."""
    found: set[str] = set()
    for name in names:
        if not name.startswith("@"):
            found.add(name)
            continue
        lines = run("systemd-analyze", "syscall-filter", name).stdout.splitlines()[1:]
        found |= system_calls([word for line in lines if (word := line.strip()) and not word.startswith("#")])
    return found


@needs_analyze
def test_the_filter_lets_through_what_the_daemon_does() -> None:
    allowed: set[str] = set()
    for line in UNIT.read_text().splitlines():
        if line.startswith("SystemCallFilter="):
            value = line.removeprefix("SystemCallFilter=")
            calls = system_calls(value.removeprefix("~").split())
            allowed = allowed - calls if value.startswith("~") else allowed | calls
    assert allowed >= OWN_CALLS | {"read", "socket", "clone3", "execve"}
    assert not allowed & {"mount", "reboot", "setuid", "sched_setscheduler", "bpf"}


def test_cameras_and_serial_ports_still_work() -> None:
    """What is plugged in after the start has no name in /proc/devices at the start: its number is allowed."""
    text = UNIT.read_text()
    for kind in ("char-81", "char-166", "char-188", "char-ttyAMA", "char-ttyS", "char-media"):
        assert f"DeviceAllow={kind} rw" in text
    assert set(Unit()["Service"]["SupplementaryGroups"].split()) == {"video", "dialout"}
    assert "PrivateDevices=yes" not in text


def test_a_wrong_configuration_is_not_tried_again_and_a_hung_daemon_is() -> None:
    service = Unit()["Service"]
    assert service["Type"] == "notify"
    assert service["NotifyAccess"] == "main"
    assert service["Restart"] == "on-failure"
    assert service["RestartPreventExitStatus"] == "2"
    assert int(service["WatchdogSec"]) > 0
    assert Unit()["Unit"]["StartLimitIntervalSec"] == "0"


def test_only_the_daemon_hears_sigterm_and_has_time_for_neutral_and_release() -> None:
    service = Unit()["Service"]
    assert service["KillMode"] == "mixed"
    assert float(service["TimeoutStopSec"]) >= 10.0
    assert service["OOMPolicy"] == "continue"


def test_udev_makes_the_name_that_the_configuration_expects() -> None:
    rules = (SYSTEMD / "70-morpheyes.rules").read_text()
    device = SerialServoConfig(backend="serial").url.split(":")[1].removeprefix("/dev/")
    assert re.search(rf'SYMLINK\+="{device}[ "]', rules)
    assert rules.count("ID_MM_DEVICE_IGNORE") >= 3


@pytest.mark.parametrize(
    "line",
    [line for line in (SYSTEMD / "70-morpheyes.rules").read_text().splitlines() if line and not line.startswith("#")],
)
def test_udev_rules_are_well_formed(line: str) -> None:
    """Comma-separated KEY OP "value"; udevadm verify comes only with systemd 254."""
    part = r'(?:[A-Z_]+(?:\{[^}]+\})?(?:==|!=|\+=|:=|=)"[^"]*")'
    assert re.fullmatch(rf"{part}(?:, {part})*", line), line


@pytest.mark.skipif(not shutil.which("udevadm"), reason="udevadm is not installed")
def test_udevadm_accepts_the_rules() -> None:
    if run("udevadm", "verify", "--help").returncode != 0:
        pytest.skip("this udevadm cannot verify (it comes with systemd 254)")
    assert run("udevadm", "verify", str(SYSTEMD / "70-morpheyes.rules")).returncode == 0


@pytest.mark.skipif(not shutil.which("systemd-sysusers"), reason="systemd-sysusers is not installed")
def test_the_user_is_made_in_a_clean_root(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    done = run("systemd-sysusers", f"--root={tmp_path}", str(SYSTEMD / "morpheyes.sysusers"))
    assert done.returncode == 0, done.stderr
    assert "morpheyes:" in (tmp_path / "etc" / "passwd").read_text()
    groups = (tmp_path / "etc" / "group").read_text()
    assert re.search(r"^video:.*morpheyes$", groups, re.M)
    assert re.search(r"^dialout:.*morpheyes$", groups, re.M)


@pytest.mark.parametrize("abstract", [False, True])
def test_notify_reaches_the_service_manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool) -> None:
    address = f"@morpheyes-test-{tmp_path.name}-{id(tmp_path)}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + address[1:] if abstract else address)
        manager.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        assert notify("READY=1\nSTATUS=ready")
        assert manager.recv(100) == b"READY=1\nSTATUS=ready"


def test_notify_is_quiet_without_a_service_manager(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify("READY=1")
    assert not notify("READY=1", str(tmp_path / "nobody"))
    assert not notify("READY=1", "vsock:2:1234")


def test_notify_never_blocks_when_the_manager_does_not_read(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        sent = [notify("WATCHDOG=1", str(tmp_path / "notify")) for _ in range(5000)]
    assert sent[0]
    assert not sent[-1]
