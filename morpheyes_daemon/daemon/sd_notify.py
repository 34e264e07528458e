"""Tells systemd how the daemon is: READY=1, STATUS=…, WATCHDOG=1, STOPPING=1 (sd_notify(3), without its library)."""

from __future__ import annotations

import os
import socket


def notify(state: str, address: str | None = None) -> bool:
    """Send `state` to the service manager; False when there is none, or when it does not listen."""
    address = address or os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as sender:
            sender.connect(address)
            sender.send(state.encode())
    except OSError:
        return False
    return True
