"""The paper's section II: its laws against brute force, its table, and the numbers that `analyze` prints."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from morpheyes_daemon.paper.error_analysis import SYNC_DT_S, analysis, paper_subject, rig_subject
from morpheyes_daemon.stereo.depth import depth_sigma
from morpheyes_daemon.theory import sync
from morpheyes_daemon.theory.calibration_error import (
    EXTRINSIC,
    FOCAL_LENGTHS_MM,
    INTRINSIC,
    extrinsic_error,
    intrinsic_error,
    nominal,
    paper_lens,
    paper_pair,
    table_1,
)
from morpheyes_daemon.theory.depth_error import depth_error_m, farthest_m, nearest_m
from tests.support.panels import crooked_rig

metres = st.floats(0.5, 20.0)
baselines = st.floats(0.05, 0.4)
focal = st.floats(200.0, 1000.0)


@given(metres, baselines, focal)
def test_the_depth_error_is_the_derivative_of_b_f_over_d(z, b, f):
    d = b * f / z
    step = 1e-6 * d
    slope = (b * f / (d - step) - b * f / (d + step)) / (2 * step)
    assert depth_error_m(z, b, f, 0.25) == pytest.approx(0.25 * slope, rel=1e-6)
    assert depth_error_m(z, b, f, 0.25) == pytest.approx(depth_sigma(z, b, f, 0.25))


@given(baselines, focal, st.floats(0.01, 0.3))
def test_the_depth_error_at_the_farthest_trusted_depth_is_the_allowed_one(b, f, share):
    z = farthest_m(b, f, 0.25, share)
    assert depth_error_m(z, b, f, 0.25) == pytest.approx(share * z)


def test_the_near_limits_are_those_of_the_notes():
    # paper-notes 11: 160 disparities at f = 740 px
    assert nearest_m(0.1, 740.0, 160) == pytest.approx(0.46, abs=0.005)
    assert nearest_m(0.3, 740.0, 160) == pytest.approx(1.39, abs=0.005)


def disparity_after(z, b, f, u, moved_m, sideways_m=0.0, yaw_rad=0.0):
    """Disparity of the point that the left camera sees at column u, if the right camera has moved by then."""
    x = u * z / f
    p = np.array([x - b - sideways_m, 0.0, z - moved_m])
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    p = np.array([c * p[0] - s * p[2], 0.0, s * p[0] + c * p[2]])
    return u - f * p[0] / p[2]


@given(metres, baselines, focal, st.floats(0.2, 2.0))
def test_on_the_axis_both_ways_cost_exactly_k_pixels(z, b, f, k):
    d = b * f / z
    away, towards = sync.receding_m(z, b, f, k), sync.approaching_m(z, b, f, k)
    if math.isfinite(away):
        assert d - disparity_after(z, b, f, 0.0, -away) == pytest.approx(k, rel=1e-9)
    assert disparity_after(z, b, f, 0.0, towards) - d == pytest.approx(k, rel=1e-9)


def test_nothing_bounds_a_retreat_from_what_has_less_disparity_than_k():
    assert math.isinf(sync.receding_m(10.0, 0.1, 50.0, 1.0))


@given(metres, baselines, focal, st.floats(0.2, 2.0))
def test_forwards_no_column_of_the_image_costs_more_than_k(z, b, f, k):
    half = 320.0
    way = sync.off_axis_m(z, b, f, half, k)
    d = b * f / z
    columns = np.linspace(-half, half, 101)
    cost = np.array([abs(disparity_after(z, b, f, u, way) - d) for u in columns])
    # the left edge costs exactly k; the right edge may not cost more unless d is as large as the image
    assert cost[0] == pytest.approx(k, rel=1e-9)
    assert cost.max() <= k * (1 + 1e-9)


@given(metres, baselines, focal, st.floats(0.2, 2.0))
def test_sideways_and_yaw_cost_k_pixels(z, b, f, k):
    d = b * f / z
    way = sync.sideways_m(z, f, k)
    assert disparity_after(z, b, f, 0.0, 0.0, sideways_m=way) - d == pytest.approx(k, rel=1e-9)
    # the point at infinity is the one that yaw moves by the angle alone; k / f is its first order
    far = 1e6
    turned = disparity_after(far, b, f, b * f / far, 0.0, yaw_rad=sync.yaw_rad(f, k))
    assert turned == pytest.approx(k, rel=1e-4, abs=1e-3)


@given(metres, baselines, focal, st.floats(1e-4, 0.02))
def test_the_governors_bound_is_the_strictest(z, b, f, dt):
    bound = sync.sync_speed_bound_m_s(dt_s=dt, baseline_m=b, z_m=z, f_px=f, half_width_px=320.0)
    others = [
        sync.approaching_m(z, b, f),
        sync.receding_m(z, b, f),
        sync.off_axis_m(z, b, f, 320.0),
        sync.sideways_m(z, f),
    ]
    assert bound * dt == pytest.approx(min(others))
    on_axis = sync.sync_speed_bound_m_s(dt_s=dt, baseline_m=b, z_m=z, f_px=f)
    assert on_axis >= bound


def test_perfect_synchronization_bounds_nothing():
    assert math.isinf(sync.sync_speed_bound_m_s(dt_s=0.0, baseline_m=0.2, z_m=1.0, f_px=740.0))


@pytest.mark.parametrize("focal_mm", FOCAL_LENGTHS_MM)
def test_table_1_is_the_papers_at_every_focal_length(focal_mm):
    table = table_1(paper_lens(focal_mm), paper_pair(focal_mm))
    assert table["intrinsic"] == {"f": 1.0, "alpha": 0.0, "k1": 1.0, "k2": 1.0, "k3": 2.0, "k5": 1.0}
    row = {"T": 1.0, "phi": 0.0, "theta": 0.0, "psi": 0.0}
    assert table["extrinsic"] == {"x": row, "y": row}
    assert "largest" in str(table["statistic"])


def test_k4_mirrors_k3():
    lens = paper_lens(4.0)
    k3, k4 = intrinsic_error(lens, "k3", 1.0), intrinsic_error(lens, "k4", 1.0)
    assert (k4.x_px, k4.y_px) == pytest.approx((k3.y_px, k3.x_px))


@pytest.mark.parametrize("name", INTRINSIC)
def test_intrinsic_errors_are_those_of_the_formulas(name):
    """At the corner x = y, each number moves a pixel by f times its term of the lens model."""
    lens, share = paper_lens(3.0), 0.02
    x = 63.5 / lens.fx
    r2 = 2 * x * x
    value = nominal(lens, name)
    terms = {
        "f": (x * value, x * value),
        "alpha": (value * x * lens.fx, 0.0),
        "k1": (value * r2 * x * lens.fx,) * 2,
        "k2": (value * r2**2 * x * lens.fx,) * 2,
        "k3": (value * 2 * x * x * lens.fx, value * 4 * x * x * lens.fx),
        "k5": (value * r2**3 * x * lens.fx,) * 2,
    }
    error = intrinsic_error(lens, name, 100 * share)
    assert (error.x_px, error.y_px) == pytest.approx(tuple(share * abs(term) for term in terms[name]), rel=1e-9)


def test_a_lens_own_numbers_are_what_errors_are_percent_of():
    lens = replace(paper_lens(4.0), k=(-0.3, 0.0, 0.0, 0.0, 0.0))
    assert nominal(lens, "k1") == -0.3
    assert intrinsic_error(lens, "k1", 1.0).x_px == pytest.approx(3 * intrinsic_error(paper_lens(4.0), "k1", 1.0).x_px)


def test_rotation_errors_move_the_right_camera_by_what_the_angle_says():
    pair = paper_pair(16.0)
    f = pair.cam0.fx
    # in the middle of the image pitch and yaw move by f per radian; the corner adds (y / f)^2 and x y / f^2
    _, right = extrinsic_error(pair, "phi", 0.1)
    assert right.y_px == pytest.approx(f * math.radians(0.1) * (1 + (63.5 / f) ** 2), rel=0.02)
    _, right = extrinsic_error(pair, "psi", 0.1)
    assert right.x_px == pytest.approx(63.5 * math.radians(0.1), rel=0.02)
    assert extrinsic_error(pair, "theta", 0.0)[1].x_px == 0.0


def test_the_paper_analysis_has_the_asked_keys():
    numbers = analysis(paper_subject())
    assert set(numbers["table_1"]) == {"statistic", "intrinsic", "extrinsic"}
    assert set(numbers["table_1"]["intrinsic"]) == set(INTRINSIC)
    assert set(numbers["table_1"]["extrinsic"]["y"]) == set(EXTRINSIC)
    rows = numbers["sync"]
    assert {row["dt_s"] for row in rows} == set(SYNC_DT_S)
    assert min(row["baseline_m"] for row in rows) == 0.1
    assert max(row["baseline_m"] for row in rows) == 0.3
    assert all(set(row) == {"dt_s", "baseline_m", "v_max_m_s"} for row in rows)
    at = next(row for row in rows if row["dt_s"] == 0.001 and row["baseline_m"] == 0.1)
    assert at["v_max_m_s"] == pytest.approx(1 / (74 - 1) / 0.001)


def test_a_rig_is_analysed_with_its_own_numbers():
    rig = crooked_rig()
    numbers = analysis(rig_subject(rig, "mine"))
    assert numbers["f_px"] == pytest.approx((741 + 739 + 737 + 738.5) / 4)
    intrinsic = numbers["calibration_error"]["intrinsic"]
    assert {row["lens"] for row in intrinsic} == {"left eye", "right eye"}
    assert next(row for row in intrinsic if row["parameter"] == "k1")["nominal"] == -0.18
    pairs = {row["pair"] for row in numbers["calibration_error"]["extrinsic"]}
    assert pairs == {"100 mm", "200 mm", "300 mm"}
    # turning the right camera leaves the left image alone on any rig
    assert numbers["table_1"]["extrinsic"]["x"]["theta"] == 0.0


def test_a_fixed_rig_can_be_analysed():
    rig = crooked_rig()
    fixed = replace(rig, baselines=rig.baselines[:1])
    numbers = analysis(rig_subject(fixed, "fixed"))
    assert {row["baseline_m"] for row in numbers["sync"]} == {fixed.length_m(0.1)}
