"""H.264 that browsers play, written frame by frame while the flight goes on, each frame shown when it was taken.

Knows nothing of flights; `film.py` composes the pictures.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

from morpheyes_daemon.errors import RecordingError
from morpheyes_daemon.messages.core import Image

MILLISECONDS = Fraction(1, 1000)
CODEC = {"preset": "superfast", "crf": "27"}


class VideoWriter:
    """An mp4 of frames (H, W, 3) BGR, H and W even and always the same; close it, or it will not play."""

    def __init__(self, path: Path) -> None:
        try:
            import av
        except ImportError:
            raise RecordingError("videos need PyAV: install morpheyes-daemon[sim].") from None
        self._av = av
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container: Any = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
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
        """Write what the encoder still holds and the index."""
        if self._container is None:
            return
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()
        self._container = None

    def _open_stream(self, picture: Image) -> Any:
        stream = self._container.add_stream("libx264", rate=30, options=CODEC)
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = MILLISECONDS
        stream.time_base = MILLISECONDS
        return stream
