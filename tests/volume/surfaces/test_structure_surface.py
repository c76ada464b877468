"""Surfaces of known shapes, with fewer triangles, their faults, and their files elsewhere."""

import sys
import time

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from us_sim.errors import VolumeError
from us_sim.skin.surface import read_surface
from us_sim.volume.phantom.phantom import cached_phantom
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.label_surface import voxel_surface
from us_sim.volume.surfaces.settings import SURFACE_FORMATS, SurfaceSettings
from us_sim.volume.surfaces.structure_surface import (
    decimated,
    distances_to,
    structure_surface,
    surface_distance,
)
from us_sim.volume.surfaces.surface_files import write_surface
from us_sim.volume.volume import Volume

GRID = 0.5e-3 * (np.indices((70, 70, 70)).transpose(1, 2, 3, 0) - (35.1, 34.7, 35.3))
MATERIAL_TISSUES = ("muscle", "bone", "artery", "vein", "nerve")


def ball(x, y, z):
    return x**2 + y**2 + z**2 < 0.015**2


def ring(x, y, z):
    return (np.hypot(x, y) - 0.010) ** 2 + z**2 < 0.0045**2


def two_rings(x, y, z):
    return ring(1.9 * x - 0.011, 1.9 * y, 1.9 * z) | ring(1.9 * x + 0.011, 1.9 * y, 1.9 * z)


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
        # Edges are rounded, which takes 2 - π/2 of the radius, here a voxel or two, along each.
        (block, 0.030 * 0.024 * 0.018, 2 * (0.030 * 0.042 + 0.024 * 0.018), 0.06, 0),
    ],
)
def test_known_shapes_have_their_volume_area_and_genus(shape, volume, area, area_error, genus):
    made = structure_surface(labelled(shape(*np.moveaxis(GRID, -1, 0))), 1)
    assert made.surface.volume == pytest.approx(volume, rel=0.006)
    assert made.volume_kept == pytest.approx(1.0, abs=1e-6)
    assert made.surface.area == pytest.approx(area, rel=area_error)
    assert (made.surface.parts, made.surface.genus, made.surface.fault) == (1, genus, "")


def test_handles_and_parts_are_counted():
    eight = voxel_surface(labelled(two_rings(*np.moveaxis(GRID, -1, 0))), 1)[0]
    assert (eight.parts, eight.genus) == (1, 2)
    mask = np.zeros((30, 12, 12), bool)
    mask[2:8, 2:10, 2:10] = mask[12:28, 2:10, 2:10] = True
    mask[15:25, 5:7, :] = False  # a slot right through
    pair = voxel_surface(labelled(mask), 1)[0]
    assert (pair.parts, pair.genus, pair.fault) == (2, 1, "")


def test_a_smoothed_ball_is_round():
    surface = structure_surface(labelled(ball(*np.moveaxis(GRID, -1, 0))), 1).surface
    centre = 0.5e-3 * np.array([35.1, 34.7, 35.3])
    radii = np.linalg.norm(surface.vertices - centre, axis=1)
    assert np.abs(radii - 0.015).max() < 0.25e-3  # half a voxel's half


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


def test_five_structures_of_an_arm_keep_their_volume():
    arm = cached_phantom("upper_arm", seed=1, voxel_size=1e-3)
    numbers = {name: label for label, name in arm.label_names.items()}
    begun = time.process_time()
    made = [structure_surface(arm, numbers[name]) for name in MATERIAL_TISSUES]
    assert time.process_time() - begun < 10.0  # 0.1 s where nothing else runs
    for each in made:
        assert each.volume_kept == pytest.approx(1.0, abs=0.01), each.name
        assert each.surface.fault == ""
    assert [each.name for each in made] == list(MATERIAL_TISSUES)


def test_what_has_no_surface_is_said():
    volume = labelled(np.ones((3, 3, 3), bool))
    with pytest.raises(VolumeError, match="label 7"):
        structure_surface(volume, 7)
    with pytest.raises(VolumeError, match="no labels"):
        structure_surface(Volume(volume.intensities, np.eye(4)), 1)
    with pytest.raises(VolumeError, match=r"outside 0 to 0\.1 m"):
        SurfaceSettings(smoothing=3)


vtk = pytest.importorskip("vtk")


@pytest.fixture(scope="module")
def flat_ring():
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
def test_it_stays_within_the_distance_and_keeps_volume_and_handle(flat_ring, farthest):
    made, moved = decimated(flat_ring, farthest)
    assert len(made.triangles) < 0.5 * len(flat_ring.triangles)
    assert 0.0 < moved <= farthest
    assert (made.parts, made.genus, made.fault) == (1, 1, "")
    assert made.volume == pytest.approx(flat_ring.volume, rel=1e-3)
    for one, other in ((flat_ring, made), (made, flat_ring)):
        assert vtk_distances(one.vertices[::9], other).max() <= moved + 1e-6


def test_a_wider_distance_leaves_fewer_triangles(flat_ring):
    counts = [len(decimated(flat_ring, 1e-3 * mm)[0].triangles) for mm in (0.02, 0.1, 0.5)]
    assert counts[0] > counts[1] > counts[2]


def test_where_hardly_a_triangle_can_go_the_surface_stays_as_it_is(flat_ring):
    made, moved = decimated(flat_ring, 1e-9)
    assert made is flat_ring
    assert moved == 0.0


def test_distances_are_vtks(flat_ring):
    points = np.random.default_rng(3).normal(scale=0.02, size=(200, 3)) + flat_ring.vertices.mean(
        axis=0
    )
    ours = distances_to(points, flat_ring, 0.4e-3)
    theirs = vtk_distances(points, flat_ring)
    assert (ours > theirs - 1e-7).all()
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


