"""The images of DICOM files as grey values, a few in memory at a time.

8-bit values are taken as they are; all others are spread so that the least becomes 0 and the
greatest 255, as `us_sim.volume.files.readers` does. Colour becomes grey by its brightness.

>>> import numpy as np, pydicom.data
>>> from us_sim.volume.files.dicom.grey import GreyImages
>>> from us_sim.volume.files.dicom.header import open_dicom
>>> file = open_dicom(pydicom.data.get_testdata_file("MR_small.dcm"))
>>> (image,) = GreyImages([file]).images()
>>> image.shape, int(image.min()), int(image.max())
((64, 64), 0, 255)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.decoding import decoded_frames
from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.image_format import ImageFormat, image_format
from us_sim.volume.files.dicom.palette import WEIGHTS, grey_palette
from us_sim.volume.files.dicom.values import items, number
from us_sim.volume.files.grey_levels import GreyLevels


class GreyImages:
    """The images of files that belong together, by (number of the file, number of the image).

    Args:
        files: all of one size and type.

    Raises:
        VolumeError: as `image_format`, or the files differ.
    """

    def __init__(self, files: Sequence[DicomFile]) -> None:
        self.files = list(files)
        self.formats = [image_format(file) for file in self.files]
        self.form = self.formats[0]
        first = self.files[0]
        for file, form in zip(self.files, self.formats, strict=True):
            same = (form.rows, form.columns, form.samples, form.photometric, form.type)
            one = self.form
            if same != (one.rows, one.columns, one.samples, one.photometric, one.type) or (
                file.syntax != first.syntax
            ):
                raise VolumeError(
                    f"{file.path}: its images are of another size or type than those of "
                    f"{first.path}; import them one by one"
                )

    @property
    def all(self) -> list[tuple[int, int]]:
        """Every image, in the order of the files."""
        return [(n, k) for n, form in enumerate(self.formats) for k in range(form.frames)]

    @cached_property
    def conversions(self) -> tuple[str, ...]:
        """What is made of the stored values, for a person."""
        form, said = self.form, []
        if form.photometric == "PALETTE COLOR":
            said.append("palette colour converted to grey")
        elif form.colour:
            said.append("colour converted to grey")
        if self._inverted:
            said.append("values turned, since 0 means white")
        if not self._plain:
            said.append(f"{form.bits}-bit values spread over 0 to 255")
        return tuple(said)

    def images(
        self, which: Sequence[tuple[int, int]] | None = None, keep: NDArray[np.bool_] | None = None
    ) -> Iterator[NDArray[np.uint8]]:
        """Images (rows, columns), in the order in which they are asked for.

        Args:
            which: of which file, and which of its images; all without it.
            keep: (rows, columns) what of each is kept; the rest becomes 0.

        Raises:
            VolumeError: an image is damaged, or its decoder is missing.
        """
        which = self.all if which is None else which
        levels = GreyLevels()
        if not self._plain:
            kept = (each if keep is None else each[keep] for each in self._brightness(which))
            levels = GreyLevels.over(self.files[0].path, kept)
        blank = None if keep is None else ~keep
        for image in self._brightness(which):
            grey = levels(image)
            if self._inverted:
                np.subtract(255, grey, out=grey)
            if blank is not None:
                grey[blank] = 0
            yield grey

    @property
    def _inverted(self) -> bool:
        return self.form.photometric == "MONOCHROME1"

    @cached_property
    def _plain(self) -> bool:
        """Whether what is stored is a grey value already."""
        form = self.form
        if form.photometric == "PALETTE COLOR":
            return True
        scaled = any(_rescale(file) != (1.0, 0.0) for file in self.files)
        scaled = scaled or any(self._groups[n] for n in range(len(self.files)))
        return form.type == np.uint8 and not scaled

    @cached_property
    def _groups(self) -> list[list[Any]]:
        """The groups of values of each image, for files that rescale them one by one."""
        groups = [items(file.header, "PerFrameFunctionalGroupsSequence") for file in self.files]
        return [
            group if group and items(group[0], "PixelValueTransformationSequence") else []
            for group in groups
        ]

    def _brightness(self, which: Sequence[tuple[int, int]]) -> Iterator[NDArray[Any]]:
        """One number a pixel: a grey value where `_plain`, else the rescaled value."""
        palette = None
        if self.form.photometric == "PALETTE COLOR":
            palette = grey_palette(self.files[0])
        for (n, k), image in zip(which, self._stored(which), strict=True):
            if palette is not None:
                first, greys = palette
                yield greys[np.clip(image.astype(np.int64) - first, 0, len(greys) - 1)]
                continue
            if self.form.samples == 3:
                image = _luma(image)
            image = _masked(image, self.form)
            if self._plain:
                yield image
                continue
            group = self._groups[n]
            slope, offset = _rescale(self.files[n])
            if k < len(group):
                slope, offset = _transformation(group[k], (slope, offset))
            yield image if (slope, offset) == (1.0, 0.0) else image * slope + offset

    def _stored(self, which: Sequence[tuple[int, int]]) -> Iterator[NDArray[Any]]:
        """The images as they are stored, colours last."""
        runs = [(n, [k for _, k in run]) for n, run in groupby(which, key=lambda each: each[0])]
        if not self.form.direct:
            yield from decoded_frames([(self.files[n], frames) for n, frames in runs], self.form)
            return
        for n, frames in runs:
            yield from _read(self.files[n], self.form, frames)


def stored_frames(
    file: DicomFile, form: ImageFormat, frames: Sequence[int]
) -> Iterator[NDArray[Any]]:
    """Images of a file as they are stored, by their numbers.

    Raises:
        VolumeError: an image is damaged, or its decoder is missing.
    """
    if frames:
        yield from (
            _read(file, form, frames) if form.direct else decoded_frames([(file, frames)], form)
        )


def _read(file: DicomFile, form: ImageFormat, frames: Sequence[int]) -> Iterator[NDArray[Any]]:
    """Images that are stored as they are."""
    assert file.pixels is not None
    with file.open() as data:
        for frame in frames:
            first, last = frame * form.native_bits, (frame + 1) * form.native_bits
            data.seek(file.pixels.start + first // 8)
            wanted = -(-last // 8) - first // 8
            read = data.read(wanted)
            if len(read) != wanted:
                raise VolumeError(f"{file.path}: breaks off in its images; copy it again")
            image = np.frombuffer(read, np.uint8 if form.type == np.bool_ else form.type)
            if form.type == np.bool_:  # first the lowest bit; images follow without a gap
                image = np.unpackbits(image, bitorder="little")[first % 8 :][: form.frame_bytes]
            if form.samples == 1:
                yield image.reshape(form.rows, form.columns)
            elif form.planar:
                yield image.reshape(3, form.rows, form.columns).transpose(1, 2, 0)
            else:
                yield image.reshape(form.rows, form.columns, 3)


def _luma(image: NDArray[Any]) -> NDArray[Any]:
    """The brightness of (rows, columns, RGB), of the same type."""
    wide: NDArray[Any] = image.astype(np.uint16 if image.dtype == np.uint8 else np.int64)
    weighted: NDArray[Any] = wide @ np.array(list(WEIGHTS.values()), wide.dtype)
    return ((weighted + 128) >> 8).astype(image.dtype)


def _masked(image: NDArray[Any], form: ImageFormat) -> NDArray[Any]:
    """Without the bits that do not count, such as overlays of older files."""
    if form.type.kind in "fb" or form.bits == 8 * form.type.itemsize or not form.direct:
        return image
    if form.type.kind == "u":
        return image & image.dtype.type((1 << form.bits) - 1)
    spare = 8 * form.type.itemsize - form.bits
    return (image << spare) >> spare  # moved up and down again, the sign is that of its last bit


def _rescale(file: DicomFile) -> tuple[float, float]:
    """Slope and offset of all values of a file (PS3.3, C.11.1)."""
    shared = items(file.header, "SharedFunctionalGroupsSequence")
    own = (_one(number(file.header, "RescaleSlope")), number(file.header, "RescaleIntercept") or 0)
    return _transformation(shared[0], own) if shared else own


def _transformation(group: Any, without: tuple[float, float]) -> tuple[float, float]:
    found = items(group, "PixelValueTransformationSequence")
    if not found:
        return without
    return _one(number(found[0], "RescaleSlope")), number(found[0], "RescaleIntercept") or 0.0


def _one(slope: float | None) -> float:
    return 1.0 if slope is None or slope == 0.0 else slope
