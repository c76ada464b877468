"""Tracked freehand sweeps: Plus' sequence files, an image and a pose at a time.

A MetaImage file whose third axis is time, and whose header gives every frame its transforms (4×4,
millimetres, row by row), their status and a time stamp (plustoolkit.org, "Sequence file").

>>> import pathlib, tempfile
>>> from us_sim.volume.sequences.sweep import read_sweep
>>> header = '''ObjectType = Image
... NDims = 3
... DimSize = 4 3 1
... ElementType = MET_UCHAR
... UltrasoundImageOrientation = MFA
... Seq_Frame0000_ImageToReferenceTransform = 0.2 0 0 -10 0 0 -0.2 0 0 0.2 0 30 0 0 0 1
... Seq_Frame0000_Timestamp = 0.5
... ElementDataFile = LOCAL
... '''
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "sweep.igs.mha")
...     _ = path.write_bytes(header.encode() + bytes(range(12)))
...     sweep = read_sweep(path)
...     (image,) = sweep.images([0])
>>> sweep.image_to_reference[0] @ [3, 2, 0, 1]
array([-0.0094,  0.    ,  0.0304,  1.    ])
>>> image[2]
array([ 8,  9, 10, 11], dtype=uint8)
"""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.metaimage import metaimage_header, metaimage_voxels
from us_sim.volume.files.stored_voxels import StoredVoxels
from us_sim.volume.sequences.sequence_header import frame_fields, frame_matrix, frame_time

__all__ = ["Sweep", "read_sweep"]

_METRES = 1e-3  # the format holds millimetres
_CHUNK = 1 << 20
_LARGEST_IMAGE = 1 << 24  # pixels, 4096 × 4096
_MOST_FRAMES = 1 << 20  # four hours at 60 Hz


@dataclass(frozen=True, eq=False)
class Sweep:
    """Images of a moving probe with the pose of each; the images stay in the file."""

    path: Path
    columns: int
    rows: int
    numbers: NDArray[np.int64]  # (K,) which frames of the file these are, ascending
    times: NDArray[np.float64]  # (K,) s, the recorder's clock
    # (K, 4, 4) m, from (column, row, 0, 1) of pixel centres to the sweep's reference frame
    image_to_reference: NDArray[np.float64]
    left_out: Mapping[str, int]  # frames without a usable pose or time, by reason
    _data: _Data

    def images(self, which: Iterable[int] | None = None) -> Iterator[NDArray[np.uint8]]:
        """The images (rows, columns), ascending, one in memory at a time.

        Args:
            which: indices into `numbers`; all without it.

        Raises:
            VolumeError: the compressed data are damaged.
        """
        indices = range(len(self.numbers)) if which is None else which
        wanted = sorted({int(self.numbers[i]) for i in indices})
        try:
            for frame in self._data.frames(wanted):
                yield np.frombuffer(frame, dtype=np.uint8).reshape(self.rows, self.columns)
        except (EOFError, zlib.error) as error:
            raise VolumeError(
                f"{self.path}: its compressed images are damaged; copy or export it again"
            ) from error