def test_the_distance_is_that_of_the_side_that_is_farther(flat_ring):
    dented = flat_ring.vertices.copy()
    highest = int(dented[:, 2].argmax())
    dented[highest, 2] += 0.003
    away = surface_distance(flat_ring, ClosedSurface(dented, flat_ring.triangles))
    assert away == pytest.approx(0.003, rel=0.2)


def test_without_the_library_one_sentence_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    labels = np.zeros((6, 6, 6), np.uint8)
    labels[2:4, 2:4, 2:4] = 1
    with pytest.raises(VolumeError, match=r"us_sim\[surfaces\]"):
        structure_surface(Volume(labels, np.eye(4), labels), 1, SurfaceSettings(decimation=0.01))


CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_a_tetrahedron_is_closed_and_turned_inside_out_it_has_its_volume_below_zero():
    whole = ClosedSurface(CORNERS + 100.0, FACES)
    assert whole.fault == ""
    assert whole.volume == pytest.approx(1 / 6)
    assert whole.area == pytest.approx(1.5 + np.sqrt(3) / 2)
    inverted = ClosedSurface(CORNERS, FACES[:, ::-1])
    assert inverted.fault == ""
    assert inverted.volume == pytest.approx(-1 / 6)


OPPOSITE = np.vstack([CORNERS, -CORNERS[1:]])
AROUND_AN_EDGE = [[0.0, 0, -1], [0, 0, 1], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]]


@pytest.mark.parametrize(
    ("vertices", "triangles", "fault"),
    [
        (CORNERS, FACES[1:], "3 of its 6 edges"),
        (CORNERS, np.vstack([FACES[:1, ::-1], FACES[1:]]), "the same way"),
        (np.vstack([CORNERS, [9.0, 9, 9]]), FACES, "1 vertices are in no"),
        (
            OPPOSITE,
            np.vstack([FACES, np.array([0, 4, 5, 6])[FACES][:, ::-1]]),
            "touches itself at 1 vertices",
        ),
        (
            np.array(AROUND_AN_EDGE),
            np.vstack([FACES, np.array([0, 1, 4, 5])[FACES]]),
            "the same way",
        ),
    ],
    ids=["hole", "turned triangle", "stray vertex", "shared vertex", "shared edge"],
)
def test_what_is_wrong_with_a_surface_is_its_fault(vertices, triangles, fault):
    assert fault in ClosedSurface(vertices, triangles).fault


@pytest.mark.parametrize(
    ("vertices", "triangles", "sentence"),
    [
        (CORNERS[:, :2], FACES, "vertices"),
        (CORNERS, FACES[:0], "one triangle"),
        (CORNERS * np.nan, FACES, "not finite"),
        (CORNERS, FACES + 1, "a vertex"),
    ],
)
def test_arrays_that_are_no_surface_are_refused(vertices, triangles, sentence):
    with pytest.raises(VolumeError, match=sentence):
        ClosedSurface(vertices, triangles)


WRITTEN_CORNERS = np.array([[0.01, 0.02, 0.03], [0.05, 0, 0], [0, 0.061, 0], [0, 0, 0.0723]])
SURFACE = ClosedSurface(WRITTEN_CORNERS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


def read_by_vtk(path):
    vtk = pytest.importorskip("vtk")
    reader = {
        "stl": vtk.vtkSTLReader,
        "ply": vtk.vtkPLYReader,
        "obj": vtk.vtkOBJReader,
    }[path.suffix[1:]]()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


@pytest.mark.parametrize("kind", SURFACE_FORMATS)
def test_vtk_reads_every_format_in_millimetres(tmp_path, kind):
    path = tmp_path / f"vein.{kind}"
    write_surface(path, SURFACE)
    read = read_by_vtk(path)
    points = [tuple(np.round(read.GetPoint(n), 4)) for n in range(read.GetNumberOfPoints())]
    assert set(points) == {tuple(np.round(corner * 1e3, 4)) for corner in WRITTEN_CORNERS}
    triangles = {
        tuple(np.roll(ids, -ids.index(min(ids))))
        for ids in (
            [points.index(points[cell.GetPointId(c)]) for c in range(3)]
            for cell in map(read.GetCell, range(read.GetNumberOfCells()))
        )
    }
    assert len(triangles) == 4
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"vein.{kind}"]
    assert b"SPACE=LPS" in path.read_bytes()[:200]


@pytest.mark.parametrize("kind", SURFACE_FORMATS)
def test_meshio_and_the_scenes_reader_find_the_same_volume(tmp_path, kind):
    path = tmp_path / f"vein.{kind}"
    write_surface(path, SURFACE)
    read = meshio.read(path)
    there = ClosedSurface(read.points * 1e-3, read.cells_dict["triangle"])
    assert there.volume == pytest.approx(SURFACE.volume, rel=1e-5)
    surface = read_surface(path, 1e-3)
    assert np.ptp(surface.vertices, axis=0) == pytest.approx(
        np.ptp(WRITTEN_CORNERS, axis=0), rel=1e-5
    )


def test_another_ending_and_a_missing_folder_are_refused(tmp_path):
    with pytest.raises(VolumeError, match=r"\.stl, \.ply, \.obj"):
        write_surface(tmp_path / "vein.txt", SURFACE)
    with pytest.raises(VolumeError, match="be written"):
        write_surface(tmp_path / "nowhere" / "vein.stl", SURFACE)
    assert not list(tmp_path.iterdir())
