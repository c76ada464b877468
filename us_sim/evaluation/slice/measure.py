"""Errors and run times of every slicing method, on the same images, in turns.

The reference is `per_pixel`, which tries every tetrahedron for every pixel, in float64. The tests
compare it with linear algebra and SciPy.
"""

from __future__ import annotations

import importlib.util
import itertools
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.block import make_block_mesh
from us_sim.evaluation.slice.cases import SliceCase, SliceFrame, make_speckle
from us_sim.slicing.cutting.slicer import Slicer, create_slicer
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]

OURS = "scan_conversion"
"""The method of the targets."""

REFERENCE = "per_pixel"
WRONG = 0.1  # voxels at rest, above which a pixel shows other tissue

SLICING_METHODS = ((OURS, 1), (OURS, 2), (REFERENCE, 1))
"""Methods and their numbers of threads, in the report's order; VTK, if installed, is the last."""


def measure_case(case: SliceCase, seconds: float) -> list[dict[str, Any]]:
    """Measure a row for every method; time them together for some seconds."""
    volume, mesh, frames = make_speckle(), make_block_mesh(case.counts), case.make_frames(4)
    first = frames[0]
    tissue = volume, mesh.nodes, mesh.tetrahedra
    reference = create_slicer(REFERENCE, *tissue)
    exact = reference.cut_image(*first), reference.compute_rest_coordinates(*first)
    slicers: list[tuple[str, int, Slicer | VtkSlicer]] = [
        (name, threads, create_slicer(name, *tissue, threads=threads))
        for name, threads in SLICING_METHODS
    ]
    if importlib.util.find_spec("vtkmodules") is not None:
        slicers.append(("vtk", 1, VtkSlicer(*tissue)))
    rows: list[dict[str, Any]] = []
    for method, threads, slicer in slicers:
        image, rest = slicer.cut_image(*first), slicer.compute_rest_coordinates(*first)
        errors = compare_images(volume, first, exact, image, rest, tissue_only=method == "vtk")
        rows.append({"method": method, "tets": len(mesh.tetrahedra), "threads": threads, **errors})
    times = time_slicers([slicer for *_, slicer in slicers], frames, seconds)
    return [{**row, **columns} for row, columns in zip(rows, times, strict=True)]


def time_slicers(
    slicers: Sequence[Slicer | VtkSlicer], frames: Sequence[SliceFrame], seconds: float
) -> list[dict[str, float]]:
    """Time all slicers in turns, on a noisy machine; return a row of columns for each.

    Args:
        slicers: compiled; each has cut an image before.
        frames: to cut, over and over, five in a turn, or one if it takes over 8 ms.
        seconds: after which no turn begins but the first three, in which slicers over 150 ms have
            only one.
    """
    wall_times: list[list[float]] = [[] for _ in slicers]  # ms
    cpu_times: list[list[float]] = [[] for _ in slicers]  # ms
    begin = time.perf_counter()
    for turn in itertools.count():
        late = time.perf_counter() - begin > seconds
        if turn >= 3 and late:
            break
        for slicer, wall, cpu in zip(slicers, wall_times, cpu_times, strict=True):
            if turn and late and min(wall) > 150.0:
                continue
            for image in range(5):
                frame = frames[(turn + image) % len(frames)]
                before, worked = time.perf_counter(), time.process_time()
                slicer.cut_image(*frame)
                wall.append(1e3 * (time.perf_counter() - before))
                cpu.append(1e3 * (time.process_time() - worked))
                if min(wall) > 8.0:
                    break
    return [
        {
            "ms_median": float(np.median(wall)),
            "ms_p99": float(np.percentile(wall, 99)),
            "cpu_ms_median": float(np.median(cpu)),
            "images": len(wall),
        }
        for wall, cpu in zip(wall_times, cpu_times, strict=True)
    ]


