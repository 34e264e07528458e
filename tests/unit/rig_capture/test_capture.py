"""Taking board pictures: only what is still and tells more is kept, at once on disk, and goes on where it stopped."""

import asyncio
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import RawPair
from morpheyes_daemon.rig_capture.board_capture import BoardFolder, CaptureStatus, capture_boards, capture_visits
from morpheyes_daemon.simulation.camera.calibration_boards import BoardTwin
from morpheyes_daemon.simulation.camera.true_rig import RigTwin

BOARD = Board(5, 4, 0.04)


@pytest.fixture(scope="module")
def pairs() -> list[RawPair]:
    return list(BoardTwin(RigTwin(320, 240, seed=2), BOARD, 2).pairs([0.1] * 6))


class Table:
    """A person before the rig: shows each board for two frames, now and then none."""

    def __init__(self, pairs: list[RawPair]) -> None:
        blank = RawPair(0, 0, np.zeros_like(pairs[0].left), np.zeros_like(pairs[0].right))
        self._shown = [shown for pair in pairs for shown in (pair, pair, blank)]
        self.placed: list[float] = []
        self.taken = 0

    async def place(self, nominal_m: float) -> None:
        self.placed.append(nominal_m)

    async def pair(self) -> RawPair:
        self.taken += 1
        return self._shown[(self.taken - 1) % len(self._shown)]


def taken(table: Table, out: Path, wanted: int) -> tuple[dict[str, int], list[CaptureStatus]]:
    shown: list[CaptureStatus] = []
    session = cast(Any, table)
    counts = asyncio.run(capture_boards(session, BoardFolder(out, BOARD), [0.1, 0.2], wanted, shown.append))
    return counts, shown


def test_still_boards_are_kept_until_there_are_enough(pairs: list[RawPair], tmp_path: Path) -> None:
    table = Table(pairs)
    counts, shown = taken(table, tmp_path, 3)
    assert counts == {"100mm": 3, "200mm": 3}
    assert table.placed == [0.1, 0.2]
    assert sorted(path.name for path in (tmp_path / "100mm").iterdir()) == [
        *(f"left0{n}.png" for n in (1, 2, 3)),
        *(f"right0{n}.png" for n in (1, 2, 3)),
    ]
    said = {status.hint.text for status in shown}
    assert {"hold the board still", "kept", "no board is found"} <= said
    assert shown[-1].guide.covered(0).sum() == 3 * 20


def test_it_goes_on_where_it_stopped(pairs: list[RawPair], tmp_path: Path) -> None:
    taken(Table(pairs), tmp_path, 2)
    (tmp_path / "200mm" / "right02.png").unlink()
    table = Table(pairs)
    counts, _ = taken(table, tmp_path, 2)
    assert counts == {"100mm": 2, "200mm": 2}
    assert table.placed == [0.2], "what is complete is not taken again"


def test_visits_take_one_pair_each(pairs: list[RawPair], tmp_path: Path) -> None:
    table = Table(pairs)
    counts = asyncio.run(
        capture_visits(cast(Any, table), BoardFolder(tmp_path, BOARD), [0.1, 0.3], 2, lambda status: None)
    )
    assert counts == {"100mm": 2, "300mm": 2}
    assert table.placed == [0.1, 0.3, 0.1, 0.3]


def test_pictures_of_another_board_are_not_mixed_in(pairs: list[RawPair], tmp_path: Path) -> None:
    taken(Table(pairs), tmp_path, 1)
    other = BoardFolder(tmp_path, Board(9, 6, 0.025))
    with pytest.raises(InputError, match="another board"):
        asyncio.run(capture_boards(cast(Any, Table(pairs)), other, [0.1], 1, lambda status: None))
