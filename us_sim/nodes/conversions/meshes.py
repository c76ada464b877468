"""Meshes: tetrahedra by their nodes, and surfaces."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Int32MultiArray, MultiArrayDimension

from us_sim.errors import MeshError
from us_sim.nodes.conversions.packing import packed


def tetrahedra_message(tetrahedra: NDArray[np.integer]) -> Int32MultiArray:
    """(M, 4) node indices."""
    message = Int32MultiArray()
    count = len(tetrahedra)
    message.layout.dim = [
        MultiArrayDimension(label="tetrahedron", size=count, stride=4 * count),
        MultiArrayDimension(label="node", size=4, stride=4),
    ]
    message.data = packed("i", tetrahedra.astype(np.int32))
    return message


def tetrahedra_from(message: Int32MultiArray) -> NDArray[np.int32]:
    """(M, 4) node indices.

    Raises:
        MeshError: the number of indices is not a multiple of four, or one is negative.
    """
    indices = np.frombuffer(message.data, dtype=np.int32)
    if len(indices) % 4:
        raise MeshError(f"{len(indices)} node indices do not make whole tetrahedra")
    if (indices < 0).any():
        raise MeshError(f"node index {indices.min()} is of no node: they count from 0")
    return indices.reshape(-1, 4)


def mesh_message(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> Mesh:
    """(N, 3) m and (T, 3) as a shape."""
    return Mesh(
        vertices=_points(vertices),
        triangles=[MeshTriangle(vertex_indices=triple.astype(np.uint32)) for triple in triangles],
    )


def mesh_from(message: Mesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (N, 3) m and triangles (T, 3) of a shape.

    Raises:
        MeshError: a vertex is not finite, or a triangle names one that is not there.
    """
    vertices = np.array([(p.x, p.y, p.z) for p in message.vertices]).reshape(-1, 3)
    indices = [triangle.vertex_indices for triangle in message.triangles]
    triangles = np.array(indices, dtype=np.int64).reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise MeshError("a vertex of the mesh is not finite")
    if triangles.size and triangles.max() >= len(vertices):
        raise MeshError(
            f"the mesh's triangles name vertex {triangles.max()}, but it has {len(vertices)}"
        )
    return vertices, triangles


def _points(vertices: NDArray[np.floating]) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in vertices.tolist()]
