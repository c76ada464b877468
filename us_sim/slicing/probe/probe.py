"""Transducers: linear, convex and phased arrays, as planes of pixels and as beams."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.slicing.probe.plane import SlicePlane, require_pixel_counts


def _depth() -> Any:
    return setting(Quantity("length", 5e-3, 0.4), "of the image along the beams", live=True)


def _lines(default: int) -> Any:
    return setting(Quantity("number", 1, 4096), "beams", default=default, kw_only=True)


def _samples() -> Any:
    return setting(Quantity("number", 1, 16384), "of each beam", default=512, kw_only=True)


def _focus() -> Any:
    return setting(
        Quantity("length", 1e-3, 0.4),
        "along the beams from the face; not given: the middle of the depth",
        default=None,
        live=True,
        kw_only=True,
    )


def _frequencies(low: float, high: float) -> Any:
    return setting(
        Quantity("frequency", 0.5e6, 50e6),
        "lowest and highest of the pulse's middle",
        default=(low, high),
        kw_only=True,
    )


_ROUNDING = 1e-9
"""Tolerance for pixel centres on the outline, over the depth and over the number of lines."""

_BAND = 64  # rows
_LOSS = 1.08e-4  # dB/m/Hz there and back through soft tissue: 0.54 dB/cm/MHz each way
_WEAKEST = 100.0  # dB: a loss beyond which the strongest echo is below a scanner's noise


class Probe(Settings, ABC):
    """A transducer with straight beams in the plane y = 0 of frame ``probe``.

    The middle of its face is the origin and +z the middle beam's direction. Each beam starts on
    the face and is ``depth`` long. Beam ``k`` of ``lines`` is the middle of the k-th of as many
    equal parts of the face (of the opening angle, where beams spread), and its sample ``s`` of
    ``samples`` the middle of the s-th part of its length. So line coordinates in the image run
    from -0.5 to lines - 0.5.

    The image is the bounding rectangle of all that the beams reach; pixels that no beam reaches
    are black.
    """

    section = "probe"
    error = ProbeError

    depth: float  # m, along the beams from the face
    frequencies: tuple[float, float]  # Hz, lowest and highest
    columns: int  # pixels along the array
    rows: int  # pixels along the depth
    lines: int  # beams
    samples: int  # of each beam
    focus: float | None  # m, along the beams from the face

    def with_square_pixels(self, rows: int) -> Self:
        """Return the probe with so many rows, and columns that make pixels square to half a column.

        Raises:
            ProbeError: the image is too large.
        """
        draft = self.with_pixels(1, rows)
        return self.with_pixels(max(1, round(rows * draft.width / draft.height)), rows)

    def with_pixels(self, columns: int, rows: int) -> Self:
        """Return the probe with an image of so many pixels.

        Raises:
            ProbeError: the image is too large.
        """
        made: Any = self
        probe: Self = dataclasses.replace(made, columns=columns, rows=rows)
        return probe

    @property
    def greatest_depth(self) -> float:
        """m, from where echoes come back at the middle of its frequencies; below it is noise."""
        within = _WEAKEST / (_LOSS * math.sqrt(math.prod(self.frequencies)))
        return min(0.4, math.floor(within * 200) / 200)

    def get_upper_limit(self, name: str) -> float:
        """Return the largest value of a setting; the greatest depth for ``depth``."""
        return self.greatest_depth if name == "depth" else super().get_upper_limit(name)

    @property
    @abstractmethod
    def _outline(self) -> tuple[float, float, float]:
        """Half the width, the top and the bottom (m, along x, z, z) of all that beams reach."""

    @abstractmethod
    def _beam(
        self, x: NDArray[np.float64], z: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the place of beams through points (m) among all lines, 0 to 1, and distance (m).

        The distance is along the beam from the face. Where no beam reaches, one of the two is out
        of its range.
        """

    @abstractmethod
    def compute_rays(
        self, part: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return start (n, 2) m and unit direction (n, 2), x and z, of beams, also between lines.

        Args:
            part: (n,) of the face, or of the opening angle where beams spread: 0 to 1.
        """

    @cached_property
    def width(self) -> float:
        """m, of the image along x."""
        return 2 * self._outline[0]

    @cached_property
    def height(self) -> float:
        """m, of the image along z."""
        _, top, bottom = self._outline
        return bottom - top

    @cached_property
    def pixel_spacing(self) -> NDArray[np.float64]:
        """(2,) m: from one column to the next, and from one row to the next."""
        return _make_read_only(np.array([self.width / self.columns, self.height / self.rows]))

    @cached_property
    def image_to_probe(self) -> NDArray[np.float64]:
        """(4, 4) m: from (column, row, 0, 1) of a pixel's centre to frame ``probe``."""
        lateral, axial = self.pixel_spacing
        half_width, top, _ = self._outline
        matrix = np.zeros((4, 4))
        matrix[0, 0] = lateral
        matrix[2, 1] = axial
        matrix[1, 2] = -1.0  # so that it is a rotation times a scale: x, z and -y
        matrix[:, 3] = (0.5 * lateral - half_width, 0.0, 0.5 * axial + top, 1.0)
        return _make_read_only(matrix)

    @cached_property
    def beam_starts(self) -> NDArray[np.float64]:
        """(lines, 2) m: x and z of each beam on the face."""
        return _make_read_only(self.compute_rays(self._line_parts)[0])

    @cached_property
    def beam_directions(self) -> NDArray[np.float64]:
        """(lines, 2): x and z of each beam's unit direction."""
        return _make_read_only(self.compute_rays(self._line_parts)[1])

    @cached_property
    def pixel_beams(self) -> NDArray[np.float32]:
        """(2, rows, columns): each pixel's line coordinate, and its distance (m) along that beam.

        The line coordinate is fractional between lines. NaN where no beam reaches.
        """
        beams = np.full((2, self.rows, self.columns), np.nan, dtype=np.float32)
        for band, part, distance, reached in self._bands():
            line = part * self.lines - 0.5
            np.copyto(beams[0, band], line, where=reached, casting="same_kind")
            np.copyto(beams[1, band], distance, where=reached, casting="same_kind")
        return _make_read_only(beams)

    @cached_property
    def pixel_directions(self) -> NDArray[np.float32]:
        """(2, rows, columns): x and z of the unit direction of the beam through each pixel.

        NaN where no beam reaches.
        """
        part = (self.pixel_beams[0].ravel() + 0.5) / self.lines
        directions = self.compute_rays(part.astype(np.float64))[1]
        directions[np.isnan(part)] = np.nan
        return _make_read_only(directions.T.reshape(2, self.rows, self.columns).astype(np.float32))

    @cached_property
    def beam_pixels(self) -> NDArray[np.float32]:
        """(2, samples, lines): the column and row, fractional, of each sample of each beam."""
        lateral, axial = self.pixel_spacing
        half_width, top, _ = self._outline
        distance = (np.arange(self.samples)[:, None] + 0.5) * (self.depth / self.samples)
        x = self.beam_starts[:, 0] + distance * self.beam_directions[:, 0]
        z = self.beam_starts[:, 1] + distance * self.beam_directions[:, 1]
        pixels = np.stack([(x + half_width) / lateral, (z - top) / axial]) - 0.5
        return _make_read_only(pixels.astype(np.float32))

    def make_plane(self, pose: Pose) -> SlicePlane:
        """Return the pixels of the image taken with the probe at ``pose``, in the parent frame."""
        rotation = pose.rotation
        lateral, axial = self.pixel_spacing
        return SlicePlane(
            origin=rotation @ self.image_to_probe[:3, 3] + pose.position,
            column_step=rotation[:, 0] * lateral,
            row_step=rotation[:, 2] * axial,
            columns=self.columns,
            rows=self.rows,
            spans=self._spans,
        )

    @cached_property
    def _spans(self) -> NDArray[np.int32] | None:
        """(rows, 2, 2): runs of columns of each row that beams reach, None when they reach all."""
        return _make_read_only(np.concatenate([_runs(reached) for *_, reached in self._bands()]))

    def _bands(
        self,
    ) -> Iterator[tuple[slice, NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]]:
        """Yield bands of rows, with `_beam` of their pixels and which of these are reached.

        A few rows at a time, so that a large image does not need many times its own memory.
        """
        lateral, axial = self.pixel_spacing
        half_width, top, _ = self._outline
        x = (np.arange(self.columns) + 0.5) * lateral - half_width
        for first in range(0, self.rows, _BAND):
            band = slice(first, min(first + _BAND, self.rows))
            z = (np.arange(band.start, band.stop) + 0.5) * axial + top
            part, distance = self._beam(x[None, :], z[:, None])
            reached = (part >= -_ROUNDING) & (part <= 1 + _ROUNDING)
            reached &= (distance >= -_ROUNDING * self.depth) & (
                distance <= (1 + _ROUNDING) * self.depth
            )
            yield band, part, distance, reached

    @property
    def _line_parts(self) -> NDArray[np.float64]:
        return (np.arange(self.lines) + 0.5) / self.lines

    def check(self) -> None:
        """Refuse an image that is too large, or too deep.

        Raises:
            ProbeError: with the key, the value and the range.
        """
        low, high = self.frequencies
        if low > high:
            raise self.make_error(
                "frequencies", f"{low:g} to {high:g} Hz go down: give the lower one first"
            )
        most = self.greatest_depth
        if self.depth > most:
            raise self.make_error(
                "depth",
                f"{1e3 * self.depth:g} mm is more than the {1e3 * most:g} mm from which "
                f"echoes of {low * 1e-6:g} to {high * 1e-6:g} MHz come back (probe.frequencies)",
            )
        try:
            require_pixel_counts(self.columns, self.rows)
        except ProbeError as error:
            raise self.make_error("image", str(error)) from error


@dataclass(frozen=True)
class LinearProbe(Probe):
    """A linear array: parallel beams along +z of frame ``probe``, from the face downwards.

    The image lies in y = 0. The centre of column ``i`` is at
    ``x = (i + 0.5) aperture / columns - aperture / 2`` and that of row ``j`` at
    ``z = (j + 0.5) depth / rows``, so the upper edge of row 0 is the transducer's face.

    Examples:
        >>> from us_sim.geometry.pose import Pose
        >>> probe = LinearProbe(aperture=0.04, depth=0.05, columns=400, rows=500, lines=4)
        >>> probe.make_plane(Pose()).origin * 1e3
        array([-19.95,   0.  ,   0.05])
        >>> probe.beam_starts * 1e3
        array([[-15.,   0.],
               [ -5.,   0.],
               [  5.,   0.],
               [ 15.,   0.]])
    """

    aperture: float = setting(Quantity("length", 3e-3, 0.2), "of the face along the array")
    depth: float = _depth()
    columns: int = 512
    rows: int = 512
    lines: int = _lines(192)
    samples: int = _samples()
    focus: float | None = _focus()
    frequencies: tuple[float, float] = _frequencies(4e6, 16e6)

    @property
    def _outline(self) -> tuple[float, float, float]:
        return 0.5 * self.aperture, 0.0, self.depth

    _spans = None  # beams reach every pixel

    def _beam(
        self, x: NDArray[np.float64], z: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return tuple(np.broadcast_arrays(x / self.aperture + 0.5, z))  # type: ignore[return-value]

    def compute_rays(
        self, part: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return parallel beams, which start on the face."""
        starts = np.zeros((len(part), 2))
        starts[:, 0] = (part - 0.5) * self.aperture
        return starts, np.tile([0.0, 1.0], (len(part), 1))


def _make_read_only(array: Any) -> Any:
    """Return the array, made read-only, since all callers get the same."""
    array.flags.writeable = False
    return array


def _runs(shown: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return (rows, 2, 2): first and end column of up to two runs of each row."""
    edges = np.diff(np.pad(shown, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    runs = np.zeros((len(shown), 2, 2), dtype=np.int32)
    for which, sign in enumerate((1, -1)):
        row, column = np.nonzero(edges == sign)
        number = np.arange(len(row)) - np.searchsorted(row, row)
        runs[row, number, which] = column
    return runs


@dataclass(frozen=True)
class ConvexProbe(Probe):
    """A curved (convex) array: beams along the radii of an arc, which is the face.

    The middle of the arc is the origin of frame ``probe``, its centre at z = -radius, and its ends
    lie at z < 0. So the image begins behind the origin, at the ends of the arc.

    Examples:
        >>> probe = ConvexProbe(radius=0.0508, opening_angle=1.057, depth=0.177)
        >>> round(probe.width, 3), round(probe.height, 3)  # m, of the image
        (0.23, 0.184)
    """

    radius: float = setting(Quantity("length", 3e-3, 0.3), "of the face's curvature")
    opening_angle: float = setting(
        Quantity("angle", math.radians(1), math.pi), "between the outermost beams"
    )
    depth: float = _depth()
    columns: int = 512
    rows: int = 512
    lines: int = _lines(192)
    samples: int = _samples()
    focus: float | None = _focus()
    frequencies: tuple[float, float] = _frequencies(1.5e6, 6e6)

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

    def compute_rays(
        self, part: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return beams along the radii of the arc, which start on it."""
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
    depth: float = _depth()
    columns: int = 512
    rows: int = 512
    lines: int = _lines(128)
    samples: int = _samples()
    focus: float | None = _focus()
    frequencies: tuple[float, float] = _frequencies(1e6, 5e6)
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
            raise self.make_error(
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

    def compute_rays(
        self, part: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return beams that radiate from the apex, and start on the flat face."""
        angle = (part - 0.5) * self.opening_angle
        starts = np.column_stack([self.radius * np.tan(angle), np.zeros_like(angle)])
        return starts, np.column_stack([np.sin(angle), np.cos(angle)])


def lift_probe(pose: Pose) -> Pose:
    """Lift a probe within its image plane until it does not press into z > 0."""
    cosine = max(float(pose.rotation[2, 2]), 0.2)  # beyond this tilt a lift means nothing
    depth = max(float(pose.position[2]), 0.0) / cosine
    return Pose(pose.position - depth * pose.rotation[:, 2], pose.orientation)


def compute_image_outline(probe: Probe) -> NDArray[np.float64]:
    """Return (66, 3) m in frame ``probe``: along the face, then back where the image ends.

    So the beam of point k ends at the point 65 - k.
    """
    points = 33
    starts, directions = probe.compute_rays(np.linspace(0.0, 1.0, points))
    ends = starts + probe.depth * directions
    outline = np.zeros((2 * points, 3))
    outline[:, [0, 2]] = np.concatenate([starts, ends[::-1]])
    return outline
