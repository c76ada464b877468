"""The curved array of ImFusion's public liver sweep, as the header of their own file has it.

Lengths are in pixels, positions those of pixel centres. The frames confirm the face and the sides
to a pixel; they are lit 9 pixels (3 mm) deeper than the header's end, to their last row.
"""

import math

import cv2
import numpy as np

from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.probe import ConvexProbe

COLUMN, ROW = 369.0, 22.01  # of the face's middle
RADIUS, END = 161.34, 724.35  # of the face, and at which the beams end
HALF_ANGLE = math.radians(30.28)
SPACING = 0.314818e-3  # m


def probe():
    """The probe with pixels as wide as the recorded ones."""
    depth, radius = (END - RADIUS) * SPACING, RADIUS * SPACING
    height = depth + radius * (1.0 - math.cos(HALF_ANGLE))
    made = ConvexProbe(radius=radius, opening_angle=2.0 * HALF_ANGLE, depth=depth)
    return made.with_square_pixels(round(height / SPACING))


def probe_pose(image_to_reference):
    """Pose of the probe in the sweep's frame, from a frame's (4, 4) matrix in metres."""
    along, down = (step / np.linalg.norm(step) for step in image_to_reference[:3, :2].T)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([along, np.cross(down, along), down])
    matrix[:3, 3] = (image_to_reference @ [COLUMN, ROW, 0.0, 1.0])[:3]
    return Pose.from_matrix(matrix)


def on_probe_pixels(frame, convex):
    """A recorded frame on the pixels of a probe's image, bilinear."""
    to_pixel = convex.image_to_probe[[0, 2]][:, [0, 1, 3]] / SPACING
    to_pixel[:, 2] += (COLUMN, ROW)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(frame, to_pixel, (convex.columns, convex.rows), flags=flags)
