"""Messages to arrays and arrays to messages: the only place that knows their layouts.

Bulk data are handed over as ``array.array('B', …)``, which rclpy takes without looking at each
element.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, TransformStamped, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Float64MultiArray, Int32MultiArray, MultiArrayDimension
from visualization_msgs.msg import Marker

from us_sim.errors import MeshError, PoseError, ProbeError, TrackingError, VolumeError
from us_sim.geometry.pose import Pose
from us_sim.tracking.haptic.contact_model import ContactModel

__all__ = [
    "affine_from",
    "affine_message",
    "bgr_image_message",
    "cloud_message",
    "colour_image_message",
    "contact_model_from",
    "contact_model_message",
    "image_message",
    "mesh_message",
    "pixels_from",
    "pose_from",
    "pose_message",
    "structure_markers",
    "surface_marker",
    "tetrahedra_from",
    "tetrahedra_message",
    "transform_from",
    "transform_message",
    "vectors_from",
    "wrench_message",
    "wrench_serialized",
]

Surface = tuple[str, tuple[float, float, float, float], NDArray[np.floating], NDArray[np.integer]]
"""A marker's namespace, its red, green, blue and alpha, (V, 3) m vertices and (T, 3) triangles."""

_CDR_LITTLE_ENDIAN = b"\0\1\0\0"
_EMPTY = (1, b"\0")  # a string
_MARKER_TAIL = struct.pack(
    "@II1siII1sI1sIII1sI1sI1sI?",
    *(0, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, 0, 0, *_EMPTY, *_EMPTY, *_EMPTY, 0, False),
)
"""What a Marker has after its points: colors, textures, text and meshes, all empty."""


def pose_from(message: PoseStamped) -> Pose:
    """The pose in a message.

    Raises:
        PoseError: it is not finite, or its quaternion is zero.
    """
    p, q = message.pose.position, message.pose.orientation
    return Pose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))


def pose_message(pose: Pose, stamp: Time, frame: str) -> PoseStamped:
    """``pose`` of the probe in ``frame``."""
    message = PoseStamped()
    message.header.stamp = stamp
    message.header.frame_id = frame
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = map(float, pose.position)
    q.x, q.y, q.z, q.w = map(float, pose.orientation)
    return message


def transform_from(message: TransformStamped) -> Pose:
    """The child's pose in the frame of a transform's header.

    Raises:
        PoseError: it is not finite, or its quaternion is zero.
    """
    t, q = message.transform.translation, message.transform.rotation
    return Pose(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))


def transform_message(pose: Pose, stamp: Time, frame: str, child: str) -> TransformStamped:
    """The same transform for tf."""
    message = TransformStamped()
    message.header.stamp = stamp
    message.header.frame_id = frame
    message.child_frame_id = child
    t, q = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = map(float, pose.position)
    q.x, q.y, q.z, q.w = map(float, pose.orientation)
    return message


def wrench_message(
    force: NDArray[np.float64], torque: NDArray[np.float64], stamp: Time, frame: str
) -> WrenchStamped:
    """Force (3,) N and torque (3,) N m about the origin of ``frame``."""
    message = WrenchStamped()
    message.header.stamp = stamp
    message.header.frame_id = frame
    f, t = message.wrench.force, message.wrench.torque
    f.x, f.y, f.z = map(float, force)
    t.x, t.y, t.z = map(float, torque)
    return message


def wrench_serialized(wrench: NDArray[np.float64], stamp: int, frame: str) -> bytes:
    """Force and torque (6,) N, N m about the origin of ``frame`` at ns, as a WrenchStamped.

    Written here it takes a tenth of the time, for those who send a thousand a second.
    """
    name = frame.encode() + b"\0"
    head = struct.pack(f"@iII{len(name)}s0d", *divmod(stamp, 1_000_000_000), len(name), name)
    return _CDR_LITTLE_ENDIAN + head + wrench.astype("<f8").tobytes()


