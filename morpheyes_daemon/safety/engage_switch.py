"""The pilot's switch as it is heard in RC_CHANNELS, and what counts as the pilot asking to engage.

Off is believed at once, since it hands the sticks back. On must be earned: only the way from a steady off to a
steady on, heard without a gap, asks to engage, and only for a moment. A switch that is on at boot, a receiver that
has no such channel yet, a message that was overtaken on the way and a worn contact therefore ask for nothing.
"""

from __future__ import annotations

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.messages.safety import NARROWEST_US, WIDEST_US

STEADY_NS = 200 * MS
"""Either position must last this long; longer than messages of one link overtake each other."""

ASKING_NS = 1 * S
"""How long a flip asks: the heartbeat with a mode switched just before may come after it."""


class EngageSwitch:
    """Takes the pulses of one channel in the order of arrival; `timeout_ns` is the longest gap it bridges."""

    def __init__(self, above_us: int, timeout_ns: int) -> None:
        self._above_us = above_us
        self._timeout_ns = timeout_ns
        self._last: tuple[int, float] | None = None
        self.forget()

    def forget(self) -> None:
        """Know nothing of the switch until it is heard again."""
        self._on: bool | None = None
        self._since_ns = self._heard_ns = 0
        self._flipped = False

    @property
    def on(self) -> bool:
        """True while the switch was last heard on."""
        return self._on is True

    def hear(self, t_ns: int, width_us: float) -> bool | None:
        """Take a pulse measured at `t_ns`; returns the position, None when it tells nothing new."""
        if (t_ns, width_us) == self._last:
            return None
        self._last = t_ns, width_us
        if not NARROWEST_US <= width_us <= WIDEST_US:
            self._on = None
            return None
        on = width_us > self._above_us
        if on and t_ns < self._heard_ns:
            return None
        self._move(on, max(t_ns, self._heard_ns))
        return on

    def _move(self, on: bool, t_ns: int) -> None:
        if t_ns - self._heard_ns > self._timeout_ns:
            self._on = None
        if on is not self._on:
            self._flipped = on and self._on is False and t_ns - self._since_ns >= STEADY_NS
            self._on, self._since_ns = on, t_ns
        self._heard_ns = t_ns

    def flipped(self, now_ns: int) -> bool:
        """True from the flip to on until it has been used or is too old to count."""
        return self.on and self._flipped and now_ns - self._since_ns <= ASKING_NS

    def asks(self, now_ns: int) -> bool:
        """True while a flip counts and the switch has stayed on steadily since."""
        return self.flipped(now_ns) and self._heard_ns - self._since_ns >= STEADY_NS

    def use(self) -> None:
        """The flip has engaged; it cannot engage again."""
        self._flipped = False
