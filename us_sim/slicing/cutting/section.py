"""The cut of a tetrahedral mesh by the plane of an image.

On the plane a tetrahedron's barycentric coordinates are affine in (column, row), and so is the map
from a pixel to where its tissue lay at rest. A section holds both for each tetrahedron that
the image meets, so that finding and mapping a pixel takes a few multiplications.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.cutting.section import RestMesh
>>> nodes = np.array([[-0.1, -0.1, 0.0], [0.2, -0.1, 0.0], [-0.1, 0.2, 0.0], [0.0, 0.0, 0.3]])
>>> mesh = RestMesh(nodes, np.array([[0, 1, 2, 3]], dtype=np.int32), np.eye(4))
>>> plane = LinearProbe(aperture=0.02, depth=0.04, columns=2, rows=4).plane(Pose())
>>> section = mesh.cut(nodes, plane)
>>> column, row = 1, 2
>>> np.round(section.barycentric[0] @ [1, column, row], 3)
array([0.289, 0.322, 0.306, 0.083])
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.kernels import njit
from us_sim.slicing.cutting.barycentric import adjugate, is_solid
from us_sim.slicing.probe.plane import SlicePlane

INSIDE = -1e-9
"""Least barycentric coordinate of a point inside, so that rounding leaves no holes at faces."""

_ON_PLANE = 1e-9
"""Pixels off the plane within which a node counts as on it: rounding of its position."""


class Section(NamedTuple):
    """The E tetrahedra that an image meets, and their maps, affine in (1, column, row)."""

    barycentric: NDArray[np.float64]  # (E, 4, 3)
    rest_index: NDArray[np.float64]  # (E + 1, 3, 3), voxels; the last is left for the rigid map
    bounds: NDArray[np.float64]  # (E, 4), pixels: least and greatest column, least and greatest row
    tetrahedra: NDArray[np.int32]  # (E,) their numbers in the mesh
    skipped: int  # tetrahedra on the plane that are inverted or flat


class RestMesh:
    """A mesh at rest in a volume, to be cut in any deformation.

    Args:
        nodes: (N, 3) m.
        tetrahedra: (M, 4) indices into the nodes.
        patient_to_index: (4, 4) from m to voxel indices.

    Raises:
        MeshError: nodes are not finite, or tetrahedra name nodes that are not there.
    """

    def __init__(
        self, nodes: ArrayLike, tetrahedra: ArrayLike, patient_to_index: NDArray[np.float64]
    ) -> None:
        self.nodes = finite_nodes(nodes, None)
        corners = np.asarray(tetrahedra)
        if corners.ndim != 2 or corners.shape[1] != 4 or corners.dtype.kind not in "iu":
            raise MeshError(
                f"tetrahedra have shape {corners.shape} and type {corners.dtype}: give (M, 4) "
                f"integers"
            )
        if corners.size and (corners.min() < 0 or corners.max() >= len(self.nodes)):
            raise MeshError(
                f"tetrahedra name nodes {corners.min()} to {corners.max()}, but the mesh has only "
                f"{len(self.nodes)} nodes"
            )
        self.tetrahedra = np.ascontiguousarray(corners, dtype=np.int32)
        corners = self.nodes[self.tetrahedra]
        self.determinants = np.linalg.det(corners[:, 1:] - corners[:, :1])
        self.rest_index = np.ascontiguousarray(
            self.nodes @ patient_to_index[:3, :3].T + patient_to_index[:3, 3]
        )

    def cut(self, nodes: NDArray[np.float64], plane: SlicePlane) -> Section:
        """The section of the mesh with its nodes at ``nodes`` (N, 3) m, as far as the image goes.

        Raises:
            MeshError: another number of nodes, or nodes that are not finite.
        """
        nodes = finite_nodes(nodes, len(self.nodes))
        return Section(
            *_cut(
                nodes,
                self.tetrahedra,
                self.rest_index,
                self.determinants,
                plane.to_pixel,
                float(np.linalg.det(plane.basis)),
                plane.columns,
                plane.rows,
            )
        )


def finite_nodes(nodes: ArrayLike, count: int | None) -> NDArray[np.float64]:
    """Node positions as the kernels take them: (N, 3) float64, contiguous and finite.

    Raises:
        MeshError: they are not (count, 3), or not finite.
    """
    array = np.ascontiguousarray(nodes, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise MeshError(f"mesh nodes have shape {array.shape}: give (N, 3) coordinates")
    if count is not None and len(array) != count:
        raise MeshError(f"there are {len(array)} deformed nodes but {count} at rest: give {count}")
    finite = np.isfinite(array)
    if not finite.all():
        bad = int(np.argmin(finite.all(axis=1)))
        raise MeshError(f"node {bad} is not finite: {array[bad].tolist()}; no slice can be cut")
    return array


@njit(inline="always", error_model="numpy")
def row_span(barycentric, element, row, first, last):
    """Columns from ``first`` to ``last`` of a row that lie in a tetrahedron: (first, last).

    The last is less than the first where there are none.
    """
    low = np.float64(first)
    high = np.float64(last)
    for k in range(4):
        constant = barycentric[element, k, 0] + barycentric[element, k, 2] * row - INSIDE
        slope = barycentric[element, k, 1]
        if slope > 0.0:
            low = max(low, -constant / slope)
        elif slope < 0.0:
            high = min(high, -constant / slope)
        elif constant < 0.0:
            return 1, 0
    if not low <= high:
        return 1, 0
    return np.int64(np.ceil(low)), np.int64(np.floor(high))


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(nodes, tetrahedra, rest_index, determinants, to_pixel, pixel_volume, columns, rows):
    """Barycentric maps, rest maps, bounds, numbers and the number skipped, of tetrahedra.

    Args:
        nodes: (N, 3) m. tetrahedra: (M, 4) int32. rest_index: (N, 3) voxels.
        determinants: (M,) m³, six times the signed volumes at rest.
        to_pixel: (3, 4) from m to (column, row, height). pixel_volume: m³ per unit of those.
    """
    pixel = np.empty((len(nodes), 3))
    for n in range(len(nodes)):
        for a in range(3):
            pixel[n, a] = (
                to_pixel[a, 3]
                + to_pixel[a, 0] * nodes[n, 0]
                + to_pixel[a, 1] * nodes[n, 1]
                + to_pixel[a, 2] * nodes[n, 2]
            )

    crossing = np.empty(len(tetrahedra), dtype=np.int32)
    kept = 0
    for e in range(len(tetrahedra)):
        a = pixel[tetrahedra[e, 0], 2]
        b = pixel[tetrahedra[e, 1], 2]
        c = pixel[tetrahedra[e, 2], 2]
        d = pixel[tetrahedra[e, 3], 2]
        if (
            min(min(a, b), min(c, d)) <= _ON_PLANE
            and max(max(a, b), max(c, d)) >= -_ON_PLANE
        ):  # fmt: skip
            crossing[kept] = e
            kept += 1

    barycentric = np.empty((kept, 4, 3))
    maps = np.empty((kept + 1, 3, 3))
    bounds = np.empty((kept, 4))
    count = 0
    skipped = 0
    for q in range(kept):
        e = crossing[q]
        box = _bounding_box(pixel, tetrahedra, e)
        if box[1] < 0.0 or box[0] > columns - 1 or box[3] < 0.0 or box[2] > rows - 1:
            continue
        determinant = _invert(pixel, tetrahedra, e, barycentric[count])
        if not is_solid(determinant, pixel_volume, determinants[e]):
            skipped += 1
            continue
        for a in range(3):
            for term in range(3):
                total = 0.0
                for k in range(4):
                    total += barycentric[count, k, term] * rest_index[tetrahedra[e, k], a]
                maps[count, a, term] = total
        bounds[count, 0] = box[0]
        bounds[count, 1] = box[1]
        bounds[count, 2] = box[2]
        bounds[count, 3] = box[3]
        crossing[count] = e  # which is not read again, as no more are kept than came
        count += 1
    return barycentric[:count], maps[: count + 1], bounds[:count], crossing[:count], skipped


@njit(inline="always", error_model="numpy")
def _bounding_box(pixel, tetrahedra, e):
    """Least and greatest column and row where a tetrahedron meets the plane, a little widened."""
    left = np.inf
    right = -np.inf
    top = np.inf
    bottom = -np.inf
    for k in range(4):
        m = tetrahedra[e, k]
        height = pixel[m, 2]
        if abs(height) <= _ON_PLANE:
            left = min(left, pixel[m, 0])
            right = max(right, pixel[m, 0])
            top = min(top, pixel[m, 1])
            bottom = max(bottom, pixel[m, 1])
        for other in range(k + 1, 4):
            n = tetrahedra[e, other]
            if height * pixel[n, 2] < 0.0:
                t = height / (height - pixel[n, 2])
                column = pixel[m, 0] + t * (pixel[n, 0] - pixel[m, 0])
                row = pixel[m, 1] + t * (pixel[n, 1] - pixel[m, 1])
                left = min(left, column)
                right = max(right, column)
                top = min(top, row)
                bottom = max(bottom, row)
    margin = 1e-6 * (1.0 + (right - left) + (bottom - top))
    return left - margin, right + margin, top - margin, bottom + margin


@njit(inline="always", error_model="numpy")
def _invert(pixel, tetrahedra, e, form):
    """Fills the (4, 3) barycentric map of a tetrahedron on the plane; returns its determinant."""
    determinant, to_1, to_2, to_3 = adjugate(
        pixel, tetrahedra[e, 0], tetrahedra[e, 1], tetrahedra[e, 2], tetrahedra[e, 3]
    )
    r = 1.0 / determinant
    for term in range(3):
        form[1, term] = r * to_1[term]
        form[2, term] = r * to_2[term]
        form[3, term] = r * to_3[term]
    form[0, 0] = 1.0 - form[1, 0] - form[2, 0] - form[3, 0]
    form[0, 1] = -form[1, 1] - form[2, 1] - form[3, 1]
    form[0, 2] = -form[1, 2] - form[2, 2] - form[3, 2]
    return determinant
