"""Tracked sequences of Plus and 3D Slicer: frames with times and transforms, and maybe images.

``.igs.mha``, ``.mha``, ``.igs.nrrd`` and ``.seq.nrrd``: an image file whose last axis is time, and
whose header gives every frame its transforms (4×4, millimetres, row by row), their status and a
time stamp (plustoolkit.org, "Sequence file"). Images stay in the file until they are asked for.

>>> import pathlib, tempfile
>>> from us_sim.volume.sequences.sequence import read_sequence
>>> header = '''ObjectType = Image
... NDims = 3
... DimSize = 4 3 1
... ElementType = MET_UCHAR
... UltrasoundImageOrientation = UFA
... Seq_Frame0000_ToolTipToTrackerTransform = 1 0 0 10 0 1 0 20 0 0 1 30 0 0 0 1
... Seq_Frame0000_Timestamp = 0.5
... ElementDataFile = LOCAL
... '''
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "sweep.igs.mha")
...     _ = path.write_bytes(header.encode() + bytes(range(12)))
...     sequence = read_sequence(path)
...     (image,) = sequence.images()
>>> image[0], sequence.transforms["ToolTipToTracker"].matrices[0, :3, 3]
(array([3, 2, 1, 0], dtype=uint8), array([0.01, 0.02, 0.03]))
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.sequences.frame_transforms import FrameTransforms, read_transforms
from us_sim.volume.sequences.orientation import is_orientation, is_transposed
from us_sim.volume.sequences.sequence_file import SequenceFile, read_sequence_file
from us_sim.volume.sequences.sequence_header import frame_time
from us_sim.volume.sequences.stored_images import StoredImages

_LARGEST_IMAGE = 1 << 24  # pixels, 4096 × 4096
NO_TIME = "no Timestamp"
NO_IMAGE = "ImageStatus is not OK"
NO_FIELDS = "no field in the header"
"""Why frames cannot be used."""


@dataclass(frozen=True, eq=False)
class TrackedSequence:
    """The frames that the header describes; what is not valid is nan, and it is said why."""

    path: Path
    columns: int  # of the images, turned to MF; 0 where there are none
    rows: int
    count: int  # frames of the file
    numbers: NDArray[np.int64]  # (K,) which of them are described, ascending
    times: NDArray[np.float64]  # (K,) s, the recorder's clock; nan where there is none
    image_is_valid: NDArray[np.bool_]  # (K,) by its status
    transforms: Mapping[str, FrameTransforms]  # by name, such as ProbeToTracker
    are_colours: bool  # the images are stored in colours and read in grey
    _stored: StoredImages | VolumeError

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def has_images(self) -> bool:
        """Whether the file holds images, which may still be such as cannot be read."""
        return self.columns > 0

    def require_images(self) -> StoredImages:
        """Where the images are.

        Raises:
            VolumeError: there are none, or none that can be read.
        """
        if isinstance(self._stored, VolumeError):
            raise self._stored
        return self._stored

    def images(self, which: Iterable[int] | None = None) -> Iterator[NDArray[np.uint8]]:
        """The images (rows, columns) in grey, turned to ``MF``, one in memory at a time.

        Args:
            which: indices into `numbers`; they come in ascending order. All without it.

        Raises:
            VolumeError: there are no images, or they cannot be read or are damaged.
        """
        indices = range(len(self)) if which is None else which
        return self.require_images().read(sorted({int(self.numbers[i]) for i in indices}))

    def faults(self, transforms: FrameTransforms | None, *, images: bool) -> list[str]:
        """(K,) why each frame cannot be used, or an empty text.

        Args:
            transforms: that are needed, or None.
            images: whether they are needed.
        """
        found = [""] * len(self) if transforms is None else list(transforms.faults)
        for k in np.flatnonzero(np.isnan(self.times)):
            found[k] = found[k] or NO_TIME
        if images:
            for k in np.flatnonzero(~self.image_is_valid):
                found[k] = NO_IMAGE
        return found

    def left_out(self, faults: Iterable[str]) -> dict[str, int]:
        """How many frames cannot be used, by the reason; those not described are counted too."""
        reasons = Counter(fault for fault in faults if fault)
        if self.count > len(self):
            reasons[NO_FIELDS] = self.count - len(self)
        return dict(reasons)


def read_sequence(path: str | os.PathLike[str]) -> TrackedSequence:
    """A sequence file of Plus or 3D Slicer, MetaImage or NRRD, raw or packed by zlib or gzip.

    Transforms that are missing, not finite or singular, whose status is not OK, or that are the
    identity that Plus fills in for what it has not seen, are not valid; the reason is kept.

    Raises:
        VolumeError: the file is missing, is no sequence, or is cut within its header.
    """
    file = read_sequence_file(Path(path))
    numbers = sorted(number for number in file.frames if number < file.count)
    if not numbers:
        raise VolumeError(
            f"{path}: describes none of the {file.count} frames that it holds; export it again"
        )
    frames = [file.frames[number] for number in numbers]
    columns, rows = file.columns, file.rows
    if is_orientation(file.orientation) and is_transposed(file.orientation):
        columns, rows = rows, columns
    return TrackedSequence(
        file.path,
        columns,
        rows,
        file.count,
        np.array(numbers, dtype=np.int64),
        np.array([_time(fields) for fields in frames]),
        np.array([fields.get("ImageStatus", "OK").upper() == "OK" for fields in frames]),
        read_transforms(file.path, frames),
        file.channels > 1,
        _stored_images(file),
    )


def _time(fields: Mapping[str, str]) -> float:
    try:
        return frame_time(fields)
    except ValueError:
        return math.nan


def _stored_images(file: SequenceFile) -> StoredImages | VolumeError:
    """Where the images are, or why they cannot be read, which matters to who wants them only."""
    path, size = file.path, f"{file.columns} × {file.rows} pixels"
    if not file.columns:
        return VolumeError(
            f"{path}: holds poses without images ({file.count} frames); record the images too"
        )
    if file.columns * file.rows > _LARGEST_IMAGE:
        return VolumeError(
            f"{path}: says it holds {file.count} images of {size}; {_LARGEST_IMAGE} pixels are "
            f"read at most: export a part of it"
        )
    if file.channels not in (1, 3):
        return VolumeError(
            f"{path}: holds {file.channels} numbers per pixel; save it as grey values or colours"
        )
    if not is_orientation(file.orientation):
        return VolumeError(
            f"{path}: its images are stored in the orientation {file.orientation[:20]!r}; save it "
            f"with UltrasoundImageOrientation MF, UF, MN, UN, FM, FU, NM or NU"
        )
    try:
        voxels = file.voxels()
        if voxels.encoding == "raw":  # packed images are checked as they are read
            voxels.check_bytes()
    except VolumeError as error:
        return error
    return StoredImages(voxels, file.columns, file.rows, file.channels, file.orientation)
