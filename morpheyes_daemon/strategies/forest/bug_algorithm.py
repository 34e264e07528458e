"""Bug algorithm (boundary following): out of a dead end along one side, until nearer to the goal than ever before.

Lumelsky and Stepanov's algorithm (Algorithmica, 1987) on the free headings of the view. It begins only after the
weighted free and goal direction has brought the vehicle no nearer for STALLED_S, as in a pocket. It is given up after
PATIENCE_S without progress: among trees the boundary that is followed need not surround the goal.
"""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.transforms import Array

IN_VIEW_RAD = 1e-6
"""The goal is in view when clipping its direction to the view changes it by less than this.

Chosen: far above the rounding of an angle, far below the step between headings."""

STALLED_S = 15.0
"""Time without progress towards the goal after which boundary following begins.

Chosen: shorter begins at every detour around a tree, longer waits in a pocket."""

PATIENCE_S = 30.0
"""Boundary following without progress ends after this time, the next one after twice as long.

Chosen: long enough to leave a pocket among trees; longer follows a boundary that leads nowhere."""

PROGRESS_M = 1.0
"""Decrease of the distance to the goal that counts as progress.

Chosen: more than the drift of the position estimate, less than a tree's diameter and its margins."""

FREE_ENOUGH_M = 3.0
"""A heading that is free for this distance may be followed.

Chosen: room to fly on; a longer distance leaves the boundary in narrow places."""

FREE_SHARE = 0.6
"""Share of the longest free distance that is enough in narrow places. Unit: none.

Chosen: keeps to the boundary where no heading is free for FREE_ENOUGH_M; a lower one turns into it."""


class BugAlgorithm:
    """Whether a boundary is followed, and on which side it is kept (`side`): 1 right, -1 left, 0 none."""

    def __init__(self) -> None:
        self.side = 0
        self._best_m = float("inf")
        self._progress_ns = 0
        self._since_ns = 0
        self._patience_s = PATIENCE_S

    def reset(self) -> None:
        """Return to the state before the first update."""
        self.side, self._best_m, self._patience_s = 0, float("inf"), PATIENCE_S

    def update(self, distance_m: float, off_goal_rad: float, now_ns: int) -> bool:
        """Return whether a boundary is followed, given the distance to the goal.

        `off_goal_rad` is the goal's direction from the vehicle's heading, clockwise positive: the boundary is kept on
        that side.
        """
        if distance_m < self._best_m - PROGRESS_M:
            self.side, self._best_m, self._progress_ns, self._patience_s = 0, distance_m, now_ns, PATIENCE_S
        elif self.side == 0 and now_ns - self._progress_ns > STALLED_S * S:
            self.side, self._since_ns = 1 if off_goal_rad > 0.0 else -1, now_ns
        elif self.side != 0 and now_ns - self._since_ns >= self._patience_s * S:
            self._patience_s *= 2.0
            self.end(now_ns)
        return self.side != 0

    def end(self, now_ns: int) -> None:
        """Stop following the boundary and head for the goal again."""
        self.side, self._progress_ns = 0, now_ns

    def heading(self, headings_rad: Array, free_m: Array) -> int:
        """Return the index of the heading that keeps closest to the boundary.

        headings_rad: (M,) from left to right; free_m: (M,) free distances along them, metres.
        """
        free = np.flatnonzero(free_m >= min(FREE_ENOUGH_M, FREE_SHARE * float(free_m.max())))
        return int(free[-1] if self.side > 0 else free[0])
