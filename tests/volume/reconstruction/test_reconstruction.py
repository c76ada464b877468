"""Reconstructions of known fields, calibrations of sweeps, and volumes of Plus."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sweep_file import write_sweep

from us_sim.errors import VolumeError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.transform_file import write_transform
from us_sim.volume.files import stored_image
from us_sim.volume.files.readers import read_volume
from us_sim.volume.reconstruction.calibration_file import read_calibration
from us_sim.volume.reconstruction.grid import (
    Grid,
    fit_grid,
    make_image_mask,
)
from us_sim.volume.reconstruction.insertion import compute_means, fill_holes, insert_pixels
from us_sim.volume.reconstruction.reconstruction import plan_insertion, reconstruct
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sweep import read_sweep

PIXEL = 0.5e-3  # m
ROWS, COLUMNS, FRAMES = 40, 30, 25


def field(points):
    """A grey value everywhere, which changes by a level or two a millimetre."""
    x, y, z = np.moveaxis(1e3 * np.asarray(points), -1, 0)
    return 120.0 + 60.0 * np.sin(0.15 * x + 0.1 * z) * np.cos(0.12 * y) + 2.0 * z


def path(turn=(0.0, 0.0, 0.0), step=0.6e-3, wobble=0.0):
    """Image to reference of every frame: a probe that moves along its elevation and wobbles."""
    pixels = np.zeros((4, 4))  # m: columns along x, rows along z of the probe
    pixels[0, 0] = pixels[2, 1] = pixels[1, 2] = PIXEL
    pixels[3, 3] = 1.0
    start = Pose(orientation=[*np.sin(0.5 * np.array(turn)), 1.0]).matrix
    angles = 0.5 * wobble * np.sin(0.5 * np.arange(FRAMES))
    tilts = [Pose(orientation=[np.sin(a), 0.0, 0.0, np.cos(a)]).matrix for a in angles]
    moves = [Pose((-COLUMNS * PIXEL / 2, k * step, 0.0)).matrix for k in range(FRAMES)]
    return start @ np.array(moves) @ np.array(tilts) @ pixels


def images_at(matrices):
    columns, rows = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    pixels = np.stack([columns, rows, np.zeros((ROWS, COLUMNS))])
    points = np.einsum("kxy,yrc->krcx", matrices[:, :3, :3], pixels)
    points += matrices[:, None, None, :3, 3]
    return np.clip(np.round(field(points)), 0, 255).astype(np.uint8)


@pytest.fixture
def sweep(tmp_path):
    matrices = path(turn=(0.2, -0.3, 0.4), wobble=0.05)
    return read_sweep(write_sweep(tmp_path / "a.igs.mha", images_at(matrices), matrices))


def truth(made):
    indices = np.stack(np.meshgrid(*map(np.arange, made.volume.shape), indexing="ij"), axis=-1)
    matrix = made.volume.index_to_patient
    return field(indices @ matrix[:3, :3].T + matrix[:3, 3])


@pytest.mark.slow
def test_a_known_field_comes_back(sweep):
    made = reconstruct(plan_insertion(sweep, Compounding(spacing=0.5e-3)))
    error = np.abs(made.volume.intensities - truth(made))[made.covered]
    # Within a voxel the field changes by up to 9 levels a mm, over 0.43 mm at most.
    assert error.max() <= 9.0
    assert np.median(error) <= 1.5
    assert made.filled > 0  # frames are 0.6 mm apart


@given(st.lists(st.integers(0, 255), min_size=1, max_size=9))
def test_a_voxel_holds_the_mean_of_its_pixels(values):
    total, count = np.zeros((2, 2, 2, 2), np.uint32)
    pixels = np.array(values, np.uint8)
    insert_pixels(pixels, np.zeros((len(values), 3)), np.eye(3, 4), total, count)
    grey, covered = compute_means(total, count)
    assert covered.sum() == 1
    assert grey[0, 0, 0] == pytest.approx(np.mean(values), abs=0.5)


def test_holes_are_filled_between_what_was_hit_and_nowhere_else():
    grey = np.zeros((21, 21, 21), np.uint8)
    covered = np.zeros(grey.shape, bool)
    for i in (4, 8, 14):  # gaps of 3 and 5
        grey[i], covered[i] = 10 * i, True
    assert fill_holes(grey, covered, 2.0) == 3 * 21 * 21
    np.testing.assert_array_equal(grey[4:9, 10, 10], [40, 50, 60, 70, 80])
    assert not grey[:4].any()
    assert not grey[9:14].any()
    assert not grey[15:].any()
    assert covered.sum() == 6 * 21 * 21
    assert fill_holes(grey, covered, 3.0) == 5 * 21 * 21
    assert fill_holes(grey, covered, 0.0) == 0


def test_a_mask_is_a_rectangle_and_a_fan():
    fan = ImagePart(fan_origin=[50, 0], fan_radius=[20, 60], fan_angles=["-30 deg", "30 deg"])
    used = make_image_mask(fan, 101, 80)
    rows, columns = np.indices(used.shape)
    radius, angle = np.hypot(columns - 50, rows), np.degrees(np.arctan2(columns - 50, rows))
    assert not used[(radius < 19) | (radius > 60) | (abs(angle) > 30)].any()
    assert used[(radius > 21) & (radius < 58) & (abs(angle) < 27)].all()  # but for its border
    clipped = make_image_mask(dataclasses.replace(fan, clip=(0, 30, 50, 20)), 101, 80)
    assert clipped[30:51, :51].sum() == clipped.sum() == used[30:51, :51].sum()
    with pytest.raises(VolumeError, match=r"no pixel.*30 × 40"):
        make_image_mask(ImagePart(clip=(100, 0, 5, 5)), 30, 40)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fan_origin": (1, 2)}, "is missing"),
        ({"fan_origin": (1, 2), "fan_radius": (5, 2), "fan_angles": (-1, 1)}, "less than 2"),
    ],
)
def test_a_part_that_is_none_is_refused(values, message):
    with pytest.raises(VolumeError, match=message):
        ImagePart(**values)


def test_a_grid_that_is_too_large_is_refused_before_it_is_made(sweep, monkeypatch):
    with pytest.raises(VolumeError, match=r"536870912.*--spacing"):
        plan_insertion(sweep, Compounding(spacing=1e-5))
    planned = plan_insertion(sweep, Compounding())
    assert planned.grid.spacing == pytest.approx(PIXEL)
    monkeypatch.setattr(stored_image, "measure_free_memory", lambda: 1e5)
    with pytest.raises(VolumeError, match="GB"):
        reconstruct(planned)
    with pytest.raises(VolumeError, match="--spacing"):
        fit_grid(np.array([[0.0, 0, 0], [0.01, 0.01, 0.001]]), 0.005)


def test_what_calibrate_probe_writes_is_read(tmp_path):
    matrix = np.diag([1e-4, 2e-4, 1.5e-4, 1.0])
    matrix[:3, 3] = (0.01, 0.02, 0.03)
    file = tmp_path / "probe.yaml"
    more = {"image_to_body": matrix}
    write_transform(file, Pose(), from_frame="probe", to_frame="body", method="", more=more)
    found = read_calibration(file, "Transducer").transforms
    np.testing.assert_allclose(found["ImageToTransducer"], matrix)


PLUS_XML = (
    '<a><Transform From="I" To="P" Matrix="0.1 0 0 5 0 0.1 0 0 0 0 0.1 0 0 0 0 1"/>'
    "<VolumeReconstruction {}/></a>"
)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xml", f'<a><Transform From="I" To="P" Matrix="{"0 " * 16}"/></a>', "singular"),
        ("a.xml", PLUS_XML.format('FanAnglesDeg="4"'), "fan_angles"),
        ("a.yaml", "position: [0, 0, 0]", "image_to_body"),
        ("none.yaml", "", "No such file"),
    ],
)
def test_a_file_without_a_calibration_is_refused(tmp_path, name, text, message):
    if text:
        (tmp_path / name).write_text(text)
    with pytest.raises(VolumeError, match=message) as refused:
        read_calibration(tmp_path / name, "Probe")
    assert str(refused.value).startswith(f"{tmp_path / name}: ")


SPINE = "plus-spine-freehand"
LIVER = "imfusion-liver-sweep"
PLUS = {
    # name: configuration, correlation
    "NNMEAN": ("SpinePhantom_NN_MEAN", 0.9988),
    "LNMEAN": ("SonixRP_TRUS_D70mm_LN_MEAN", 0.98),
}


def compare(made, reference):
    """The correlation, and the fraction within two levels, of voxels that both have."""
    both = made.covered & (reference.intensities > 0)
    ours, theirs = (v.intensities[both].astype(float) for v in (made.volume, reference))
    return np.corrcoef(ours, theirs)[0, 1], (np.abs(ours - theirs) <= 2).mean()


@pytest.mark.parametrize("name", PLUS)
def test_volumes_of_plus_come_out_as_plus_made_them(shared_file, name):
    folder = shared_file(SPINE)
    configuration, least = PLUS[name]
    calibration = read_calibration(
        folder / f"Config_VolumeReconstruction_{configuration}.xml", "Probe"
    )
    path = folder / "SpinePhantomFreehand.igs.mha"
    sweep = read_sweep(path, calibration=calibration.transforms)
    how = Compounding(spacing=0.5e-3, hole_radius=0.0)
    made = reconstruct(plan_insertion(sweep, how, calibration.part))
    reference = read_volume(folder / f"VolumeReconstructorTest{name}volumeRef.mha")
    assert made.volume.shape == reference.shape
    # The file gives its place to six digits.
    np.testing.assert_allclose(made.volume.index_to_patient, reference.index_to_patient, atol=1e-6)
    # Plus rounds places to 1/16384 of a voxel, and its running mean down after every pixel.
    assert compare(made, reference)[0] >= least


@pytest.mark.slow
def test_the_liver_sweep_comes_out_as_others_compounded_it(shared_file):
    folder = shared_file(LIVER)
    reference = read_volume(folder / "liver_sweep_compounded_1mm.mha")
    sweep = read_sweep(folder / "liver_sweep.igs.mha")
    fan = ImagePart(
        fan_origin=(369.0, 22.01 - 161.34),
        fan_radius=(161.34, 724.35),
        fan_angles=("-30.28 deg", "30.28 deg"),
    )
    how = Compounding(spacing="1 mm")
    grid = Grid(reference.index_to_patient, reference.shape)
    made = reconstruct(dataclasses.replace(plan_insertion(sweep, how, fan), grid=grid))
    found = compare(made, reference)
    assert found[0] >= 0.998
    assert found[1] >= 0.98
    assert (made.covered & (reference.intensities > 0)).sum() > 2_200_000
