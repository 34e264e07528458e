"""The autopilot's parameters over MAVLink: read all, follow changes, set one; and as a file ground stations load.

ArduPilot sends every value as a float whatever its type. Meaning and units are control/parameters.py's matter.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

from morpheyes_daemon.clock import MS, Clock, S
from morpheyes_daemon.errors import DeviceError, DeviceTimeoutError
from morpheyes_daemon.wire.mavlink import Message, dialect, text_of

POLL_NS = 50 * MS
QUIET_NS = 700 * MS
"""No value for this long while reading: ask again for what is missing."""
ASK_AGAIN = 40
"""Missing values asked for at a time; the autopilot's queue for them is short."""
PATIENCE_NS = 6 * S
"""Reading gives up when nothing at all has come for this long."""
TELL_NS = 1 * S
SET_TRIES = 4
SET_WAIT_S = 0.6


class ParameterClient:
    """Reads and sets; `values` is what is known so far, complete once `complete` is true."""

    def __init__(self, send: Callable[[Message], None], clock: Clock, target_system: int) -> None:
        self._send = send
        self._clock = clock
        self._target = target_system
        self._values: dict[str, float] = {}
        self._types: dict[str, int] = {}
        self._arrived: set[str] = set()
        self._seen: set[int] = set()
        self._count: int | None = None
        self._last_ns = 0
        self._changed = asyncio.Event()
        self._listeners: list[Callable[[Mapping[str, float]], None]] = []
        self._untold = False
        self._told_ns = -TELL_NS
        self.complete = False

    @property
    def values(self) -> Mapping[str, float]:
        """All values known so far by name, read-only and live."""
        return MappingProxyType(self._values)

    def on_change(self, listener: Callable[[Mapping[str, float]], None]) -> None:
        """Call `listener` with all values when reading is done, and after later changes, once a second at most."""
        self._listeners.append(listener)

    def take(self, message: Message) -> None:
        """Take a PARAM_VALUE of the vehicle."""
        if not math.isfinite(message.param_value):
            return
        name, value = text_of(message.param_id), float(message.param_value)
        is_new = self._values.get(name) != value
        self._values[name], self._types[name] = value, message.param_type
        self._arrived.add(name)
        self._last_ns = self._clock.now_ns()
        if message.param_index < message.param_count:
            self._seen.add(message.param_index)
            self._count = message.param_count
        self._changed.set()
        if is_new and self.complete:
            self._untold = True
            self.tell_due(self._last_ns)

    def tell_due(self, now_ns: int) -> None:
        """Tell the listeners of changes, once in TELL_NS at most: what they make of them is dear."""
        if self._untold and now_ns - self._told_ns >= TELL_NS:
            self._tell()

    async def read_all(self) -> None:
        """Read every parameter; raises DeviceTimeoutError when the autopilot stops answering."""
        self._seen, self._count = set(), None
        started_ns = asked_ns = self._clock.now_ns()
        self._send(dialect.MAVLink_param_request_list_message(self._target, 1))
        while self._count is None or len(self._seen) < self._count:
            await self._clock.sleep_until_ns(self._clock.now_ns() + POLL_NS)
            now_ns = self._clock.now_ns()
            if now_ns - max(self._last_ns, started_ns) > PATIENCE_NS:
                raise DeviceTimeoutError(
                    f"The autopilot stopped sending parameters after {len(self._seen)} of {self._count or '?'}."
                )
            if now_ns - max(self._last_ns, asked_ns) > QUIET_NS:
                asked_ns = now_ns
                self._ask_again()
        self.complete = True
        self._tell()
        self._told_ns = -TELL_NS  # the first change after a reading is told at once

    def _ask_again(self) -> None:
        if self._count is None:
            self._send(dialect.MAVLink_param_request_list_message(self._target, 1))
            return
        missing = [index for index in range(self._count) if index not in self._seen]
        for index in missing[:ASK_AGAIN]:
            self._send(dialect.MAVLink_param_request_read_message(self._target, 1, b"", index))

    async def set(self, name: str, value: float) -> None:
        """Set a parameter and wait for the autopilot to say so.

        Raises DeviceTimeoutError when it does not answer (also: no such parameter), DeviceError when it keeps
        another value.
        """
        kind = self._types.get(name, dialect.MAV_PARAM_TYPE_REAL32)
        for _ in range(SET_TRIES):
            self._arrived.discard(name)
            self._send(dialect.MAVLink_param_set_message(self._target, 1, name.encode(), value, kind))
            if await self._answer(name):
                kept = self._values[name]
                if not math.isclose(kept, value, rel_tol=1e-5, abs_tol=1e-9):
                    raise DeviceError(f"The autopilot keeps {name} at {kept:g} instead of {value:g}.")
                return
        raise DeviceTimeoutError(f"The autopilot does not answer the setting of {name}: does it know it?")

    async def _answer(self, name: str) -> bool:
        """Wait for a value of `name`; False when none came in time."""
        try:
            async with asyncio.timeout(SET_WAIT_S):
                while name not in self._arrived:
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            return False
        return True

    def _tell(self) -> None:
        self._untold, self._told_ns = False, self._clock.now_ns()
        for listener in self._listeners:
            listener(self.values)


def parameter_file(values: Mapping[str, float], comment: str = "") -> str:
    """Return the text of a parameter file that ground stations and SITL load: `NAME,VALUE` lines."""
    lines = [f"# {line}" for line in comment.splitlines()]
    lines += [f"{name},{value:.9g}" for name, value in sorted(values.items())]
    return "\n".join(lines) + "\n"
