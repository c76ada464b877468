"""A surface that is told once, as the page reads it, and what is no surface."""

import numpy as np
import pytest

from us_sim.errors import MeshError
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.viewer.surfaces import RestSurface

SQUARE = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def test_what_is_told_is_read_as_the_page_does():
    edges = np.array([[0, 1], [2, 3], [0, 2]])
    packet = RestSurface(SQUARE, TRIANGLES, edges).told("skin_mesh", 3)
    assert [packet.header[name] for name in ("points", "triangles", "edges")] == [4, 2, 3]
    floats = np.frombuffer(packet.payload, np.float32, 12)
    indices = np.frombuffer(packet.payload, np.uint32, offset=48)
    np.testing.assert_array_equal(floats.reshape(4, 3), SQUARE.astype(np.float32))
    np.testing.assert_array_equal(indices, [*TRIANGLES.ravel(), *edges.ravel()])


def test_moved_points_come_back_to_half_a_micrometre():
    surface = RestSurface(SQUARE, TRIANGLES)
    moved = SQUARE + np.array([0.0, 0.0012344, 0.0100006])
    packet = surface.moved(moved, kind="skin", sequence=1, stamp=12)
    steps = np.frombuffer(packet.payload, np.int16).reshape(4, 3)
    back = surface.points + packet.header["resolution"] * steps
    assert np.abs(back - moved).max() <= 0.51e-6
    assert packet.header["stamp"] == "12"
    assert packet.header["mesh"] == surface.told("skin_mesh", 1).header["mesh"]


def test_another_surface_has_another_number():
    one, other = RestSurface(SQUARE, TRIANGLES), RestSurface(SQUARE, TRIANGLES[:1])
    assert one.number != other.number
    assert one.number == RestSurface(SQUARE.copy(), TRIANGLES).number


def test_around_a_mesh_are_its_outer_faces_with_each_edge_once():
    planes = np.linspace(0.0, 0.03, 4)
    mesh = box_mesh(planes, planes, planes)
    packet = RestSurface.around(mesh).told("tissue_mesh", 1)
    count = packet.header["triangles"]
    assert (packet.header["points"], count) == (64, 6 * 9 * 2)
    assert packet.header["edges"] == 3 * count // 2  # of a closed surface
    indices = np.frombuffer(packet.payload, np.uint32, offset=12 * 64)
    edges = {tuple(edge) for edge in indices[3 * count :].reshape(-1, 2)}
    sides = indices[: 3 * count].reshape(-1, 3)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert edges == {tuple(sorted(side)) for side in sides}


@pytest.mark.parametrize(
    ("points", "triangles", "sentence"),
    [
        (SQUARE, [[0, 1, 4]], "names point 4, but there are only 4"),
        (SQUARE, [[0, 1, -1]], "names point"),
        (SQUARE * np.nan, TRIANGLES, "no \\(N, 3\\) finite positions"),
        (SQUARE, [[0, 1]], "triangles have shape"),
    ],
)
def test_what_is_no_surface_is_refused(points, triangles, sentence):
    with pytest.raises(MeshError, match=sentence):
        RestSurface(points, np.array(triangles))


def test_another_number_of_points_is_refused():
    surface = RestSurface(SQUARE, TRIANGLES)
    with pytest.raises(MeshError, match="3 points came, and the mesh has 4"):
        surface.moved(SQUARE[:3], kind="skin", sequence=1, stamp=0)
