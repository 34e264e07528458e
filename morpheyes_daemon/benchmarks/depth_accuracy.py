"""How good and how fast depth is on real images with ground truth, beside OpenCV's own matcher in the same run.

Needs the Middlebury pairs; `tests/` and `morpheyes bench` say where they are looked for. Rendered pairs are timed by
`bench_vision`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morpheyes_daemon.benchmarks.vision_latency import opencv_matcher
from morpheyes_daemon.clock import stopwatch_s
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import FloatMap, Image
from morpheyes_daemon.stereo.depth import grey
from morpheyes_daemon.stereo.image_files import read_picture
from morpheyes_daemon.stereo.matching import SUBPIXELS, match

CONES_STEPS = (1, 3, 4, 5, 6)
"""View im4 is misplaced by 0.3 px, so not 2 steps."""

MOTORCYCLE_F_PX, MOTORCYCLE_BASELINE_M, MOTORCYCLE_DOFFS_PX = 994.978, 0.193001, 31.086
"""From the data set's calibration."""


@dataclass(frozen=True, slots=True, eq=False)
class TruePair:
    """A rectified grey pair with its true disparity (H, W), NaN unknown; depth goes as 1 / (d + doffs_px)."""

    name: str
    left: Image
    right: Image
    truth_px: FloatMap
    disparities: int
    doffs_px: float = 0.0


def motorcycle(data: Path) -> TruePair:
    """Read Middlebury 2014 "Motorcycle"; raises InputError when a file is missing."""
    folder = data / "middlebury2014_motorcycle"
    left, right = (grey(read_picture(folder / f"motorcycle_{eye}.png")) for eye in ("left", "right"))
    with np.load(folder / "motorcycle_disp.npz") as archive:
        truth = archive[archive.files[0]].astype(np.float32)
    truth[~np.isfinite(truth)] = np.nan
    return TruePair("motorcycle", left, right, truth, 80, MOTORCYCLE_DOFFS_PX)


def cones(data: Path, steps: int) -> TruePair:
    """Read Middlebury 2003 "Cones", view 2 and the one `steps` further; raises InputError when a file is missing."""
    folder = data / "middlebury2003_cones"
    left, right = (grey(read_picture(folder / f"im{i}.ppm")) for i in (2, 2 + steps))
    stored = grey(read_picture(folder / "disp2.pgm")).astype(np.float32)
    truth = np.where(stored > 0, stored / 4 * steps / 4, np.float32(np.nan))
    return TruePair(f"cones, {steps} steps", left, right, truth, -(-round(14 * steps + 4) // 16) * 16)


def bench_depth(data: Path, repeats: int = 5) -> dict[str, Any]:
    """Return density, errors and times of both matchers on every pair, and the ratios theirs / ours."""
    if not data.is_dir():
        raise InputError(f"{data}: there are no real images; set MORPHEYES_DATA to their folder.")
    pairs = [motorcycle(data), *(cones(data, steps) for steps in CONES_STEPS)]
    return {"threads": cv2.getNumThreads(), "pairs": [_compared(pair, repeats) for pair in pairs]}


def _compared(pair: TruePair, repeats: int) -> dict[str, Any]:
    plain = opencv_matcher(pair.disparities)
    ours = _measured(pair, repeats, lambda: match(pair.left, pair.right, pair.disparities).disparity_px)
    theirs = _measured(pair, repeats, lambda: _opencv_disparity(plain, pair))
    ratios = {
        key: theirs[key] / ours[key] for key in ("median_relative_error", "median_error_px", "time_s") if ours[key]
    }
    return {"name": pair.name, "ours": ours, "opencv": theirs, "opencv_over_ours": ratios}


def _opencv_disparity(matcher: Any, pair: TruePair) -> FloatMap:
    disparity = matcher.compute(pair.left, pair.right).astype(np.float32) / SUBPIXELS
    return np.where(disparity >= 0, disparity, np.float32(np.nan))


def _measured(pair: TruePair, repeats: int, run: Callable[[], FloatMap]) -> dict[str, float]:
    seconds = []
    for _ in range(repeats):
        started_s = stopwatch_s()
        disparity = run()
        seconds.append(stopwatch_s() - started_s)
    return {**accuracy(pair, disparity), "time_s": float(np.median(seconds))}


def accuracy(pair: TruePair, disparity_px: FloatMap) -> dict[str, float]:
    """Return the share of true pixels with a disparity, and the errors of those."""
    true = np.isfinite(pair.truth_px)
    both = true & np.isfinite(disparity_px)
    error = np.abs(disparity_px - pair.truth_px)[both]
    # with Z ~ 1 / (d + doffs), (Z - Z0) / Z0 = (d0 - d) / (d + doffs)
    relative = error / np.maximum(disparity_px[both] + pair.doffs_px, 1e-6)
    return {
        "density": float(both.sum() / true.sum()),
        "median_relative_error": float(np.median(relative)),
        "median_error_px": float(np.median(error)),
        "over_1_px": float(np.mean(error > 1.0)),
    }
