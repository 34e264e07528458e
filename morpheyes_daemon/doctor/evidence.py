"""What a rule may ask of the autopilot's parameters, and how it puts what it finds into words.

Each predicate returns the evidence as a text, None when all is well. Which finding is how grave stands in
parameter_rules.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.control import parameters as p
from morpheyes_daemon.control.loiter import LoiterModel

BRAKE_DELAY_S = 0.2
LOITER_SPEED_M_S = 5.0
LOITER_SPEEDS_M_S = (4.0, 7.0)
OVERRIDE_TIME_S = 1.0
FORWARD_M_S = 3.0
"""The speed at which stopping distances are quoted."""

LOITER, LAND_FAILSAFE, AVOID_STOP, PROXIMITY_MAVLINK, DOWNWARD = 5, 3, 1, 2, 25
RTL_FAILSAFES = (1, 2, 4, 6)
USE_PROXIMITY = 2
IGNORE_RECEIVER, IGNORE_OVERRIDES = 1, 2
GPS_VELOCITY = 3


@dataclass(frozen=True, slots=True)
class Subject:
    """The parameters under examination with the configuration they must fit."""

    values: Mapping[str, float]
    config: VehicleConfig

    def get(self, name: str, default: float = 0.0) -> float:
        """Return a parameter, `default` where the firmware has none."""
        return self.values.get(name, default)

    def has(self, name: str) -> bool:
        """Return whether the firmware has a parameter."""
        return name in self.values

    @property
    def reserve_s(self) -> float:
        """How long the governor reckons that the vehicle flies on without us."""
        return self.config.safety.dead_daemon_s

    @property
    def on_flow(self) -> bool:
        """True when velocity comes from optical flow."""
        return round(p.VELOCITY_SOURCE.read(self.values)) == p.OPTICAL_FLOW

    @property
    def may_avoid(self) -> bool:
        """True when the autopilot would avoid what a proximity sensor shows, and we publish as one."""
        return self.config.autopilot.publish_obstacles and bool(int(self.get("AVOID_ENABLE")) & USE_PROXIMITY)

    @property
    def avoids(self) -> bool:
        """True when it also takes our OBSTACLE_DISTANCE for that sensor."""
        return self.may_avoid and self.get("PRX1_TYPE") == PROXIMITY_MAVLINK


Broken = Callable[[Subject], str | None]
Changes = Callable[[Subject], dict[str, float]]


def equals(name: str, *values: float) -> Broken:
    """Broken where the parameter exists and is one of these."""

    def broken(s: Subject) -> str | None:
        return f"{name} is {s.get(name):g}" if s.has(name) and s.get(name) in values else None

    return broken


def is_not(name: str, value: float) -> Broken:
    """Broken where the parameter exists and is anything else."""

    def broken(s: Subject) -> str | None:
        return f"{name} is {s.get(name):g}" if s.has(name) and s.get(name) != value else None

    return broken


def above(name: str, limit: float, unit: str = "") -> Broken:
    """Broken where the parameter is larger; a thousandth is left for its float32."""
    return lambda s: f"{name} is {s.get(name):g}{unit}" if s.get(name) > limit + 1e-3 else None


def at_most(name: str, limit: float, unit: str = "") -> Broken:
    """Broken where the parameter exists and is this or smaller."""
    return lambda s: f"{name} is {s.get(name):g}{unit}" if s.has(name) and s.get(name) <= limit else None


def where(condition: Callable[[Subject], bool], broken: Broken) -> Broken:
    """Broken only where the condition holds."""
    return lambda s: broken(s) if condition(s) else None


def to(**changes: float) -> Changes:
    """Set these."""
    return lambda s: dict(changes)


def shorter_override(s: Subject) -> dict[str, float]:
    """An override time that the governor's reserve covers."""
    return {"RC_OVERRIDE_TIME": max(0.2, min(OVERRIDE_TIME_S, s.reserve_s))}


def outlives_reserve(s: Subject) -> str | None:
    """The last stick is held for longer than the governor reckons with."""
    held_s = s.get("RC_OVERRIDE_TIME")
    if held_s <= s.reserve_s + 0.05:
        return None
    return f"RC_OVERRIDE_TIME is {held_s:g} s, and safety.dead_daemon_s is {s.reserve_s:g} s"


def contains(name: str, mask: int) -> Broken:
    """Broken where a bit of the mask is set."""
    return lambda s: f"{name} is {s.get(name):g}, which contains {mask}" if int(s.get(name)) & mask else None


def without(name: str, mask: int) -> Changes:
    """Clear the bits of the mask."""
    return lambda s: {name: float(int(s.get(name)) & ~mask)}


def other_gcs_sysid(s: Subject) -> str | None:
    """Overrides would come from an id that the autopilot does not listen to."""
    name, low = p.GCS_SYSID.find(s.values) or ("MAV_GCS_SYSID", 255.0)
    high = max(low, s.get("MAV_GCS_SYSID_HI"))
    ours = s.config.autopilot.override_sysid
    return None if low <= ours <= high else f"{name} is {low:g}, and autopilot.override_sysid is {ours}"


