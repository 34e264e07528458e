"""The gap's contour in real images: GapFlyt's own frames, two of them as depth, against masks drawn by hand.

The frames are monocular, so the flow from one to another takes the place of inverse depth: where the camera moved
sideways its length is proportional to it, where it moved forward, its length over the distance from the point the
camera flies to. From there on it is the mission's own split into near and far.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from morpheyes_daemon.benchmarks.gapflyt_baseline import dis_flow, enclosed
from morpheyes_daemon.campaigns.gap_ground_truth import iou
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.messages.core import FloatMap, Image, Mask
from morpheyes_daemon.stereo.depth import grey
from morpheyes_daemon.stereo.image_files import read_picture
from morpheyes_daemon.strategies.gap.wall_segmentation import segment_inverse_depth

OPENING, IGNORED = 255, 128
"""In the masks; the cloth of scene A looks like a part of the hole but moves with the wall."""

FLOW_SIGMA = 0.05
"""One sigma of a flow, as a share of its median."""

SMOOTH_PX = 7


@dataclass(frozen=True, slots=True)
class ScenePair:
    """Two frames of a scene, the mask of the first, the authors' own flow from it, and how the camera moved."""

    name: str
    first: str
    second: str
    mask: str
    flow: str
    forward: bool


SCENES = (
    ScenePair("A, small step", "Temp_frame_0001.png", "Temp_frame_0002.png", "gapmask_Temp_frame_0001.png",
              "Output_1and2.flo", forward=False),
    ScenePair("A, large step", "Temp_frame_0001.png", "Temp_frame_0003.png", "gapmask_Temp_frame_0001.png",
              "Output_1and3.flo", forward=False),
    ScenePair("B", "flownet2-tf-umd_13.png", "flownet2-tf-umd_15.png", "gapmask_flownet2-tf-umd_13.png",
              "flownet2-tf-umd_13and15Gray.flo", forward=True),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class SceneIou:
    """How well the opening of one scene was found in one kind of flow; `separation` is Ashman's D of the clusters."""

    scene: str
    flow: str
    iou: float
    separation: float
    bimodal: bool


def gap_images(data: Path) -> list[SceneIou]:
    """Return the IoU of every scene with our flow (dense inverse search) and with the authors' (FlowNet2).

    Raises InputError when the images are not there.
    """
    folder = data / "gapflyt"
    if not folder.is_dir():
        raise InputError(f"{folder}: there are no real gap images; set MORPHEYES_DATA to the folder above it.")
    found = []
    for scene in SCENES:
        first, second = (grey(read_picture(folder / name)) for name in (scene.first, scene.second))
        mask = grey(read_picture(folder / scene.mask))
        for kind, flow in (("dis", dis_flow().calc(first, second, None)), ("flownet2", read_flo(folder / scene.flow))):
            found.append(_judged(scene, kind, np.asarray(flow, dtype=np.float32), mask))
    return found


def read_flo(path: Path) -> FloatMap:
    """Read a flow (H, W, 2) float32 in Middlebury's format; raises InputError."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    if len(raw) < 12 or np.frombuffer(raw, np.float32, 1)[0] != np.float32(202021.25):
        raise InputError(f"{path}: is not a Middlebury .flo file.")
    width, height = (int(x) for x in np.frombuffer(raw, np.int32, 2, 4))
    if len(raw) < 12 + 8 * width * height:
        raise InputError(f"{path}: is cut off.")
    return np.frombuffer(raw, np.float32, 2 * width * height, 12).reshape(height, width, 2).copy()


def inverse_depth_of(flow: FloatMap, forward: bool) -> FloatMap:
    """Return what of a flow (H, W, 2) is proportional to inverse depth, (H, W) float32."""
    if not forward:
        return np.asarray(cv2.magnitude(flow[..., 0], flow[..., 1]))
    u, v = focus_of_expansion(flow)
    column, row = np.meshgrid(np.arange(flow.shape[1], dtype=np.float32), np.arange(flow.shape[0], dtype=np.float32))
    away = np.maximum(np.hypot(column - np.float32(u), row - np.float32(v)), 8.0)
    along = (flow[..., 0] * (column - u) + flow[..., 1] * (row - v)) / away
    return np.asarray(along / away, dtype=np.float32)


def focus_of_expansion(flow: FloatMap) -> tuple[float, float]:
    """Return the pixel that all flows point away from: least squares of the lines along them, twice reweighted."""
    step = 8
    row, column = np.mgrid[0 : flow.shape[0] : step, 0 : flow.shape[1] : step]
    du, dv = (flow[::step, ::step, k].ravel().astype(np.float64) for k in (0, 1))
    size = np.maximum(np.hypot(du, dv), 1e-6)
    normal = np.stack([-dv / size, du / size], axis=1)
    offset = normal[:, 0] * column.ravel() + normal[:, 1] * row.ravel()
    weight = np.minimum(size, 5.0)
    point = np.zeros(2)
    for _ in range(5):
        A = normal * weight[:, None]
        point = np.linalg.lstsq(A, offset * weight, rcond=None)[0]
        weight = np.minimum(size, 5.0) / (1.0 + np.abs(normal @ point - offset) / 20.0)
    return float(point[0]), float(point[1])


def largest_hole(inverse: FloatMap) -> tuple[Mask, float, bool]:
    """Return the largest hole (H, W) that the near surface encloses, Ashman's D of the split, and whether it is one."""
    smooth: FloatMap = np.asarray(cv2.medianBlur(inverse, 5), dtype=np.float32)
    for _ in range(2):
        filtered = cv2.bilateralFilter(smooth, SMOOTH_PX, 0.3 * float(np.median(smooth)), SMOOTH_PX)
        smooth = np.asarray(filtered, dtype=np.float32)
    sigma = FLOW_SIGMA * float(np.median(np.abs(smooth)))
    found = segment_inverse_depth(smooth.__getitem__, np.zeros(smooth.shape, np.bool_), sigma)
    if found is None:
        return np.zeros(smooth.shape, np.bool_), 0.0, False
    return enclosed(found.clusters()[0]), found.separation, found.bimodal


def _judged(scene: ScenePair, kind: str, flow: FloatMap, mask: Image) -> SceneIou:
    hole, separation, bimodal = largest_hole(inverse_depth_of(flow, scene.forward))
    counted = mask != IGNORED
    return SceneIou(scene.name, kind, round(iou(hole & counted, mask == OPENING), 4), round(separation, 2), bimodal)
