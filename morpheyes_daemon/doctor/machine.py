"""The companion computer: disk, clock, temperature, power and permissions.

Linux is read through /sys and the file system; what a machine does not have is no finding.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from morpheyes_daemon.clock import wall_time_s
from morpheyes_daemon.config.vehicle import SerialServoConfig, V4l2CameraConfig, VehicleConfig
from morpheyes_daemon.doctor.findings import Finding, Severity

WARM_C, HOT_C = 75.0, 83.0
"""A Raspberry Pi slows down from 80 to 85 degrees."""
EARLIEST_WALL_S = 1_735_689_600.0
"""2025-01-01: a clock before it was never set."""
UNDER_VOLTAGE_NOW, THROTTLED_NOW, UNDER_VOLTAGE_SINCE_BOOT = 0x1, 0x4, 0x10000
"""Bits of the Raspberry Pi firmware's get_throttled."""
_MEGABYTE = 1e6


def examine_machine(config: VehicleConfig, sys: Path = Path("/sys")) -> list[Finding]:
    """Return the findings on the computer that this runs on; `sys` is where sysfs is mounted."""
    found = [*_disk(config), *_wall_clock(wall_time_s()), *_temperature(sys), *_power(sys), *_permissions(config)]
    return [finding for finding in found if finding is not None]


def _disk(config: VehicleConfig) -> list[Finding]:
    folder = config.recorder.folder.absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not os.access(existing, os.W_OK | os.X_OK):
        return [
            Finding(
                "log-folder-closed",
                Severity.CARE,
                f"{existing} cannot be written by this user",
                "the flight leaves no log",
                f"give the folder to the daemon's user (chown), or set recorder.folder instead of {folder}",
            )
        ]
    free_mb = shutil.disk_usage(existing).free / _MEGABYTE
    if free_mb >= config.safety.min_free_disk_mb:
        return []
    return [
        Finding(
            "disk-full",
            Severity.CARE,
            f"{free_mb:.0f} MB are free in {existing}, and safety.min_free_disk_mb is"
            f" {config.safety.min_free_disk_mb:g}",
            "the log of the flight is cut short",
            "move old flights off the card",
        )
    ]


def _wall_clock(now_s: float) -> list[Finding]:
    if now_s >= EARLIEST_WALL_S:
        return []
    return [
        Finding(
            "clock-not-set",
            Severity.CARE,
            "the computer's date lies before 2025",
            "logs carry a wrong date; signed links may be rejected",
            "connect it to a network once, or set the date by hand (timedatectl set-time)",
        )
    ]


def _temperature(sys: Path) -> list[Finding]:
    readings = [_number(path) for path in sys.glob("class/thermal/thermal_zone*/temp")]
    hottest = max((reading / 1000.0 for reading in readings if reading is not None), default=0.0)
    if hottest < WARM_C:
        return []
    return [
        Finding(
            "too-hot",
            Severity.STOP if hottest >= HOT_C else Severity.CARE,
            f"{hottest:.0f} degrees",
            "the processor slows down, and depth comes too late",
            "let it cool, and give it air before take-off",
        )
    ]


def _power(sys: Path) -> list[Finding]:
    path = sys / "devices/platform/soc/soc:firmware/get_throttled"
    bits = _number(path, base=16)
    if bits is None or not bits & (UNDER_VOLTAGE_NOW | THROTTLED_NOW | UNDER_VOLTAGE_SINCE_BOOT):
        return []
    now = bits & (UNDER_VOLTAGE_NOW | THROTTLED_NOW)
    return [
        Finding(
            "under-voltage",
            Severity.STOP if now else Severity.CARE,
            f"the firmware reports {'' if now else 'past '}under-voltage or throttling ({bits:#x})",
            "the computer slows down or restarts in flight",
            "feed it from a supply that holds 5.1 V under load",
        )
    ]


def _number(path: Path, base: int = 10) -> int | None:
    try:
        return int(path.read_text().strip(), base)
    except (OSError, ValueError):
        return None


def _permissions(config: VehicleConfig) -> list[Finding]:
    devices = [_device(config.autopilot.url)]
    if isinstance(config.servo, SerialServoConfig):
        devices.append(_device(config.servo.url))
    if isinstance(config.camera, V4l2CameraConfig):
        devices.append(Path(config.camera.device))
    return [
        Finding(
            "no-permission",
            Severity.STOP,
            f"this user may not read and write {device}",
            "the device cannot be opened",
            "add the user to the device's group (dialout for serial ports, video for cameras) and log in again",
        )
        for device in devices
        if device is not None and device.exists() and not os.access(device, os.R_OK | os.W_OK)
    ]


def _device(url: str) -> Path | None:
    """The device file of a serial URL."""
    scheme, _, address = url.partition(":")
    if scheme != "serial":
        return None
    name, _, baud = address.rpartition(":")
    return Path(name if baud.isdigit() else address)