def compare_images(
    volume: Volume,
    frame: SliceFrame,
    exact: tuple[NDArray[np.uint8], Array],
    image: NDArray[np.uint8],
    rest: Array,
    tissue_only: bool = False,
) -> dict[str, Any]:
    """Compute the errors, by column, of an image (rows, columns) and its places at rest.

    Args:
        volume: that was cut.
        frame: nodes and plane.
        exact: the reference's image and places.
        image: grey values.
        rest: (rows, columns, 3) m, places at rest; NaN where the method found nothing.
        tissue_only: the method, as VTK, does not show the rigid volume outside the mesh: only
            pixels that it shows are compared; others are missed only where tissue has moved.
    """
    grey, places = exact
    known, seen = np.isfinite(places[..., 0]), np.isfinite(rest[..., 0])
    off = _measure_voxels(volume, rest - places)
    moved = _measure_voxels(volume, places - frame.plane.compute_pixel_positions()) > 0.01
    missed = known & ~seen & (moved if tissue_only else True)
    wrong = missed | (seen & ~known) | (off > WRONG)
    compared = known & seen & ~wrong if tissue_only else np.ones_like(wrong)
    difference = np.abs(image.astype(np.int16) - grey)[compared]
    return {
        "coverage_mismatch_px": int(wrong.sum()),
        "max_grey_difference": int(difference.max(initial=0)),
        "mean_grey_difference": float(difference.mean()) if difference.size else 0.0,
        "max_voxel_error": float(off[known & seen & ~wrong].max(initial=0.0)),
    }


def _measure_voxels(volume: Volume, way: Array) -> Array:
    """Measure vectors (rows, columns, 3) m in voxels: (rows, columns)."""
    return np.asarray(np.linalg.norm(way @ volume.patient_to_index[:3, :3].T, axis=-1))


class VtkSlicer:
    """A slicer of VTK's filters, for comparison.

    `vtkProbeFilter` finds the pixels in the deformed mesh and interpolates its nodes' coordinates
    at rest; a second one samples the volume there. The mesh is passed in columns, rows and heights
    over the image, since the filter ignores an image's direction matrix; for an image it is also
    fast, since it goes through the cells instead of searching one for each pixel.

    Args:
        volume: in frame ``patient``.
        rest_nodes: (N, 3) m.
        tetrahedra: (M, 4) indices into the nodes.

    Raises:
        ImportError: VTK is not installed.
    """

    def __init__(self, volume: Volume, rest_nodes: Array, tetrahedra: NDArray[np.int32]) -> None:
        from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
        from vtkmodules.vtkCommonCore import VTK_ID_TYPE, vtkPoints
        from vtkmodules.vtkCommonDataModel import (
            VTK_TETRA,
            vtkCellArray,
            vtkImageData,
            vtkPolyData,
            vtkUnstructuredGrid,
        )
        from vtkmodules.vtkFiltersCore import vtkProbeFilter

        self._to_numpy = vtk_to_numpy
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

    def cut_image(self, nodes: Array, plane: SlicePlane) -> NDArray[np.uint8]:
        """Cut the grey values (rows, columns) of tissue, 0 elsewhere."""
        self._locate_pixels(nodes, plane)
        self._at.SetData(self._finder.GetOutput().GetPointData().GetArray("rest"))
        self._at.Modified()
        self._sampler.Update()
        grey = self._sampler.GetOutput().GetPointData().GetArray("grey")
        image = self._to_numpy(grey).reshape(plane.rows, plane.columns)
        return np.where(self._make_mask(plane), image, np.uint8(0))

    def compute_rest_coordinates(self, nodes: Array, plane: SlicePlane) -> Array:
        """Compute each pixel's place (rows, columns, 3) m at rest; NaN outside tissue."""
        self._locate_pixels(nodes, plane)
        index = self._to_numpy(self._finder.GetOutput().GetPointData().GetArray("rest"))
        to_patient = np.linalg.inv(self._to_index)
        rest = index[:, ::-1] @ to_patient[:3, :3].T + to_patient[:3, 3]
        rest = rest.reshape(plane.rows, plane.columns, 3)
        rest[~self._make_mask(plane)] = np.nan
        return np.asarray(rest)

    def _locate_pixels(self, nodes: Array, plane: SlicePlane) -> None:
        np.add(nodes @ plane.to_pixel[:, :3].T, plane.to_pixel[:, 3], out=self._placed)
        self._points.GetData().Modified()
        self._points.Modified()
        self._mesh.Modified()
        self._pixels.SetDimensions(plane.columns, plane.rows, 1)
        self._pixels.Modified()
        self._finder.Update()

    def _make_mask(self, plane: SlicePlane) -> NDArray[np.bool_]:
        """Return a mask (rows, columns) of the latest image's pixels in the mesh."""
        mask = self._finder.GetOutput().GetPointData().GetArray("vtkValidPointMask")
        return np.asarray(self._to_numpy(mask).reshape(plane.rows, plane.columns) > 0)
