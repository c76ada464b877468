"""Where the transducer's face touches the skin, against what geometry says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.skin.surface import plane_surface
from us_sim.slicing.formation.coupling import FULL_PRESS, GEL_FILM, LIGHT_CONTACT, ContactSurface
from us_sim.slicing.probe.fan_probe import ConvexProbe
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes

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
    gap, press = SURFACE.gaps(BLOCK.nodes, PROBE, Pose([0.003, 0.0011, -height]))
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
    expected = SURFACE.contact(BLOCK.nodes, PROBE, pose)
    found = skin.contact(sheet.vertices + shift, PROBE, moved)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-9)
    assert found[0].max() > 0.0


def test_coupling_from_air_to_full_contact():
    def coupled(z):
        line = SURFACE.contact(BLOCK.nodes, PROBE, Pose([0, 0.0011, z]))[0]
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
    gap, press = SURFACE.gaps(BLOCK.nodes, PROBE, pose)
    x = PROBE.beam_starts[:, 0]
    angle = np.radians(degrees)
    height = x * np.sin(angle) - z  # of each line's start above the skin
    np.testing.assert_allclose(gap, height / np.cos(angle), atol=1e-9)
    np.testing.assert_allclose(press, -gap, atol=1e-9)
    coupling = SURFACE.contact(BLOCK.nodes, PROBE, pose)[0]
    assert (coupling[gap > GEL_FILM[1]] == 0.0).all()
    assert (coupling[gap < 0.0] >= np.float32(LIGHT_CONTACT)).all()


def test_a_convex_face_touches_in_the_middle_only():
    probe = ConvexProbe(radius=0.05, opening_angle=1.0, depth=0.05, columns=64, rows=64, lines=101)
    gap, _ = SURFACE.gaps(BLOCK.nodes, probe, Pose([0, 0.0011, 0.001]))
    angle = (np.arange(101) + 0.5) / 101 - 0.5
    # Along its radius, from the face at 50 mm to the skin 49 mm below the arc's centre.
    np.testing.assert_allclose(gap, 0.049 / np.cos(angle) - 0.05, atol=1e-9)
    assert gap.min() == pytest.approx(-0.001)
    assert gap.max() > 0.004


def test_indented_tissue_is_pressed_by_as_much_as_it_moved():
    nodes = BLOCK.nodes.copy()
    nodes[:, 2] += 0.008 * (1 - nodes[:, 2] / 0.05)
    nodes[:, 0] += 0.003  # and dragged aside, which presses nothing
    gap, press = SURFACE.gaps(nodes, PROBE, Pose([0.003, 0.0011, 0.0078]))
    np.testing.assert_allclose(gap, 0.0002, atol=1e-9)
    np.testing.assert_allclose(press, 0.0078, atol=1e-9)


def test_beside_the_tissue_there_is_nothing_to_touch():
    gap, press = SURFACE.gaps(BLOCK.nodes, PROBE, Pose([0.06, 0.0011, 0.002]))
    beside = PROBE.beam_starts[:, 0] + 0.06 > 0.05
    assert np.isinf(gap[beside]).all()
    assert (press[beside] == 0.0).all()
    np.testing.assert_allclose(gap[~beside], -0.002, atol=1e-12)
    turned = Pose([0, 0.0011, -0.01], [1, 0, 0, 0])  # looks away
    assert np.isinf(SURFACE.gaps(BLOCK.nodes, PROBE, turned)[0]).all()
    far = SURFACE.contact(BLOCK.nodes, PROBE, Pose([0, 0.5, 0.002]))[0]
    assert (far == 0.0).all()


@pytest.mark.parametrize("y", [0.0, 0.01, 0.0011])
def test_a_plane_through_nodes_and_edges_meets_the_surface_once(y):
    gap, _ = SURFACE.gaps(BLOCK.nodes, PROBE, Pose([0, y, -0.002]))
    np.testing.assert_allclose(gap, 0.002, atol=1e-12)


def test_triangles_may_face_inward():
    inward = ContactSurface(BLOCK.nodes, BLOCK.boundary[:, ::-1])
    pose = tilted(10.0, 0.001)
    np.testing.assert_array_equal(
        inward.contact(BLOCK.nodes, PROBE, pose)[0], SURFACE.contact(BLOCK.nodes, PROBE, pose)[0]
    )


def test_a_fold_in_the_skin_is_no_air():
    # A second block overlaps the first one below its surface, as folded skin does.
    other = BLOCK.nodes * [1, 1, 0.02] + [0, 0, 0.0005]
    surface = ContactSurface(
        np.concatenate([BLOCK.nodes, other]),
        np.concatenate([BLOCK.boundary, BLOCK.boundary + len(BLOCK.nodes)]),
    )
    # The face has entered both and left one again.
    gap, _ = surface.gaps(surface.rest_nodes, PROBE, Pose([0, 0.0011, 0.002]))
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


def test_nodes_of_another_mesh_are_refused():
    with pytest.raises(MeshError, match="588 nodes at rest"):
        SURFACE.contact(BLOCK.nodes[:5], PROBE, Pose())
