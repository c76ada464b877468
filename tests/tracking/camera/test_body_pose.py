"""Poses from corners: both of a plane's, refined together, with a covariance that is true."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from camera_views import WEBCAM, faceted_grip, random_views, turned
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.pose import Pose
from us_sim.tracking.camera.body_pose import (
    CORNER_DEVIATION,
    PlaneAmbiguity,
    estimate_body_poses,
    rotation_angle,
    solve_plane_poses,
)
from us_sim.tracking.camera.markers import compute_square_corners
from us_sim.tracking.camera.model import CameraModel

PINHOLE = CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]])
MARKER = compute_square_corners(0.04)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 2.0), st.floats(1.0, 80.0))
def test_one_of_a_planes_two_poses_is_the_true_one(seed, distance, angle):
    (true,) = random_views(1, distance, (angle, angle), seed)
    seen = true.transform_points(MARKER)
    poses = solve_plane_poses(MARKER, seen[:, :2] / seen[:, 2:])
    assert len(poses) == 2
    rotation, position = poses[0]
    assert np.allclose(rotation, true.rotation, atol=1e-4)
    assert np.allclose(position, true.position, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("degrees", range(0, 360, 15))
def test_a_marker_that_squarely_faces_the_camera_has_its_pose(degrees):
    # OpenCV's IPPE alone takes half a turn, of which all of these are, for none.
    facing = turned([0, 0, 1], np.radians(degrees)) @ turned([1, 0, 0], np.pi)
    true = Pose([0.02, 0.01, 0.4], facing.orientation)
    seen = true.transform_points(MARKER)
    rotation, position = solve_plane_poses(MARKER, seen[:, :2] / seen[:, 2:])[0]
    assert np.allclose(rotation, true.rotation, atol=1e-6)
    assert np.allclose(position, true.position, atol=1e-7)


def test_the_other_pose_is_tilted_the_other_way_about_the_line_of_sight():
    # A square 2 m away, 30 degrees from facing the camera: nearly without perspective, so that
    # the other solution is its mirror image, 30 degrees the other way.
    for true in random_views(5, 2.0, (30.0, 30.0), seed=3):
        pixels = PINHOLE.project_points(true.transform_points(MARKER))
        first, other = estimate_body_poses(PINHOLE, MARKER, pixels)
        assert rotation_angle(first.pose, true) < 1e-5
        assert np.degrees(rotation_angle(other.pose, true)) == pytest.approx(60.0, abs=3.0)
        sight = true.position / np.linalg.norm(true.position)
        tilts = [np.arccos(-(each.pose.rotation[:, 2] @ sight)) for each in (first, other)]
        assert np.degrees(tilts) == pytest.approx([30.0, 30.0], abs=2.0)
        assert first.error < 1e-6
        assert 0 < other.error < 1.0


def corners_of(body):
    """(n, 3) corners, and the number of the marker of each."""
    return body.corners.reshape(-1, 3), np.repeat(np.arange(len(body.ids)), 4)


def test_all_markers_are_solved_together():
    points, owners = corners_of(faceted_grip())
    random = np.random.default_rng(0)
    alone, together = [], []
    for true in random_views(20, 0.4, (5.0, 40.0), seed=1):
        pixels = WEBCAM.project_points(true.transform_points(points)) + random.normal(
            0, 0.1, (16, 2)
        )
        pose = estimate_body_poses(WEBCAM, points, pixels, owners)[0].pose
        together.append(np.linalg.norm(pose.position - true.position))
        one = estimate_body_poses(WEBCAM, points[:4], pixels[:4])[0].pose
        alone.append(np.linalg.norm(one.position - true.position))
    # Four times as many corners alone halve the error.
    assert np.median(together) < 0.5 * np.median(alone)


@pytest.mark.slow
def test_the_covariance_is_that_of_the_errors():
    # Mahalanobis lengths of errors have the mean of chi squared with 6 degrees: 6. The noise
    # is as assumed.
    points, owners = corners_of(faceted_grip())
    random = np.random.default_rng(5)
    lengths = []
    for true in random_views(400, 0.4, (5.0, 40.0), seed=6):
        pixels = WEBCAM.project_points(true.transform_points(points)) + random.normal(
            0, CORNER_DEVIATION, (16, 2)
        )
        found = estimate_body_poses(WEBCAM, points, pixels, owners)[0]
        turn = found.pose.rotation @ true.rotation.T
        error = np.empty(6)
        error[:3] = found.pose.position - true.position
        skew = 0.5 * (turn - turn.T)
        error[3:] = skew[2, 1], skew[0, 2], skew[1, 0]
        lengths.append(error @ np.linalg.solve(found.covariance, error))
    # Huber's weights lose a little, and the larger of what is assumed and found is taken.
    assert 4.0 < np.mean(lengths) < 7.0


@pytest.fixture
def two_poses():
    """A pose and its mirror image, 60 degrees apart, which fit equally well."""
    (true,) = random_views(1, 2.0, (30.0, 30.0), seed=3)
    found = estimate_body_poses(
        PINHOLE, MARKER, PINHOLE.project_points(true.transform_points(MARKER))
    )
    return [dataclasses.replace(each, misfit=1.0) for each in found]


def test_two_poses_that_fit_alike_widen_the_covariance_by_their_mixture(two_poses):
    pose = PlaneAmbiguity().choose_pose(two_poses, None)
    covariance = PlaneAmbiguity().record_choice(two_poses, pose, None)
    # Each is the right one with probability 1 / 2.
    apart = rotation_angle(two_poses[0].pose, two_poses[1].pose)
    wider = np.trace(covariance[3:, 3:]) - np.trace(pose.covariance[3:, 3:])
    assert wider == pytest.approx(0.5 * apart**2)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_images_that_speak_for_the_other_pose_win_in_the_end(two_poses):
    first, other = two_poses
    ambiguity = PlaneAmbiguity()
    ambiguity.record_choice(two_poses, first, None)
    better = dataclasses.replace(other, misfit=0.0)
    chosen = []
    for _ in range(3):
        # Half a unit of log likelihood an image: not enough at once after a sure start.
        ambiguity.record_choice([first, dataclasses.replace(other, misfit=9.0)], first, first.pose)
    for _ in range(30):
        before = chosen[-1].pose if chosen else first.pose
        chosen.append(ambiguity.choose_pose([better, first], before))
        ambiguity.record_choice([better, first], chosen[-1], before)
    assert chosen[0] is first
    assert chosen[-1] is better
    assert sum(one is not two for one, two in pairwise(chosen)) == 1
