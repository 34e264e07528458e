"""Capture for `calibrate mount`: pictures of a fixed board from a vehicle that is rotated by hand, with attitudes.

Writes left and right pictures and one line of `attitudes.csv` for each pair. A pair is kept when the vehicle is still
and its attitude differs from those kept before; it is written at once.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from morpheyes_daemon.calibration.mount import ATTITUDES, COLUMNS, attitude_rows
from morpheyes_daemon.calibration.targets.boards import Board, find_corners
from morpheyes_daemon.clock import Clock, S
from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.devices.autopilot.session import AutopilotSession
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import LinkOpener
from morpheyes_daemon.errors import DeviceTimeoutError, InputError
from morpheyes_daemon.messages.core import Image, VehicleState
from morpheyes_daemon.rig_capture.board_capture import BoardFolder, note_board, write_pair
from morpheyes_daemon.rig_capture.rig_session import RigSession
from morpheyes_daemon.transforms import Array, R_from_rpy, rotvec_from_R

STILL_RAD_S = 0.03
"""Largest turn rate of a still vehicle, rad/s; chosen: 0.3 mrad of motion in an exposure of 10 ms."""
STILL_PX = 1.0
"""Largest motion of a corner between two frames of a still vehicle, pixels; chosen: more blurs the corners."""
FRESH_NS = S // 5
"""Largest age of an attitude, nanoseconds; chosen: twice the period of a 10 Hz telemetry."""
MIN_NEW_ROTATION_RAD = math.radians(8.0)
"""Least rotation from every kept attitude, rad; chosen: smaller ones add little to the spread of 48 attitudes."""
ATTITUDE_TIMEOUT_S = 10.0
"""Longest wait for the first attitude, seconds; chosen: the heartbeats of an autopilot come every second."""
_POLLS_PER_S = 20
"""Checks for the first attitude per second; chosen: within one period of usual telemetry."""

Show = Callable[[int, str], None]
"""Called with the number of kept pictures and the advice after every pair."""


class HandHeldVehicle:
    """Attitude of the autopilot over its link; an asynchronous context manager.

    Entering raises DeviceTimeoutError when no attitude arrives within ATTITUDE_TIMEOUT_S.
    """

    def __init__(self, config: VehicleConfig, clock: Clock, opener: LinkOpener) -> None:
        self._clock = clock
        self._session = AutopilotSession(config.autopilot, DeviceContext.alone(clock, opener))

    async def __aenter__(self) -> Self:
        await self._session.__aenter__()
        for _ in range(round(ATTITUDE_TIMEOUT_S * _POLLS_PER_S)):
            if self.state.attitude_t_ns:
                return self
            await self._clock.sleep_until_ns(self._clock.now_ns() + S // _POLLS_PER_S)
        await self.__aexit__(None, None, None)
        raise DeviceTimeoutError("The autopilot sends no attitude; run `morpheyes doctor` to find out why.")

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._session.__aexit__(kind, error, trace)

    @property
    def state(self) -> VehicleState:
        """Newest vehicle state."""
        return self._session.vehicle


@dataclass(frozen=True, slots=True)
class AttitudeSource:
    """Reads the newest vehicle state; `clock` gives its age."""

    read: Callable[[], VehicleState]
    clock: Clock

    def fresh(self, state: VehicleState) -> bool:
        """Return whether the attitude of a state is at most FRESH_NS old."""
        return self.clock.now_ns() - state.attitude_t_ns < FRESH_NS


async def capture_mount(session: RigSession, attitude: AttitudeSource, out: BoardFolder, wanted: int, show: Show) -> int:
    """Take pairs and attitudes at the smallest baseline until `out` holds `wanted`; return their number.

    Raises DeviceError when camera, servo or autopilot fail, InputError when `out` holds another board or cannot be
    written.
    """
    note_board(out)
    attitudes = out.path / ATTITUDES
    kept = [R for _, R in attitude_rows(attitudes)] if attitudes.is_file() else []
    if len(kept) < wanted:
        await session.place(session.range_m[0])
    selector = _Selector(out.board, kept)
    while len(kept) < wanted:
        pair = await session.pair()
        state = attitude.read()
        advice = selector.evaluate(pair.left, state, attitude.fresh(state))
        if not advice:
            kept.append(_R_ned_frd(state))
            write_pair(out.path, len(kept), pair)
            _note_attitude(attitudes, f"left{len(kept):02d}.png", state)
        show(len(kept), advice or "kept")
    return len(kept)


@dataclass
class _Selector:
    """Selects pictures: the board is found, the vehicle is still, and its attitude R_ned_frd (3, 3) is new."""

    board: Board
    kept: list[Array]
    last: Array | None = None

    def evaluate(self, left: Image, state: VehicleState, fresh: bool) -> str:
        """Return the advice to the person, empty for a picture to keep; `left` is raw (H, W) or (H, W, 3)."""
        last, self.last = self.last, find_corners(left, self.board)
        corners = self.last
        if corners is None:
            return "no complete board in the left picture"
        if not fresh:
            return "no recent attitude from the autopilot"
        moved = last is None or last.shape != corners.shape or float(np.nanmax(np.abs(corners - last))) > STILL_PX
        if moved or max(abs(rate) for rate in state.rates_frd_rad_s) > STILL_RAD_S:
            return "hold the vehicle still"
        R = _R_ned_frd(state)
        if any(np.linalg.norm(rotvec_from_R(other.T @ R)) < MIN_NEW_ROTATION_RAD for other in self.kept):
            return "rotate the vehicle differently: onto its sides, nose up and down, from the left and right"
        return ""


def _R_ned_frd(state: VehicleState) -> Array:
    return R_from_rpy(state.roll_rad, state.pitch_rad, state.yaw_rad)


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
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); free some space and run the command again."
        ) from None
