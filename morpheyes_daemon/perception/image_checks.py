"""Checks of the images: frozen, dark, overexposed, blank, swapped cameras, misaligned rows, different scenes.

Every limit is set against false alarms, since a fault takes the sticks to neutral: a healthy camera in front of a
bare wall or at dusk must pass. What follows from a fault is decided elsewhere.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from morpheyes_daemon.messages.core import Image
from morpheyes_daemon.stereo.epipolar import MIN_POINTS, RowOffsets
from morpheyes_daemon.stereo.matching import MatchSettings, semi_global


class ImageFault(StrEnum):
    """A fault of a stereo frame; `text` explains it to a person."""

    text: str

    def __new__(cls, code: str, text: str) -> ImageFault:
        """Return the member of a code with its text."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.text = text
        return member

    FROZEN = "frozen", "a camera repeats its last image"
    DARK = "dark", "a camera image is dark: lens cap, night, or a dead sensor"
    BURNT = "burnt", "a camera image is overexposed: exposure setting, or the sun"
    BLANK = "blank", "a camera image is uniformly grey"
    SWAPPED = "swapped", "the left and the right camera are swapped"
    MISALIGNED = "misaligned", "the rows of the two images do not align: bent rig or wrong calibration"
    SCENE_MISMATCH = "scene_mismatch", "the cameras do not see the same scene"
    ROW_MISMATCH = (
        "row_mismatch",
        "the rows of the images keep differing: unsynchronized cameras, bent rig, or another rig's calibration",
    )


_COARSE_DISPARITIES = 48
"""Disparities searched in the coarse pair, pixels: 30 % of its width of 160 px."""

MAX_SHIFT_ROWS = 12
"""Largest row shift that is recognized, pixels of the coarse pair (48 rows at 640x480); chosen: a larger one leaves
too few rows to correlate."""


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """Limits of the faults; grey levels of 255, fractions of the image, angles in radians.

    Those of `PairCheck` are measured (see there); the others are chosen: tighter limits stop healthy flights.
    """

    dark_below: int = 12
    """99th percentile of the grey levels below which an image is dark."""
    burnt_above: int = 250
    burnt_fraction: float = 0.5
    """Fraction of pixels at `burnt_above` or more from which an image is overexposed."""
    blank_spread: float = 1.5
    """Standard deviation of the grey levels below which an image is blank."""
    suspicious_valid_fraction: float = 0.45
    """Fraction of pixels with depth below which other arrangements of the images are tried."""
    better_gain: float = 2.0
    better_share: float = 0.35
    """Another arrangement must match `better_gain` times as many pixels, and at least this fraction."""
    found_share: float = 0.3
    """Share of textured points found in the right image below which the scenes differ."""
    textured_share: float = 0.3
    textured_levels: float = 5.0
    """Local standard deviation from which a pixel is textured; `textured_share` of the left image must be."""
    least_points: int = 40
    """Textured points below which nothing is concluded."""
    scene_mismatch_frames: int = 3
    scene_mismatch_of: int = 4
    """M-of-N confirmation: scene_mismatch_frames of the last scene_mismatch_of."""
    scene_mismatch_rad: float = 1e-2
    """Median row offset beyond which matches are false."""
    confirming_points: int = 16
    confirming_rad: float = 1e-3
    """So many matches with a smaller median row offset confirm that both cameras see one scene."""
    row_mismatch_limit_rad: float = 3.2e-3
    row_mismatch_frames: int = 5
    row_mismatch_of: int = 8
    """M-of-N confirmation of a median row offset beyond row_mismatch_limit_rad."""


class FrozenCheck:
    """Detects a repeated image: the noise of a sensor never repeats."""

    def __init__(self) -> None:
        self._last: tuple[Image, Image] | None = None

    def check(self, left: Image, right: Image) -> bool:
        """Return True when either raw image (H, W[, 3]) equals the one before it."""
        last, self._last = self._last, (left, right)
        return last is not None and (_same(last[0], left) or _same(last[1], right))


