"""The images of a sequence where they are: in its file, raw or packed, one after another.

>>> import pathlib, tempfile, zlib
>>> from us_sim.volume.files.stored_voxels import StoredVoxels
>>> from us_sim.volume.sequences.stored_images import StoredImages
>>> with tempfile.TemporaryDirectory() as folder:
...     file = pathlib.Path(folder, "images.raw")
...     _ = file.write_bytes(zlib.compress(bytes(range(12))))
...     voxels = StoredVoxels((3, 2, 2), 1, file, file, packed=True)
...     (image,) = StoredImages(voxels, columns=3, rows=2, channels=1, orientation="UF").read([1])
>>> image
array([[ 8,  7,  6],
       [11, 10,  9]], dtype=uint8)
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.stored_voxels import StoredVoxels
from us_sim.volume.sequences.orientation import turned

__all__ = ["StoredImages"]

_CHUNK = 1 << 20


@dataclass(frozen=True)
class StoredImages:
    """Images of bytes, grey or red, green and blue."""

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
        size = self.columns * self.rows * self.channels
        try:
            for data in self._frames(wanted, size):
                numbers = np.frombuffer(data, dtype=np.uint8)
                if self.channels > 1:
                    colours = numbers.reshape(self.rows, self.columns, self.channels)
                    numbers = np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
                image = numbers.reshape(self.rows, self.columns)
                yield np.ascontiguousarray(turned(image, self.orientation))
        except (EOFError, zlib.error) as error:
            raise VolumeError(
                f"{self.voxels.header}: its compressed images are damaged, or there are fewer than "
                f"its header says; copy or export it again"
            ) from error

    def _frames(self, wanted: Iterable[int], size: int) -> Iterator[bytes]:
        """The bytes of frames, whose numbers ascend."""
        with self.voxels.file.open("rb") as file:
            file.seek(self.voxels.start)
            stream = _Inflated(file) if self.voxels.packed else _Raw(file)
            at = 0
            for number in wanted:
                stream.skip((number - at) * size)
                data = stream.read(size)
                at = number + 1
                if len(data) != size:
                    raise EOFError
                yield data


class _Raw:
    """A file as it is."""

    def __init__(self, file: BinaryIO) -> None:
        self.read = file.read
        self._seek = file.seek

    def skip(self, count: int) -> None:
        self._seek(count, 1)


class _Inflated:
    """The plain bytes of a zlib or gzip stream in a file, a piece at a time."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(32 + zlib.MAX_WBITS)  # zlib or gzip

    def skip(self, count: int) -> None:
        while count > 0:
            count -= len(self.read(min(count, _CHUNK))) or count

    def read(self, count: int) -> bytes:
        """The next ``count`` bytes; fewer at the end."""
        pieces = []
        while count:
            if self._inflate.eof:  # gzip may come in members
                rest = self._inflate.unused_data or self._file.read(_CHUNK)
                if not rest:
                    break
                self._inflate = zlib.decompressobj(32 + zlib.MAX_WBITS)
                packed = rest
            else:
                packed = self._inflate.unconsumed_tail or self._file.read(_CHUNK)
            piece = self._inflate.decompress(packed, count)
            if not packed and not piece:
                break
            pieces.append(piece)
            count -= len(piece)
        return b"".join(pieces)
