"""Scales, outlines, colours and their bar, drawn over an image."""

import math
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.drawing.annotation import Annotation, Badge
from us_sim.slicing.drawing.label_outlines import snap_to_border, trace_label_outlines
from us_sim.slicing.drawing.overlay import ColourBar, ColourScale, Overlay
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

LINEAR = LinearProbe(aperture=0.04, depth=0.04, columns=512, rows=512, focus=0.02)
CONVEX = ConvexProbe(
    radius=0.06, opening_angle=math.radians(60), depth=0.14, columns=640, rows=480, focus=0.06
)
SECTOR = SectorProbe(
    aperture=0.02, opening_angle=math.radians(90), depth=0.16, columns=600, rows=500, focus=0.08
)
PROBES = pytest.mark.parametrize("probe", [LINEAR, CONVEX, SECTOR], ids=lambda p: type(p).__name__)
AMBER = (255, 176, 0)


def black(probe):
    return np.zeros((probe.rows, probe.columns), np.uint8)


def runs(lit):
    """Middles of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lit, [False]]).astype(int)))
    return (edges[::2] + edges[1::2] - 1) / 2


def disk(labels, column, row, radius, number):
    y, x = np.mgrid[: labels.shape[0], : labels.shape[1]]
    labels[np.hypot(x - column, y - row) <= radius] = number
    return labels


@PROBES
@pytest.mark.parametrize(("inset", "apart_mm"), [(2, {1, 5, 10}), (-1, {5, 10, 20})])
def test_ticks_of_the_depth_scale_stand_at_whole_steps_below_the_face(probe, inset, apart_mm):
    picture = Annotation(probe, {}).draw_annotated(black(probe))
    text = round(min(probe.rows, probe.columns) / 40)  # labelled ticks are as long as letters
    rows = runs(picture[:, probe.columns - (text if inset < 0 else inset)].min(axis=-1) > 150)
    ends = (rows == 0) | (rows == probe.rows - 1)
    depths = 1e3 * (probe.image_to_probe[2, 1] * rows + probe.image_to_probe[2, 3])
    apart = round(np.median(np.diff(depths)))
    assert apart in apart_mm
    off = np.abs(depths / apart - np.round(depths / apart)) * apart
    spacing = 1e3 * probe.pixel_spacing[1]
    assert (off[~ends] <= 0.51 * spacing).all()
    assert (off <= 1.01 * spacing).all()
    assert depths[0] == pytest.approx(0.0, abs=1.01 * spacing)
    assert len(rows) == 1 + math.floor(1e3 * probe.depth / apart + 1e-6)


@PROBES
def test_the_focus_is_marked_at_its_depth(probe):
    picture = Annotation(probe, {}).draw_annotated(black(probe)).astype(int)
    yellow = (picture[:, :, 0] > 200) & (picture[:, :, 2] < 120)
    rows = np.nonzero(yellow)[0]
    assert len(rows) > 10
    depth = probe.image_to_probe[2, 1] * rows.mean() + probe.image_to_probe[2, 3]
    assert depth == pytest.approx(probe.focus, abs=probe.pixel_spacing[1])


@pytest.mark.parametrize("radius", [6.0, 25.3, 140.7])
def test_the_outline_of_a_disk_is_its_circle(radius):
    labels = disk(np.zeros((400, 420), np.uint8), 200.3, 190.6, radius, 7)
    (outline,) = trace_label_outlines(labels, 7, smoothing=3.0)
    distance = np.hypot(*(outline - [200.3, 190.6]).T)
    assert distance.mean() == pytest.approx(radius, abs=0.15)
    assert np.abs(distance - radius).max() < 0.5


def test_holes_are_outlined_and_specks_are_not():
    labels = disk(np.zeros((200, 200), np.uint8), 100, 100, 60, 3)
    labels = disk(labels, 100, 100, 30, 9)
    labels[5, 5] = 3
    outer, inner = trace_label_outlines(labels, 3)
    assert np.hypot(*(outer - 100).T).mean() == pytest.approx(60, abs=0.3)
    assert np.hypot(*(inner - 100).T).mean() == pytest.approx(30, abs=0.3)
    assert trace_label_outlines(labels, 4) == []


def test_each_structure_is_outlined_in_its_colour_and_named_once():
    annotation = Annotation(
        LINEAR, {6: ("vein", (0.25, 0.4, 0.85)), 5: ("artery", (0.85, 0.15, 0.15))}
    )
    labels = disk(disk(black(LINEAR), 120, 200, 40, 6), 300, 200, 20, 6)
    blue_once = annotation.draw_annotated(black(LINEAR), labels).astype(int)
    blue = blue_once[:, :, 2] - blue_once[:, :, 0] > 60
    row, column = np.nonzero(blue)
    first, second = np.hypot(column - 120, row - 200), np.hypot(column - 300, row - 200)
    assert (np.abs(first - 40) < 1.6).sum() > 200
    assert (np.abs(second - 20) < 1.6).sum() > 100
    name = (np.abs(first - 40) > 2) & (np.abs(second - 20) > 2)
    assert 30 < name.sum() < 200
    assert np.ptp(column[name]) < 60  # in one place
    assert np.ptp(row[name]) < 20
    labels = disk(labels, 200, 350, 30, 5)
    both = annotation.draw_annotated(black(LINEAR), labels).astype(int)
    red = both[:, :, 0] - both[:, :, 2] > 60
    row, column = np.nonzero(red & (np.indices(red.shape)[1] < 420))  # the focus is yellow
    assert (np.abs(np.hypot(column - 200, row - 350) - 30) < 1.6).sum() > 150
    np.testing.assert_array_equal(both[:300], blue_once[:300])


def test_the_badge_stands_in_a_frame_of_its_colour_and_the_image_stays():
    annotation = Annotation(LINEAR, {})
    image = np.random.default_rng(1).integers(0, 256, (512, 512), dtype=np.uint8)
    before = image.copy()
    live = annotation.draw_annotated(image)
    stale = annotation.draw_annotated(image, badge=Badge("STALE 0.6 s", AMBER))
    for edge in (stale[:3], stale[-3:], stale[:, :3], stale[:, -3:]):
        assert (edge == AMBER).all()
    text = stale[4:40, 100:412].astype(int)
    assert (np.abs(text - AMBER).max(axis=-1) < 30).sum() > 300
    np.testing.assert_array_equal(stale[50:-8, 8:-8], live[50:-8, 8:-8])
    np.testing.assert_array_equal(image, before)
    assert (live[100:400, 50:400] == image[100:400, 50:400, None]).all()


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 400),
    st.integers(1, 400),
    st.floats(5e-3, 0.2),
    st.floats(5e-3, 0.4),
    st.sampled_from(["", "LOST", "NO PROBE POSE", "STALE 1234567890.0 s"]),
    st.integers(0, 2**32 - 1),
)
def test_a_picture_of_any_size_has_everything_inside(columns, rows, aperture, depth, text, seed):
    probe = LinearProbe(aperture, depth, columns, rows, focus=4e-3, frequencies=(1e6, 2e6))
    labels = np.random.default_rng(seed).integers(0, 3, (rows, columns), dtype=np.uint8)
    labels[rows // 3 : rows // 2, columns // 3 :] = 1
    annotation = Annotation(probe, {1: ("artery", (1.0, 0.0, 0.0)), 2: ("bone", (0.0, 1.0, 0.0))})
    badge = Badge(text, AMBER) if text else None
    picture = annotation.draw_annotated(black(probe), labels, badge)
    assert picture.shape == (rows, columns, 3)
    assert picture.dtype == np.uint8
    if badge:
        assert (picture[0] == AMBER).all()
        assert (picture[:, -1] == AMBER).all()
    again = annotation.draw_annotated(black(probe), labels, badge)
    np.testing.assert_array_equal(picture, again)


SCALE = ColourScale("flow", -0.2, 0.2, "cm/s", factor=100.0)
PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=300, rows=300)


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


def test_an_overlay_lies_below_scales_and_names_and_its_outline_is_drawn():
    values = np.full((300, 300), np.nan, np.float32)
    values[150:250, 100:200] = 0.2
    box = np.array([[100, 150], [199, 150], [199, 249], [100, 249]])
    labels = np.zeros((300, 300), np.uint8)
    labels[20:60, 20:60] = 1  # where the bar stands
    annotation = Annotation(PROBE, {1: ("vein", (0.2, 0.3, 0.9))})
    grey = np.full((300, 300), 60, np.uint8)
    plain = annotation.draw_annotated(grey, labels)
    overlay = Overlay(values, SCALE, note="12 cm/s", outline=box)
    picture = annotation.draw_annotated(grey, labels, overlay=overlay)
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
    plain = Annotation(PROBE, structures).draw_annotated(grey, labels, overlay=overlay, lines=drawn)
    flipped = Annotation(PROBE, structures, is_flipped=True).draw_annotated(
        grey, labels, overlay=overlay, lines=drawn
    )
    middle = slice(40, 260)  # without the scales
    same = (plain[140:270, middle] == flipped[140:270, ::-1][:, middle]).all(axis=2)
    assert same.mean() > 0.95  # names and smooth edges may differ
    assert flipped[175, 299 - 80].tolist() == plain[175, 80].tolist()
    assert (plain[:20] != flipped[:20, ::-1]).any()  # what is written, and that it is flipped


VOXEL = 0.3e-3  # m
BORDER_PROBE = LinearProbe(aperture=0.03, depth=0.024, columns=400, rows=320)  # four pixels a voxel
PIXEL = 0.075  # mm
MIDDLE = np.array([15.2, 11.3])  # mm, of the vessel
MESH = box_mesh(
    uniform_planes(-0.003, 0.033, 7), uniform_planes(0.0, 0.003, 2), uniform_planes(0.0, 0.024, 7)
)


@pytest.fixture(scope="module")
def volume():
    """A vessel of 3.1 mm radius along y."""
    x, _, z = np.indices((120, 10, 100)) * 1e3 * VOXEL
    inside = (x - MIDDLE[0]) ** 2 + (z - MIDDLE[1]) ** 2 < 3.1**2
    labels = inside.astype(np.uint8)
    return Volume(labels, np.diag([VOXEL, VOXEL, VOXEL, 1.0]), labels, {1: "vein"})


@pytest.mark.parametrize("flat", [1.0, 0.4, 0.12])
def test_an_outline_has_no_steps_and_its_area_whatever_the_press(volume, flat):
    scanner = BMode(volume, BORDER_PROBE)
    scanner.attach_mesh(MESH.nodes, MESH.tetrahedra)
    pressed = MESH.nodes * [1.0, 1.0, flat]
    frame = scanner.make_frame(Pose([0.015, 0.0014, 0.0]), pressed)
    refine = partial(snap_to_border, frame)
    (plain,) = trace_label_outlines(frame.labels, 1, smoothing=5.0)
    (outline,) = trace_label_outlines(frame.labels, 1, smoothing=5.0, refine=refine)

    def off(points):
        """mm, root mean square from the ellipse that the circle has become."""
        x, z = (PIXEL * (points + 0.5)).T
        around = np.linspace(0.0, 2 * np.pi, 4000)
        a, b = MIDDLE[0] + 3.1 * np.cos(around), flat * (MIDDLE[1] + 3.1 * np.sin(around))
        return np.sqrt(((x[:, None] - a) ** 2 + (z[:, None] - b) ** 2).min(axis=1).mean())

    def turned(points):
        """Of its sides, in turns: 1 without steps and corners inwards."""
        across, down = np.diff(points, axis=0, append=points[:1]).T
        directions = np.exp(1j * np.arctan2(down, across))
        return np.abs(np.angle(directions / np.roll(directions, 1))).sum() / (2 * np.pi)

    assert off(outline) < 0.7 * off(plain)
    assert off(outline) < 0.12 * 1e3 * VOXEL
    assert turned(outline) < 1.1
    area = PIXEL**2 * cv2.contourArea(outline.astype(np.float32))
    assert area == pytest.approx(np.pi * 3.1**2 * flat, rel=0.02)
