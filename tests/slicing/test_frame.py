"""A frame makes what it is asked for, once, and from one cut of the mesh."""

import numpy as np
import pytest
from slicing_cases import every_method

from us_sim.errors import MeshError, VolumeError
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.cutting.resampling import BLACK
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.probe.probe import LinearProbe, SectorProbe
from us_sim.slicing.settings import Imaging
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume

PLANES = np.linspace(-0.02, 0.02, 5)
MESH = box_mesh(PLANES, PLANES, np.linspace(0.0, 0.04, 5))
POSE = Pose([0.002, 0.001, -0.003])
LINEAR = LinearProbe(aperture=0.05, depth=0.05, columns=50, rows=40)
SECTOR = SectorProbe(aperture=0.02, opening_angle=1.5, depth=0.05, columns=50, rows=40)


def arm():
    rng = np.random.default_rng(1)
    grey = rng.integers(1, 256, (42, 42, 42), dtype=np.uint8)
    to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    to_patient[:2, 3] = -0.021
    return Volume(grey, to_patient, grey // 40, {n: str(n) for n in range(7)})


def pressed(nodes):
    return nodes + 0.1 * (0.04 - nodes[:, 2:]) * [0.02, 0.0, 1.0]


@pytest.fixture(scope="module")
def scanner():
    scanner = BMode(arm(), LINEAR)
    scanner.attach_mesh(MESH.nodes, MESH.tetrahedra)
    return scanner


@pytest.mark.parametrize("probe", [LINEAR, SECTOR], ids=["linear", "sector"])
@pytest.mark.parametrize("first", ["pixels", "labels", "located"])
def test_all_of_a_frame_comes_from_one_cut_in_any_order(scanner, probe, first, monkeypatch):
    scanner.apply_settings(probe, Imaging())
    slicer = scanner.make_frame(POSE, MESH.nodes).slicer
    nodes = pressed(MESH.nodes)
    plane = probe.make_plane(POSE)
    image, labels = slicer.cut_image(nodes, plane), slicer.cut_labels(nodes, plane)
    frame, cut, cuts = scanner.make_frame(POSE, nodes), slicer._cut, []
    monkeypatch.setattr(slicer, "_cut", lambda *state: cuts.append(state) or cut(*state))
    getattr(frame, first)
    np.testing.assert_array_equal(frame.pixels, image)
    np.testing.assert_array_equal(frame.labels, labels)
    rest = frame.located.compute_rest_index()
    assert len(cuts) == (1 if first == "pixels" else 2)
    to_index = frame.volume.patient_to_index
    expected = slicer.compute_rest_coordinates(nodes, plane) @ to_index[:3, :3].T + to_index[:3, 3]
    np.testing.assert_allclose(rest, expected, atol=1e-9)
    assert frame.pixels is frame.pixels


@pytest.mark.parametrize(
    "imaging", [Imaging(elevation_planes=3), Imaging(lateral_resolution=1e-3, gain=3.0)]
)
def test_labels_are_of_the_middle_plane_and_of_the_beams(scanner, imaging):
    scanner.apply_settings(SECTOR, imaging)
    frame = scanner.make_frame(POSE, pressed(MESH.nodes))
    assert frame.pixels.any()
    scanner.apply_settings(SECTOR, Imaging())
    np.testing.assert_array_equal(frame.labels, scanner.render_labels(POSE, frame.nodes))
    black = frame.located.elements == BLACK
    assert black[~frame.plane.make_shown_mask()].all()
    shown = frame.plane.make_shown_mask()
    was = frame.plane.compute_pixel_positions()[black & shown]  # in the mesh, and moved away
    assert len(was)
    assert (was >= MESH.nodes.min(axis=0) - 1e-9).all()
    assert (was <= MESH.nodes.max(axis=0) + 1e-9).all()


@every_method
def test_every_method_says_which_tetrahedron_a_pixel_is_in(method):
    nodes = pressed(MESH.nodes)
    plane = LINEAR.make_plane(POSE)
    slicer = create_slicer(method, arm(), MESH.nodes, MESH.tetrahedra)
    slicer.cut_image(nodes, plane)
    located = slicer.locate_pixels(nodes, plane)
    inside = (located.elements >= 0) & (located.elements < len(located.tetrahedra))
    assert 0.5 < inside.mean() < 1.0
    corners = nodes[MESH.tetrahedra[located.tetrahedra[located.elements[inside]]]]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    weights = np.linalg.solve(
        edges, (plane.compute_pixel_positions()[inside] - corners[:, 0])[..., None]
    )[..., 0]
    assert weights.min() > -1e-6
    assert weights.sum(axis=1).max() < 1 + 1e-6
    rest = MESH.nodes[MESH.tetrahedra[located.tetrahedra[located.elements[inside]]]]
    at = rest[:, 0] + np.einsum("ni,nij->nj", weights, rest[:, 1:] - rest[:, :1])
    to_index = arm().patient_to_index
    expected = at @ to_index[:3, :3].T + to_index[:3, 3]
    np.testing.assert_allclose(located.compute_rest_index()[inside], expected, atol=1e-9)
    outside = located.elements == len(located.tetrahedra)
    pixel_index = plane.compute_pixel_positions() @ to_index[:3, :3].T + to_index[:3, 3]
    np.testing.assert_allclose(
        located.compute_rest_index()[outside], pixel_index[outside], atol=1e-9
    )


def test_what_cannot_be_known_of_a_frame_is_said(scanner):
    scanner.apply_settings(LINEAR, Imaging())
    with pytest.raises(MeshError, match="no tissue carries the volume"):
        _ = scanner.make_frame(POSE).located
    with pytest.raises(MeshError, match="3 deformed nodes"):
        _ = scanner.make_frame(POSE, MESH.nodes[:3]).pixels
    bare = BMode(Volume(arm().intensities, arm().index_to_patient), LINEAR)
    bare.attach_mesh(MESH.nodes, MESH.tetrahedra)
    for nodes in (None, MESH.nodes):
        with pytest.raises(VolumeError, match="has no labels"):
            _ = bare.make_frame(POSE, nodes).labels


@every_method
def test_labels_follow_nodes_that_were_written_to_after_an_image(method):
    plane, nodes = LINEAR.make_plane(POSE), MESH.nodes.copy()
    slicer = create_slicer(method, arm(), MESH.nodes, MESH.tetrahedra)
    slicer.cut_image(nodes, plane)
    before = slicer.cut_labels(nodes, plane)
    nodes[:] = pressed(nodes)
    expected = create_slicer(method, arm(), MESH.nodes, MESH.tetrahedra).cut_labels(nodes, plane)
    assert (expected != before).any()
    np.testing.assert_array_equal(slicer.cut_labels(nodes, plane), expected)
