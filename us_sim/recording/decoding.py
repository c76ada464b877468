"""Values of the domain from messages, as rclpy or rosbags decode them.

A type allows values that the domain does not: numbers that are not finite, quaternions of zero
length, stamps that are no time, sizes that their buffers do not have. Those are refused in one
sentence.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import (
    FrameError,
    MeshError,
    MessageError,
    PoseError,
    ProbeError,
    StampError,
    VolumeError,
)
from us_sim.geometry.pose import Pose

SECOND = 1_000_000_000  # ns
LAST_SECOND = 2**31 - 1 - 86_400
"""s since 1970, a day before a stamp can count no further: what is added must be counted, too."""
_TRIANGLE_LIST, _LINE_STRIP, _ADD = 11, 4, 0  # of visualization_msgs/Marker


def nanoseconds_of(stamp: Any) -> int:
    """Return the ns since 1970 of a stamp; 0 for one that was never set.

    Raises:
        StampError: it is no time: before 1970, with a second's worth of nanoseconds or more, or
            so late that ROS cannot count any further.
    """
    return to_nanoseconds(stamp.sec, stamp.nanosec)


def to_nanoseconds(seconds: int, nanoseconds: int) -> int:
    """Return the ns since 1970 of a stamp's two parts.

    Raises:
        StampError: it is no time.
    """
    if not 0 <= seconds <= LAST_SECOND or not 0 <= nanoseconds < SECOND:
        raise StampError(
            f"the stamp of {seconds} s and {nanoseconds} ns is no time: let the sender stamp its "
            f"messages with its clock"
        )
    return int(SECOND * seconds + nanoseconds)


def read_stamp(data: bytes, begin: int = 4) -> int:
    """Read the ns since 1970 with which a serialized message's header begins.

    Nothing else of it is decoded: it may hold megabytes.

    Raises:
        struct.error, IndexError: it is too short to have a stamp.
    """
    seconds, nanoseconds = struct.unpack_from(f"{_order_of(data)}iI", data, begin)
    return int(SECOND * seconds + nanoseconds)


def read_first_stamp(data: bytes) -> int | None:
    """Read the stamp of the first of a serialized sequence of messages; None for an empty one."""
    (count,) = struct.unpack_from(f"{_order_of(data)}I", data, 4)
    return read_stamp(data, 8) if count else None


def _order_of(data: bytes) -> str:
    """Return the order of bytes that the encapsulation of a serialized message states."""
    return "<" if data[1] & 1 else ">"


def require_frame(header: Any, frame: str | None) -> None:
    """Check the frame of a message; None is any.

    Raises:
        FrameError: it is another one.
    """
    if frame is not None and header.frame_id != frame:
        raise FrameError(f"is in frame '{header.frame_id}', not '{frame}'")


_FARTHEST_POSE = 1e7
"""m, beyond which a position is in another unit, or nonsense."""


def pose_from(message: Any, frame: str | None = None) -> Pose:
    """Return the pose in a message, of any frame or of the one that it must be in.

    Raises:
        PoseError: it is not finite, beyond any place, or its quaternion has no length to speak of.
        FrameError: it is in another frame.
    """
    require_frame(message.header, frame)
    return _pose(message.pose.position, message.pose.orientation)


def pose_from_text(text: str) -> Pose:
    """Read the pose in a text of `pose_text`.

    Raises:
        PoseError: it is no pose.
    """
    try:
        x, y, z, *quaternion = map(float, text.split())
        return Pose(np.array([x, y, z]), np.array(quaternion).reshape(4))
    except ValueError:
        told = f"{text[:80]!r} is no pose: 7 numbers are one, x y z and a quaternion"
        raise PoseError(told) from None


def transform_from(message: Any) -> Pose:
    """Return the child's pose in the frame of a transform's header.

    Raises:
        PoseError: as for `pose_from`.
    """
    return _pose(message.transform.translation, message.transform.rotation)


def _pose(p: Any, q: Any) -> Pose:
    pose = Pose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
    if max(map(abs, (p.x, p.y, p.z))) > _FARTHEST_POSE:
        raise PoseError(
            f"the pose is at ({p.x:.3g}, {p.y:.3g}, {p.z:.3g}) m, which is no place: positions are "
            f"in metres"
        )
    return pose


def wrench_from(message: Any, frame: str | None = None) -> NDArray[np.float64]:
    """Return force and torque (6,) N, N m about the origin of the message's frame.

    Raises:
        MessageError: a number is not finite.
        FrameError: it is in another frame.
    """
    require_frame(message.header, frame)
    return _six_numbers("wrench", message.wrench.force, message.wrench.torque)


def twist_from(message: Any) -> NDArray[np.float64]:
    """Return linear and angular velocity (6,) m/s, rad/s along the axes of the message's frame.

    Raises:
        MessageError: a number is not finite.
    """
    return _six_numbers("velocity", message.twist.linear, message.twist.angular)


def _six_numbers(what: str, linear: Any, angular: Any) -> NDArray[np.float64]:
    numbers = _points([linear, angular]).ravel()
    if not np.isfinite(numbers).all():
        raise MessageError(f"the {what} is not finite: {numbers.tolist()}")
    return numbers


def _points(points: Iterable[Any]) -> NDArray[np.float64]:
    """Return x, y and z (N, 3) of points or vectors."""
    return np.array([(p.x, p.y, p.z) for p in points], dtype=np.float64).reshape(-1, 3)


_KINDS = {7: "f4", 8: "f8"}  # by sensor_msgs/PointField's FLOAT32 and FLOAT64
_FARTHEST = 1e6
"""m: coordinates beyond are no place, and their squares do not fit single precision for long."""


def vectors_from(message: Any, frame: str | None = None) -> NDArray[np.float64]:
    """Return the x, y, z fields of a cloud, (N, 3) m.

    Args:
        message: of points one after the other.
        frame: that it must be in; None is any.

    Raises:
        MeshError: a field is missing, no float, or outside of its point; the data do not fill the
            stated size; a coordinate is not finite, or too large to be one.
        FrameError: it is in another frame.
    """
    require_frame(message.header, frame)
    fields = {field.name: field for field in message.fields}
    count, order = int(message.height) * int(message.width), "<>"[message.is_bigendian]
    try:
        layout: Any = {
            "names": ["x", "y", "z"],
            "formats": [order + _KINDS[fields[name].datatype] for name in "xyz"],
            "offsets": [fields[name].offset for name in "xyz"],
            "itemsize": message.point_step,
        }
        if max(layout["offsets"]) >= message.point_step:  # NumPy's own check can overflow
            raise ValueError("a field is outside of its point")
        points = np.ndarray(count, np.dtype(layout), message.data)
    except KeyError as error:
        raise MeshError(f"the point cloud has no float field for {error} of x, y and z") from None
    except (ValueError, TypeError, OverflowError, MemoryError) as error:
        raise MeshError(
            f"the point cloud's {len(message.data)} bytes are not its {count} points of "
            f"{message.point_step} bytes: {error}"
        ) from None
    vectors = np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)
    if not (np.abs(vectors) <= _FARTHEST).all():  # nor is it for what is no number
        raise MeshError(
            "the point cloud has a coordinate that is not finite, or beyond any place: it must be "
            "in metres"
        )
    return vectors


def tetrahedra_from(message: Any) -> NDArray[np.int32]:
    """Return (M, 4) node indices.

    Raises:
        MeshError: the number of indices is not a multiple of four, or one is negative.
    """
    indices = np.frombuffer(message.data, dtype=np.int32)
    if len(indices) % 4:
        raise MeshError(f"{len(indices)} node indices do not make whole tetrahedra")
    if (indices < 0).any():
        raise MeshError(f"node index {indices.min()} is of no node: they count from 0")
    return indices.reshape(-1, 4)


def mesh_from(message: Any) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices (N, 3) m and triangles (T, 3) of a shape.

    Raises:
        MeshError: a vertex is not finite, or a triangle names one that is not there.
    """
    vertices = _points(message.vertices)
    indices = [triangle.vertex_indices for triangle in message.triangles]
    triangles = np.array(indices, dtype=np.int64).reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise MeshError("a vertex of the mesh is not finite")
    if triangles.size and triangles.max() >= len(vertices):
        raise MeshError(
            f"the mesh's triangles name vertex {triangles.max()}, but it has {len(vertices)}"
        )
    return vertices, triangles


