"""Messages to values of the domain and back: the only place that knows their layouts.

A type allows values that the domain does not: numbers that are not finite, quaternions of zero
length, stamps that are no time, sizes that their buffers do not have. The readers here refuse
those in one sentence.

Bulk data are handed over as ``array.array('B', …)``, which rclpy takes without looking at each
element.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, TransformStamped, TwistStamped, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Float64MultiArray, Header, Int32MultiArray, MultiArrayDimension
from visualization_msgs.msg import Marker, MarkerArray

from us_sim.errors import (
    MeshError,
    MessageError,
    PoseError,
    ProbeError,
    StampError,
    TrackingError,
    VolumeError,
)
from us_sim.geometry.pose import Pose
from us_sim.tracking.haptic import ContactModel

CDR_LITTLE_ENDIAN = b"\0\1\0\0"  # what serialized messages begin with


def packed(code: str, values: NDArray[Any]) -> array[Any]:
    """All values in order, copied once (``array(code, bytes)`` takes forty times as long)."""
    data = array(code)
    data.frombytes(np.ascontiguousarray(values).ravel().view(np.uint8).data)
    return data


_SECOND = 1_000_000_000  # ns
_LAST = 2**31 - 1 - 86_400
"""s since 1970, a day before a stamp can count no further: what is added must be counted, too."""


def nanoseconds_of(stamp: Time) -> int:
    """The ns since 1970 of a stamp; 0 for one that was never set.

    Raises:
        StampError: it is no time: before 1970, with a second's worth of nanoseconds or more, or
            so late that ROS cannot count any further.
    """
    return nanoseconds_since(stamp.sec, stamp.nanosec)


def nanoseconds_since(seconds: int, nanoseconds: int) -> int:
    """Likewise, of a stamp's two parts."""
    if not 0 <= seconds <= _LAST or not 0 <= nanoseconds < _SECOND:
        raise StampError(
            f"the stamp of {seconds} s and {nanoseconds} ns is no time: let the sender stamp its "
            f"messages with its clock"
        )
    return int(_SECOND * seconds + nanoseconds)


def stamp_message(nanoseconds: int) -> Time:
    """The stamp of a time in ns since 1970; of 1970 itself where it is before.

    Raises:
        StampError: it is so late that ROS cannot count any further.
    """
    seconds, rest = divmod(max(int(nanoseconds), 0), _SECOND)
    if seconds > _LAST:
        raise StampError(f"a time of {seconds} s after 1970 is later than a stamp can say")
    return Time(sec=seconds, nanosec=rest)


def require_stamp(message: Any) -> None:
    """Check the stamp that a message has in its header, or as a clock.

    Raises:
        StampError: there is one, and it is no time.
    """
    header = getattr(message, "header", None)
    stamp = getattr(message, "clock", None) if header is None else header.stamp
    if stamp is not None:
        nanoseconds_of(stamp)


def require_frame(header: Header, frame: str | None) -> None:
    """Check the frame of a message; None is any.

    Raises:
        MessageError: it is another one.
    """
    if frame is not None and header.frame_id != frame:
        raise MessageError(f"is in frame '{header.frame_id}', not '{frame}'")


_FARTHEST_POSE = 1e7
"""m, beyond which a position is in another unit, or nonsense."""


def pose_from(message: PoseStamped, frame: str | None = None) -> Pose:
    """The pose in a message.

    Args:
        message: of any device or node.
        frame: that it must be in; None is any.

    Raises:
        PoseError: it is not finite, beyond any place, or its quaternion has no length to speak of.
        MessageError: it is in another frame.
    """
    require_frame(message.header, frame)
    return _pose(message.pose.position, message.pose.orientation)


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


def pose_from_text(text: str) -> Pose:
    """The pose in a text of `pose_text`.

    Raises:
        PoseError: it is no pose.
    """
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 7:
        raise PoseError(f"{text[:80]!r} is no pose: 7 numbers are one, x y z and a quaternion")
    return Pose(numbers[:3], numbers[3:])