def image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """A ``mono8`` image of (rows, columns) pixels."""
    return _image(pixels, "mono8", 1, stamp, frame)


def colour_image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """An ``rgb8`` image of (rows, columns, 3) pixels: red, green, blue."""
    return _image(pixels, "rgb8", 3, stamp, frame)


def bgr_image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """A ``bgr8`` image of (rows, columns, 3) pixels, as OpenCV has them."""
    return _image(pixels, "bgr8", 3, stamp, frame)


def _image(pixels: NDArray[np.uint8], encoding: str, size: int, stamp: Time, frame: str) -> Image:
    message = Image()
    message.header.stamp = stamp
    message.header.frame_id = frame
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.is_bigendian = 0
    message.step = size * message.width
    message.data = _packed("B", pixels)
    return message


def pixels_from(message: Image) -> NDArray[np.uint8]:
    """The (rows, columns) pixels of a ``mono8`` image.

    Raises:
        VolumeError: another encoding, or fewer bytes than the stated size.
    """
    if message.encoding not in ("mono8", "8UC1"):
        raise VolumeError(f"the image is {message.encoding}; it must be mono8")
    step = message.step or message.width
    if len(message.data) < message.height * step:
        raise VolumeError(
            f"the image holds {len(message.data)} bytes, but says it has {message.height} rows "
            f"of {step}"
        )
    rows = np.frombuffer(message.data, dtype=np.uint8, count=message.height * step)
    return rows.reshape(message.height, step)[:, : message.width]


def cloud_message(columns: dict[str, NDArray[np.floating]], stamp: Time, frame: str) -> PointCloud2:
    """A float32 cloud whose fields are the ``columns``, each (N,), in their order."""
    table = np.column_stack(list(columns.values())).astype("<f4")
    message = PointCloud2()
    message.header.stamp = stamp
    message.header.frame_id = frame
    message.height, message.width = 1, len(table)
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate(columns)
    ]
    message.point_step = 4 * table.shape[1]
    message.row_step = message.point_step * len(table)
    message.data = _packed("B", table)
    message.is_dense = True
    return message


def vectors_from(message: PointCloud2) -> NDArray[np.float64]:
    """The x, y, z fields of a cloud, (N, 3).

    Raises:
        MeshError: a field is missing or not a float, or the data do not fill the stated size.
    """
    kinds = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    try:
        chosen = [fields[name] for name in "xyz"]
        formats = [order + kinds[field.datatype] for field in chosen]
    except KeyError as error:
        raise MeshError(
            f"the point cloud has no float field for {error}; it needs x, y and z"
        ) from error
    count = message.width * message.height
    if len(message.data) < count * message.point_step:
        raise MeshError(
            f"the point cloud holds {len(message.data)} bytes, but says it has {count} points "
            f"of {message.point_step} bytes"
        )
    layout = np.dtype(
        {
            "names": list("xyz"),
            "formats": formats,
            "offsets": [field.offset for field in chosen],
            "itemsize": message.point_step,
        }
    )
    table = np.frombuffer(message.data, dtype=layout, count=count)
    return np.column_stack([table[name] for name in "xyz"]).astype(np.float64)


def tetrahedra_message(tetrahedra: NDArray[np.integer]) -> Int32MultiArray:
    """(M, 4) node indices."""
    message = Int32MultiArray()
    count = len(tetrahedra)
    message.layout.dim = [
        MultiArrayDimension(label="tetrahedron", size=count, stride=4 * count),
        MultiArrayDimension(label="node", size=4, stride=4),
    ]
    message.data = _packed("i", tetrahedra.astype(np.int32))
    return message


def tetrahedra_from(message: Int32MultiArray) -> NDArray[np.int32]:
    """(M, 4) node indices.

    Raises:
        MeshError: the number of indices is not a multiple of four.
    """
    indices = np.frombuffer(message.data, dtype=np.int32)
    if len(indices) % 4:
        raise MeshError(f"{len(indices)} node indices do not make whole tetrahedra")
    return indices.reshape(-1, 4)


