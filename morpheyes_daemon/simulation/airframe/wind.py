"""The air around the vehicle: wind that grows with height, and gusts.

Mean wind plus three independent first-order (Ornstein-Uhlenbeck) gusts with the intensity and length scale of the
Dryden model at low altitude (MIL-F-8785C, 3.7.3.4, below 1000 ft): sigma_w = 0.1 W20,
sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4, L_u = h / (0.177 + 0.000823 h)^1.2, L_w = h, h in feet and at
least 10. The lateral spectra's second pole is left out. The mean grows with height as that standard's wind shear
(3.7.3.3, roughness 0.15 ft). Wind is not known to the vehicle; Loiter has to reject it.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

_FT_M = 0.3048
_LOWEST_FT = 10.0
"""The gust model ends at 10 ft; below that its values there are used."""
_ROUGHNESS_FT = 0.15
_SHEAR_AT_20_FT = math.log(20.0 / _ROUGHNESS_FT)


@dataclass(frozen=True, slots=True)
class WindConditions:
    """Mean wind at 6 m (20 ft), where the wind comes from over ground, and how much of the Dryden gusts to apply."""

    speed_m_s: float = 0.0
    from_rad: float = 0.0
    gust_fraction: float = 1.0

    def mean_ned_m_s(self) -> tuple[float, float]:
        """Return the velocity (north, east) of the mean wind."""
        return -self.speed_m_s * math.cos(self.from_rad), -self.speed_m_s * math.sin(self.from_rad)


CALM = WindConditions()


class Wind:
    """The velocity of the air; `advance` steps the gusts, `velocity_ned_m_s` holds between steps."""

    def __init__(self, conditions: WindConditions, seed: int) -> None:
        self._random = random.Random(f"wind {seed}")
        self._conditions = conditions
        self._mean = conditions.mean_ned_m_s()
        self._gust = [0.0, 0.0, 0.0]
        self.velocity_ned_m_s = (0.0, 0.0, 0.0)

    def advance(self, dt_s: float, height_m: float, airspeed_m_s: float) -> None:
        """Step the gusts by `dt_s` for a vehicle at `height_m` that meets the air at `airspeed_m_s`."""
        wind_m_s = self._conditions.speed_m_s
        if wind_m_s <= 0.0:
            return
        height_ft = max(_LOWEST_FT, height_m / _FT_M)
        shape = 0.177 + 0.000823 * height_ft
        sigma_w = 0.1 * wind_m_s * self._conditions.gust_fraction
        sigma_u = sigma_w / shape**0.4
        speed_m_s = max(airspeed_m_s, wind_m_s)
        self._step(0, dt_s * speed_m_s / (_FT_M * height_ft / shape**1.2), sigma_u)
        self._step(1, dt_s * speed_m_s / (_FT_M * height_ft / shape**1.2), sigma_u)
        self._step(2, dt_s * speed_m_s / (_FT_M * height_ft), sigma_w)
        north, east, down = self._gust
        shear = max(0.0, math.log(max(height_m / _FT_M, _ROUGHNESS_FT) / _ROUGHNESS_FT) / _SHEAR_AT_20_FT)
        self.velocity_ned_m_s = (shear * self._mean[0] + north, shear * self._mean[1] + east, down)

    def _step(self, axis: int, dt_over_tau: float, sigma_m_s: float) -> None:
        keep = math.exp(-dt_over_tau)
        self._gust[axis] = keep * self._gust[axis] + sigma_m_s * math.sqrt(1.0 - keep * keep) * self._random.gauss()
