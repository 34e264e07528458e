"""The daemon finds gaps in rendered walls, flies through them, and refuses those that are too small."""

import math

import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer needs the extra `sim`")

from morpheyes_daemon.benchmarks.gap_detection import GapBencher, gap_view
from morpheyes_daemon.campaigns.runner import fly_one
from morpheyes_daemon.flights.flight_plan import make_plan

FIT_M = 0.040


def plan(**changes):
    return make_plan("gap", **{"size": "320x240", "calibration": "exact", "limit_s": 60.0, **changes})


def test_the_contour_in_a_rendered_wall_is_where_the_opening_is():
    bencher = GapBencher(plan())
    for k in (1, 3):
        bencher.run(gap_view(plan(), k, stack=1))
    # measured over all shapes: 0.91 in the median at this size
    assert np.median(bencher.ious["detection"]) > 0.85


@pytest.mark.slow
def test_it_flies_through_the_smallest_opening_without_touching_it():
    row = fly_one(plan(seed=0), "test")
    assert (row["outcome"], row["shape"], row["motion"]) == ("reached", "rectangle", "none")
    assert 0.0 < row["clearance_m"] <= FIT_M + 0.005
    assert row["crossing_speed_m_s"] > 2.6
    assert row["contour_iou"] > 0.8
    assert row["baseline_min_m"] == pytest.approx(0.1, abs=0.002)
    assert row["baseline_max_m"] > 0.25


@pytest.mark.slow
def test_it_refuses_what_is_too_small_and_says_how_large_it_is():
    row = fly_one(plan(seed=0, world="gap_small"), "test")
    assert (row["outcome"], row["reason"]) == ("refused", "mission_refused")
    assert "the vehicle needs 0.34 x 0.19 m" in row["text"]
    assert row["min_clearance_m"] > 1.0
    assert row["crossing_speed_m_s"] is None


@pytest.mark.slow
def test_of_several_openings_it_flies_through_the_one_that_fits():
    row = fly_one(plan(seed=0, world="gap_several"), "test")
    assert row["outcome"] == "reached"
    assert math.isfinite(row["crossing_speed_m_s"])
    assert row["clearance_m"] > 0.0