def affine_message(matrix: NDArray[np.floating]) -> Float64MultiArray:
    """A (4, 4) affine map, row after row."""
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label="row", size=4, stride=16),
        MultiArrayDimension(label="column", size=4, stride=4),
    ]
    message.data = _packed("d", matrix.astype(np.float64))
    return message


def affine_from(message: Float64MultiArray) -> NDArray[np.float64]:
    """The (4, 4) affine map in a message.

    Raises:
        ProbeError: it is no 4 by 4 matrix, not finite, or its last row is not 0 0 0 1.
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
    if not (np.isfinite(matrix).all() and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all()):
        raise ProbeError(
            f"the matrix {matrix.tolist()} is not an affine map: give finite numbers, and 0 0 0 1 "
            f"as the last row"
        )
    return matrix


_CONTACT_PARTS = (("stamp", 2), ("pose", 7), ("wrench", 6), ("stiffness", 36))
"""What a model of the contact holds: seconds and nanoseconds; position and quaternion of the probe;
force and torque; six rows of six."""


def contact_model_message(model: ContactModel) -> Float64MultiArray:
    """Stamp, pose, wrench and stiffness one after another, each a labelled dimension."""
    message = Float64MultiArray()
    left = sum(size for _, size in _CONTACT_PARTS)
    for label, size in _CONTACT_PARTS:
        message.layout.dim.append(MultiArrayDimension(label=label, size=size, stride=left))
        left -= size
    values = (divmod(model.stamp, 1_000_000_000), model.pose.position, model.pose.orientation)
    message.data = _packed("d", np.concatenate([*values, model.wrench, model.stiffness.ravel()]))
    return message


def contact_model_from(message: Float64MultiArray) -> ContactModel:
    """The model of the contact in a message.

    Raises:
        TrackingError: it has other parts, or a number that cannot be.
    """
    parts = tuple((dimension.label, dimension.size) for dimension in message.layout.dim)
    values = np.array(message.data, dtype=np.float64)
    if parts != _CONTACT_PARTS or len(values) != 51 or not np.isfinite(values).all():
        raise TrackingError(
            f"a model of the contact needs {', '.join(f'{n} of {k}' for k, n in _CONTACT_PARTS)}, "
            f"51 finite numbers in all, not {len(values)} in {list(parts)}"
        )
    stamp = 1_000_000_000 * int(values[0]) + int(values[1])
    try:
        pose = Pose(values[2:5], values[5:9])
    except PoseError as error:
        raise TrackingError(f"a model of the contact: {error}") from error
    return ContactModel(stamp, pose, values[9:15], values[15:].reshape(6, 6))


def mesh_message(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> Mesh:
    """(N, 3) m and (T, 3) as a shape."""
    return Mesh(
        vertices=_points(vertices),
        triangles=[MeshTriangle(vertex_indices=triple.astype(np.uint32)) for triple in triangles],
    )


def surface_marker(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], stamp: Time, frame: str
) -> bytes:
    """A skin-coloured TRIANGLE_LIST marker, serialized."""
    skin = ("skin", (0.85, 0.65, 0.55, 0.9), vertices, triangles)
    return b"".join([_CDR_LITTLE_ENDIAN, *_marker(skin, stamp, frame, 0)])


def structure_markers(surfaces: Sequence[Surface], stamp: Time, frame: str) -> bytes:
    """A MarkerArray with a TRIANGLE_LIST of each surface in its own namespace, serialized."""
    parts = [_CDR_LITTLE_ENDIAN, struct.pack("@I", len(surfaces))]
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


def _points(vertices: NDArray[np.floating]) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in vertices.tolist()]


def _packed(code: str, values: NDArray[Any]) -> array[Any]:
    """All values in order, copied once (``array(code, bytes)`` takes forty times as long)."""
    data = array(code)
    data.frombytes(np.ascontiguousarray(values).ravel().view(np.uint8).data)
    return data
