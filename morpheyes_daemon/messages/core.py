"""What the tasks tell each other: frozen dataclasses with a stamp, made from whom, valid until when.

Stamps are monotonic nanoseconds of the injected clock, taken when the thing was measured, not when it arrived.
Arrays are read-only. Units and frames are in the names (docs/conventions.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.reasons import Reason

Image = NDArray[np.uint8]
FloatMap = NDArray[np.float32]
Mask = NDArray[np.bool_]
Vector = NDArray[np.float64]


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Mark an array read-only and return it."""
    array.flags.writeable = False
    return array


KNOWN_SHARE = 0.05
"""Share of a baseline that its sigma may be: beyond it depth has no scale, and rows mean nothing."""

SECTORS = 72
"""Directions of `Perception.sectors_m`: the length of the array in MAVLink's OBSTACLE_DISTANCE."""


@dataclass(frozen=True, slots=True)
class BaselineEstimate:
    """The modelled distance between the eyes at `t_ns`; the servo has no feedback, so it carries a sigma."""

    t_ns: int
    target_m: float
    baseline_m: float
    sigma_m: float
    moving: bool

    @property
    def known(self) -> bool:
        """True when sigma is a small share of the baseline."""
        return self.sigma_m < KNOWN_SHARE * self.baseline_m


@dataclass(frozen=True, slots=True, eq=False)
class RawPair:
    """What a camera backend delivers: two uint8 images (H, W) or (H, W, 3) BGR, same size.

    `t_ns` is mid-exposure of the left camera; the right one exposes within camera.sync_error_ms of it.
    """

    seq: int
    t_ns: int
    left: Image
    right: Image


@dataclass(frozen=True, slots=True, eq=False)
class StereoFrame:
    """A raw pair with the baseline that the model gives for its mid-exposure."""

    seq: int
    t_ns: int
    left: Image
    right: Image
    baseline: BaselineEstimate


@dataclass(frozen=True, slots=True)
class Pinhole:
    """The common K_rect of both rectified eyes; pixel (0, 0) is the centre of the top-left pixel."""

    width: int
    height: int
    f_px: float
    cx_px: float
    cy_px: float

    @property
    def h_fov_rad(self) -> float:
        """Horizontal field of view."""
        return math.atan((self.cx_px + 0.5) / self.f_px) + math.atan((self.width - 0.5 - self.cx_px) / self.f_px)


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Depth of every pixel of the rectified left eye, (H, W) float32 metres along z, NaN unknown.

    `near` (H, W) bool: unknown because closer than `near_limit_m` (at the disparity ceiling).
    `half_occluded` (H, W) bool: unknown because only the left eye sees it.
    `sigma_disparity_px` and the baseline's sigma give eps_z by `stereo.depth.depth_sigma`.
    """

    seq: int
    t_ns: int
    depth_m: FloatMap
    near: NDArray[np.bool_]
    half_occluded: NDArray[np.bool_]
    pinhole: Pinhole
    T_rig_rect: Vector
    baseline_m: float
    baseline_sigma_m: float
    sigma_disparity_px: float
    near_limit_m: float
    valid_fraction: float
    ceiling_fraction: float
    calibration_hash: str


@dataclass(frozen=True, slots=True)
class DepthSummary:
    """The part of a depth map that the event loop needs; `nearest_m` is the 1st percentile of known depth."""

    seq: int
    t_ns: int
    done_ns: int
    baseline_m: float
    baseline_sigma_m: float
    f_px: float
    h_fov_rad: float
    sigma_disparity_px: float
    near_limit_m: float
    valid_fraction: float
    ceiling_fraction: float
    nearest_m: float
    compute_s: float
    calibration_hash: str


@dataclass(frozen=True, slots=True, eq=False)
class Perception:
    """What the vision worker returns for one frame.

    `percept` is the strategy's own (picklable) finding. `sectors_m` (SECTORS,) float32 nearest obstacle per sector of
    the horizontal field of view, left to right, NaN free or unknown, for OBSTACLE_DISTANCE.
    `left_rect` and `depth_m` are small views for recorder and dashboard, or None when not asked for. `events` is what
    the watch over the calibration has to tell.
    """

    summary: DepthSummary
    percept: Any
    sectors_m: FloatMap
    image_faults: tuple[Reason, ...] = ()
    left_rect: Image | None = None
    depth_m: FloatMap | None = None
    events: tuple[Event, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class VehicleState:
    """The newest of what the autopilot said, each group with its own stamp (0: never heard).

    `rc_us` are RC_CHANNELS 1..16 (0: absent), `rc_rssi` their signal strength 0..254 (255: not measured).
    `position_t_ns` stamps p and v. `custom_mode` is ArduCopter's number.
    `sensors_present` and `sensors_health` are the bits of SYS_STATUS, `gps_fix` is GPS_RAW_INT's type of fix (-1: never
    told).
    """

    t_ns: int = 0
    attitude_t_ns: int = 0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    rates_frd_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position_t_ns: int = 0
    p_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    v_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    height_t_ns: int = 0
    height_m: float = math.nan
    heartbeat_t_ns: int = 0
    armed: bool = False
    custom_mode: int = -1
    system_status: int = 0
    rc_t_ns: int = 0
    rc_us: tuple[int, ...] = ()
    rc_rssi: int = 255
    ekf_t_ns: int = 0
    ekf_flags: int = 0
    sensors_present: int = 0
    sensors_health: int = 0
    gps_fix: int = -1
    battery_v: float = math.nan
    battery_fraction: float = math.nan
    gcs_t_ns: int = 0
    landed: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A moving object as of one frame: filtered position and velocity in ned with their covariance (6, 6).

    `seen` tells whether this very frame showed it; `p_rect_m` is then the middle of its visible face as measured, in
    the axes of the frame's rectified left eye (else as predicted), and `pixels` how many were its own. `radius_m` is
    half its size across. `id` changes when another object, or the same after a loss, is followed.
    """

    seq: int
    t_ns: int
    id: int
    seen: bool
    p_ned_m: tuple[float, float, float]
    v_ned_m_s: tuple[float, float, float]
    covariance: Vector
    p_rect_m: tuple[float, float, float]
    radius_m: float
    pixels: int
    baseline_m: float


