"""A way around begins when the goal comes no nearer, keeps to one side, and ends nearer to the goal than before."""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.way_around import STALLED_S, WayAround

LATER_NS = round((STALLED_S + 1.0) * S)
HEADINGS = np.linspace(-0.5, 0.5, 11)


def test_it_begins_only_when_the_goal_comes_no_nearer() -> None:
    around = WayAround()
    for second in range(60):
        assert not around.update(80.0 - 0.5 * second, 0.1, second * S)
    assert not around.update(51.0, 0.1, 60 * S)
    assert around.update(51.0, 0.1, 60 * S + LATER_NS)


def test_what_is_in_the_way_is_kept_on_the_goals_side_until_it_is_nearer_than_ever() -> None:
    around = WayAround()
    around.update(20.0, -0.3, 0)
    assert around.update(20.0, -0.3, LATER_NS)
    assert around.side == -1
    assert around.update(26.0, 1.2, 2 * LATER_NS), "going away first"
    assert around.side == -1, "the side stays when the goal passes to the other"
    assert not around.update(18.9, 0.0, 3 * LATER_NS)
    assert not around.update(18.9, 0.0, 3 * LATER_NS + S), "and a new one begins after another stall only"


def test_it_takes_the_outermost_heading_that_is_wide_enough() -> None:
    around = WayAround()
    around.update(20.0, 0.3, 0)
    around.update(20.0, 0.3, LATER_NS)
    free = np.array([9.0, 9.0, 9.0, 8.0, 6.0, 5.0, 4.0, 3.5, 1.5, 0.8, 0.4])
    assert around.heading(HEADINGS, free) == 7
    assert around.heading(HEADINGS, free / 5.0) == 4, "in a narrow place six tenths of the best will do"


def test_it_ends_where_nothing_is_in_the_way() -> None:
    around = WayAround()
    around.update(20.0, 0.3, 0)
    assert around.update(20.0, 0.3, LATER_NS)
    around.end(LATER_NS)
    assert not around.update(20.0, 0.3, LATER_NS + S)


def test_forgotten_before_the_mission_engages() -> None:
    around = WayAround()
    around.update(20.0, 0.3, 0)
    around.update(20.0, 0.3, LATER_NS)
    around.reset()
    assert not around.update(30.0, 0.3, 2 * LATER_NS)