_FIELD = re.compile(r"32FC([1-4])")
_LARGEST_OFFSET = 1e6  # m, of a pixel, or to the first one


def pixels_from(message: Any, encoding: str = "mono8") -> NDArray[np.uint8]:
    """Return the pixels of an image, (rows, columns) of ``mono8``, (rows, columns, 3) of ``rgb8``.

    Raises:
        VolumeError: another encoding, no pixels, or fewer bytes than the stated size.
    """
    if message.encoding not in (encoding, "8UC1" if encoding == "mono8" else encoding):
        raise VolumeError(f"the image is {message.encoding}; it must be {encoding}")
    if encoding == "mono8":
        return rows_from(message, 1)
    return rows_from(message, 3).reshape(int(message.height), int(message.width), 3)


def field_from(message: Any) -> NDArray[np.float32]:
    """Return (rows, columns, K) values of a ``32FC…`` image, (rows, columns) where K is 1.

    Raises:
        VolumeError: another encoding, big-endian values, no pixels, or fewer bytes than the stated
            size.
    """
    form = _FIELD.fullmatch(message.encoding)
    if form is None or message.is_bigendian:
        what = f"big-endian {message.encoding}" if message.is_bigendian else message.encoding
        raise VolumeError(f"the image is {what}; it must be 32FC1 to 32FC4, little-endian")
    count = int(form[1])
    values = np.ascontiguousarray(rows_from(message, 4 * count)).view("<f4")
    rows, columns = int(message.height), int(message.width)
    return values.reshape((rows, columns) if count == 1 else (rows, columns, count))


