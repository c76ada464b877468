"""The picture as the console forms it from slices, each stage only where a setting asks for it.

A volume's grey values are levels: 255 is the strongest echo, each 4.25 less is one decibel less,
and 0 is no echo, which no gain makes visible.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.slicing.probe.beams import (
    compute_beam_width,
    compute_step_depths,
    find_depth_steps,
    get_focus,
)
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import ECHO_RANGE, Imaging

if TYPE_CHECKING:
    from us_sim.slicing.formation.coupling import GelLayer, Reverberation
    from us_sim.slicing.formation.resolution import Resolution


class ImageFormation:
    """The stages between slices and the picture, in the order in which echoes meet them.

    They are the beam's thickness, the layer of gel at the face, what sound meets on its way, the
    beam's width and the pulse's length; then air in front of the face; then gain, dynamic range and
    grey map. The result depends on settings and arguments only.

    Args:
        probe: its geometry.
        imaging: the settings; a stage whose settings are at their defaults is not even imported.

    Examples:
        >>> import numpy as np
        >>> from us_sim.slicing.probe.probe import LinearProbe
        >>> from us_sim.slicing.settings import Imaging
        >>> slice_ = np.full((4, 4), 100, dtype=np.uint8)
        >>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=4, rows=4)
        >>> ImageFormation(probe, Imaging()).form_picture([slice_]) is slice_
        True
        >>> ImageFormation(probe, Imaging(gain=6.0)).form_picture([slice_])[0]
        array([126, 126, 126, 126], dtype=uint8)
    """

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        self._probe = probe
        self._elevation: Elevation | None = None
        self._gel_layer: GelLayer | None = None
        self._resolution: Resolution | None = None
        self._reverberation: Reverberation | None = None
        self._grey_levels: GreyMapping | None = None
        if imaging.elevation_planes > 1:
            self._elevation = Elevation(probe, imaging)
        if imaging.lateral_resolution > 0.0 or imaging.axial_resolution > 0.0:
            from us_sim.slicing.formation.resolution import Resolution

            self._resolution = Resolution(probe, imaging)
        if imaging.contact:
            from us_sim.slicing.formation.coupling import GelLayer, Reverberation

            self._gel_layer = GelLayer(probe)
            self._reverberation = Reverberation(probe, imaging)
        if imaging.changes_grey_levels:
            self._grey_levels = GreyMapping(probe, imaging)

    @property
    def needs_contact(self) -> bool:
        """True if `form_picture` needs the contact of each line with the skin."""
        return self._reverberation is not None

    def make_planes(self, pose: Pose, plane: SlicePlane | None = None) -> list[SlicePlane]:
        """Make the planes to cut with the probe at ``pose``, from the lowest y of the probe on.

        Args:
            pose: of the probe.
            plane: the probe's own at that pose, where it is there already.

        Raises:
            ProbeError: the pose is nowhere near.
        """
        plane = plane or self._probe.make_plane(pose)
        if self._resolution is not None and plane.spans is not None:
            # Beside a fan's edge there is tissue too, which its outer beams see.
            plane = dataclasses.replace(plane, spans=None)
        if self._elevation is None:
            return [plane]
        normal = pose.rotation[:, 1]
        return [
            dataclasses.replace(plane, origin=plane.origin + y * normal)
            for y in self._elevation.offsets
        ]

    def form_picture(
        self,
        images: Sequence[NDArray[np.uint8]],
        coupling: NDArray[np.float32] | None = None,
        gap: NDArray[np.float64] | None = None,
        heard: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None,
    ) -> NDArray[np.uint8]:
        """Form the picture (rows, columns); return the first image itself if nothing is to be done.

        Args:
            images: the slices on `make_planes`, (rows, columns) each.
            coupling: (lines,) from 0 in air to 1 in full contact; None is full contact.
            gap: (lines,) m, from the face to what carries the volume; None is none.
            heard: makes of echoes (rows, columns) what is left of them on their way; None is all.
        """
        image = images[0]
        if self._elevation is not None:
            image = self._elevation.average_planes(images)
        if self._gel_layer is not None and coupling is not None and gap is not None:
            image = self._gel_layer.fill_gap(image, gap, coupling)
        if heard is not None:
            image = heard(image)
        if self._resolution is not None:
            image = self._resolution.spread_echoes(image)
        if self._reverberation is not None and coupling is not None:
            image = self._reverberation.apply_coupling(image, coupling)
        if self._grey_levels is not None:
            image = self._grey_levels.map_levels(image)
        return image


GREYS_PER_DECIBEL = 255.0 / ECHO_RANGE

_SOFT = 0.7  # exponent of the soft map
_FADE = 17.0  # grey values over which the faintest echoes fade


class GreyMapping:
    """The console's last stage, as one table for each step of depth.

    A level of L dB (0 the strongest) is shown as ``255 m(1 + (L + gain + time gain) / range)``,
    black below and white above, with m the grey map:

    - ``linear``: m(t) = t
    - ``soft``: m(t) = t^0.7, which lifts faint echoes
    - ``contrast``: m(t) = t² (3 - 2 t), which parts middle greys and darkens faint echoes
    """

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        self._steps: NDArray[np.uint16] | None = None
        gain = np.array([imaging.gain])
        if any(imaging.time_gain):
            self._steps = find_depth_steps(probe)
            at = np.linspace(0.0, probe.depth, len(imaging.time_gain))
            gain = imaging.gain + np.interp(compute_step_depths(probe), at, imaging.time_gain)
        grey = np.arange(256)
        level = grey / GREYS_PER_DECIBEL - ECHO_RANGE + gain[:, None]  # dB
        ramp = np.clip(1.0 + level / imaging.dynamic_range, 0.0, 1.0)
        if imaging.grey_map == "soft":
            ramp = ramp**_SOFT
        elif imaging.grey_map == "contrast":
            ramp = ramp * ramp * (3.0 - 2.0 * ramp)
        ramp -= ramp[:, :1] * np.maximum(1.0 - grey / _FADE, 0.0)
        # Halves are rounded up, also where the sum of decibels is a rounding error below one.
        self._tables = np.floor(255.0 * ramp + (0.5 + 1e-9)).astype(np.uint8)

    def map_levels(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Map echo levels (rows, columns) to grey values (rows, columns)."""
        out = np.empty_like(image)
        if self._steps is None:
            _look_up(image.reshape(-1), self._tables[0], out.reshape(-1))
        else:
            flat = image.reshape(-1), self._steps.reshape(-1)
            _look_up_by_step(*flat, self._tables.reshape(-1), out.reshape(-1))
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def _look_up(image, table, out):
    for i in range(len(image)):
        out[i] = table[image[i]]


