"""Markers of surfaces, for the eye."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from us_sim.nodes.conversions.packing import CDR_LITTLE_ENDIAN

__all__ = ["structure_markers", "surface_marker"]

Surface = tuple[str, tuple[float, float, float, float], NDArray[np.floating], NDArray[np.integer]]
"""A marker's namespace, its red, green, blue and alpha, (V, 3) m vertices and (T, 3) triangles."""

_EMPTY = (1, b"\0")  # a string
_MARKER_TAIL = struct.pack(
    "@II1siII1sI1sIII1sI1sI1sI?",
    *(0, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, *_EMPTY, 0, False),
)
"""What a Marker has after its points: colors, textures, text and meshes, all empty."""


def surface_marker(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], stamp: Time, frame: str
) -> bytes:
    """A skin-coloured TRIANGLE_LIST marker, serialized."""
    skin = ("skin", (0.85, 0.65, 0.55, 0.9), vertices, triangles)
    return b"".join([CDR_LITTLE_ENDIAN, *_marker(skin, stamp, frame, 0)])


def structure_markers(surfaces: Sequence[Surface], stamp: Time, frame: str) -> bytes:
    """A MarkerArray with a TRIANGLE_LIST of each surface in its own namespace, serialized."""
    parts = [CDR_LITTLE_ENDIAN, struct.pack("@I", len(surfaces))]
    for surface in surfaces:
        parts += _marker(surface, stamp, frame, sum(map(len, parts[1:])))
    return b"".join(parts)


def _marker(surface: Surface, stamp: Time, frame: str, offset: int) -> list[bytes]:
    """The parts of a serialized TRIANGLE_LIST marker that begins at that offset of a message.

    It holds three Point objects a triangle, too slow to make one by one. So the CDR is written
    here: native alignment in `struct` is CDR's, and ``0d`` aligns what follows.
    """
    namespace, colour, vertices, triangles = surface
    points = vertices.astype(np.float64)[triangles.ravel()]
    name, place = namespace.encode() + b"\0", frame.encode() + b"\0"
    identity, scale = (0, 0, 0, 0, 0, 0, 1), (1, 1, 1)
    before = offset % 8
    head = struct.pack(
        f"@{before}xiII{len(place)}sI{len(name)}siii10d4fiI?I" + ("0d" if len(points) else ""),
        *(stamp.sec, stamp.nanosec, len(place), place, len(name), name),
        *(0, Marker.TRIANGLE_LIST, Marker.ADD, *identity, *scale, *colour),
        *(0, 0, False, len(points)),
    )
    return [head[before:], points.tobytes(), _MARKER_TAIL]
