"""The ends of the colour bar of strain, which follow the images."""

import numpy as np
import pytest

from us_sim.slicing.strain import FollowingEnd, strain_scale


@pytest.mark.parametrize("mean", [-0.002, -0.03, -0.14, -0.45])
def test_a_press_of_any_strength_has_colours_that_tell_its_parts_apart(mean):
    """Strain that differs by a third of the mean, as in layers of unlike stiffness."""
    values = mean * np.linspace(2 / 3, 4 / 3, 100 * 80).reshape(100, 80)
    end = FollowingEnd().of(values)
    assert end > np.percentile(np.abs(values), 94)
    levels = strain_scale("strain", end).levels(values)
    assert (levels == 0).mean() <= 0.06
    assert np.ptp(levels.astype(float)) > (20 if mean < -0.01 else 5)


def test_a_vein_that_collapses_does_not_take_the_colours_from_all_else():
    values = np.full((200, 200), -0.14)
    values[80:88, 50:150] = -0.9
    assert FollowingEnd().of(values) == 0.2


def test_the_bar_stays_while_tissue_breathes_and_follows_a_release():
    end = FollowingEnd()
    breath = [end.of(np.full((40, 40), -0.14 - 0.05 * np.sin(t))) for t in np.linspace(0, 20, 60)]
    assert set(breath) == {0.2}
    assert end.of(np.full((40, 40), -0.001)) == 0.01


def test_an_image_without_strain_has_a_bar_too():
    assert FollowingEnd().of(np.full((40, 40), np.nan)) == 0.01
