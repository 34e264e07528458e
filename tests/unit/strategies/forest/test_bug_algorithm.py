"""A way around begins when the goal comes no nearer, keeps to one side, and ends nearer to the goal than before."""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.forest.bug_algorithm import PATIENCE_S, STALLED_S, BugAlgorithm

LATER_NS = round((STALLED_S + 1.0) * S)
HEADINGS = np.linspace(-0.5, 0.5, 11)


def test_it_begins_only_when_the_goal_comes_no_nearer() -> None:
    around = BugAlgorithm()
    for second in range(60):
        assert not around.update(80.0 - 0.5 * second, 0.1, second * S)
    assert not around.update(51.0, 0.1, 60 * S)
    assert around.update(51.0, 0.1, 60 * S + LATER_NS)


def test_what_is_in_the_way_is_kept_on_the_goals_side_until_it_is_nearer_than_ever() -> None:
    around = BugAlgorithm()
    around.update(20.0, -0.3, 0)
    assert around.update(20.0, -0.3, LATER_NS)
    assert around.side == -1
    assert around.update(26.0, 1.2, 2 * LATER_NS), "going away first"
    assert around.side == -1, "the side stays when the goal passes to the other"
    assert not around.update(18.9, 0.0, 3 * LATER_NS)
    assert not around.update(18.9, 0.0, 3 * LATER_NS + S), "and a new one begins after another stall only"


def test_it_takes_the_outermost_heading_that_is_wide_enough() -> None:
    around = BugAlgorithm()
    around.update(20.0, 0.3, 0)
    around.update(20.0, 0.3, LATER_NS)
    free = np.array([9.0, 9.0, 9.0, 8.0, 6.0, 5.0, 4.0, 3.5, 1.5, 0.8, 0.4])
    assert around.heading(HEADINGS, free) == 7
    assert around.heading(HEADINGS, free / 5.0) == 4, "in a narrow place six tenths of the best will do"


def test_it_ends_where_nothing_is_in_the_way() -> None:
    around = BugAlgorithm()
    around.update(20.0, 0.3, 0)
    assert around.update(20.0, 0.3, LATER_NS)
    around.end(LATER_NS)
    assert not around.update(20.0, 0.3, LATER_NS + S)


def flown_s(around: BugAlgorithm, second: int) -> int:
    """How long the way around that begins after `second` is flown when it leads nowhere."""
    while not around.update(20.0, 0.3, second * S):
        second += 1
    begun = second
    while around.update(20.0, 0.3, second * S):
        second += 1
    return second - begun


def test_one_that_leads_nowhere_is_given_up_the_next_one_later() -> None:
    around = BugAlgorithm()
    assert flown_s(around, 0) == PATIENCE_S
    assert flown_s(around, 100) == 2 * PATIENCE_S
    assert not around.update(15.0, 0.3, 300 * S), "nearer"
    assert flown_s(around, 300) == PATIENCE_S, "patience is for one obstacle"


def test_forgotten_before_the_mission_engages() -> None:
    around = BugAlgorithm()
    around.update(20.0, 0.3, 0)
    around.update(20.0, 0.3, LATER_NS)
    around.reset()
    assert not around.update(30.0, 0.3, 2 * LATER_NS)
