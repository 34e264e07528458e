"""Figure-quality still sequences: the world path-traced beside the fast renderer, and whether depth agrees.

Ideal pinholes, no lens and no sensor, so that what differs between the two is light alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morpheyes_daemon.messages.core import FloatMap, Image, Pinhole
from morpheyes_daemon.simulation.rendering.mitsuba import trace
from morpheyes_daemon.simulation.rendering.renderer import Renderer, encode
from morpheyes_daemon.simulation.worlds.loader import build_world, load_world
from morpheyes_daemon.stereo.colours import colour_depth
from morpheyes_daemon.stereo.depth import default_settings, depth_from_disparity, grey
from morpheyes_daemon.stereo.matching import disparity_range, match
from morpheyes_daemon.transforms import R_FRD_CAM, Array, R_from_rpy, pose

F_OF_WIDTH = 740.0 / 640.0
MEAN_RADIANCE = 0.2
LAMP_OF_MEDIAN = 6.0
"""What is so much brighter than the median is a lamp."""

NEAR_M, FAR_M = 1.0, 20.0
"""Range of depths compared: what a flight looks at."""

Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class StillPlan:
    """A walk along +x through a world, one pair every `step_m`."""

    world: str
    seed: int = 0
    first_m: float = 0.0
    steps: int = 1
    step_m: float = 1.0
    height_m: float = 1.5
    yaw_deg: float = 0.0
    baseline_m: float = 0.2
    size: tuple[int, int] = (640, 480)
    samples: int = 32

    @property
    def pinhole(self) -> Pinhole:
        """Both eyes' camera."""
        width, height = self.size
        return Pinhole(width, height, F_OF_WIDTH * width, (width - 1) / 2, (height - 1) / 2)

    def T_ned_cam(self, step: int, eye: int) -> Array:
        """Pose (4, 4) of an eye (0 left, 1 right) at a step."""
        R_ned_cam = R_from_rpy(0.0, 0.0, math.radians(self.yaw_deg)) @ R_FRD_CAM
        left = np.array([self.first_m + step * self.step_m, 0.0, -self.height_m])
        return pose(R_ned_cam, left + eye * self.baseline_m * R_ned_cam[:, 0])


@dataclass(frozen=True, slots=True)
class StillResult:
    """How depth from the two renderers compares on one pair, over what is 1 to 20 m away.

    `*_valid`: share of pixels with a depth; `*_error_px`: median disparity error against the truth;
    `difference_px`: median difference between the two where both have a depth.
    """

    step: int
    fast_valid: float
    traced_valid: float
    fast_error_px: float
    traced_error_px: float
    difference_px: float

    def as_json(self) -> dict[str, Any]:
        """Return plain values, rounded."""
        return {key: round(value, 4) for key, value in asdict(self).items()}


def make_stills(plan: StillPlan, out: Path, report: Report) -> list[StillResult]:
    """Render every step with both, write the pictures into `out`, return the comparison."""
    out.mkdir(parents=True, exist_ok=True)
    scene = build_world(load_world(plan.world), plan.seed).scene
    renderer, results = Renderer(scene), []
    for step in range(plan.steps):
        report("path tracing", step, plan.steps)
        poses = [plan.T_ned_cam(step, eye) for eye in (0, 1)]
        fast = [renderer.render(T, plan.pinhole) for T in poses]
        traced = [trace(scene, T, plan.pinhole, plan.samples) for T in poses]
        pairs = _exposed([view.radiance for view in fast]), _exposed(traced)
        disparities = [_disparity(pair) for pair in pairs]
        results.append(_compare(step, fast[0].depth_m, disparities[0], disparities[1], plan))
        _write(out, step, pairs, disparities, plan)
    report("path tracing", plan.steps, plan.steps)
    return results


def _exposed(radiances: list[FloatMap]) -> list[Image]:
    """Develop both eyes with the exposure of the left one, for what is lit rather than for lamps."""
    lit = np.minimum(radiances[0], LAMP_OF_MEDIAN * np.median(radiances[0]))
    gain = np.float32(MEAN_RADIANCE / max(float(lit.mean()), 1e-6))
    return [encode(radiance * gain) for radiance in radiances]


def _disparity(pair: list[Image]) -> FloatMap:
    left, right = (grey(image) for image in pair)
    width = left.shape[1]
    return match(left, right, disparity_range(width / 4 - 1, width), default_settings(left.shape[0])).disparity_px


def _compare(step: int, depth_m: FloatMap, fast: FloatMap, traced: FloatMap, plan: StillPlan) -> StillResult:
    truth = plan.baseline_m * plan.pinhole.f_px / depth_m
    looked_at = (depth_m > NEAR_M) & (depth_m < FAR_M)

    def median(values: FloatMap) -> float:
        known = values[looked_at & np.isfinite(values)]
        return float(np.median(known)) if known.size else math.nan

    return StillResult(
        step,
        float(np.isfinite(fast[looked_at]).mean()),
        float(np.isfinite(traced[looked_at]).mean()),
        median(np.abs(fast - truth)),
        median(np.abs(traced - truth)),
        median(np.abs(fast - traced)),
    )


def _write(out: Path, step: int, pairs: tuple[list[Image], ...], disparities: list[FloatMap], plan: StillPlan) -> None:
    """Write the pairs, and both left pictures above their depth."""
    panels = []
    for name, pair, disparity in zip(("fast", "traced"), pairs, disparities, strict=True):
        for eye, image in zip(("left", "right"), pair, strict=True):
            cv2.imwrite(str(out / f"{step:03d}_{name}_{eye}.png"), image)
        depth_m = depth_from_disparity(disparity, plan.baseline_m, plan.pinhole.f_px)
        panels.append(np.vstack([pair[0], colour_depth(depth_m, NEAR_M, FAR_M)]))
    cv2.imwrite(str(out / f"{step:03d}_compared.png"), np.hstack(panels))
