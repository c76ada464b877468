"""Fewer triangles: the distance that is stated against VTK's, and what must stay as it was."""

import sys

import numpy as np
import pytest

from us_sim.errors import VolumeError
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.settings import SurfaceSettings
from us_sim.volume.surfaces.structure_surface import (
    decimated,
    distances_to,
    structure_surface,
    surface_distance,
)
from us_sim.volume.volume import Volume

vtk = pytest.importorskip("vtk")


@pytest.fixture(scope="module")
def ring():
    """A torus of 0.5 mm voxels."""
    x, y, z = 0.5e-3 * (
        np.indices((60, 60, 30)) - np.array([29.6, 30.2, 14.7])[:, None, None, None]
    )
    mask = (np.hypot(x, y) - 0.009) ** 2 + z**2 < 0.004**2
    labels = mask.astype(np.uint8)
    return structure_surface(Volume(labels, np.diag([0.5e-3] * 3 + [1.0]), labels), 1).surface


def polygons_of(surface):
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

    made, points, cells = vtk.vtkPolyData(), vtk.vtkPoints(), vtk.vtkCellArray()
    points.SetData(numpy_to_vtk(surface.vertices, deep=True))
    cells.SetData(3, numpy_to_vtkIdTypeArray(surface.triangles.ravel().astype(np.int64), deep=True))
    made.SetPoints(points)
    made.SetPolys(cells)
    return made


def vtk_distances(points, surface):
    signed = vtk.vtkImplicitPolyDataDistance()
    signed.SetInput(polygons_of(surface))
    return np.array([abs(signed.EvaluateFunction(point)) for point in points])


@pytest.mark.parametrize("farthest", [0.05e-3, 0.2e-3])
def test_it_stays_within_the_distance_and_keeps_volume_and_handle(ring, farthest):
    made, moved = decimated(ring, farthest)
    assert len(made.triangles) < 0.5 * len(ring.triangles)
    assert 0.0 < moved <= farthest
    assert (made.parts, made.genus, made.fault) == (1, 1, "")
    assert made.volume == pytest.approx(ring.volume, rel=1e-3)
    for one, other in ((ring, made), (made, ring)):
        assert vtk_distances(one.vertices[::9], other).max() <= moved + 1e-6


def test_a_wider_distance_leaves_fewer_triangles(ring):
    counts = [len(decimated(ring, 1e-3 * mm)[0].triangles) for mm in (0.02, 0.1, 0.5)]
    assert counts[0] > counts[1] > counts[2]


def test_where_hardly_a_triangle_can_go_the_surface_stays_as_it_is(ring):
    made, moved = decimated(ring, 1e-9)
    assert made is ring
    assert moved == 0.0


def test_distances_are_vtks(ring):
    points = np.random.default_rng(3).normal(scale=0.02, size=(200, 3)) + ring.vertices.mean(axis=0)
    ours = distances_to(points, ring.vertices, ring.triangles)
    theirs = vtk_distances(points, ring)
    assert (ours > theirs - 1e-7).all()
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


def test_the_distance_is_that_of_the_side_that_is_farther(ring):
    dented = ring.vertices.copy()
    highest = int(dented[:, 2].argmax())
    dented[highest, 2] += 0.003
    away = surface_distance(ring, ClosedSurface(dented, ring.triangles))
    assert away == pytest.approx(0.003, rel=0.2)


def test_without_the_library_one_sentence_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    labels = np.zeros((6, 6, 6), np.uint8)
    labels[2:4, 2:4, 2:4] = 1
    with pytest.raises(VolumeError, match=r"us_sim\[surfaces\]"):
        structure_surface(Volume(labels, np.eye(4), labels), 1, SurfaceSettings(decimation=0.01))
