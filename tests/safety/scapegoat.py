"""What the worker process is tested with: an object that does whatever harm it is told to.

Imports little, since every worker process that a test starts has to import it too.
"""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from morpheyes_daemon.errors import CalibrationError


@dataclass(frozen=True)
class Order:
    """A job that says what is to go wrong."""

    what: str
    argument: Any = None


class Scapegoat:
    """Does what the order says."""

    def __init__(self) -> None:
        self.jobs = 0

    def perceive(self, order: Order) -> Any:
        self.jobs += 1
        return getattr(self, order.what)(order.argument)

    def count(self, _: Any) -> int:
        return self.jobs

    def echo(self, thing: Any) -> Any:
        return thing

    def read_only(self, array: Any) -> bool:
        return not array.flags.writeable

    def pid(self, _: Any) -> int:
        return os.getpid()

    def nice(self, _: Any) -> int:
        return os.getpriority(os.PRIO_PROCESS, 0)

    def refuse(self, text: str) -> None:
        raise CalibrationError(text)

    def fail(self, text: str) -> None:
        raise ZeroDivisionError(text)

    def unpicklable(self, _: Any) -> Any:
        return lambda: None

    def hang(self, _: Any) -> None:
        signal.pause()

    def crash(self, number: int) -> None:
        os.kill(os.getpid(), number)

    def leave(self, code: int) -> None:
        os._exit(code)


def never_built() -> Scapegoat:
    raise CalibrationError("calibration.yaml: there is no such file.")


def dies_building(marker: Path) -> Scapegoat:
    """Die at the first attempt only."""
    if marker.exists():
        return Scapegoat()
    marker.touch()
    os._exit(9)
