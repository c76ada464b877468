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
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.metaimage import describe_metaimage_numbers
from us_sim.volume.files.nrrd import describe_nrrd_numbers
from us_sim.volume.files.readers import is_sequence, read_sequence_header
from us_sim.volume.files.stored_image import GreyLevels, StoredNumbers
from us_sim.volume.sequences.transforms import (
    FrameTransforms,
    parse_frame_time,
    read_transforms,
    split_frame_fields,
)

SEQUENCE_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr")

_GIVE = "give a sequence of Plus or 3D Slicer (.igs.mha, .igs.nrrd, .seq.nrrd)"


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
    orientation: str  # of the images as they are stored
    stored: StoredNumbers | VolumeError  # of the images, or why they cannot be read

    def __len__(self) -> int:
        return len(self.numbers)

    def require_images(self) -> StoredNumbers:
        """Return the images as they are stored; raise what is wrong with them."""
        if isinstance(self.stored, VolumeError):
            raise self.stored
        return self.stored

    def read_images(self, which: Iterable[int] | None = None) -> Iterator[NDArray[np.uint8]]:
        """Yield images (rows, columns) in grey, turned to ``MF``; those at indices in `numbers`.

        Other numbers than bytes are spread over all frames.
        """
        import cv2  # which a node that plays poses alone does not need

        numbers = self.numbers if which is None else self.numbers[list(which)]
        for number in numbers:
            image = self._levels(self._images[..., number].T)
            if self.are_colours:
                image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
            yield np.ascontiguousarray(turn_image(image, self.orientation))

    @cached_property
    def _images(self) -> NDArray[Any]:
        """(columns, rows, frames), or (channels, columns, rows, frames), as they are stored."""
        return self.require_images().read()

    @cached_property
    def _levels(self) -> GreyLevels:
        if self._images.dtype == np.uint8:
            return GreyLevels()
        frames = (self._images[..., n].T for n in range(self.count))
        return GreyLevels.find_levels(self.path, (each.reshape(len(each), -1) for each in frames))


def read_sequence(path: str | os.PathLike[str]) -> TrackedSequence:
    """Read a sequence file of Plus or 3D Slicer, MetaImage or NRRD, raw or packed.

    Transforms that are missing, not finite or singular, whose status is not OK, or that are the
    identity that Plus fills in for what it has not seen, are not valid; the reason is kept.

    Raises:
        VolumeError: the file is missing, is of another format, a volume, or cut within its
            header, or says no usable size.
    """
    path = Path(path)
    if not path.is_file():
        raise VolumeError(f"{path}: there is no such file; {_GIVE}")
    keys, kinds, sizes, start = read_sequence_header(path)
    described = split_frame_fields(keys)
    if not described or (kinds and not is_sequence(kinds, keys)):
        axes = f" (its axes are {' '.join(kinds)})" if kinds else ""
        raise VolumeError(f"{path}: is a volume{axes}, as it holds no tracked frames; {_GIVE}")
    channels = int(keys.get("ElementNumberOfChannels", 1))
    if kinds and kinds[0] in ("vector", "rgb-color", "3-color", "list"):
        channels, *sizes = sizes
    # Newer versions of Plus write a depth of 1 before the number of frames.
    if len(sizes) not in (3, 4) or sizes[-1] < 1 or any(depth > 1 for depth in sizes[2:-1]):
        raise VolumeError(
            f"{path}: has the size {' '.join(map(str, sizes))} where a sequence of flat images has "
            f"columns, rows and frames; export it again"
        )
    columns, rows, count = sizes[0], sizes[1], sizes[-1]
    numbers = sorted(number for number in described if number < count)
    if not numbers:
        raise VolumeError(
            f"{path}: describes none of the {count} frames that it holds; export it again"
        )
    frames = [described[number] for number in numbers]
    # Older versions of Plus write the key with blanks.
    code = keys.get("UltrasoundImageOrientation", keys.get("ultrasound image orientation", "MF"))
    stored: StoredNumbers | VolumeError
    try:
        stored = _stored_images(path, keys, start, (columns, rows, channels, count), code)
    except VolumeError as error:  # for whoever asks for them
        stored, columns, rows = error, max(columns, 0), max(rows, 0)
    if code[:1] in ("F", "N"):
        columns, rows = rows, columns
    return TrackedSequence(
        path,
        columns,
        rows,
        count,
        np.array(numbers, dtype=np.int64),
        np.array([parse_frame_time(fields) for fields in frames]),
        np.array([fields.get("ImageStatus", "OK").upper() == "OK" for fields in frames]),
        read_transforms(frames),
        channels > 1,
        code,
        stored,
    )


def _stored_images(
    path: Path, keys: Mapping[str, Any], start: int, size: tuple[int, int, int, int], code: str
) -> StoredNumbers:
    """Describe the images, as (columns, rows, channels, frames)."""
    columns, rows, channels, count = size
    kind = keys.get("UltrasoundImageType", keys.get("ultrasound image type", "BRIGHTNESS")).upper()
    if min(columns, rows) < 1:
        problem = f"holds poses without images ({count} frames); record the images too"
    elif channels not in (1, 3):
        problem = f"holds {channels} numbers per pixel; save it as grey values or colours"
    elif not re.fullmatch(r"([UM][FN]|[FN][UM])[AD]?", code):
        problem = f"its images are stored in the orientation {code!r}, and not as MF or UN are"
    elif kind not in ("BRIGHTNESS", "RGB_COLOR"):
        problem = f"its images are {kind}, no B-mode: give the logarithm of their envelopes"
    else:
        is_nrrd = path.name.lower().endswith((".nrrd", ".nhdr"))
        numbers = (describe_nrrd_numbers if is_nrrd else describe_metaimage_numbers)(
            path, keys, start
        )
        return replace(numbers, size=(channels, columns, rows, count)[channels == 1 :])
    raise VolumeError(f"{path}: {problem}")


def turn_image(image: NDArray[np.uint8], code: str) -> NDArray[np.uint8]:
    """Turn an image (rows, columns) that was stored in an orientation, as it is in ``MF``.

    >>> turn_image(np.array([[1, 2], [3, 4], [5, 6]]), "FM")
    array([[1, 3, 5],
           [2, 4, 6]])
    """
    across, down = code[0], code[1]
    if across in "FN":
        image, across, down = image.T, down, across
    if across == "U":
        image = image[:, ::-1]
    return image[::-1] if down == "N" else image
