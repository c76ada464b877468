"""The tissue's mesh at rest, which comes in two latched messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.errors import MeshError
from us_sim.nodes.conversions import tetrahedra_from, vectors_from
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.qos import LATCHED
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.meshes.rest_surface import RestSurface

__all__ = ["RestMesh"]


class RestMesh:
    """``tissue/rest`` and ``tissue/tetrahedra``, subscribed to while somebody wants them.

    Args:
        node: that subscribes.
        came: called, in the node's thread, when there is another mesh.
    """

    def __init__(self, node: GuardedNode, came: Callable[[], None]) -> None:
        self._node, self._came = node, came
        self._subscriptions: list[Any] = []
        self._rest: PointCloud2 | None = None
        self._tetrahedra: Int32MultiArray | None = None
        self.mesh: TetrahedralMesh | None = None
        self.surface: RestSurface | None = None  # its outer faces, with their edges

    def listen(self, on: bool) -> None:
        """Begin or end to hear them; the mesh is kept."""
        if on == bool(self._subscriptions):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        if on:
            self._subscriptions = [
                self._node.create_subscription(
                    PointCloud2, "tissue/rest", self._take_rest, LATCHED
                ),
                self._node.create_subscription(
                    Int32MultiArray, "tissue/tetrahedra", self._take_tetrahedra, LATCHED
                ),
            ]

    def _take_rest(self, message: PointCloud2) -> None:
        self._rest = message
        self._make(is_complete=False)

    def _take_tetrahedra(self, message: Int32MultiArray) -> None:
        self._tetrahedra = message
        self._make(is_complete=True)

    def _make(self, is_complete: bool) -> None:
        """Of the two a mesh, unless the second has still to follow the first of another scene."""
        if self._rest is None or self._tetrahedra is None:
            return
        nodes = vectors_from(self._rest, "patient")
        tetrahedra = tetrahedra_from(self._tetrahedra)
        if tetrahedra.max(initial=-1) + 1 != len(nodes):
            if not is_complete:
                return
            raise MeshError(
                f"the tissue has {len(nodes)} nodes at rest, and its tetrahedra name "
                f"{tetrahedra.max(initial=-1) + 1}: the two are not of the same mesh"
            )
        mesh = TetrahedralMesh(nodes, tetrahedra)
        faces = mesh.boundary
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        surface = RestSurface(nodes, faces, np.unique(edges, axis=0))
        if self.surface is not None and surface.number == self.surface.number:
            return
        self.mesh, self.surface = mesh, surface
        self._came()
