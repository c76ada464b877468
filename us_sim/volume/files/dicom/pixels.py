"""The images of DICOM files as grey values, read and decoded by pydicom, one in memory at a time.

8-bit values are taken as they are; all others are spread so that the least becomes 0 and the
greatest 255, as `us_sim.volume.files.readers` does. Colour becomes grey by its brightness.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import (
    EXTRA,
    DicomFile,
    items,
    number,
    numbers,
    quiet,
    text,
    whole,
)
from us_sim.volume.files.stored_image import GreyLevels, check_claim

_GREY = ("MONOCHROME1", "MONOCHROME2", "PALETTE COLOR")

_WEIGHTS = np.array([77, 150, 29])
"""Of red, green and blue in a grey value, in 256ths (ITU-R BT.601, 2.5.1)."""


@dataclass(frozen=True)
class ImageFormat:
    """Size, number, type and colour of a file's images."""

    frames: int
    rows: int
    columns: int
    samples: int  # numbers of a pixel: 1, or 3 of a colour
    photometric: str
    type: np.dtype[np.generic]  # of a number
    bits: int  # of it that count


def image_format(file: DicomFile) -> ImageFormat:
    """Read the format that a header states, and compare it with the bytes that there are.

    Raises:
        VolumeError: there are no images, their number, size or type is missing or cannot be, or
            the file holds fewer or more bytes than they take.
    """
    header, path = file.header, file.path
    if file.pixels is None:
        from pydicom.uid import UID

        uid = UID(text(header, "SOPClassUID"))
        name = uid.name if uid.name != uid else "of no kind that is known"
        raise VolumeError(
            f"{path}: holds no image ({name}), or breaks off before it; give the DICOM file of an "
            f"image or a volume"
        )
    frames = whole(header, "NumberOfFrames") if "NumberOfFrames" in header else 1
    samples = whole(header, "SamplesPerPixel") or 1
    rows, columns = whole(header, "Rows") or 0, whole(header, "Columns") or 0
    if frames is None or min(frames, rows, columns) < 1:
        raise VolumeError(
            f"{path}: says that it holds {frames} images of {columns} × {rows} pixels; export it "
            f"again"
        )
    photometric = text(header, "PhotometricInterpretation") or "MONOCHROME2"
    if samples not in (1, 3) or (samples == 1) != (photometric in _GREY):
        raise VolumeError(
            f"{path}: its pixels have {samples} numbers as {photometric[:20]!r}; save it as grey "
            f"values or RGB"
        )
    allocated = whole(header, "BitsAllocated")
    bits = whole(header, "BitsStored") or allocated
    if allocated not in (1, 8, 16, 32, 64) or not bits or not 1 <= bits <= allocated:
        raise VolumeError(
            f"{path}: its pixels have {bits} of {allocated} bits; save it with 8, 16 or 32"
        )
    sign = "i" if whole(header, "PixelRepresentation") == 1 else "u"
    sign = "f" if file.pixels.tag != 0x7FE00010 else sign
    kind: np.dtype[Any] = np.dtype(bool) if allocated == 1 else np.dtype(f"{sign}{allocated // 8}")
    check_claim(path, (frames, rows, columns, samples), kind.itemsize)
    length = getattr(file.pixels, "length", None)  # none of images that came with the header
    length = len(file.pixels.value) if length is None else length
    expected = -(-frames * rows * columns * samples * allocated // 8)
    if photometric == "YBR_FULL_422":
        expected = frames * rows * math.ceil(columns / 2) * 4 * kind.itemsize
    if length not in (0xFFFFFFFF, expected, expected + expected % 2):
        raise VolumeError(
            f"{path}: holds {length} bytes of images where its header says {expected}; copy or "
            f"export it again"
        )
    return ImageFormat(frames, rows, columns, samples, photometric, kind, bits)


def stored_frames(
    file: DicomFile, form: ImageFormat, frames: Sequence[int]
) -> Iterator[NDArray[Any]]:
    """Yield images of a file, (rows, columns) or (rows, columns, RGB), by their numbers.

    Raises:
        VolumeError: an image is damaged, or its decoder is missing.
    """
    from pydicom.pixels import iter_pixels, pixel_array

    from us_sim.volume.files.dicom import twelve_bit_jpeg

    twelve_bit_jpeg.add_plugin()
    source: Any = file.header if file.deflated else file.path
    more: dict[str, Any] = {}
    if not file.deflated:
        more = {"transfer_syntax_uid": file.syntax, "number_of_frames": form.frames}
    try:
        with quiet():
            if form.type == np.bool_:  # pydicom finds packed images that begin within a byte in all
                every = pixel_array(source, **more).reshape(-1, form.rows, form.columns)
                found = iter([every[n] for n in frames])
            else:
                found = iter_pixels(source, indices=list(frames), **more)
        for _ in frames:
            with quiet():
                image = next(found)
            if image.shape[:2] != (form.rows, form.columns):
                raise ValueError("another size")
            yield image
    except Exception as error:  # pydicom and its decoders raise many kinds of errors
        raise _undecoded(file) from error


def _undecoded(file: DicomFile) -> VolumeError:
    from pydicom.pixels import get_decoder
    from pydicom.uid import UID

    name = UID(file.syntax).name
    try:
        missing = not get_decoder(UID(file.syntax)).is_available
    except NotImplementedError:
        why = (
            f"images are compressed as {name}, which is not read; export them uncompressed, or as "
            f"JPEG, JPEG 2000 or RLE"
        )
    else:
        why = (
            f"images are compressed as {name}, for which no decoder is installed: {EXTRA}"
            if missing
            else "images are damaged or cut short, or not of the size and type that its header "
            "says; copy or export it again"
        )
    return VolumeError(f"{file.path}: its {why}")


def _grey_palette(file: DicomFile) -> tuple[int, NDArray[np.uint8]]:
    """Return the stored value that a colour table begins with, and the grey value of each.

    Raises:
        VolumeError: a table is missing or damaged.
    """
    from pydicom.pixels import apply_color_lut

    count, first, _ = map(
        int, numbers(file.header, "RedPaletteColorLookupTableDescriptor", 3) or (0, 0, 0)
    )
    count = count or 1 << 16
    try:
        with quiet():
            colours = apply_color_lut(np.arange(first, first + count), file.header)[..., :3]
    except Exception as error:
        raise VolumeError(
            f"{file.path}: its table of colours is missing or damaged; export it in grey values or "
            f"RGB"
        ) from error
    # Some writers give numbers of 8 bits in entries of 16.
    top = 65535.0 if colours.max() > 255 else 255.0
    return first, np.floor(colours @ _WEIGHTS / 256 * (255 / top) + 0.5).astype(np.uint8)


class GreyImages:
    """The images of files that belong together, by (number of the file, number of the image).

    Raises:
        VolumeError: as `image_format`, or the files differ.
    """

    def __init__(self, files: Sequence[DicomFile]) -> None:
        self.files = list(files)
        self.formats = [image_format(file) for file in self.files]
        self.form = self.formats[0]
        kinds = [
            (form.rows, form.columns, form.samples, form.photometric, form.type, file.syntax)
            for file, form in zip(self.files, self.formats, strict=True)
        ]
        for file, kind in zip(self.files, kinds, strict=True):
            if kind != kinds[0]:
                raise VolumeError(
                    f"{file.path}: its images are of another size or type than those of "
                    f"{self.files[0].path}; import them one by one"
                )
        self._inverted = self.form.photometric == "MONOCHROME1"
        self._is_palette = self.form.photometric == "PALETTE COLOR"

    @property
    def all(self) -> list[tuple[int, int]]:
        """Every image, in the order of the files."""
        return [(n, k) for n, form in enumerate(self.formats) for k in range(form.frames)]

    @cached_property
    def conversions(self) -> tuple[str, ...]:
        """Changes of the stored values, for a person."""
        said = []
        if self._is_palette:
            said.append("palette colour converted to grey")
        elif self.form.samples == 3:
            said.append("colour converted to grey")
        if self._inverted:
            said.append("values turned, since 0 means white")
        if not self._plain:
            said.append(f"{self.form.bits}-bit values spread over 0 to 255")
        return tuple(said)

    def images(
        self, which: Sequence[tuple[int, int]] | None = None, keep: NDArray[np.bool_] | None = None
    ) -> Iterator[NDArray[np.uint8]]:
        """Images (rows, columns), in the order in which they are asked for.

        Args:
            which: of which file, and which of its images; all without it.
            keep: (rows, columns) the pixels of each that are kept; the rest becomes 0.

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

    @cached_property
    def _plain(self) -> bool:
        """Whether the stored numbers are grey values already."""
        scaled = any(map(_rescale, self.files)) or any(self._groups)
        return self._is_palette or (self.form.type == np.uint8 and not scaled)

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
        palette = _grey_palette(self.files[0]) if self._is_palette else None
        for (n, k), image in zip(which, self._stored(which), strict=True):
            if palette is not None:
                first, greys = palette
                yield greys[np.clip(image.astype(np.int64) - first, 0, len(greys) - 1)]
                continue
            if self.form.samples == 3:
                image = _luma(image)
            image = _masked(image, self.form)
            scale = None if self._plain else _rescale(self.files[n])
            if not self._plain and k < len(self._groups[n]):
                scale = _transformation(self._groups[n][k], scale)
            yield image if scale is None else image * scale[0] + scale[1]

    def _stored(self, which: Sequence[tuple[int, int]]) -> Iterator[NDArray[Any]]:
        """Yield the images as they are stored, colours last."""
        for n, run in groupby(which, key=lambda each: each[0]):
            yield from stored_frames(self.files[n], self.formats[n], [k for _, k in run])


def _luma(image: NDArray[Any]) -> NDArray[Any]:
    """The brightness of (rows, columns, RGB), of the same type."""
    wide: NDArray[Any] = image.astype(np.uint16 if image.dtype == np.uint8 else np.int64)
    weighted: NDArray[Any] = wide @ _WEIGHTS.astype(wide.dtype)
    return ((weighted + 128) >> 8).astype(image.dtype)


def _masked(image: NDArray[Any], form: ImageFormat) -> NDArray[Any]:
    """Without the bits that do not count, such as overlays of older files."""
    spare = 8 * image.itemsize - form.bits
    if image.dtype.kind == "f" or spare <= 0:
        return image
    return (image << spare) >> spare  # moved up and down again, the sign is that of its last bit


def _rescale(file: DicomFile) -> tuple[float, float] | None:
    """Slope and offset of all values of a file (PS3.3, C.11.1); None where they change nothing."""
    own = _slope_and_offset(file.header)
    shared = items(file.header, "SharedFunctionalGroupsSequence")
    return _transformation(shared[0], own) if shared else own


def _transformation(group: Any, without: tuple[float, float] | None) -> tuple[float, float] | None:
    found = items(group, "PixelValueTransformationSequence")
    return _slope_and_offset(found[0]) if found else without


def _slope_and_offset(header: Any) -> tuple[float, float] | None:
    scale = number(header, "RescaleSlope") or 1.0, number(header, "RescaleIntercept") or 0.0
    return None if scale == (1.0, 0.0) else scale
