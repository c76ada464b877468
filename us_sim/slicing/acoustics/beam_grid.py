"""The beams along which sound is followed: half as many as pixels, with a few samples a millimetre.

>>> from us_sim.slicing.acoustics.beam_grid import BeamGrid
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> grid = BeamGrid(LinearProbe(aperture=0.04, depth=0.04, columns=512, rows=512))
>>> grid.beams, grid.samples, round(grid.step * 1e3, 4)  # mm
(256, 86, 0.4688)
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.probe.probe import LinearProbe, Probe

LOCATED = (2, 2)
"""Rows and columns from one pixel to the next of those that beams know the place of."""

_STEP = 0.45e-3  # m, between samples, where the image is as fine as that
_PIXELS_ACROSS = 2  # a beam
_ROWS = (2, 6)  # rows a sample, at least and at most

_F_NUMBER = 2.0  # depth over the length of face that looks there
_APERTURE = (1.5e-3, 1 / 3)  # m, and fraction of the face: the least and the most that is used


class BeamGrid:
    """Beams of a probe and samples along them, both evenly spaced.

    Sample ``s`` lies ``(s + 0.5) step`` along its beam; beam ``k`` is the middle of the k-th of
    as many equal parts of the face, or of the opening angle.
    """

    def __init__(self, probe: Probe) -> None:
        lateral, axial = probe.pixel_spacing
        self.is_linear = is_linear = isinstance(probe, LinearProbe)
        rows = min(max(round(_STEP / axial), _ROWS[0]), _ROWS[1])
        self.pixels = (rows, _PIXELS_ACROSS)  # rows a sample, columns a beam of a linear array
        self.step = float(rows * axial)  # m
        self.samples = max(2, math.ceil(probe.depth / self.step - 1e-6))
        self.distance = (np.arange(self.samples) + 0.5) * self.step  # (samples,) m
        if is_linear:
            self.beams = max(1, -(-probe.columns // _PIXELS_ACROSS))
            part = (np.arange(self.beams) + 0.5) * _PIXELS_ACROSS / probe.columns
        else:
            ends = (probe.beam_starts, probe.beam_starts + probe.depth * probe.beam_directions)
            widest = max(np.linalg.norm(np.diff(end, axis=0), axis=1).sum() for end in ends)
            self.beams = max(2, math.ceil(widest / (_PIXELS_ACROSS * math.sqrt(lateral * axial))))
            part = (np.arange(self.beams) + 0.5) / self.beams
        self.starts, self.directions = probe.rays(np.minimum(part, 1.0))  # m, and unit: x and z
        x = self.starts[:, 0] + self.distance[:, None] * self.directions[:, 0]
        z = self.starts[:, 1] + self.distance[:, None] * self.directions[:, 1]
        between = np.hypot(np.diff(x, axis=1), np.diff(z, axis=1))
        self.spacing = np.full(self.samples, _PIXELS_ACROSS * lateral)  # m, between beams
        if not is_linear:
            self.spacing = np.maximum(np.median(between, axis=1), 1e-6)
        left, top = probe.image_to_probe[[0, 2], 3]
        self.columns = (x - left) / lateral  # (samples, beams), fractional
        self.rows = (z - top) / axial
        self.aperture = aperture(probe, self.distance)  # (samples,) m
        self.places = self._places(probe, None if is_linear else _nearest_shown(probe))
        self._shape = probe.rows, probe.columns
        self._maps = None if is_linear else self._pixel_places(probe)

    @property
    def lines(self) -> NDArray[np.float64]:
        """(beams, 4): column and row of each beam's first sample, and from sample to sample."""
        first = np.stack([self.columns[0], self.rows[0]])
        return np.ascontiguousarray(
            np.concatenate([first, np.stack([self.columns[1], self.rows[1]]) - first]).T
        )

    def _places(
        self, probe: Probe, nearest: tuple[NDArray[np.int32], NDArray[np.int32]] | None
    ) -> NDArray[np.int32]:
        """(beams, samples): which of the located pixels, flat, is nearest to each sample.

        Of those that beams reach, since the nearest of all may lie beside a fan.
        """
        row_step, step = LOCATED
        many = -(-probe.columns // step)
        row = np.clip(np.rint(self.rows / row_step), 0, (probe.rows - 1) // row_step).astype(int)
        column = np.clip(np.rint(self.columns / step), 0, many - 1).astype(int)
        if nearest is not None:
            row, column = nearest[0][row, column], nearest[1][row, column]
        return np.ascontiguousarray((row * many + column).T, dtype=np.int32)

    def _pixel_places(self, probe: Probe) -> tuple[NDArray, NDArray]:
        """Where each pixel lies among samples and beams, as `cv2.remap` takes it."""
        line, distance = probe.pixel_beams
        row, column = _nearest(~np.isnan(line))
        beam = (line[row, column] + 0.5) * (self.beams / probe.lines) - 0.5
        sample = distance[row, column] / self.step - 0.5
        beam = np.clip(beam, 0, self.beams - 1).astype(np.float32)
        sample = np.clip(sample, 0, self.samples - 1).astype(np.float32)
        nearest, fractions = cv2.convertMaps(beam, sample, cv2.CV_16SC2)
        return np.asarray(nearest), np.asarray(fractions)

    @property
    def room(self) -> tuple[int, int]:
        """Rows and columns of pixels that all samples and beams of a linear array are on."""
        return self.samples * self.pixels[0], self.beams * self.pixels[1]

    def on_pixels(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Values (samples, beams) at the pixels (rows, columns), linear in between."""
        rows, columns = self._shape
        if self._maps is None:
            resized: Any = cv2.resize(values, self.room[::-1], interpolation=cv2.INTER_LINEAR)
            return np.asarray(resized)[:rows, :columns]
        remapped = cv2.remap(values, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(remapped)


def _nearest_shown(probe: Probe) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Row and column of the pixel nearest to each that a beam reaches, all in steps of two."""
    row, column = _nearest(~np.isnan(probe.pixel_beams[0, ::2, ::2]))
    return row, column


def _nearest(marked: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(2, rows, columns) row and column of the marked pixel that is nearest to each."""
    from scipy.ndimage import distance_transform_edt  # which only a fan needs

    nearest: NDArray[np.int32] = distance_transform_edt(
        ~marked, return_distances=False, return_indices=True
    )
    return nearest


def aperture(probe: Probe, depth: NDArray[Any]) -> NDArray[np.float64]:
    """(D,) m, of the face that forms an echo at depths (D,) m: as long as keeps the f-number."""
    starts = probe.rays(np.array([0.0, 1.0]))[0]
    length = float(np.linalg.norm(starts[1] - starts[0]))
    length = max(length, getattr(probe, "aperture", 0.0))  # a phased array uses all of its face
    least, most = _APERTURE
    return np.clip(depth / _F_NUMBER, least, max(most * length, least))
