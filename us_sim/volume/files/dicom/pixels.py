"""The images of DICOM files as grey values, a few in memory at a time.

8-bit values are taken as they are; all others are spread so that the least becomes 0 and the
greatest 255, as `us_sim.volume.files.readers` does. Colour becomes grey by its brightness.

pydicom decodes compressed images, in a process of its own (`decoder`). Its `pixels.processing` was
tried for palettes and rescaling and is not used: 1.8 kB of a segmented palette expand to 20 million
entries, without a bound (ours stops at the entries that the header claims), it knows no rescaling
of single frames (functional groups), and makes 64-bit numbers of all frames at once.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom import decoder
from us_sim.volume.files.dicom.header import (
    EXTRA,
    DicomFile,
    items,
    number,
    numbers,
    text,
    value,
    whole,
)
from us_sim.volume.files.stored_image import GreyLevels, check_claim

_GREY = ("MONOCHROME1", "MONOCHROME2", "PALETTE COLOR")
_MOST_FRAMES = 1 << 20
_DIRECT = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.1.99", "")

_WEIGHTS = {"Red": 77, "Green": 150, "Blue": 29}
"""Of colours in a grey value, in 256ths (ITU-R BT.601, 2.5.1); a grey pixel stays as it is."""


@dataclass(frozen=True)
class ImageFormat:
    """Size, number, type and colour of a file's images."""

    frames: int
    rows: int
    columns: int
    samples: int  # numbers of a pixel: 1, or 3 of a colour
    photometric: str
    type: np.dtype[np.generic]  # of a number as it is stored
    bits: int  # of it that count
    planar: bool  # the three colours one after another, not pixel by pixel
    direct: bool  # stored as they are, so that no decoder is needed

    @property
    def frame_bytes(self) -> int:
        """Bytes of an image that is not compressed."""
        return self.rows * self.columns * self.samples * self.type.itemsize

    @property
    def native_bits(self) -> int:
        """Bits that an image which is not compressed has in the file, where masks are packed."""
        return self.frame_bytes if self.type == np.bool_ else 8 * self.frame_bytes


def image_format(file: DicomFile) -> ImageFormat:
    """The format that a header states, compared with the bytes that there are.

    Raises:
        VolumeError: there are no images, their number, size or type is missing or cannot be, or
            the file holds fewer or more bytes, or fewer fragments, than they take.
    """
    header, path = file.header, file.path
    if file.pixels is None:
        raise VolumeError(
            f"{path}: holds no image ({_class_name(file)}); give the DICOM file of an image or a "
            f"volume"
        )
    frames = whole(header, "NumberOfFrames") if "NumberOfFrames" in header else 1
    samples = whole(header, "SamplesPerPixel") or 1
    rows, columns = whole(header, "Rows") or 0, whole(header, "Columns") or 0
    if frames is None or not 1 <= frames <= _MOST_FRAMES or min(rows, columns) < 1:
        raise VolumeError(
            f"{path}: says that it holds {frames} images of {columns} × {rows} pixels; export it "
            f"again"
        )
    bits, stored = _number_type(file, file.pixels.element)
    photometric = text(header, "PhotometricInterpretation") or "MONOCHROME2"
    if samples not in (1, 3) or (samples == 1) != (photometric in _GREY):
        raise VolumeError(
            f"{path}: its pixels have {samples} numbers as {photometric[:20]!r}; save it as grey "
            f"values or RGB"
        )
    planar = samples == 3 and whole(header, "PlanarConfiguration") == 1
    direct = file.syntax in _DIRECT and photometric in (*_GREY, "RGB") and file.little_endian
    form = ImageFormat(frames, rows, columns, samples, photometric, stored, bits, planar, direct)
    check_claim(path, (frames, rows, columns, samples), stored.itemsize)
    _check_bytes(file, form)
    return form


