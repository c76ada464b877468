"""Rigid transforms by their axioms and against SciPy, and trees of frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from us_sim.errors import PoseError
from us_sim.geometry.pose import Pose

numbers = st.floats(-1.0, 1.0)
poses = (
    st.tuples(st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers, numbers))
    .filter(lambda p: np.linalg.norm(p[1]) > 1e-3)
    .map(lambda p: Pose(*p))
)
quick = settings(max_examples=50, deadline=None)


@quick
@given(poses)
def test_rotation_is_scipys(pose):
    expected = Rotation.from_quat(pose.orientation).as_matrix()
    np.testing.assert_allclose(pose.rotation, expected, atol=1e-12)


@pytest.mark.slow
@quick
@given(poses, poses, poses)
def test_composition_is_associative_and_is_the_matrix_product(a, b, c):
    np.testing.assert_allclose(((a @ b) @ c).matrix, (a @ (b @ c)).matrix, atol=1e-12)
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-12)


@quick
@given(poses)
def test_inverse_undoes(pose):
    np.testing.assert_allclose((pose @ pose.inverse()).matrix, np.eye(4), atol=1e-12)
    points = np.array([[0.1, -0.2, 0.3]])
    np.testing.assert_allclose(
        pose.inverse().transform_points(pose.transform_points(points)), points, atol=1e-12
    )


@pytest.mark.parametrize(
    ("position", "orientation", "words"),
    [
        ([np.nan, 0, 0], [0, 0, 0, 1], "not finite"),
        ([0, 0, 0], [0, np.inf, 0, 1], "not finite"),
        ([0, 0, 0], [0, 0, 0, 0], "quaternion is zero"),
        ([0, 0, 0], [0, 0, 0, 5e-324], "quaternion is zero"),
        ([0, 0, 0], [0, 0, 1e308, 1], "length 1"),
        ([0, 1e200, 0], [0, 0, 0, 1], "beyond"),
        ([0, 0], [0, 0, 0, 1], "3 coordinates"),
    ],
)
def test_what_is_no_pose_is_refused(position, orientation, words):
    with pytest.raises(PoseError, match=words):
        Pose(position, orientation)
