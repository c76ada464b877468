"""Surfaces of known shapes, with fewer triangles, their faults, and their files elsewhere."""

import sys

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from us_sim.errors import VolumeError
from us_sim.skin.surface import read_surface
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.label_surface import voxel_surface
from us_sim.volume.surfaces.settings import SurfaceSettings
from us_sim.volume.surfaces.stl_file import write_stl
from us_sim.volume.surfaces.structure_surface import structure_surface
from us_sim.volume.volume import Volume

GRID = 0.5e-3 * (np.indices((70, 70, 70)) - np.reshape((35.1, 34.7, 35.3), (3, 1, 1, 1)))


def ball(x, y, z):
    return x**2 + y**2 + z**2 < 0.015**2


def ring(x, y, z):
    return (np.hypot(x, y) - 0.010) ** 2 + z**2 < 0.0045**2


def block(x, y, z):
    return (abs(x) < 0.015) & (abs(y) < 0.012) & (abs(z) < 0.009)


def labelled(mask, affine=None):
    placed = np.diag([0.5e-3, 0.5e-3, 0.5e-3, 1.0]) if affine is None else affine
    return Volume(np.zeros(mask.shape, np.uint8), placed, mask.astype(np.uint8), {1: "vein"})


@pytest.mark.parametrize(
    ("shape", "volume", "area", "area_error", "genus"),
    [
        (ball, 4 / 3 * np.pi * 0.015**3, 4 * np.pi * 0.015**2, 0.005, 0),
        (ring, 2 * np.pi**2 * 0.010 * 0.0045**2, 4 * np.pi**2 * 0.010 * 0.0045, 0.01, 1),
    ],
)
def test_known_shapes_have_their_volume_area_and_genus(shape, volume, area, area_error, genus):
    made = structure_surface(labelled(shape(*GRID)), 1)
    assert made.surface.volume == pytest.approx(volume, rel=0.006)
    assert made.volume_kept == pytest.approx(1.0, abs=1e-6)
    assert made.surface.area == pytest.approx(area, rel=area_error)
    assert (made.surface.parts, made.surface.genus, made.surface.fault) == (1, genus, "")


def test_parts_are_counted_and_a_smoothed_ball_is_round():
    mask = np.zeros((30, 12, 12), bool)
    mask[2:8, 2:10, 2:10] = mask[12:28, 2:10, 2:10] = True
    mask[15:25, 5:7, :] = False  # a slot right through
    pair = voxel_surface(labelled(mask), 1)[0]
    assert (pair.parts, pair.genus, pair.fault) == (2, 1, "")
    surface = structure_surface(labelled(ball(*GRID)), 1).surface
    radii = np.linalg.norm(surface.vertices - 0.5e-3 * np.array([35.1, 34.7, 35.3]), axis=1)
    assert np.abs(radii - 0.015).max() < 0.25e-3  # half a voxel's half


def test_without_labels_or_the_library_one_sentence_says_so(monkeypatch):
    volume = labelled(block(*GRID))
    with pytest.raises(VolumeError, match="label 7"):
        structure_surface(volume, 7)
    with pytest.raises(VolumeError, match="no labels"):
        structure_surface(Volume(volume.intensities, np.eye(4)), 1)
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(VolumeError, match=r"us_sim\[surfaces\]"):
        structure_surface(volume, 1, SurfaceSettings(decimation=0.5))


@given(
    mask=arrays(bool, st.tuples(*[st.integers(2, 7)] * 3)),
    steps=st.tuples(*[st.floats(0.2e-3, 2e-3)] * 3),
    mirrored=st.booleans(),
    turn=st.integers(0, 2**16),
)
@settings(max_examples=40, deadline=None)
def test_any_labels_have_a_closed_surface_that_faces_outwards(mask, steps, mirrored, turn):
    mask.flat[0] = True
    axes, _ = np.linalg.qr(np.random.default_rng(turn).normal(size=(3, 3)))
    axes *= np.sign(np.linalg.det(axes)) * (-1 if mirrored else 1)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes * steps, (0.1, -0.2, 0.05)
    surface, voxels = voxel_surface(labelled(mask, affine), 1)
    assert surface.fault == ""
    assert voxels == pytest.approx(mask.sum() * np.prod(steps))
    assert 0.0 < surface.volume < 1.1 * voxels  # corners of voxels are cut
    assert surface.genus >= 0


