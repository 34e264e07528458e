"""Pictures that are none, or too large, and offsets that no camera has: one sentence, before memory is spent."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from morpheyes_daemon.errors import InputError, printable
from morpheyes_daemon.stereo.image_files import decode_picture, read_picture
from morpheyes_daemon.stereo.still import rectified_depth


def png(width: int, height: int, content: bytes = b"\0") -> bytes:
    """A PNG whose header claims a size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(content)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("side", [30_000, 60_000])
def test_a_picture_with_too_many_pixels_is_refused_by_its_header(tmp_path: Path, side: int) -> None:
    """In a process of its own, whose memory is bounded to less than the picture would take."""
    path = tmp_path / "bomb.png"
    path.write_bytes(png(side, side))
    code = (
        "import resource, sys\n"
        "from morpheyes_daemon.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (900 << 20, 900 << 20))\n"
        f"sys.argv = ['morpheyes', 'depth', {str(path)!r}, {str(path)!r}, '--focal-px', '700', '--baseline-m', '0.2']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2, done.stderr
    assert "million pixels" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("content", [b"", b"no picture", png(100, 100)[:40], b"\x89PNG\r\n\x1a\n" + b"\xff" * 100])
def test_what_is_no_picture_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.png"
    path.write_bytes(content)
    with pytest.raises(InputError, match="broken.png: cannot be read as a picture"):
        read_picture(path)


def test_a_good_picture_comes_as_asked() -> None:
    image = np.arange(64 * 48, dtype=np.uint8).reshape(48, 64)
    content = cv2.imencode(".png", image)[1].tobytes()
    assert decode_picture(content, "x").shape == (48, 64, 3)
    assert np.array_equal(decode_picture(content, "x", cv2.IMREAD_GRAYSCALE), image)


@pytest.mark.parametrize("shape", [(1, 640), (480, 1), (15, 32), (16, 31)])
def test_a_picture_of_hardly_any_rows_or_columns_is_refused(shape: tuple[int, int]) -> None:
    image = np.zeros(shape, np.uint8)
    with pytest.raises(InputError, match="nothing to match"):
        rectified_depth(image, image, f_px=700.0, baseline_m=0.2)


@pytest.mark.parametrize("doffs_px", [math.nan, math.inf, -math.inf, 1e9])
def test_an_offset_that_no_camera_has_is_refused(doffs_px: float) -> None:
    image = np.zeros((120, 160), np.uint8)
    with pytest.raises(InputError, match="offset"):
        rectified_depth(image, image, f_px=700.0, baseline_m=0.2, doffs_px=doffs_px)


def test_what_a_terminal_would_obey_is_written_out() -> None:
    shown = printable("\x1b[2Jgone\x07\u202etxt\nnext\tµ≤é")
    assert shown == "\\x1b[2Jgone\\x07\\u202etxt\\nnext\tµ≤é"
