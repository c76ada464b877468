"""M-mode: the echoes along one beam, over time.

>>> import numpy as np
>>> from us_sim.slicing.m_mode import MMode
>>> from us_sim.slicing.m_mode_settings import MModeSettings
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=64, rows=64)
>>> image = np.zeros((64, 64), np.uint8)
>>> image[32:, 48] = 200
>>> line = MMode(probe, MModeSettings(lateral=16.5 / 64)).line(image)  # column 48
>>> int(line[0]), int(line[-1])
(0, 200)
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.drawing.sweep_picture import SweepPicture
from us_sim.slicing.m_mode_settings import MModeSettings
from us_sim.slicing.probe.beam_places import pixels_of
from us_sim.slicing.probe.probe import Probe

_ROWS, _COLUMNS = 384, 512


class MMode:
    """The echoes along a line of one probe's images.

    Args:
        probe: its geometry.
        settings: of the line.
    """

    def __init__(self, probe: Probe, settings: MModeSettings) -> None:
        self.settings = settings
        depth = (np.arange(_ROWS) + 0.5) * (probe.depth / _ROWS)
        places = pixels_of(probe, np.full(_ROWS, settings.lateral), depth)
        #: (2, 2) column and row of the ends of the line.
        self.places = places[[0, -1]]
        column, row = places.astype(np.float32).T
        self._column, self._row = column.copy()[:, None], row.copy()[:, None]
        self._picture = SweepPicture(
            _ROWS, _COLUMNS, settings.sweep, (0.0, 1e3 * probe.depth, "mm")
        )

    def go_on(self, before: MMode) -> None:
        """Go on with the picture of a line that looked elsewhere, if its scales are the same."""
        if before._picture.layout == self._picture.layout:
            self._picture = before._picture

    def line(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Grey values (rows,) along the line of an image (rows, columns), from the face down."""
        linear, edge = cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
        line = cv2.remap(image, self._column, self._row, linear, borderMode=edge)
        return np.asarray(line, dtype=np.uint8)[:, 0]

    def show(self, image: NDArray[np.uint8], time: float) -> NDArray[np.uint8]:
        """The picture (rows, columns, 3) up to the image at a time (s), with its scales.

        Between two images it shows the later one.
        """
        count = len(self._picture.moments(time))
        self._picture.add(np.repeat(self.line(image)[:, None], count, axis=1))
        return self._picture.drawn()
