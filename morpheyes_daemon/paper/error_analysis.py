"""The paper's section II in numbers, for its own cameras or a calibrated rig; `morpheyes analyze` prints them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.stereo.rig import RigModel
from morpheyes_daemon.theory import sync
from morpheyes_daemon.theory.calibration_error import (
    EXTRINSIC,
    FOCAL_LENGTHS_MM,
    SWEPT,
    CameraPair,
    extrinsic_error,
    intrinsic_error,
    nominal,
    paper_lens,
    paper_pair,
    rig_pair,
    table_1,
)
from morpheyes_daemon.theory.depth_error import depth_error_m, nearest_m

PAPER_F_PX = 740.0
PAPER_WIDTH_PX = 640
"""The flight camera: OV5647 behind 3.96 mm at 640 x 480 px (paper, section III-A)."""

PAPER_BASELINES_M = tuple(round(0.1 + 0.01 * i, 3) for i in range(21))
SYNC_DT_S = (1e-4, 1e-3, 2e-3, 5e-3, 1e-2)
SYNC_Z_M, SYNC_K_PX = 1.0, 1.0
"""Depth and disparity error of the paper's figure 5."""

DISPARITY_ERROR_PX = 0.25
DEPTHS_M = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0)

ERRORS_PCT = np.linspace(0.0, 10.0, 21)
ERRORS_DEG = np.linspace(0.0, 1.0, 21)
"""How wrong the numbers of figures 2 and 3 are."""


@dataclass(frozen=True)
class Subject:
    """What is analysed: lenses and eye pairs by label, and the flight camera's focal length, width and baselines."""

    name: str
    lenses: Mapping[str, CameraIntrinsics]
    pairs: Mapping[str, CameraPair]
    f_px: float
    width_px: int
    baselines_m: tuple[float, ...]
    num_disparities: int


def paper_subject() -> Subject:
    """Return the paper's cameras: six focal lengths for the calibration errors, the flight camera for the rest."""
    labels = {f"{f:g} mm": f for f in FOCAL_LENGTHS_MM}
    return Subject(
        name="the paper's cameras",
        lenses={label: paper_lens(f) for label, f in labels.items()},
        pairs={label: paper_pair(f) for label, f in labels.items()},
        f_px=PAPER_F_PX,
        width_px=PAPER_WIDTH_PX,
        baselines_m=PAPER_BASELINES_M,
        num_disparities=PAPER_WIDTH_PX // 4,
    )


def rig_subject(rig: RigModel, name: str) -> Subject:
    """Return a calibrated rig: both eyes, and the pose at its smallest, middle and largest baseline."""
    low, high = rig.range_m
    shown = sorted({low, (low + high) / 2, high})
    return Subject(
        name=name,
        lenses={"left eye": rig.cam0, "right eye": rig.cam1},
        pairs={f"{b * 1e3:.0f} mm": rig_pair(rig, b) for b in shown},
        f_px=(rig.cam0.fx + rig.cam0.fy + rig.cam1.fx + rig.cam1.fy) / 4,
        width_px=rig.size[0],
        baselines_m=tuple(rig.length_m(float(b)) for b in np.unique(np.linspace(low, high, 21))),
        num_disparities=max(16, rig.size[0] // 64 * 16),
    )


def analysis(subject: Subject) -> dict[str, Any]:
    """Return every number of the figures as plain data; keys carry units."""
    lens, pair = next(iter(subject.lenses.values())), next(iter(subject.pairs.values()))
    return {
        "subject": subject.name,
        "f_px": subject.f_px,
        "table_1": table_1(lens, pair),
        "sync": sync_rows(subject),
        "sync_cases": sync_case_rows(subject),
        "depth_error": depth_error_rows(subject),
        "calibration_error": {
            "statistic": "largest pixel error of the image",
            "intrinsic": intrinsic_rows(subject),
            "extrinsic": extrinsic_rows(subject),
        },
    }


def sync_rows(subject: Subject) -> list[dict[str, float | None]]:
    """Return the paper's figure 5: the printed bound at Z = 1 m, k = 1 px; None: no bound."""
    return [
        {
            "dt_s": dt,
            "baseline_m": b,
            "v_max_m_s": _finite(sync.receding_m(SYNC_Z_M, b, subject.f_px, SYNC_K_PX) / dt),
        }
        for dt in SYNC_DT_S
        for b in subject.baselines_m
    ]


def sync_case_rows(subject: Subject) -> list[dict[str, float | None]]:
    """Return every direction of motion (paper-notes 4), and the yaw rate, at the same Z and k."""
    f, half = subject.f_px, subject.width_px / 2
    return [
        {
            "dt_s": dt,
            "baseline_m": b,
            "receding_m_s": _finite(sync.receding_m(SYNC_Z_M, b, f, SYNC_K_PX) / dt),
            "approaching_m_s": sync.approaching_m(SYNC_Z_M, b, f, SYNC_K_PX) / dt,
            "whole_image_m_s": sync.off_axis_m(SYNC_Z_M, b, f, half, SYNC_K_PX) / dt,
            "sideways_m_s": sync.sideways_m(SYNC_Z_M, f, SYNC_K_PX) / dt,
            "yaw_rad_s": sync.yaw_rad(f, SYNC_K_PX) / dt,
        }
        for dt in SYNC_DT_S
        for b in subject.baselines_m
    ]


def depth_error_rows(subject: Subject) -> list[dict[str, float]]:
    """Return eps_z at a quarter of a pixel, and the near limit, for each baseline and depth."""
    return [
        {
            "baseline_m": b,
            "z_m": z,
            "error_m": depth_error_m(z, b, subject.f_px, DISPARITY_ERROR_PX),
            "disparity_error_px": DISPARITY_ERROR_PX,
            "near_limit_m": nearest_m(b, subject.f_px, subject.num_disparities),
        }
        for b in subject.baselines_m
        for z in DEPTHS_M
    ]


def intrinsic_rows(subject: Subject) -> list[dict[str, Any]]:
    """Return figure 2's curves: for each lens and number, pixel errors over percent of error."""
    return [
        {
            "lens": label,
            "parameter": name,
            "nominal": nominal(lens, name),
            "error_pct": ERRORS_PCT.tolist(),
            **_curves([intrinsic_error(lens, name, float(e)) for e in ERRORS_PCT]),
        }
        for label, lens in subject.lenses.items()
        for name in SWEPT
    ]


def extrinsic_rows(subject: Subject) -> list[dict[str, Any]]:
    """Return figure 3's curves: errors of the right image (and of the left, `_left`) over percent or degrees."""
    rows = []
    for label, pair in subject.pairs.items():
        for name in EXTRINSIC:
            key, errors = ("error_pct", ERRORS_PCT) if name == "T" else ("error_deg", ERRORS_DEG)
            both = [extrinsic_error(pair, name, float(e)) for e in errors]
            left = {f"{k}_left": v for k, v in _curves([error[0] for error in both]).items()}
            right = _curves([error[1] for error in both])
            rows.append({"pair": label, "parameter": name, key: errors.tolist(), **right, **left})
    return rows


def _curves(errors: list[Any]) -> dict[str, list[float]]:
    return {"e_x_px": [error.x_px for error in errors], "e_y_px": [error.y_px for error in errors]}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
