"""Unpacking foreign data: as many bytes as they claim to hold, and never more than a limit."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard

from us_sim.errors import BagError

LARGEST_CHUNK = 1 << 28
"""Bytes of a chunk or message after unpacking; rosbag2 makes chunks of less than a megabyte."""

LARGEST_FILE = 1 << 36
"""Bytes of a bag after unpacking: 64 GiB."""

_SPARE = 1 << 30  # bytes of the disk that stay free
_STEP = 1 << 20
_LONGEST_HEADER = 18  # bytes of a zstd frame


def unpack(packed: bytes | memoryview, compression: str, size: int) -> bytes:
    """The first ``size`` unpacked bytes, and one more where there are more.

    Args:
        packed: of which the end may be missing; then the bytes before it are unpacked.
        compression: ``zstd`` or ``lz4``.
        size: bytes, as the one who packed them says.

    Raises:
        BagError: ``size`` is above `LARGEST_CHUNK`.
        zstandard.ZstdError, RuntimeError: the bytes are damaged.
    """
    if size > LARGEST_CHUNK:
        raise BagError(
            f"it says that it holds {size} bytes when it is unpacked; {LARGEST_CHUNK} are read at "
            f"most"
        )
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
    return b"".join(_pieces(BytesIO(packed), size + 1))


def unpack_file(file: Path, copy: Path) -> None:
    """Unpack a zstd file into another; of one that is cut off, the bytes before the cut.

    Raises:
        BagError: the file is damaged, or holds more than `LARGEST_FILE` or than there is room for
            on the disk of the copy.
    """
    room = max(0, min(LARGEST_FILE, shutil.disk_usage(copy.parent).free - _SPARE))
    try:
        with file.open("rb") as packed, copy.open("wb") as unpacked:
            said = zstandard.frame_content_size(packed.read(_LONGEST_HEADER))
            packed.seek(0)
            if said <= room:
                for piece in _pieces(packed, room + 1):
                    unpacked.write(piece)
            if max(said, unpacked.tell()) <= room:
                return
    except zstandard.ZstdError as error:
        raise BagError(f"{file} cannot be decompressed: {error}") from None
    copy.unlink()
    raise BagError(
        f"{file} holds {said if said > 0 else 'more'} bytes when it is unpacked, where {room} are "
        f"the most that {copy.parent} takes: unpack it with `zstd -d` on a disk with more room"
    )


def _pieces(packed: BinaryIO, size: int) -> Iterator[bytes]:
    """The bytes of zstd frames in pieces, up to ``size`` of them."""
    with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
        while size and (piece := reader.read(min(size, _STEP))):
            yield piece
            size -= len(piece)
