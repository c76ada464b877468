"""Contact of face and skin against geometry, the layer of gel, and lines without contact."""

import functools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.skin.surface import plane_surface
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.coupling import (
    BAND_SPACING,
    FULL_PRESS,
    GEL_FILM,
    LIGHT_CONTACT,
    ContactSurface,
    GelLayer,
    Reverberation,
)
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.slicing.settings import Imaging
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

BLOCK = box_mesh(
    uniform_planes(-0.05, 0.05, 14), uniform_planes(-0.03, 0.03, 7), uniform_planes(0, 0.05, 6)
)
SURFACE = ContactSurface(BLOCK.nodes, BLOCK.boundary)
PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=64, rows=64, lines=100)


def tilted(degrees, z):
    """About the probe's y, so that one end of the array lifts off."""
    half = np.radians(degrees) / 2
    return Pose([0.0, 0.0011, z], [0.0, np.sin(half), 0.0, np.cos(half)])


@pytest.mark.parametrize("height", [0.01, 0.0004, 0.0])
def test_the_gap_is_the_height_above_flat_skin(height):
    gap, press = SURFACE.measure_gaps(BLOCK.nodes, PROBE, Pose([0.003, 0.0011, -height]))
    np.testing.assert_allclose(gap, height, atol=1e-12)
    np.testing.assert_allclose(press, -height, atol=1e-12)


@pytest.mark.parametrize("away", [0.0, 0.3, -0.3])
@pytest.mark.parametrize("degrees", [0.0, 8.0, 25.0])
def test_an_open_skin_is_met_as_the_block_that_it_covers(degrees, away):
    """Wherever it lies: an open surface has no volume that would tell its outside."""
    sheet, shift = plane_surface((0.1, 0.06), 0.005), np.array([0.1, -0.2, away])
    skin = ContactSurface(sheet.vertices + shift, sheet.triangles, is_outward=True)
    pose = tilted(degrees, 0.002)
    moved = Pose(pose.position + shift, pose.orientation)
    expected = SURFACE.measure_contact(BLOCK.nodes, PROBE, pose)
    found = skin.measure_contact(sheet.vertices + shift, PROBE, moved)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-9)
    assert found[0].max() > 0.0


def test_coupling_from_air_to_full_contact():
    def coupled(z):
        line = SURFACE.measure_contact(BLOCK.nodes, PROBE, Pose([0, 0.0011, z]))[0]
        assert np.ptp(line) == 0.0
        return float(line[0])

    assert coupled(-GEL_FILM[1]) == 0.0
    assert coupled(-sum(GEL_FILM) / 2) == pytest.approx(LIGHT_CONTACT / 2)
    assert coupled(-GEL_FILM[0]) == pytest.approx(LIGHT_CONTACT)
    assert coupled(0.0) == pytest.approx(LIGHT_CONTACT)
    assert coupled(FULL_PRESS / 2) == pytest.approx((1 + LIGHT_CONTACT) / 2)
    assert coupled(FULL_PRESS) == coupled(0.01) == 1.0


@settings(max_examples=40, deadline=None)
@given(degrees=st.floats(1.0, 40.0), z=st.floats(-0.004, 0.004), mirrored=st.booleans())
def test_a_tilted_probe_is_in_air_exactly_where_it_is_off_the_skin(degrees, z, mirrored):
    degrees = -degrees if mirrored else degrees
    pose = tilted(degrees, z)
    gap, press = SURFACE.measure_gaps(BLOCK.nodes, PROBE, pose)
    x = PROBE.beam_starts[:, 0]
    angle = np.radians(degrees)
    height = x * np.sin(angle) - z  # of each line's start above the skin
    np.testing.assert_allclose(gap, height / np.cos(angle), atol=1e-9)
    np.testing.assert_allclose(press, -gap, atol=1e-9)
    coupling = SURFACE.measure_contact(BLOCK.nodes, PROBE, pose)[0]
    assert (coupling[gap > GEL_FILM[1]] == 0.0).all()
    assert (coupling[gap < 0.0] >= np.float32(LIGHT_CONTACT)).all()


def test_indented_tissue_is_pressed_by_as_much_as_it_moved():
    nodes = BLOCK.nodes.copy()
    nodes[:, 2] += 0.008 * (1 - nodes[:, 2] / 0.05)
    nodes[:, 0] += 0.003  # and dragged aside, which presses nothing
    gap, press = SURFACE.measure_gaps(nodes, PROBE, Pose([0.003, 0.0011, 0.0078]))
    np.testing.assert_allclose(gap, 0.0002, atol=1e-9)
    np.testing.assert_allclose(press, 0.0078, atol=1e-9)


