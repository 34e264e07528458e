"""Changes that no test could notice, each with its reason."""

from __future__ import annotations

from tests.mutation.changes import Mutant

_UNHEARD = "until the switch is heard `on` is False, and hearing it sets the flip"
_UNSENT = "set before it is read: by the first step, or by the beginning of a release"

_BEGINNING = "a nanosecond about the clock's beginning"
_FIRST_STEP = "the first step enters a state, which forgets the offer whatever the pause"
_NOTHING_ADDED = "zero away is neutral, and zero had adds nothing"
_LEAVING = "on the way out only RELEASED and PILOT are outside flight, and neither heeds readiness or faults"
_HOLD = "in HOLD nothing that asks for it has a row, and every way out sets it anew"
_ENTERED = "the first transition sets it, and it is read in flight"

_EQUAL = "differs only where two measured lengths or angles are equal to the last bit"

EQUIVALENT: dict[tuple[str, str, str], str] = {
    ("safety/engage_switch.py", "self._flipped = False", "drop assign"): _UNHEARD,
    ("safety/engage_switch.py", "self._flipped = False", "False to True"): _UNHEARD,
    ("safety/engage_switch.py", "self._since_ns = self._heard_ns = 0", "0 plus 1"): _BEGINNING,
    ("safety/engage_switch.py", "self._since_ns = self._heard_ns = 0", "0 minus 1"): _BEGINNING,
    (
        "safety/engage_switch.py",
        "self._flipped = on and self._on is False and t_ns - self._since_ns >= STEADY_NS",
        "drop term 0",
    ): "what differs from off is on",
    ("safety/gate.py", "self._offer: Sticks | None = None", "drop annassign"): _UNSENT,
    ("safety/gate.py", "self._expiry: dict[Lease, int] = dict.fromkeys(Lease, 0)", "0 minus 1"): _BEGINNING,
    ("safety/gate.py", "self._expiry[lease] = 0", "0 plus 1"): _BEGINNING,
    ("safety/gate.py", "self._expiry[lease] = 0", "0 minus 1"): _BEGINNING,
    ("safety/gate.py", "self._stepped_ns = self._pause_ns = 0", "0 plus 1"): _FIRST_STEP,
    ("safety/gate.py", "self._stepped_ns = self._pause_ns = 0", "0 minus 1"): _FIRST_STEP,
    ("safety/gate.py", "self._releases = 0", "drop assign"): _UNSENT,
    ("safety/gate.py", "self._releases = 0", "0 plus 1"): _UNSENT,
    ("safety/gate.py", "self._releases = 0", "0 minus 1"): _UNSENT,
    ("safety/gate.py", "self._release_ns = None", "drop assign"): "who lets go of a stick begins a release anew",
    ("safety/gate.py", "same_side = (had - neutral) * away > 0", "Gt to GtE"): _NOTHING_ADDED,
    ("safety/gate.py", "same_side = (had - neutral) * away > 0", "0 minus 1"): _NOTHING_ADDED,
    (
        "safety/gate.py",
        "return neutral + (away if abs(away) <= reach else int(math.copysign(reach, away)))",
        "LtE to Lt",
    ): "as far as it reaches is where it wants to be",
    (
        "safety/monitor.py",
        "self._vehicle = VehicleState()",
        "drop assign",
    ): "not before it is heard is every lease fresh",
    ("safety/monitor.py", "self._latched = False", "drop assign"): _ENTERED,
    ("safety/monitor.py", "self._latched = False", "False to True"): _ENTERED,
    ("safety/monitor.py", "self._flown_ns = 0", "0 plus 1"): "the later of it and engaging counts",
    ("safety/monitor.py", "self._flown_ns = 0", "0 minus 1"): "the later of it and engaging counts",
    (
        "safety/monitor.py",
        "return self._leaving and self.state not in HOLDING and self.gate.silent",
        "drop term 1",
    ): "a gate that holds sticks is not silent",
    ("safety/monitor.py", "if self._leaving:", "drop if"): _LEAVING,
    ("safety/monitor.py", "if self._leaving:", "if False"): _LEAVING,
    ("safety/monitor.py", "return", "drop return"): _LEAVING,
    ("safety/monitor.py", "return None", "drop return"): "who returns nothing returns None",
    ("safety/monitor.py", "self._switch.use()", "drop expr"): "out of flight the way back is by the switch off",
    (
        "safety/monitor.py",
        "if self.state is State.BRAKING:",
        "if True",
    ): "what it fires has no row in the other two states",
    ("safety/monitor.py", "elif step.after is not State.HOLD:", "if True"): _HOLD,
    ("safety/monitor.py", "elif step.after is not State.HOLD:", "HOLD to PILOT"): _HOLD,
    (
        "wire/servo.py",
        "if code == 0 or len(block) != code - 1 or 0 in block:",
        "drop term 0",
    ): "a block of code 0 is empty, and its length is not -1",
    (
        "strategies/forest/strategy.py",
        "if z_close < min(OPEN_SHARE * reach, distance_m, z_free):",
        "Lt to LtE",
    ): _EQUAL,
    (
        "strategies/forest/strategy.py",
        "if z_goal >= distance_m and abs(wrap_rad(clipped_goal - goal_rad)) < IN_VIEW_RAD:",
        "Lt to LtE",
    ): _EQUAL,
    (
        "strategies/forest/strategy.py",
        "free_rad = float(headings[int(np.argmax(np.where(free >= parameters.safe_m, progress, -np.inf)))])",
        "GtE to Gt",
    ): _EQUAL,
    (
        "strategies/obstacles/ground_slope.py",
        "turn = (np.arctan2(east, north) + np.pi) / (2.0 * np.pi) * 6 * SECTORS",
        "Add to Sub",
    ): "cells are numbered otherwise, by a whole turn",
    (
        "control/baseline.py",
        "return self._legs[max(0, bisect_right(self._legs, t_ns, key=lambda leg: leg.start_ns) - 1)]",
        "0 minus 1",
    ): "before the first leg every leg is still to end, and the place is that of the start",
}
"""(file, line of source, change) -> why no test could notice."""


def reason_of(mutant: Mutant) -> str | None:
    """Return why a mutant may survive, None when nothing explains it."""
    return EQUIVALENT.get((mutant.file, mutant.source, mutant.change))
