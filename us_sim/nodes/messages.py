"""Messages from values of the domain; `us_sim.recording.decoding` is the way back.

rclpy takes bulk data in ``array.array`` without a look at each element.
"""

from __future__ import annotations

import contextlib
import struct
from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, TransformStamped, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Float64MultiArray, Header, Int32MultiArray, MultiArrayDimension
from visualization_msgs.msg import Marker

from us_sim.errors import PoseError, StampError, TrackingError
from us_sim.geometry.pose import Pose
from us_sim.recording.decoding import LAST_SECOND, SECOND, to_nanoseconds
from us_sim.tracking.haptic import ContactModel

CDR_LITTLE_ENDIAN = b"\0\1\0\0"  # what serialized messages begin with
TFMessage: Any = None
"""The class of tf2_msgs; None where it is not installed: every ROS 2 has it, PyPI has not."""

with contextlib.suppress(ModuleNotFoundError):
    import tf2_msgs.msg

    TFMessage = tf2_msgs.msg.TFMessage


def pack_array(code: str, values: NDArray[Any]) -> array[Any]:
    """Copy all values in order, once (``array(code, bytes)`` takes forty times as long)."""
    data = array(code)
    data.frombytes(np.ascontiguousarray(values).ravel().view(np.uint8).data)
    return data


def stamp_message(nanoseconds: int) -> Time:
    """Make the stamp of a time in ns since 1970, at least 0.

    Raises:
        StampError: the time is too late for a stamp.
    """
    seconds, rest = divmod(max(int(nanoseconds), 0), SECOND)
    if seconds > LAST_SECOND:
        raise StampError(f"a time of {seconds} s after 1970 is later than a stamp can say")
    return Time(sec=seconds, nanosec=rest)


def pose_message(pose: Pose, stamp: Time, frame: str) -> PoseStamped:
    """Make the message of a pose in ``frame``."""
    message = PoseStamped(header=Header(stamp=stamp, frame_id=frame))
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = map(float, pose.position)
    q.x, q.y, q.z, q.w = map(float, pose.orientation)
    return message


def pose_text(pose: Pose) -> str:
    """Write position (m) and quaternion x, y, z, w as a value of diagnostics."""
    return " ".join(repr(float(number)) for number in (*pose.position, *pose.orientation))


def transform_message(pose: Pose, stamp: Time, frame: str, child: str) -> TransformStamped:
    """Make the message for tf of a pose of ``child`` in ``frame``."""
    message = TransformStamped(header=Header(stamp=stamp, frame_id=frame))
    message.child_frame_id = child
    t, q = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = map(float, pose.position)
    q.x, q.y, q.z, q.w = map(float, pose.orientation)
    return message


def wrench_message(
    force: NDArray[np.float64], torque: NDArray[np.float64], stamp: Time, frame: str
) -> WrenchStamped:
    """Make the message of a force (3,) N and torque (3,) N m about the origin of ``frame``."""
    message = WrenchStamped(header=Header(stamp=stamp, frame_id=frame))
    f, t = message.wrench.force, message.wrench.torque
    f.x, f.y, f.z = map(float, force)
    t.x, t.y, t.z = map(float, torque)
    return message


def serialize_wrench(wrench: NDArray[np.float64], stamp: int, frame: str) -> bytes:
    """Serialize a WrenchStamped of force and torque (6,) N, N m at ns; ten times rclpy's speed."""
    name = frame.encode() + b"\0"
    head = struct.pack(f"@iII{len(name)}s0d", *divmod(stamp, SECOND), len(name), name)
    return CDR_LITTLE_ENDIAN + head + wrench.astype("<f8").tobytes()


_LARGEST_OF_CONTACT = 1e10  # N, N/m or s: products of larger ones may become infinite


def contact_model_message(model: ContactModel) -> Float64MultiArray:
    """Make the message of 51 numbers, in SI units.

    Seconds and nanoseconds; position and quaternion of the probe; force and torque; the six rows
    of the stiffness.
    """
    values = (divmod(model.stamp, SECOND), model.pose.position, model.pose.orientation)
    numbers = np.concatenate([*values, model.wrench, model.stiffness.ravel()])
    return Float64MultiArray(data=pack_array("d", numbers))


def contact_model_from(message: Float64MultiArray) -> ContactModel:
    """Return the contact model of a message; refuse other counts, sizes or times."""
    values = np.array(message.data, dtype=np.float64)
    if len(values) != 51 or not (np.abs(values) <= _LARGEST_OF_CONTACT).all():
        raise TrackingError(
            f"a model of the contact is 51 numbers of a sensible size, not {len(values)} or others"
        )
    stamp = to_nanoseconds(int(values[0]), int(values[1]))
    try:
        pose = Pose(values[2:5], values[5:9])
    except PoseError as error:
        raise TrackingError(f"a model of the contact: {error}") from error
    return ContactModel(stamp, pose, values[9:15], values[15:].reshape(6, 6))


