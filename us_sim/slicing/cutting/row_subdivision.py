"""Images of deformed tissue by recursive subdivision of pixel rows (the paper, section IV).

Both ends of a row are located in the deformed mesh. Where they lie in one tetrahedron, all pixels
between do too, and the row runs linearly through the volume at rest; otherwise it is split in the
middle. Lists of the tetrahedra in each region of the image keep the search short.

Three things that the paper leaves open: a row whose ends lie outside the mesh is outside only when
no tetrahedron of the regions it crosses meets it; a pixel is first sought in the tetrahedra of its
neighbours; and where tissue was pushed away the image is black.

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

from us_sim.kernels import njit
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.slicing.cutting.resampling import (
    BLACK,
    Located,
    parallel_rows,
    pixel_to_index,
    voxels_of,
)
from us_sim.slicing.cutting.section import INSIDE, finite_nodes, row_span
from us_sim.slicing.cutting.slicer import Slicer
from us_sim.slicing.cutting.trilinear import sample_linear
from us_sim.slicing.probe.plane import SlicePlane

if TYPE_CHECKING:
    from collections.abc import Callable


@njit(cache=True, nogil=True, error_model="numpy")
def cells(bounds, columns, rows, regions):
    """The tetrahedra of each cell of the image, as lists one after the other.

    Returns:
        starts (cells + 1,), members (starts[-1],), and the rows and columns of one cell.
    """
    band = (rows + regions - 1) // regions
    cell = (columns + regions - 1) // regions
    across = (columns + cell - 1) // cell
    down = (rows + band - 1) // band
    starts = np.zeros(across * down + 1, dtype=np.int64)
    for e in range(len(bounds)):
        for v in range(_cell(bounds[e, 2], band, down), _cell(bounds[e, 3], band, down) + 1):
            for u in range(
                _cell(bounds[e, 0], cell, across), _cell(bounds[e, 1], cell, across) + 1
            ):
                starts[v * across + u + 1] += 1
    for c in range(across * down):
        starts[c + 1] += starts[c]
    filled = starts[:-1].copy()
    members = np.empty(starts[-1], dtype=np.int32)
    for e in range(len(bounds)):
        for v in range(_cell(bounds[e, 2], band, down), _cell(bounds[e, 3], band, down) + 1):
            for u in range(
                _cell(bounds[e, 0], cell, across), _cell(bounds[e, 1], cell, across) + 1
            ):
                members[filled[v * across + u]] = e
                filled[v * across + u] += 1
    return starts, members, band, cell


@njit(inline="always", error_model="numpy")
def _cell(pixel, size, count):
    return np.int64(min(max(pixel, 0.0) / size, count - 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def subdivide_rows(barycentric, starts, members, band, cell, first_row, end_row, elements, outside):
    """Locates the pixels of rows ``first_row`` to ``end_row - 1``; a thread has whole bands.

    Args:
        barycentric: (E, 4, 3); starts, members, band, cell: as `cells` returns them.
        elements: (rows, columns) int32, set to the tetrahedron of each pixel, E outside all.
        outside: (rows,) bool, set where a pixel of the row is outside.
    """
    # One kind of number everywhere, so that `_locate` is compiled once.
    none = np.int32(len(barycentric))
    left = np.int64(0)
    columns = elements.shape[1]
    across = (columns + cell - 1) // cell
    stack = np.empty((64, 2), dtype=np.int64)
    for row in range(first_row, end_row):
        line = elements[row]
        lists = (row // band) * across
        # The first row of a band takes no hints from the row above, so that the result does not
        # depend on how bands are divided among threads.
        hinted = row % band != 0
        above = elements[row - 1] if hinted else line
        any_outside = False
        last = columns - 1
        line[0] = _locate(
            barycentric, starts, members, lists, cell, left, row, above[0] if hinted else none, none
        )
        hint = above[last] if hinted else none
        line[last] = _locate(barycentric, starts, members, lists, cell, last, row, hint, line[0])
        stack[0, 0] = 0
        stack[0, 1] = last
        depth = 1
        while depth > 0:
            depth -= 1
            a = stack[depth, 0]
            z = stack[depth, 1]
            if line[a] == none or line[z] == none:
                any_outside = True
            if z - a < 2:
                continue
            if line[a] == line[z]:
                if line[a] != none:
                    for i in range(a + 1, z):
                        line[i] = line[a]
                    continue
                m, found = _first_inside(barycentric, starts, members, lists, cell, a, z, row)
                for i in range(a + 1, m):
                    line[i] = none
                if found == none:
                    continue
                line[m] = found
                stack[depth, 0] = m
                stack[depth, 1] = z
                depth += 1
                continue
            m = (a + z) // 2
            hint = above[m] if hinted else none
            if hint != none and _is_inside(barycentric, hint, m, row):
                line[m] = hint
            else:
                line[m] = _locate(
                    barycentric, starts, members, lists, cell, m, row, line[a], line[z]
                )
            stack[depth, 0] = m
            stack[depth, 1] = z
            stack[depth + 1, 0] = a
            stack[depth + 1, 1] = m
            depth += 2
        outside[row] = any_outside


@njit(inline="always", error_model="numpy")
def _is_inside(barycentric, e, column, row):
    b = barycentric[e]
    return (
        b[0, 0] + b[0, 1] * column + b[0, 2] * row >= INSIDE
        and b[1, 0] + b[1, 1] * column + b[1, 2] * row >= INSIDE
        and b[2, 0] + b[2, 1] * column + b[2, 2] * row >= INSIDE
        and b[3, 0] + b[3, 1] * column + b[3, 2] * row >= INSIDE
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _locate(barycentric, starts, members, lists, cell, column, row, hint, second):
    """The tetrahedron of a pixel, sought in two likely ones first; E when it is outside all."""
    none = len(barycentric)
    if hint != none and _is_inside(barycentric, hint, column, row):
        return hint
    if second != none and _is_inside(barycentric, second, column, row):
        return second
    c = lists + column // cell
    for q in range(starts[c], starts[c + 1]):
        if _is_inside(barycentric, members[q], column, row):
            return members[q]
    return none


@njit(cache=True, nogil=True, error_model="numpy")
def _first_inside(barycentric, starts, members, lists, cell, a, z, row):
    """The first pixel strictly between ``a`` and ``z`` that is in a tetrahedron, and which.

    Returns:
        The column and the tetrahedron; ``z`` and E when all pixels between are outside.
    """
    for u in range((a + 1) // cell, (z - 1) // cell + 1):
        first = max(a + 1, u * cell)
        column = min(z - 1, (u + 1) * cell - 1)
        found = -1
        for q in range(starts[lists + u], starts[lists + u + 1]):
            low, high = row_span(barycentric, members[q], row, first, column)
            if low <= high and (found < 0 or low < column):
                column = low
                found = members[q]
        if found >= 0:
            return column, found
    return z, np.int32(len(barycentric))


@njit(cache=True, nogil=True, error_model="numpy")
def leave_black(barycentric, bounds, none, outside, elements):
    """Marks the pixels outside the deformed mesh that the mesh covers at rest.

    Args:
        barycentric, bounds: of the section at rest.
        none: what ``elements`` (rows, columns) holds at pixels outside the deformed mesh.
        outside: (rows,) bool, which rows have such pixels.
    """
    rows, columns = elements.shape
    for e in range(len(bounds)):
        top = int(max(0.0, np.ceil(bounds[e, 2])))
        bottom = int(min(rows - 1.0, np.floor(bounds[e, 3])))
        for row in range(top, bottom + 1):
            if outside[row]:
                low, high = row_span(barycentric, e, row, 0, columns - 1)
                for i in range(low, high + 1):
                    if elements[row, i] == none:
                        elements[row, i] = BLACK


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
    """The paper's method, for comparison. Every cell has a list of the tetrahedra that cross it."""

    Settings = RowSubdivisionSettings

    def _prepare(self, settings: RowSubdivisionSettings | None) -> None:
        self._regions = (settings or RowSubdivisionSettings()).regions
        self._latest: tuple[ArrayLike, SlicePlane, Located] | None = None  # of an image

    def image(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        voxels, shape = voxels_of(self._volume.intensities)
        located = self._locate(nodes, plane)
        self._latest = nodes, plane, located
        elements, maps, _ = located
        image = np.empty(elements.shape, dtype=np.uint8)
        self._in_bands(
            plane, lambda a, b: sample_linear(voxels, shape, maps, elements, a, b, image)
        )
        return image

    def locate(self, nodes: ArrayLike, plane: SlicePlane) -> Located:
        if self._latest is not None and self._latest[0] is nodes and self._latest[1] is plane:
            return self._latest[2]
        return self._locate(nodes, plane)

    def _locate(self, nodes: ArrayLike, plane: SlicePlane) -> Located:
        moved = finite_nodes(nodes, len(self._mesh.nodes))
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
        return Located(elements, section.rest_index, section.tetrahedra.astype(np.intp))

    def _in_bands(self, plane: SlicePlane, work: Callable[[int, int], None]) -> None:
        parallel_rows(self._threads, plane.rows, work, band=-(-plane.rows // self._regions))