class PairCheck:
    """Detects cameras that see different scenes, expose at different times, or belong to another calibration.

    Measured in flights at 320x240 (`morpheyes sim forest --size 320x240`, seeds 0 to 3): of the textured points of
    the left image 0.44 to 0.89 are found in the right one. With swapped cameras it is 0.0 to 0.36, half of the frames
    below 0.03; one flight has 0.5, at a row offset of 12 mrad, which `scene_mismatch_rad` rejects. A time offset of
    2 ms makes 4 mrad in a quick pitch, in one frame of 20; with 20 ms every second frame has as much, and the
    calibration of another rig makes 5 mrad. Hence the M-of-N confirmation.

    Few points are found, too, where the scene is far, thin and hazy (0.2 in a sparse forest, healthy cameras). The
    found ones then confirm the pair, when there are `confirming_points` with rows within `confirming_rad`.
    """

    def __init__(self, limits: ImageLimits | None = None) -> None:
        self._limits = limits or ImageLimits()
        self._scene_mismatch: deque[bool] = deque(maxlen=self._limits.scene_mismatch_of)
        self._row_mismatch: deque[bool] = deque(maxlen=self._limits.row_mismatch_of)

    def check(self, left: Image, found: RowOffsets, f_px: float, row_uncertainty_rad: float = 0.0) -> set[ImageFault]:
        """Return the confirmed faults after one more frame.

        `left` (H, W) is the rectified grey left image, `found` its points in the right one, `f_px` the focal length.
        `row_uncertainty_rad` is added to the limits: the row offset that an uncertain baseline can cause.
        """
        limits = self._limits
        rows_far_off = (
            found.count >= MIN_POINTS and found.median_px > (limits.scene_mismatch_rad + row_uncertainty_rad) * f_px
        )
        confirmed = found.count >= limits.confirming_points and found.median_px < limits.confirming_rad * f_px
        few = found.count < limits.found_share * found.tried and not confirmed
        unlike = found.tried >= limits.least_points and (few or rows_far_off)
        unlike = unlike and _textured_share(left, limits.textured_levels) > limits.textured_share
        self._scene_mismatch.append(unlike)
        apart = (
            found.count >= MIN_POINTS and found.median_px > (limits.row_mismatch_limit_rad + row_uncertainty_rad) * f_px
        )
        self._row_mismatch.append(unlike or apart)
        faults = {ImageFault.SCENE_MISMATCH} if sum(self._scene_mismatch) >= limits.scene_mismatch_frames else set()
        return faults | ({ImageFault.ROW_MISMATCH} if sum(self._row_mismatch) >= limits.row_mismatch_frames else set())


def exposure_faults(left: Image, right: Image, limits: ImageLimits | None = None) -> set[ImageFault]:
    """Return the exposure faults of a grey pair (H, W), from every eighth pixel of every eighth row."""
    limits = limits or ImageLimits()
    faults = set()
    for side in (left[::8, ::8], right[::8, ::8]):
        if np.percentile(side, 99.0) < limits.dark_below:
            faults.add(ImageFault.DARK)
        elif np.mean(side >= limits.burnt_above) > limits.burnt_fraction:
            faults.add(ImageFault.BURNT)
        elif float(side.std()) < limits.blank_spread:
            faults.add(ImageFault.BLANK)
    return faults


def matching_faults(
    left: Image, right: Image, valid_fraction: float, limits: ImageLimits | None = None
) -> set[ImageFault]:
    """Return swapped or misaligned cameras as the cause of little depth in a rectified grey pair (H, W).

    A pair with a `valid_fraction` below the limit is matched coarsely with the images exchanged (swapped cameras have
    negative disparities only) and with the rows shifted; an arrangement that matches far better is the cause.
    """
    limits = limits or ImageLimits()
    if valid_fraction >= limits.suspicious_valid_fraction:
        return set()
    small_left, small_right = _small(left), _small(right)
    enough = max(limits.better_share, limits.better_gain * _matched_share(small_left, small_right))
    if _matched_share(small_right, small_left) >= enough:
        return {ImageFault.SWAPPED}
    shift = row_shift(small_left, small_right)
    shifted = (np.roll(small_right, -rows, axis=0) for rows in (shift, shift - 1, shift + 1) if rows)
    return {ImageFault.MISALIGNED} if any(_matched_share(small_left, image) >= enough for image in shifted) else set()


def row_shift(left: Image, right: Image) -> int:
    """Return by how many rows the right image (H, W) lies lower, to about one row.

    Correlates the mean vertical gradient of each row, which parallax along the rows hardly changes.
    """
    profiles = [cv2.Sobel(side, cv2.CV_32F, 0, 1).mean(axis=1, dtype=np.float64) for side in (left, right)]
    edge = MAX_SHIFT_ROWS
    inner = profiles[0][edge:-edge]
    with np.errstate(invalid="ignore", divide="ignore"):  # an even image has no pattern: NaN, no match
        scores = [
            float(np.corrcoef(inner, profiles[1][edge + shift : len(inner) + edge + shift])[0, 1])
            for shift in range(-edge, edge + 1)
        ]
    return int(np.argmax(np.nan_to_num(scores, nan=-1.0))) - edge


def _small(image: Image) -> Image:
    scale = MatchSettings().coarse_width_px / image.shape[1]
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _matched_share(left: Image, right: Image) -> float:
    """Return the fraction of a coarse pair that matches with a disparity of at least one pixel."""
    settings = MatchSettings()
    disparity = semi_global(left, right, range(_COARSE_DISPARITIES), settings, settings.coarse_speckle_px)
    return float(np.mean(disparity >= 1.0))


def _textured_share(image: Image, levels: float) -> float:
    """Return the fraction of pixels whose 9x9 neighbourhood has a standard deviation above `levels`."""
    grey = image.astype(np.float32)
    mean, square = cv2.blur(grey, (9, 9)), cv2.blur(grey * grey, (9, 9))
    return float(np.mean(square - mean * mean > levels * levels))


def _same(before: Image, after: Image) -> bool:
    if before.shape != after.shape or not np.array_equal(before[::16], after[::16]):
        return False
    return np.array_equal(before, after)
