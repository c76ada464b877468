"""A mesh at rest, and its tetrahedra that an image's plane may meet, found by clusters.

On the plane a tetrahedron's barycentric coordinates are affine in (1, column, row), and so is the
map from a pixel to where its tissue lay at rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.kernels import njit
from us_sim.slicing.probe.plane import SlicePlane

FLAT = 1e-6
"""Fraction of its rest volume below which a tetrahedron is flat: it has no interior to show."""


@njit(inline="always", error_model="numpy")
def compute_adjugate(place, n0, n1, n2, n3):
    """Compute a tetrahedron's determinant, and barycentric coordinates of its last three corners.

    Each is three coefficients, of 1, column and row, times the determinant.

    Shapes and units:
        place: (N, 3) column, row and height above the plane. n0 … n3: which four are the corners.
    """
    x0, y0, z0 = place[n0, 0], place[n0, 1], place[n0, 2]
    ax = place[n1, 0] - x0
    ay = place[n1, 1] - y0
    az = place[n1, 2] - z0
    bx = place[n2, 0] - x0
    by = place[n2, 1] - y0
    bz = place[n2, 2] - z0
    cx = place[n3, 0] - x0
    cy = place[n3, 1] - y0
    cz = place[n3, 2] - z0
    # Rows of the inverse of the matrix with columns a, b, c are b×c, c×a and a×b over a·(b×c).
    ux = by * cz - bz * cy
    uy = bz * cx - bx * cz
    uz = bx * cy - by * cx
    vx = cy * az - cz * ay
    vy = cz * ax - cx * az
    vz = cx * ay - cy * ax
    wx = ay * bz - az * by
    wy = az * bx - ax * bz
    wz = ax * by - ay * bx
    return (
        ax * ux + ay * uy + az * uz,
        (-(ux * x0 + uy * y0 + uz * z0), ux, uy),
        (-(vx * x0 + vy * y0 + vz * z0), vx, vy),
        (-(wx * x0 + wy * y0 + wz * z0), wx, wy),
    )


@njit(inline="always", error_model="numpy")
def is_solid(determinant, pixel_volume, rest_determinant):
    """Return True if a tetrahedron is neither inverted nor flat.

    ``pixel_volume`` is m³ per unit of the determinant, ``rest_determinant`` is m³.
    """
    size = determinant * pixel_volume * np.sign(rest_determinant)
    return size > FLAT * abs(rest_determinant)


INSIDE = -1e-9
"""Least barycentric coordinate of a point inside, so that rounding leaves no holes at faces."""


class RestMesh:
    """A mesh at rest in a volume.

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
        self.nodes = require_finite_nodes(nodes, None)
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


