"""Images of deformed tissue by recursive subdivision of pixel rows (the paper, section IV).

Both ends of a row are located in the deformed mesh. Where they lie in one tetrahedron, all pixels
between do too, since it is convex, and the row runs linearly through the volume at rest; otherwise
it is split in the middle. Lists of the tetrahedra in each region of the image keep the search
short.

The paper leaves three things open. Where both ends lie outside the mesh, the row
between them is only taken as outside when no tetrahedron of the regions it crosses meets it. A
pixel is first sought in the tetrahedra of its neighbours. And a pixel outside the deformed mesh
shows the rigid volume only where the mesh was not at rest either: tissue that was pushed away
leaves black behind, not its ghost.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.cutting.row_subdivision import RowSubdivision
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.volume.volume import Volume
>>> ramp = np.tile(np.arange(50, dtype=np.uint8), (41, 41, 1))
>>> to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> to_patient[:2, 3] = -0.02
>>> mesh = box_mesh([-0.02, 0.02], [-0.02, 0.02], [0.0, 0.02, 0.04])
>>> slicer = RowSubdivision(Volume(ramp, to_patient, None, {}), mesh.nodes, mesh.tetrahedra)
>>> plane = LinearProbe(aperture=0.02, depth=0.02, columns=8, rows=5).plane(Pose())
>>> slicer.image(mesh.nodes * [1, 1, 0.5], plane)[:, 0]
array([ 4, 12, 20, 28, 36], dtype=uint8)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.slicing.cutting.located import BLACK, Located
from us_sim.slicing.cutting.location import cells, leave_black, subdivide_rows
from us_sim.slicing.cutting.resampling import pixel_to_index, voxels_of
from us_sim.slicing.cutting.row_bands import parallel_rows
from us_sim.slicing.cutting.section import RestMesh, finite_nodes
from us_sim.slicing.cutting.slicer import Slicer
from us_sim.slicing.cutting.trilinear import sample_linear
from us_sim.slicing.probe.plane import SlicePlane

if TYPE_CHECKING:
    from collections.abc import Callable

    from us_sim.volume.volume import Volume


@dataclass(frozen=True)
class RowSubdivisionSettings(Settings):
    """The settings of the method ``row_subdivision``."""

    section = "slice"

    regions: int = setting(
        Quantity("number", 1, 4096),
        "bands of rows into which an image is split, and cells into which each band is; the paper "
        "found 32 best",
        default=32,
    )


class RowSubdivision(Slicer):
    """The paper's method, for comparison. Every cell has a list of the tetrahedra that cross it.

    Raises:
        ValueError: fewer than one thread.
    """

    Settings = RowSubdivisionSettings

    def __init__(
        self,
        volume: Volume,
        rest_nodes: ArrayLike,
        tetrahedra: ArrayLike,
        *,
        threads: int = 1,
        settings: RowSubdivisionSettings | None = None,
    ) -> None:
        if threads < 1:
            raise ValueError(f"give at least one thread, not {threads}")
        self._volume = volume
        self._mesh = RestMesh(
            np.asarray(rest_nodes), np.asarray(tetrahedra), volume.patient_to_index
        )
        self._regions = (settings or RowSubdivisionSettings()).regions
        self._threads = threads
        self._latest: Located | None = None

    def image(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        voxels, shape = voxels_of(self._volume.intensities)
        elements, maps, _ = self.locate(nodes, plane)
        image = np.empty(elements.shape, dtype=np.uint8)
        self._in_bands(
            plane, lambda a, b: sample_linear(voxels, shape, maps, elements, a, b, image)
        )
        return image

    def locate(self, nodes: ArrayLike, plane: SlicePlane, cut: int = 0) -> Located:
        if cut and cut == self.cuts and self._latest is not None:
            return self._latest
        moved = finite_nodes(nodes, len(self._mesh.nodes))
        self.cuts += 1
        section = self._mesh.cut(moved, plane)
        self.skipped = section.skipped
        section.rest_index[-1] = pixel_to_index(self._volume, plane)
        elements = np.empty((plane.rows, plane.columns), dtype=np.int32)
        outside = np.zeros(plane.rows, dtype=np.bool_)
        starts, members, band, cell = cells(
            section.bounds, plane.columns, plane.rows, self._regions
        )
        self._in_bands(
            plane,
            lambda a, b: subdivide_rows(
                section.barycentric, starts, members, band, cell, a, b, elements, outside
            ),
        )
        if outside.any() and not np.array_equal(moved, self._mesh.nodes):
            rest = self._mesh.cut(self._mesh.nodes, plane)
            leave_black(rest.barycentric, rest.bounds, len(section.bounds), outside, elements)
        if plane.spans is not None:
            elements[~plane.is_shown()] = BLACK
        self._latest = Located(elements, section.rest_index, section.tetrahedra.astype(np.intp))
        return self._latest

    def _in_bands(self, plane: SlicePlane, work: Callable[[int, int], None]) -> None:
        """Do ``work(first_row, end_row)`` for all rows, each thread a run of whole bands."""
        parallel_rows(self._threads, plane.rows, work, band=-(-plane.rows // self._regions))
