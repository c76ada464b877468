"""A quick selection of the tetrahedra that an image may meet, by clusters of neighbours.

Tetrahedra that are near each other at rest stay near each other. They are kept in clusters, and a
cluster whose nodes all lie beyond one and the same side of the image is left out as a whole.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.cutting.clusters import Clusters
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> mesh = box_mesh([-0.02, 0.0, 0.02], [-0.021, -0.005, 0.01], [0.0, 0.02, 0.04])
>>> plane = LinearProbe(aperture=0.01, depth=0.01, columns=8, rows=8).plane(Pose())
>>> clusters = Clusters(mesh.nodes, mesh.tetrahedra)
>>> len(clusters.tetrahedra), len(clusters.near(mesh.nodes, plane))
(40, 10)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.kernels import njit
from us_sim.slicing.cutting.section import finite_nodes
from us_sim.slicing.probe.plane import SlicePlane

ON_PLANE = 1e-9
"""Pixels off the plane within which a node counts as on it: rounding."""

_SIZE = 128
"""Tetrahedra of a cluster: few enough to follow the plane, many enough to have most nodes in
common."""
_BLOCK = 256  # nodes that are tested together
_MARGIN = 1e-3
"""Pixels beyond the image's border at which a tetrahedron may be left out."""


class Clusters:
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

    def near(self, nodes: NDArray[np.float64], plane: SlicePlane) -> NDArray[np.int32]:
        """(K,) tetrahedra that are not wholly beyond one side of the image, ascending.

        The array is overwritten by the next call.

        Raises:
            MeshError: nodes that are not finite.
        """
        count = _near(
            nodes,
            plane.to_pixel,
            plane.columns,
            plane.rows,
            self.tetrahedra,
            self._starts,
            self._members,
            self._sides,
            self._near,
        )
        if count < 0:
            finite_nodes(nodes, None)
            raise MeshError("nodes are so far away that no slice can be cut: check their unit")
        return self._near[:count]


def _along_a_z_curve(nodes: NDArray[np.float64], tetrahedra: NDArray[np.int32]) -> NDArray[np.intp]:
    """(M,) the order of tetrahedra along a Z-order (Morton) curve through their centres."""
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
def _near(nodes, to_pixel, columns, rows, tetrahedra, starts, members, sides, near):
    """Fills ``near`` and returns how many there are, or -1 when a node is not finite.

    Args:
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
    """Which sides of the image each node is beyond; returns whether all nodes are finite."""
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
