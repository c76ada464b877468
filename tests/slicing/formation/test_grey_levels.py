"""Gain, time gain, dynamic range and grey map, in numbers that decibels give."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.slicing.formation.grey_levels import GreyLevels
from us_sim.slicing.formation.imaging import GREY_MAPS, Imaging
from us_sim.slicing.probe.fan_probe import ConvexProbe
from us_sim.slicing.probe.probe import LinearProbe

PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=256, rows=4)
RAMP = np.tile(np.arange(256, dtype=np.uint8), (4, 1))


def shown(**settings):
    return GreyLevels(PROBE, Imaging(**settings)).shown(RAMP).astype(int)


def test_six_decibels_are_a_tenth_of_sixty():
    np.testing.assert_array_equal(shown(gain=6.0)[0, 17:230], np.arange(17, 230) + 26)  # 25.5
    np.testing.assert_array_equal(shown(gain=-12.0)[0, 51:], np.arange(51, 256) - 51)
    assert (shown(gain=6.0)[:, 230:] == 255).all()
    assert (shown(gain=-12.0)[:, :51] == 0).all()


def test_half_the_range_doubles_the_steps_below_the_strongest():
    np.testing.assert_array_equal(shown(dynamic_range=30.0)[0, 128:], 2 * np.arange(128, 256) - 255)
    assert (shown(dynamic_range=30.0)[0, :127] == 0).all()


def test_twice_the_range_lifts_the_faintest_echo_half_way():
    wide = shown(dynamic_range=120.0)[0]
    assert wide[255] == 255
    assert wide[17] == 136  # 127.5 + 17 / 2
    assert wide[0] == 0


def test_the_faintest_echoes_fade_where_gain_lifts_them():
    # 10 dB would show the faintest of all at 42.5; its fade is linear over 17 grey values.
    faint = np.arange(18)
    expected = np.floor(faint + 42.5 - 42.5 * (1 - faint / 17) + 0.5)
    np.testing.assert_array_equal(shown(gain=10.0)[0, :18], expected)


def test_grey_maps_at_half_level():
    level = 127 / 255
    assert shown(grey_map="soft")[0, 127] == round(255 * level**0.7)
    assert shown(grey_map="contrast")[0, 127] == round(255 * level**2 * (3 - 2 * level))
    # The two maps part the other way: soft lifts faint echoes, contrast darkens them.
    assert shown(grey_map="soft")[0, 40] > 40 > shown(grey_map="contrast")[0, 40]
    assert shown(grey_map="contrast")[0, 215] > 215


@settings(max_examples=30, deadline=None)
@given(
    gain=st.floats(-60, 60),
    time_gain=st.lists(st.floats(-60, 60), max_size=5),
    dynamic_range=st.floats(10, 120),
    grey_map=st.sampled_from(GREY_MAPS),
)
def test_no_echo_stays_black_and_stronger_echoes_are_never_darker(
    gain, time_gain, dynamic_range, grey_map
):
    picture = shown(gain=gain, time_gain=time_gain, dynamic_range=dynamic_range, grey_map=grey_map)
    assert (picture[:, 0] == 0).all()
    assert (np.diff(picture, axis=1) >= 0).all()


def test_time_gain_is_linear_between_evenly_spaced_depths():
    probe = LinearProbe(aperture=0.04, depth=0.04, columns=2, rows=400)
    image = np.full((400, 2), 60, dtype=np.uint8)
    picture = GreyLevels(probe, Imaging(time_gain=(0.0, 10.0, 40.0))).shown(image)
    depth = (np.arange(400) + 0.5) * 1e-4  # m; knots at 0, 20 and 40 mm
    decibels = np.where(depth < 0.02, 500 * depth, 10 + 1500 * (depth - 0.02))
    np.testing.assert_allclose(
        picture[:, 0], 60 + 4.25 * decibels, atol=0.76
    )  # a step and rounding
    assert picture[199, 0] == pytest.approx(60 + 42.5, abs=0.76)


def test_time_gain_of_one_number_is_gain():
    np.testing.assert_array_equal(shown(time_gain=[6.0]), shown(gain=6.0))


def test_time_gain_follows_the_beams_of_a_fan():
    probe = ConvexProbe(radius=0.05, opening_angle=1.0, depth=0.1, columns=200, rows=200)
    image = np.full((200, 200), 60, dtype=np.uint8)
    picture = GreyLevels(probe, Imaging(time_gain=(0.0, 40.0))).shown(image)
    to_probe = probe.image_to_probe
    for column, row in ((100, 30), (100, 150), (30, 100), (160, 100)):
        x, _, z, _ = to_probe @ (column, row, 0, 1)
        way = np.hypot(x, z + 0.05) - 0.05
        assert picture[row, column] == pytest.approx(60 + 4.25 * 400 * way, abs=1.0)
