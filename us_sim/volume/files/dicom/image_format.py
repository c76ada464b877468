"""How the images of a DICOM file are stored: size, number, type and colour.

>>> import pydicom.data
>>> from us_sim.volume.files.dicom.header import open_dicom
>>> from us_sim.volume.files.dicom.image_format import image_format
>>> form = image_format(open_dicom(pydicom.data.get_testdata_file("examples_palette.dcm")))
>>> form.frames, form.rows, form.columns, form.photometric, form.type
(1, 350, 800, 'PALETTE COLOR', dtype('uint8'))
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.values import text, whole
from us_sim.volume.files.stored_voxels import check_claim

_GREY = ("MONOCHROME1", "MONOCHROME2", "PALETTE COLOR")
_MOST_FRAMES = 1 << 20
_DIRECT = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.1.99", "")


@dataclass(frozen=True)
class ImageFormat:
    """What a header says of its images."""

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

    @property
    def colour(self) -> bool:
        """Whether grey values have to be made of colours."""
        return self.samples == 3 or self.photometric == "PALETTE COLOR"


def image_format(file: DicomFile) -> ImageFormat:
    """What a header says of its images, compared with the bytes that there are.

    Raises:
        VolumeError: there are no images, their number, size or type is missing or cannot be, or
            the file holds fewer or more bytes, or fewer fragments, than they take.
    """
    header, path = file.header, file.path
    if file.pixels is None:
        raise VolumeError(
            f"{path}: holds no image ({_kind(file)}); give the DICOM file of an image or a volume"
        )
    size = {key: whole(header, key) for key in ("Rows", "Columns")}
    frames = whole(header, "NumberOfFrames") if "NumberOfFrames" in header else 1
    samples = whole(header, "SamplesPerPixel") or 1
    rows, columns = size["Rows"] or 0, size["Columns"] or 0
    if frames is None or not 1 <= frames <= _MOST_FRAMES or min(rows, columns) < 1:
        raise VolumeError(
            f"{path}: says that it holds {frames} images of {columns} × {rows} pixels; export it "
            f"again"
        )
    bits, stored = _bits(file)
    photometric = text(header, "PhotometricInterpretation") or "MONOCHROME2"
    if samples not in (1, 3) or (samples == 1) != (photometric in _GREY):
        raise VolumeError(
            f"{path}: its pixels have {samples} numbers as {photometric[:20]!r}; save it as grey "
            f"values or RGB"
        )
    form = ImageFormat(
        frames=frames,
        rows=rows,
        columns=columns,
        samples=samples,
        photometric=photometric,
        type=stored,
        bits=bits,
        planar=samples == 3 and whole(header, "PlanarConfiguration") == 1,
        direct=file.syntax in _DIRECT and photometric in (*_GREY, "RGB") and file.little_endian,
    )
    check_claim(path, (frames, rows, columns, samples), stored.itemsize)
    _check_bytes(file, form)
    return form


def _bits(file: DicomFile) -> tuple[int, np.dtype[np.generic]]:
    """Bits of a number that count, and how it is stored."""
    assert file.pixels is not None
    if file.pixels.element != 0x7FE00010:
        bits = 32 if file.pixels.element == 0x7FE00008 else 64
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
    """Compare what the header says with the bytes or fragments that there are."""
    assert file.pixels is not None
    if file.compressed != (file.pixels.length is None):
        raise VolumeError(
            f"{file.path}: its images are {'not ' if file.compressed else ''}in fragments, against "
            f"its transfer syntax; export it again"
        )
    if file.pixels.length is None:
        there = _fragments(file)
        if there < form.frames:
            raise VolumeError(
                f"{file.path}: holds {there} compressed images where its header says "
                f"{form.frames}; copy or export it again"
            )
        return
    expected = -(-form.frames * form.native_bits // 8)
    if form.photometric == "YBR_FULL_422":
        expected = form.frames * form.rows * math.ceil(form.columns / 2) * 4 * form.type.itemsize
    if file.pixels.length not in (expected, expected + expected % 2):
        raise VolumeError(
            f"{file.path}: holds {file.pixels.length} bytes of images where its header says "
            f"{expected}; copy or export it again"
        )


def _fragments(file: DicomFile) -> int:
    """How many fragments there are behind the table of their offsets."""
    assert file.pixels is not None
    count, size = -1, file.size
    with file.open() as data:
        data.seek(file.pixels.start)
        while (head := data.read(8))[:4] == b"\xfe\xff\x00\xe0" and len(head) == 8:
            data.seek(int.from_bytes(head[4:], "little"), 1)
            if data.tell() > size:
                break
            count += 1
    return count


def _kind(file: DicomFile) -> str:
    """What a file is, in the standard's words."""
    from pydicom.uid import UID

    kind = UID(text(file.header, "SOPClassUID"))
    return kind.name if kind.name != kind else "of no kind that is known"
