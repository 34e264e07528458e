"""The free corridor against a slow reference that moves the disc forward in small steps."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.strategies.obstacles.corridor import free_distance_m

STEP_M = 0.01


def walked(points: np.ndarray, heading: float, half_width: float, reach: float) -> float:
    """Move a disc along the heading until a point would come nearer than before and lies inside it."""
    ahead = np.array([math.cos(heading), math.sin(heading)])
    distance = 0.0
    while distance < reach:
        relative = points - distance * ahead
        inside = np.hypot(relative[:, 0], relative[:, 1]) < half_width
        if np.any(inside & (relative @ ahead > 0.0)):
            return distance
        distance += STEP_M
    return reach


coordinate = st.floats(-8.0, 8.0)


@given(st.lists(st.tuples(coordinate, coordinate), max_size=8), st.floats(-3.1, 3.1), st.floats(0.2, 1.0))
def test_the_free_distance_is_that_of_a_pushed_disc(
    places: list[tuple[float, float]], heading: float, width: float
) -> None:
    points = np.array(places, dtype=np.float64).reshape(-1, 2)
    free = float(free_distance_m(points, np.array([heading]), width, 6.0)[0])
    # one step of the reference, and a step more where the disc just grazes a point
    assert free <= walked(points, heading, width, 6.0) + STEP_M
    assert walked(points, heading, width - 1e-3, 6.0) >= free - 2 * STEP_M


def test_a_point_behind_blocks_no_heading() -> None:
    assert free_distance_m(np.array([[-0.1, 0.0]]), np.array([0.0]), 0.5, 4.0)[0] == 4.0
    assert free_distance_m(np.array([[-0.1, 0.0]]), np.array([math.pi]), 0.5, 4.0)[0] == 0.0
