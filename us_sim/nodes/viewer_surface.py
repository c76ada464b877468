"""What the viewer knows of the surface on which the probe can be put."""

from __future__ import annotations

from collections.abc import Callable

from shape_msgs.msg import Mesh

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import mesh_from
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.viewer_feeds.rest_mesh import RestMesh
from us_sim.tracking.virtual_hand import RestSurface

_PLANE = 0.1
"""m around the origin, of the plane where nothing has a surface."""


class ViewerSurface:
    """The skin at rest; where the scene has none the tissue's upper side, else the plane z = 0.

    Args:
        node: that hears ``skin/mesh``.
        rest: the tissue's mesh.
        changed: called when there is another surface.
    """

    def __init__(self, node: GuardedNode, rest: RestMesh, changed: Callable[[], None]) -> None:
        self._node, self._rest, self._changed = node, rest, changed
        self._skin: RestSurface | None = None
        self._tissue: RestSurface | None = None
        self._plane = RestSurface.plane(_PLANE)
        self._heard = node.create_subscription(Mesh, "skin/mesh", self._take_skin, LATCHED)
        rest.watch(self._make_tissue)
        node.guarded(node.resolve_topic_name("tissue/rest"), self._make_tissue)()

    @property
    def best(self) -> RestSurface | None:
        """The surface; None while one is still awaited."""
        if self._skin is not None and (self._tissue is None or self._is_offered("skin/mesh")):
            return self._skin
        if self._tissue is not None:
            return self._tissue
        is_awaited = self._is_offered("skin/mesh") or self._is_offered("tissue/rest")
        return None if is_awaited else self._plane

    def close(self) -> None:
        """Hear no more."""
        self._node.destroy_subscription(self._heard)
        self._rest.watch(self._make_tissue, is_wanted=False)

    def _is_offered(self, topic: str) -> bool:
        return self._node.count_publishers(self._node.resolve_topic_name(topic)) > 0

    def _take_skin(self, message: Mesh) -> None:
        self._skin = RestSurface(*mesh_from(message))
        self._changed()

    def _make_tissue(self) -> None:
        """The tissue's upper side, of the mesh that is there now."""
        if self._rest.mesh is not None:
            self._tissue = RestSurface.upper_side(self._rest.mesh.nodes, self._rest.mesh.boundary)
            self._changed()
