"""Colours over an image, and the bar that says what they mean."""

import numpy as np
import pytest

from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.colour_bar import ColourBar
from us_sim.slicing.drawing.overlay import ColourScale, Overlay
from us_sim.slicing.probe.probe import LinearProbe

SCALE = ColourScale("flow", -0.2, 0.2, "cm/s", factor=100.0)
PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=300, rows=300)


def test_the_table_goes_through_the_colours_in_even_steps():
    table = ColourScale("all", 0.0, 1.0, "", colours=((0, 0, 0), (100, 0, 0), (100, 200, 0))).table
    assert table.shape == (256, 3)
    assert table[[0, 255]].tolist() == [[0, 0, 0], [100, 200, 0]]
    np.testing.assert_allclose(table[:128, 0], np.linspace(0, 99.6, 128), atol=0.6)
    np.testing.assert_allclose(table[128:, 1], np.linspace(0.8, 200, 128), atol=0.8)


def test_values_beyond_the_scale_have_its_last_colours():
    levels = SCALE.levels(np.float32([-9.0, -0.2, 0.0, 0.1, 0.2, 9.0, np.inf]))
    assert levels.tolist() == [0, 0, 128, 191, 255, 255, 255]
    assert [SCALE.text(value) for value in (-0.2, 0.0, 0.2)] == ["-20", "0", "20"]


@pytest.mark.parametrize("opacity", [0.0, 0.25, 1.0])
def test_colours_are_blended_where_there_are_values(opacity):
    values = np.array([[-0.2, np.nan], [0.2, 0.0]], np.float32)
    picture = np.full((2, 2, 3), 80, np.uint8)
    Overlay(values, SCALE, opacity).lay_over(picture)
    expected = opacity * SCALE.table[[0, 128, 255, 128]] + (1 - opacity) * 80
    expected[1] = 80
    np.testing.assert_allclose(picture.reshape(-1, 3), expected, atol=1)


def test_the_bar_has_the_colours_from_high_to_low_beside_their_values():
    picture = np.zeros((300, 300, 3), np.uint8)
    bar = ColourBar(SCALE, 12, "a note")
    bar.draw(picture)
    left, top, right, bottom = bar.box
    outside = picture.copy()
    outside[top - 1 : bottom, left - 1 : right] = 0
    assert not outside.any()
    strip = picture[:, left + 5]
    red, blue = (np.flatnonzero((strip == colour).all(axis=-1)) for colour in SCALE.table[[255, 0]])
    assert len(red)
    assert len(blue)
    assert red.max() < blue.min() < bottom
    assert picture[bottom - 6 : bottom, left:right].max() > 150  # the note


def test_a_bar_that_has_no_room_is_left_out_and_nothing_fails():
    picture = np.zeros((20, 15, 3), np.uint8)
    ColourBar(SCALE, 12, "a note that is too long for that").draw(picture)
    assert picture.shape == (20, 15, 3)


def test_an_overlay_lies_below_scales_and_names_and_its_outline_is_drawn():
    values = np.full((300, 300), np.nan, np.float32)
    values[150:250, 100:200] = 0.2
    box = np.array([[100, 150], [199, 150], [199, 249], [100, 249]])
    labels = np.zeros((300, 300), np.uint8)
    labels[20:60, 20:60] = 1  # where the bar stands
    annotation = Annotation(PROBE, {1: ("vein", (0.2, 0.3, 0.9))})
    grey = np.full((300, 300), 60, np.uint8)
    plain = annotation.draw(grey, labels)
    overlay = Overlay(values, SCALE, note="12 cm/s", outline=box)
    picture = annotation.draw(grey, labels, overlay=overlay)
    assert picture[200, 150].tolist() == [158, 30, 30]
    assert picture[150, 150].min() > 150  # the outline
    np.testing.assert_array_equal(picture[:, -12:], plain[:, -12:])  # the scale of depth
    assert (picture[20:130, 10:30] != plain[20:130, 10:30]).any()


def test_flipped_all_but_what_is_written_has_left_and_right_exchanged():
    rng = np.random.default_rng(4)
    grey = rng.integers(0, 100, (300, 300), np.uint8)
    labels = np.zeros((300, 300), np.uint8)
    labels[180:260, 150:200] = 1
    values = np.full((300, 300), np.nan, np.float32)
    values[150:200, 60:110] = 0.2
    outline = np.array([[60.0, 150], [109, 150], [109, 199], [60, 199]])
    drawn = [np.array([[150.0, 20], [240, 140]])]
    overlay = Overlay(values, SCALE, outline=outline)
    structures = {1: ("vein", (0.2, 0.3, 0.9))}
    plain = Annotation(PROBE, structures).draw(grey, labels, overlay=overlay, lines=drawn)
    flipped = Annotation(PROBE, structures, is_flipped=True).draw(
        grey, labels, overlay=overlay, lines=drawn
    )
    middle = slice(40, 260)  # without the scales
    same = (plain[140:270, middle] == flipped[140:270, ::-1][:, middle]).all(axis=2)
    assert same.mean() > 0.95  # names and smooth edges may differ
    assert flipped[175, 299 - 80].tolist() == plain[175, 80].tolist()
    assert (plain[:20] != flipped[:20, ::-1]).any()  # what is written, and that it is flipped
