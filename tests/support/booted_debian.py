"""A Debian root that is really booted: systemd is process 1 of a container with a network of its own, loopback alone.

Commands run inside with `Container.run`. The container is given the bpf system call, since systemd enforces
IPAddressDeny and DeviceAllow by programs that it loads into the kernel.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

SUITES = {11: "bookworm", 13: "trixie"}
"""Debian by the minor version of its Python."""
INSIDE = "systemd,systemd-sysv,dbus,python3"
TOOLS = ("mmdebstrap", "systemd-nspawn", "nsenter", "dpkg-deb", "ip")
BOOT_LIMIT_S = 120.0
NSPAWN = (
    "systemd-nspawn", "--boot", "--register=no", "--keep-unit", "--private-network", "--console=read-only",
    "--system-call-filter=bpf", "--capability=CAP_BPF,CAP_NET_ADMIN,CAP_PERFMON", "--machine=morpheyes-test",
)  # fmt: skip


class NoContainerError(Exception):
    """This machine cannot make or boot a container; the text says why."""


def missing() -> str:
    """Why there can be no container here, an empty text when there can."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return "booting a container is root's"
    tools = [tool for tool in TOOLS if not shutil.which(tool)]
    if tools:
        return f"{', '.join(tools)} not installed (apt-get install mmdebstrap systemd-container iproute2)"
    return "" if sys.version_info.minor in SUITES else "no Debian has this Python"


def make_root(root: Path, architecture: str = "", include: str = INSIDE) -> None:
    """Make Debian's smallest system with systemd and the Python of this machine; raises NoContainerError."""
    suite = SUITES[sys.version_info.minor]
    chosen = [f"--architectures={architecture}"] if architecture else []
    command = ["mmdebstrap", "--variant=minbase", f"--include={include}", *chosen, suite, str(root)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800)
    if done.returncode != 0:
        raise NoContainerError(f"mmdebstrap cannot make {suite}: {done.stderr.strip().splitlines()[-1]}")


def until(condition: Callable[[], bool], limit_s: float, what: Callable[[], str] = lambda: "") -> None:
    """Ask until it is so; there is nothing that would notify across the container's border."""
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s, what()
        time.sleep(0.1)


class Container:
    """A booted root; `leader` is its process 1 as seen from here."""

    def __init__(self, root: Path, process: subprocess.Popen[bytes], leader: int) -> None:
        self.root, self.process, self.leader = root, process, leader
        self.inside = Path(f"/proc/{leader}/root")

    def run(self, *command: object, code: int | None = 0, timeout_s: float = 300.0) -> str:
        """Run inside and return the standard output; `code` is the exit code wanted, None for any."""
        full = ["nsenter", f"--target={self.leader}", "--all", "--wd=/", *(str(part) for part in command)]
        done = subprocess.run(full, capture_output=True, text=True, timeout=timeout_s, env=CLEAN)
        assert code is None or done.returncode == code, f"{command}: {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout

    def shown(self, unit: str, *names: str) -> dict[str, str]:
        """Return what `systemctl show` says."""
        lines = self.run("systemctl", "show", unit, f"--property={','.join(names)}").splitlines()
        return dict(line.split("=", 1) for line in lines)

    def in_its_network(self, *command: object) -> list[str]:
        """Return the command line of a program of this machine that sees the container's network alone."""
        return ["nsenter", f"--net=/proc/{self.leader}/ns/net", *(str(part) for part in command)]


CLEAN = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C.UTF-8"}


@contextmanager
def booted(root: Path, log: Path) -> Iterator[Container]:
    """Boot `root` and power it off at the end; raises NoContainerError when this machine cannot."""
    with log.open("wb") as console:
        process = subprocess.Popen(
            [*NSPAWN, f"--directory={root}"],
            stdin=subprocess.DEVNULL, stdout=console, stderr=console,
            env={**CLEAN, "UNIFIED_CGROUP_HIERARCHY": "1", "SYSTEMD_LOG_COLOR": "0"},
        )  # fmt: skip
    leader = 0
    try:
        until(lambda: process.poll() is not None or _leader(process.pid) != 0, 30.0, log.read_text)
        leader = _leader(process.pid)
        if not leader:
            raise NoContainerError(f"systemd-nspawn cannot boot here: {log.read_text()[-300:]}")
        container = Container(root, process, leader)
        until(
            lambda: container.run("systemctl", "is-system-running", code=None).strip() in ("running", "degraded"),
            BOOT_LIMIT_S, lambda: log.read_text()[-2000:],
        )  # fmt: skip
        yield container
    finally:
        _power_off(process, leader)


def _power_off(process: subprocess.Popen[bytes], leader: int) -> None:
    if leader and process.poll() is None:
        os.kill(leader, signal.SIGRTMIN + 4)  # systemd's own word for poweroff
    try:
        process.wait(30.0)
    except subprocess.TimeoutExpired:
        if leader:
            os.kill(leader, signal.SIGKILL)
        process.kill()
        process.wait()


def _leader(pid: int) -> int:
    """Return the container's process 1 among the children of systemd-nspawn, 0 while it is not there."""
    try:
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            if Path(f"/proc/{child}/comm").read_text() == "systemd\n":
                return int(child)
    except OSError:
        pass  # one of them has just ended
    return 0


def process_status(folder: Path) -> dict[str, str]:
    """Return /proc/PID/status, empty when the process is gone."""
    try:
        lines = (folder / "status").read_text().splitlines()
    except OSError:
        return {}
    return dict(line.split(":\t", 1) for line in lines if ":\t" in line)