def test_beside_the_tissue_there_is_nothing_to_touch():
    gap, press = SURFACE.measure_gaps(BLOCK.nodes, PROBE, Pose([0.06, 0.0011, 0.002]))
    beside = PROBE.beam_starts[:, 0] + 0.06 > 0.05
    assert np.isinf(gap[beside]).all()
    assert (press[beside] == 0.0).all()
    np.testing.assert_allclose(gap[~beside], -0.002, atol=1e-12)
    turned = Pose([0, 0.0011, -0.01], [1, 0, 0, 0])  # looks away
    assert np.isinf(SURFACE.measure_gaps(BLOCK.nodes, PROBE, turned)[0]).all()
    far = SURFACE.measure_contact(BLOCK.nodes, PROBE, Pose([0, 0.5, 0.002]))[0]
    assert (far == 0.0).all()


def test_a_fold_in_the_skin_is_no_air():
    # A second block overlaps the first one below its surface, as folded skin does.
    other = BLOCK.nodes * [1, 1, 0.02] + [0, 0, 0.0005]
    surface = ContactSurface(
        np.concatenate([BLOCK.nodes, other]),
        np.concatenate([BLOCK.boundary, BLOCK.boundary + len(BLOCK.nodes)]),
    )
    # The face has entered both and left one again.
    gap, _ = surface.measure_gaps(surface.rest_nodes, PROBE, Pose([0, 0.0011, 0.002]))
    assert (gap <= 0.0).all()


@pytest.mark.parametrize(
    ("nodes", "triangles", "words"),
    [
        (np.zeros((4, 2)), [[0, 1, 2]], "needs nodes"),
        (np.zeros((4, 3)), [[0, 1]], "needs nodes"),
        (np.zeros((4, 3)), [[0, 1, 4]], "4 nodes has triangles that name others, from 0 to 4"),
        (np.zeros((4, 3)), [[0, 1, -1]], "from -1 to 1"),
    ],
)
def test_a_surface_that_cannot_be_is_refused(nodes, triangles, words):
    with pytest.raises(MeshError, match=words):
        ContactSurface(nodes, triangles)


PROBES = {
    "linear": LinearProbe(aperture=0.04, depth=0.04, columns=80, rows=100, lines=20),
    "convex": ConvexProbe(
        radius=0.04, opening_angle=1.0, depth=0.05, columns=120, rows=110, lines=24
    ),
    "sector": SectorProbe(
        aperture=0.02, opening_angle=1.2, depth=0.05, columns=90, rows=100, lines=30, radius=0.012
    ),
}


def graded(probe, gap):
    """Grey values that say how deep they are, black in front of a gap; and the depths (m)."""
    line, depth = probe.pixel_beams
    grey = np.nan_to_num(20.0 + depth * 5000.0)
    surface = np.interp(np.nan_to_num(line), np.arange(probe.lines), gap)
    return np.where(depth > surface, grey, 0.0).astype(np.uint8), surface


@pytest.mark.parametrize("name", PROBES)
@settings(max_examples=15, deadline=None)
@given(first=st.floats(0.2e-3, 4e-3), last=st.floats(0.2e-3, 4e-3))
@example(first=3.2451774602223087e-3, last=2.3404710968436904e-3)  # left a sector's corner black
def test_the_layer_shows_the_tissue_beyond_it_mirrored(name, first, last):
    probe = PROBES[name]
    gap = np.linspace(first, last, probe.lines)
    image, surface = graded(probe, gap)
    filled = GelLayer(probe).fill_gap(image, gap, np.ones(probe.lines))
    depth = probe.pixel_beams[1]
    pixel = float(np.hypot(*probe.pixel_spacing))
    layer = depth < surface
    mirrored = 20.0 + 5000.0 * (2 * surface - depth)
    # To the margin of a pixel on both sides, and the rounding to the nearest.
    np.testing.assert_allclose(filled[layer], mirrored[layer], atol=5000.0 * 3.5 * pixel + 1)
    beyond = depth > surface + pixel
    np.testing.assert_array_equal(filled[beyond], image[beyond])
    np.testing.assert_array_equal(filled[np.isnan(depth)], image[np.isnan(depth)])


