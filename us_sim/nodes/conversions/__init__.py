"""Messages to values of the domain and back: the only place that knows their layouts.

A type allows what the domain does not: numbers that are not finite, quaternions of no length,
stamps of no time, sizes that their buffers do not have. What is read here has none of that, or is
refused in one sentence.

Bulk data are handed over as ``array.array('B', …)``, which rclpy takes without looking at each
element.
"""

from us_sim.nodes.conversions.clouds import cloud_message, vectors_from
from us_sim.nodes.conversions.contact import contact_model_from, contact_model_message
from us_sim.nodes.conversions.images import (
    affine_from,
    affine_message,
    bgr_image_message,
    colour_image_message,
    colour_pixels_from,
    field_from,
    field_message,
    image_message,
    pixels_from,
)
from us_sim.nodes.conversions.markers import (
    line_from,
    markers_stamp,
    structure_markers,
    surface_marker,
    transducer_markers,
    triangles_from,
)
from us_sim.nodes.conversions.meshes import (
    mesh_from,
    mesh_message,
    tetrahedra_from,
    tetrahedra_message,
)
from us_sim.nodes.conversions.poses import (
    pose_from,
    pose_from_text,
    pose_message,
    pose_text,
    transform_from,
    transform_message,
    wrench_from,
    wrench_message,
    wrench_serialized,
)
from us_sim.nodes.conversions.stamps import nanoseconds_of, require_stamp, stamp_message

__all__ = [
    "affine_from",
    "affine_message",
    "bgr_image_message",
    "cloud_message",
    "colour_image_message",
    "colour_pixels_from",
    "contact_model_from",
    "contact_model_message",
    "field_from",
    "field_message",
    "image_message",
    "line_from",
    "markers_stamp",
    "mesh_from",
    "mesh_message",
    "nanoseconds_of",
    "pixels_from",
    "pose_from",
    "pose_from_text",
    "pose_message",
    "pose_text",
    "require_stamp",
    "stamp_message",
    "structure_markers",
    "surface_marker",
    "tetrahedra_from",
    "tetrahedra_message",
    "transducer_markers",
    "transform_from",
    "transform_message",
    "triangles_from",
    "vectors_from",
    "wrench_from",
    "wrench_message",
    "wrench_serialized",
]
