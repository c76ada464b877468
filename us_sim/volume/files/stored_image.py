"""Images in files: their numbers as a header says that they are stored, read piece by piece.

The headers are read by each format's library. The numbers of all formats are read here, since a
volume of 512³ shall not be in memory twice, and its bytes are compared with the header once.
"""

from __future__ import annotations

import bz2
import io
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError

LARGEST_VOLUME = 1 << 29  # numbers in the largest image that is read: 1024 × 1024 × 512

_STEP = 1 << 20

Encoding = Literal["raw", "packed", "bzip2"]
"""As they are; by zlib or gzip; by bzip2."""


@dataclass(frozen=True)
class StoredVoxels:
    """Numbers as a header says that they are stored."""

    size: tuple[int, ...]  # numbers along each axis, those of one voxel included, fastest first
    type: np.dtype[Any]  # of a number, in the file's byte order
    file: Path
    header: Path  # the file with the header, which errors name
    start: int = 0  # byte of the file at which they, or the packed bytes, begin
    skip: int = 0  # bytes before them, after unpacking; -1 of raw ones: they end the file
    encoding: Encoding = "raw"

    @property
    def expected(self) -> int:
        """Bytes that the header says there are."""
        return math.prod(self.size) * self.type.itemsize

    def check_bytes(self) -> None:
        """Compare the bytes of raw numbers with the header; packed ones are compared as read."""
        if not self.file.is_file():
            raise VolumeError(f"{self.header}: belongs to {self.file.name}, which is not there")
        if self.encoding == "raw":
            there = self.file.stat().st_size - self.start - max(self.skip, 0)
            self._check_length(min(there, self.expected) if self.skip < 0 else there)

    def pieces(self, size: int, wanted: Iterable[int] | None = None) -> Iterator[NDArray[Any]]:
        """Yield arrays of ``size`` numbers each, such as the slices of a volume.

        Args:
            size: numbers of a piece.
            wanted: which pieces, ascending from 0; all without it, and then there must be no more.
        """
        self.check_bytes()
        step, at = size * self.type.itemsize, 0
        with self._stream() as stream:
            for number in range(self.expected // step) if wanted is None else wanted:
                if self.encoding == "raw":
                    stream.seek(number * step - at, io.SEEK_CUR)
                    at = number * step
                while at < number * step and (passed := stream.read(step)):
                    at += len(passed)
                data = stream.read(step)
                at += len(data)
                if len(data) != step:
                    self._check_length(at)
                yield np.frombuffer(data, self.type)
            if wanted is None:
                self._check_length(at + len(stream.read(1)))

    @contextmanager
    def _stream(self) -> Iterator[Any]:
        """Open the bytes after unpacking, from those on that are skipped."""
        try:
            with self.file.open("rb") as file:
                file.seek(self.start)
                stream: Any = file
                if self.encoding == "packed":
                    stream = io.BufferedReader(_Inflated(file))
                elif self.encoding == "bzip2":
                    stream = bz2.BZ2File(file)
                if self.skip < 0:
                    file.seek(-self.expected, io.SEEK_END)
                stream.read(max(self.skip, 0))
                yield stream
        except (zlib.error, EOFError, OSError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise  # the file cannot be read at all
            raise VolumeError(
                f"{self.header}: its image data are broken or cut ({error}); copy it again"
            ) from error

    def _check_length(self, there: int) -> None:
        if there != self.expected:
            more = " or more" if self.encoding != "raw" and there > self.expected else ""
            raise VolumeError(
                f"{self.header}: holds {max(there, 0)}{more} bytes of image data where its header "
                f"says {self.expected}; copy or export it again"
            )


class _Inflated(io.RawIOBase):
    """The plain bytes of a zlib or gzip stream in a file.

    MetaImage packs by zlib, for which the standard library has no file; IGSIO writes gzip in
    several members, of which pynrrd reads the first.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(32 + zlib.MAX_WBITS)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        piece = b""
        while not piece:
            done = self._inflate.eof
            packed = self._inflate.unused_data if done else self._inflate.unconsumed_tail
            packed = packed or self._file.read(_STEP)
            if done and not packed:
                return 0
            if done:  # the next member
                self._inflate = zlib.decompressobj(32 + zlib.MAX_WBITS)
            piece = self._inflate.decompress(packed, len(buffer))
            if not (packed or piece or self._inflate.eof):
                raise EOFError("its compression ends too early")
        buffer[: len(piece)] = piece
        return len(piece)


def check_claim(path: Path, size: tuple[int, ...], value: int) -> None:
    """Refuse an image of so many numbers along each axis, and so many bytes a number.

    Raises:
        VolumeError: it is larger than `LARGEST_VOLUME`, or than the memory that is free.
    """
    count = math.prod(size)
    needed, free = count * (value + 1), free_memory()  # as they are stored, and as grey values
    if count > LARGEST_VOLUME or needed > free:
        raise VolumeError(
            f"{path}: says it holds {' × '.join(map(str, size))} numbers, {needed / 1e9:.3g} GB of "
            f"memory; {LARGEST_VOLUME} numbers and {free / 1e9:.3g} GB are possible: cut out a part"
        )


def check_brightness(path: Path | str, image: NDArray[Any]) -> None:
    """Refuse radio-frequency data, which swing about zero along the beam.

    Other signed images, such as CT, seldom change sign between neighbours.

    Args:
        path: which errors name.
        image: (j, i) of a volume, or of a sequence; beams along either axis.
    """
    if image.dtype.kind not in "if" or max(image.shape) < 64:
        return
    below = image < 0
    turns = max(np.mean(below[1:] != below[:-1]), np.mean(below[:, 1:] != below[:, :-1]))
    share, mean, spread = below.mean(), image.mean(dtype=np.float64), image.std(dtype=np.float64)
    if 0.3 < share < 0.7 and turns > 0.2 and abs(mean) < 0.25 * spread:
        raise VolumeError(
            f"{path}: looks like radio-frequency data ({100 * share:.0f} % of it is below zero), "
            f"not like a B-mode image: give the logarithm of its envelope"
        )


def free_memory() -> float:
    """Bytes of memory that programs may still take, as Linux estimates it; elsewhere no limit."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        (available,) = (line for line in lines if line.startswith("MemAvailable:"))
        return float(available.split()[1]) * 1024
    except (OSError, ValueError):
        return math.inf


@dataclass(frozen=True)
class StoredImage:
    """An image in a MetaImage, NRRD or NIfTI file, as its header says."""

    voxels: StoredVoxels
    components: int  # numbers of a voxel; where there are several they are the first axis
    placement: Callable[[], NDArray[np.float64]]  # (4, 4) m, from indices; raises VolumeError
    scaling: tuple[float, float] = (1.0, 0.0)  # slope and offset of the stored numbers
    texts: Mapping[str, str] = field(default_factory=dict)  # further keys and values
    remarks: tuple[str, ...] = ()  # on what the header leaves open, a sentence each

    @property
    def axes(self) -> tuple[int, ...]:
        """Voxels along each axis."""
        return self.voxels.size[self.components > 1 :]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along each axis of a volume."""
        i, j, k = self.axes[:3]
        return i, j, k

    @property
    def volumes(self) -> int:
        """How many volumes there are one after another."""
        return self.axes[3] if len(self.axes) == 4 else 1

    def check(self, *, layers: bool = False) -> None:
        """Refuse an image that is no volume, or does not fit into memory.

        With ``layers`` a voxel may have several numbers, as in segmentations of 3D Slicer.
        """
        path, axes = self.voxels.header, self.axes
        if len(axes) not in (3, 4) or min(axes[:3]) < 2:
            raise VolumeError(
                f"{path}: is {len(axes)}-dimensional, {' × '.join(map(str, axes))}; a volume has "
                f"three dimensions and two voxels or more along each axis"
            )
        if self.components != 1 and not layers:
            raise VolumeError(
                f"{path}: holds {self.components} numbers per voxel; convert it to one grey value"
            )
        check_claim(path, (*self.shape, self.components), self.voxels.type.itemsize)

    def slices(self, volume: int = 1) -> Iterator[NDArray[Any]]:
        """Yield the slices (j, i) of one of the volumes, or (j, i, component), scaled."""
        i, j, k = self.shape
        slope, offset = self.scaling
        wanted = range(k * (volume - 1), k * volume) if self.volumes > 1 else None
        form = (j, i, self.components) if self.components > 1 else (j, i)
        for numbers in self.voxels.pieces(i * j * self.components, wanted):
            image = numbers.reshape(form)
            yield image if self.scaling == (1.0, 0.0) else image * slope + offset


@dataclass(frozen=True)
class GreyLevels:
    """The numbers that become black and white; all others are spread between.

    NaN becomes 0, and infinities the end on their side.
    """

    low: float = 0.0
    high: float = 255.0
    missing: int = 0  # how many are NaN
    infinite: int = 0  # how many are +Inf or -Inf

    @classmethod
    def over(cls, path: Path | str, images: Iterable[NDArray[Any]]) -> GreyLevels:
        """Find the levels of images (rows, columns), read once; errors name the path."""
        low, high, missing, infinite = math.inf, -math.inf, 0, 0
        for number, image in enumerate(images):
            if number % 16 == 0:
                check_brightness(path, image)
            values = image
            if image.dtype.kind == "f":
                missing += int(np.count_nonzero(np.isnan(image)))
                infinite += int(np.count_nonzero(np.isinf(image)))
                values = image[np.isfinite(image)]
            if values.size:
                low, high = min(low, float(values.min())), max(high, float(values.max()))
        if low > high:
            raise VolumeError(f"{path}: holds no finite value")
        return cls(low, high, missing, infinite)

    def __call__(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """An image as grey values; 8-bit ones between 0 and 255 are taken as they are."""
        if image.dtype == np.uint8 and (self.low, self.high) == (0.0, 255.0):
            return np.array(image, dtype=np.uint8)
        # Halves, since the whole range of a float64 image may exceed what float64 can hold.
        height = image.astype(np.float64) / 2 - self.low / 2
        level = height / ((self.high / 2 - self.low / 2) or 1.0)
        level = np.clip(np.nan_to_num(level, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
        return np.asarray(np.floor(level * 255.0 + 0.5).astype(np.uint8))

    def described(self, bits: int) -> list[str]:
        """The conversion in words, for a person."""
        said = [f"{bits}-bit values spread over 0 to 255"]
        if self.missing:
            said.append(f"{self.missing} values that are no number are black")
        if self.infinite:
            said.append(f"{self.infinite} infinite values are white (+Inf) or black (-Inf)")
        return said


def file_order(voxels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(k, j, i) C-contiguous, the order of files, of a part (i, j, k) of a volume.

    OpenCV turns a plane in blocks that fit the cache, in a tenth of NumPy's time.
    """
    import cv2  # which a node that plays poses alone does not need

    made = np.empty(voxels.shape[::-1], np.uint8)
    for j in range(voxels.shape[1]):
        made[:, j, :] = cv2.transpose(voxels[:, j, :])
    return made


def volume_of_slices(
    slices: Iterable[NDArray[np.uint8]],
    count: int,
    progress: Callable[[float, str], None] | None = None,
) -> NDArray[np.uint8]:
    """A volume (i, j, k) of slices (j, i), of which a few are in memory at a time.

    Args:
        slices: in order; the first is read before memory is taken for all.
        count: how many come.
        progress: told the fraction that is there.
    """
    import cv2

    voxels: NDArray[np.uint8] | None = None
    slab: list[NDArray[np.uint8]] = []
    for k, image in enumerate(slices, start=1):
        if voxels is None:
            voxels = np.empty((*image.shape[::-1], count), np.uint8)
        slab.append(image)
        if len(slab) * image.size >= 1 << 23 or k == count:
            stack = np.stack(slab)
            for j in range(stack.shape[1]):
                voxels[:, j, k - len(slab) : k] = cv2.transpose(stack[:, j, :])
            slab.clear()
            if progress:
                progress(k / count, f"{k} of {count} images")
    assert voxels is not None
    return voxels
