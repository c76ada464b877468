"""Images by locating every pixel on its own: slow, simple, and the oracle of the other methods.

Every pixel is tried in every tetrahedron whose cut has it in its bounding box, in float64; the
first that holds it says where it lay at rest.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.kernels import njit
from us_sim.slicing.cutting.resampling import (
    BLACK,
    LocatedPixels,
    compute_pixel_to_index,
    get_label_voxels,
    run_rows_in_parallel,
)
from us_sim.slicing.cutting.section import INSIDE, require_finite_nodes
from us_sim.slicing.cutting.slicer import Slicer
from us_sim.slicing.cutting.span_sampling import SLACK
from us_sim.slicing.probe.plane import SlicePlane

_ON_PLANE = 1e-9  # pixels off the plane that count as on it, as for a section
_FLAT = 1e-6  # fraction of its rest volume below which a tetrahedron is flat


class PerPixel(Slicer):
    """Locates every pixel by brute force."""

    def cut_image(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        """Cut the image, trilinear in float64."""
        inside, index = self._voxels(nodes, plane)
        lower = np.minimum(index.astype(np.int64), np.maximum(np.array(self._volume.shape) - 2, 0))
        upper = np.minimum(lower + 1, np.array(self._volume.shape) - 1)
        offset = index - lower
        grey = np.zeros(len(index))
        for side in np.ndindex(2, 2, 2):
            corner = np.where(side, upper, lower)
            weight = np.where(side, offset, 1.0 - offset).prod(axis=1)
            grey += weight * self._volume.intensities[tuple(corner.T)]
        image = np.zeros(inside.shape, dtype=np.uint8)
        image[inside] = np.floor(grey + 0.5)
        return image

    def cut_labels(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        """Cut the label image from the rest place of each pixel."""
        labels = get_label_voxels(self._volume)[0].reshape(self._volume.shape)
        inside, index = self._voxels(nodes, plane)
        image = np.zeros(inside.shape, dtype=np.uint8)
        image[inside] = labels[tuple((index + 0.5).astype(np.int64).T)]
        return image

    def compute_rest_coordinates(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.float64]:
        """Compute the rest place of each pixel's tissue by its barycentric coordinates."""
        moved = require_finite_nodes(nodes, len(self._mesh.nodes))
        covered, *_ = self._place(self._mesh.nodes, plane)
        rest, *_ = self._place(moved, plane)
        outside = np.isnan(rest[..., 0])
        rest[outside] = plane.compute_pixel_positions()[outside]
        rest[outside & ~np.isnan(covered[..., 0])] = np.nan
        rest[~plane.make_shown_mask()] = np.nan
        return rest

    def locate_pixels(self, nodes: ArrayLike, plane: SlicePlane) -> LocatedPixels:
        """Find the first tetrahedron that holds each pixel."""
        moved = require_finite_nodes(nodes, len(self._mesh.nodes))
        covered, *_ = self._place(self._mesh.nodes, plane)
        rest, kept, elements = self._place(moved, plane)
        elements[elements < 0] = len(kept)
        elements[np.isnan(rest[..., 0]) & ~np.isnan(covered[..., 0])] = BLACK
        elements[~plane.make_shown_mask()] = BLACK
        corners = (
            moved[self._mesh.tetrahedra[kept]] @ plane.to_pixel[:, :3].T + plane.to_pixel[:, 3]
        )
        index = self._mesh.rest_index[self._mesh.tetrahedra[kept]]
        ones = np.ones((len(kept), 4, 1))
        maps = np.linalg.solve(np.concatenate([ones, corners], axis=2), index).transpose(0, 2, 1)
        rigid = compute_pixel_to_index(self._volume, plane)[None]
        return LocatedPixels(elements, np.concatenate([maps[..., :3], rigid]), kept)

    def _voxels(
        self, nodes: ArrayLike, plane: SlicePlane
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which pixels (rows, columns) lie in the volume, and their voxel indices (P, 3).

        The outer half voxel takes the index of the outermost centre.
        """
        to_index, shape = self._volume.patient_to_index, np.array(self._volume.shape)
        index = self.compute_rest_coordinates(nodes, plane) @ to_index[:3, :3].T + to_index[:3, 3]
        inside = ((index >= -0.5 - SLACK) & (index <= shape - 0.5 + SLACK)).all(axis=-1)
        return np.asarray(inside), np.clip(index[inside], 0, shape - 1)

    def _place(
        self, nodes: NDArray[np.float64], plane: SlicePlane
    ) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.int32]]:
        """Return the rest place of each pixel, (rows, columns, 3) m, NaN outside the mesh.

        Also the tetrahedra (E,) on the image, and which of them each pixel is in (rows, columns),
        -1 outside all.
        """
        now, places = nodes[self._mesh.tetrahedra], self._mesh.nodes[self._mesh.tetrahedra]
        corners = now @ plane.to_pixel[:, :3].T + plane.to_pixel[:, 3]
        first, last = _boxes(corners)
        met = ((last >= 0) & (first <= [plane.columns - 1, plane.rows - 1])).all(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):  # nodes of a solver that has diverged
            size, rest_size = (np.linalg.det(x[:, 1:] - x[:, :1]) for x in (now, places))
        valid = size * np.sign(rest_size) > _FLAT * np.abs(rest_size)
        kept = met & valid
        first, last = (np.clip(x[kept], -1, 1e6).astype(np.int64) for x in (first, last))
        rest = np.full((plane.rows, plane.columns, 3), np.nan)
        elements = np.full(rest.shape[:2], -1, dtype=np.int32)
        locate = partial(_locate, corners[kept], places[kept], first, last, rest, elements)
        run_rows_in_parallel(self._threads, plane.rows, locate)
        self.skipped = int((met & ~valid).sum())
        return rest, np.flatnonzero(kept), elements


def _boxes(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (M, 2) least and greatest column and row of each cut; inf, -inf without one.

    Args:
        corners: (M, 4, 3) column, row and height above the plane.
    """
    one, other = corners[:, :, None], corners[:, None, :]
    above, below = one[..., 2], other[..., 2]
    on_edge = (above > 0.0) & (below < 0.0)
    on_node = np.eye(4, dtype=np.bool_) & (np.abs(above) <= _ON_PLANE)
    fraction = np.where(on_edge, above / np.where(on_edge, above - below, 1.0), 0.0)[..., None]
    points = one[..., :2] + fraction * (other - one)[..., :2]
    margin = 1e-6 * (1.0 + np.abs(points))
    on_plane = (on_edge | on_node)[..., None]
    first = np.where(on_plane, points - margin, np.inf).min(axis=(1, 2))
    last = np.where(on_plane, points + margin, -np.inf).max(axis=(1, 2))
    return np.ceil(first), np.floor(last)


@njit(cache=True, nogil=True, error_model="numpy")
def _locate(corners, places, first, last, rest, elements, first_row, end_row):
    """Fill rest positions of the pixels of some rows; of several tetrahedra the first holds.

    Shapes and units:
        corners: (E, 4, 3) column, row and height of the tetrahedra's nodes.
        places: (E, 4, 3) m, the nodes at rest. first, last: (E, 2) columns and rows.
        rest: (rows, columns, 3) m, NaN, filled here where a tetrahedron is.
        elements: (rows, columns), likewise set to its number.
    """
    weights = np.empty(4)
    pixel = np.zeros(3)
    for e in range(len(corners)):
        corner = corners[e].copy()
        size = _six_volumes(corner)
        for row in range(max(first_row, first[e, 1]), min(end_row, last[e, 1] + 1)):
            for column in range(max(0, first[e, 0]), min(rest.shape[1], last[e, 0] + 1)):
                if not np.isnan(rest[row, column, 0]):
                    continue
                pixel[0], pixel[1] = column, row
                # A barycentric coordinate is the fraction of the volume with the pixel as a corner.
                for k in range(4):
                    for a in range(3):
                        corner[k, a] = pixel[a]
                    weights[k] = _six_volumes(corner) / size
                    for a in range(3):
                        corner[k, a] = corners[e, k, a]
                if weights.min() >= INSIDE:
                    for a in range(3):
                        rest[row, column, a] = (weights * places[e, :, a]).sum()
                    elements[row, column] = e


@njit(inline="always", error_model="numpy")
def _six_volumes(c):
    """Return the triple product of the edges from the first of four corners (4, 3)."""
    u = c[1, 0] - c[0, 0], c[1, 1] - c[0, 1], c[1, 2] - c[0, 2]
    v = c[2, 0] - c[0, 0], c[2, 1] - c[0, 1], c[2, 2] - c[0, 2]
    w = c[3, 0] - c[0, 0], c[3, 1] - c[0, 1], c[3, 2] - c[0, 2]
    return (
        u[0] * (v[1] * w[2] - v[2] * w[1])
        + u[1] * (v[2] * w[0] - v[0] * w[2])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
    )
