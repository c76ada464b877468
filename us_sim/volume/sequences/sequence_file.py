"""What the file of a tracked sequence says of its frames: MetaImage and NRRD alike.

>>> import pathlib, tempfile
>>> from us_sim.volume.sequences.sequence_file import read_sequence_file
>>> header = '''NRRD0004
... type: uint8
... dimension: 4
... sizes: 4 3 1 2
... kinds: domain domain domain list
... encoding: raw
... UltrasoundImageOrientation:=UNA
... Seq_Frame0000_Timestamp:=0.5
... Seq_Frame0001_Timestamp:=0.6
...
... '''
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "sweep.igs.nrrd")
...     _ = path.write_bytes(header.encode() + bytes(24))
...     file = read_sequence_file(path)
>>> file.columns, file.rows, file.count, file.orientation, file.frames[1]["Timestamp"]
(4, 3, 2, 'UNA', '0.6')
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.volume.files.frame_sequence import is_sequence
from us_sim.volume.files.metaimage import metaimage_header, metaimage_voxels
from us_sim.volume.files.nrrd import nrrd_header, nrrd_voxels
from us_sim.volume.files.stored_voxels import StoredVoxels
from us_sim.volume.sequences.sequence_header import frame_fields

SEQUENCE_SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr")

_GIVE = "give a sequence of Plus or 3D Slicer (.igs.mha, .igs.nrrd, .seq.nrrd)"
_MOST_FRAMES = 1 << 20  # four hours at 60 Hz
_NUMBER = re.compile(r"-?[0-9]{1,18}")
_COLOURS = {"vector", "rgb-color", "3-color", "list"}


@dataclass(frozen=True)
class SequenceFile:
    """A header; the images are as they are stored."""

    path: Path
    columns: int  # along the file's first axis of an image; 0 where there are no images
    rows: int
    channels: int  # numbers a pixel
    count: int  # frames
    orientation: str
    frames: Mapping[int, Mapping[str, str]]  # fields by the frame's number
    voxels: Callable[[], StoredVoxels]  # where the images are; raises VolumeError


def read_sequence_file(path: Path) -> SequenceFile:
    """The header of a sequence.

    Raises:
        VolumeError: the file is missing, is of another format, a volume, or cut within its
            header, or says no usable size.
    """
    if not os.path.isfile(path):
        raise VolumeError(f"{path}: there is no such file; {_GIVE}")
    with path.open("rb") as file:
        start = file.read(256)
    # The first bytes tell, so that a vast file of another kind is not read as a header.
    if start.startswith(b"NRRD"):
        return _nrrd(path)
    if b"=" not in start:
        raise VolumeError(f"{path}: is neither MetaImage nor NRRD; {_GIVE}")
    return _metaimage(path)


def _metaimage(path: Path) -> SequenceFile:
    header, header_bytes = metaimage_header(path)
    if "ElementDataFile" not in header:
        raise VolumeError(
            f"{path}: ends within its header, so it is cut; copy it again, or {_GIVE}"
        )
    said = header.get("DimSize", "")
    sizes = _whole_numbers(path, "DimSize", said)
    # Newer versions of Plus write a depth of 1 before the number of frames.
    if len(sizes) not in (3, 4):
        raise _no_size(path, "DimSize", said)
    columns, rows, *between, count = sizes
    (channels,) = _whole_numbers(path, "channels", header.get("ElementNumberOfChannels", "1"))
    return SequenceFile(
        path,
        *_size(path, columns, rows, between, channels, count),
        _orientation(header),
        _frames(path, header.get("Kinds", ""), header),
        lambda: metaimage_voxels(path, header, header_bytes),
    )


def _nrrd(path: Path) -> SequenceFile:
    fields, pairs, _ = nrrd_header(path)
    kinds = fields.get("kinds", "").lower().split()
    if frame_fields(pairs) and {"list", "time"} & set(kinds[:-1]) and kinds[-1] == "domain":
        raise VolumeError(
            f"{path}: stores its frames along another axis than the last ({' '.join(kinds)[:80]}); "
            f"export it as Plus does: domain domain domain list"
        )
    frames = _frames(path, " ".join(kinds), pairs)
    said = fields.get("sizes", "")
    sizes = _whole_numbers(path, "sizes", said)
    if not kinds:
        kinds = ["domain"] * (len(sizes) - 1) + ["list"]
    channels = 1
    if kinds[0] in _COLOURS:
        channels, kinds, sizes = sizes[0], kinds[1:], sizes[1:]
    if len(sizes) != len(kinds) or len(sizes) not in (3, 4):
        raise _no_size(path, "sizes", said)
    columns, rows, *between, count = sizes
    return SequenceFile(
        path,
        *_size(path, columns, rows, between, channels, count),
        _orientation(pairs),
        frames,
        lambda: nrrd_voxels(path),
    )


def _orientation(keys: Mapping[str, str]) -> str:
    """How images lie; older versions of Plus write the key in small letters with blanks."""
    return keys.get("UltrasoundImageOrientation", keys.get("ultrasound image orientation", "MF"))


def _frames(path: Path, kinds: str, keys: Mapping[str, str]) -> dict[int, dict[str, str]]:
    """The fields of the frames, of what is a sequence."""
    frames = frame_fields(keys)
    if kinds and not is_sequence(kinds, keys):
        raise VolumeError(
            f"{path}: is a volume, as its axes are {kinds}, and holds no tracked frames; {_GIVE}"
        )
    if not frames:
        raise VolumeError(f"{path}: holds no tracked frames (Seq_Frame0000_...); {_GIVE}")
    return frames


def _size(
    path: Path, columns: int, rows: int, between: Sequence[int], channels: int, count: int
) -> tuple[int, int, int, int]:
    """Columns, rows, channels and frames that can be."""
    if any(depth > 1 for depth in between):
        raise VolumeError(f"{path}: is a sequence of volumes; give one of flat images")
    if not 1 <= count <= _MOST_FRAMES:
        raise VolumeError(
            f"{path}: says it holds {count} frames; 1 to {_MOST_FRAMES} can be read: export it "
            f"again, or a part of it"
        )
    if min(columns, rows) < 1 or not all(between):
        columns = rows = 0  # poses alone
    return columns, rows, channels, count


def _whole_numbers(path: Path, key: str, said: str) -> list[int]:
    words = said.split()
    # int() would also take 1_000 and the digits of other scripts.
    if not words or not all(map(_NUMBER.fullmatch, words)):
        raise _no_size(path, key, said)
    return list(map(int, words))


def _no_size(path: Path, key: str, said: str) -> VolumeError:
    return VolumeError(
        f"{path}: its {key} is {said[:80]!r} where a sequence has columns, rows and frames; export "
        f"it again"
    )
