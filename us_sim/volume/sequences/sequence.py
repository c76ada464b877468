"""Tracked sequences of Plus and 3D Slicer: frames with times and transforms, and maybe images.

``.igs.mha``, ``.mha``, ``.igs.nrrd`` and ``.seq.nrrd``: an image file whose last axis is time, and
whose header gives every frame its transforms (4×4, millimetres, row by row), their status and a
time stamp (plustoolkit.org, "Sequence file"). Images stay in the file until they are asked for.

An orientation's first letter says where columns go as they are counted up, its second where rows
go: to the probe's marked (M) or unmarked side (U), far from it (F) or near (N). A third letter says
how slices follow in a volume (A ascending, D descending) and means nothing for a flat image. The
transforms of a sequence hold for images in ``MF``, to which Plus turns them as it reads them
(plustoolkit.org, "Ultrasound image orientation").
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.metaimage import metaimage_header, metaimage_voxels
from us_sim.volume.files.nrrd import nrrd_header, nrrd_voxels
from us_sim.volume.files.readers import is_sequence
from us_sim.volume.files.stored_image import GreyLevels, StoredVoxels
from us_sim.volume.sequences.transforms import (
    FrameTransforms,
    frame_fields,
    frame_time,
    read_transforms,
)

SEQUENCE_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr")

_GIVE = "give a sequence of Plus or 3D Slicer (.igs.mha, .igs.nrrd, .seq.nrrd)"
_MOST_FRAMES = 1 << 20  # four hours at 60 Hz
_LARGEST_IMAGE = 1 << 24  # pixels, 4096 × 4096

NO_TIME = "no Timestamp"
NO_IMAGE = "ImageStatus is not OK"
NO_FIELDS = "no field in the header"  # why frames cannot be used


@dataclass(frozen=True)
class _Header:
    """The header of a sequence; the images are as they are stored."""

    path: Path
    columns: int  # along the file's first axis of an image; 0 where there are no images
    rows: int
    channels: int  # numbers a pixel
    count: int  # frames
    orientation: str
    frames: Mapping[int, Mapping[str, str]]  # fields by the frame's number
    voxels: Callable[[], StoredVoxels]  # where the images are; raises VolumeError


@dataclass(frozen=True)
class StoredImages:
    """Images, grey or red, green and blue; other numbers than bytes are spread over all frames."""

    voxels: StoredVoxels
    columns: int  # as they are stored
    rows: int
    channels: int  # 1 or 3
    orientation: str

    def read(self, wanted: Iterable[int]) -> Iterator[NDArray[np.uint8]]:
        """Grey images (rows, columns) turned to ``MF``, one in memory at a time, of frames whose
        numbers ascend.

        Raises:
            VolumeError: there are fewer than promised, or they are damaged.
        """
        import cv2  # which a node that plays poses alone does not need

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


@dataclass(frozen=True, eq=False)
class TrackedSequence:
    """The frames that the header describes; invalid entries are nan, with the reason."""

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

    def require_images(self) -> StoredImages:
        """The images in the file.

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
        """(K,) why each frame cannot be used, given what is needed of it, or an empty text."""
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
        VolumeError: the file is missing, is of another format, a volume, or cut within its
            header, or says no usable size.
    """
    file = _header(Path(path))
    numbers = sorted(number for number in file.frames if number < file.count)
    if not numbers:
        raise VolumeError(
            f"{path}: describes none of the {file.count} frames that it holds; export it again"
        )
    frames = [file.frames[number] for number in numbers]
    columns, rows = file.columns, file.rows
    if _is_orientation(file.orientation) and file.orientation[0] in "FN":
        columns, rows = rows, columns
    return TrackedSequence(
        file.path,
        columns,
        rows,
        file.count,
        np.array(numbers, dtype=np.int64),
        np.array([frame_time(fields) for fields in frames]),
        np.array([fields.get("ImageStatus", "OK").upper() == "OK" for fields in frames]),
        read_transforms(file.path, frames),
        file.channels > 1,
        _stored_images(file),
    )


def _stored_images(file: _Header) -> StoredImages | VolumeError:
    """The images, or the error for whoever asks for them."""
    path = file.path
    if not file.columns:
        return VolumeError(
            f"{path}: holds poses without images ({file.count} frames); record the images too"
        )
    if file.columns * file.rows > _LARGEST_IMAGE:
        return VolumeError(
            f"{path}: says it holds {file.count} images of {file.columns} × {file.rows} pixels; "
            f"{_LARGEST_IMAGE} pixels are read at most: export a part of it"
        )
    if file.channels not in (1, 3):
        return VolumeError(
            f"{path}: holds {file.channels} numbers per pixel; save it as grey values or colours"
        )
    if not _is_orientation(file.orientation):
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


def _is_orientation(code: str) -> bool:
    return re.fullmatch(r"([UM][FN]|[FN][UM])[AD]?", code) is not None


def turned(image: NDArray[np.uint8], code: str) -> NDArray[np.uint8]:
    """A view of an image (rows, columns) that was stored in an orientation, as it is in ``MF``.

    >>> turned(np.array([[1, 2], [3, 4], [5, 6]]), "FM")
    array([[1, 3, 5],
           [2, 4, 6]])
    """
    across, down = code[0], code[1]
    if across in "FN":
        image, across, down = image.T, down, across
    if across == "U":
        image = image[:, ::-1]
    return image[::-1] if down == "N" else image


def _header(path: Path) -> _Header:
    if not os.path.isfile(path):
        raise VolumeError(f"{path}: there is no such file; {_GIVE}")
    with path.open("rb") as file:
        start = file.read(256)
    # The first bytes tell, so that a vast file of another kind is not read as a header.
    if start.startswith(b"NRRD"):
        return _nrrd(path)
    if b"=" not in start:
        raise VolumeError(f"{path}: is neither MetaImage nor NRRD; {_GIVE}")
    return _metaimage(path)


def _metaimage(path: Path) -> _Header:
    header, header_bytes = metaimage_header(path)
    if "ElementDataFile" not in header:
        raise VolumeError(
            f"{path}: ends within its header, so it is cut; copy it again, or {_GIVE}"
        )
    stated = header.get("DimSize", "")
    sizes = _whole_numbers(path, "DimSize", stated)
    (channels,) = _whole_numbers(path, "channels", header.get("ElementNumberOfChannels", "1"))
    return _Header(
        path,
        *_size(path, "DimSize", stated, sizes, channels),
        _orientation(header),
        _frames(path, header.get("Kinds", ""), header),
        lambda: metaimage_voxels(path, header, header_bytes),
    )


def _nrrd(path: Path) -> _Header:
    fields, pairs, _ = nrrd_header(path)
    kinds = fields.get("kinds", "").lower().split()
    if frame_fields(pairs) and {"list", "time"} & set(kinds[:-1]) and kinds[-1] == "domain":
        raise VolumeError(
            f"{path}: stores its frames along another axis than the last ({' '.join(kinds)[:80]}); "
            f"export it as Plus does: domain domain domain list"
        )
    frames = _frames(path, " ".join(kinds), pairs)
    stated = fields.get("sizes", "")
    sizes = _whole_numbers(path, "sizes", stated)
    if kinds and len(kinds) != len(sizes):
        raise _no_size(path, "sizes", stated)
    channels = 1
    if kinds and kinds[0] in ("vector", "rgb-color", "3-color", "list"):
        channels, *sizes = sizes
    return _Header(
        path,
        *_size(path, "sizes", stated, sizes, channels),
        _orientation(pairs),
        frames,
        lambda: nrrd_voxels(path),
    )


def _orientation(keys: Mapping[str, str]) -> str:
    """The images' orientation; older versions of Plus write the key with blanks."""
    return keys.get("UltrasoundImageOrientation", keys.get("ultrasound image orientation", "MF"))


