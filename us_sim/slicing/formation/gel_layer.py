"""The layer between the transducer's face and the mesh under it, where a line is coupled.

The triangles of a coarse mesh stand off a face that their nodes touch, by a millimetre or two where
it digs in (`us_sim.slicing.formation.coupling`). Skin and gel fill that layer, and no tetrahedron
carries the volume there. It shows the tissue beyond it, mirrored: grain and brightness go on to the
face without a seam, and nothing is made up that is not there.

>>> import numpy as np
>>> from us_sim.slicing.formation.gel_layer import GelLayer
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=4, rows=40, lines=4)
>>> slice_ = np.zeros((40, 4), dtype=np.uint8)
>>> slice_[2:] = np.arange(2, 40)[:, None]  # 2 mm off the face
>>> layer = GelLayer(probe)
>>> layer.filled(slice_, np.full(4, 2e-3), np.array([1.0, 1.0, 0.0, 0.0]))[:5, [0, 3]].T
array([[5, 4, 3, 3, 4],
       [0, 0, 2, 3, 4]], dtype=uint8)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.probe.probe import Probe

_THICKEST = 5e-3
"""m, of a layer that is filled: what is more is not the mesh's coarseness."""

_TRIES, _NEARER = 4, 0.8
_BESIDE = (0, 1, -1)  # columns
_NOT_FILLED = -1.0  # in place of how thick the layer is


class GelLayer:
    """Fills what no tetrahedron covers in front of a coupled face."""

    def __init__(self, probe: Probe) -> None:
        line, distance = probe.pixel_beams
        self._row, self._column = np.nonzero(distance < _THICKEST)
        near = self._row, self._column
        self._line, self._distance = line[near], distance[near]
        numbers = np.arange(probe.lines)
        steps = probe.beam_directions / probe.pixel_spacing
        # Columns and rows per metre of depth along each pixel's beam.
        self._along = np.stack([np.interp(self._line, numbers, step) for step in steps.T])
        # A pixel that the surface crosses is not covered whole.
        self._margin = float(probe.pixel_spacing[1])
        # With the kernel loaded the first layer is not late.
        image = np.zeros((probe.rows, probe.columns), np.uint8)
        self.filled(image, np.full(probe.lines, 1e-6), np.ones(probe.lines))

    def filled(
        self, image: NDArray[np.uint8], gap: NDArray[np.float64], coupling: NDArray[np.floating]
    ) -> NDArray[np.uint8]:
        """The slice (rows, columns) with the layer filled; the slice itself where there is none.

        Args:
            image: the slice.
            gap: (lines,) m, from the face to the surface of the mesh along each line.
            coupling: (lines,); lines without stay as they are.
        """
        filled = (coupling > 0.0) & (gap <= _THICKEST)
        thick = np.where(filled, np.maximum(gap, 0.0), _NOT_FILLED)
        if not (thick > 0.0).any():
            return image
        out = image.copy()
        pixels = self._row, self._column, self._line, self._distance, self._along
        _mirror(image, *pixels, thick, self._margin, out)
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def _mirror(image, row, column, line, distance, along, thick, margin, out):
    """Sets pixels of out (rows, columns) that lie in the layer, thick (lines,) m, if not negative.

    Args:
        row, column, line, distance: (P,) of the pixels, and where they are on their beams (m).
        along: (2, P), columns and rows per metre along these.
        margin: m, by which the layer counts as thicker.
    """
    rows, columns = image.shape
    last = len(thick) - 1
    for p in range(len(row)):
        at = min(max(line[p], 0.0), last)
        one = int(at)
        other = min(one + 1, last)
        near, far = thick[one], thick[other]
        if near < 0.0 or far < 0.0:
            near = far = near if at - one < 0.5 else far
            if near < 0.0:
                continue
        end = near + (at - one) * (far - near) + margin
        if distance[p] >= end:
            continue
        away = 2.0 * (end - distance[p])
        # At a fan's side the mirrored place may be beyond it: then one beside it, or nearer.
        for attempt in range(_TRIES * len(_BESIDE)):
            c = int(column[p] + away * along[0, p] + 0.5) + _BESIDE[attempt % len(_BESIDE)]
            r = int(row[p] + away * along[1, p] + 0.5)
            if 0 <= c < columns and 0 <= r < rows and image[r, c] > 0:
                out[row[p], column[p]] = image[r, c]
                break
            if attempt % len(_BESIDE) == len(_BESIDE) - 1:
                away *= _NEARER
