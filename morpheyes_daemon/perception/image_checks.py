"""Images that must not be flown on: frozen, dark, burnt out, blank, eyes swapped, rows that do not align.

Every check is on the safe side of doubt for its kind: a healthy camera in front of a bare wall or at dusk must not
trip it, since a fault takes the sticks to neutral. What follows from a fault is decided elsewhere.
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
    """What is wrong with a stereo frame; `text` is for a person."""

    text: str

    def __new__(cls, code: str, text: str) -> ImageFault:
        """Make a member of its code and text."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.text = text
        return member

    FROZEN = "frozen", "an eye sends the same image again"
    DARK = "dark", "an eye sees next to nothing: lens cap, night, or a dead sensor"
    BURNT = "burnt", "an eye is burnt out: exposure, or the sun"
    BLANK = "blank", "an eye shows one even grey"
    SWAPPED = "swapped", "the left and the right eye are swapped"
    MISALIGNED = "misaligned", "the rows of the eyes do not align: bent rig or wrong calibration"
    UNLIKE = "unlike", "the eyes do not see the same scene"
    APART = "apart", "the rows of the eyes stay apart: not exposed together, bent, or another rig's calibration"


MAX_SHIFT_ROWS = 12
"""Largest row shift that is recognized in the coarse pair: 48 rows at 640x480."""


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """Where a fault begins. Grey levels are of 255; fractions of the image; rows in pixels of the rectified image."""

    dark_below: int = 12
    burnt_above: int = 250
    burnt_fraction: float = 0.5
    blank_spread: float = 1.5
    suspicious_valid_fraction: float = 0.45
    better_gain: float = 2.0
    better_share: float = 0.35
    alike_share: float = 0.3
    textured_share: float = 0.3
    textured_levels: float = 5.0
    alike_points: int = 40
    unlike_frames: int = 3
    unlike_of: int = 4
    unlike_rad: float = 1e-2
    vouching_points: int = 16
    vouching_rad: float = 1e-3
    apart_rad: float = 3.2e-3
    apart_frames: int = 5
    apart_of: int = 8


class FrozenCheck:
    """Tells an image that is sent again: a sensor's noise never repeats itself."""

    def __init__(self) -> None:
        self._last: tuple[Image, Image] | None = None

    def check(self, left: Image, right: Image) -> bool:
        """Return True when either raw image equals the one before it."""
        last, self._last = self._last, (left, right)
        return last is not None and (_same(last[0], left) or _same(last[1], right))


class PairCheck:
    """Tells eyes that see different things, or the same at different times, or through another calibration.

    Of flights at 320x240 (forest, seeds 0 to 3) 0.44 to 0.89 of the textured places of the left are found again in
    the right, with the eyes swapped 0.0 to 0.36, half of them below 0.03, and where it is more (0.5 in one flight) their
    rows are 12 mrad apart, which is as good as not found. One frame is no proof. Nor is it for rows that are apart by
    less: 2 ms between the eyes make 4 mrad in a quick pitch, in one frame of 20 of those flights; with 20 ms every
    second frame shows as much, and the calibration of another rig 5 mrad in all.

    Few places are found again, too, where all that is seen is far, thin and hazy (0.2 of a sparse forest, with the eyes
    together). Those that are found vouch for the eyes then, when there are some and their rows agree to a milliradian.
    """

    def __init__(self, limits: ImageLimits | None = None) -> None:
        self._limits = limits or ImageLimits()
        self._unlike: deque[bool] = deque(maxlen=self._limits.unlike_of)
        self._apart: deque[bool] = deque(maxlen=self._limits.apart_of)

    def check(self, left: Image, found: RowOffsets, f_px: float, doubt_rad: float = 0.0) -> set[ImageFault]:
        """Look at a rectified grey left image (H, W), what was found of it in the right one, and focal length.

        `doubt_rad` is how far the eyes may point elsewhere than the pair was rectified for.
        """
        limits = self._limits
        astray = found.count >= MIN_POINTS and found.median_px > (limits.unlike_rad + doubt_rad) * f_px
        vouch = found.count >= limits.vouching_points and found.median_px < limits.vouching_rad * f_px
        few = found.count < limits.alike_share * found.tried and not vouch
        unlike = found.tried >= limits.alike_points and (few or astray)
        unlike = unlike and _textured_share(left, limits.textured_levels) > limits.textured_share
        self._unlike.append(unlike)
        apart = found.count >= MIN_POINTS and found.median_px > (limits.apart_rad + doubt_rad) * f_px
        self._apart.append(unlike or apart)
        faults = {ImageFault.UNLIKE} if sum(self._unlike) >= limits.unlike_frames else set()
        return faults | ({ImageFault.APART} if sum(self._apart) >= limits.apart_frames else set())


def exposure_faults(left: Image, right: Image, limits: ImageLimits | None = None) -> set[ImageFault]:
    """Return what is wrong with how bright a grey pair (H, W) is; every eighth pixel is looked at."""
    limits = limits or ImageLimits()
    faults = set()
    for eye in (left[::8, ::8], right[::8, ::8]):
        if np.percentile(eye, 99.0) < limits.dark_below:
            faults.add(ImageFault.DARK)
        elif np.mean(eye >= limits.burnt_above) > limits.burnt_fraction:
            faults.add(ImageFault.BURNT)
        elif float(eye.std()) < limits.blank_spread:
            faults.add(ImageFault.BLANK)
    return faults


def matching_faults(
    left: Image, right: Image, valid_fraction: float, limits: ImageLimits | None = None
) -> set[ImageFault]:
    """Return why a rectified grey pair (H, W) has so little depth, if it matches far better in another way.

    Swapped eyes have negative disparities only; rows that are off by many pixels match once they are shifted. A pair
    with enough depth (`valid_fraction`) is not looked at; the others are, coarsely, the other way round and shifted.
    """
    limits = limits or ImageLimits()
    if valid_fraction >= limits.suspicious_valid_fraction:
        return set()
    small_left, small_right = _small(left), _small(right)
    enough = max(limits.better_share, limits.better_gain * _matched_share(small_left, small_right))
    if _matched_share(small_right, small_left) >= enough:
        return {ImageFault.SWAPPED}
    about = row_shift(small_left, small_right)
    tried = (np.roll(small_right, -rows, axis=0) for rows in (about, about - 1, about + 1) if rows)
    return {ImageFault.MISALIGNED} if any(_matched_share(small_left, eye) >= enough for eye in tried) else set()


def row_shift(left: Image, right: Image) -> int:
    """Return by about how many rows the right image (H, W) lies lower, from the rows' mean vertical gradients.

    Parallax moves things within their rows, so the means keep their pattern, to a row or so.
    """
    profiles = [cv2.Sobel(eye, cv2.CV_32F, 0, 1).mean(axis=1, dtype=np.float64) for eye in (left, right)]
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
    """Return the share of a small pair that matches with a disparity of at least one pixel."""
    settings = MatchSettings()
    disparity = semi_global(left, right, 0, 48, settings, settings.coarse_speckle_px)
    return float(np.mean(disparity >= 1.0))


def _textured_share(image: Image, levels: float) -> float:
    """Return the share of a grey image whose neighbourhood of 9 pixels spreads by more than `levels`."""
    grey = image.astype(np.float32)
    mean, square = cv2.blur(grey, (9, 9)), cv2.blur(grey * grey, (9, 9))
    return float(np.mean(square - mean * mean > levels * levels))


def _same(before: Image, after: Image) -> bool:
    if before.shape != after.shape or not np.array_equal(before[::16], after[::16]):
        return False
    return np.array_equal(before, after)
