"""The stages of image formation together, and grey levels in decibels."""

import dataclasses
import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.pose import Pose
from us_sim.slicing.formation.image_formation import GreyMapping, ImageFormation
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.slicing.settings import GREY_MAPS, Imaging

PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=48, rows=64, lines=24, samples=64)
FAN = ConvexProbe(
    radius=0.04, opening_angle=1.0, depth=0.05, columns=60, rows=50, lines=24, samples=64
)
PHASED = SectorProbe(aperture=0.02, opening_angle=1.2, depth=0.05, columns=40, rows=50)
PIXEL = LinearProbe(aperture=0.04, depth=0.04, columns=1, rows=1, lines=1, samples=1)
SPECKLE = np.random.Generator(np.random.PCG64(2)).integers(0, 256, (64, 48), dtype=np.uint8)


def test_by_default_the_slice_itself_is_the_picture():
    formation = ImageFormation(PROBE, Imaging())
    assert formation.form_picture([SPECKLE], None) is SPECKLE
    assert not formation.needs_contact
    (plane,) = formation.make_planes(Pose([0, 0, 0.01]))
    np.testing.assert_array_equal(plane.origin, PROBE.make_plane(Pose([0, 0, 0.01])).origin)
    assert ImageFormation(PROBE, Imaging(time_gain=[0.0, 0.0])).form_picture([SPECKLE]) is SPECKLE


@pytest.mark.slow
def test_what_is_off_is_not_imported():
    names = ("resolution", "coupling")
    parts = [f"us_sim.slicing.formation.{name}" for name in names]
    assert all(map(importlib.util.find_spec, parts))
    code = (
        "import sys\n"
        "from us_sim.slicing.formation.image_formation import ImageFormation\n"
        "from us_sim.slicing.settings import Imaging\n"
        "from us_sim.slicing.probe.probe import LinearProbe\n"
        "ImageFormation(LinearProbe(0.04, 0.04), Imaging())\n"
        f"print([p for p in {parts} if p in sys.modules], 'cv2' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[] False"


@settings(max_examples=25, deadline=None)
@given(
    imaging=st.builds(
        Imaging,
        gain=st.floats(-60, 60),
        time_gain=st.lists(st.floats(-60, 60), max_size=3).map(tuple),
        dynamic_range=st.floats(10, 120),
        grey_map=st.sampled_from(GREY_MAPS),
        elevation_planes=st.integers(1, 15),
        elevation_width=st.floats(1e-4, 0.02),
        lateral_resolution=st.sampled_from([0.0, 1e-5, 1e-3, 0.01]),
        axial_resolution=st.sampled_from([0.0, 1e-5, 1e-3, 0.01]),
        contact=st.booleans(),
        reverberation=st.floats(-60, 0),
    ),
    probe=st.sampled_from([PROBE, FAN, dataclasses.replace(FAN, lines=1), PHASED, PIXEL]),
    seed=st.integers(0, 9),
)
def test_any_settings_give_a_picture_the_same_one_every_time(imaging, probe, seed):
    random = np.random.Generator(np.random.PCG64(seed))
    formation = ImageFormation(probe, imaging)
    planes = formation.make_planes(Pose([0.1, 0.2, 0.3], [0.1, 0.2, 0.3, 0.9]))
    assert len(planes) == imaging.elevation_planes
    images = [random.integers(0, 256, (probe.rows, probe.columns), np.uint8) for _ in planes]
    before = [image.copy() for image in images]
    coupling = random.random(probe.lines, dtype=np.float32)
    picture = formation.form_picture(images, coupling)
    assert picture.shape == (probe.rows, probe.columns)
    assert picture.dtype == np.uint8
    if imaging.lateral_resolution or imaging.axial_resolution:  # else slices are black there
        assert not picture[np.isnan(probe.pixel_beams[0])].any()
    np.testing.assert_array_equal(
        ImageFormation(probe, imaging).form_picture(images, coupling), picture
    )
    np.testing.assert_array_equal(images, before)  # slices are not drawn on


GREY_PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=256, rows=4)
RAMP = np.tile(np.arange(256, dtype=np.uint8), (4, 1))


def shown(**settings):
    return GreyMapping(GREY_PROBE, Imaging(**settings)).map_levels(RAMP).astype(int)


def test_six_decibels_are_a_tenth_of_sixty():
    np.testing.assert_array_equal(shown(gain=6.0)[0, 17:230], np.arange(17, 230) + 26)  # 25.5
    np.testing.assert_array_equal(shown(gain=-12.0)[0, 51:], np.arange(51, 256) - 51)
    assert (shown(gain=6.0)[:, 230:] == 255).all()
    assert (shown(gain=-12.0)[:, :51] == 0).all()


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
    picture = GreyMapping(probe, Imaging(time_gain=(0.0, 10.0, 40.0))).map_levels(image)
    depth = (np.arange(400) + 0.5) * 1e-4  # m; knots at 0, 20 and 40 mm
    decibels = np.where(depth < 0.02, 500 * depth, 10 + 1500 * (depth - 0.02))
    np.testing.assert_allclose(
        picture[:, 0], 60 + 4.25 * decibels, atol=0.76
    )  # a step and rounding
    assert picture[199, 0] == pytest.approx(60 + 42.5, abs=0.76)


def test_time_gain_follows_the_beams_of_a_fan():
    probe = ConvexProbe(radius=0.05, opening_angle=1.0, depth=0.1, columns=200, rows=200)
    image = np.full((200, 200), 60, dtype=np.uint8)
    picture = GreyMapping(probe, Imaging(time_gain=(0.0, 40.0))).map_levels(image)
    to_probe = probe.image_to_probe
    for column, row in ((100, 30), (100, 150), (30, 100), (160, 100)):
        x, _, z, _ = to_probe @ (column, row, 0, 1)
        way = np.hypot(x, z + 0.05) - 0.05
        assert picture[row, column] == pytest.approx(60 + 4.25 * 400 * way, abs=1.0)