def climbs(name: str, actions: tuple[int, ...]) -> Broken:
    """Broken where the action is one that returns to launch, and that climbs."""

    def broken(s: Subject) -> str | None:
        altitude = p.RTL_ALTITUDE.read(s.values)
        if s.get(name) not in actions or altitude <= 0.0:
            return None
        return f"{name} is {s.get(name):g}, which returns to launch at {altitude:g} m"

    return broken


def stops_in(s: Subject, **changes: float) -> str:
    """Return in words how far it goes from FORWARD_M_S with neutral sticks."""
    model = LoiterModel.from_parameters({**s.values, **changes})
    return f"{model.stopping_distance_m(FORWARD_M_S, math.nan):.1f} m"


def slow_brake(s: Subject) -> str | None:
    """Braking begins late."""
    delay = p.LOIT_BRK_DELAY.read(s.values)
    if delay <= BRAKE_DELAY_S + 1e-3:
        return None
    better = stops_in(s, **p.LOIT_BRK_DELAY.change(s.values, BRAKE_DELAY_S))
    return f"LOIT_BRK_DELAY is {delay:g} s: {stops_in(s)} to stop from {FORWARD_M_S:g} m/s instead of {better}"


def odd_loiter_speed(s: Subject) -> str | None:
    """The stick answers slowly, or tops out below the speed of a mission."""
    name, speed = p.LOIT_SPEED.find(s.values) or ("LOIT_SPEED", 0.0)
    if LOITER_SPEEDS_M_S[0] <= speed <= LOITER_SPEEDS_M_S[1]:
        return None
    model = LoiterModel.from_parameters(s.values)
    lag = model.time_constant_s(math.nan)
    stop = f"{stops_in(s)} to stop from {FORWARD_M_S:g} m/s"
    return f"{name} means {speed:g} m/s: a stick takes {lag:.1f} s to act, and it takes {stop}"


def weak_brake(s: Subject) -> str | None:
    """Braking is soft."""
    accel, jerk = p.LOIT_BRK_ACCEL.read(s.values), p.LOIT_BRK_JERK.read(s.values)
    weak = accel < 2.0 or jerk < 4.0
    stop = f"{stops_in(s)} from {FORWARD_M_S:g} m/s"
    return f"Loiter brakes with {accel:g} m/s2 and {jerk:g} m/s3: {stop}" if weak else None


def shares_mode_channel(s: Subject) -> str | None:
    """Engaging would also change the mode."""
    same = mode_channel(s) == s.config.autopilot.engage_channel
    return f"FLTMODE_CH is {mode_channel(s)}, and so is autopilot.engage_channel" if same else None


def unwatched_gcs(s: Subject) -> str | None:
    """A ground station failsafe that our overrides hold off, with nobody else watching."""
    if s.get("FS_GCS_ENABLE") <= 0 or s.config.autopilot.watch_gcs:
        return None
    return f"FS_GCS_ENABLE is {s.get('FS_GCS_ENABLE'):g}, and autopilot.watch_gcs is off"


def assigned_switch(s: Subject) -> str | None:
    """The engage switch's channel has a function of the autopilot."""
    name = f"RC{s.config.autopilot.engage_channel}_OPTION"
    return f"{name} is {s.get(name):g}: the engage switch does something else too" if s.get(name) else None


def mode_channel(s: Subject) -> int:
    """Return the channel of the pilot's mode switch."""
    return round(s.get("FLTMODE_CH", 5.0))


def no_loiter_on_switch(s: Subject) -> str | None:
    """No position of the mode switch is Loiter."""
    modes = [round(s.get(f"FLTMODE{i}", -1.0)) for i in range(1, 7)]
    return None if LOITER in modes else f"FLTMODE1 to 6 are {', '.join(map(str, modes))}: none is 5, Loiter"


def slow_over_flow(s: Subject) -> str | None:
    """The flow sensor limits the speed at low height."""
    model = LoiterModel.from_parameters(s.values)
    wanted = s.config.safety.max_speed_m_s
    if model.flow_rate_1_s is None or model.limit_m_s(2.0) >= wanted:
        return None
    one, two = model.limit_m_s(1.0), model.limit_m_s(2.0)
    return f"over the flow sensor it flies {one:.1f} m/s at 1 m of height and {two:.1f} at 2 m"


def low_ceiling(s: Subject) -> str | None:
    """ArduCopter keeps a flow-only vehicle below 0.7 of the rangefinder's reach less 1 m."""
    reach = s.get("RNGFND1_MAX") if s.has("RNGFND1_MAX") else s.get("RNGFND1_MAX_CM", 4000.0) / 100.0
    ceiling = 0.7 * reach - 1.0
    return f"the rangefinder's {reach:g} m let it climb to {ceiling:.1f} m only" if ceiling < 2.5 else None