class Intent(StrEnum):
    """What the mission wants of the vehicle."""

    FLY = "fly"
    STOP = "stop"
    DONE = "done"
    REFUSE = "refuse"


@dataclass(frozen=True, slots=True)
class Line:
    """A straight path to follow between two commands: through a point that is at `p_ned_m` at `t_ns` and moves with
    `v_ned_m_s` and `a_ned_m_s2`, along the command's velocity; when that is zero, the point itself is held.

    `gain_1_s` times the error is the correction, at most `max_m_s`; `integral_1_s2` removes the steady error of wind
    and drag. `fast_response` has the velocity loop use its fast gain on a filtered velocity.
    """

    t_ns: int
    p_ned_m: tuple[float, float, float]
    v_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    a_ned_m_s2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gain_1_s: float = 1.5
    integral_1_s2: float = 0.0
    max_m_s: float = 1.0
    fast_response: bool = False


@dataclass(frozen=True, slots=True)
class MissionCommand:
    """Velocity, heading and baseline that the mission wants; worthless after `expires_ns`.

    `clear_m` is how far the swept corridor along `v_ned_m_s` is known to be free, measured from where the vehicle
    was at `p_measured_ned_m`; the governor never lets the vehicle outrun it. `margin_m` has been taken off already.
    `coast` asks for neutral pitch and roll (the last stretch through a gap). `line` is kept to at every stick period,
    in height too when `height_m` is None. `detail` is for log and plots, `text` says more about the reason.
    """

    seq: int
    t_ns: int
    expires_ns: int
    intent: Intent
    reason: Reason | None
    v_ned_m_s: tuple[float, float, float]
    yaw_rad: float | None
    height_m: float | None
    baseline_m: float
    clear_m: float
    p_measured_ned_m: tuple[float, float, float]
    z_close_m: float = math.nan
    coast: bool = False
    detail: dict[str, float] = field(default_factory=dict)
    line: Line | None = None
    text: str = ""


@dataclass(frozen=True, slots=True)
class Sticks:
    """Pulse widths for the four sticks in microseconds, before the gate."""

    t_ns: int
    expires_ns: int
    roll_us: int
    pitch_us: int
    throttle_us: int
    yaw_us: int


@dataclass(frozen=True, slots=True)
class Governed:
    """What the governor allowed at one stick period, and which bound held the speed.

    `stick_limit_m_s` bounds the steady speed of the stick itself: held for as long as the autopilot would fly on
    without us, it must still leave room to stop.
    """

    t_ns: int
    limit_m_s: float
    bound: str
    clear_m: float
    trust_m: float
    speed_m_s: float
    wanted_m_s: float
    stick_limit_m_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Event:
    """An edge that must not be lost: a transition, a device lost or found, a refusal."""

    t_ns: int
    source: str
    reason: Reason
    text: str = ""
