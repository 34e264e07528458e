"""Tries what the service may do and what it must not, and prints what came of each as one line of JSON."""

from __future__ import annotations

import ctypes
import errno
import grp
import json
import mmap
import os
import platform
import pwd
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

CALLS = {"unshare": {"x86_64": 272, "aarch64": 97}, "mount": {"x86_64": 165, "aarch64": 40}}
CLONE_NEWUSER = 0x10000000
LIBC = ctypes.CDLL(None, use_errno=True)


def call(name: str, *arguments: Any) -> None:
    """Make a system call by its number."""
    if LIBC.syscall(CALLS[name][platform.machine()], *arguments) < 0:
        raise OSError(ctypes.get_errno(), name)


def send(host: str) -> None:
    """Send a datagram."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"x", (host, 9999))


def open_device(name: str) -> None:
    """Open a device for reading and writing."""
    os.close(os.open(f"/dev/{name}", os.O_RDWR | os.O_NONBLOCK))


def touch(folder: str) -> Callable[[], None]:
    """Return what makes a file in the folder and takes it away."""

    def make() -> None:
        path = Path(folder, "probe")
        path.touch()
        path.unlink()

    return make


def make_setuid() -> None:
    """Make a file that would run as its owner."""
    path = Path("/var/lib/morpheyes/probe")
    path.touch()
    try:
        path.chmod(0o4755)
    finally:
        path.unlink()


ATTEMPTS: dict[str, Callable[[], object]] = {
    **{
        f"a file in {folder}": touch(folder)
        for folder in ("/etc", "/usr", "/var/lib/morpheyes", "/var/log/morpheyes", "/var/cache/morpheyes")
    },
    "the names in /home": lambda: os.listdir("/home"),
    "a foreign process": lambda: os.listdir("/proc/1"),
    "a packet socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
    "a netlink socket": lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW),
    "to loopback": lambda: send("127.0.0.1"),
    "to a local network": lambda: send("10.9.9.9"),
    "to the internet": lambda: send("203.0.113.7"),
    "a Teensy plugged in later": lambda: open_device("ttyACM9"),
    "a USB serial port plugged in later": lambda: open_device("ttyUSB9"),
    "a camera plugged in later": lambda: open_device("video9"),
    "a disk": lambda: open_device("loop9"),
    "lower priority": lambda: os.nice(1),
    "higher priority": lambda: os.nice(-5),
    "real-time scheduling": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)),
    "writable code": lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC),
    "a new namespace": lambda: call("unshare", CLONE_NEWUSER),
    "a mount": lambda: call("mount", b"none", b"/tmp", b"tmpfs", 0, 0),
    "another user": lambda: os.setuid(0),
    "a set-user-id file": make_setuid,
    "another host name": lambda: socket.sethostname("probe"),
    "another time": lambda: time.clock_settime(time.CLOCK_REALTIME, 0.0),
}


WANTED = {
    "a file in /etc": "EROFS",
    "a file in /usr": "EROFS",
    "a file in /var/lib/morpheyes": "done",
    "a file in /var/log/morpheyes": "done",
    "a file in /var/cache/morpheyes": "done",
    "the names in /home": "EACCES",
    "a foreign process": "ENOENT",
    "a packet socket": "EAFNOSUPPORT EPERM",
    "a netlink socket": "EAFNOSUPPORT",
    "to loopback": "done",
    "to a local network": "done",
    "to the internet": "EPERM",
    "a Teensy plugged in later": "ENXIO",
    "a USB serial port plugged in later": "ENXIO",
    "a camera plugged in later": "ENXIO",
    "a disk": "EPERM",
    "lower priority": "done",
    "higher priority": "EPERM EACCES",
    "real-time scheduling": "EPERM",
    "writable code": "EPERM",
    "a new namespace": "EPERM",
    "a mount": "EPERM",
    "another user": "EPERM",
    "a set-user-id file": "EPERM",
    "another host name": "EPERM",
    "another time": "EPERM",
}
"""What comes of trying; ENXIO is what the kernel says of a device without a driver that one may open."""


def outcome(attempt: Callable[[], object]) -> str:
    """Return `done` or the name of the error."""
    try:
        attempt()
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    return "done"


if __name__ == "__main__":
    found: dict[str, object] = {name: outcome(attempt) for name, attempt in ATTEMPTS.items()}
    found["user"] = pwd.getpwuid(os.getuid()).pw_name
    found["groups"] = [grp.getgrgid(number).gr_name for number in os.getgroups()]
    print(json.dumps(found))
