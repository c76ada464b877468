"""Text in real images is found where a person sees it, and none is seen where there is none."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.volume.deidentification.text_detection import find_text
from us_sim.volume.files.dicom.header import open_dicom
from us_sim.volume.files.dicom.pixels import GreyImages
from us_sim.volume.files.readers import read_volume
from us_sim.volume.sequences.sweep import read_sweep

SEEN = {
    "US1_UNCR": {"hospital": (15, 20, 160, 55), "lymph node": (248, 358, 362, 375)},
    "OBXXXX1A_rle_2frame": {"maker": (325, 25, 505, 45), "date": (665, 5, 770, 25)},
    "gdcm-US-ALOKA-16": {"hospital": (80, 0, 255, 12), "pelvis": (35, 455, 98, 470)},
}
"""Boxes in pixels that were drawn around words by eye."""


@pytest.mark.parametrize("name", SEEN)
def test_words_in_real_images_are_found(shared_data, name):
    path = shared_data / "dicom-us-2d" / f"{name}.dcm"
    if not path.exists():
        pytest.skip(f"no {path}")
    image = next(GreyImages([open_dicom(path)]).images())
    covered = np.zeros(image.shape, bool)
    for line in find_text([image]):
        covered[line.slices] = True
    for word, (left, top, right, bottom) in SEEN[name].items():
        assert covered[top:bottom, left:right].mean() > 0.25, word


def test_a_sweep_without_text_has_none(shared_data):
    folder = shared_data / "imfusion-liver-sweep"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    frames = list(read_sweep(folder / "liver_sweep.igs.mha").images(range(0, 140, 35)))
    assert find_text(frames) == []
    assert [find_text([frame]) for frame in frames[:2]] == [[], []]
    voxels = read_volume(folder / "liver_sweep_compounded_1mm.mha").intensities
    assert find_text([voxels[:, :, k].T for k in (40, 77, 110)]) == []


@given(
    text=st.text("ABCDEFGHJKLMNPRSTUVWXYZ0123456789", min_size=5, max_size=9),
    size=st.floats(0.4, 1.2),
    seed=st.integers(0, 1000),
)
@settings(max_examples=12, deadline=None)
def test_any_word_on_black_is_found_beside_moving_speckle(text, size, seed):
    rng = np.random.default_rng(seed)
    frames = rng.rayleigh(40, (4, 160, 320)).clip(0, 255).astype(np.uint8)
    frames[:, :60] = 0
    for frame in frames:
        cv2.putText(frame, text, (12, 40), cv2.FONT_HERSHEY_SIMPLEX, size, 220, 1, cv2.LINE_AA)
    ink = frames[0, :60] > 150
    covered = np.zeros(frames[0].shape, bool)
    for line in find_text(list(frames)):
        covered[line.slices] = True
    assert (covered[:60] & ink).sum() > 0.6 * ink.sum()
    assert covered[64:].mean() < 0.02
