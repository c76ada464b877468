"""Markers of surfaces and lines, for the eye: written, and read again."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from visualization_msgs.msg import Marker, MarkerArray

from us_sim.errors import MeshError, PoseError
from us_sim.geometry.pose import Pose
from us_sim.nodes.conversions.packing import CDR_LITTLE_ENDIAN
from us_sim.nodes.conversions.stamps import nanoseconds_since, require_frame

Surface = tuple[str, tuple[float, float, float, float], NDArray[np.floating], NDArray[np.integer]]
"""A marker's namespace, its red, green, blue and alpha, (V, 3) m vertices and (T, 3) triangles."""

MarkedTriangles = tuple[str, tuple[float, float, float], NDArray[np.float64]]
"""A marker's namespace, its red, green and blue, and three (3 T, 3) m corners of each triangle."""

_LINE_WIDTH = 4e-4
"""m, of an image's outline."""
_OUTLINE_COLOUR = (0.31, 0.70, 0.75, 1.0)

_FIRST_STAMP = 8
"""Where it is in a serialized array: after the encapsulation and the number of markers."""

_EMPTY = (1, b"\0")  # a string
_MARKER_TAIL = struct.pack(
    "@II1siII1sI1sIII1sI1sI1sI?",
    *(0, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, *_EMPTY, 0, False),
)
"""What a Marker has after its points: colors, textures, text and meshes, all empty."""


def surface_marker(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.integer],
    stamp: Time,
    frame: str,
    opacity: float,
) -> bytes:
    """A skin-coloured TRIANGLE_LIST marker, serialized; an opacity of 1 hides what lies below."""
    skin = ("skin", (0.85, 0.65, 0.55, opacity), vertices, triangles)
    return b"".join([CDR_LITTLE_ENDIAN, *_marker(skin, stamp, frame, 0)])


def structure_markers(surfaces: Sequence[Surface], stamp: Time, frame: str) -> bytes:
    """A MarkerArray with a TRIANGLE_LIST of each surface in its own namespace, serialized."""
    parts = [CDR_LITTLE_ENDIAN, struct.pack("@I", len(surfaces))]
    for surface in surfaces:
        parts += _marker(surface, stamp, frame, sum(map(len, parts[1:])))
    return b"".join(parts)


def transducer_markers(
    parts: Sequence[Surface], outline: NDArray[np.floating], stamp: Time, frame: str
) -> bytes:
    """The same with a LINE_STRIP around an image, (P, 3) m, as the last, serialized."""
    whole = [CDR_LITTLE_ENDIAN, struct.pack("@I", len(parts) + 1)]
    for part in parts:
        whole += _marker(part, stamp, frame, sum(map(len, whole[1:])))
    closed = np.concatenate([outline, outline[:1]]).astype(np.float64)
    whole += _serialized(
        *("image", Marker.LINE_STRIP, (_LINE_WIDTH, 0, 0), _OUTLINE_COLOUR, closed),
        *(stamp, frame, sum(map(len, whole[1:]))),
    )
    return b"".join(whole)


def triangles_from(message: MarkerArray, frame: str) -> list[MarkedTriangles]:
    """The triangles of each TRIANGLE_LIST that an array adds, those of a namespace together.

    Raises:
        MeshError: corners do not make whole triangles, or one is not finite.
        MessageError: a marker is in another frame.
    """
    corners: dict[str, list[NDArray[np.float64]]] = {}
    colours: dict[str, tuple[float, float, float]] = {}
    for marker in message.markers:
        if marker.type != Marker.TRIANGLE_LIST or marker.action != Marker.ADD or not marker.points:
            continue
        require_frame(marker.header, frame)
        points = _points_of(marker)
        if len(points) % 3:
            raise MeshError(f"{marker.ns}: {len(points)} corners do not make whole triangles")
        corners.setdefault(marker.ns, []).append(points)
        channels = np.nan_to_num([marker.color.r, marker.color.g, marker.color.b])
        red, green, blue = np.clip(channels, 0.0, 1.0).tolist()
        colours.setdefault(marker.ns, (red, green, blue))
    return [(name, colours[name], np.concatenate(found)) for name, found in corners.items()]


def line_from(message: MarkerArray, frame: str) -> NDArray[np.float64]:
    """(P, 3) m, the points of the first LINE_STRIP that an array adds, without the repeated last.

    Raises:
        MeshError: a point is not finite.
        MessageError: the marker is in another frame.
    """
    for marker in message.markers:
        if marker.type == Marker.LINE_STRIP and marker.action == Marker.ADD and marker.points:
            require_frame(marker.header, frame)
            points = _points_of(marker)
            return points[:-1] if (points[0] == points[-1]).all() else points
    return np.zeros((0, 3))


def markers_stamp(data: bytes) -> int | None:
    """The ns since 1970 at which the first marker of a serialized array is; None where it has none.

    Nothing else of it is decoded: an array may hold megabytes.

    Raises:
        StampError: it is no time.
    """
    order = "<" if data[1:2] == b"\1" else ">"
    if len(data) < _FIRST_STAMP + 8 or struct.unpack_from(f"{order}I", data, 4)[0] == 0:
        return None
    return nanoseconds_since(*struct.unpack_from(f"{order}iI", data, _FIRST_STAMP))


def _points_of(marker: Marker) -> NDArray[np.float64]:
    """(P, 3) m, in the marker's frame."""
    points = np.array([(p.x, p.y, p.z) for p in marker.points], dtype=np.float64)
    if not np.isfinite(points).all():
        raise MeshError(f"{marker.ns}: a point is not finite")
    p, q = marker.pose.position, marker.pose.orientation
    if q.x == q.y == q.z == q.w == 0.0:  # as of a message in which nobody set it
        q.w = 1.0
    try:
        pose = Pose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
    except PoseError as error:
        raise MeshError(f"{marker.ns}: {error}") from error
    return pose.apply(points)


def _marker(surface: Surface, stamp: Time, frame: str, offset: int) -> list[bytes]:
    """The parts of a serialized TRIANGLE_LIST marker that begins at that offset of a message."""
    namespace, colour, vertices, triangles = surface
    points = vertices.astype(np.float64)[triangles.ravel()]
    return _serialized(
        namespace, Marker.TRIANGLE_LIST, (1, 1, 1), colour, points, stamp, frame, offset
    )


def _serialized(
    namespace: str,
    kind: int,
    scale: tuple[float, float, float],
    colour: tuple[float, float, float, float],
    points: NDArray[np.float64],
    stamp: Time,
    frame: str,
    offset: int,
) -> list[bytes]:
    """The parts of a serialized marker of points (P, 3) m at that offset of a message.

    It holds an object for each point, too slow to make one by one. So the CDR is written here:
    native alignment in `struct` is CDR's, and ``0d`` aligns what follows.
    """
    name, place = namespace.encode() + b"\0", frame.encode() + b"\0"
    identity = (0, 0, 0, 0, 0, 0, 1)
    before = offset % 8
    head = struct.pack(
        f"@{before}xiII{len(place)}sI{len(name)}siii10d4fiI?I" + ("0d" if len(points) else ""),
        *(stamp.sec, stamp.nanosec, len(place), place, len(name), name),
        *(0, kind, Marker.ADD, *identity, *scale, *colour),
        *(0, 0, False, len(points)),
    )
    return [head[before:], points.tobytes(), _MARKER_TAIL]
