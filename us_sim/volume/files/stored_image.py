"""Images in files: their numbers, read when they are asked for, and as grey values."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError

LARGEST_VOLUME = 1 << 29  # numbers in the largest image that is read: 1024 × 1024 × 512


@dataclass(frozen=True)
class StoredNumbers:
    """Numbers in a MetaImage or NRRD file, or in the file that its header names."""

    size: tuple[int, ...]  # along each axis, those of one voxel included, fastest first
    type: np.dtype[Any]  # of a number, in the file's byte order
    file: Path
    header: Path  # which errors name
    start: int = 0  # byte of the file at which they, or the packed bytes, begin
    skip: int = 0  # bytes before them, after unpacking; -1 of raw ones: they end the file
    unpack: Callable[[bytes], bytes] | None = None  # None: they are there as they are

    def read(self) -> NDArray[Any]:
        """Read all numbers, with axes as in `size`; those of a raw file are mapped.

        Raises:
            VolumeError: the file is not there, is damaged, or holds fewer or more bytes than its
                header says, or does not fit into memory.
        """
        if not self.file.is_file():
            raise VolumeError(f"{self.header}: belongs to {self.file.name}, which is not there")
        expected = math.prod(self.size) * self.type.itemsize
        if self.unpack is None:
            start = self.start + self.skip
            if self.skip < 0:
                start = max(self.file.stat().st_size - expected, self.start)
            self._check_length(self.file.stat().st_size - start, expected)
            return np.memmap(self.file, self.type, "r", start, self.size, "F")
        check_memory(2 * expected, f"{self.header}: unpacking it")
        try:
            data = self.unpack(self.file.read_bytes()[self.start :])[self.skip :]
        except (zlib.error, EOFError, OSError) as error:
            raise VolumeError(
                f"{self.header}: its image data are broken or cut ({error}); copy it again"
            ) from error
        self._check_length(len(data), expected)
        return np.frombuffer(data, self.type).reshape(self.size, order="F")

    def _check_length(self, there: int, expected: int) -> None:
        if there != expected:
            raise VolumeError(
                f"{self.header}: holds {max(there, 0)} bytes of image data where its header says "
                f"{expected}; copy or export it again"
            )


def check_memory(needed: float, purpose: str, advice: str = "end other programs") -> None:
    """Raise VolumeError where a purpose takes more bytes than the free memory has."""
    free = measure_free_memory()
    if needed > free:
        raise VolumeError(
            f"{purpose} takes {needed / 1e9:.3g} GB of memory where {free / 1e9:.3g} GB are free: "
            f"{advice}"
        )


def check_claim(path: Path | str, size: tuple[int, ...], value: int) -> None:
    """Raise VolumeError where so many numbers, of so many bytes, are too many to be read.

    Either of `LARGEST_VOLUME` or of the memory that is free.
    """
    count, shown = math.prod(size), " × ".join(map(str, size))
    if count > LARGEST_VOLUME:
        raise VolumeError(
            f"{path}: says it holds {shown} numbers where {LARGEST_VOLUME} are possible: cut out a "
            f"part"
        )
    # As they are stored, and as grey values.
    check_memory(count * (value + 1), f"{path}: an image of {shown} numbers", "cut out a part")


def check_brightness(path: Path | str, image: NDArray[Any]) -> None:
    """Refuse radio-frequency data (j, i), which swing about zero along the beam, on either axis.

    Other signed images, such as CT, seldom change sign between neighbours.
    """
    if image.dtype.kind not in "if" or image.ndim != 2 or max(image.shape) < 64:
        return
    below = image < 0
    turns = max(np.mean(below[1:] != below[:-1]), np.mean(below[:, 1:] != below[:, :-1]))
    share, mean, spread = below.mean(), image.mean(dtype=np.float64), image.std(dtype=np.float64)
    if 0.3 < share < 0.7 and turns > 0.2 and abs(mean) < 0.25 * spread:
        raise VolumeError(
            f"{path}: looks like radio-frequency data ({100 * share:.0f} % of it is below zero), "
            f"not like a B-mode image: give the logarithm of its envelope"
        )


def measure_free_memory() -> float:
    """Return the bytes of memory that are free, as Linux estimates it; elsewhere infinity."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        (available,) = (line for line in lines if line.startswith("MemAvailable:"))
        return float(available.split()[1]) * 1024
    except (OSError, ValueError):
        return math.inf


