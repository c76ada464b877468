"""Lens models against OpenCV's, their derivatives and inverses, and camera info files."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import TrackingError
from us_sim.tracking.camera.model import CameraModel, read_camera_info, write_camera_info

MATRIX = np.array([[600.0, 0, 320], [0, 610, 240], [0, 0, 1]])
LENSES = {
    "plumb_bob": [-0.3, 0.1, 0.01, -0.02, 0.05],
    "rational_polynomial": [0.1, 0.02, 0.001, 0.002, 0.01, 0.05, 0.02, 0.01],
    "tilted": [0.1, 0.02, 0.001, 0.002, 0.01, 0.05, 0.02, 0.01, 1e-3, 2e-3, 1e-3, 5e-4, 0.02, 0.01],
    "equidistant": [0.1, 0.02, 0.01, 0.001],
}
NAMES = {"tilted": "rational_polynomial"}


def camera(model, lens=None):
    return CameraModel(
        640, 480, MATRIX, LENSES[model] if lens is None else lens, NAMES.get(model, model)
    )


def opencv_pixels(model, points):
    still = np.zeros(3)
    if model == "equidistant":
        lens = np.array(LENSES[model])
        return cv2.fisheye.projectPoints(points[:, None], still, still, MATRIX, lens)[0][:, 0]
    return cv2.projectPoints(points, still, still, MATRIX, np.array(LENSES[model]))[0][:, 0]


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.3], (50, 3))


@pytest.mark.parametrize("model", LENSES)
def test_points_are_where_opencv_sees_them(model, points):
    assert np.allclose(
        camera(model).project_points(points), opencv_pixels(model, points), atol=1e-9
    )


@pytest.mark.parametrize("model", LENSES)
def test_the_derivatives_are_those_of_the_pixels(model, points):
    shift = np.array([0.1, -0.05, 0.2])
    slopes = camera(model).linearise_projection(points, shift)[1]
    for axis, step in enumerate(1e-6 * np.eye(3)):
        sides = [camera(model).project_points(points + shift + sign * step) for sign in (1, -1)]
        assert np.allclose(slopes[:, axis], (sides[0] - sides[1]).ravel() / 2e-6, atol=1e-5)
        turns = [cv2.Rodrigues(sign * step)[0] for sign in (1, -1)]
        sides = [camera(model).project_points(points @ turn.T + shift) for turn in turns]
        assert np.allclose(slopes[:, 3 + axis], (sides[0] - sides[1]).ravel() / 2e-6, atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(sorted(LENSES)), st.floats(-0.5, 0.5), st.floats(-0.4, 0.4), st.floats(0.1, 9)
)
def test_the_ray_of_a_pixel_leads_back_to_the_point(model, x, y, depth):
    pixel = camera(model).project_points(np.array([[x * depth, y * depth, depth]]))
    assert np.allclose(camera(model).compute_rays(pixel), [[x, y]], atol=1e-9)


def test_what_is_behind_the_camera_or_beyond_its_lens_is_nowhere():
    assert np.isnan(camera("plumb_bob").project_points(np.array([[0.0, 0.0, -1.0]]))).all()
    # With k1 = -0.3 alone radii grow up to 1 / sqrt(0.9), where they are 0.703.
    folded = camera("plumb_bob", [-0.3, 0, 0, 0])
    assert np.isfinite(folded.compute_rays(np.array([[320 + 600 * 0.70, 240.0]]))).all()
    assert np.isnan(folded.compute_rays(np.array([[320 + 600 * 0.71, 240.0]]))).all()


@pytest.mark.parametrize("model", LENSES)
def test_a_file_gives_back_the_camera(model, tmp_path):
    write_camera_info(tmp_path / "camera.yaml", camera(model))
    again = read_camera_info(tmp_path / "camera.yaml")
    assert (again.width, again.height, again.distortion_model) == (
        640,
        480,
        NAMES.get(model, model),
    )
    assert np.array_equal(again.matrix, MATRIX)
    assert np.array_equal(again.distortion, LENSES[model])
    with pytest.raises(TrackingError, match=r"camera.yaml: exists already"):
        write_camera_info(tmp_path / "camera.yaml", camera(model))


def test_the_file_of_ros_camera_calibration_is_read(tmp_path):
    path = tmp_path / "head_camera.yaml"
    path.write_text(
        """image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [452.5, 0.0, 317.7, 0.0, 456.8, 277.8, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.121, -1.085, 0.0001, -0.0005, 2.954]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [452.5, 0, 317.7, 0, 0, 456.8, 277.8, 0, 0, 0, 1, 0]
"""
    )
    read = read_camera_info(path)
    assert read.matrix[1].tolist() == [0.0, 456.8, 277.8]
    assert read.distortion.tolist() == [0.121, -1.085, 0.0001, -0.0005, 2.954]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ((640, 480, np.zeros(9), np.zeros(5)), "focal length"),
        ((640, 480, MATRIX.T, np.zeros(5)), "fx"),
        ((640, 480, MATRIX + np.eye(3, k=1), np.zeros(5)), "fx"),  # skewed
        ((640, 480, MATRIX, np.zeros(3)), "3 coefficients"),
        ((640, 480, MATRIX, np.zeros(5), "equidistant"), "5 coefficients"),
        ((640, 480, MATRIX, np.zeros(4), "omnidirectional"), "omnidirectional"),
        ((640, 480, MATRIX, [np.nan, 0, 0, 0]), "finite"),
        ((640, 480, MATRIX, [1e30, 0, 0, 0]), "large"),
    ],
)
def test_what_is_no_camera_is_refused(arguments, word):
    with pytest.raises(TrackingError, match=word):
        CameraModel(*arguments)


REST = "image_width: 640\ncamera_matrix: 0\ndistortion_coefficients: 0\n"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("- 1", "mapping"),
        ("a: [", "YAML"),
        ("image_width: 640", "image_height"),
        (f"image_height: 48.5\n{REST}", "height"),
        (f"image_height: 48\n{REST}", "camera_matrix"),
        (None, "No such file"),
    ],
)
def test_a_bad_file_is_refused(text, word, tmp_path):
    path = tmp_path / "camera.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(TrackingError, match=f"camera.yaml: .*{word}"):
        read_camera_info(path)
