"""A volume that grows while a probe scans: images inserted at poses, in a box that is fixed.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.volume.reconstruction.live import LiveReconstruction
>>> from us_sim.volume.reconstruction.live_settings import LiveBox
>>> live = LiveReconstruction(LiveBox(lower=[0, 0, 0], upper=[0.01, 0.01, 0.01], spacing=0.001))
>>> live.insert(np.full((4, 4), 70, np.uint8), np.diag([0.001, 0.001, 0.001, 1.0]))
>>> volume = live.volume()
>>> live.frames, volume.shape, int(volume.intensities[2, 2, 0])
(1, (11, 11, 11), 70)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.reconstruction.grid import grid_around
from us_sim.volume.reconstruction.hole_filling import fill_holes
from us_sim.volume.reconstruction.insertion import Insertion
from us_sim.volume.reconstruction.live_settings import LiveBox
from us_sim.volume.volume import Volume


class LiveReconstruction:
    """Inserts one image after the other.

    Args:
        box: where, and how.

    Raises:
        VolumeError: it has too many voxels, or more than the free memory holds.
    """

    def __init__(self, box: LiveBox) -> None:
        self.box = box
        corners = np.array([box.lower, box.upper])
        self._insertion = Insertion(
            grid_around(corners, box.spacing), method=box.method, compounding=box.compounding
        )
        self._used = np.ones((0, 0), dtype=np.bool_)
        self.frames = 0

    def insert(self, image: NDArray[np.uint8], image_to_patient: NDArray[np.float64]) -> None:
        """Insert an image; pixels that were black in all images so far lie beside the beams.

        Args:
            image: (rows, columns) grey values.
            image_to_patient: (4, 4) m, from (column, row, 0, 1).
        """
        if self._used.shape != image.shape:
            self._used = np.zeros(image.shape, dtype=np.bool_)
        self._used |= image > 0
        self._insertion.insert(np.ascontiguousarray(image), image_to_patient, self._used)
        self.frames += 1

    def clear(self) -> None:
        """Begin anew."""
        self._insertion.clear()
        self.frames = 0

    def volume(self) -> Volume:
        """What has been inserted so far, its holes filled.

        Raises:
            VolumeError: nothing has, within the box.
        """
        grey, covered = self._insertion.result()
        if not covered.any():
            raise VolumeError(
                f"nothing of the {self.frames} images lies in the box from "
                f"{list(self.box.lower)} to {list(self.box.upper)} m; set lower and upper"
            )
        fill_holes(grey, covered, self.box.hole_radius / self.box.spacing)
        return Volume(grey, self._insertion.grid.index_to_reference)