def transform_from(message: TransformStamped) -> Pose:
    """The child's pose in the frame of a transform's header.

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


def wrench_from(message: WrenchStamped, frame: str | None = None) -> NDArray[np.float64]:
    """Force and torque (6,) N, N m about the origin of the message's frame.

    Raises:
        MessageError: a number is not finite, or it is in another frame.
    """
    require_frame(message.header, frame)
    f, t = message.wrench.force, message.wrench.torque
    wrench = np.array([f.x, f.y, f.z, t.x, t.y, t.z])
    if not np.isfinite(wrench).all():
        raise MessageError(f"the wrench is not finite: {wrench.tolist()}")
    return wrench


def twist_from(message: TwistStamped) -> NDArray[np.float64]:
    """Linear and angular velocity (6,) m/s, rad/s along the axes of the message's frame.

    Raises:
        MessageError: a number is not finite.
    """
    v, w = message.twist.linear, message.twist.angular
    twist = np.array([v.x, v.y, v.z, w.x, w.y, w.z])
    if not np.isfinite(twist).all():
        raise MessageError(f"the velocity is not finite: {twist.tolist()}")
    return twist


def wrench_serialized(wrench: NDArray[np.float64], stamp: int, frame: str) -> bytes:
    """Force and torque (6,) N, N m about the origin of ``frame`` at ns, as a WrenchStamped.

    Written here it takes a tenth of the time, for those who send a thousand a second.
    """
    name = frame.encode() + b"\0"
    head = struct.pack(f"@iII{len(name)}s0d", *divmod(stamp, 1_000_000_000), len(name), name)
    return CDR_LITTLE_ENDIAN + head + wrench.astype("<f8").tobytes()


_CONTACT_PARTS = (("stamp", 2), ("pose", 7), ("wrench", 6), ("stiffness", 36))
"""Numbers of a contact model: seconds and nanoseconds; position and quaternion of the probe;
force and torque; six rows of six."""


def contact_model_message(model: ContactModel) -> Float64MultiArray:
    """Stamp, pose, wrench and stiffness one after another, each a labelled dimension."""
    message = Float64MultiArray()
    left = sum(size for _, size in _CONTACT_PARTS)
    for label, size in _CONTACT_PARTS:
        message.layout.dim.append(MultiArrayDimension(label=label, size=size, stride=left))
        left -= size
    values = (divmod(model.stamp, 1_000_000_000), model.pose.position, model.pose.orientation)
    message.data = packed("d", np.concatenate([*values, model.wrench, model.stiffness.ravel()]))
    return message


def contact_model_from(message: Float64MultiArray) -> ContactModel:
    """The model of the contact in a message.

    Raises:
        TrackingError: it has other parts, or a number that cannot be.
        StampError: its stamp is no time.
    """
    parts = tuple((dimension.label, dimension.size) for dimension in message.layout.dim)
    values = np.array(message.data, dtype=np.float64)
    if parts != _CONTACT_PARTS or len(values) != 51 or not np.isfinite(values).all():
        raise TrackingError(
            f"a model of the contact needs {', '.join(f'{n} of {k}' for k, n in _CONTACT_PARTS)}, "
            f"51 finite numbers in all, not {len(values)} in {list(parts)}"
        )
    stamp = nanoseconds_since(int(values[0]), int(values[1]))
    try:
        pose = Pose(values[2:5], values[5:9])
    except PoseError as error:
        raise TrackingError(f"a model of the contact: {error}") from error
    return ContactModel(stamp, pose, values[9:15], values[15:].reshape(6, 6))


_KINDS = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
_FARTHEST = 1e6
"""m: coordinates beyond are no place, and their squares do not fit single precision for long."""


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
    message.data = packed("B", table)
    message.is_dense = True
    return message


def vectors_from(message: PointCloud2, frame: str | None = None) -> NDArray[np.float64]:
    """The x, y, z fields of a cloud, (N, 3) m.

    Args:
        message: of one row of points or of several.
        frame: that it must be in; None is any.

    Raises:
        MeshError: a field is missing, no float, or outside of its point; the data do not fill the
            stated size; a coordinate is not finite, or too large to be one.
        MessageError: it is in another frame.
    """
    require_frame(message.header, frame)
    # In Python's integers, which are as wide as need be.
    rows, columns, step = int(message.height), int(message.width), int(message.point_step)
    stride = int(message.row_step) if rows > 1 else columns * step
    kinds = {name: _kind_of(message, name) for name in "xyz"}
    needed = (rows - 1) * stride + columns * step if rows * columns else 0
    if stride < columns * step or len(message.data) < needed:
        raise MeshError(
            f"the point cloud holds {len(message.data)} bytes, but says it has {rows * columns} "
            f"points of {step} bytes" + (f" in rows of {stride} bytes" if rows > 1 else "")
        )
    vectors = np.empty((rows * columns, 3))
    for axis, (kind, offset) in enumerate(kinds.values() if len(vectors) else ()):
        grid = np.ndarray((rows, columns), kind, message.data, offset, (stride, step))
        vectors[:, axis] = grid.ravel()
    if not (np.abs(vectors) <= _FARTHEST).all():  # nor is it for what is no number
        raise MeshError(
            "the point cloud has a coordinate that is not finite, or beyond any place: it must be "
            "in metres"
        )
    return vectors


def _kind_of(message: PointCloud2, name: str) -> tuple[str, int]:
    """NumPy's name of a field's type, and where in its point it begins."""
    fields = {field.name: field for field in message.fields}
    field = fields.get(name)
    kind = _KINDS.get(field.datatype) if field is not None else None
    if field is None or kind is None or field.count > 1:
        raise MeshError(f"the point cloud has no float field for '{name}'; it needs x, y and z")
    offset, end = int(field.offset), int(field.offset) + int(kind[1])
    if end > message.point_step:
        raise MeshError(
            f"the point cloud's field '{name}' ends {end} bytes into a point of "
            f"{message.point_step} bytes"
        )
    return (">" if message.is_bigendian else "<") + kind, offset


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


_FIELD = re.compile(r"32FC([1-4])")
_LARGEST_OFFSET = 1e6  # m, of a pixel, or to the first one


def image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """A ``mono8`` image of (rows, columns) pixels."""
    return _image(pixels, "mono8", 1, stamp, frame)


def colour_image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """An ``rgb8`` image of (rows, columns, 3) pixels: red, green, blue."""
    return _image(pixels, "rgb8", 3, stamp, frame)


def bgr_image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """A ``bgr8`` image of (rows, columns, 3) pixels, as OpenCV has them."""
    return _image(pixels, "bgr8", 3, stamp, frame)


def field_message(values: NDArray[np.float32], stamp: Time, frame: str) -> Image:
    """A ``32FC…`` image of (rows, columns) values, or of (rows, columns, K); NaN is none there."""
    count = 1 if values.ndim == 2 else values.shape[2]
    return _image(values, f"32FC{count}", 4 * count, stamp, frame)


def _image(pixels: NDArray[Any], encoding: str, size: int, stamp: Time, frame: str) -> Image:
    message = Image(header=Header(stamp=stamp, frame_id=frame))
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.is_bigendian = 0
    message.step = size * message.width
    message.data = packed("B", pixels)
    return message


def pixels_from(message: Image) -> NDArray[np.uint8]:
    """The (rows, columns) pixels of a ``mono8`` image.

    Raises:
        VolumeError: another encoding, no pixels, or fewer bytes than the stated size.
    """
    if message.encoding not in ("mono8", "8UC1"):
        raise VolumeError(f"the image is {message.encoding}; it must be mono8")
    return rows_from(message, 1)


def colour_pixels_from(message: Image) -> NDArray[np.uint8]:
    """The (rows, columns, 3) pixels of an ``rgb8`` image: red, green, blue.

    Raises:
        VolumeError: another encoding, no pixels, or fewer bytes than the stated size.
    """
    if message.encoding != "rgb8":
        raise VolumeError(f"the image is {message.encoding}; it must be rgb8")
    return rows_from(message, 3).reshape(int(message.height), int(message.width), 3)


def field_from(message: Image) -> NDArray[np.float32]:
    """The (rows, columns, K) values of a ``32FC…`` image, (rows, columns) where K is 1.

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


