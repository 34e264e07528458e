"""Acceptance of a calibration: fit to fly, fly with care or do not fly, and the pictures to take again."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.calibration.solver.cross_validation import HeldOut, LeftOutBaseline
from morpheyes_daemon.calibration.solver.plausibility import ScaleCheck
from morpheyes_daemon.calibration.solver.solver import Calibration
from morpheyes_daemon.calibration.solver.uncertainty import BaselineUncertainty
from morpheyes_daemon.calibration.targets.coverage import coverage, empty_corners

HELD_OUT_GOOD_PX, HELD_OUT_LIMIT_PX = 0.5, 1.0
"""Limits of the 95th percentile of held-out row errors, pixels; chosen: a matcher searches along one row, so errors of
a pixel lose matches; lower limits refuse usable rigs."""
_RMS_LIMIT_PX = 0.6
"""Largest rms of the corners at a baseline, pixels; chosen: more is motion or a wrong board."""
_YAW_GOOD_PX = 0.25
"""Largest sigma of the disparity at infinity, pixels; chosen: the matcher's own noise."""
_FEWEST_VIEWS = 8
"""Stereo views per baseline below which more are asked for; chosen: two thirds of `BASELINE_VIEWS`."""
_LEAST_COVERAGE = 0.8
"""Fraction of the image that boards should cover; chosen: distortion is extrapolated elsewhere."""
_OUTLIER_SHARE = 0.25
"""Fraction of outlier pictures at a baseline from which it should be retaken; chosen: a few are normal."""
_LEFT_OUT_RATIO, _LEFT_OUT_FLOOR_PX = 1.3, 0.05
"""Row error of a left-out baseline over that of the full solve, plus a floor in pixels, from which the rail does not
fit it; chosen: lower ones report noise."""


@dataclass(frozen=True)
class Acceptance:
    """`text` begins with "fit to fly", "fly with care" or "do not fly"; `retake` are sentences on what to retake."""

    text: str
    retake: tuple[str, ...]


@dataclass(frozen=True)
class Quality:
    """Figures of a calibration: errors on held-out boards and on left-out baselines, uncertainties, scale."""

    held_out: HeldOut
    left_out: list[LeftOutBaseline]
    uncertainty: list[BaselineUncertainty]
    scale: ScaleCheck


def judge(calibration: Calibration, quality: Quality, lost: tuple[str, ...]) -> Acceptance:
    """Return the acceptance of a calibration; `lost` are sentences on baselines that could not be used."""
    held_out = quality.held_out
    fatal = _fatal(calibration, held_out, quality.scale)
    advice = [*_views(calibration), *_cells(calibration), *_yaw(calibration, quality.uncertainty)]
    advice += _rail(quality.left_out)
    retake = tuple([*fatal, *lost, *advice])
    if fatal:
        return Acceptance(f"do not fly: {fatal[0]}", retake)
    if held_out.p95_px > HELD_OUT_GOOD_PX:
        return Acceptance(f"fly with care: rows of held-out boards differ by {held_out.p95_px:.2f} px (95 %)", retake)
    if advice or lost:
        return Acceptance(f"fly with care: {retake[0]}", retake)
    return Acceptance(f"fit to fly: rows of held-out boards agree within {held_out.p95_px:.2f} px (95 %)", retake)


def _fatal(calibration: Calibration, held_out: HeldOut, scale: ScaleCheck) -> list[str]:
    found = []
    if scale.disagrees and scale.length_ratio is not None:
        found.append(
            f"the solved baselines are {scale.length_ratio:.3f} of their names: measure a square and the baselines"
        )
    if held_out.p95_px > HELD_OUT_LIMIT_PX:
        found.append(f"rows of held-out boards differ by {held_out.p95_px:.2f} px (95 %): retake it, board still")
    for nominal, rms in zip(calibration.nominal_m, calibration.rms_px, strict=True):
        if rms > _RMS_LIMIT_PX:
            found.append(f"{nominal * 1e3:g} mm fits only to {rms:.2f} px: retake it, board and rig held still")
    return found


def _views(calibration: Calibration) -> list[str]:
    observations = calibration.observations
    advice = []
    for index, nominal in enumerate(calibration.nominal_m):
        chosen = observations.baseline == index
        both = np.isfinite(observations.left[chosen, :, 0]).any(axis=1) & np.isfinite(
            observations.right[chosen, :, 0]
        ).any(axis=1)
        if np.count_nonzero(both) < _FEWEST_VIEWS:
            advice.append(f"{nominal * 1e3:g} mm has only {np.count_nonzero(both)} usable pairs: take at least ten")
    dropped = Counter(outlier.name.split("/")[0] for outlier in calibration.outliers if "/" in outlier.name)
    for folder, count in dropped.items():
        if count > _OUTLIER_SHARE * 2 * _FEWEST_VIEWS:
            advice.append(f"{folder} has {count} outlier pictures: retake it without moving")
    return advice


def _cells(calibration: Calibration) -> list[str]:
    seen = coverage(calibration.observations)
    advice = []
    for side, counts in (("left", seen.left), ("right", seen.right)):
        empty = empty_corners(counts)
        if empty or np.mean(counts > 0) < _LEAST_COVERAGE:
            where = " and ".join(empty) or "border"
            advice.append(
                f"boards cover {np.mean(counts > 0):.0%} of the {side} image: show one in the {where} of the picture"
            )
    return advice


def _yaw(calibration: Calibration, uncertainty: list[BaselineUncertainty]) -> list[str]:
    return [
        f"the yaw at {nominal * 1e3:g} mm is only known to {sigma.disparity_px:.2f} px: add far and near boards there"
        for nominal, sigma in zip(calibration.nominal_m, uncertainty, strict=True)
        if sigma.disparity_px > _YAW_GOOD_PX
    ]


def _rail(left_out: list[LeftOutBaseline]) -> list[str]:
    return [
        f"{one.baseline_mm:g} mm differs from what its neighbours predict: retake it and the baselines beside it"
        for one in left_out
        if one.epipolar_median_px > _LEFT_OUT_RATIO * one.full_epipolar_median_px + _LEFT_OUT_FLOOR_PX
    ]
