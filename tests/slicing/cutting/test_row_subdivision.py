"""Slices of deformed meshes against a pixel-by-pixel search, analytic maps and scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slicing_cases import SIZE, around_the_box, box, plane_of_nodes

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.row_subdivision import RowSubdivision, RowSubdivisionSettings
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.volume.volume import Volume

pytestmark = pytest.mark.slow

COUNTS = (7, 5, 6)


def locate_one_by_one(mesh, nodes, points):
    """The tissue's rest position at each point (P, 3), by trying all tetrahedra; NaN outside."""
    rest = np.full(points.shape, np.nan)
    corners, places = nodes[mesh.tetrahedra], mesh.nodes[mesh.tetrahedra]
    for corner, place in zip(corners, places, strict=True):
        if np.linalg.det(corner[1:] - corner[0]) <= 0:
            continue
        near = np.flatnonzero(
            ((points >= corner.min(0) - 1e-9) & (points <= corner.max(0) + 1e-9)).all(axis=1)
        )
        weights = np.linalg.solve((corner[1:] - corner[0]).T, (points[near] - corner[0]).T).T
        weights = np.column_stack([1 - weights.sum(axis=1), weights])
        inside = (weights >= -1e-9).all(axis=1)
        rest[near[inside]] = weights[inside] @ place
    return rest


def expected_rest(mesh, nodes, plane):
    """The oracle for `rest_coordinates`: deformed tissue, else nothing, else the pixel itself."""
    points = plane.pixels().reshape(-1, 3)
    moved = locate_one_by_one(mesh, nodes, points)
    was_tissue = ~np.isnan(locate_one_by_one(mesh, mesh.nodes, points)[:, 0])
    outside = np.isnan(moved[:, 0])
    moved[outside & ~was_tissue] = points[outside & ~was_tissue]
    return moved.reshape(plane.rows, plane.columns, 3)


def pressed(mesh, depth=0.008, width=0.012):
    """The box with a dent in its top, its other faces where they were."""
    x, y, z = mesh.nodes.T
    dent = np.exp(-(x**2 + y**2) / width**2) * depth * (1 - z / SIZE[2])
    return mesh.nodes + np.column_stack([0 * dent, 0 * dent, dent])


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    strength=st.floats(0.0, 0.35),
    regions=st.sampled_from([1, 3, 32, 200]),
    shape=st.sampled_from([(1, 1), (1, 40), (40, 1), (37, 23), (64, 64)]),
)
def test_row_subdivision_equals_a_search_of_every_pixel(seed, strength, regions, shape):
    rng = np.random.default_rng(seed)
    mesh = box((4, 4, 4))
    spacing = SIZE / 3
    nodes = mesh.nodes + rng.uniform(-1, 1, mesh.nodes.shape) * strength * spacing
    corners = nodes[mesh.tetrahedra]
    if np.linalg.det(corners[:, 1:] - corners[:, :1]).min() <= 1e-9:
        nodes = mesh.nodes + (nodes - mesh.nodes) * 0.3
    pose = Pose(rng.uniform(-0.5, 0.5, 3) * SIZE, rng.normal(size=4))
    plane = LinearProbe(rng.uniform(0.01, 0.12), rng.uniform(0.01, 0.12), *shape).plane(pose)
    slicer = RowSubdivision(
        around_the_box(),
        mesh.nodes,
        mesh.tetrahedra,
        settings=RowSubdivisionSettings(regions=regions),
    )
    np.testing.assert_allclose(
        slicer.rest_coordinates(nodes, plane), expected_rest(mesh, nodes, plane), atol=1e-9
    )
    assert slicer.skipped == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("layer", [0, 1, -1])
def test_a_plane_through_nodes_and_faces_leaves_no_hole(axis, layer):
    """Pixels on vertices, edges and faces; with the outermost layers, on the mesh's boundary."""
    volume, mesh = around_the_box(), box(COUNTS)
    plane = plane_of_nodes(mesh, axis, layer)
    turn = Pose([0.011, 0.003, -0.007], [0.3, -0.2, 0.5, 0.8])
    slicer = RowSubdivision(volume, mesh.nodes, mesh.tetrahedra)
    for moved in (Pose(), turn):
        placed = SlicePlane(
            moved.apply(plane.origin[None])[0],
            moved.rotation @ plane.column_step,
            moved.rotation @ plane.row_step,
            columns=plane.columns,
            rows=plane.rows,
        )
        found = slicer.rest_coordinates(moved.apply(mesh.nodes), placed)
        np.testing.assert_allclose(found, plane.pixels(), rtol=0, atol=1e-9)


def test_tissue_that_was_pushed_away_leaves_black_and_no_ghost():
    """Above the dent is air; beside the mesh the volume goes on, without a seam."""
    mesh = box((13, 9, 11))
    volume = around_the_box()
    grey, labels = np.full(volume.shape, 200, np.uint8), np.ones(volume.shape, np.uint8)
    volume = Volume(grey, volume.index_to_patient, labels, {1: "a"})
    plane = LinearProbe(0.07, 0.04, 128, 100).plane(Pose())
    slicer = RowSubdivision(volume, mesh.nodes, mesh.tetrahedra)
    nodes = pressed(mesh)
    column, row = np.meshgrid(np.arange(128), np.arange(100))
    x = np.unique(mesh.nodes[:, 0])
    surface = np.interp(plane.pixels()[0, :, 0], x, 0.008 * np.exp(-(x**2) / 0.012**2))
    depth = (row + 0.5) * 0.04 / 100
    inside_the_box = np.abs(plane.pixels()[..., 0]) < SIZE[0] / 2
    in_the_dent = (depth < surface[column]) & inside_the_box
    assert in_the_dent.sum() > 300
    np.testing.assert_array_equal(slicer.image(nodes, plane) == 0, in_the_dent)
    np.testing.assert_array_equal(slicer.labels(nodes, plane) == 0, in_the_dent)
    np.testing.assert_array_equal(
        np.isnan(slicer.rest_coordinates(nodes, plane)[..., 0]), in_the_dent
    )


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "words"),
    [
        (np.full((4, 3), np.inf), [[0, 1, 2, 3]], "node 0"),
        (np.eye(4)[:, :3], [[0, 1, 2, 4]], "4 nodes"),
        (np.eye(4)[:, :3], [[0, 1, 2, -1]], "-1"),
        (np.eye(4)[:, :3], [[0, 1, 2]], r"\(M, 4\)"),
        (np.eye(4)[:, :3], [[0.0, 1, 2, 3]], r"\(M, 4\)"),
    ],
)
def test_a_rest_mesh_that_cannot_be_is_refused(nodes, tetrahedra, words):
    with pytest.raises(MeshError, match=words):
        RowSubdivision(around_the_box(), nodes, np.array(tetrahedra))
