"""Areas of labels in images."""

import numpy as np
import pytest

from us_sim.errors import VolumeError
from us_sim.volume.measure import label_area


def test_a_disc_has_the_area_of_a_circle():
    step = 0.05e-3
    v, u = np.mgrid[-200:201, -200:201] * step
    image = np.where(u**2 + v**2 < (4e-3) ** 2, 6, 3).astype(np.uint8)
    assert label_area(image, 6, step**2) == pytest.approx(np.pi * (4e-3) ** 2, rel=2e-3)


def test_an_absent_label_has_no_area():
    assert label_area(np.zeros((5, 5), np.uint8), 6, 1.0) == 0.0
    assert label_area(np.zeros((5, 5), np.uint8), 6, 1.0, largest_part=True) == 0.0


def test_the_largest_part_leaves_the_others_out():
    image = np.zeros((20, 20), np.uint8)
    image[2:6, 2:6] = 6
    image[10:12, 10:13] = 6
    image[6, 6] = 6  # touches the first at a corner only
    assert label_area(image, 6, 0.5) == 23 * 0.5
    assert label_area(image, 6, 0.5, largest_part=True) == 16 * 0.5


@pytest.mark.parametrize("pixel_area", [0.0, -1.0, np.nan, np.inf])
def test_a_pixel_without_area_is_refused(pixel_area):
    with pytest.raises(VolumeError, match="above zero"):
        label_area(np.zeros((5, 5), np.uint8), 6, pixel_area)


def test_a_volume_is_no_image():
    with pytest.raises(VolumeError, match="two-dimensional"):
        label_area(np.zeros((5, 5, 5), np.uint8), 6, 1.0)
