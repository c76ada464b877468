"""A volume that grows while a probe scans: images inserted at poses, in a box that is fixed.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.volume.reconstruction.live import LiveBox, LiveReconstruction
>>> live = LiveReconstruction(LiveBox(lower=[0, 0, 0], upper=[0.01, 0.01, 0.01], spacing=0.001))
>>> live.insert(np.full((4, 4), 70, np.uint8), np.diag([0.001, 0.001, 0.001, 1.0]))
>>> volume = live.volume()
>>> live.frames, volume.shape, int(volume.intensities[2, 2, 0])
(1, (11, 11, 11), 70)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.reconstruction.grid import grid_around
from us_sim.volume.reconstruction.hole_filling import fill_holes
from us_sim.volume.reconstruction.insertion import Insertion
from us_sim.volume.reconstruction.settings import METHODS
from us_sim.volume.volume import Volume

__all__ = ["LIVE_COMPOUNDINGS", "LiveBox", "LiveReconstruction", "LiveVolume"]

LIVE_COMPOUNDINGS = ("mean", "max", "latest")
"""Those that need no image twice."""

_PLACE = Quantity("length", -100.0, 100.0)
_VOLUMES = (".nrrd", ".mha", ".nii", ".nii.gz")


@dataclass(frozen=True)
class LiveBox(Settings):
    """The box that is filled, and how."""

    error = VolumeError

    lower: tuple[float, float, float] = setting(
        _PLACE, "corner of the box in frame `patient`", default=(-0.06, -0.06, -0.01)
    )
    upper: tuple[float, float, float] = setting(
        _PLACE, "its opposite corner", default=(0.06, 0.06, 0.11)
    )
    spacing: float = setting(Quantity("length", 1e-5, 0.02), "side of a voxel", default=0.5e-3)
    method: str = setting(description="of insertion", choices=METHODS, default="nearest")
    compounding: str = setting(
        description="of several pixels in one voxel", choices=LIVE_COMPOUNDINGS, default="mean"
    )
    hole_radius: float = setting(
        Quantity("length", 0.0, 0.05), "of the largest hole that is filled", default=1e-3
    )

    def check(self) -> None:
        """Refuse a box that is inside out."""
        for low, high in zip(self.lower, self.upper, strict=True):
            if not low < high:
                raise self.refused("upper", "must lie beyond `lower` along each axis")


@dataclass(frozen=True)
class LiveVolume(Settings):
    """Where the volume goes, and where the pixels of an image lie on the probe."""

    error = VolumeError

    file: str = setting(
        description="to save to: .nrrd, .mha or .nii.gz; a number is added where it is taken",
        default="volume.nrrd",
    )
    pixel_size: tuple[float, float] = setting(
        Quantity("length", 1e-6, 0.01),
        "of an image, across and down, until `ultrasound/image_to_probe` says it",
        default=(0.2e-3, 0.2e-3),
    )
    first_pixel: tuple[float, float] = setting(
        Quantity("length", -1.0, 1.0),
        "where the first one lies in frame `probe`, along x and z, likewise",
        default=(0.0, 0.0),
    )

    def check(self) -> None:
        """Refuse a file that could not be written at the end."""
        if not self.file.lower().endswith(_VOLUMES):
            raise self.refused("file", f"{self.file}: must end in {', '.join(_VOLUMES)}")

    @property
    def image_to_probe(self) -> NDArray[np.float64]:
        """(4, 4) m, from (column, row, 0, 1) to frame ``probe``."""
        across, down = self.pixel_size
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 2], matrix[2, 1], matrix[3, 3] = across, across, down, 1.0
        matrix[0, 3], matrix[2, 3] = self.first_pixel
        return matrix


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
