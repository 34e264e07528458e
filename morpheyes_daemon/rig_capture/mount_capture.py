"""Taking pictures of a board that stands still with a vehicle that is turned by hand, and the attitude of each.

What `calibrate mount` takes: left and right pictures and a line of `attitudes.csv` for each. A picture is kept when
the vehicle is held still and turned otherwise than in those kept before; it is on disk at once.
"""

from __future__ import annotations

import asyncio
import csv
import math
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.calibration.mount import ATTITUDES, COLUMNS, attitude_rows
from morpheyes_daemon.calibration.targets.boards import Board, find_corners
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.devices.autopilot.connection import AutopilotConnection
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.errors import DeviceTimeoutError, InputError
from morpheyes_daemon.messages.core import Image, VehicleState
from morpheyes_daemon.rig_capture.board_capture import note_board, write_pair
from morpheyes_daemon.rig_capture.rig_session import RigSession
from morpheyes_daemon.transforms import Array, R_from_rpy, rotvec_from_R

STILL_RAD_S = 0.03
FRESH_NS = S // 5
MIN_NEW_ROTATION_RAD = math.radians(8.0)
ATTITUDE_TIMEOUT_S = 10.0

Say = Callable[[int, str], None]
"""Told how many pictures are kept, and what to do next."""


class HandHeldVehicle:
    """The autopilot's attitude over its link; use it with `async with`."""

    def __init__(self, config: VehicleConfig, clock: Clock, opener: LinkOpener) -> None:
        self._clock = clock
        self._topics = Topics.create()
        self._hub = AutopilotConnection(config.autopilot, clock, self._topics, EventLog(), opener)

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self._hub.run(), name="autopilot")
        for _ in range(round(ATTITUDE_TIMEOUT_S * 20)):
            if self.state.attitude_t_ns:
                return self
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // 20)
        await self.__aexit__(None, None, None)
        raise DeviceTimeoutError("The autopilot tells no attitude: see `morpheyes doctor`.")

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    @property
    def state(self) -> VehicleState:
        """The newest state."""
        return self._topics.vehicle.get() or VehicleState()


async def capture_mount(
    stand: RigSession, vehicle: Callable[[], VehicleState], clock: Clock, out: Path, board: Board, wanted: int, say: Say
) -> int:
    """Fill `out` with `wanted` pictures and attitudes, cameras at their smallest baseline; returns how many it holds.

    Raises DeviceError when camera, servo or autopilot fail, InputError when `out` cannot be written.
    """
    note_board(out, board)
    kept = [R for _, R in attitude_rows(out / ATTITUDES)] if (out / ATTITUDES).is_file() else []
    if len(kept) < wanted:
        await stand.place(stand.range_m[0])
    last: Array | None = None
    while len(kept) < wanted:
        pair = await stand.pair()
        state = vehicle()
        R = R_from_rpy(state.roll_rad, state.pitch_rad, state.yaw_rad)
        fresh = clock.now_ns() - state.attitude_t_ns < FRESH_NS
        last, hint = _evaluate(pair.left, board, state, fresh, R, kept, last)
        if not hint:
            kept.append(R)
            write_pair(out, len(kept), pair)
            _note_attitude(out / ATTITUDES, f"left{len(kept):02d}.png", state)
        say(len(kept), hint or "kept")
    return len(kept)


def _evaluate(
    left: Image, board: Board, state: VehicleState, fresh: bool, R: Array, kept: list[Array], last: Array | None
) -> tuple[Array | None, str]:
    """Return the board's corners and what to do; nothing when the picture is worth keeping."""
    corners = find_corners(left, board)
    if corners is None:
        return None, "no whole board in the left picture"
    if not fresh:
        return corners, "the autopilot is not heard"
    moved = last is None or last.shape != corners.shape or float(np.nanmax(np.abs(corners - last))) > 1.0
    if moved or max(abs(rate) for rate in state.rates_frd_rad_s) > STILL_RAD_S:
        return corners, "hold the vehicle still"
    if any(np.linalg.norm(rotvec_from_R(other.T @ R)) < MIN_NEW_ROTATION_RAD for other in kept):
        return corners, "turn it otherwise: onto its sides, nose up and down, from the left and right"
    return corners, ""


def _note_attitude(path: Path, picture: str, state: VehicleState) -> None:
    angles = (state.roll_rad, state.pitch_rad, state.yaw_rad)
    try:
        new = not path.is_file()
        with path.open("a", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            if new:
                writer.writerow(COLUMNS)
            writer.writerow([picture, *(f"{math.degrees(angle):.4f}" for angle in angles)])
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); free some space and go on.") from None
