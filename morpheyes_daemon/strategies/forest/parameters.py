"""Parameters of a forest mission; every key with its bounds."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from morpheyes_daemon.config.vehicle import Section
from morpheyes_daemon.strategies.base import StrategyParameters

OPEN_BEYOND_M = 0.6
"""A direction is worth flying in when it is free for this much more than `safe_m`.

Chosen: less stops again at once, more turns away from narrow passages."""


class Goal(Section):
    """Where to go, relative to the position and heading in which the mission engaged."""

    forward_m: float = Field(80.0, ge=-10000, le=10000)
    right_m: float = Field(0.0, ge=-10000, le=10000)


class ForestParameters(StrategyParameters):
    """The keys of `parameters:` in a forest mission."""

    goal: Goal = Goal()
    goal_radius_m: float = Field(1.5, gt=0.2, le=20, description="the goal counts as reached within this")
    height_m: float | None = Field(None, gt=0.3, le=20, description="None: the height at which it engaged")
    speed_m_s: float = Field(5.0, gt=0.1, le=10, description="largest speed wanted; the governor bounds it further")
    baseline_gain: float = Field(0.02, gt=0, le=1, description="K of b = K Z_close")
    baseline_smoothing_s: float = Field(0.5, ge=0, le=10, description="time constant of the low-passed Z_close")
    margin_m: float = Field(0.30, ge=0, le=3, description="margin to obstacles on each side")
    tight_margin_m: float = Field(0.15, ge=0, le=3, description="margin where nothing wider is free")
    band_margin_m: float = Field(0.20, ge=0, le=3, description="margin above and below")
    safe_m: float = Field(0.4, ge=0, le=10, description="tau_safe: stop when the corridor closes within this")
    memory_s: float = Field(6.0, ge=0, le=60, description="how long obstacles out of view are remembered")
    reach_m: float = Field(16.0, gt=1, le=100, description="range up to which directions are compared")
    weight: Literal["stopping", "paper"] | float = Field(
        "stopping", description="Z_0 of the weight: twice the stopping distance, the paper's printed form, or metres"
    )
    turn_gains: tuple[float, float, float] = Field((1.2, 0.0, 0.05), description="kp, ki, kd on the heading error")
    look_rate_deg_s: float = Field(35.0, gt=1, le=90, description="yaw rate when searching a free direction")

    @model_validator(mode="after")
    def _ordered(self) -> ForestParameters:
        if self.tight_margin_m > self.margin_m:
            raise ValueError("tight_margin_m must not be greater than margin_m")
        if self.reach_m < self.safe_m + OPEN_BEYOND_M:
            raise ValueError(f"reach_m must be at least {OPEN_BEYOND_M:g} m more than safe_m, or no direction is free")
        return self
