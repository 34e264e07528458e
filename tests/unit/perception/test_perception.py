"""What the pipeline makes of a rig that the drift watch no longer believes in."""

from __future__ import annotations

import pytest

from morpheyes_daemon.flights.flight_plan import make_plan
from morpheyes_daemon.messages.core import BaselineEstimate, StereoFrame, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.perception.extrinsics_monitor import ExtrinsicsMonitor
from morpheyes_daemon.perception.pipeline import Pipeline, VisionJob
from tests.support.panels import Panel, crooked_rig, raw_pair


@pytest.mark.parametrize(("broken", "late"), [(False, False), (True, False), (False, True)])
def test_depth_of_a_rig_that_is_broken_or_late_is_worth_nothing(
    monkeypatch: pytest.MonkeyPatch, broken: bool, late: bool
) -> None:
    plan = make_plan("forest", size="320x240", calibration="exact")
    rig = crooked_rig(320, 240)
    pipeline = Pipeline(plan.config, plan.mission, rig)
    pipeline._extrinsics.broken = broken
    monkeypatch.setattr(ExtrinsicsMonitor, "out_of_sync", late)
    panels = [Panel(5.0, slope_x=0.3), Panel(2.5, x_m=(-0.3, 0.6), y_m=(-0.5, 0.3), seed=3)]
    frame = StereoFrame(0, 0, *raw_pair(panels, rig, 0.2, noise=1.5), BaselineEstimate(0, 0.2, 0.2, 1e-4, False))
    seen = pipeline.perceive(VisionJob(frame, VehicleState(), keep_images=False))
    assert (Reason.EYES_APART in seen.image_faults) == (broken or late)
