"""Dual quaternions and ScLERP agree with scipy and pytransform3d, at every rotation from none to a half turn."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytransform3d.transformations import (
    dual_quaternion_from_transform,
    dual_quaternion_sclerp,
    transform_from_dual_quaternion,
)
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from morpheyes_daemon.stereo.screw import (
    dual_quaternion,
    exponential,
    inverse,
    logarithm,
    multiply,
    pose_from_dual_quaternion,
    sclerp,
)
from morpheyes_daemon.transforms import pose, q_from_R

TOLERANCE = 1e-9
"""What the issue asks; both sides work in double precision on translations of metres."""

unit = st.tuples(*[st.integers(-1000, 1000)] * 3).filter(lambda v: any(v))
translation = st.tuples(*[st.integers(-2000, 2000).map(lambda mm: mm / 1000)] * 3)
angle = st.one_of(
    st.floats(0, math.pi - 1e-6),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 0.0199, 0.02, 0.0201, math.pi - 1e-3, math.pi - 1e-6]),
)


def motion(axis, angle_rad, t):
    rotvec = np.array(axis) / np.linalg.norm(axis) * angle_rad
    return pose(Rotation.from_rotvec(rotvec).as_matrix(), np.array(t))


def dual_quaternion_from_pose(T):
    return dual_quaternion(q_from_R(T[:3, :3]), T[:3, 3])


poses = st.builds(motion, unit, angle, translation)


def screw_reference(a, b, t):
    """a (a^-1 b)^t by scipy's matrix logarithm."""
    return a @ expm(t * np.real(logm(np.linalg.inv(a) @ b)))


@given(poses)
def test_a_pose_survives_the_way_through_a_dual_quaternion(T):
    dq = dual_quaternion_from_pose(T)
    assert np.allclose(pose_from_dual_quaternion(dq), T, atol=1e-14)
    assert np.linalg.norm(dq[:4]) == pytest.approx(1.0, abs=1e-14)
    assert abs(dq[:4] @ dq[4:]) < 1e-14


@given(poses)
def test_the_dual_quaternion_is_that_of_pytransform3d(T):
    theirs = dual_quaternion_from_transform(T)
    ours = dual_quaternion_from_pose(T)
    sign = 1.0 if ours[:4] @ theirs[:4] > 0 else -1.0
    assert np.allclose(ours, sign * theirs, atol=1e-12)


@given(poses, poses)
def test_multiplication_and_inverse_are_those_of_matrices(A, B):
    a, b = dual_quaternion_from_pose(A), dual_quaternion_from_pose(B)
    assert np.allclose(pose_from_dual_quaternion(multiply(a, b)), A @ B, atol=1e-13)
    assert np.allclose(pose_from_dual_quaternion(inverse(a)), np.linalg.inv(A), atol=1e-13)


@given(poses)
def test_the_exponential_undoes_the_logarithm(T):
    dq = dual_quaternion_from_pose(T)
    assert np.allclose(exponential(logarithm(dq)), dq, atol=1e-13)


@given(poses, unit, angle, translation, st.floats(0, 1))
@settings(max_examples=150)
def test_sclerp_is_that_of_pytransform3d(A, axis, angle_rad, t_rel, share):
    # poses are related by less than a half turn, where both libraries mean the same shorter way
    B = A @ motion(axis, angle_rad, t_rel)
    ours = pose_from_dual_quaternion(sclerp(dual_quaternion_from_pose(A), dual_quaternion_from_pose(B), share))
    a, b = dual_quaternion_from_transform(A), dual_quaternion_from_transform(B)
    theirs = transform_from_dual_quaternion(dual_quaternion_sclerp(a, b, share))
    assert np.abs(ours - theirs).max() <= TOLERANCE or near_their_singularity(angle_rad)


def near_their_singularity(angle_rad):
    """pytransform3d divides by the sine of the half angle; below this angle its own rounding exceeds 1e-9."""
    return 0.0 < angle_rad < 1e-5