def vtk_distance(one, other):
    """Of the vertices of one surface from the other, m."""
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

    made, points, cells = vtk.vtkPolyData(), vtk.vtkPoints(), vtk.vtkCellArray()
    points.SetData(numpy_to_vtk(other.vertices, deep=True))
    cells.SetData(3, numpy_to_vtkIdTypeArray(other.triangles.ravel().astype(np.int64), deep=True))
    made.SetPoints(points)
    made.SetPolys(cells)
    signed = vtk.vtkImplicitPolyDataDistance()
    signed.SetInput(made)
    return max(abs(signed.EvaluateFunction(point)) for point in one.vertices[::40])


@pytest.mark.slow
@pytest.mark.parametrize(("decimation", "farthest"), [(0.9, 0.15e-3)])
def test_fewer_triangles_keep_shape_volume_and_handle(decimation, farthest):
    volume = labelled(ring(*GRID))
    whole = structure_surface(volume, 1).surface
    made = structure_surface(volume, 1, SurfaceSettings(decimation=decimation)).surface
    assert len(made.triangles) == pytest.approx((1 - decimation) * len(whole.triangles), rel=0.02)
    assert (made.parts, made.genus, made.fault) == (1, 1, "")
    assert made.volume == pytest.approx(whole.volume, rel=1e-5)
    assert max(vtk_distance(whole, made), vtk_distance(made, whole)) < farthest


CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


OPPOSITE = np.vstack([CORNERS, -CORNERS[1:]])
AROUND_AN_EDGE = [[0.0, 0, -1], [0, 0, 1], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]]


@pytest.mark.parametrize(
    ("vertices", "triangles", "fault"),
    [
        (CORNERS, FACES[1:], "one side"),
        (CORNERS, np.vstack([FACES[:1, ::-1], FACES[1:]]), "same way"),
        (np.vstack([CORNERS, [9.0, 9, 9]]), FACES, "in no triangle"),
        (OPPOSITE, np.vstack([FACES, np.array([0, 4, 5, 6])[FACES][:, ::-1]]), "touches itself"),
        (
            np.array(AROUND_AN_EDGE),
            np.vstack([FACES, np.array([0, 1, 4, 5])[FACES]]),
            "same way",
        ),
    ],
    ids=["hole", "turned triangle", "stray vertex", "shared vertex", "shared edge"],
)
def test_what_is_wrong_with_a_surface_is_its_fault(vertices, triangles, fault):
    assert fault in ClosedSurface(vertices, triangles).fault


SURFACE = ClosedSurface(
    np.array([[0.01, 0.02, 0.03], [0.05, 0, 0], [0, 0.061, 0], [0, 0, 0.0723]]), FACES
)


def test_meshio_and_the_scenes_reader_find_the_same_surface_in_millimetres(tmp_path):
    path = tmp_path / "vein.stl"
    write_stl(path, SURFACE)
    for vertices in (meshio.read(path).points * 1e-3, read_surface(path, 1e-3).vertices):
        np.testing.assert_allclose(
            np.sort(vertices, axis=0), np.sort(SURFACE.vertices, axis=0), atol=1e-8
        )
    there = meshio.read(path)
    turned = ClosedSurface(there.points * 1e-3, there.cells_dict["triangle"])
    assert turned.volume == pytest.approx(SURFACE.volume, rel=1e-5)
    assert b"SPACE=LPS" in path.read_bytes()[:80]