@njit(cache=True, nogil=True, error_model="numpy")
def _look_up_by_step(image, steps, tables, out):
    """Fill out; the tables of 256 entries lie one after the other."""
    for i in range(len(image)):
        out[i] = tables[np.uint32(steps[i]) << np.uint32(8) | np.uint32(image[i])]


WIDTH_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a Gaussian, in standard deviations."""

_WHOLE = 1 << 15  # the sum of the weights of a pixel, in fixed point


class Elevation:
    """Parallel slices and their weights, which follow the beam's hourglass in depth.

    At every depth the weights are a Gaussian's at the planes, its own width chosen such that
    their variance is exactly the beam's. So a few planes, a fixed distance apart, average a volume
    that is quadratic across the plane as the continuous beam does. (An even number has no plane in
    the middle and cannot be thinner than the innermost two are apart.) Grey values are averaged,
    as when images of neighbouring planes are compounded.
    """

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        count = imaging.elevation_planes
        depths = compute_step_depths(probe)
        sigma = (
            compute_beam_width(depths, imaging.elevation_width, get_focus(probe)) / WIDTH_PER_SIGMA
        )
        # The outer planes of binomial weights of this variance; those come near a Gaussian.
        reach = math.sqrt(count - 1) * float(sigma.max())
        self.offsets: NDArray[np.float64] = np.linspace(-reach, reach, count)  # m, along y
        self.weights = _matched_weights(self.offsets, sigma)  # (DEPTH_STEPS, planes)
        fixed = _fixed_point(self.weights)
        self._weights = np.ascontiguousarray(fixed.T)[:, find_depth_steps(probe)]

    def average_planes(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Return the weighted mean (rows, columns) of the images (rows, columns) on the planes."""
        total = np.full(images[0].size, _WHOLE // 2, dtype=np.uint32)
        for image, weights in zip(images, self._weights, strict=True):
            _add_weighted(image.reshape(-1), weights.reshape(-1), total)
        total >>= 15
        return total.astype(np.uint8).reshape(images[0].shape)


def _matched_weights(
    offsets: NDArray[np.float64], sigma: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return weights (depths, planes) that sum to 1 and have the variance sigma² (depths,).

    Two planes have the variance of their distance, whatever their weights.
    """
    squares = offsets**2
    low, high = np.full(len(sigma), 1e-3), np.full(len(sigma), 30.0)  # of sigma
    for _ in range(40):
        middle = np.sqrt(low * high)
        weights = _gaussian(squares, middle * sigma)
        narrow = weights @ squares < sigma**2
        low, high = np.where(narrow, middle, low), np.where(narrow, high, middle)
    return _gaussian(squares, np.sqrt(low * high) * sigma)


def _gaussian(squares: NDArray[np.float64], sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    exponent = -(squares - squares.min()) / (2 * sigma[:, None] ** 2)
    weights = np.exp(exponent)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _fixed_point(weights: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Return weights in fixed point, symmetric and with the exact sum: even tissue stays even."""
    half = weights.shape[1] // 2
    outer = np.round(weights[:, :half] * _WHOLE).astype(np.int64)
    if weights.shape[1] % 2:
        middle = _WHOLE - 2 * outer.sum(axis=1, keepdims=True)
        whole = np.concatenate([outer, middle, outer[:, ::-1]], axis=1)
    else:
        outer[:, -1] += _WHOLE // 2 - outer.sum(axis=1)
        whole = np.concatenate([outer, outer[:, ::-1]], axis=1)
    return whole.astype(np.uint16)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_weighted(image, weights, total):
    for i in range(len(image)):
        total[i] += np.uint32(image[i]) * np.uint32(weights[i])