def test_no_black_wedge_where_a_coarse_mesh_stands_off_a_pressed_face():
    planes = uniform_planes(-0.04, 0.04, 9), uniform_planes(-0.02, 0.02, 5)
    block = box_mesh(*planes, uniform_planes(0.0, 0.05, 6))
    grey = np.full((90, 50, 60), 120, np.uint8)
    to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    to_patient[:3, 3] = [-0.0445, -0.0245, -0.0045]
    probe = LinearProbe(aperture=0.04, depth=0.03, columns=80, rows=120, lines=80)
    pressed, nodes = Pose([0.0, 0.0011, 0.01]), block.nodes.copy()
    # Every other node of the top lies 1.5 mm beneath the face, and the others on it.
    top = nodes[:, 2] == 0.0
    nodes[:, 2] += 0.01 * (1 - nodes[:, 2] / 0.05)
    odd = np.round(nodes[:, 0] / 0.01).astype(int) % 2 == 1
    nodes[top & odd, 2] += 0.0015

    def shown(contact):
        scanner = BMode(Volume(grey, to_patient), probe, Imaging(contact=contact))
        scanner.attach_mesh(block.nodes, block.tetrahedra)
        return scanner.render_image(pressed, nodes)

    assert (shown(False)[:4] == 0).mean() > 0.3  # the wedges are there
    assert (shown(True) == 120).all()


AIR_PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=200, rows=400, lines=100)
TISSUE = np.random.Generator(np.random.PCG64(1)).integers(0, 256, (400, 200), dtype=np.uint8)


@functools.cache
def quiet():
    return Reverberation(AIR_PROBE, Imaging(contact=True, reverberation=-60.0))


@functools.cache
def air():
    return Reverberation(AIR_PROBE, Imaging(contact=True))


def coupling(value):
    return np.full(100, value, dtype=np.float32)


@pytest.mark.parametrize(("share", "decibels"), [(0.5, 6.02), (0.1, 20.0)])
def test_a_badly_coupled_line_is_dimmer_by_decibels_at_every_depth(share, decibels):
    expected = np.maximum(TISSUE.astype(int) - round(4.25 * decibels), 0)
    np.testing.assert_array_equal(quiet().apply_coupling(TISSUE, coupling(share)), expected)


def test_air_shows_no_tissue():
    shown = air().apply_coupling(TISSUE, coupling(0.0))
    np.testing.assert_array_equal(shown, air().apply_coupling(np.zeros_like(TISSUE), coupling(0.0)))
    np.testing.assert_array_equal(shown, air().apply_coupling(TISSUE, coupling(0.0)))  # every frame
    assert (shown[-100:] == 0).all()


def test_bands_are_a_lens_apart_and_each_weaker_by_as_much():
    mean = air().apply_coupling(TISSUE, coupling(0.0)).mean(axis=1)
    spacing = 0.04 / 400
    depths = (np.arange(400) + 0.5) * spacing
    bands = [i for i in range(1, 120) if mean[i - 1] < mean[i] >= mean[i + 1]]
    assert len(bands) >= 6
    np.testing.assert_allclose(
        depths[bands[:6]], (np.arange(6) + 0.5) * BAND_SPACING, atol=1.5 * spacing
    )
    np.testing.assert_allclose(np.diff(mean[bands[:6]]), -4.25 * 5.0, atol=3.0)
    assert mean[bands[0]] == pytest.approx(255 - 4.25 * 10, abs=3.0)  # the setting's -10 dB


@pytest.mark.parametrize(("row", "aperture"), [(10, 1.5e-3), (100, 5e-3), (380, 0.04 / 3)])
def test_a_shadow_is_as_soft_as_the_aperture_is_wide(row, aperture):
    half = (np.arange(100) < 50).astype(np.float32)  # the face's middle is the edge
    strong = np.full_like(TISSUE, 200)
    shown = quiet().apply_coupling(strong, half)[row].astype(int)
    x = (np.arange(200) - 99.5) * 0.2e-3  # m from the edge
    margin = 0.5 * aperture + 0.6e-3  # a step of depth, and a line
    assert (shown[x < -margin] == 200).all()
    assert (shown[x > margin] == 0).all()
    # Half of the aperture hears half the amplitude both ways; what it is in between is linear.
    partly = np.abs(x) < 0.5 * aperture - 0.6e-3
    share = 0.5 - x[partly] / aperture
    np.testing.assert_allclose(10 ** ((shown[partly] - 200) / 4.25 / 40), share, atol=0.06)


def test_a_fan_stays_black_beside_its_beams_and_its_bands_follow_the_face():
    probe = ConvexProbe(radius=0.05, opening_angle=1.0, depth=0.05, columns=300, rows=300)
    air = Reverberation(probe, Imaging(contact=True))
    shown = air.apply_coupling(np.zeros((300, 300), np.uint8), np.zeros(probe.lines, np.float32))
    line, way = probe.pixel_beams
    assert (shown[np.isnan(line)] == 0).all()
    bright = shown > 180
    assert bright[np.nan_to_num(line) > 150].any()
    assert bright[np.isfinite(line) & (line < 40)].any()
    off = np.abs(way[bright] / BAND_SPACING % 1.0 - 0.5) * BAND_SPACING
    assert off.max() < 0.5e-3
