"""A calibration as the rig model that the daemon reads, with everything a person may want to know of it beside."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from morpheyes_daemon.calibration.projection import camera_from_vector
from morpheyes_daemon.calibration.solver import Calibration
from morpheyes_daemon.calibration.uncertainty import baseline_uncertainty
from morpheyes_daemon.stereo.rig import CalibratedBaseline, RigModel


def rig_model(calibration: Calibration, details: Mapping[str, Any] | None = None) -> RigModel:
    """Return the rig model of a calibration."""
    state, size = calibration.solution.state, calibration.observations.size
    cam0, cam1 = (camera_from_vector(eye, size) for eye in state.eyes)
    rms = calibration.rms_px
    baselines = []
    for index, (nominal, T) in enumerate(zip(calibration.nominal_m, calibration.poses, strict=True)):
        sigma = baseline_uncertainty(calibration, index)
        measures = {"rms_px": float(rms[index]), "sigma_length_m": sigma.length_m, "sigma_yaw_rad": sigma.yaw_rad}
        baselines.append(CalibratedBaseline.from_pose(float(nominal), T, **measures))
    return RigModel(cam0, cam1, tuple(baselines), "solved", details or {})
