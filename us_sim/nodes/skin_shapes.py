"""Where the skin was at the latest poses, for images that ask how the face meets it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from us_sim.nodes.conversions import nanoseconds_of, vectors_from
from us_sim.nodes.scene_node import SceneNode
from us_sim.scene.building import skin_surface_of
from us_sim.slicing.b_mode import BMode

_REMEMBERED = 64


class SkinShapes:
    """``skin/nodes``, by their stamps.

    Live, an image does not wait for the skin, which is there before the tissue all but always; in
    lockstep it does, so that it is the same every time.

    Args:
        node: that makes the images.
        scanner: is told of the skin at rest.
        came: called when there is skin for a pose, in lockstep.
    """

    def __init__(self, node: SceneNode, scanner: BMode, came: Callable[[], None]) -> None:
        surface = skin_surface_of(node.scene)
        scanner.touch(surface.vertices, surface.triangles)
        self._node, self._came = node, came
        self._shape = surface.vertices.shape
        self._shapes: dict[int, NDArray[np.float64]] = {}
        node.listen(PointCloud2, "skin/nodes", self._take)

    def at(self, stamp: int) -> NDArray[np.float64] | None:
        """(V, 3) m, of a pose's stamp (ns); None where it has not come."""
        return self._shapes.get(stamp)

    def is_awaited(self, stamp: int) -> bool:
        """Whether an image of that stamp has to wait."""
        return self._node.lockstep and stamp not in self._shapes

    def _take(self, message: PointCloud2) -> None:
        vertices = vectors_from(message, "patient")
        if vertices.shape != self._shape:
            self._node.health.problem(
                "skin",
                f"skin/nodes has {len(vertices)} vertices, and the scene's skin {self._shape[0]}: "
                f"contact is with the tissue; start both with the same scene",
            )
            return
        self._shapes[nanoseconds_of(message.header.stamp)] = vertices
        while len(self._shapes) > _REMEMBERED:
            del self._shapes[next(iter(self._shapes))]
        if self._node.lockstep:
            self._came()
