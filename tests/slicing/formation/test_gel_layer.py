"""What is shown between the face and a mesh that stands off it."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.gel_layer import GelLayer
from us_sim.slicing.formation.imaging import Imaging
from us_sim.slicing.probe.fan_probe import ConvexProbe, SectorProbe
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

PROBES = {
    "linear": LinearProbe(aperture=0.04, depth=0.04, columns=80, rows=100, lines=20),
    "convex": ConvexProbe(
        radius=0.04, opening_angle=1.0, depth=0.05, columns=120, rows=110, lines=24
    ),
    "sector": SectorProbe(
        aperture=0.02, opening_angle=1.2, depth=0.05, columns=90, rows=100, lines=30, radius=0.012
    ),
}
LAYERS = {name: GelLayer(probe) for name, probe in PROBES.items()}


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
    filled = LAYERS[name].filled(image, gap, np.ones(probe.lines))
    depth = probe.pixel_beams[1]
    pixel = float(np.hypot(*probe.pixel_spacing))
    layer = depth < surface
    mirrored = 20.0 + 5000.0 * (2 * surface - depth)
    # To the margin of a pixel on both sides, and the rounding to the nearest.
    np.testing.assert_allclose(filled[layer], mirrored[layer], atol=5000.0 * 3.5 * pixel + 1)
    beyond = depth > surface + pixel
    np.testing.assert_array_equal(filled[beyond], image[beyond])
    np.testing.assert_array_equal(filled[np.isnan(depth)], image[np.isnan(depth)])


@pytest.mark.parametrize("name", PROBES)
def test_lines_in_air_and_a_face_in_full_contact_stay_as_they_are(name):
    probe, layer = PROBES[name], LAYERS[name]
    gap = np.full(probe.lines, 2e-3)
    image, _ = graded(probe, gap)
    assert layer.filled(image, gap, np.zeros(probe.lines)) is image
    assert layer.filled(image, np.zeros(probe.lines), np.ones(probe.lines)) is image
    assert layer.filled(image, np.full(probe.lines, np.inf), np.ones(probe.lines)) is image
    assert layer.filled(image, np.full(probe.lines, 0.02), np.ones(probe.lines)) is image
    half = np.where(np.arange(probe.lines) < probe.lines // 2, 1.0, 0.0)
    filled = layer.filled(image, gap, half)
    line = np.nan_to_num(probe.pixel_beams[0])
    in_air = line > probe.lines // 2
    np.testing.assert_array_equal(filled[in_air], image[in_air])
    assert (filled[~in_air] != image[~in_air]).any()


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
        scanner.carry(block.nodes, block.tetrahedra)
        return scanner.image(pressed, nodes)

    assert (shown(False)[:4] == 0).mean() > 0.3  # the wedges are there
    assert (shown(True) == 120).all()
