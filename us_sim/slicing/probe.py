"""Transducers: what part of the patient they image, as a plane of pixels.

>>> from us_sim.pose import Pose
>>> from us_sim.slicing.probe import LinearProbe
>>> plane = LinearProbe(aperture=0.04, depth=0.05, columns=400, rows=500).plane(Pose())
>>> plane.origin * 1e3
array([-19.95,   0.  ,   0.05])
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from us_sim.errors import ProbeError
from us_sim.pose import Pose
from us_sim.slicing.plane import SlicePlane, require_pixel_counts

__all__ = ["LinearProbe"]

# Shortest and longest side, m, of the images that transducers make.
_LIMITS = {"aperture": (5e-3, 0.2), "depth": (5e-3, 0.4)}


@dataclass(frozen=True)
class LinearProbe:
    """A linear array: parallel beams along +z of frame ``probe``, from the face downwards.

    The image lies in y = 0. The centre of column ``i`` is at
    ``x = (i + 0.5) aperture / columns - aperture / 2`` and that of row ``j`` at
    ``z = (j + 0.5) depth / rows``, so the upper edge of row 0 is the transducer's face.

    Raises:
        ProbeError: the aperture is not 5 to 200 mm, the depth not 5 to 400 mm, or the image not
            1 to 4096 pixels a side.
    """

    aperture: float  # m, width of the image along the array
    depth: float  # m, height of the image below the face
    columns: int
    rows: int

    def __post_init__(self) -> None:
        for name, (lowest, highest) in _LIMITS.items():
            length = getattr(self, name)
            if not (
                isinstance(length, int | float)
                and math.isfinite(length)
                and lowest <= length <= highest
            ):
                raise ProbeError(
                    f"the probe's {name} is {length!r} m: give {1e3 * lowest:g} to "
                    f"{1e3 * highest:g} mm, in metres"
                )
        require_pixel_counts(self.columns, self.rows)

    def plane(self, pose: Pose) -> SlicePlane:
        """The pixels of the image taken with the probe at ``pose``, in the parent frame."""
        rotation = pose.rotation
        pitch = self.aperture / self.columns
        spacing = self.depth / self.rows
        first = np.array([0.5 * pitch - 0.5 * self.aperture, 0.0, 0.5 * spacing])
        return SlicePlane(
            origin=rotation @ first + pose.position,
            column_step=rotation[:, 0] * pitch,
            row_step=rotation[:, 2] * spacing,
            columns=self.columns,
            rows=self.rows,
        )
