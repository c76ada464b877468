"""The proposal of vessels: found where a phantom has them, plausible in a real liver."""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.volume.files.readers import read_volume
from us_sim.volume.segmentation.dark_vessels import DarkVessels
from us_sim.volume.segmentation.region import Region
from us_sim.volume.segmentation.settings import read_seeds
from us_sim.volume.segmentation.structures import segment
from us_sim.volume.volume import Volume

SHAPE = (64, 64, 48)


@pytest.fixture(scope="module")
def fan():
    """Speckle with two tubes, a shadow that leaves it below, and no data beside it."""
    i, j, k = np.indices(SHAPE)
    data = abs(i - 32) < 14 + 0.35 * j
    grey = np.random.default_rng(5).rayleigh(60, SHAPE)
    grey = ndimage.gaussian_filter(grey, 0.7)
    tubes = np.hypot(i - 26, j - 20 - 0.2 * k) < 4
    tubes |= np.hypot(i - 42 + 0.1 * k, j - 34) < 3
    shadow = (abs(i - 20) < 6) & (j > 40)
    grey[tubes | shadow] *= 0.12
    return np.where(data, np.clip(grey, 1, 255), 0).astype(np.float32), tubes, shadow


def region(grey, size=1e-3):
    return Region(grey, np.full(3, size), (), (), "vessels")


@pytest.mark.parametrize("finer", [1, 2])
def test_tubes_are_found_and_a_shadow_is_not(fan, finer):
    grey, tubes, shadow = (np.kron(each, np.ones((finer,) * 3)) for each in fan)
    settings = DarkVessels(thickest=12e-3)
    found = settings.found_in(region(grey.astype(np.float32), 1e-3 / finer))
    inner = np.zeros(SHAPE, bool)
    inner[:, :, 6:-6] = True  # the proposal keeps off the border of the data
    inner = np.kron(inner, np.ones((finer,) * 3)).astype(bool)
    both = np.count_nonzero(found & (tubes > 0) & inner)
    assert 2 * both / (np.count_nonzero(found & inner) + np.count_nonzero(tubes[inner])) > 0.8
    assert np.count_nonzero(found & (shadow > 0)) < 0.02 * np.count_nonzero(shadow)


def test_nothing_is_proposed_where_there_is_nothing():
    assert not DarkVessels().found_in(region(np.zeros((12, 12, 12), np.float32))).any()
    speckle = np.random.default_rng(1).integers(80, 120, (30, 30, 30)).astype(np.float32)
    assert not DarkVessels().found_in(region(speckle)).any()


def test_settings_in_the_wrong_order_are_refused():
    with pytest.raises(VolumeError, match="less than thinnest"):
        DarkVessels(thinnest=5e-3, thickest=3e-3)
    with pytest.raises(VolumeError, match="more than contrast"):
        DarkVessels(edge_contrast=0.9)


def test_seeds_and_proposal_find_the_same_vessels_in_a_real_liver(shared_data):
    path = shared_data / "imfusion-liver-sweep" / "liver_sweep_compounded_1mm.mha"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    whole = read_volume(path)
    seeds = read_seeds(Path(__file__).resolve().parents[3] / "config/seeds/liver_sweep.yaml")
    by_seeds = segment(whole, seeds)
    # The part around the vessels, and every second voxel, as the whole takes half a minute.
    box = (slice(70, 190, 2), slice(30, 150, 2), slice(40, 128, 2))
    coarse = whole.index_to_patient @ np.diag([2.0, 2.0, 2.0, 1.0])
    part = Volume(whole.intensities[box], coarse, by_seeds.labels[box])
    vessels = DarkVessels().found_in(region(part.intensities.astype(np.float32), 2e-3))
    for label, name in by_seeds.names.items():
        seeded = part.labels == label
        assert 2e3 < by_seeds.voxels[name] < 2e4  # mm³
        grey = whole.intensities[by_seeds.labels == label].mean()
        rim = ndimage.binary_dilation(by_seeds.labels == label, iterations=4)
        around = whole.intensities[rim & (by_seeds.labels == 0)].mean()
        assert grey < 0.6 * around, name
        assert np.count_nonzero(vessels & seeded) > 0.4 * np.count_nonzero(seeded), name
