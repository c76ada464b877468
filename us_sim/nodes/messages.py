"""Messages from values of the domain; `us_sim.recording.decoding` is the way back.

Bulk data are handed over as ``array.array('B', …)``, which rclpy takes without looking at each
element.
"""

from __future__ import annotations

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


def pack_array(code: str, values: NDArray[Any]) -> array[Any]:
    """All values in order, copied once (``array(code, bytes)`` takes forty times as long)."""
    data = array(code)
    data.frombytes(np.ascontiguousarray(values).ravel().view(np.uint8).data)
    return data


def stamp_message(nanoseconds: int) -> Time:
    """The stamp of a time in ns since 1970; of 1970 itself where it is before.

    Raises:
        StampError: it is so late that ROS cannot count any further.
    """
    seconds, rest = divmod(max(int(nanoseconds), 0), SECOND)
    if seconds > LAST_SECOND:
        raise StampError(f"a time of {seconds} s after 1970 is later than a stamp can say")
    return Time(sec=seconds, nanosec=rest)


def pose_message(pose: Pose, stamp: Time, frame: str) -> PoseStamped:
    """``pose`` of the probe in ``frame``."""
    message = PoseStamped(header=Header(stamp=stamp, frame_id=frame))
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = map(float, pose.position)
    q.x, q.y, q.z, q.w = map(float, pose.orientation)
    return message


def pose_text(pose: Pose) -> str:
    """Position (m) and quaternion x, y, z, w, as a value of diagnostics."""
    return " ".join(repr(float(number)) for number in (*pose.position, *pose.orientation))


def transform_message(pose: Pose, stamp: Time, frame: str, child: str) -> TransformStamped:
    """The same transform for tf."""
    message = TransformStamped(header=Header(stamp=stamp, frame_id=frame))
    message.child_frame_id = child
    t, q = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = map(float, pose.position)
    q.x, q.y, q.z, q.w = map(float, pose.orientation)
    return message


def wrench_message(
    force: NDArray[np.float64], torque: NDArray[np.float64], stamp: Time, frame: str
) -> WrenchStamped:
    """Force (3,) N and torque (3,) N m about the origin of ``frame``."""
    message = WrenchStamped(header=Header(stamp=stamp, frame_id=frame))
    f, t = message.wrench.force, message.wrench.torque
    f.x, f.y, f.z = map(float, force)
    t.x, t.y, t.z = map(float, torque)
    return message


def serialize_wrench(wrench: NDArray[np.float64], stamp: int, frame: str) -> bytes:
    """Force and torque (6,) N, N m about the origin of ``frame`` at ns, as a WrenchStamped.

    Written here it takes a tenth of the time, for those who send a thousand a second.
    """
    name = frame.encode() + b"\0"
    head = struct.pack(f"@iII{len(name)}s0d", *divmod(stamp, 1_000_000_000), len(name), name)
    return CDR_LITTLE_ENDIAN + head + wrench.astype("<f8").tobytes()


_LARGEST_OF_CONTACT = 1e10  # N, N/m or s: products of larger ones would end in a hand as infinite


def contact_model_message(model: ContactModel) -> Float64MultiArray:
    """Make one of 51 numbers, in SI units.

    Seconds and nanoseconds; position and quaternion of the probe; force and torque; the six rows
    of the stiffness.
    """
    values = (divmod(model.stamp, SECOND), model.pose.position, model.pose.orientation)
    numbers = np.concatenate([*values, model.wrench, model.stiffness.ravel()])
    return Float64MultiArray(data=pack_array("d", numbers))


def contact_model_from(message: Float64MultiArray) -> ContactModel:
    """Return the model of the contact in a message.

    Raises:
        TrackingError: it has other parts, or a number that cannot be.
        StampError: its stamp is no time.
    """
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
    """A float32 cloud whose fields are the ``columns``, each (N,), in their order."""
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
    """(M, 4) node indices."""
    message = Int32MultiArray()
    count = len(tetrahedra)
    message.layout.dim = [
        MultiArrayDimension(label="tetrahedron", size=count, stride=4 * count),
        MultiArrayDimension(label="node", size=4, stride=4),
    ]
    message.data = pack_array("i", tetrahedra.astype(np.int32))
    return message


def mesh_message(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> Mesh:
    """(N, 3) m and (T, 3) as a shape."""
    return Mesh(
        vertices=[Point(x=x, y=y, z=z) for x, y, z in vertices.tolist()],
        triangles=[MeshTriangle(vertex_indices=triple.astype(np.uint32)) for triple in triangles],
    )


def image_message(
    pixels: NDArray[Any], stamp: Time, frame: str, encoding: str | None = None
) -> Image:
    """Make an image of (rows, columns) or (rows, columns, channels) pixels.

    Args:
        pixels: by default bytes are grey values (``mono8``), or red, green and blue (``rgb8``);
            float32 are values of as many channels (``32FC…``), where NaN is none there.
        stamp, frame: of its header.
        encoding: another one, such as ``bgr8``.
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
    """A (4, 4) affine map, row after row."""
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label="row", size=4, stride=16),
        MultiArrayDimension(label="column", size=4, stride=4),
    ]
    message.data = pack_array("d", matrix.astype(np.float64))
    return message


class MarkerShape(NamedTuple):
    """Triangles or a line, as a marker shows them."""

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
    """Make the serialized Marker of a shape."""
    return b"".join([CDR_LITTLE_ENDIAN, *_serialized(shape, stamp, frame, 0)])


def serialize_markers(shapes: Sequence[MarkerShape], stamp: Time, frame: str) -> bytes:
    """Make the serialized MarkerArray of shapes, each in its own namespace."""
    parts = [CDR_LITTLE_ENDIAN, struct.pack("@I", len(shapes))]
    for shape in shapes:
        parts += _serialized(shape, stamp, frame, sum(map(len, parts[1:])))
    return b"".join(parts)


def _serialized(shape: MarkerShape, stamp: Time, frame: str, offset: int) -> list[bytes]:
    """Make the parts of a serialized marker that begins at that offset of a message.

    It holds an object for each point, too slow to make one by one. So the CDR is written here:
    native alignment in `struct` is CDR's, and ``0d`` aligns what follows.
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
