"""The vehicle's configuration: what `config.yaml` may say, with bounds and units on every key.

Screen units (`_mm`, `_deg`) are allowed here and converted by the properties; everything past this file is SI.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, field_validator, model_validator


class Section(BaseModel):
    """A strict, frozen part of a YAML file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Footprint(Section):
    """How much room the vehicle takes, as numbers."""

    hull_length_mm: float = Field(337.0, gt=50, lt=2000, description="nose to tail over the propeller tips")
    hull_width_mm: float = Field(337.0, gt=50, lt=2000, description="side to side over the propeller tips")
    hull_height_mm: float = Field(120.0, gt=20, lt=1000, description="skid to antenna")
    bar_depth_mm: float = Field(40.0, gt=5, lt=300, description="stereo bar, front to back")
    bar_height_mm: float = Field(30.0, gt=5, lt=300, description="stereo bar, top to bottom")
    camera_width_mm: float = Field(30.0, gt=1, lt=200, description="one camera; the bar is baseline + this wide")

    def width_m(self, baseline_m: float) -> float:
        """Widest extent, hull or bar, at a baseline."""
        return max(self.hull_width_mm / 1e3, baseline_m + self.camera_width_mm / 1e3)


class Mount(Section):
    """Where the stereo bar sits on the body, frd, and how far it is tilted up."""

    forward_mm: float = Field(90.0, gt=-500, lt=500)
    right_mm: float = Field(0.0, gt=-500, lt=500)
    down_mm: float = Field(-20.0, gt=-500, lt=500)
    tilt_up_deg: float = Field(8.0, ge=-45, le=45, description="camera axis above the body's forward axis")


class CameraBase(Section):
    """What every camera backend has: image size, frame rate, mount."""

    width_px: int = Field(640, ge=160, le=4096)
    height_px: int = Field(480, ge=120, le=3072)
    rate_hz: float = Field(5.0, gt=0.1, le=120, description="stereo pairs per second")
    h_fov_deg: float | None = Field(
        None, ge=20, le=140, description="horizontal field of view by the lens's data sheet; the doctor compares"
    )
    sync_error_ms: float = Field(2.0, ge=0, le=100, description="largest time between the eyes, measured")
    mount: Mount = Mount()


class SimCameraConfig(CameraBase):
    """Frames rendered by the simulator (`morpheyes sim`)."""

    backend: Literal["sim"] = "sim"
    address: str | None = Field(None, description="socket of the simulator in real time; None: the same process")


class RecordingCameraConfig(CameraBase):
    """Frames from a folder or video of side-by-side or left/right images."""

    backend: Literal["recording"]
    path: Path = Field(description="folder or video file")
    loop: bool = Field(True, description="start again at the end")


class V4l2CameraConfig(CameraBase):
    """A side-by-side UVC camera."""

    backend: Literal["v4l2"]
    device: str = Field("/dev/video0", min_length=1)
    swap_eyes: bool = Field(False, description="the right eye is in the left half")


class PluginConfig(Section):
    """A backend of another package, found through its entry point; it checks the `options` itself."""

    group: ClassVar[str]
    built_in: ClassVar[tuple[str, ...]]

    backend: str = Field(min_length=1, max_length=100)
    options: Any = Field(default_factory=dict, description="the backend's own settings")

    @field_validator("backend")
    @classmethod
    def _installed(cls, backend: str) -> str:
        installed = {point.name for point in entry_points(group=cls.group)}
        if backend not in installed:
            names = ", ".join(sorted({*cls.built_in, *installed}))
            raise ValueError(f"there is no backend {backend!r}; installed are: {names}")
        return backend


class PluginCameraConfig(CameraBase, PluginConfig):
    """A camera of another package (entry point group `morpheyes.cameras`)."""

    group = "morpheyes.cameras"
    built_in = ("recording", "sim", "v4l2")


def _backend_of(*built_in: str) -> Discriminator:
    """Choose among the named backends; any other name is a plugin's."""

    def tag(value: Any) -> str:
        backend = value.get("backend") if isinstance(value, dict) else getattr(value, "backend", None)
        return backend if backend in built_in else "plugin"

    return Discriminator(tag)