def require_finite_nodes(nodes: ArrayLike, count: int | None) -> NDArray[np.float64]:
    """Return node positions as the kernels take them: (N, 3) float64, contiguous and finite.

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


ON_PLANE = 1e-9  # pixels off the plane within which a node counts as on it: rounding
_SIZE = 128
"""Tetrahedra of a cluster: few enough to follow the plane, many enough to have most nodes in
common."""
_BLOCK = 256  # nodes that are tested together
_MARGIN = 1e-3  # pixels beyond the image's border at which a tetrahedron may be left out


class TetrahedronClusters:
    """A mesh's tetrahedra in an order in which neighbours are near each other.

    Args:
        rest_nodes: (N, 3) m. tetrahedra: (M, 4) int32.
    """

    order: NDArray[np.intp]  # (M,) index of each one in ``tetrahedra`` as passed
    tetrahedra: NDArray[np.int32]  # (M, 4), in that order

    def __init__(self, rest_nodes: NDArray[np.float64], tetrahedra: NDArray[np.int32]) -> None:
        self.order = _along_a_z_curve(rest_nodes, tetrahedra)
        self.tetrahedra = np.ascontiguousarray(tetrahedra[self.order])
        cluster = np.repeat(np.arange(len(tetrahedra), dtype=np.int64) // _SIZE, 4)
        count = max(len(rest_nodes), 1)
        once = np.unique(cluster * count + self.tetrahedra.ravel())
        clusters = -(-len(tetrahedra) // _SIZE)
        starts = np.searchsorted(once // count, np.arange(clusters + 1))
        # Nodes are tested by fours: each cluster repeats its first one up to a multiple of four.
        missing = -np.diff(starts) % 4
        once = np.insert(
            once, np.repeat(starts[:-1], missing), np.repeat(once[starts[:-1]], missing)
        )
        self._members = (once % count).astype(np.int32).reshape(-1, 4)
        self._starts = (starts + np.append(0, np.cumsum(missing))) // 4
        self._sides = np.empty(len(rest_nodes), dtype=np.uint8)
        self._near = np.empty(len(tetrahedra), dtype=np.int32)

    def find_near_plane(self, nodes: NDArray[np.float64], plane: SlicePlane) -> NDArray[np.int32]:
        """Return (K,) tetrahedra that are not wholly beyond one side of the image, ascending.

        The array is overwritten by the next call.

        Raises:
            MeshError: nodes that are not finite.
        """
        clusters = self.tetrahedra, self._starts, self._members, self._sides, self._near
        count = _near(nodes, plane.to_pixel, plane.columns, plane.rows, *clusters)
        if count < 0:
            require_finite_nodes(nodes, None)
            raise MeshError("nodes are so far away that no slice can be cut: check their unit")
        return self._near[:count]


def _along_a_z_curve(nodes: NDArray[np.float64], tetrahedra: NDArray[np.int32]) -> NDArray[np.intp]:
    """Return (M,) the order of tetrahedra along a Z-order (Morton) curve through their centres."""
    if not len(tetrahedra):
        return np.empty(0, dtype=np.intp)
    centres = nodes[tetrahedra].mean(axis=1)
    low = centres.min(axis=0)
    extent = float((centres.max(axis=0) - low).max()) or 1.0
    cell = ((centres - low) / extent * 1023.0).astype(np.int64)
    key = np.zeros(len(cell), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


@njit(cache=True, nogil=True, error_model="numpy")
def _near(nodes, to_pixel, columns, rows, tetrahedra, starts, members, sides, near):  # noqa: PLR0913
    """Fill ``near`` and return how many there are, or -1 when a node is not finite.

    Shapes and units:
        nodes: (N, 3) m. to_pixel: (3, 4) from m to column, row and height above the plane.
        starts (clusters + 1,), members (…, 4): the nodes of each cluster.
        sides: (N,) uint8 to work in: a bit for each side of the image that a node is beyond.
    """
    if not _find_sides(nodes, to_pixel, columns - 1 + _MARGIN, rows - 1 + _MARGIN, sides):
        return -1
    count = np.uint64(0)
    for cluster in range(len(starts) - 1):
        a = b = c = d = np.uint8(63)
        for k in range(starts[cluster], starts[cluster + 1]):
            i = np.uint64(k)
            a &= sides[np.uint32(members[i, 0])]
            b &= sides[np.uint32(members[i, 1])]
            c &= sides[np.uint32(members[i, 2])]
            d &= sides[np.uint32(members[i, 3])]
        if a & b & c & d:
            continue
        for k in range(cluster * _SIZE, min((cluster + 1) * _SIZE, len(tetrahedra))):
            e = np.uint64(k)
            near[count] = e
            both = sides[np.uint32(tetrahedra[e, 0])] & sides[np.uint32(tetrahedra[e, 1])]
            both &= sides[np.uint32(tetrahedra[e, 2])] & sides[np.uint32(tetrahedra[e, 3])]
            count += np.uint64(both == 0)
    return np.int64(count)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _find_sides(nodes, to_pixel, right, bottom, sides):
    """Fill the sides of the image that each node is beyond; return True if all are finite."""
    cx, cy, cz, c0 = to_pixel[0, 0], to_pixel[0, 1], to_pixel[0, 2], to_pixel[0, 3]
    rx, ry, rz, r0 = to_pixel[1, 0], to_pixel[1, 1], to_pixel[1, 2], to_pixel[1, 3]
    hx, hy, hz, h0 = to_pixel[2, 0], to_pixel[2, 1], to_pixel[2, 2], to_pixel[2, 3]
    x = np.empty(_BLOCK)
    y = np.empty(_BLOCK)
    z = np.empty(_BLOCK)
    unusable = 0
    # Coordinates are separated first: in one loop with the rest it is half as fast.
    for start in range(0, len(nodes), _BLOCK):
        count = min(_BLOCK, len(nodes) - start)
        for k in range(count):
            n = np.uint64(start + k)
            x[k] = nodes[n, 0]
            y[k] = nodes[n, 1]
            z[k] = nodes[n, 2]
        block = sides[start : start + count]
        for k in range(count):
            column = c0 + cx * x[k] + cy * y[k] + cz * z[k]
            row = r0 + rx * x[k] + ry * y[k] + rz * z[k]
            height = h0 + hx * x[k] + hy * y[k] + hz * z[k]
            unusable |= not abs(height) < np.inf
            block[k] = (
                (height > ON_PLANE) * 1
                | (height < -ON_PLANE) * 2
                | (column < -_MARGIN) * 4
                | (column > right) * 8
                | (row < -_MARGIN) * 16
                | (row > bottom) * 32
            )
    return not unusable
