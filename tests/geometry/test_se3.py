"""Exponential, adjoint and interpolation by their axioms, and against SciPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose

quick = settings(max_examples=60, deadline=None)
numbers = st.floats(-1.0, 1.0)
directions = (
    st.tuples(numbers, numbers, numbers)
    .filter(lambda v: np.linalg.norm(v) > 1e-2)
    .map(lambda v: np.array(v) / np.linalg.norm(v))
)
NEAR_HALF_A_TURN = (np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-12, np.pi)
NEAR_NONE = (0.0, 1e-300, 1e-15, 1e-9, 0.99e-3, 1.01e-3)
angles = st.one_of(st.floats(0.0, np.pi), st.sampled_from(NEAR_HALF_A_TURN + NEAR_NONE))
rotations = st.tuples(directions, angles).map(lambda r: r[0] * r[1])
twists = st.tuples(numbers, numbers, numbers, rotations).map(
    lambda t: np.concatenate([t[:3], t[3]])
)
poses = twists.map(se3.exp)


def hat(twist):
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = se3.cross_matrix(twist[3:])
    matrix[:3, 3] = twist[:3]
    return matrix


@quick
@given(twists)
def test_exp_is_the_matrix_exponential(twist):
    np.testing.assert_allclose(se3.exp(twist).matrix, expm(hat(twist)), atol=1e-12)


@quick
@given(rotations)
def test_rotation_exp_and_log_are_scipys(vector):
    quaternion = se3.rotation_exp(vector)
    expected = Rotation.from_rotvec(vector)
    np.testing.assert_allclose(
        Pose(orientation=quaternion).rotation, expected.as_matrix(), atol=1e-14
    )
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)
    length = np.linalg.norm(se3.rotation_log(quaternion))
    assert length == pytest.approx(expected.magnitude(), abs=1e-14)
    np.testing.assert_array_equal(se3.rotation_log(-quaternion), se3.rotation_log(quaternion))


def test_the_smallest_rotations_keep_all_their_digits():
    for angle in (1e-300, 1e-150, 1e-12, 1e-6):
        vector = np.array([0.6, 0.0, -0.8]) * angle
        np.testing.assert_allclose(se3.rotation_log(se3.rotation_exp(vector)), vector, rtol=1e-13)


@quick
@given(poses, twists)
def test_adjoint_takes_twists_from_frame_to_frame(pose, twist):
    there = pose @ se3.exp(twist) @ pose.inverse()
    np.testing.assert_allclose(se3.exp(se3.adjoint(pose) @ twist).matrix, there.matrix, atol=1e-11)


@quick
@given(poses, poses)
def test_adjoint_of_a_product_is_the_product(a, b):
    product = se3.adjoint(a) @ se3.adjoint(b)
    np.testing.assert_allclose(se3.adjoint(a @ b), product, atol=1e-12)


@quick
@given(rotations, directions)
def test_left_jacobian_is_the_derivative(vector, direction):
    step = 1e-6
    ahead, behind = (se3.rotation_exp(vector + s * direction) for s in (step, -step))
    slope = se3.rotation_between(behind, ahead) / (2 * step)
    np.testing.assert_allclose(se3.left_jacobian(vector) @ direction, slope, atol=1e-8)


@quick
@given(poses, poses, st.floats(0.0, 1.0))
def test_interpolation_goes_straight_and_turns_evenly(a, b, part):
    between = se3.interpolate_poses(a, b, part)
    np.testing.assert_allclose(
        between.position, (1 - part) * a.position + part * b.position, atol=1e-12
    )
    way = np.linalg.norm(se3.rotation_between(a.orientation, b.orientation))
    done = np.linalg.norm(se3.rotation_between(a.orientation, between.orientation))
    left = np.linalg.norm(se3.rotation_between(between.orientation, b.orientation))
    assert done == pytest.approx(part * way, abs=1e-12)
    assert left == pytest.approx((1 - part) * way, abs=1e-12)


def test_interpolation_takes_the_shorter_way_whatever_the_quaternions_sign():
    turned = se3.exp(np.array([0.0, 0, 0, 0, 0, np.radians(80)]))
    flipped = Pose(turned.position, -turned.orientation)
    half = se3.interpolate_poses(Pose(), flipped, 0.5)
    np.testing.assert_allclose(
        np.degrees(se3.rotation_log(half.orientation)), [0, 0, 40], atol=1e-12
    )