@dataclass(frozen=True)
class StoredImage:
    """An image in a MetaImage, NRRD or NIfTI file, as its header says."""

    path: Path
    size: tuple[int, ...]  # along each axis, fastest first, the numbers of a voxel included
    type: np.dtype[Any]  # of a number
    components: int  # numbers of a voxel; where there are several they are the first axis
    # (4, 4) m, from indices, given the spacing (3,) mm of a file that does not state it; raises
    placement: Callable[..., NDArray[np.float64]]  # VolumeError
    read: Callable[[], NDArray[Any]]  # all numbers, with axes as in `size`; raises VolumeError
    texts: Mapping[str, str] = field(default_factory=dict)  # further keys and values
    remarks: tuple[str, ...] = ()  # on what the header leaves open, a sentence each

    @property
    def axes(self) -> tuple[int, ...]:
        """Voxels along each axis."""
        return self.size[self.components > 1 :]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along each axis of a volume."""
        i, j, k = self.axes[:3]
        return i, j, k

    @property
    def volumes(self) -> int:
        """The number of volumes, one after another."""
        return self.axes[3] if len(self.axes) == 4 else 1

    def require_volume(self, *, layers: bool = False) -> None:
        """Refuse an image that is no volume, or does not fit into memory.

        With ``layers`` a voxel may have several numbers, as in segmentations of 3D Slicer.
        """
        axes = self.axes
        if len(axes) not in (3, 4) or min(axes[:3]) < 2:
            raise VolumeError(
                f"{self.path}: is {len(axes)}-dimensional, {' × '.join(map(str, axes))}; a volume "
                f"has three dimensions and two voxels or more along each axis"
            )
        if self.components != 1 and not layers:
            raise VolumeError(
                f"{self.path}: holds {self.components} numbers per voxel; convert it to one grey "
                f"value"
            )
        check_claim(self.path, (*self.shape, self.components), self.type.itemsize)


@dataclass(frozen=True)
class GreyLevels:
    """The numbers that become black and white; all others are spread between.

    NaN becomes 0, and infinities the end on their side.
    """

    low: float = 0.0
    high: float = 255.0

    @classmethod
    def find_levels(cls, path: Path | str, images: Iterable[NDArray[Any]]) -> GreyLevels:
        """Find the levels of images (rows, columns), read once; errors name the path."""
        low, high = math.inf, -math.inf
        for number, image in enumerate(images):
            if number % 16 == 0:
                check_brightness(path, image)
            values = image[np.isfinite(image)]
            if values.size:
                low, high = min(low, float(values.min())), max(high, float(values.max()))
        if low > high:
            raise VolumeError(f"{path}: holds no finite value")
        return cls(low, high)

    def __call__(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """Return an image as grey values; 8-bit ones between 0 and 255 are taken as they are."""
        if image.dtype == np.uint8 and (self.low, self.high) == (0.0, 255.0):
            return np.array(image, dtype=np.uint8)
        # Halves, since the whole range of a float64 image may exceed what float64 can hold.
        height = image.astype(np.float64) / 2 - self.low / 2
        level = height / ((self.high / 2 - self.low / 2) or 1.0)
        level = np.clip(np.nan_to_num(level, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
        return np.asarray(np.floor(level * 255.0 + 0.5).astype(np.uint8))


def read_grey_voxels(
    image: StoredImage, volume: int = 1
) -> tuple[NDArray[np.uint8], tuple[str, ...]]:
    """Read the grey values (i, j, k) of one of an image's volumes; say how they came about."""
    if not 1 <= volume <= image.volumes:
        raise VolumeError(
            f"{image.path}: holds {image.volumes} volumes; number {volume} is none of them"
        )
    said = list(image.remarks)
    stored = image.read().reshape((*image.shape, image.volumes), order="F")[..., volume - 1]

    def slices() -> Iterator[NDArray[Any]]:
        return (stored[:, :, k].T for k in range(stored.shape[2]))

    levels = GreyLevels()
    if stored.dtype != np.uint8:
        levels = GreyLevels.find_levels(image.path, slices())
        said.append(f"{8 * image.type.itemsize}-bit values spread over 0 to 255")
    if image.volumes > 1:
        said.append(f"volume {volume} of {image.volumes}")
    return stack_slices(map(levels, slices()), stored.shape[2]), tuple(said)


def stack_slices(slices: Iterable[NDArray[np.uint8]], count: int) -> NDArray[np.uint8]:
    """Stack a volume (i, j, k) of slices (j, i), of which so many come.

    The first is read before memory is taken for all.
    """
    stack = np.empty(0, np.uint8)
    for k, image in enumerate(slices):
        if not k:
            stack = np.empty((count, *image.shape), np.uint8)
        stack[k] = image
    return np.ascontiguousarray(stack.T)
