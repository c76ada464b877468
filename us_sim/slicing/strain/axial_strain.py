"""The strain of the tissue along the beams of an image: what an elastogram would be without error.

It is engineering strain of a line of tissue that lies along the beam *now*: its length now over its
length in the other state, less 1. So a block that is pressed to 95 % of its height shows -0.05
whatever its size, a turn shows none, and it lies between -1 and ∞. The beam of the image is taken,
since that is where a scanner measures; for small strains all definitions are one.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.b_mode import BMode
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.strain.axial_strain import AxialStrain
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.volume.volume import Volume
>>> volume = Volume(np.zeros((41, 41, 41), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
>>> mesh = box_mesh([0.0, 0.02, 0.04], [0.0, 0.04], [0.0, 0.04])
>>> scanner = BMode(volume, LinearProbe(aperture=0.01, depth=0.02, columns=2, rows=3))
>>> scanner.carry(mesh.nodes, mesh.tetrahedra)
>>> frame = scanner.frame(Pose([0.02, 0.02, 0.01]), mesh.nodes * [1.02, 1.02, 0.95])
>>> AxialStrain.of(frame).image(frame)[:, 0].round(4)
array([-0.05, -0.05, -0.05], dtype=float32)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.kernels import njit
from us_sim.slicing.cutting.row_bands import parallel_rows
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import LinearProbe, Probe
from us_sim.slicing.strain.main_label import main_labels
from us_sim.slicing.strain.nodal_strain import corners_by_tissue, nodal_deformation, to_pixels


class AxialStrain:
    """Strain images of a mesh's deformations.

    Args:
        rest_nodes: (N, 3) m. tetrahedra: (M, 4) indices into them.
        tissue: (M,) which tissue each is of, at least 0: strain is averaged at the nodes of one
            tissue only. None is one for all.
    """

    def __init__(
        self,
        rest_nodes: ArrayLike,
        tetrahedra: ArrayLike,
        tissue: NDArray[np.integer] | None = None,
    ) -> None:
        self._rest = np.array(rest_nodes, dtype=np.float64)
        self._tetrahedra = np.array(tetrahedra, dtype=np.int32)
        nodes, count = self._rest.shape, len(self._tetrahedra)
        self._corners = corners_by_tissue(
            self._tetrahedra, np.zeros(count, dtype=np.int64) if tissue is None else tissue
        )
        corners = len(self._corners.starts) - 1
        self._now, self._before, self._place = np.empty(nodes), np.empty(nodes), np.empty(nodes)
        self._mean = np.empty((corners, 3))
        self._deformed = np.empty((count, 4))
        self._done = np.empty(count + corners, dtype=np.bool_)
        self._directions: tuple[Probe, NDArray[np.float32]] | None = None

    @classmethod
    def of(cls, frame: Frame, *, sharp: bool = False) -> AxialStrain:
        """Of the mesh that carries the volume in a frame.

        Args:
            sharp: average nothing over borders of the volume's labels, as far as the mesh follows
                them.

        Raises:
            MeshError: there is none.
        """
        if frame.mesh is None:
            raise MeshError("no tissue carries the volume, so there is no strain")
        nodes, tetrahedra = frame.mesh
        return cls(
            nodes, tetrahedra, main_labels(nodes, tetrahedra, frame.volume) if sharp else None
        )

    def image(self, frame: Frame, before: NDArray[np.float64] | None = None) -> NDArray[np.float32]:
        """(rows, columns): the strain along each pixel's beam, negative where tissue got shorter.

        Args:
            frame: of this mesh.
            before: (N, 3) m, where the nodes were; None for at rest.

        Returns:
            NaN where no tissue of the mesh is, and beside the beams.

        Raises:
            MeshError: the frame has no mesh or another, or nodes of either state are not as many
                as this mesh has.
            ProbeError: the pose is nowhere near.
        """
        located, plane = frame.located, frame.plane
        now = self._as_kernels_take(frame.nodes, self._now)
        then = self._rest if before is None else self._as_kernels_take(before, self._before)
        shown = located.tetrahedra
        nodal_deformation(
            shown, self._tetrahedra, *self._corners, then, now, plane.to_pixel,
            float(np.linalg.det(plane.basis)), frame.probe.pixel_spacing, self._place,
            self._deformed, self._done, self._mean,
        )  # fmt: skip
        maps = np.empty((len(shown), 3, 3))
        numbers = self._corners.numbers
        to_pixels(shown, self._tetrahedra, numbers, self._place, self._mean, maps)
        values = np.empty(located.elements.shape, dtype=np.float32)
        elements, directions = located.elements, self._directions_of(frame.probe)
        parallel_rows(
            frame.threads,
            plane.rows,
            lambda first, end: _strain(maps, elements, directions, first, end, values),
        )
        return values

    def _as_kernels_take(self, nodes: ArrayLike | None, room: NDArray[np.float64]) -> Any:
        array = np.asarray(nodes)
        if array.shape != room.shape:
            raise MeshError(
                f"the strain is that of a mesh of {len(room)} nodes, but {array.shape} came"
            )
        room[:] = array
        return room

    def _directions_of(self, probe: Probe) -> NDArray[np.float32]:
        """As `Probe.pixel_directions`; of one row and column where all beams are parallel."""
        if self._directions is None or self._directions[0] is not probe:
            directions = probe.pixel_directions
            if isinstance(probe, LinearProbe):
                directions = directions[:, :1, :1]
            self._directions = probe, np.array(directions)
        return self._directions[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _strain(maps, elements, directions, first_row, end_row, values):
    """Fills rows of ``values`` (rows, columns) a run of pixels of one tetrahedron at a time.

    Args:
        maps: (E, 3, 3) as `to_pixels` fills them. elements: (rows, columns).
        directions: (2, rows, columns) x and z of each pixel's beam, or (2, 1, 1) for 0 and 1.
    """
    columns = elements.shape[1]
    along_z = directions.shape[1] == 1 and directions.shape[2] == 1
    one = np.float32(1.0)
    for row in range(first_row, end_row):
        line = elements[row]
        start = 0
        while start < columns:
            element = line[start]
            end = start + 1
            while end < columns and line[end] == element:
                end += 1
            if element < 0 or element >= len(maps):
                for i in range(start, end):
                    values[row, i] = np.nan
                start = end
                continue
            m = maps[element]
            axial = np.float32(m[2, 0] + m[2, 2] * row)
            d_axial = np.float32(m[2, 1])
            if along_z:
                for i in range(start, end):
                    values[row, i] = one / np.sqrt(axial + d_axial * np.float32(i)) - one
            else:
                lateral = np.float32(m[0, 0] + m[0, 2] * row)
                d_lateral = np.float32(m[0, 1])
                mixed = np.float32(m[1, 0] + m[1, 2] * row)
                d_mixed = np.float32(m[1, 1])
                for i in range(start, end):
                    at = np.float32(i)
                    x = directions[0, row, i]
                    z = directions[1, row, i]
                    values[row, i] = one / np.sqrt(
                        x * x * (lateral + d_lateral * at)
                        + np.float32(2.0) * x * z * (mixed + d_mixed * at)
                        + z * z * (axial + d_axial * at)
                    ) - one  # fmt: skip
            start = end