CameraConfig = Annotated[
    Annotated[SimCameraConfig, Tag("sim")]
    | Annotated[RecordingCameraConfig, Tag("recording")]
    | Annotated[V4l2CameraConfig, Tag("v4l2")]
    | Annotated[PluginCameraConfig, Tag("plugin")],
    _backend_of(*PluginCameraConfig.built_in),
]


class ServoMotion(Section):
    """What the linear servos do, from their data sheet; there is no feedback to measure it in flight."""

    min_baseline_mm: float = Field(100.0, ge=10, le=1000)
    max_baseline_mm: float = Field(300.0, ge=10, le=1000)
    speed_mm_s: float = Field(25.0, gt=0, le=500, description="one camera; the baseline changes twice as fast")
    backlash_mm: float = Field(0.25, ge=0, le=5, description="one camera")
    settle_ms: float = Field(150.0, ge=0, le=2000)
    latency_ms: float = Field(20.0, ge=0, le=500, description="from command to first motion")
    repeatability_sigma_mm: float = Field(0.1, ge=0, le=5, description="one sigma of the baseline after settling")
    max_duty_pct: float = Field(20.0, gt=0, le=100, description="share of time the servo may move")

    @model_validator(mode="after")
    def _ordered(self) -> ServoMotion:
        if self.min_baseline_mm >= self.max_baseline_mm:
            raise ValueError("min_baseline_mm must be less than max_baseline_mm")
        return self


class SerialServoConfig(Section):
    """Two linear servos behind a Teensy on a serial port."""

    backend: Literal["serial"]
    url: str = Field("serial:/dev/morpheyes-teensy:115200", min_length=1)
    motion: ServoMotion = ServoMotion()


class NoServoConfig(Section):
    """A fixed rig."""

    backend: Literal["none"]
    baseline_mm: float = Field(200.0, ge=10, le=1000)


class PluginServoConfig(PluginConfig):
    """A servo of another package (entry point group `morpheyes.servos`)."""

    group = "morpheyes.servos"
    built_in = ("none", "serial")

    motion: ServoMotion = ServoMotion()


ServoConfig = Annotated[
    Annotated[SerialServoConfig, Tag("serial")]
    | Annotated[NoServoConfig, Tag("none")]
    | Annotated[PluginServoConfig, Tag("plugin")],
    _backend_of(*PluginServoConfig.built_in),
]


class AutopilotConfig(Section):
    """The MAVLink link to ArduCopter."""

    backend: str = Field("mavlink", min_length=1, description="mavlink, or another package's (morpheyes.autopilots)")
    url: str = Field("serial:/dev/ttyAMA0:921600", min_length=1, description="serial:, tcp:, udp: or udpin:")
    vehicle_sysid: int = Field(1, ge=1, le=254)
    override_sysid: int = Field(255, ge=1, le=255, description="must equal MAV_GCS_SYSID (SYSID_MYGCS before 4.7)")
    override_compid: int = Field(191, ge=1, le=255)
    status_compid: int = Field(197, ge=1, le=255, description="status comes from the vehicle's id, this component")
    proximity_compid: int = Field(196, ge=1, le=255)
    engage_channel: int = Field(7, ge=5, le=16, description="RC channel of the pilot's switch; never overridden")
    engage_above_us: int = Field(1700, ge=1200, le=2000, description="switch on above this")
    watch_gcs: bool = Field(False, description="brake when the ground station's heartbeat is gone")
    gcs_timeout_s: float = Field(5.0, gt=0.5, le=60)
    gcs_sysid: int = Field(255, ge=1, le=255)
    gcs_compid: int = Field(190, ge=1, le=255, description="tells the ground station from the daemon's overrides")
    mavsdk: bool = Field(True, description="run mavsdk beside pymavlink for health and ground crew")
    publish_obstacles: bool = True
    signing_key_file: Path | None = Field(None, description="file with 32 bytes in hex; None: unsigned")
    link_timeout_s: float = Field(0.5, gt=0.05, le=10)
    stick_rate_hz: float = Field(50.0, ge=20, le=100)


class StereoConfig(Section):
    """Matching."""

    disparities_fraction: float = Field(0.25, gt=0.02, le=0.5, description="search range as a share of the width")
    sigma_disparity_px: float = Field(0.25, gt=0, le=5, description="one sigma of a matched disparity")
    latency_ms: float = Field(100.0, ge=0, le=5000, description="frame to depth; what lockstep takes for it")