def read_sweep(path: Path, *, tracked: bool = True) -> Sweep:
    """A sequence file with an ``ImageToReferenceTransform`` a frame; its images are read later.

    Frames whose transform or time stamp is missing, not finite or singular, or whose status is
    not OK, are left out and counted.

    Args:
        path: of the file.
        tracked: False takes images without a pose too; the sweep's poses are then all nan.

    Raises:
        VolumeError: the file is missing, is no sequence of 8-bit grey images, is cut, or no frame
            of it can be used.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise VolumeError(f"{path}: there is no such file; give a sequence (.igs.mha) of Plus")
    # The first bytes tell, so that a vast file of another kind is not read as a header.
    with path.open("rb") as file:
        if b"=" not in file.read(256):
            raise VolumeError(f"{path}: is no MetaImage; give a sequence (.igs.mha) of Plus")
    header, header_bytes = metaimage_header(path)
    frames = frame_fields(header)
    if not frames:
        raise VolumeError(
            f"{path}: holds no tracked frames (Seq_Frame0000_...); give a sequence of Plus"
        )
    columns, rows, count = _size(path, header)
    voxels = metaimage_voxels(path, header, header_bytes)
    if not voxels.packed:  # packed images are checked as they are read
        voxels.check_bytes()
    numbers, times, matrices = [], [], []
    left_out: dict[str, int] = {}
    for number in range(count):
        fields = frames.get(number, {})
        try:
            matrix, time = _usable(fields, tracked)
        except ValueError as reason:
            left_out[str(reason)] = left_out.get(str(reason), 0) + 1
            continue
        numbers.append(number)
        times.append(time)
        matrices.append(matrix)
    if not numbers:
        raise VolumeError(_nothing_usable(path, frames, left_out, count))
    return Sweep(
        path,
        columns,
        rows,
        np.array(numbers, dtype=np.int64),
        np.array(times),
        np.array(matrices),
        left_out,
        _Data(voxels, columns * rows),
    )


def _size(path: Path, header: Mapping[str, str]) -> tuple[int, int, int]:
    """Columns, rows and frames, of images that can be understood."""
    try:
        columns, rows, *between, count = (int(n) for n in header["DimSize"].split())
        channels = int(header.get("ElementNumberOfChannels", "1"))
    except (KeyError, ValueError) as error:
        raise VolumeError(
            f"{path}: its DimSize is {header.get('DimSize')!r} where a sequence has columns, rows "
            f"and frames; export it again"
        ) from error
    # Newer versions of Plus write a depth of 1 before the number of frames.
    if between not in ([], [1]):
        raise VolumeError(f"{path}: is a sequence of volumes; give one of flat images")
    if min(columns, rows, count) < 1:
        raise VolumeError(
            f"{path}: holds poses without images ({columns} × {rows} pixels, {count} frames); "
            f"record the images too"
        )
    if columns * rows > _LARGEST_IMAGE or count > _MOST_FRAMES:
        raise VolumeError(
            f"{path}: says it holds {count} images of {columns} × {rows} pixels; {_MOST_FRAMES} of "
            f"{_LARGEST_IMAGE} pixels are read at most: export a part of it"
        )
    element = header.get("ElementType")
    if element != "MET_UCHAR" or channels != 1:
        raise VolumeError(
            f"{path}: holds {channels} × {element} per pixel; save it as 8-bit grey values"
        )
    orientation = header.get("UltrasoundImageOrientation", "MF")
    if orientation[:2] != "MF":
        # The transforms of Plus hold for the image turned to MF, which is not documented.
        raise VolumeError(
            f"{path}: its images are stored in the orientation {orientation}; "
            f"save it with UltrasoundImageOrientation MF"
        )
    return columns, rows, count


def _usable(fields: Mapping[str, str], tracked: bool) -> tuple[NDArray[np.float64], float]:
    """A frame's (4, 4) matrix in metres, and its time in s.

    Raises:
        ValueError: with the reason why it cannot be used.
    """
    if fields.get("ImageStatus", "OK").upper() != "OK":
        raise ValueError("ImageStatus is not OK")
    if not tracked:
        return np.full((4, 4), math.nan), frame_time(fields)
    matrix = frame_matrix(fields, "ImageToReferenceTransform")
    matrix[:3] *= _METRES
    return matrix, frame_time(fields)


def _nothing_usable(
    path: Path, frames: Mapping[int, Mapping[str, str]], left_out: Mapping[str, int], count: int
) -> str:
    why = ", ".join(f"{number} with {reason}" for reason, number in left_out.items())
    there = sorted({key for fields in frames.values() for key in fields if "To" in key})
    there = [key for key in there if key.endswith("Transform")]
    has = f"; it has {', '.join(there)}: calibrate the image and export again" if there else ""
    return f"{path}: none of its {count} frames can be used ({why}){has}"


@dataclass(frozen=True)
class _Data:
    """The images, one after another: in the file after its header, or in another."""

    voxels: StoredVoxels
    frame: int  # bytes

    def frames(self, wanted: Iterable[int]) -> Iterator[bytes]:
        """The bytes of frames, whose numbers ascend.

        Raises:
            EOFError, zlib.error: there are fewer than promised, or they are damaged.
        """
        with self.voxels.file.open("rb") as file:
            file.seek(self.voxels.start)
            stream: BinaryIO | _Inflated = _Inflated(file) if self.voxels.packed else file
            at = 0
            for number in wanted:
                while at < number:
                    stream.read(self.frame)
                    at += 1
                data = stream.read(self.frame)
                at += 1
                if len(data) != self.frame:
                    raise EOFError
                yield data


class _Inflated:
    """The plain bytes of a zlib stream in a file, a piece at a time."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(32 + zlib.MAX_WBITS)  # zlib or gzip

    def read(self, count: int) -> bytes:
        """The next ``count`` bytes; fewer at the end."""
        pieces = []
        while count:
            packed = self._inflate.unconsumed_tail or self._file.read(_CHUNK)
            piece = self._inflate.decompress(packed, count)
            if not packed and not piece:
                break
            pieces.append(piece)
            count -= len(piece)
        return b"".join(pieces)
