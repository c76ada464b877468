"""Where the voxels of an image file lie, how many its header says there are, and whether that fits.

A library that reads an image believes its header: it takes memory for what that says, and where
the file holds less, what was in that memory before passes for tissue.

>>> import pathlib, tempfile, zlib
>>> from us_sim.volume.files.stored_voxels import StoredVoxels
>>> with tempfile.TemporaryDirectory() as folder:
...     file = pathlib.Path(folder, "voxels.raw")
...     _ = file.write_bytes(zlib.compress(bytes(100)))
...     StoredVoxels((4, 5, 6), 1, file, file, packed=True).check()  # doctest: +ELLIPSIS
Traceback (most recent call last):
us_sim.errors.VolumeError: ...voxels.raw: holds 100 bytes of image data where its header says 120...
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import VolumeError

__all__ = ["LARGEST_VOLUME", "StoredVoxels", "check_claim", "free_memory"]

LARGEST_VOLUME = 1 << 29
"""Numbers in the largest image that is read: 1024 × 1024 × 512."""

_STEP = 1 << 20
_BROKEN = "its compression is broken or cut short; copy it again"
_ZLIB_OR_GZIP = 32 + zlib.MAX_WBITS


@dataclass(frozen=True)
class StoredVoxels:
    """What a header says of its voxels."""

    size: tuple[int, ...]  # numbers along each axis, those of one voxel included
    value: int  # bytes of a number
    file: Path
    header: Path  # the file with the header, which errors name
    start: int = 0  # byte of the file at which they, or what is packed, begin
    skip: int = 0  # bytes before them in what is packed
    packed: bool = False  # by zlib or gzip

    @property
    def expected(self) -> int:
        """Bytes that the header says there are."""
        return math.prod(self.size) * self.value

    def check(self) -> None:
        """Compare the bytes with what the header says, packed ones by unpacking them in steps.

        Raises:
            VolumeError: there are more or fewer, the compression is broken, or an image of that
                size is not read.
        """
        check_claim(self.header, self.size, self.value)
        self.check_bytes()

    def check_bytes(self) -> None:
        """The same for an image of any size.

        Raises:
            VolumeError: there are more or fewer, or the compression is broken.
        """
        stored = self._unpacked() if self.packed else self.file.stat().st_size - self.start
        if stored != self.skip + self.expected:
            more = " or more" if self.packed and stored > self.skip + self.expected else ""
            raise VolumeError(
                f"{self.header}: holds {max(stored - self.skip, 0)}{more} bytes of image data "
                f"where its header says {self.expected}; copy or export it again"
            )

    def _unpacked(self) -> int:
        """Bytes after unpacking; it stops one step after those that are expected."""
        total, enough = 0, self.skip + self.expected
        unpack = zlib.decompressobj(_ZLIB_OR_GZIP)
        try:
            with self.file.open("rb") as file:
                file.seek(self.start)
                while total <= enough:
                    packed = unpack.unconsumed_tail or unpack.unused_data or file.read(_STEP)
                    if unpack.eof and packed:
                        unpack = zlib.decompressobj(_ZLIB_OR_GZIP)  # gzip may come in members
                    if not packed:
                        break
                    total += len(unpack.decompress(packed, _STEP))
        except zlib.error as error:
            raise VolumeError(
                f"{self.header}: its compression is broken or cut short; copy it again"
            ) from error
        if total <= enough and not unpack.eof:
            raise VolumeError(
                f"{self.header}: its compression is broken or cut short; copy it again"
            )
        return total


def check_claim(path: Path, size: tuple[int, ...], value: int) -> None:
    """Refuse an image that is larger than `LARGEST_VOLUME` or than the memory that is free.

    Raises:
        VolumeError: it is.
    """
    numbers = math.prod(size)
    shown = " × ".join(map(str, size))
    if numbers > LARGEST_VOLUME:
        raise VolumeError(
            f"{path}: says it holds {shown} numbers; {LARGEST_VOLUME} are read at most: cut out "
            f"the part that is needed, or resample it"
        )
    # The library's copy, and that in grey values.
    needed, free = numbers * (value + 1), free_memory()
    if needed > free:
        raise VolumeError(
            f"{path}: says it holds {shown} numbers, which take {needed / 1e9:.1f} GB of memory "
            f"where {free / 1e9:.1f} GB are free: end other programs, or resample it"
        )


def free_memory() -> float:
    """Bytes of memory that programs may still take, as Linux estimates it; elsewhere no limit."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        (available,) = (line for line in lines if line.startswith("MemAvailable:"))
        return float(available.split()[1]) * 1024
    except (OSError, ValueError):
        return math.inf
