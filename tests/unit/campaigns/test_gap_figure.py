"""The figure of a gap campaign shows flights that went through, one of every shape."""

import cv2
import pytest

pytest.importorskip("numba", reason="the simulator's worlds need the extra `sim`")

from morpheyes_daemon.campaigns.gap_figure import draw_sequences
from morpheyes_daemon.flights.flight_plan import make_plan

WAY = [[-2.0 + 0.5 * k, 0.02, -1.5, 0.0, -0.1, 0.0, 0.1] for k in range(9)]


def row(seed, shape, outcome="reached"):
    return {
        "seed": seed, "shape": shape, "outcome": outcome, "sequence": WAY, "crossing_speed_m_s": 2.9, "clearance_m": 0.03,
    }  # fmt: skip


def test_every_shape_flown_through_has_one_column(tmp_path):
    plan = make_plan("gap", size="320x240", calibration="exact")
    rows = [row(0, "rectangle"), row(23, "rectangle"), row(1, "infinity"), row(2, "goku", "collided")]
    assert draw_sequences(tmp_path / "two.png", plan, rows)
    assert draw_sequences(tmp_path / "one.png", plan, rows[:2])
    two, one = (cv2.imread(str(tmp_path / name)) for name in ("two.png", "one.png"))
    assert two is not None
    assert one is not None
    assert two.shape[1] == pytest.approx(2 * one.shape[1], abs=2)


def test_nothing_is_drawn_when_nobody_came_through(tmp_path):
    plan = make_plan("gap", size="320x240", calibration="exact")
    assert not draw_sequences(tmp_path / "none.png", plan, [row(2, "goku", "collided")])
    assert not (tmp_path / "none.png").exists()
