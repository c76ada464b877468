"""Structures from seeds in volumes whose answer is known."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.settings.reading import SettingsReader
from us_sim.volume.files.readers import read_volume
from us_sim.volume.segmentation.settings import SegmentationSettings, read_seeds
from us_sim.volume.segmentation.structures import segment_volume
from us_sim.volume.volume import Volume

STEPS = np.array([0.5e-3, 0.5e-3, 1e-3])
SHAPE = (60, 60, 30)
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, -1]])  # about z, and mirrored


def grid():
    affine = np.eye(4)
    affine[:3, :3] = TURN * STEPS
    affine[:3, 3] = (0.05, -0.03, 0.2)
    return affine


def point(*index):
    """Where a voxel is, mm."""
    return (1e3 * (grid() @ [*index, 1.0])[:3]).tolist()


@pytest.fixture(scope="module")
def two_tubes():
    """A dark tube along k that touches a second one, in bright speckle with an edge of no data."""
    speckle = np.random.default_rng(2).normal(100, 12, SHAPE)
    i, j, _ = np.indices(SHAPE)
    tube = np.hypot(i - 20, j - 30) < 8
    other = np.hypot(i - 42, j - 30) < 8
    bridge = (abs(j - 30) < 2) & (i > 20) & (i < 42)
    grey = np.where(tube | other | bridge, np.random.default_rng(3).normal(15, 4, SHAPE), speckle)
    grey[:, :4] = 0
    return Volume(np.clip(grey, 0, 255).astype(np.uint8), grid()), tube, other


def read(document):
    return SettingsReader("seeds.yaml", None, VolumeError).read(SegmentationSettings, document)


def found(volume, **structures):
    return segment_volume(volume, read({"structures": structures}))


def overlap(one, other):
    """Dice's coefficient."""
    return 2 * np.count_nonzero(one & other) / (np.count_nonzero(one) + np.count_nonzero(other))


def test_growing_takes_what_hangs_together_and_opening_parts_it(two_tubes):
    volume, tube, other = two_tubes
    dark = {"upper": 50, "seeds_mm": [point(20, 30, 15)]}
    leaked = found(volume, vein=dark).labels == 1
    reference, _ = ndimage.label(volume.intensities <= 50, np.ones((3, 3, 3)))
    assert leaked[42, 30, 15]
    assert overlap(leaked, reference == reference[20, 30, 15]) > 0.99
    alone = found(volume, vein=dark | {"open": "1.5 mm"}).labels == 1
    assert not alone[42, 30, 15]
    assert overlap(alone, tube) > 0.95
    assert overlap(alone, other) == 0.0


def test_of_structures_that_overlap_the_first_stays_and_a_reach_ends_one(two_tubes):
    volume, tube, other = two_tubes
    all_dark = {"upper": 50, "seeds_mm": [point(42, 30, 15)]}
    left = DARK | {"seeds_mm": [point(20, 30, 15)], "open": "1.5 mm"}
    made = found(volume, vein=left, fluid=all_dark)
    assert made.names == {1: "vein", 2: "fluid"}
    assert overlap(made.labels == 1, tube) > 0.95
    assert (made.labels[other] == 2).mean() > 0.98
    assert any("of fluid are in vein" in remark for remark in made.remarks)
    with pytest.raises(VolumeError, match="vein: all of it"):
        found(volume, fluid=all_dark, vein=left)
    near = found(volume, vein=left | {"reach": "6 mm"}).labels == 1
    away = (np.argwhere(near) - (20, 30, 15)) * STEPS
    assert 0.005 < np.linalg.norm(away, axis=1).max() <= 0.006


@given(
    seed=st.tuples(st.integers(0, 59), st.integers(4, 59), st.integers(0, 29)),
    reach=st.floats(2e-3, 8e-3),
)
@settings(max_examples=10, deadline=None)
def test_a_seed_is_in_its_structure_whatever_is_looked_at(two_tubes, seed, reach):
    volume, *_ = two_tubes
    value = int(volume.intensities[seed])
    keys = {"lower": value, "upper": min(value + 100, 255)}
    made = found(volume, part=keys | {"seeds_mm": [point(*seed)], "reach": reach})
    assert made.labels[seed] == 1


DARK = {"upper": 50}


@pytest.mark.parametrize(
    ("vein", "word"),
    [
        (DARK | {"seeds_mm": []}, "empty"),
        (DARK | {"seeds_mm": [[0, 0, 0]]}, r"vein: seeds_mm\[0\].*outside the volume.*spans"),
        (DARK | {"seeds_mm": [point(5, 30, 15)]}, "seed 1 .*outside 0 to 50"),
        (DARK | {"seeds_mm": [point(20, 30, 15)], "upper": 5, "lower": 9}, "swap them"),
    ],
)
def test_what_cannot_be_found_is_one_sentence(two_tubes, vein, word):
    with pytest.raises(VolumeError, match=word):
        found(two_tubes[0], vein=vein)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("structures: {'Doe/12.3.1961': {upper: 3, seeds_mm: [[0, 0, 0]]}}", "no path"),
        ("structures: {vein: {smooth: 3, seeds_mm: [[0, 0, 0]]}}", "did you mean '3 mm'"),
    ],
)
def test_a_file_of_seeds_that_will_not_do_is_refused(tmp_path, text, sentence):
    path = tmp_path / "seeds.yaml"
    path.write_text(text)
    with pytest.raises(VolumeError, match=sentence) as refused:
        read_seeds(path)
    assert str(path) in str(refused.value)


SEEDS = Path(__file__).resolve().parents[3] / "config" / "seeds"


def test_seeds_find_dark_vessels_in_a_real_liver(shared_file):
    whole = read_volume(shared_file("imfusion-liver-sweep/liver_sweep_compounded_1mm.mha"))
    by_seeds = segment_volume(whole, read_seeds(SEEDS / "liver_sweep.yaml"))
    for label, name in by_seeds.names.items():
        assert 2e3 < by_seeds.voxels[name] < 2e4  # mm³
        grey = whole.intensities[by_seeds.labels == label].mean()
        rim = ndimage.binary_dilation(by_seeds.labels == label, iterations=4)
        around = whole.intensities[rim & (by_seeds.labels == 0)].mean()
        assert grey < 0.6 * around, name