def rows_from(message: Image, size: int) -> NDArray[np.uint8]:
    """The bytes of an image, row by row, without padding.

    Args:
        message: the image.
        size: bytes of a pixel.

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


def affine_message(matrix: NDArray[np.floating]) -> Float64MultiArray:
    """A (4, 4) affine map, row after row."""
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label="row", size=4, stride=16),
        MultiArrayDimension(label="column", size=4, stride=4),
    ]
    message.data = packed("d", matrix.astype(np.float64))
    return message


def affine_from(message: Float64MultiArray) -> NDArray[np.float64]:
    """The (4, 4) affine map in a message.

    Raises:
        ProbeError: it is no 4 by 4 matrix, its last row is not 0 0 0 1, or a number of it is not
            finite, or so large that products of it would not be.
    """
    sizes = tuple(dimension.size for dimension in message.layout.dim)
    strides = tuple(dimension.stride for dimension in message.layout.dim)
    count, offset = len(message.data), message.layout.data_offset
    if sizes != (4, 4) or strides[1] != 4 or count != offset + 16:
        raise ProbeError(
            f"the matrix has {count} numbers from {offset} on in dimensions {list(sizes)} with "
            f"strides {list(strides)}; it must be 4 by 4, row after row (strides 16 and 4)"
        )
    matrix = np.array(message.data[offset:], dtype=np.float64).reshape(4, 4)
    if not (
        (np.abs(matrix) <= _LARGEST_OFFSET).all() and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all()
    ):
        raise ProbeError(
            f"the matrix {matrix.tolist()} is not an affine map: give finite numbers, and "
            f"0 0 0 1 as the last row"
        )
    return matrix


Surface = tuple[str, tuple[float, float, float, float], NDArray[np.floating], NDArray[np.integer]]
"""A marker's namespace, its red, green, blue and alpha, (V, 3) m vertices and (T, 3) triangles."""

MarkedTriangles = tuple[str, tuple[float, float, float], NDArray[np.float64]]
"""A marker's namespace, its red, green and blue, and three (3 T, 3) m corners of each triangle."""

_LINE_WIDTH = 4e-4  # m, of an image's outline
_OUTLINE_COLOUR = (0.31, 0.70, 0.75, 1.0)

_FIRST_STAMP = 8
"""Where it is in a serialized array: after the encapsulation and the number of markers."""

_EMPTY = (1, b"\0")  # a string
_MARKER_TAIL = struct.pack(
    "@II1siII1sI1sIII1sI1sI1sI?",
    *(0, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, *_EMPTY, 0, False),
)
"""Fields of a Marker after its points: colors, textures, text and meshes, all empty."""


def surface_marker(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.integer],
    stamp: Time,
    frame: str,
    opacity: float,
) -> bytes:
    """A skin-coloured TRIANGLE_LIST marker, serialized; an opacity of 1 hides everything below."""
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
