"""The images of a sequence where they are: in its file, raw or packed, one after another.

>>> import pathlib, tempfile, zlib
>>> import numpy as np
>>> from us_sim.volume.files.stored_voxels import StoredVoxels
>>> from us_sim.volume.sequences.stored_images import StoredImages
>>> with tempfile.TemporaryDirectory() as folder:
...     file = pathlib.Path(folder, "images.raw")
...     _ = file.write_bytes(zlib.compress(bytes(range(12))))
...     voxels = StoredVoxels((3, 2, 2), np.dtype("u1"), file, file, encoding="packed")
...     (image,) = StoredImages(voxels, columns=3, rows=2, channels=1, orientation="UF").read([1])
>>> image
array([[ 8,  7,  6],
       [11, 10,  9]], dtype=uint8)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.volume.files.grey_levels import GreyLevels
from us_sim.volume.files.stored_voxels import StoredVoxels
from us_sim.volume.sequences.orientation import turned


@dataclass(frozen=True)
class StoredImages:
    """Images, grey or red, green and blue; other numbers than bytes are spread over all frames."""

    voxels: StoredVoxels
    columns: int  # as they are stored
    rows: int
    channels: int  # 1 or 3
    orientation: str

    def read(self, wanted: Iterable[int]) -> Iterator[NDArray[np.uint8]]:
        """Grey images (rows, columns) turned to ``MF``, one in memory at a time.

        Args:
            wanted: numbers of frames, ascending.

        Raises:
            VolumeError: there are fewer than promised, or they are damaged.
        """
        levels = self._levels
        for numbers in self.voxels.pieces(self._size, wanted):
            image = levels(numbers)
            if self.channels > 1:
                colours = image.reshape(self.rows, self.columns, self.channels)
                image = np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
            image = image.reshape(self.rows, self.columns)
            yield np.ascontiguousarray(turned(image, self.orientation))

    @property
    def _size(self) -> int:
        return self.columns * self.rows * self.channels

    @cached_property
    def _levels(self) -> GreyLevels:
        if self.voxels.type == np.uint8:
            return GreyLevels()
        return GreyLevels.over(self.voxels.header, self.voxels.pieces(self._size))
