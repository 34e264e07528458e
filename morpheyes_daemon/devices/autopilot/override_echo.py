"""Whether the autopilot does what our overrides say: they must come back in RC_CHANNELS.

An override from the wrong system id is ignored without a word (docs/safety.md), and there is no acknowledgement;
the echo is the only sign. Only sent against seen is compared here, the mode plays no part.
"""

from __future__ import annotations

from collections import deque

from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.safety import Widths
from morpheyes_daemon.wire.mavlink import ChannelOverride

ECHO_NS = 1 * S
STEADY_NS = S // 2
"""Overrides must have come without a pause as long as this, or it is no stream that could be echoed."""


class OverrideEcho:
    """`sent` and `seen` feed it; `ignored` is true while a steady stream of overrides is not echoed."""

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Widths]] = deque()
        self._since_ns: int | None = None
        self._echoed_ns = 0

    def sent(self, override: ChannelOverride, now_ns: int) -> None:
        """An override went out."""
        if override.releases:
            self._sent.clear()
            self._since_ns = None
            return
        if self._since_ns is None or now_ns - self._sent[-1][0] > STEADY_NS:
            self._since_ns = now_ns
        self._sent.append((now_ns, override.channels_us))
        while now_ns - self._sent[0][0] > ECHO_NS:
            self._sent.popleft()

    def seen(self, rc_us: tuple[int, ...], now_ns: int) -> None:
        """RC_CHANNELS came in."""
        if any(widths == rc_us[:4] for _, widths in self._sent):
            self._echoed_ns = now_ns

    def ignored(self, now_ns: int, rc_t_ns: int) -> bool:
        """True when overrides have streamed for ECHO_NS, RC_CHANNELS kept coming, and none of them was ours."""
        if self._since_ns is None or now_ns - self._sent[-1][0] > STEADY_NS or now_ns - rc_t_ns > STEADY_NS:
            return False
        return now_ns - max(self._since_ns, self._echoed_ns) > ECHO_NS
