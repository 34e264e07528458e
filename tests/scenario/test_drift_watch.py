"""The drift watch before the camera twin: a bent rig is noticed and put right, late eyes are told how late they are."""

import pytest

from morpheyes_daemon.benchmarks.online_calibration import FRAMES, drift_trial, late_trials
from morpheyes_daemon.simulation.camera.true_rig import RigTwin

pytestmark = pytest.mark.slow


def test_a_rig_bent_after_calibration_is_noticed_and_corrected() -> None:
    trial = drift_trial(RigTwin(640, 480, seed=0).exact_rig(), seed=0)
    assert trial.before_disparity_bias_px > 1.8, "0.15 degrees are two pixels"
    assert trial.noticed_after is not None
    assert trial.noticed_after <= FRAMES
    assert trial.epipolar_median_px <= 0.3
    assert trial.disparity_bias_px <= 0.3
    assert len(trial.said) >= 2, "it says what it did"


def test_a_good_rig_is_left_alone() -> None:
    trial = drift_trial(RigTwin(640, 480, seed=1).exact_rig(), seed=1, bent_deg=0.0)
    assert trial.said == ()


def test_the_time_between_the_eyes_is_measured_from_the_images() -> None:
    for trial in late_trials(RigTwin(640, 480, seed=0).exact_rig(), seed=0):
        assert trial.measured_ms == pytest.approx(trial.true_ms, abs=0.5)
        assert trial.ends_trust == (trial.true_ms > 6.0), "2 ms are declared, 4 more allowed"
