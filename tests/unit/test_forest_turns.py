"""The forest mission slows down where the way to a new heading bends through something before the next frame."""

from __future__ import annotations

import numpy as np
import pytest

from morpheyes_daemon.config import Footprint
from morpheyes_daemon.strategies.base import Craft
from morpheyes_daemon.strategies.forest import Forest, ForestParameters, Goal

TREE = np.array([[1.65, 1.5]])
"""Off the straight ways along x and along y, on the bend between them."""
AHEAD, ASIDE = np.array([3.0, 0.0]), np.array([0.0, 3.0])


def share(frame_period_s: float, obstacles: np.ndarray, before: np.ndarray, wanted: np.ndarray) -> float:
    craft = Craft(Footprint(), np.eye(4), (0.1, 0.3), frame_period_s, 3.0, 0.2)
    return Forest(ForestParameters(goal=Goal()), craft)._turnable(obstacles, before, wanted, 0.4)


def test_a_bend_through_a_tree_is_taken_slower_with_frames_far_apart() -> None:
    assert share(1.0, TREE, AHEAD, ASIDE) < 1.0


def test_with_frames_close_together_the_next_one_is_in_time() -> None:
    assert share(0.2, TREE, AHEAD, ASIDE) == 1.0


@pytest.mark.parametrize("obstacles", [np.empty((0, 2)), np.array([[9.0, -5.0]])], ids=["nothing", "far away"])
def test_a_free_way_is_not_slowed(obstacles: np.ndarray) -> None:
    assert share(1.0, obstacles, AHEAD, ASIDE) == 1.0