@pytest.mark.parametrize("seed", range(20))
def test_sclerp_is_the_matrix_power_of_scipy(seed):
    rng = np.random.default_rng(seed)
    A = motion(rng.standard_normal(3), rng.uniform(0, math.pi), rng.uniform(-2, 2, 3))
    B = A @ motion(rng.standard_normal(3), rng.uniform(0.01, math.pi - 0.01), rng.uniform(-2, 2, 3))
    share = rng.uniform()
    ours = pose_from_dual_quaternion(sclerp(dual_quaternion_from_pose(A), dual_quaternion_from_pose(B), share))
    assert np.abs(ours - screw_reference(A, B, share)).max() <= TOLERANCE


@given(poses, unit, st.sampled_from([1e-12, 1e-10, 1e-8, 1e-6, 1e-5]), translation, st.floats(0, 1))
def test_tiny_rotations_interpolate_like_a_straight_line(A, axis, angle_rad, t_rel, share):
    B = A @ motion(axis, angle_rad, t_rel)
    ours = pose_from_dual_quaternion(sclerp(dual_quaternion_from_pose(A), dual_quaternion_from_pose(B), share))
    straight = A[:3, 3] + share * (B[:3, 3] - A[:3, 3])
    # a screw leaves the chord by at most angle * length / 8
    assert np.abs(ours[:3, 3] - straight).max() <= 0.5 * angle_rad + 1e-13


@given(unit, translation, st.floats(0, 1))
def test_a_pure_translation_is_interpolated_exactly(axis, t, share):
    a, b = dual_quaternion_from_pose(np.eye(4)), dual_quaternion_from_pose(pose(np.eye(3), np.array(t)))
    between = pose_from_dual_quaternion(sclerp(a, b, share))
    assert np.allclose(between, pose(np.eye(3), share * np.array(t)), atol=1e-15)


@given(poses, unit, translation, st.floats(0, 1))
def test_half_turns_stay_on_one_screw(A, axis, t, share):
    B = A @ motion(axis, math.pi, t)
    a, b = dual_quaternion_from_pose(A), dual_quaternion_from_pose(B)
    between = sclerp(a, b, share)
    # either way round is right: the rest of the way must be the power that is left
    rest = multiply(inverse(between), b)
    again = exponential((1.0 - share) * logarithm(_upright(multiply(inverse(a), b))))
    assert _same_motion(rest, again)
    assert np.isfinite(between).all()


@given(poses, poses)
def test_the_ends_are_the_ends(A, B):
    a, b = dual_quaternion_from_pose(A), dual_quaternion_from_pose(B)
    assert np.allclose(pose_from_dual_quaternion(sclerp(a, b, 0.0)), A, atol=1e-13)
    assert np.allclose(pose_from_dual_quaternion(sclerp(a, b, 1.0)), B, atol=1e-12)


@given(poses, unit, angle, translation, st.floats(0, 1))
def test_the_sign_of_a_dual_quaternion_does_not_matter(A, axis, angle_rad, t, share):
    a = dual_quaternion_from_pose(A)
    b = dual_quaternion_from_pose(A @ motion(axis, angle_rad, t))
    same = pose_from_dual_quaternion(sclerp(a, b, share))
    assert np.allclose(pose_from_dual_quaternion(sclerp(a, -b, share)), same, atol=1e-13)


def test_a_quaternion_that_is_not_quite_unit_is_normalised():
    dq = dual_quaternion(np.array([2.0, 0.0, 0.0, 0.0]), np.array([1.0, 2.0, 3.0]))
    assert np.allclose(pose_from_dual_quaternion(dq), pose(np.eye(3), np.array([1.0, 2.0, 3.0])))


def _upright(dq):
    return dq if dq[0] >= 0 else -dq


def _same_motion(a, b):
    return np.allclose(pose_from_dual_quaternion(a), pose_from_dual_quaternion(b), atol=1e-9)
