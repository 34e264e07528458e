"""A vehicle turned by hand before a board: kept is what is held still and turned otherwise, with its attitude."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from morpheyes_daemon.calibration.mount import ATTITUDES, attitude_rows
from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.clock import S
from morpheyes_daemon.messages.core import RawPair, VehicleState
from morpheyes_daemon.rig_capture.board_capture import BoardFolder
from morpheyes_daemon.rig_capture.mount_capture import AttitudeSource, capture_mount
from morpheyes_daemon.simulation.camera.calibration_boards import BoardTwin
from morpheyes_daemon.simulation.camera.true_rig import RigTwin
from morpheyes_daemon.transforms import Array, R_from_rpy, rpy_from_R

BOARD = Board(5, 4, 0.04)
Held = list[tuple[RawPair, Array]]


@pytest.fixture(scope="module")
def held() -> Held:
    return list(BoardTwin(RigTwin(320, 240, seed=2), BOARD, 2).hand_turned(0.1, 5))


class Hands:
    """Somebody who holds each attitude for a few frames, and turns between them."""

    def __init__(self, held: Held, **state: Any) -> None:
        blank = RawPair(0, 0, np.zeros_like(held[0][0].left), np.zeros_like(held[0][0].right))
        self._shown = [shown for one in held for shown in (one, one, one, (blank, one[1]))]
        self._state = state
        self.now_s = 1.0
        self.taken = 0
        self.range_m = (0.1, 0.3)
        self.placed: list[float] = []

    def now_ns(self) -> int:
        return round(self.now_s * S)

    async def place(self, nominal_m: float) -> None:
        self.placed.append(nominal_m)

    async def pair(self) -> RawPair:
        if self.taken > 200:
            raise TimeoutError
        self.taken += 1
        self.now_s += 0.2
        return self._shown[(self.taken - 1) % len(self._shown)][0]

    def vehicle(self) -> VehicleState:
        roll, pitch, yaw = rpy_from_R(self._shown[(self.taken - 1) % len(self._shown)][1])
        state = VehicleState(attitude_t_ns=self.now_ns(), roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
        return replace(state, **self._state)


def take(hands: Hands, out: Path, wanted: int) -> tuple[int, set[str]]:
    said: set[str] = set()
    source = AttitudeSource(hands.vehicle, cast(Any, hands))
    show = lambda kept, text: said.add(text)  # noqa: E731
    return asyncio.run(capture_mount(cast(Any, hands), source, BoardFolder(out, BOARD), wanted, show)), said


def test_each_attitude_is_kept_once_with_its_picture(held: Held, tmp_path: Path) -> None:
    hands = Hands(held)
    kept, said = take(hands, tmp_path, 3)
    assert kept == 3
    assert hands.placed == [0.1]
    assert {"kept", "hold the vehicle still", "no complete board in the left picture"} <= said
    assert any(text.startswith("rotate the vehicle differently") for text in said)
    rows = list(attitude_rows(tmp_path / ATTITUDES))
    assert [name for name, _ in rows] == ["left01.png", "left02.png", "left03.png"]
    for (name, R), (_, true) in zip(rows, held, strict=False):
        assert (tmp_path / name).is_file()
        assert (tmp_path / name.replace("left", "right")).is_file()
        assert pytest.approx(R_from_rpy(*rpy_from_R(true)), abs=2e-6) == R


def test_it_goes_on_where_it_stopped(held: Held, tmp_path: Path) -> None:
    take(Hands(held), tmp_path, 2)
    kept, _ = take(Hands(held), tmp_path, 4)
    assert kept == 4
    assert len(list(attitude_rows(tmp_path / ATTITUDES))) == 4
    assert take(Hands(held), tmp_path, 4) == (4, set())


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({"attitude_t_ns": 1}, "no recent attitude from the autopilot"),
        ({"rates_frd_rad_s": (0.0, 0.2, 0.0)}, "hold the vehicle still"),
    ],
)
def test_an_old_attitude_or_a_turning_vehicle_is_not_kept(
    held: Held, tmp_path: Path, state: dict[str, Any], said: str
) -> None:
    hands = Hands(held, **state)
    heard: set[str] = set()
    source, out = AttitudeSource(hands.vehicle, cast(Any, hands)), BoardFolder(tmp_path, BOARD)
    with pytest.raises(TimeoutError):
        asyncio.run(capture_mount(cast(Any, hands), source, out, 1, lambda kept, text: heard.add(text)))
    assert said in heard
    assert "kept" not in heard
