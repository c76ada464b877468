"""Transducers whose beams spread: curved arrays, and phased arrays that steer their beams.

>>> import math
>>> from us_sim.slicing.probe.fan_probe import ConvexProbe, SectorProbe
>>> convex = ConvexProbe(radius=0.06, opening_angle=math.radians(60), depth=0.14,
...                      columns=640, rows=480)
>>> round(convex.width, 6), round(convex.height, 6)  # the arc's ends are 8 mm behind its middle
(0.2, 0.148038)
>>> sector = SectorProbe(aperture=0.02, opening_angle=math.radians(90), depth=0.16,
...                      columns=640, rows=480)
>>> round(sector.width, 6), sector.height
(0.226274, 0.16)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.slicing.probe.probe import (
    Probe,
    beam_focus,
    beam_frequencies,
    beam_lines,
    beam_samples,
    image_depth,
)


@dataclass(frozen=True)
class ConvexProbe(Probe):
    """A curved (convex) array: beams along the radii of an arc, which is the face.

    The middle of the arc is the origin of frame ``probe``, its centre at z = -radius, and its ends
    lie at z < 0. So the image begins behind the origin, at the ends of the arc.

    Raises:
        ProbeError: a value is out of its range.
    """

    radius: float = setting(Quantity("length", 3e-3, 0.3), "of the face's curvature")
    opening_angle: float = setting(
        Quantity("angle", math.radians(1), math.pi), "between the outermost beams"
    )
    depth: float = image_depth()
    columns: int = 512
    rows: int = 512
    lines: int = beam_lines(192)
    samples: int = beam_samples()
    focus: float | None = beam_focus()
    frequencies: tuple[float, float] = beam_frequencies(1.5e6, 6e6)

    @property
    def _outline(self) -> tuple[float, float, float]:
        half = 0.5 * self.opening_angle
        return (
            (self.radius + self.depth) * math.sin(half),
            self.radius * (math.cos(half) - 1),
            self.depth,
        )

    def _beam(
        self, x: NDArray[np.float64], z: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        below = z + self.radius
        return np.arctan2(x, below) / self.opening_angle + 0.5, np.hypot(x, below) - self.radius

    def _rays(self, part: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        angle = (part - 0.5) * self.opening_angle
        directions = np.column_stack([np.sin(angle), np.cos(angle)])
        return self.radius * (directions - [0.0, 1.0]), directions


@dataclass(frozen=True)
class SectorProbe(Probe):
    """A phased array: a small flat face whose beams are steered, evenly over the opening angle.

    All beams leave the middle of the face; that is how phased arrays scan, and the image begins
    in a point. With ``radius`` they radiate from a virtual apex so far behind the face instead,
    through different places of it: the image begins with a flat edge on the face. In both
    cases beams are ``depth`` long from the face.

    Raises:
        ProbeError: a value is out of its range, or the face too small for the beams that ``radius``
            spreads over it.
    """

    aperture: float = setting(Quantity("length", 3e-3, 0.2), "of the face along the array")
    opening_angle: float = setting(
        Quantity("angle", math.radians(1), math.radians(150)), "between the outermost beams"
    )
    depth: float = image_depth()
    columns: int = 512
    rows: int = 512
    lines: int = beam_lines(128)
    samples: int = beam_samples()
    focus: float | None = beam_focus()
    frequencies: tuple[float, float] = beam_frequencies(1e6, 5e6)
    radius: float = setting(
        Quantity("length", 0.0, 0.05),
        "how far behind the face is the apex from which beams radiate",
        default=0.0,
        kw_only=True,
    )

    def check(self) -> None:
        """Refuse a face too small for its beams."""
        super().check()
        used = 2 * self.radius * math.tan(0.5 * self.opening_angle)
        if used > self.aperture * (1 + 1e-9):
            raise self.refused(
                "aperture",
                f"{1e3 * self.aperture:g} mm is less than the {1e3 * used:.4g} mm "
                f"of the face that beams over {math.degrees(self.opening_angle):g} degrees from an "
                f"apex {1e3 * self.radius:g} mm behind it (probe.radius) pass through",
            )

    @property
    def _outline(self) -> tuple[float, float, float]:
        half = 0.5 * self.opening_angle
        return self.radius * math.tan(half) + self.depth * math.sin(half), 0.0, self.depth

    def _beam(
        self, x: NDArray[np.float64], z: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        below = z + self.radius
        # Of the distance from the apex only the part beyond the face counts.
        return np.arctan2(x, below) / self.opening_angle + 0.5, np.hypot(x, below) * z / below

    def _rays(self, part: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        angle = (part - 0.5) * self.opening_angle
        starts = np.column_stack([self.radius * np.tan(angle), np.zeros_like(angle)])
        return starts, np.column_stack([np.sin(angle), np.cos(angle)])
