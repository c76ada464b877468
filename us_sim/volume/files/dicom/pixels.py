"""The images of DICOM files as grey values, decoded by pydicom, one in memory at a time.

8-bit values are taken as they are; all others are spread so that the least becomes 0 and the
greatest 255, as `us_sim.volume.files.readers` does. Colour becomes grey by its brightness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import (
    EXPORT,
    EXTRA,
    read_functional_groups,
    read_items,
    read_number,
    read_numbers,
    silence_pydicom,
)
from us_sim.volume.files.stored_image import GreyLevels, check_claim

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
    bits: int  # that a number takes
    is_signed: bool
    used_bits: int  # of a number that count


def read_image_format(header: Any) -> ImageFormat:
    """Read the format that a header states, and compare it with the bytes that there are."""
    from pydicom.pixels.utils import get_expected_length, get_nr_frames

    path = header.filename
    keys = ("PixelData", "FloatPixelData", "DoubleFloatPixelData")
    pixels = next((header[key] for key in keys if key in header), None)
    if pixels is None:
        raise VolumeError(f"{path}: holds no image; give another DICOM file, or {EXPORT}")
    try:
        with silence_pydicom():
            form = ImageFormat(
                int(get_nr_frames(header)),
                int(header.Rows),
                int(header.Columns),
                int(header.SamplesPerPixel),
                str(header.PhotometricInterpretation),
                int(header.BitsAllocated),
                header.get("PixelRepresentation") == 1,
                int(header.get("BitsStored") or header.BitsAllocated),
            )
            expected = get_expected_length(header)
    except (AttributeError, TypeError, ValueError) as error:
        raise VolumeError(
            f"{path}: does not describe its images ({error}); export it again"
        ) from error
    size = form.frames, form.rows, form.columns, form.samples
    if min(size) < 1:
        raise VolumeError(
            f"{path}: says that it holds {form.frames} images of {form.columns} × {form.rows} "
            f"pixels; export it again"
        )
    check_claim(path, size, max(form.bits // 8, 1))
    length = len(pixels.value)
    if not pixels.is_undefined_length and length not in (expected, expected + expected % 2):
        raise VolumeError(
            f"{path}: holds {length} bytes of images where its header says {expected}; copy or "
            f"export it again"
        )
    return form


def read_stored_frames(
    file: Any, form: ImageFormat, frames: Sequence[int]
) -> Iterator[NDArray[Any]]:
    """Yield images of a file, (rows, columns) or (rows, columns, RGB), by their numbers."""
    from pydicom.pixels import iter_pixels

    try:
        with silence_pydicom():
            found = iter_pixels(file, indices=list(frames))
        for _ in frames:
            with silence_pydicom():
                image = next(found)
            if image.shape[:2] != (form.rows, form.columns):
                raise ValueError(f"an image has {image.shape[:2]} pixels")
            yield image
    except Exception as error:  # pydicom and its decoders raise many kinds of errors
        raise VolumeError(
            f"{file.filename}: its images cannot be decoded ({' '.join(str(error).split())}); copy "
            f"or export it again, or install the decoders: {EXTRA}"
        ) from error


def _grey_palette(file: Any) -> tuple[int, NDArray[np.uint8]]:
    """Return the stored value that a colour table begins with, and the grey value of each."""
    from pydicom.pixels import apply_color_lut

    try:
        count, first, _ = map(int, read_numbers(file, "RedPaletteColorLookupTableDescriptor", 3))
        with silence_pydicom():
            every = np.arange(first, first + (count or 1 << 16))
            colours = apply_color_lut(every, file)[..., :3]
    except Exception as error:
        raise VolumeError(
            f"{file.filename}: its table of colours is missing or damaged; export it in grey or RGB"
        ) from error
    # Some writers give numbers of 8 bits in entries of 16.
    top = 65535.0 if colours.max() > 255 else 255.0
    return first, np.floor(colours @ _WEIGHTS / 256 * (255 / top) + 0.5).astype(np.uint8)


class GreyImages:
    """The images of files that belong together, by (number of the file, number of the image)."""

    def __init__(self, files: Sequence[Any]) -> None:
        self.files = list(files)
        self.path: str = self.files[0].filename  # which errors name
        self.formats = [read_image_format(file) for file in self.files]
        self.form = self.formats[0]
        for file, form in zip(self.files, self.formats, strict=True):
            if replace(form, frames=self.form.frames) != self.form:
                raise VolumeError(
                    f"{file.filename}: its images are of another size or type than those of "
                    f"{self.path}; import them one by one"
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
        said = {
            "palette colour converted to grey": self._is_palette,
            "colour converted to grey": self.form.samples == 3,
            "values turned, since 0 means white": self._inverted,
            f"{self.form.used_bits}-bit values spread over 0 to 255": not self._plain,
        }
        return tuple(sentence for sentence, is_so in said.items() if is_so)

    def read_images(
        self, which: Sequence[tuple[int, int]] | None = None, keep: NDArray[np.bool_] | None = None
    ) -> Iterator[NDArray[np.uint8]]:
        """Yield images (rows, columns) in the order in which they are asked for, or all.

        Pixels (rows, columns) of each that are not to be kept become 0.
        """
        which = self.all if which is None else which
        levels = GreyLevels()
        if not self._plain:
            kept = (each if keep is None else each[keep] for each in self._brightness(which))
            levels = GreyLevels.find_levels(self.path, kept)
        for image in self._brightness(which):
            grey = levels(image)
            if self._inverted:
                np.subtract(255, grey, out=grey)
            if keep is not None:
                grey[~keep] = 0
            yield grey

    @cached_property
    def _plain(self) -> bool:
        """True where the stored numbers are grey values already."""
        is_scaled = any(scale != (1.0, 0.0) for scales in self._scales for scale in scales)
        is_byte = self.form.bits == 8 and not self.form.is_signed
        return self._is_palette or (is_byte and not is_scaled)

    @cached_property
    def _scales(self) -> list[list[tuple[float, float]]]:
        """Slope and offset of each image of each file (PS3.3, C.11.1): its own, or the file's."""
        key = "PixelValueTransformationSequence"
        return [
            [
                _slope_and_offset(
                    *(each for group in groups for each in read_items(group, key)), header
                )
                for groups in read_functional_groups(header, form.frames)
            ]
            for header, form in zip(self.files, self.formats, strict=True)
        ]

    def _brightness(self, which: Sequence[tuple[int, int]]) -> Iterator[NDArray[Any]]:
        """Yield one number a pixel: a grey value where `_plain`, else the rescaled value."""
        palette = _grey_palette(self.files[0]) if self._is_palette else None
        for n, run in groupby(which, key=lambda each: each[0]):
            wanted = [k for _, k in run]
            stored = read_stored_frames(self.files[n], self.formats[n], wanted)
            for k, image in zip(wanted, stored, strict=True):
                if palette is not None:
                    first, greys = palette
                    yield greys[np.clip(image.astype(np.int64) - first, 0, len(greys) - 1)]
                    continue
                grey = _luma(image) if image.ndim == 3 else image
                slope, offset = self._scales[n][k]
                is_same = self._plain or (slope, offset) == (1.0, 0.0)
                yield grey if is_same else grey * slope + offset


def _luma(image: NDArray[Any]) -> NDArray[Any]:
    """Return the brightness of (rows, columns, RGB), of the same type."""
    wide: NDArray[Any] = image.astype(np.uint16 if image.dtype == np.uint8 else np.int64)
    weighted: NDArray[Any] = wide @ _WEIGHTS.astype(wide.dtype)
    return ((weighted + 128) >> 8).astype(image.dtype)


def _slope_and_offset(*places: Any) -> tuple[float, float]:
    """Read the first of some places that has them; 1 and 0 where none has."""
    header = next((place for place in places if "RescaleSlope" in place), places[-1])
    return read_number(header, "RescaleSlope") or 1.0, read_number(
        header, "RescaleIntercept"
    ) or 0.0