def _number_type(file: DicomFile, element: int) -> tuple[int, np.dtype[np.generic]]:
    """Bits of a number that count, and how it is stored."""
    if element != 0x7FE00010:
        bits = 32 if element == 0x7FE00008 else 64
        return bits, np.dtype(f"<f{bits // 8}")
    allocated = whole(file.header, "BitsAllocated")
    stored = whole(file.header, "BitsStored") or allocated
    if allocated == 1:
        return 1, np.dtype(np.bool_)
    if allocated not in (8, 16, 32) or not stored or not 1 <= stored <= allocated:
        raise VolumeError(
            f"{file.path}: its pixels have {stored} of {allocated} bits; save it with 8, 16 or 32"
        )
    sign = "i" if whole(file.header, "PixelRepresentation") == 1 else "u"
    return stored, np.dtype(f"<{sign}{allocated // 8}")


def _check_bytes(file: DicomFile, form: ImageFormat) -> None:
    assert file.pixels is not None
    length = file.pixels.length
    if file.compressed != (length is None):
        raise VolumeError(
            f"{file.path}: its images are {'not ' if file.compressed else ''}in fragments, against "
            f"its transfer syntax; export it again"
        )
    if length is None:
        if (there := _fragments(file, file.pixels.start)) < form.frames:
            raise VolumeError(
                f"{file.path}: holds {there} compressed images where its header says "
                f"{form.frames}; copy or export it again"
            )
        return
    expected = -(-form.frames * form.native_bits // 8)
    if form.photometric == "YBR_FULL_422":
        expected = form.frames * form.rows * math.ceil(form.columns / 2) * 4 * form.type.itemsize
    if length not in (expected, expected + expected % 2):
        raise VolumeError(
            f"{file.path}: holds {length} bytes of images where its header says {expected}; copy "
            f"or export it again"
        )


def _fragments(file: DicomFile, start: int) -> int:
    """How many fragments there are behind the table of their offsets."""
    count, size = -1, file.size
    with file.open() as data:
        data.seek(start)
        while (head := data.read(8))[:4] == b"\xfe\xff\x00\xe0" and len(head) == 8:
            data.seek(int.from_bytes(head[4:], "little"), 1)
            if data.tell() > size:
                break
            count += 1
    return count


def _class_name(file: DicomFile) -> str:
    from pydicom.uid import UID

    kind = UID(text(file.header, "SOPClassUID"))
    return kind.name if kind.name != kind else "of no kind that is known"


def _grey_palette(file: DicomFile) -> tuple[int, NDArray[np.uint8]]:
    """The stored value that the colour table begins with, and the grey value of each that follows
    (PS3.3, C.7.6.3.1.5 and C.7.9.2).

    Raises:
        VolumeError: a table is missing or damaged.
    """
    order = "<" if file.little_endian else ">"
    total = np.zeros(1, np.float64)
    first = 0
    for colour, weight in _WEIGHTS.items():
        described = numbers(file.header, f"{colour}PaletteColorLookupTableDescriptor", 3)
        count, first, bits = (int(each) for each in described or (1, 0, 0))
        count = count % ((1 << 16) + 1) or 1 << 16
        data = value(file.header, f"{colour}PaletteColorLookupTableData")
        if isinstance(data, bytes):
            table = _plain(data, count, order)
        else:
            data = value(file.header, f"Segmented{colour}PaletteColorLookupTableData")
            table = _expanded(data, count, order) if isinstance(data, bytes) else None
        if (
            table is None
            or len(table) != count
            or bits not in (8, 16)
            or len(total) not in (1, count)
        ):
            raise VolumeError(
                f"{file.path}: its table of {colour.lower()} values is missing or damaged; export "
                f"it in grey values or RGB"
            )
        # Some writers give numbers of 8 bits in entries that say 16.
        top = 65535.0 if bits == 16 and table.max() > 255 else 255.0
        total = total + weight / 256 * 255 * np.minimum(table / top, 1.0)
    return first, np.floor(total + 0.5).astype(np.uint8)


def _plain(data: bytes, count: int, order: str) -> NDArray[np.int64] | None:
    """The entries, one after another in a byte or two."""
    if len(data) in (count, count + count % 2) and count > 1:
        return np.frombuffer(data[:count], np.uint8).astype(np.int64)
    if len(data) == 2 * count:
        return np.frombuffer(data, f"{order}u2").astype(np.int64)
    return None


def _expanded(data: bytes, count: int, order: str) -> NDArray[np.int64] | None:
    """The entries of a segmented table: runs of values, and straight lines between two."""
    words = np.frombuffer(data[: len(data) // 2 * 2], f"{order}u2").astype(np.int64)
    pieces: list[NDArray[Any]] = []
    made, at = 0, 0
    last: int | None = None
    while at + 1 < len(words) and made < count:
        kind, length = int(words[at]), int(words[at + 1])
        if kind == 0 and at + 2 + length <= len(words):
            piece, at = words[at + 2 : at + 2 + length], at + 2 + length
        elif kind == 1 and last is not None and at + 2 < len(words):
            steps = np.arange(1, length + 1) / max(length, 1)
            piece = np.floor(last + steps * (words[at + 2] - last) + 0.5).astype(np.int64)
            at += 3
        else:  # a segment that repeats others was never seen in an ultrasound image
            return None
        if len(piece):
            pieces.append(piece)
            made, last = made + len(piece), int(piece[-1])
    return np.concatenate(pieces) if pieces and made == count else None


def decoded_frames(
    jobs: Sequence[tuple[DicomFile, Sequence[int]]], form: ImageFormat
) -> Iterator[NDArray[np.generic]]:
    """Compressed images of files, decoded in a process of its own, which starts in half a second.

    Args:
        jobs: files of one transfer syntax, and the numbers of the images wanted of each.
        form: how their images are stored.

    Yields:
        (rows, columns) or (rows, columns, RGB).

    Raises:
        VolumeError: a decoder is missing, or an image cannot be decoded or is not of that form.
    """
    shape = (form.rows, form.columns) + ((3,) if form.samples == 3 else ())
    total = form.rows * form.columns * form.samples * sum(len(which) for _, which in jobs)
    task = {
        "syntax": jobs[0][0].syntax,
        "shape": shape,
        "bytes": form.type.itemsize,
        "memory": (1 << 30) + 16 * form.frame_bytes,  # bytes, beside several copies of an image
        "seconds": int(60 + total / 1e6),  # run lengths decode at 30 million pixels a second
        "files": [
            {"path": str(file.path.resolve()), "frames": [int(frame) for frame in which]}
            for file, which in jobs
        ],
    }
    # -P: this folder is no place to import from.
    command = [sys.executable, "-P", str(Path(decoder.__file__))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdin
        assert process.stdout
        try:
            try:
                process.stdin.write(json.dumps(task).encode() + b"\n")
                process.stdin.close()
            except BrokenPipeError:  # it ended at once; the first missing image shows that
                pass
            for file, which in jobs:
                for _ in which:
                    data = process.stdout.read(form.frame_bytes)
                    if len(data) != form.frame_bytes:
                        raise _failure(file, process)
                    yield np.frombuffer(data, dtype=form.type).reshape(shape)
        finally:
            process.kill()


def _failure(file: DicomFile, process: subprocess.Popen[bytes]) -> VolumeError:
    from pydicom.uid import UID

    assert process.stderr
    lines = process.stderr.read(1 << 16).decode(errors="replace").strip().splitlines()
    process.wait()
    try:
        kind = json.loads(lines[-1])["kind"]
    except (ValueError, IndexError, TypeError, KeyError):
        kind = decoder.WRONG
    name = UID(file.syntax).name
    name = name if name != file.syntax else "a way that is not known"
    if kind == decoder.MISSING:
        why = f"images are compressed as {name}, for which no decoder is installed: {EXTRA}"
    elif kind == decoder.UNKNOWN:
        why = (
            f"images are compressed as {name}, which is not read; export them uncompressed, or as "
            f"JPEG, JPEG 2000 or RLE"
        )
    else:
        why = (
            "compressed images are damaged, or not of the size and type that its header says; copy "
            "or export it again"
        )
    return VolumeError(f"{file.path}: its {why}")


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
    weighted: NDArray[Any] = wide @ np.array(list(_WEIGHTS.values()), wide.dtype)
    return ((weighted + 128) >> 8).astype(image.dtype)


def _masked(image: NDArray[Any], form: ImageFormat) -> NDArray[Any]:
    """Without the bits that do not count, such as overlays of older files."""
    if form.type.kind in "fb" or form.bits == 8 * form.type.itemsize or not form.direct:
        return image
    if form.type.kind == "u":
        return image & image.dtype.type((1 << form.bits) - 1)
    spare = 8 * form.type.itemsize - form.bits
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