def cloud_message(columns: dict[str, NDArray[np.floating]], stamp: Time, frame: str) -> PointCloud2:
    """Make a float32 cloud whose fields are the ``columns``, each (N,), in their order."""
    table = np.column_stack(list(columns.values())).astype("<f4")
    message = PointCloud2(header=Header(stamp=stamp, frame_id=frame))
    message.height, message.width = 1, len(table)
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate(columns)
    ]
    message.point_step = 4 * table.shape[1]
    message.row_step = message.point_step * len(table)
    message.data = pack_array("B", table)
    message.is_dense = True
    return message


def tetrahedra_message(tetrahedra: NDArray[np.integer]) -> Int32MultiArray:
    """Make the message of the node indices (M, 4)."""
    return _table_message(Int32MultiArray(), "i", tetrahedra.astype(np.int32), "tetrahedron node")


def mesh_message(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> Mesh:
    """Make a mesh of vertices (N, 3) m and triangles (T, 3)."""
    return Mesh(
        vertices=[Point(x=x, y=y, z=z) for x, y, z in vertices.tolist()],
        triangles=[MeshTriangle(vertex_indices=triple.astype(np.uint32)) for triple in triangles],
    )


def image_message(
    pixels: NDArray[Any], stamp: Time, frame: str, encoding: str | None = None
) -> Image:
    """Make an image of (rows, columns) or (rows, columns, channels) pixels.

    By default bytes are grey values (``mono8``), or red, green and blue (``rgb8``), and float32 are
    values of as many channels (``32FC…``), where NaN is no value.
    """
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if encoding is None:
        of_bytes = "mono8" if channels == 1 else "rgb8"
        encoding = f"32FC{channels}" if pixels.dtype == np.float32 else of_bytes
    message = Image(header=Header(stamp=stamp, frame_id=frame))
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.step = pixels.itemsize * channels * message.width
    message.data = pack_array("B", pixels)
    return message


def affine_message(matrix: NDArray[np.floating]) -> Float64MultiArray:
    """Make the message of a (4, 4) affine map, row after row."""
    return _table_message(Float64MultiArray(), "d", matrix.astype(np.float64), "row column")


def _table_message(message: Any, code: str, table: NDArray[Any], labels: str) -> Any:
    """Fill a multi-array message with a table (N, 4), whose two dimensions have these labels."""
    rows, columns = labels.split()
    message.layout.dim = [
        MultiArrayDimension(label=rows, size=len(table), stride=table.size),
        MultiArrayDimension(label=columns, size=4, stride=4),
    ]
    message.data = pack_array(code, table)
    return message


class MarkerShape(NamedTuple):
    """Triangles or a line of a marker."""

    namespace: str
    colour: tuple[float, float, float, float]  # red, green, blue, alpha
    points: NDArray[np.floating]  # (P, 3) m, three of each triangle in a row
    line_width: float = 0.0  # m; 0: it is triangles


_EMPTY = (1, b"\0")  # a string
_MARKER_TAIL = struct.pack(
    "@II1siII1sI1sIII1sI1sI1sI?",
    *(0, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, *_EMPTY, 0, False),
)
"""Fields of a Marker after its points: colors, textures, text and meshes, all empty."""


def serialize_marker(shape: MarkerShape, stamp: Time, frame: str) -> bytes:
    """Serialize a Marker of a shape."""
    return b"".join([CDR_LITTLE_ENDIAN, *_serialized(shape, stamp, frame, 0)])


def serialize_markers(shapes: Sequence[MarkerShape], stamp: Time, frame: str) -> bytes:
    """Serialize a MarkerArray of shapes, each in its own namespace."""
    parts = [CDR_LITTLE_ENDIAN, struct.pack("@I", len(shapes))]
    for shape in shapes:
        parts += _serialized(shape, stamp, frame, sum(map(len, parts[1:])))
    return b"".join(parts)


def _serialized(shape: MarkerShape, stamp: Time, frame: str, offset: int) -> list[bytes]:
    """Serialize a marker that begins at an offset of a message; return its parts.

    rclpy would make an object for each point, which is too slow. Native alignment in `struct` is
    that of CDR, and ``0d`` aligns what follows.
    """
    name, place = shape.namespace.encode() + b"\0", frame.encode() + b"\0"
    kind = Marker.LINE_STRIP if shape.line_width else Marker.TRIANGLE_LIST
    scale = (shape.line_width, 0.0, 0.0) if shape.line_width else (1.0, 1.0, 1.0)
    identity = (0, 0, 0, 0, 0, 0, 1)
    before, count = offset % 8, len(shape.points)
    head = struct.pack(
        f"@{before}xiII{len(place)}sI{len(name)}siii10d4fiI?I" + ("0d" if count else ""),
        *(stamp.sec, stamp.nanosec, len(place), place, len(name), name),
        *(0, kind, Marker.ADD, *identity, *scale, *shape.colour, 0, 0, False, count),
    )
    return [head[before:], shape.points.astype(np.float64, copy=False).tobytes(), _MARKER_TAIL]
