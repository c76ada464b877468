"""Exact images of deformed tissue: every tetrahedron that the image cuts is scan-converted.

>>> import numpy as np
>>> from us_sim.pose import Pose
>>> from us_sim.slicing.probe import LinearProbe
>>> from us_sim.slicing.scan_conversion import ScanConversion
>>> from us_sim.tissue.mesh import box_mesh
>>> from us_sim.volume.volume import Volume
>>> ramp = np.tile(np.arange(50, dtype=np.uint8), (41, 41, 1))
>>> to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> to_patient[:2, 3] = -0.02
>>> mesh = box_mesh([-0.02, 0.02], [-0.02, 0.02], [0.0, 0.02, 0.04])
>>> slicer = ScanConversion(Volume(ramp, to_patient, None, {}), mesh.nodes, mesh.tetrahedra)
>>> plane = LinearProbe(aperture=0.02, depth=0.02, columns=8, rows=5).plane(Pose())
>>> slicer.image(mesh.nodes * [1, 1, 0.5], plane)[:, 0]
array([ 4, 12, 20, 28, 36], dtype=uint8)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from us_sim.pose import Pose
from us_sim.slicing.location import BLACK, leave_black
from us_sim.slicing.plane import SlicePlane
from us_sim.slicing.probe import LinearProbe
from us_sim.slicing.resampling import label_voxels, pixel_to_index, sample_nearest, voxels_of
from us_sim.slicing.section import RestMesh, finite_nodes, row_span
from us_sim.slicing.slicer import Slicer
from us_sim.slicing.trilinear import sample_linear

if TYPE_CHECKING:
    from us_sim.volume.volume import Volume

__all__ = ["ScanConversion", "warm_up"]


class ScanConversion(Slicer):
    """Cuts exact images."""

    def __init__(
        self, volume: Volume, rest_nodes: ArrayLike, tetrahedra: ArrayLike, *, threads: int = 1
    ) -> None:
        if threads < 1:
            raise ValueError(f"give at least one thread, not {threads}")
        self._volume = volume
        self._mesh = RestMesh(rest_nodes, tetrahedra, volume.patient_to_index)

    def image(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        elements, maps = self._locate(nodes, plane)
        image = np.empty(elements.shape, dtype=np.uint8)
        voxels, shape = voxels_of(self._volume.intensities)
        sample_linear(voxels, shape, maps, elements, 0, plane.rows, image)
        return image

    def labels(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        voxels, shape = label_voxels(self._volume)
        elements, maps = self._locate(nodes, plane)
        image = np.empty(elements.shape, dtype=np.uint8)
        sample_nearest(voxels, shape, maps, elements, 0, plane.rows, image)
        return image

    def rest_coordinates(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.float64]:
        elements, maps = self._locate(nodes, plane)
        column, row = np.meshgrid(np.arange(plane.columns), np.arange(plane.rows))
        pixel = np.stack([np.ones(column.shape), column, row], axis=-1)
        index = np.einsum("rcij,rcj->rci", maps[elements], pixel)
        index[elements == BLACK] = np.nan
        to_patient = self._volume.index_to_patient
        return index @ to_patient[:3, :3].T + to_patient[:3, 3]

    def _locate(
        self, nodes: ArrayLike, plane: SlicePlane
    ) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        moved = finite_nodes(nodes, len(self._mesh.nodes))
        section = self._mesh.cut(moved, plane)
        self.skipped = section.skipped
        section.rest_index[-1] = pixel_to_index(self._volume, plane)
        none = len(section.bounds)
        elements = np.full((plane.rows, plane.columns), none, dtype=np.int32)
        _fill(section.barycentric, section.bounds, elements)
        outside = (elements == none).any(axis=1)
        if outside.any():
            rest = self._mesh.cut(self._mesh.nodes, plane)
            leave_black(rest.barycentric, rest.bounds, none, outside, elements)
        if plane.spans is not None:
            elements[~plane.is_shown()] = BLACK
        return elements, section.rest_index


def warm_up() -> None:
    """Compile every kernel, or load it from numba's cache, by cutting one tiny image."""
    from us_sim.volume.volume import Volume

    voxels = np.zeros((2, 2, 2), dtype=np.uint8)
    volume = Volume(voxels, np.eye(4), voxels, {0: "nothing"})
    nodes = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]]) - 2e-4
    slicer = ScanConversion(volume, nodes, np.array([[0, 1, 2, 3]]))
    plane = LinearProbe(aperture=0.01, depth=0.01, columns=4, rows=4).plane(Pose())
    slicer.image(1.1 * nodes, plane)
    slicer.labels(nodes, plane)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(barycentric, bounds, elements):
    """Writes each tetrahedron's number where it lies on the image."""
    rows, columns = elements.shape
    for e in range(len(bounds)):
        top = int(max(0.0, np.ceil(bounds[e, 2])))
        bottom = int(min(rows - 1.0, np.floor(bounds[e, 3])))
        for row in range(top, bottom + 1):
            low, high = row_span(barycentric, e, row, 0, columns - 1)
            for i in range(low, high + 1):
                elements[row, i] = e
