"""Surface files as VTK and meshio read them."""

import meshio
import numpy as np
import pytest

from us_sim.errors import VolumeError
from us_sim.skin.surface import read_surface
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.settings import SURFACE_FORMATS
from us_sim.volume.surfaces.surface_files import write_surface

CORNERS = np.array([[0.01, 0.02, 0.03], [0.05, 0, 0], [0, 0.061, 0], [0, 0, 0.0723]])
SURFACE = ClosedSurface(CORNERS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


def read_by_vtk(path):
    vtk = pytest.importorskip("vtk")
    reader = {
        "stl": vtk.vtkSTLReader,
        "ply": vtk.vtkPLYReader,
        "obj": vtk.vtkOBJReader,
        "vtp": vtk.vtkXMLPolyDataReader,
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
    assert set(points) == {tuple(np.round(corner * 1e3, 4)) for corner in CORNERS}
    triangles = {
        tuple(np.roll(ids, -ids.index(min(ids))))
        for ids in (
            [points.index(points[cell.GetPointId(c)]) for c in range(3)]
            for cell in map(read.GetCell, range(read.GetNumberOfCells()))
        )
    }
    assert len(triangles) == 4
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"vein.{kind}"]
    if kind == "vtp":
        assert read.GetFieldData().GetAbstractArray("SPACE").GetValue(0) == "LPS"
    else:
        assert b"SPACE=LPS" in path.read_bytes()[:200]


@pytest.mark.parametrize("kind", ["stl", "ply", "obj"])
def test_meshio_and_the_scenes_reader_find_the_same_volume(tmp_path, kind):
    path = tmp_path / f"vein.{kind}"
    write_surface(path, SURFACE)
    read = meshio.read(path)
    there = ClosedSurface(read.points * 1e-3, read.cells_dict["triangle"])
    assert there.volume == pytest.approx(SURFACE.volume, rel=1e-5)
    surface = read_surface(path, 1e-3)
    assert np.ptp(surface.vertices, axis=0) == pytest.approx(np.ptp(CORNERS, axis=0), rel=1e-5)


def test_another_ending_and_a_missing_folder_are_refused(tmp_path):
    with pytest.raises(VolumeError, match=r"ends in \.stl, \.ply, \.vtp, \.obj"):
        write_surface(tmp_path / "vein.txt", SURFACE)
    with pytest.raises(VolumeError, match="cannot be written"):
        write_surface(tmp_path / "nowhere" / "vein.stl", SURFACE)
    assert not list(tmp_path.iterdir())
