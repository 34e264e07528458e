"""Commands to the autopilot with their acknowledgement; one at a time, so that answers cannot be confused."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from morpheyes_daemon.errors import DeviceError, DeviceTimeoutError
from morpheyes_daemon.wire.mavlink import Message, dialect

TRIES = 4
ANSWER_S = 0.5
PROGRESS_S = 10.0
"""How long an autopilot that said "in progress" may stay silent."""


class CommandClient:
    """Sends COMMAND_LONG and waits for COMMAND_ACK."""

    def __init__(self, send: Callable[[Message], None], target_system: int) -> None:
        self._send = send
        self._target = target_system
        self._lock = asyncio.Lock()
        self._waiting: tuple[int, asyncio.Queue[int]] | None = None

    def take(self, message: Message) -> None:
        """Take a COMMAND_ACK of the vehicle."""
        if self._waiting is not None and message.command == self._waiting[0]:
            self._waiting[1].put_nowait(message.result)

    async def send(self, command: int, *parameters: float) -> None:
        """Send a MAV_CMD with up to seven parameters until it is accepted.

        Raises DeviceError when the autopilot refuses, DeviceTimeoutError when it does not answer.
        """
        padded = (*parameters, *(0.0,) * (7 - len(parameters)))
        async with self._lock:
            answers: asyncio.Queue[int] = asyncio.Queue()
            self._waiting = command, answers
            try:
                for confirmation in range(TRIES):
                    self._send(dialect.MAVLink_command_long_message(self._target, 1, command, confirmation, *padded))
                    result = await _result(answers)
                    if result is not None:
                        _raise_unless_accepted(command, result)
                        return
            finally:
                self._waiting = None
        raise DeviceTimeoutError(f"The autopilot does not answer {_name('MAV_CMD', command)}.")


async def _result(answers: asyncio.Queue[int]) -> int | None:
    """Return the final MAV_RESULT, None when no answer came in time."""
    wait_s = ANSWER_S
    try:
        while True:
            async with asyncio.timeout(wait_s):
                result = await answers.get()
            if result != dialect.MAV_RESULT_IN_PROGRESS:
                return result
            wait_s = PROGRESS_S
    except TimeoutError:
        return None


def _raise_unless_accepted(command: int, result: int) -> None:
    if result != dialect.MAV_RESULT_ACCEPTED:
        answer = _name("MAV_RESULT", result).removeprefix("MAV_RESULT_").lower().replace("_", " ")
        raise DeviceError(f"The autopilot refuses {_name('MAV_CMD', command)}: {answer}.")


def _name(enum: str, number: int) -> str:
    entry = dialect.enums[enum].get(number)
    return entry.name if entry is not None else f"{enum} {number}"
