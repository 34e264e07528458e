"""Out of a dead end: keep to one side until nearer to the goal than ever before.

Lumelsky and Stepanov's Bug algorithm (Algorithmica, 1987) on the free headings of the view. It begins only where
weighing free and goal direction has brought the vehicle no nearer for long, as in a pocket. It is given up when it
leads nowhere either: among trees what is followed need not surround the goal.
"""

from __future__ import annotations

import numpy as np

from morpheyes_daemon.clock import S
from morpheyes_daemon.strategies.obstacles.polar_profile import Floats

STALLED_S = 15.0
"""No nearer to the goal for so long: there is something to go around."""

PATIENCE_S = 30.0
"""A way around that has led nowhere for so long is given up, the next one after twice the time."""

NEARER_M = 1.0
"""What counts as nearer."""

WIDE_M = 3.0
"""A heading so free is free enough to be followed."""


class BugAlgorithm:
    """Whether a way around is being flown, and on which side what is in the way is kept: 1 right, -1 left, 0 none."""

    def __init__(self) -> None:
        self.side = 0
        self._best_m = float("inf")
        self._nearer_ns = 0
        self._since_ns = 0
        self._patience_s = PATIENCE_S

    def reset(self) -> None:
        """Forget everything."""
        self.side, self._best_m, self._patience_s = 0, float("inf"), PATIENCE_S

    def update(self, distance_m: float, off_goal_rad: float, now_ns: int) -> bool:
        """Return whether a way around is being flown.

        `off_goal_rad` is the goal's direction from the nose: what lies between is kept on that side.
        """
        if distance_m < self._best_m - NEARER_M:
            self.side, self._best_m, self._nearer_ns, self._patience_s = 0, distance_m, now_ns, PATIENCE_S
        elif self.side == 0 and now_ns - self._nearer_ns > STALLED_S * S:
            self.side, self._since_ns = 1 if off_goal_rad > 0.0 else -1, now_ns
        elif self.side != 0 and now_ns - self._since_ns >= self._patience_s * S:
            self._patience_s *= 2.0
            self.end(now_ns)
        return self.side != 0

    def end(self, now_ns: int) -> None:
        """Make for the goal again: nothing is in the way, or going around leads nowhere."""
        self.side, self._nearer_ns = 0, now_ns

    def heading(self, headings_rad: Floats, free_m: Floats) -> int:
        """Return which of the headings (M,), left to right, keeps closest to what is in the way."""
        wide = np.flatnonzero(free_m >= min(WIDE_M, 0.6 * float(free_m.max())))
        return int(wide[-1] if self.side > 0 else wide[0])
