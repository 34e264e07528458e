"""Can a rig such as the calibration file describes exist: a camera of its size, its servos, and one eye by the other?

The file's hash notices damage; whoever edits a file can hash it anew. What is judged here are bounds that no working
rig comes near, except for the lens's field of view, which is as narrow as `camera.h_fov_deg` makes it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from morpheyes_daemon.config.vehicle import VehicleConfig
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel

FIELD_OF_VIEW_DEG = 20.0, 140.0
"""Horizontal; beyond lies what the pinhole model with this distortion describes."""
LENS_TOLERANCE = 0.10
"""Focal length against the lens's data sheet, whose field of view is a round number."""
EYES_TOLERANCE = 0.05
"""Focal lengths against each other, along and across: two lenses of one kind agree within 1 or 2 %."""
CENTRE_SHARE = 0.15
"""How far the principal point may be off the middle, as a share of the size; cheap lens holders reach 0.05."""
LARGEST_SKEW = 0.02
LENGTH_TOLERANCE_M, LENGTH_TOLERANCE = 8e-3, 0.08
"""Length against nominal baseline: a ruler's reading of lens housings, and a servo's stroke error."""
LARGEST_TURN_RAD = math.radians(10.0)
"""One eye against the other, and the line between them against the left one's rows; worse cannot be rectified well."""
LARGEST_STEP_RAD = math.radians(2.0)
"""Between neighbouring baselines of a rail."""
LARGEST_MOUNT_RAD = math.radians(20.0)
"""The left eye on the bar; the bar's own tilt is `camera.mount`."""
LARGEST_SIGMA_M, LARGEST_SIGMA_RAD = 0.02, math.radians(5.0)


def implausible(rig: RigModel, config: VehicleConfig) -> list[str]:
    """Return what of a calibration cannot be, each as half a sentence; nothing for a rig that can exist."""
    with np.errstate(all="ignore"):
        return [*_lenses(rig, config), *_baselines(rig), *_mount(rig)]


def _lenses(rig: RigModel, config: VehicleConfig) -> Iterator[str]:
    for name, camera in (("left", rig.cam0), ("right", rig.cam1)):
        yield from _lens(name, camera, config.camera.h_fov_deg)
    if not _agree(rig.cam0.fx, rig.cam1.fx, EYES_TOLERANCE):
        yield f"the focal lengths of the cameras, {rig.cam0.fx:.6g} and {rig.cam1.fx:.6g} px, are of different lenses"


def _lens(name: str, camera: CameraIntrinsics, sheet_deg: float | None) -> Iterator[str]:
    view_deg = 2.0 * math.degrees(math.atan2(camera.width / 2.0, camera.fx))
    low, high = FIELD_OF_VIEW_DEG
    if not low <= view_deg <= high:
        yield f"the {name} focal length of {camera.fx:.6g} px means a field of view of {view_deg:.3g} degrees"
    elif sheet_deg is not None and not _agree(_half(view_deg), _half(sheet_deg), LENS_TOLERANCE):
        yield f"the {name} field of view is {view_deg:.3g} degrees, camera.h_fov_deg says {sheet_deg:g}"
    if not _agree(camera.fx, camera.fy, EYES_TOLERANCE):
        yield f"the {name} focal lengths along and across, {camera.fx:.6g} and {camera.fy:.6g} px, differ"
    off = abs(2 * camera.cx + 1 - camera.width) / camera.width, abs(2 * camera.cy + 1 - camera.height) / camera.height
    if not max(off) / 2 <= CENTRE_SHARE:
        yield f"the {name} principal point ({camera.cx:.6g}, {camera.cy:.6g}) is far from the middle of the picture"
    if not abs(camera.alpha) <= LARGEST_SKEW:
        yield f"the {name} pixels are skewed by {camera.alpha:.3g}"
    if not _unfolded(camera):
        yield f"the {name} distortion folds the picture"


def _half(view_deg: float) -> float:
    return math.tan(math.radians(view_deg) / 2.0)


def _agree(a: float, b: float, tolerance: float) -> bool:
    return abs(a / b - 1.0) <= tolerance


def _unfolded(camera: CameraIntrinsics) -> bool:
    """Whether the distortion can be undone at the middle of each side and only grows up to there."""
    across = np.array([[-0.5, camera.cy], [camera.width - 0.5, camera.cy], [camera.cx, -0.5]])
    xy = camera.normalised_from_pixels(across)
    return bool(np.isfinite(xy).all() and np.hypot(xy[:, 0], xy[:, 1]).max() < camera.largest_radius)


def _baselines(rig: RigModel) -> Iterator[str]:
    for baseline in rig.baselines:
        yield from _baseline(baseline)
    for one, other in itertools.pairwise(rig.baselines):
        step_rad = _turn_rad(one, other)
        if not step_rad <= LARGEST_STEP_RAD:
            yield f"the eyes turn by {math.degrees(step_rad):.3g} degrees from {_name(one)} to {_name(other)}"
        if not float(np.linalg.norm(other.t_cam0_cam1_m)) > float(np.linalg.norm(one.t_cam0_cam1_m)):
            yield f"the eyes are no farther apart at {_name(other)} than at {_name(one)}"


def _baseline(baseline: CalibratedBaseline) -> Iterator[str]:
    name, nominal_m = _name(baseline), baseline.nominal_m
    t = np.array(baseline.t_cam0_cam1_m)
    length_m = float(np.linalg.norm(t))
    if not nominal_m > 0.0:
        yield f"a nominal baseline of {name} is none"
    elif not abs(length_m - nominal_m) <= LENGTH_TOLERANCE_M + LENGTH_TOLERANCE * nominal_m:
        yield f"the eyes are {length_m * 1e3:.6g} mm apart at a nominal {name}"
    turn_rad = 2.0 * math.acos(min(1.0, abs(baseline.q_cam0_cam1[0])))
    if not turn_rad <= LARGEST_TURN_RAD:
        yield f"the eyes are turned by {math.degrees(turn_rad):.3g} degrees against each other at {name}"
    if not float(np.hypot(t[1], t[2])) <= math.tan(LARGEST_TURN_RAD) * t[0]:
        yield f"the right eye is not beside the left one at {name}"
    spread = baseline.rms_px or 0.0, baseline.sigma_length_m or 0.0, baseline.sigma_yaw_rad or 0.0
    if min(spread) < 0.0 or spread[1] > LARGEST_SIGMA_M or spread[2] > LARGEST_SIGMA_RAD:
        yield f"the uncertainties stated at {name} cannot be"


def _turn_rad(one: CalibratedBaseline, other: CalibratedBaseline) -> float:
    return 2.0 * math.acos(min(1.0, abs(float(np.dot(one.q_cam0_cam1, other.q_cam0_cam1)))))


def _name(baseline: CalibratedBaseline) -> str:
    return f"{baseline.nominal_m * 1e3:.6g} mm"


def _mount(rig: RigModel) -> Iterator[str]:
    if rig.mount is None:
        return
    turn_rad = float(np.linalg.norm(rig.mount.rotation_rad))
    if not turn_rad <= LARGEST_MOUNT_RAD:
        yield f"the left eye is turned by {math.degrees(turn_rad):.3g} degrees on the bar"
    if not all(0.0 <= sigma <= LARGEST_SIGMA_RAD for sigma in rig.mount.sigma_rad):
        yield "the uncertainty stated of the mount cannot be"
