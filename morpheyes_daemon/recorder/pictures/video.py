"""H.264 that browsers play, encoded frame by frame while the flight goes on, each frame shown when it was taken.

The film is kept in memory until it is closed: FFmpeg's own file output ends the process (SIGSEGV) when the disk is
full. A minute takes a few megabytes. Knows nothing of flights; `film.py` composes the pictures.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any

from morpheyes_daemon.errors import RecordingError
from morpheyes_daemon.messages.core import Image

MILLISECONDS = Fraction(1, 1000)
CODEC = {"preset": "superfast", "crf": "27"}
_CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")


class VideoWriter:
    """An mp4 of frames (H, W, 3) BGR, H and W even and always the same; close it, or there will be no file."""

    def __init__(self, path: Path) -> None:
        try:
            import av
        except ImportError:
            raise RecordingError("videos need PyAV: install morpheyes-daemon[sim].") from None
        self._av = av
        self._path = path
        self._content = BytesIO()
        self._container: Any = av.open(self._content, "w", format="mp4")
        self._stream: Any = None
        self._first_s = 0.0
        self._last_ms = -1

    def add(self, t_s: float, picture: Image) -> None:
        """Append a frame taken at `t_s`; one that is not later than the last is left out."""
        if self._stream is None:
            self._stream = self._open_stream(picture)
            self._first_s = t_s
        at_ms = round((t_s - self._first_s) * 1000)
        if at_ms <= self._last_ms:
            return
        self._last_ms = at_ms
        frame = self._av.VideoFrame.from_ndarray(picture, format="bgr24")
        frame.pts, frame.time_base = at_ms, MILLISECONDS
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write what the encoder still holds, the index, and the file; raises RecordingError when it cannot be."""
        if self._container is None:
            return
        container, self._container = self._container, None
        if self._stream is not None:
            container.mux(self._stream.encode(None))
        container.close()
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_bytes(index_first(self._content.getvalue()))
        except OSError as error:
            raise RecordingError(f"{self._path}: the film cannot be written there ({error.strerror}).") from None

    def _open_stream(self, picture: Image) -> Any:
        stream = self._container.add_stream("libx264", rate=30, options=CODEC)
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = MILLISECONDS
        stream.time_base = MILLISECONDS
        return stream


def index_first(mp4: bytes) -> bytes:
    """Return an mp4 with its index (moov) before its pictures (mdat), so that it plays before it is loaded whole.

    The places of the pictures, which the index holds (ISO 14496-12, stco and co64), move by the index's length.
    """
    boxes = {kind: (start, end) for kind, start, end, _ in _boxes(mp4, 0, len(mp4))}
    if b"moov" not in boxes or b"mdat" not in boxes or boxes[b"moov"] < boxes[b"mdat"]:
        return mp4
    start, end = boxes[b"moov"]
    index = bytearray(mp4[start:end])
    _move(index, 0, len(index), end - start)
    _, head = boxes[b"ftyp"]
    return mp4[:head] + bytes(index) + mp4[head:start] + mp4[end:]


def _boxes(content: bytes | bytearray, start: int, end: int) -> Iterator[tuple[bytes, int, int, int]]:
    """Yield kind, start, end, and where its content begins, of each box."""
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", content, start)
        body = start + 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", content, body)
            body += 8
        size = size if size >= 8 else end - start  # 0 means up to the end
        yield kind, start, start + size, body
        start += size


def _move(index: bytearray, start: int, end: int, shift: int) -> None:
    for kind, _, after, body in _boxes(index, start, end):
        if kind in _CONTAINERS:
            _move(index, body, after, shift)
        elif kind in (b"stco", b"co64"):
            (count,) = struct.unpack_from(">I", index, body + 4)
            places = struct.Struct(f">{count}{'I' if kind == b'stco' else 'Q'}")
            places.pack_into(index, body + 8, *(place + shift for place in places.unpack_from(index, body + 8)))
