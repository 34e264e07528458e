"""Parameters of a gap mission; every key with its bounds."""

from __future__ import annotations

from pydantic import Field

from morpheyes_daemon.strategies.base import StrategyParameters


class GapParameters(StrategyParameters):
    """The keys of `parameters:` in a gap mission."""

    speed_m_s: float = Field(2.9, gt=0.2, le=6, description="through the opening; the governor bounds it further")
    approach_m_s: float = Field(1.2, gt=0.1, le=3, description="to the stand-off")
    stand_off_m: float = Field(4.0, gt=1.5, le=10, description="distance to the wall for measuring, start of the run")
    margin_m: float = Field(0.0, ge=0, le=0.5, description="clearance around the silhouette that must be measured")
    lean_deg: float = Field(12.0, ge=0, le=30, description="of the vehicle when crossing, for its silhouette")
    baseline_gain: float = Field(0.05, gt=0, le=1, description="K of b = K median(Z_C)")
    confirm_frames: int = Field(5, ge=2, le=50, description="consecutive frames that must show that it fits")
    off_line_m: float = Field(0.05, gt=0.005, le=0.5, description="largest offset from the line at the start of the run")
    look_s: float = Field(12.0, gt=1, le=120, description="time without an opening after which it refuses")
    watch_s: float = Field(16.0, gt=2, le=60, description="time for which a moving opening is observed before the run")
    behind_m: float = Field(0.6, gt=0.2, le=10, description="distance past the wall at which it stops")
