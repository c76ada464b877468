"""Numbers of an image in a file: how many its header says there are, how they are stored, reading
them piece by piece.

A header is a stranger's claim: memory is taken only for what can be, and where a file holds less
or more than its header says it is refused.

>>> import pathlib, tempfile, zlib
>>> import numpy as np
>>> from us_sim.volume.files.stored_voxels import StoredVoxels
>>> with tempfile.TemporaryDirectory() as folder:
...     file = pathlib.Path(folder, "voxels.raw")
...     _ = file.write_bytes(zlib.compress(bytes(range(120))))
...     stored = StoredVoxels((4, 5, 6), np.dtype("u1"), file, file, encoding="packed")
...     print([int(piece[0]) for piece in stored.pieces(20, [1, 4])])
...     StoredVoxels((4, 5, 7), np.dtype("u1"), file, file, encoding="packed").check()
...     # doctest: +ELLIPSIS
Traceback (most recent call last):
us_sim.errors.VolumeError: ...voxels.raw: holds 120 bytes of image data where its header says 140...
"""

from __future__ import annotations

import bz2
import io
import math
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError

LARGEST_VOLUME = 1 << 29
"""Numbers in the largest image that is read: 1024 × 1024 × 512."""

_STEP = 1 << 20
_ZLIB_OR_GZIP = 32 + zlib.MAX_WBITS

Encoding = Literal["raw", "packed", "bzip2", "text"]
"""As they are; by zlib or gzip; by bzip2; as words."""


class _Stream(Protocol):
    def read(self, count: int, /) -> bytes: ...


@dataclass(frozen=True)
class StoredVoxels:
    """Numbers as a header says that they are stored."""

    size: tuple[int, ...]  # numbers along each axis, those of one voxel included, fastest first
    type: np.dtype[Any]  # of a number, in the file's byte order
    file: Path
    header: Path  # the file with the header, which errors name
    start: int = 0  # byte of the file at which they, or what is packed, begin
    skip: int = 0  # bytes before them, after unpacking
    encoding: Encoding = "raw"

    @property
    def expected(self) -> int:
        """Bytes that the header says there are."""
        return math.prod(self.size) * self.type.itemsize

    def check(self) -> None:
        """Compare the bytes with what the header says, packed ones by unpacking them in steps.

        Raises:
            VolumeError: there are more or fewer, the compression is broken, or an image of that
                size is not read.
        """
        check_claim(self.header, self.size, self.type.itemsize)
        self.check_bytes()

    def check_bytes(self) -> None:
        """The same for an image of any size.

        Raises:
            VolumeError: there are more or fewer, or the compression is broken.
        """
        there, enough = 0, self.skip + self.expected
        if self.encoding == "raw":
            there = self.file.stat().st_size - self.start
        else:
            with self._stream() as stream:
                while there <= enough and (data := stream.read(_STEP)):
                    there += len(data)
        if there != enough:
            raise self._other(there - self.skip)

    def pieces(self, size: int, wanted: Iterable[int] | None = None) -> Iterator[NDArray[Any]]:
        """Arrays of ``size`` numbers each, such as the slices of a volume.

        Args:
            size: numbers of a piece.
            wanted: which pieces, ascending from 0; all without it, and then there must be no more.

        Raises:
            VolumeError: there are fewer or more than the header says, or they are damaged.
        """
        if self.encoding == "raw":
            self.check_bytes()
        step, at = size * self.type.itemsize, -self.skip
        with self._stream() as stream:
            for number in range(self.expected // step) if wanted is None else wanted:
                at += _pass(stream, number * step - at)
                data = stream.read(step) if at == number * step else b""
                at += len(data)
                if len(data) != step:
                    raise self._other(at)
                yield np.frombuffer(data, self.type)
            if wanted is None and (more := stream.read(1)):
                raise self._other(at + len(more))

    @contextmanager
    def _stream(self) -> Iterator[_Stream]:
        """The bytes after unpacking, from those on that are skipped."""
        try:
            with self.file.open("rb") as file:
                file.seek(self.start)
                if self.encoding == "text":
                    yield io.BytesIO(self._said(file))
                elif self.encoding == "bzip2":
                    with bz2.BZ2File(file) as unpacked:
                        yield unpacked
                else:
                    yield _Inflated(file) if self.encoding == "packed" else file
        except (zlib.error, EOFError, OSError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise  # the file cannot be read at all
            raise VolumeError(
                f"{self.header}: its compression is broken or cut short; copy it again"
            ) from error

    def _said(self, file: BinaryIO) -> bytes:
        """Numbers that are written as words."""
        most = 32 * math.prod(self.size) + _STEP
        text = file.read(most + 1)
        try:
            words = np.array(text.replace(b",", b" ").split(), np.float64)
        except ValueError:
            words = np.array([math.nan])
        # Only numbers with a fraction may be something else than finite.
        whole = self.type.kind != "f"
        limits = np.iinfo(self.type) if whole else None
        if len(text) > most or (
            limits and not ((words >= limits.min) & (words <= limits.max) & (words % 1 == 0)).all()
        ):
            raise VolumeError(
                f"{self.header}: its image data are not the {self.type} numbers that its header "
                f"says; copy or export it again"
            )
        return words.astype(self.type).tobytes()

    def _other(self, there: int) -> VolumeError:
        """More or fewer bytes than there should be."""
        more = " or more" if self.encoding != "raw" and there > self.expected else ""
        return VolumeError(
            f"{self.header}: holds {max(there, 0)}{more} bytes of image data where its header says "
            f"{self.expected}; copy or export it again"
        )


def _pass(stream: _Stream, count: int) -> int:
    """Bytes that were passed over: ``count``, or fewer at the end."""
    if isinstance(stream, io.BufferedReader):
        stream.seek(count, io.SEEK_CUR)
        return count
    passed = 0
    while passed < count and (data := stream.read(min(count - passed, _STEP))):
        passed += len(data)
    return passed


class _Inflated:
    """The plain bytes of a zlib or gzip stream in a file, a piece at a time."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(_ZLIB_OR_GZIP)

    def read(self, count: int, /) -> bytes:
        """The next ``count`` bytes; fewer at the end.

        Raises:
            EOFError: the stream breaks off.
            zlib.error: it is damaged.
        """
        pieces = []
        while count:
            if self._inflate.eof:  # gzip may come in members
                packed = self._inflate.unused_data or self._file.read(_STEP)
                if not packed:
                    break
                self._inflate = zlib.decompressobj(_ZLIB_OR_GZIP)
            else:
                packed = self._inflate.unconsumed_tail or self._file.read(_STEP)
            piece = self._inflate.decompress(packed, count)
            if not packed and not piece and not self._inflate.eof:
                raise EOFError
            pieces.append(piece)
            count -= len(piece)
        return b"".join(pieces)


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
    # As they are stored, and as grey values.
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
