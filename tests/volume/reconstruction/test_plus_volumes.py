"""The volumes that Plus reconstructed of its own test sweep, and a published sweep's."""

import dataclasses

import numpy as np
import pytest

from us_sim.volume.files.readers import read_volume
from us_sim.volume.reconstruction.calibration_file import read_calibration
from us_sim.volume.reconstruction.grid import Grid
from us_sim.volume.reconstruction.reconstruction import plan, reconstruct
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sequence import read_sequence
from us_sim.volume.sequences.sweep import read_sweep, sweep_of

SPINE = "plus-spine-freehand"
LIVER = "imfusion-liver-sweep"
PLUS = {
    "NNMEAN": ("SpinePhantom_NN_MEAN", "nearest", "plus_mean"),
    "LNMAXI": ("SpinePhantom_LN_MAXI", "linear", "max"),
    "NNLATE": ("SonixRP_TRUS_D70mm_NN_LATE", "nearest", "latest"),
    "LNMEAN": ("SonixRP_TRUS_D70mm_LN_MEAN", "linear", "plus_mean"),
}


def of_plus(folder, name, **settings):
    """The reconstruction with the settings of a configuration, and what Plus made with it."""
    configuration, method, compounding = PLUS[name]
    calibration = read_calibration(
        folder / f"Config_VolumeReconstruction_{configuration}.xml", "Probe"
    )
    sequence = read_sequence(folder / "SpinePhantomFreehand.igs.mha")
    sweep = sweep_of(sequence, calibration=calibration.transforms)
    how = {"spacing": 0.5e-3, "method": method, "compounding": compounding, "hole_radius": 0.0}
    made = reconstruct(plan(sweep, Compounding(**{**how, **settings}), calibration.part))
    return made, read_volume(folder / f"VolumeReconstructorTest{name}volumeRef.mha")


def within(made, reference, levels):
    difference = made.volume.intensities.astype(int) - reference.intensities
    return (np.abs(difference)[made.covered] <= levels).mean()


@pytest.mark.parametrize("name", PLUS)
def test_volumes_of_plus_come_out_as_plus_made_them(shared_data, name):
    folder = shared_data / SPINE
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    made, reference = of_plus(folder, name, plus_rounding=True)
    assert made.volume.shape == reference.shape
    # The file gives its place to six digits.
    np.testing.assert_allclose(made.volume.index_to_patient, reference.index_to_patient, atol=1e-6)
    assert within(made, reference, 2) >= 0.999
    if name.startswith("NN"):
        assert within(made, reference, 0) == 1.0


def test_the_mean_is_two_levels_brighter_than_the_one_that_plus_rounds_down(shared_data):
    folder = shared_data / SPINE
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    made, reference = of_plus(folder, "NNMEAN", compounding="mean")
    difference = made.volume.intensities.astype(int) - reference.intensities
    assert difference[made.covered].mean() == pytest.approx(2.4, abs=0.3)  # as its source says


def test_the_liver_sweep_comes_out_as_others_compounded_it(shared_data):
    folder = shared_data / LIVER
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    reference = read_volume(folder / "liver_sweep_compounded_1mm.mha")
    sweep = read_sweep(folder / "liver_sweep.igs.mha")
    fan = ImagePart(
        fan_origin=(369.0, 22.01 - 161.34),
        fan_radius=(161.34, 724.35),
        fan_angles=("-30.28 deg", "30.28 deg"),
    )
    planned = plan(sweep, Compounding(spacing="1 mm", method="nearest"), fan)
    grid = Grid(reference.index_to_patient, reference.shape)
    made = reconstruct(dataclasses.replace(planned, grid=grid))
    both = made.covered & (reference.intensities > 0)
    assert both.sum() > 2_200_000
    difference = made.volume.intensities.astype(int) - reference.intensities
    assert (np.abs(difference)[both] <= 2).mean() >= 0.98
