"""An image in a MetaImage, NRRD or NIfTI file: how its numbers are stored, and where they lie.

>>> import numpy as np
>>> from pathlib import Path
>>> from us_sim.volume.files.stored_image import StoredImage
>>> from us_sim.volume.files.stored_voxels import StoredVoxels
>>> voxels = StoredVoxels((2, 4, 5, 6), np.dtype("u1"), Path("a.nrrd"), Path("a.nrrd"))
>>> StoredImage(voxels, 2, lambda: np.eye(4)).shape
(4, 5, 6)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.stored_voxels import StoredVoxels, check_claim


@dataclass(frozen=True)
class StoredImage:
    """What a header says."""

    voxels: StoredVoxels
    components: int  # numbers of a voxel; where there are several they are the first axis
    placement: Callable[[], NDArray[np.float64]]  # (4, 4) m, from indices; raises VolumeError
    scaling: tuple[float, float] = (1.0, 0.0)  # slope and offset of what the numbers stand for
    texts: Mapping[str, str] = field(default_factory=dict)  # further keys and values

    @property
    def axes(self) -> tuple[int, ...]:
        """Voxels along each axis."""
        return self.voxels.size[self.components > 1 :]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along each axis of a volume."""
        i, j, k = self.axes[:3]
        return i, j, k

    @property
    def volumes(self) -> int:
        """How many volumes there are one after another."""
        return self.axes[3] if len(self.axes) == 4 else 1

    def check(self, *, layers: bool = False) -> None:
        """Refuse what is no volume, or none that can be read.

        Args:
            layers: a voxel may have several numbers, as segmentations of 3D Slicer have.

        Raises:
            VolumeError: it is not of three dimensions, or of four as several volumes, has one voxel
                only along an axis, several numbers a voxel, or is larger than what is read.
        """
        path, axes = self.voxels.header, self.axes
        if len(axes) not in (3, 4):
            raise VolumeError(f"{path}: is {len(axes)}-dimensional; a volume has three dimensions")
        if min(axes[:3]) < 2:
            raise VolumeError(
                f"{path}: has {' × '.join(map(str, axes))} voxels; a volume needs two or more "
                f"along each axis"
            )
        if self.components != 1 and not layers:
            raise VolumeError(
                f"{path}: holds {self.components} numbers per voxel; convert it to one grey value"
            )
        check_claim(path, (*self.shape, self.components), self.voxels.type.itemsize)

    def slices(self, volume: int = 1) -> Iterator[NDArray[Any]]:
        """The slices (j, i) of a volume, or (j, i, component), with what their numbers stand for.

        Args:
            volume: which one where there are several.

        Raises:
            VolumeError: the file holds more or fewer numbers, or is damaged.
        """
        i, j, k = self.shape
        slope, offset = self.scaling
        wanted = None
        if self.volumes > 1:
            self.voxels.check_bytes()
            wanted = range(k * (volume - 1), k * volume)
        form = (j, i, self.components) if self.components > 1 else (j, i)
        for numbers in self.voxels.pieces(i * j * self.components, wanted):
            image = numbers.reshape(form)
            yield image if self.scaling == (1.0, 0.0) else image * slope + offset
