"""Files of `morpheyes depth`: reads image pairs, writes depth maps and their figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morpheyes_daemon import LARGEST_PICTURE_PX
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import FloatMap, Image
from morpheyes_daemon.stereo.colours import UNKNOWN_BGR, colour_depth
from morpheyes_daemon.stereo.still import StillDepth, halves

LARGEST_FILE_BYTES = 300_000_000
"""Bytes; chosen: no compression makes LARGEST_PICTURE_PX larger than this."""
NEAR_BGR, HALF_OCCLUDED_BGR = (235, 235, 235), (96, 84, 78)
INK, GREY = "#30343a", "#888888"
WIDTH_IN, DPI = 9.0, 150
"""Colours of the figure, its width in inches and its dots per inch; chosen: readable in print and on screen."""


def read_pair(left: Path, right: Path | None) -> tuple[Image, Image]:
    """Return two pictures (H, W) or (H, W, 3) uint8, from two files or one side-by-side one.

    Raises InputError naming the file that cannot be read.
    """
    if right is None:
        return halves(read_picture(left))
    return read_picture(left), read_picture(right)


def read_picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> Image:
    """Return a picture as BGR (H, W, 3) uint8, or as OpenCV's `flags` say; raises InputError naming the file."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file.")
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise InputError(f"{path}: is larger than {LARGEST_FILE_BYTES // 1_000_000} MB; make it smaller.")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    return decode_picture(content, str(path), flags)


def decode_picture(content: bytes, name: str, flags: int = cv2.IMREAD_COLOR) -> Image:
    """Return the picture in a file's content; raises InputError, also for one of more pixels than are ever read."""
    try:
        picture = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags) if content else None
    except cv2.error as error:
        if "CV_IO_MAX_IMAGE" in str(error):
            raise InputError(
                f"{name}: has more than {LARGEST_PICTURE_PX // 1_000_000} million pixels; make it smaller."
            ) from None
        picture = None
    if picture is None:
        raise InputError(f"{name}: cannot be read as a picture; PNG, JPEG, PPM and the like can.")
    return np.asarray(picture, dtype=np.uint8)


def write_depth(out: Path, depth: StillDepth, title: str) -> list[Path]:
    """Write depth.npy and depth.png into `out` and return their paths; raises InputError when they cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        np.save(out / "depth.npy", depth.depth_m)
        draw_depth(out / "depth.png", depth, title)
    except OSError as error:
        raise InputError(f"{out}: the results cannot be written there ({error.strerror}); name another --out.") from None
    return [out / "depth.npy", out / "depth.png"]


def draw_depth(path: Path, depth: StillDepth, title: str) -> None:
    """Write the left image and its depth side by side, with a colour bar in metres and a legend of unknown pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    near_m, far_m = _range(depth.depth_m)
    height, width = depth.depth_m.shape
    figure = Figure(figsize=(WIDTH_IN, 0.47 * WIDTH_IN * height / width + 0.75), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2)
    panels[0].imshow(_rgb(depth.left), interpolation="antialiased")
    panels[1].imshow(_rgb(_coloured(depth, near_m, far_m)), interpolation="nearest")
    for axes, name in zip(panels, (title, "depth"), strict=True):
        axes.set_axis_off()
        axes.set_title(name, fontsize=9, color=INK, loc="left")
    _colour_bar(figure, panels[1], near_m, far_m)
    shares = [
        (UNKNOWN_BGR, "unknown", np.isnan(depth.depth_m) & ~depth.near & ~depth.half_occluded),
        (NEAR_BGR, f"nearer than {depth.near_limit_m:.2f} m", depth.near),
        (HALF_OCCLUDED_BGR, "half-occluded (left camera only)", depth.half_occluded),
    ]
    handles = [
        Patch(facecolor=_hex(bgr), edgecolor=GREY, label=f"{label} ({100 * mask.mean():.1f} %)")
        for bgr, label, mask in shares
    ]
    figure.legend(handles=handles, loc="outside lower right", ncols=3, fontsize=8, frameon=False, labelcolor=INK)
    figure.savefig(path, facecolor="white")


def _range(depth_m: FloatMap) -> tuple[float, float]:
    """Return the ends of the colour scale, metres: the 0.5 and 99 percentiles of the known depths (H, W)."""
    known = depth_m[np.isfinite(depth_m)]
    if not known.size:
        return 0.5, 30.0
    near_m, far_m = (float(v) for v in np.percentile(known, (0.5, 99.0)))
    return near_m, max(far_m, 1.05 * near_m)


def _coloured(depth: StillDepth, near_m: float, far_m: float) -> Image:
    picture = colour_depth(depth.depth_m, near_m, far_m)
    picture[depth.near] = NEAR_BGR
    picture[depth.half_occluded] = HALF_OCCLUDED_BGR
    return picture


def _colour_bar(figure: Any, axes: Any, near_m: float, far_m: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, LogNorm
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ramp = np.geomspace(near_m, far_m, 256).astype(np.float32)[None]
    colours = ListedColormap(_rgb(colour_depth(ramp, near_m, far_m))[0] / 255.0)
    bar = figure.colorbar(ScalarMappable(LogNorm(near_m, far_m), colours), cax=axes.inset_axes((1.03, 0.0, 0.045, 1.0)))
    bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())
    if far_m < 1.6 * near_m:
        bar.ax.yaxis.set_ticks(np.linspace(near_m, far_m, 5))
    bar.ax.tick_params(labelsize=8, color=GREY)
    bar.ax.invert_yaxis()
    bar.set_label("depth [m]", fontsize=9, color=INK)
    bar.outline.set_visible(False)


def _rgb(picture: Image) -> Image:
    return picture[..., ::-1] if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)


def _hex(bgr: tuple[int, int, int]) -> str:
    return "#{2:02x}{1:02x}{0:02x}".format(*bgr)