def rows_from(message: Any, size: int) -> NDArray[np.uint8]:
    """Return the bytes of an image, ``size`` of a pixel, row by row, without padding.

    Raises:
        VolumeError: no pixels, or fewer bytes than the stated size.
    """
    rows, columns = int(message.height), int(message.width)
    step = int(message.step) or size * columns
    if not rows or not columns or step < size * columns or len(message.data) < rows * step:
        bytes_each = f" of {size} bytes" if size > 1 else ""
        raise VolumeError(
            f"the image holds {len(message.data)} bytes, but says it has {rows} rows of {columns} "
            f"pixels{bytes_each} in {step} bytes each"
        )
    flat = np.frombuffer(message.data, dtype=np.uint8, count=rows * step)
    return flat.reshape(rows, step)[:, : size * columns]


def affine_from(message: Any) -> NDArray[np.float64]:
    """Return the (4, 4) affine map in a message.

    Raises:
        ProbeError: it is no 4 by 4 matrix, its last row is not 0 0 0 1, or a number of it is not
            finite, or so large that products of it would not be.
    """
    if len(message.data) != 16:
        raise ProbeError(f"the matrix has {len(message.data)} numbers; it must be 4 by 4")
    matrix = np.array(message.data, dtype=np.float64).reshape(4, 4)
    if not (
        (np.abs(matrix) <= _LARGEST_OFFSET).all() and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all()
    ):
        raise ProbeError(
            f"the matrix {matrix.tolist()} is not an affine map: give finite numbers, and "
            f"0 0 0 1 as the last row"
        )
    return matrix


MarkedTriangles = tuple[str, tuple[float, float, float], NDArray[np.float64]]
"""A marker's namespace, its red, green and blue, and three (3 T, 3) m corners of each triangle."""


def triangles_from(message: Any, frame: str) -> list[MarkedTriangles]:
    """Return the triangles of each TRIANGLE_LIST that is added, those of a namespace together.

    Raises:
        MeshError: corners do not make whole triangles, or one is not finite.
        FrameError: a marker is in another frame.
    """
    corners: dict[str, list[NDArray[np.float64]]] = {}
    colours: dict[str, tuple[float, float, float]] = {}
    for marker in message.markers:
        if marker.type != _TRIANGLE_LIST or marker.action != _ADD or not marker.points:
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


def line_from(message: Any, frame: str) -> NDArray[np.float64]:
    """Return (P, 3) m, the first LINE_STRIP that is added, without the repeated last point.

    Raises:
        MeshError: a point is not finite.
        FrameError: the marker is in another frame.
    """
    for marker in message.markers:
        if marker.type == _LINE_STRIP and marker.action == _ADD and marker.points:
            require_frame(marker.header, frame)
            points = _points_of(marker)
            return points[:-1] if (points[0] == points[-1]).all() else points
    return np.zeros((0, 3))


def _points_of(marker: Any) -> NDArray[np.float64]:
    """Return (P, 3) m, in the marker's frame."""
    points = _points(marker.points)
    if not np.isfinite(points).all():
        raise MeshError(f"{marker.ns}: a point is not finite")
    p, q = marker.pose.position, marker.pose.orientation
    if q.x == q.y == q.z == q.w == 0.0:  # as of a message in which nobody set it
        q.w = 1.0
    try:
        pose = Pose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
    except PoseError as error:
        raise MeshError(f"{marker.ns}: {error}") from error
    return pose.transform_points(points)
