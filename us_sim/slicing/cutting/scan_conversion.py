"""Exact images of deformed tissue: every tetrahedron that an image cuts is scan-converted.

`section.TetrahedronClusters` finds the tetrahedra that the image may meet; `cut_polygons` gives
each its polygon, the affine map from pixels to rest, and the spans of pixels in it; `span_sampling`
looks these up in the volume. The outline of the mesh at rest tells tissue that was pushed away from
what lies beside it.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.cutting.scan_conversion import ScanConversion
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.volume.volume import Volume
>>> ramp = np.tile(np.arange(50, dtype=np.uint8), (41, 41, 1))
>>> to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> to_patient[:2, 3] = -0.02
>>> mesh = box_mesh([-0.02, 0.02], [-0.02, 0.02], [0.0, 0.02, 0.04])
>>> slicer = ScanConversion(Volume(ramp, to_patient, None, {}), mesh.nodes, mesh.tetrahedra)
>>> plane = LinearProbe(aperture=0.02, depth=0.02, columns=8, rows=5).make_plane(Pose())
>>> slicer.cut_image(mesh.nodes * [1, 1, 0.5], plane)[:, 0]
array([ 4, 12, 20, 28, 36], dtype=uint8)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.geometry.mesh_faces import sort_faces
from us_sim.slicing.cutting.cut_polygons import (
    NO_OUTLINE,
    Outline,
    RestSurface,
    allocate_cuts,
    convert_cuts,
    cut_tetrahedra,
)
from us_sim.slicing.cutting.resampling import (
    BLACK,
    LocatedPixels,
    compute_pixel_to_index,
    get_grey_voxels,
    make_full_runs,
    run_rows_in_parallel,
)
from us_sim.slicing.cutting.section import TetrahedronClusters, require_finite_nodes
from us_sim.slicing.cutting.slicer import Slicer
from us_sim.slicing.cutting.span_sampling import INNER_MARGIN, fill_elements, sample_spans
from us_sim.slicing.probe.plane import SlicePlane


class ScanConversion(Slicer):
    """Cuts exact images, and fast."""

    def _prepare(self) -> None:
        volume, mesh = self._volume, self._mesh
        self._clusters = TetrahedronClusters(mesh.nodes, mesh.tetrahedra)
        self._determinants = mesh.determinants[self._clusters.order]
        self._rest_index = mesh.rest_index
        self._within = _among_centres(mesh.rest_index, self._clusters.tetrahedra, volume.shape)
        self._neighbours = _neighbours(self._clusters.tetrahedra, self._determinants)
        self._surface = RestSurface(
            mesh.nodes, self._clusters.tetrahedra, self._determinants, self._neighbours
        )
        self._voxels, self._shape = get_grey_voxels(volume)
        self._moved = np.empty(mesh.nodes.shape)
        self._cuts = allocate_cuts(256)
        self._spans = np.empty((0, 0), dtype=np.int64)
        self._used = np.empty(0, dtype=np.int32)
        self._full = np.empty((0, 2, 2), dtype=np.int32)
        # Of the latest image, while its cuts and spans are there.
        self._drawn: tuple[ArrayLike, SlicePlane, int, Outline] | None = None

    def cut_image(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        """Cut the image, by spans of pixels."""
        count, pieces, outline, is_covered = self._cut(nodes, plane)
        runs = self._shown(plane)
        image = np.empty((plane.rows, plane.columns), dtype=np.uint8)
        self._drawn = nodes, plane, count, outline

        def draw(first_row: int, end_row: int) -> None:
            spans = self._convert(count, pieces, runs, first_row, end_row)
            if spans is not self._spans:
                self._drawn = None
            sample_spans(
                self._voxels, self._shape, self._cuts.maps, self._cuts.inside, count, spans,
                self._used, runs, is_covered, *outline, first_row, end_row, image,
            )  # fmt: skip

        run_rows_in_parallel(self._threads, plane.rows, draw)
        return image

    def locate_pixels(self, nodes: ArrayLike, plane: SlicePlane) -> LocatedPixels:
        """Find the tetrahedron and the rest place of each pixel, by spans of pixels."""
        return self.locate_pixel_subset(nodes, plane, (1, 1))

    def locate_pixel_subset(
        self, nodes: ArrayLike, plane: SlicePlane, steps: tuple[int, int]
    ) -> LocatedPixels:
        """Locate every n-th row and column from 0 on, without the pixels in between."""
        count, outline, runs, spans = self._spans_of(nodes, plane)
        shape = -(-plane.rows // steps[0]), -(-plane.columns // steps[1])
        elements = np.empty(shape, dtype=np.int32)
        fill_elements(
            spans, self._used, runs, count, BLACK, *outline, np.array(steps), plane.columns,
            elements,
        )  # fmt: skip
        tetrahedra = self._clusters.order[self._cuts.tetrahedra[:count]]
        return LocatedPixels(elements, self._cuts.maps[: count + 1].copy(), tetrahedra)

    def _spans_of(
        self, nodes: ArrayLike, plane: SlicePlane
    ) -> tuple[int, Outline, NDArray[np.int32], NDArray[np.int64]]:
        if self._drawn is not None and self._drawn[0] is nodes and self._drawn[1] is plane:
            return *self._drawn[2:], self._shown(plane), self._spans
        count, pieces, outline, _ = self._cut(nodes, plane)
        runs = self._shown(plane)
        return count, outline, runs, self._convert(count, pieces, runs, 0, plane.rows)

    def _cut(self, nodes: ArrayLike, plane: SlicePlane) -> tuple[int, int, Outline, bool]:
        """Fill the cuts, followed by the rigid map.

        Returns:
            how many there are, and how many outlines; the mesh at rest; and whether the cuts are
            known to cover the image, so that the mesh at rest does not matter.
        """
        moved = self._as_kernels_take(nodes)
        self._drawn = None
        near = self._clusters.find_near_plane(moved, plane)
        if 4 * len(near) >= len(self._cuts.sides):
            self._cuts = allocate_cuts(2 * len(near))
        count, pieces, self.skipped, is_covered = cut_tetrahedra(
            near, moved, plane.to_pixel, float(np.linalg.det(plane.basis)), plane.columns,
            plane.rows, self._clusters.tetrahedra, self._neighbours, self._determinants,
            self._rest_index, self._within, self._cuts,
        )  # fmt: skip
        self._cuts.maps[count] = compute_pixel_to_index(self._volume, plane)
        outline = NO_OUTLINE if is_covered else self._surface.cut_plane(plane)
        return count, pieces, outline, is_covered

    def _as_kernels_take(self, nodes: ArrayLike) -> NDArray[np.float64]:
        """Return nodes (N, 3) m as contiguous float64, without a copy where they are so."""
        array = np.asarray(nodes)
        if array.shape != self._moved.shape:
            require_finite_nodes(array, len(self._moved))
        if array.dtype == np.float64 and array.flags.c_contiguous:
            return array
        self._moved[:] = array
        return self._moved

    def _shown(self, plane: SlicePlane) -> NDArray[np.int32]:
        """Return (rows, 2, 2) the runs of columns that an image shows; make room for its spans.

        A row has no more spans than pixels, unless deformed tissue overlaps itself.
        """
        if len(self._used) < plane.rows or self._spans.shape[1] < plane.columns:
            self._used = np.empty(plane.rows, dtype=np.int32)
            self._spans = np.empty((plane.rows, plane.columns), dtype=np.int64)
        if plane.spans is not None:
            return plane.spans
        if len(self._full) != plane.rows or self._full[0, 0, 1] != plane.columns:
            self._full = make_full_runs(plane)
        return self._full

    def _convert(
        self, count: int, pieces: int, runs: NDArray[np.int32], first_row: int, end_row: int
    ) -> NDArray[np.int64]:
        cuts, spans = self._cuts, self._spans
        while True:
            most = convert_cuts(
                cuts.corners, cuts.sides, count, cuts.outlines, cuts.points, cuts.owner, pieces,
                runs, first_row, end_row, spans, self._used,
            )  # fmt: skip
            if most <= spans.shape[1]:
                return spans
            spans = np.empty((end_row, most), dtype=np.int64)


def _among_centres(
    rest_index: NDArray[np.float64], tetrahedra: NDArray[np.int32], shape: tuple[int, int, int]
) -> NDArray[np.bool_]:
    """Return (M,) True for tetrahedra that lie well among the centres of the volume's voxels."""
    last = np.array(shape) - 1 - INNER_MARGIN
    among = (rest_index >= INNER_MARGIN) & (rest_index <= last)
    return np.asarray(among[tetrahedra].all(axis=(1, 2)))


def _neighbours(
    tetrahedra: NDArray[np.int32], determinants: NDArray[np.float64]
) -> NDArray[np.int32]:
    """Return (M, 4) the tetrahedron beyond the face opposite to each corner, -1 without one.

    A tetrahedron that is flat at rest is nobody's neighbour.
    """
    solid = np.flatnonzero(determinants).astype(np.int32)
    order, starts, counts = sort_faces(tetrahedra[solid])
    first = starts[counts == 2]
    one, other = order[first], order[first + 1]
    of_solid = np.full(4 * len(solid), -1, dtype=np.int32)
    of_solid[one], of_solid[other] = solid[other // 4], solid[one // 4]
    neighbours = np.full(tetrahedra.shape, -1, dtype=np.int32)
    neighbours[solid] = of_solid.reshape(-1, 4)
    return neighbours
