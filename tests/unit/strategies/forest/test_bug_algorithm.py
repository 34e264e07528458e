"""Boundary following begins without progress to the goal, keeps to one side, and ends nearer to the goal."""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.forest.bug_algorithm import PATIENCE_S, STALLED_S, BugAlgorithm

LATER_NS = round((STALLED_S + 1.0) * S)
HEADINGS = np.linspace(-0.5, 0.5, 11)


def test_boundary_following_begins_only_without_progress() -> None:
    bug = BugAlgorithm()
    for second in range(60):
        assert not bug.update(80.0 - 0.5 * second, 0.1, second * S)
    assert not bug.update(51.0, 0.1, 60 * S)
    assert bug.update(51.0, 0.1, 60 * S + LATER_NS)


def test_the_boundary_stays_on_the_goals_side_until_progress() -> None:
    bug = BugAlgorithm()
    bug.update(20.0, -0.3, 0)
    assert bug.update(20.0, -0.3, LATER_NS)
    assert bug.side == -1
    assert bug.update(26.0, 1.2, 2 * LATER_NS), "away from the goal at first"
    assert bug.side == -1, "the side stays when the goal passes to the other"
    assert not bug.update(18.9, 0.0, 3 * LATER_NS)
    assert not bug.update(18.9, 0.0, 3 * LATER_NS + S), "the next one begins after another stall only"


def test_the_outermost_free_heading_is_followed() -> None:
    bug = BugAlgorithm()
    bug.update(20.0, 0.3, 0)
    bug.update(20.0, 0.3, LATER_NS)
    free = np.array([9.0, 9.0, 9.0, 8.0, 6.0, 5.0, 4.0, 3.5, 1.5, 0.8, 0.4])
    assert bug.heading(HEADINGS, free) == 7
    assert bug.heading(HEADINGS, free / 5.0) == 4, "in narrow places six tenths of the best are enough"


def test_boundary_following_ends_on_request() -> None:
    bug = BugAlgorithm()
    bug.update(20.0, 0.3, 0)
    assert bug.update(20.0, 0.3, LATER_NS)
    bug.end(LATER_NS)
    assert not bug.update(20.0, 0.3, LATER_NS + S)


def flown_s(bug: BugAlgorithm, second: int) -> int:
    """Return how long boundary following lasts without progress, when it begins after `second`."""
    while not bug.update(20.0, 0.3, second * S):
        second += 1
    begun = second
    while bug.update(20.0, 0.3, second * S):
        second += 1
    return second - begun


def test_without_progress_it_ends_and_the_next_one_lasts_twice_as_long() -> None:
    bug = BugAlgorithm()
    assert flown_s(bug, 0) == PATIENCE_S
    assert flown_s(bug, 100) == 2 * PATIENCE_S
    assert not bug.update(15.0, 0.3, 300 * S), "progress"
    assert flown_s(bug, 300) == PATIENCE_S, "progress resets the patience"


def test_reset_forgets_the_best_distance() -> None:
    bug = BugAlgorithm()
    bug.update(20.0, 0.3, 0)
    bug.update(20.0, 0.3, LATER_NS)
    bug.reset()
    assert not bug.update(30.0, 0.3, 2 * LATER_NS)
