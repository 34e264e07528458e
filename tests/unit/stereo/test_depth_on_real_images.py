"""Depth on real images with ground truth: the motorcycle's figures, and the error law over five baselines."""

import numpy as np
import pytest

from morpheyes_daemon.benchmarks.depth_accuracy import (
    CONES_STEPS,
    MOTORCYCLE_BASELINE_M,
    MOTORCYCLE_DOFFS_PX,
    MOTORCYCLE_F_PX,
    accuracy,
    bench_depth,
    cones,
    motorcycle,
)
from morpheyes_daemon.stereo.matching import match
from morpheyes_daemon.stereo.still import rectified_depth
from tests.support.real_images import real_images

pytestmark = pytest.mark.realdata


def test_motorcycle_is_within_half_a_percent_on_85_percent_of_the_truth():
    pair = motorcycle(real_images("middlebury2014_motorcycle").parent)
    found = rectified_depth(
        pair.left,
        pair.right,
        f_px=MOTORCYCLE_F_PX,
        baseline_m=MOTORCYCLE_BASELINE_M,
        doffs_px=MOTORCYCLE_DOFFS_PX,
    )
    truth_m = MOTORCYCLE_F_PX * MOTORCYCLE_BASELINE_M / (pair.truth_px + MOTORCYCLE_DOFFS_PX)
    true = np.isfinite(truth_m)
    known = true & np.isfinite(found.depth_m)
    assert known.sum() / true.sum() >= 0.85
    assert np.median(np.abs(found.depth_m - truth_m)[known] / truth_m[known]) <= 0.005
    # it all lies within range: nothing may be called too near
    assert found.ceiling_fraction < 0.001


@pytest.fixture(scope="module")
def by_steps():
    data = real_images("middlebury2003_cones").parent
    found = {}
    for steps in CONES_STEPS:
        pair = cones(data, steps)
        found[steps] = pair, match(pair.left, pair.right, pair.disparities)
    return found


def test_the_error_falls_with_the_baseline_as_the_law_says(by_steps):
    """eps_z / z = eps_d / d: one disparity error in pixels explains the depth error at every baseline."""
    measured = {steps: accuracy(pair, found.disparity_px) for steps, (pair, found) in by_steps.items()}
    relative = [measured[steps]["median_relative_error"] for steps in CONES_STEPS]
    assert relative[0] > 3 * relative[1]
    assert relative[-1] < 0.25 * relative[0]
    typical_px = float(np.median([measured[steps]["median_error_px"] for steps in CONES_STEPS]))
    for steps in CONES_STEPS:
        pair, _ = by_steps[steps]
        law = typical_px / float(np.nanmedian(pair.truth_px))
        # views sit up to a tenth of a pixel off their places, which is as much as the matcher errs
        assert measured[steps]["median_relative_error"] == pytest.approx(law, rel=0.5), steps
    assert 0.08 < typical_px < 0.2


def test_real_images_within_range_have_nothing_too_near(by_steps):
    for steps, (_, found) in by_steps.items():
        assert found.near.mean() < 0.002, steps


def test_on_real_images_too_what_is_beyond_the_range_is_near_and_not_far(by_steps):
    pair, _ = by_steps[5]
    found = match(pair.left, pair.right, 48)
    column = np.arange(pair.left.shape[1])
    beyond = (pair.truth_px > 50) & (column > pair.truth_px)
    assert beyond.mean() > 0.05
    assert found.near[beyond].mean() > 0.6
    assert np.isfinite(found.disparity_px[beyond]).mean() < 0.15
    within = pair.truth_px < 40
    assert found.near[within].mean() < 0.02


def test_the_benchmark_compares_both_matchers_on_every_pair():
    data = real_images("middlebury2014_motorcycle").parent
    real_images("middlebury2003_cones")
    result = bench_depth(data, repeats=1)
    assert [pair["name"] for pair in result["pairs"]][:2] == ["motorcycle", "cones, 1 steps"]
    for pair in result["pairs"]:
        assert pair["ours"]["density"] > 0.97 * pair["opencv"]["density"]
        assert pair["opencv_over_ours"]["median_error_px"] > 1.0
        assert pair["ours"]["over_1_px"] < 1.05 * pair["opencv"]["over_1_px"]
        assert pair["opencv_over_ours"]["time_s"] > 0
