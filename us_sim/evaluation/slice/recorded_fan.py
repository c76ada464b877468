"""Where a probe's fan lies in the images that a scanner recorded.

>>> import numpy as np
>>> from us_sim.evaluation.slice.recorded_fan import LIVER_SWEEP
>>> probe = LIVER_SWEEP.probe(0.314818e-3)
>>> round(probe.radius * 1e3, 2), round(probe.depth * 1e3, 2), probe.rows
(50.79, 177.25, 585)
>>> frame = np.diag([0.314818e-3, 0.314818e-3, 0.314818e-3, 1.0])
>>> (LIVER_SWEEP.pose(frame).position * 1e3).round(2)
array([116.17,   6.93,   0.  ])
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.probe import ConvexProbe


@dataclass(frozen=True)
class RecordedFan:
    """Where a curved array's image lies in a recorded frame, in pixels.

    Positions are those of pixel centres, so that the first pixel's centre is (0, 0).
    """

    column: float  # of the face's middle
    row: float
    radius: float  # of the face
    end: float  # radius at which the beams end
    half_angle: float  # rad

    def fits(self, columns: int, rows: int) -> bool:
        """Whether images of that size hold the whole fan, to half a pixel."""
        reach = self.end * math.sin(self.half_angle)
        bottom = self.row + self.end - self.radius
        across = reach - 0.5 <= self.column <= columns - 0.5 - reach
        return across and bottom <= rows - 0.5

    def probe(self, spacing: float) -> ConvexProbe:
        """The probe with pixels ``spacing`` m wide, as near as a whole number of them allows."""
        depth = (self.end - self.radius) * spacing
        radius = self.radius * spacing
        height = depth + radius * (1.0 - math.cos(self.half_angle))
        probe = ConvexProbe(radius=radius, opening_angle=2.0 * self.half_angle, depth=depth)
        return probe.with_square_pixels(round(height / spacing))

    def pose(self, image_to_reference: NDArray[np.float64]) -> Pose:
        """Of the probe in the sweep's frame, from a frame's (4, 4) matrix in metres."""
        along, down = (step / np.linalg.norm(step) for step in image_to_reference[:3, :2].T)
        matrix = np.eye(4)
        matrix[:3, :3] = np.column_stack([along, np.cross(down, along), down])
        matrix[:3, 3] = (image_to_reference @ [self.column, self.row, 0.0, 1.0])[:3]
        return Pose.from_matrix(matrix)

    def on_probe_pixels(
        self, frame: NDArray[np.uint8], probe: ConvexProbe, spacing: float
    ) -> NDArray[np.uint8]:
        """A recorded frame on the pixels of a probe's image, bilinear."""
        to_pixel = probe.image_to_probe[[0, 2]][:, [0, 1, 3]] / spacing
        to_pixel[:, 2] += (self.column, self.row)
        size = (probe.columns, probe.rows)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(frame, to_pixel, size, flags=flags), dtype=np.uint8)


LIVER_SWEEP = RecordedFan(369.0, 22.01, 161.34, 724.35, math.radians(30.28))
"""The curved array of ImFusion's public liver sweep, as the header of their own file has it.

The frames confirm the face and the sides to a pixel; they are lit 9 pixels (3 mm) deeper than the
header's end, to their last row.
"""
