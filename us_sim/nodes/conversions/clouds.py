"""Points in clouds, of any layout that PointCloud2 can describe."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

from us_sim.errors import MeshError
from us_sim.nodes.conversions.packing import packed
from us_sim.nodes.conversions.stamps import require_frame

_KINDS = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
_FARTHEST = 1e6
"""m: coordinates beyond are no place, and their squares do not fit single precision for long."""


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
