"""The same images by VTK, as a user of VTK would make them, to compare with.

`vtkProbeFilter` finds the pixels in the deformed mesh, whose nodes carry their coordinates at
rest, and interpolates those; a second one samples the volume there. The mesh is passed to it in
columns, rows and heights over the image, since it ignores an image's direction matrix; that is
also its fast method, which goes through the cells instead of searching one for each pixel.
"""

from __future__ import annotations

import importlib.util
import time

import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.probe.plane import SlicePlane
from us_sim.volume.volume import Volume

HOW_TO_GET = "VTK was left out, since it is not installed: pip install 'us_sim[evaluate]' adds it"


def is_installed() -> bool:
    """Whether VTK can be imported."""
    return importlib.util.find_spec("vtkmodules") is not None


class VtkSlicer:
    """Cuts images with VTK.

    Args:
        volume: in frame ``patient``.
        rest_nodes: (N, 3) m.
        tetrahedra: (M, 4) indices into the nodes.
        threads: more than the one that VTK's wheels use unless told otherwise.

    Raises:
        ImportError: VTK is not installed.
    """

    filter_ms: float = float("nan")
    """Processor time of finding the pixels of the latest image."""
    sampling_ms: float = float("nan")
    """Processor time of sampling the volume for the latest image."""

    def __init__(
        self,
        volume: Volume,
        rest_nodes: NDArray[np.float64],
        tetrahedra: NDArray[np.int32],
        threads: int = 1,
    ) -> None:
        from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
        from vtkmodules.vtkCommonCore import VTK_ID_TYPE, vtkPoints, vtkSMPTools
        from vtkmodules.vtkCommonDataModel import (
            VTK_TETRA,
            vtkCellArray,
            vtkImageData,
            vtkPolyData,
            vtkUnstructuredGrid,
        )
        from vtkmodules.vtkFiltersCore import vtkProbeFilter

        self._workers, self._to_numpy = vtkSMPTools, vtk_to_numpy
        self._threads = threads
        self._to_index = volume.patient_to_index
        self._placed = np.empty(rest_nodes.shape)
        self._points = vtkPoints()
        self._points.SetData(numpy_to_vtk(self._placed))
        cells = vtkCellArray()
        starts = np.arange(0, 4 * len(tetrahedra) + 1, 4)
        numbers = (starts.astype(np.int64), tetrahedra.reshape(-1).astype(np.int64))
        cells.SetData(*(numpy_to_vtk(ids, deep=True, array_type=VTK_ID_TYPE) for ids in numbers))
        self._mesh = vtkUnstructuredGrid()
        self._mesh.SetPoints(self._points)
        self._mesh.SetCells(VTK_TETRA, cells)
        # VTK's first index runs fastest, so its x is the volume's last axis.
        index = rest_nodes @ self._to_index[:3, :3].T + self._to_index[:3, 3]
        at_rest = numpy_to_vtk(np.ascontiguousarray(index[:, ::-1]), deep=True)
        at_rest.SetName("rest")
        self._mesh.GetPointData().AddArray(at_rest)
        self._pixels = vtkImageData()
        self._finder = vtkProbeFilter()
        self._finder.SetInputData(self._pixels)
        self._finder.SetSourceData(self._mesh)

        self._voxels = vtkImageData()
        self._voxels.SetDimensions(*volume.shape[::-1])
        self._grey = volume.intensities.reshape(-1)  # VTK does not keep it
        grey = numpy_to_vtk(self._grey)
        grey.SetName("grey")
        self._voxels.GetPointData().SetScalars(grey)
        self._places = vtkPolyData()
        self._at = vtkPoints()
        self._places.SetPoints(self._at)
        self._sampler = vtkProbeFilter()
        self._sampler.SetInputData(self._places)
        self._sampler.SetSourceData(self._voxels)

    def image(self, nodes: NDArray[np.float64], plane: SlicePlane) -> NDArray[np.uint8]:
        """(rows, columns): the grey values of tissue, 0 elsewhere."""
        begin = time.process_time()
        self._find(nodes, plane)
        found = time.process_time()
        self._at.SetData(self._finder.GetOutput().GetPointData().GetArray("rest"))
        self._at.Modified()
        self._sampler.Update()
        grey = self._sampler.GetOutput().GetPointData().GetArray("grey")
        image = self._to_numpy(grey).reshape(plane.rows, plane.columns)
        image = np.where(self._valid(plane), image, np.uint8(0))
        self.filter_ms = (found - begin) * 1e3
        self.sampling_ms = (time.process_time() - found) * 1e3
        return image

    def rest_coordinates(
        self, nodes: NDArray[np.float64], plane: SlicePlane
    ) -> NDArray[np.float64]:
        """(rows, columns, 3) m, where each pixel's tissue lies at rest; NaN elsewhere."""
        self._find(nodes, plane)
        index = self._to_numpy(self._finder.GetOutput().GetPointData().GetArray("rest"))
        to_patient = np.linalg.inv(self._to_index)
        rest = index[:, ::-1] @ to_patient[:3, :3].T + to_patient[:3, 3]
        rest = rest.reshape(plane.rows, plane.columns, 3)
        rest[~self._valid(plane)] = np.nan
        return np.asarray(rest)

    def _find(self, nodes: NDArray[np.float64], plane: SlicePlane) -> None:
        # Threads are set for the whole process.
        self._workers.SetBackend("Sequential" if self._threads == 1 else "STDThread")
        self._workers.Initialize(self._threads)
        np.add(nodes @ plane.to_pixel[:, :3].T, plane.to_pixel[:, 3], out=self._placed)
        self._points.GetData().Modified()
        self._points.Modified()
        self._mesh.Modified()
        self._pixels.SetDimensions(plane.columns, plane.rows, 1)
        self._pixels.Modified()
        self._finder.Update()

    def _valid(self, plane: SlicePlane) -> NDArray[np.bool_]:
        """(rows, columns): which pixels of the latest image lie in the mesh."""
        mask = self._finder.GetOutput().GetPointData().GetArray("vtkValidPointMask")
        return np.asarray(self._to_numpy(mask).reshape(plane.rows, plane.columns) > 0)
