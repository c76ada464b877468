"""Surfaces that come as markers, each triangle with corners of its own."""

from __future__ import annotations

from visualization_msgs.msg import MarkerArray

from us_sim.nodes.messages import triangles_from
from us_sim.viewer.meshes.coloured_surface import ColouredSurface
from us_sim.viewer.meshes.welded import welded


def surfaces_of(message: MarkerArray, frame: str) -> list[ColouredSurface]:
    """Of each namespace one, with shared vertices.

    Raises:
        MeshError: the corners do not make whole triangles, or one is not finite.
        MessageError: a marker is in another frame.
    """
    surfaces = []
    for name, colour, corners in triangles_from(message, frame):
        vertices, triangles = welded(corners)
        if len(triangles):
            surfaces.append(ColouredSurface(name, colour, vertices, triangles))
    return surfaces