class SafetyConfig(Section):
    """Ages after which an input is worthless, and how much faith the governor has."""

    frame_periods: float = Field(3.0, ge=1, le=20, description="camera periods until a frame is stale")
    depth_periods: float = Field(3.0, ge=1, le=20, description="camera periods until a depth map is stale")
    mission_periods: float = Field(3.0, ge=1, le=20, description="camera periods that a mission command may last")
    vehicle_timeout_s: float = Field(0.3, gt=0.02, le=5)
    switch_timeout_s: float = Field(0.5, gt=0.05, le=5)
    supervisor_timeout_s: float = Field(0.25, gt=0.02, le=5)
    neutral_before_release_s: float = Field(2.0, ge=0.2, le=30, description="when we stop or fail")
    dead_daemon_s: float = Field(
        1.0, ge=0, le=5, description="how long the autopilot flies on when we die (RC_OVERRIDE_TIME, FS_THR)"
    )
    battery_low_pct: float = Field(20.0, ge=0, le=90, description="brake and do not engage below this charge")
    depth_sigmas: float = Field(3.0, ge=1, le=6, description="depth is trusted where this many sigmas fit")
    max_relative_depth_error: float = Field(0.2, gt=0.01, le=1.0)
    max_speed_m_s: float = Field(5.0, gt=0.1, le=10, description="a last bound; the governor is the real one")
    max_lean_deg: float = Field(20.0, gt=1, le=45)
    active_braking: bool = Field(False, description="brake with opposite stick, never past zero speed")
    min_free_disk_mb: float = Field(200.0, ge=0)


class RecorderConfig(Section):
    """The flight log."""

    folder: Path = Path("flights")
    images: bool = Field(True, description="keep small left images and depth maps")
    image_rate_hz: float = Field(1.0, gt=0, le=30)


class DashboardConfig(Section):
    """The page to watch."""

    enabled: bool = False
    host: str = "127.0.0.1"
    port: int = Field(8080, ge=1, le=65535)


class VehicleConfig(Section):
    """The whole of `config.yaml`."""

    mission: str = Field("forest", min_length=1, description="name or path; the service flies this one")
    calibration: Path | None = Field(None, description="file made by `morpheyes calibrate solve`")
    hold_baseline_mm: float | None = Field(None, ge=10, le=1000, description="hold this baseline, for comparisons")
    footprint: Footprint = Footprint()
    camera: CameraConfig
    servo: ServoConfig
    autopilot: AutopilotConfig = AutopilotConfig()
    stereo: StereoConfig = StereoConfig()
    safety: SafetyConfig = SafetyConfig()
    recorder: RecorderConfig = RecorderConfig()
    dashboard: DashboardConfig = DashboardConfig()

    @model_validator(mode="after")
    def _can_be_held(self) -> VehicleConfig:
        low_mm, high_mm = self._reach_mm
        if self.hold_baseline_mm is not None and not low_mm <= self.hold_baseline_mm <= high_mm:
            raise ValueError(f"hold_baseline_mm must be what the rig can take, from {low_mm:g} to {high_mm:g}")
        return self

    @property
    def _reach_mm(self) -> tuple[float, float]:
        if isinstance(self.servo, NoServoConfig):
            return self.servo.baseline_mm, self.servo.baseline_mm
        return self.servo.motion.min_baseline_mm, self.servo.motion.max_baseline_mm

    @property
    def baseline_range_m(self) -> tuple[float, float]:
        """Smallest and largest baseline the mission may ask for."""
        if self.hold_baseline_mm is not None:
            return self.hold_baseline_mm / 1e3, self.hold_baseline_mm / 1e3
        low_mm, high_mm = self._reach_mm
        return low_mm / 1e3, high_mm / 1e3


class MissionFile(Section):
    """The whole of a mission file; `parameters` is checked by the strategy's own model."""

    strategy: str = Field(min_length=1)
    description: str = ""
    world: str = Field("forest", description="world that the simulator flies it in, by name or path")
    still_scene: bool = Field(True, description="off where much of what is seen may move, such as a swaying wall")
    avoidance: bool = Field(True, description="leave the autopilot's own proximity avoidance switched on")
    parameters: dict[str, Any] = Field(default_factory=dict)
