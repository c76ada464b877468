"""The model of the contact between tissue and probe."""

from __future__ import annotations

import numpy as np
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from us_sim.errors import PoseError, TrackingError
from us_sim.geometry.pose import Pose
from us_sim.nodes.conversions.packing import packed
from us_sim.nodes.conversions.stamps import nanoseconds_since
from us_sim.tracking.haptic import ContactModel

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
