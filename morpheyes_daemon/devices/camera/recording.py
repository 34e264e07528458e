"""Recorded images as a camera: a folder or video of side-by-side or left/right images, at the configured rate.

A folder with image names that start with left and right, or with folders left and right, holds pairs that share
the rest of the name, and other images in it are passed over; any other folder holds side-by-side images. Order is
natural: 2 before 10. A recording is for the bench: images are decoded in the event loop, some milliseconds each.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from morpheyes_daemon.clock import Clock, Ticker
from morpheyes_daemon.config.vehicle import RecordingCameraConfig
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.errors import DeviceLostError, InputError
from morpheyes_daemon.messages.core import Image, RawPair, frozen
from morpheyes_daemon.stereo.image_files import read_picture

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".pnm"}
_SIDE = re.compile(r"(left|right)[-_ ]?(.*)", re.IGNORECASE)

Pair = tuple[Image, Image]


class Source(Protocol):
    """Pairs in order, by number."""

    def __len__(self) -> int:
        """Return how many pairs there are."""

    def pair(self, index: int) -> Pair:
        """Return a pair of images (H, W) or (H, W, 3); InputError when it cannot be read or does not match."""


class RecordingCamera:
    """A `Camera` over a recording; InputError when there is nothing usable at the path."""

    @classmethod
    def from_config(cls, config: RecordingCameraConfig, context: DeviceContext) -> RecordingCamera:
        """Build the backend `recording`; raises InputError when there is no recording at its path."""
        return cls(config, context.clock)

    def __init__(self, config: RecordingCameraConfig, clock: Clock) -> None:
        self._config, self._clock = config, clock
        self._source = find_source(config.path)
        self._next = 0
        self._seq = 0
        self._ticker: Ticker | None = None
        self._checked(self._source.pair(0), "the first")

    async def open(self) -> None:
        """Start the beat; a recording that was closed goes on where it was."""
        if self._ticker is None:
            self._ticker = Ticker(self._clock, self._config.rate_hz)

    async def read(self) -> RawPair:
        """Return the next pair at its beat; DeviceLostError at the end, InputError for a pair that is damaged."""
        if self._ticker is None:
            raise DeviceLostError("The recording is not open.")
        await self._ticker.wait()
        if self._next == len(self._source):
            if not self._config.loop:
                raise DeviceLostError(f"The recording {self._config.path} is at its end.")
            self._next = 0
        index, self._next = self._next, self._next + 1
        left, right = self._checked(self._source.pair(index), f"number {index + 1}")
        self._seq += 1
        return RawPair(self._seq, self._clock.now_ns(), frozen(left), frozen(right))

    async def close(self) -> None:
        """Stop."""
        self._ticker = None

    def _checked(self, pair: Pair, which: str) -> Pair:
        height, width = pair[0].shape[:2]
        wanted = self._config.width_px, self._config.height_px
        if (width, height) != wanted:
            raise InputError(
                f"{self._config.path}: {which} pair has images of {width}×{height} per eye, but the camera is "
                f"configured as {wanted[0]}×{wanted[1]}; set camera.width_px and camera.height_px."
            )
        return pair


def find_source(path: Path) -> Source:
    """Return the pairs at a folder, video or single side-by-side image; InputError when there are none."""
    if path.is_dir():
        return _folder_source(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such recording.")
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return SideBySideFiles([path])
    return Video(path)


def _folder_source(folder: Path) -> Source:
    images = _images_in(folder)
    if not images:
        images = [image for name in ("left", "right") for image in _images_in(folder / name)]
    if not images:
        raise InputError(f"{folder}: there are no images ({', '.join(sorted(IMAGE_SUFFIXES))}) in this folder.")
    sides = {path: side for path in images if (side := _side_of(path, folder))}
    if {side for side, _ in sides.values()} == {"left", "right"}:
        return LeftRightFiles(list(_paired(sides)))
    return SideBySideFiles(images)


def _images_in(folder: Path) -> list[Path]:
    files = folder.iterdir() if folder.is_dir() else ()
    return sorted((path for path in files if path.suffix.lower() in IMAGE_SUFFIXES), key=_natural)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key: digits count as numbers."""
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part.lower()) for part in parts]


def _side_of(path: Path, folder: Path) -> tuple[str, str] | None:
    """Return (left or right, the rest that both eyes share), None for a name that says neither."""
    if path.parent != folder:
        return path.parent.name, path.stem
    match = _SIDE.fullmatch(path.stem)
    return (match[1].lower(), match[2]) if match else None


def _paired(sides: dict[Path, tuple[str, str]]) -> Iterator[tuple[Path, Path]]:
    by_side = {(side, rest): path for path, (side, rest) in sides.items()}
    for (side, rest), path in by_side.items():
        other = "right" if side == "left" else "left"
        if (other, rest) not in by_side:
            raise InputError(f"{path}: the {other} image that belongs to it is missing.")
        if side == "left":
            yield path, by_side["right", rest]


class LeftRightFiles:
    """Two image files per pair."""

    def __init__(self, paths: list[tuple[Path, Path]]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    def pair(self, index: int) -> Pair:
        """Return the left and right image of one stereo frame; raises InputError when it cannot be read."""
        left_path, right_path = self._paths[index]
        left, right = read_image(left_path), read_image(right_path)
        if left.shape != right.shape:
            raise InputError(
                f"{left_path} is {_size(left)} and {right_path.name} is {_size(right)}; both eyes must have one size."
            )
        return left, right


class SideBySideFiles:
    """One image file per pair, the left eye in its left half."""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    def pair(self, index: int) -> Pair:
        """Return the left and right image of one stereo frame; raises InputError when it cannot be read."""
        path = self._paths[index]
        return halves(read_image(path), str(path))


class Video:
    """A side-by-side video; going back or skipping is possible but slow."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._capture = cv2.VideoCapture(str(path))
        self._at = 0
        self._length = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if not self._capture.isOpened() or self._length < 1:
            raise InputError(f"{path}: cannot be read as a video; is it damaged, or no video at all?")

    def __len__(self) -> int:
        return self._length

    def pair(self, index: int) -> Pair:
        """Return the left and right image of one stereo frame; raises InputError when it cannot be read."""
        if index != self._at:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
        good, image = self._capture.read()
        self._at = index + 1
        if not good:
            self._length = max(1, index)  # containers often promise more frames than they hold
            raise InputError(f"{self._path}: frame {index + 1} cannot be decoded; the video ends before it here.")
        return halves(np.asarray(image, dtype=np.uint8), f"{self._path}, frame {index + 1}")


def read_image(path: Path) -> Image:
    """Read an image as grey (H, W) or BGR (H, W, 3), 8 bit; InputError when it cannot be."""
    return read_picture(path, cv2.IMREAD_ANYCOLOR)


def halves(image: Image, name: str) -> Pair:
    """Split a side-by-side image into contiguous left and right; InputError when the width is odd."""
    width = image.shape[1]
    if width % 2:
        raise InputError(f"{name}: a width of {width} px is odd, so it is no side-by-side pair.")
    return np.ascontiguousarray(image[:, : width // 2]), np.ascontiguousarray(image[:, width // 2 :])


def _size(image: Image) -> str:
    return f"{image.shape[1]}×{image.shape[0]}"
