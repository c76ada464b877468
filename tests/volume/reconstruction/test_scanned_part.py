"""The probe is found in its images: fans and rectangles that are known, and two real sweeps."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_file import write_sweep

from us_sim.volume.reconstruction.calibration_file import read_calibration
from us_sim.volume.reconstruction.grid import make_image_mask
from us_sim.volume.reconstruction.scanning_probe import (
    Fan,
    Rectangle,
    find_scanning_probe,
    fit_part,
)
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.sweep import read_sweep

ROWS, COLUMNS = 300, 400
SIDE = np.array([0.5e-3, 0.5e-3])


def fan_mask(x, z, begins, ends, first, last, side=SIDE):
    """Pixels whose centres a fan holds; lengths in metres, angles in degrees."""
    row, column = np.indices((ROWS, COLUMNS))
    across, down = column * side[0] - x, row * side[1] - z
    radius, angle = np.hypot(across, down), np.degrees(np.arctan2(across, down))
    return (radius > begins) & (radius < ends) & (angle > first) & (angle < last)


@settings(max_examples=12, deadline=None)
@given(
    begins=st.floats(0.008, 0.07),
    half=st.floats(18.0, 40.0),
    tilt=st.floats(-4.0, 4.0),
    unlike=st.floats(0.8, 1.2),
    noise=st.integers(0, 99),
)
def test_fans_are_found_to_a_pixel(begins, half, tilt, unlike, noise):
    side = SIDE * [1.0, unlike]
    top = 0.012 - begins * math.cos(math.radians(half - abs(tilt)))
    mask = fan_mask(0.1, top, begins, 0.14 * unlike - top, tilt - half, tilt + half, side)
    rng = np.random.default_rng(noise)
    mask &= rng.random(mask.shape) > 0.02  # black specks
    mask[5:12, 5:40] = True  # letters beside it
    found = fit_part(mask, side)
    assert isinstance(found, Fan)
    np.testing.assert_allclose(found.apex, [0.1, top], atol=1.5e-3)
    np.testing.assert_allclose(found.radius, [begins, 0.14 * unlike - top], atol=1.5e-3)
    np.testing.assert_allclose(np.degrees(found.angles), [tilt - half, tilt + half], atol=0.8)


BOX = np.zeros((ROWS, COLUMNS), bool)
BOX[10:250, 100:200] = True


def test_a_rectangle_is_a_linear_arrays_and_a_shadow_in_it_does_no_harm():
    mask = BOX.copy()
    mask[150:200, 130:160] = False
    found = fit_part(mask, SIDE)
    assert isinstance(found, Rectangle)
    np.testing.assert_allclose(found.x, [0.04975, 0.09975], atol=1e-9)
    np.testing.assert_allclose(found.z, [0.00475, 0.12475], atol=1e-9)


def swept(tmp_path, mask, matrices=None):
    """A sweep of images with a mask; without others along +y, columns along -x, rows along z."""
    if matrices is None:
        matrices = np.zeros((9, 4, 4))
        matrices[:, 0, 0] = -SIDE[0]
        matrices[:, 2, 1] = matrices[:, 1, 2] = SIDE[1]
        matrices[:, 1, 3] = 2e-3 * np.arange(9)
        matrices[:, 3, 3] = 1.0
    images = np.broadcast_to((mask * 90).astype(np.uint8), (len(matrices), ROWS, COLUMNS))
    return read_sweep(write_sweep(tmp_path / "s.igs.mha", images, matrices))


def test_the_poses_are_of_the_middle_of_the_face(tmp_path):
    mask = fan_mask(0.1, -0.03, 0.04, 0.11, -20, 30)
    found = find_scanning_probe(swept(tmp_path, mask), ImagePart(), np.ones_like(mask))
    array = found.probe.array.given
    assert found.probe.geometry == "convex"
    assert array.radius == pytest.approx(0.04, abs=5e-4)
    assert array.depth == pytest.approx(0.07, abs=5e-4)
    assert len(found.poses) == 9
    middle = np.radians(5.0)
    pose = found.poses[4].pose
    face = [-(0.1 + 0.04 * np.sin(middle)), 0.008, -0.03 + 0.04 * np.cos(middle)]
    np.testing.assert_allclose(pose.position, face, atol=1e-3)
    ahead = [-np.sin(middle), 0.0, np.cos(middle)]
    assert np.degrees(np.arccos(pose.rotation[:, 2] @ ahead)) < 0.5
    assert pose.rotation[0, 0] < -0.99  # along the columns


def test_a_part_that_is_named_is_the_probes(tmp_path):
    mask = np.random.default_rng(0).random((ROWS, COLUMNS)) < 0.3  # proves nothing
    sweep = swept(tmp_path, mask)
    part = ImagePart(clip=(100, 40, 79, 119))
    found = find_scanning_probe(sweep, part, make_image_mask(part, COLUMNS, ROWS))
    assert found.probe.geometry == "linear"
    assert found.probe.array.given.aperture == pytest.approx(80 * SIDE[0])
    assert found.probe.array.given.depth == pytest.approx(120 * SIDE[1])
    np.testing.assert_allclose(found.poses[0].position, [-139.5 * SIDE[0], 0, 39.5 * SIDE[1]])
    angles = ["-30 deg", "30 deg"]
    part = ImagePart(fan_origin=[200, -60], fan_radius=[80, 220], fan_angles=angles)
    found = find_scanning_probe(sweep, part, make_image_mask(part, COLUMNS, ROWS))
    array = found.probe.array.given
    assert (array.radius, array.depth) == (0.04, 0.07)
    assert math.degrees(array.opening_angle) == pytest.approx(60.0, abs=1e-3)
    np.testing.assert_allclose(found.poses[0].position, [-0.1, 0.0, 0.01], atol=1e-5)


@pytest.mark.parametrize(
    ("folder", "configuration", "recording", "begin", "size", "within"),
    [
        (
            "plus-nwire-calibration",
            "PlusDeviceSet_NwirePhantomFreehand_vtkVolumeReconstructorTest2.xml",
            "NwirePhantomFreehand.igs.mha",
            (167, 62),
            (495, 488),  # as the configuration says
            2,
        ),
    ],
)
def test_the_linear_array_of_a_real_sweep_is_found(
    shared_file, folder, configuration, recording, begin, size, within
):
    calibration = read_calibration(shared_file(folder) / configuration, "Probe")
    path = shared_file(folder) / recording
    sweep = read_sweep(path, calibration=calibration.transforms)
    used = make_image_mask(calibration.part, sweep.columns, sweep.rows)
    found = find_scanning_probe(sweep, calibration.part, used)
    assert found.probe.geometry == "linear"
    column, row = np.linalg.norm(sweep.image_to_reference[0][:3, :2], axis=0)
    array = found.probe.array.given
    assert array.aperture == pytest.approx(size[0] * column, abs=within * column)
    assert array.depth == pytest.approx(size[1] * row, abs=within * row)
    faces = (sweep.image_to_reference @ [begin[0] + size[0] / 2, begin[1], 0, 1])[:, :3]
    for pose in found.poses:
        off = np.linalg.norm(faces - pose.position, axis=1)
        assert off.min() < 1.3 * within * column
        down = sweep.image_to_reference[off.argmin()][:3, 1] / row
        assert pose.pose.rotation[:, 2] @ down > np.cos(np.radians(0.1))


def test_the_curved_array_of_a_real_sweep_is_found_in_its_images(shared_data):
    sweep = read_sweep(shared_data / "imfusion-liver-sweep" / "liver_sweep.igs.mha")
    used = np.ones((sweep.rows, sweep.columns), bool)
    found = find_scanning_probe(sweep, ImagePart(), used)
    array = found.probe.array.given
    # Its publisher's: 161.34 pixels, 30.28° to either side; beams end at 724.35 pixels by it,
    # but the images go on to their last row, 592, which is 731 pixels from the apex.
    pixel = 0.314818e-3
    assert array.radius / pixel == pytest.approx(161.34, abs=1.5)
    assert math.degrees(array.opening_angle) == pytest.approx(60.56, abs=0.3)
    assert (array.radius + array.depth) / pixel == pytest.approx(731.0, abs=4.0)
    # config/scenes/liver_sweep.yaml
    middle = sweep.image_to_reference[len(sweep.numbers) // 2] @ [369, 22.01, 0, 1]
    places = np.array([pose.position for pose in found.poses])
    assert np.linalg.norm(places - middle[:3], axis=1).min() < 2e-3
