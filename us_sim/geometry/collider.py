"""The probe's shape where it touches the patient, shared by tissue and skin."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

# A curved face is refused when it is steeper than this at its ends, rad.
_STEEPEST = math.radians(75)
_SIZE = Quantity("length", 1e-4, 0.5)
_ROUNDING = Quantity("length", 1e-5, 0.25)


@dataclass(frozen=True)
class _Shape(Settings):
    """A box grown by a rounding, its `offset_box`.

    That is (4,) m: half extents x, y, z of the core box, and the rounding around it; (5,) where
    the core's front is curved, with its curvature, 1/m.
    """

    section = "probe.collider"
    error = ProbeError


@dataclass(frozen=True)
class Sphere(_Shape):
    """The paper's spherical collision volume; touches z = 0 of the probe at the origin."""

    radius: float = setting(_SIZE, "of the sphere")

    @property
    def offset_box(self) -> NDArray[np.float64]:
        """(4,) m: a point, rounded."""
        return np.array([0.0, 0.0, 0.0, self.radius])


@dataclass(frozen=True)
class Capsule(_Shape):
    """A cylinder along the probe's x with hemispherical ends, as a linear array has."""

    radius: float = setting(_SIZE, "of the cylinder and of its ends")
    length: float = setting(_SIZE, "between the centres of the two end caps")

    @property
    def offset_box(self) -> NDArray[np.float64]:
        """(4,) m: a segment along x, rounded."""
        return np.array([self.length / 2, 0.0, 0.0, self.radius])


@dataclass(frozen=True)
class RoundedBox(_Shape):
    """A flat transducer face with rounded edges.

    Examples:
        >>> probe = RoundedBox(length=0.05, width=0.03, height=0.05, rounding=0.006)
        >>> probe.offset_box  # half extents of the core, and the rounding, m
        array([0.019, 0.009, 0.019, 0.006])
    """

    length: float = setting(_SIZE, "total along the probe's x")
    width: float = setting(_SIZE, "total along the probe's y")
    height: float = setting(_SIZE, "total along the probe's z")
    rounding: float = setting(_ROUNDING, "radius of edges and corners")

    def check(self) -> None:
        """Refuse dimensions that do not go together."""
        smallest = min(self.length, self.width, self.height)
        if 2 * self.rounding > smallest:
            raise self.make_error(
                "rounding",
                f"{self.rounding:g} m is more than half of the smallest side ({smallest:g} m): "
                f"give at most {smallest / 2:g} m",
            )

    @property
    def offset_box(self) -> NDArray[np.float64]:
        """(4,) m: the box less its rounding, and that."""
        sides = np.array([self.length, self.width, self.height])
        return np.append(sides / 2 - self.rounding, self.rounding)


@dataclass(frozen=True)
class Convex(RoundedBox):
    """A curved array: a rounded box whose face is part of a cylinder about a line along y."""

    radius: float = setting(_SIZE, "of the face's curvature")

    def check(self) -> None:
        """Refuse dimensions that do not go together."""
        super().check()
        core = self.radius - self.rounding
        if core <= 0.0:
            raise self.make_error("radius", f"{self.radius:g} m is no more than the rounding")
        longest = 2 * (core * math.sin(_STEEPEST) + self.rounding)
        if self.length > longest:
            raise self.make_error(
                "length",
                f"{self.length:g} m: a face of radius {self.radius:g} m would be steeper than "
                f"{math.degrees(_STEEPEST):g} degrees at its ends: give at most {longest:.4g} m",
            )
        half = 0.5 * self.length - self.rounding
        least = 2 * self.rounding + core - math.sqrt(core * core - half * half)
        if self.height < least:
            raise self.make_error(
                "height",
                f"{self.height:g} m is less than the face is bent: give at least {least:.4g} m",
            )

    @property
    def offset_box(self) -> NDArray[np.float64]:
        """(5,) m, and 1/m: the box, and the curvature of its front."""
        return np.append(super().offset_box, 1 / (self.radius - self.rounding))


Collider = Sphere | Capsule | RoundedBox | Convex