def _frames(path: Path, kinds: str, keys: Mapping[str, str]) -> dict[int, dict[str, str]]:
    frames = frame_fields(keys)
    if kinds and not is_sequence(kinds, keys):
        raise VolumeError(
            f"{path}: is a volume, as its axes are {kinds}, and holds no tracked frames; {_GIVE}"
        )
    if not frames:
        raise VolumeError(f"{path}: holds no tracked frames (Seq_Frame0000_...); {_GIVE}")
    return frames


def _size(
    path: Path, key: str, stated: str, sizes: Sequence[int], channels: int
) -> tuple[int, int, int, int]:
    """Columns, rows, channels and frames that can be."""
    # Newer versions of Plus write a depth of 1 before the number of frames.
    if len(sizes) not in (3, 4):
        raise _no_size(path, key, stated)
    columns, rows, *between, count = sizes
    if any(depth > 1 for depth in between):
        raise VolumeError(f"{path}: is a sequence of volumes; give one of flat images")
    if not 1 <= count <= _MOST_FRAMES:
        raise VolumeError(
            f"{path}: says it holds {count} frames; 1 to {_MOST_FRAMES} can be read: export it "
            f"again, or a part of it"
        )
    if min(columns, rows) < 1 or not all(between):
        columns = rows = 0  # poses alone
    return columns, rows, channels, count


def _whole_numbers(path: Path, key: str, said: str) -> list[int]:
    words = said.split()
    # int() would also take 1_000 and the digits of other scripts.
    if not words or not all(re.fullmatch(r"-?[0-9]{1,18}", word) for word in words):
        raise _no_size(path, key, said)
    return list(map(int, words))


def _no_size(path: Path, key: str, said: str) -> VolumeError:
    return VolumeError(
        f"{path}: its {key} is {said[:80]!r} where a sequence has columns, rows and frames; export "
        f"it again"
    )
