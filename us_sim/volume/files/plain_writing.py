"""Voxels into NRRD and MetaImage files as they are, a slab at a time.

SimpleITK would need the whole image a second time, turned to the files' order of axes. A file is
written beside its place under another name and renamed, so it is whole or absent.

>>> import pathlib, tempfile
>>> import numpy as np
>>> from us_sim.volume.files.plain_writing import write_plain
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "volume.nrrd")
...     write_plain(path, np.zeros((3, 4, 5), np.uint8), np.diag([5e-4, 5e-4, 1e-3, 1.0]), {})
...     print(path.read_bytes()[:-61].decode())
NRRD0004
type: unsigned char
dimension: 3
space: left-posterior-superior
sizes: 3 4 5
space directions: (0.5,0,0) (0,0.5,0) (0,0,1)
kinds: domain domain domain
endian: little
encoding: raw
space origin: (0,0,0)
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.axis_order import file_order

_MILLIMETRES = 1e3  # these formats hold millimetres
_ORTHONORMAL = 1e-6  # of a direction matrix's columns; the readers' own limit is wider
_SLAB = 1 << 23  # bytes that are turned at a time


def write_plain(
    path: Path,
    voxels: NDArray[np.uint8],
    index_to_patient: NDArray[np.float64],
    fields: Mapping[str, str],
) -> None:
    """Voxels (i, j, k) as .nrrd or .mha, not compressed; a file of that name is replaced.

    Raises:
        VolumeError: as `us_sim.volume.files.writing.write_volume`.
    """
    grid = grid_in_mm(path, voxels.shape, index_to_patient)
    check_fields(path, fields)
    header = _nrrd if path.name.lower().endswith(".nrrd") else _metaimage
    text = header(voxels.shape, *grid, fields)
    step = max(1, _SLAB // (voxels.shape[0] * voxels.shape[1]))
    with partial_file(path, f"image{path.suffix}") as partial, partial.open("wb") as file:
        file.write(text.encode("utf-8"))
        for k in range(0, voxels.shape[2], step):
            file.write(file_order(voxels[:, :, k : k + step]).data)


def grid_in_mm(
    path: Path, shape: tuple[int, ...], index_to_patient: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Spacing (3,) mm, direction (3, 3) and origin (3,) mm of a grid.

    Raises:
        VolumeError: it has no right angles, or one voxel only along an axis.
    """
    matrix = index_to_patient[:3, :3] * _MILLIMETRES
    spacing = np.linalg.norm(matrix, axis=0)
    direction = matrix / spacing
    if np.abs(direction.T @ direction - np.eye(3)).max() > _ORTHONORMAL:
        raise VolumeError(
            f"{path}: the volume's axes are not at right angles, which image files cannot hold; "
            f"resample it on a grid with right angles"
        )
    if min(shape) < 2:
        raise VolumeError(
            f"{path}: the volume has {' × '.join(map(str, shape))} voxels; two or more along each "
            f"axis can be written"
        )
    return spacing, direction, index_to_patient[:3, 3] * _MILLIMETRES


def check_fields(path: Path, fields: Mapping[str, str]) -> None:
    """Refuse fields that would be read as something else.

    Raises:
        VolumeError: a field cannot stand in a header.
    """
    for key, value in fields.items():
        if not (key.isprintable() and value.isprintable()) or set(key) & set(":= ") or not key:
            raise VolumeError(
                f"{path}: the field {key!r} cannot stand in an image header: it must have a name "
                f"without blanks, colons and equals signs, and one line of text"
            )


@contextmanager
def partial_file(path: Path, name: str) -> Iterator[Path]:
    """The path of a file to write; at the end it takes the place of another.

    Raises:
        VolumeError: it cannot be written there.
    """
    try:
        folder = tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=path.parent)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be written: {error.strerror}") from error
    partial = Path(folder, name)
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
        os.rmdir(folder)


def _nrrd(
    shape: tuple[int, ...],
    spacing: NDArray[np.float64],
    direction: NDArray[np.float64],
    origin: NDArray[np.float64],
    fields: Mapping[str, str],
) -> str:
    """teem.sourceforge.net/nrrd/format.html, with pairs of keys and values behind the fields."""
    steps = " ".join(f"({_joined(axis, ',')})" for axis in (direction * spacing).T)
    lines = [
        "NRRD0004",
        "type: unsigned char",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {' '.join(map(str, shape))}",
        f"space directions: {steps}",
        "kinds: domain domain domain",
        "endian: little",
        "encoding: raw",
        f"space origin: ({_joined(origin, ',')})",
        *(f"{key}:={value}" for key, value in fields.items()),
    ]
    return "\n".join([*lines, "", ""])


def _metaimage(
    shape: tuple[int, ...],
    spacing: NDArray[np.float64],
    direction: NDArray[np.float64],
    origin: NDArray[np.float64],
    fields: Mapping[str, str],
) -> str:
    """itk.org/Wiki/MetaIO/Documentation, with further fields in between."""
    said = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": _joined(direction.T.ravel(), " "),
        "Offset": _joined(origin, " "),
        "CenterOfRotation": "0 0 0",
        "ElementSpacing": _joined(spacing, " "),
        "DimSize": " ".join(map(str, shape)),
        **fields,
        "ElementType": "MET_UCHAR",
        "ElementDataFile": "LOCAL",
    }
    return "".join(f"{key} = {value}\n" for key, value in said.items())


def _joined(numbers: NDArray[np.float64], between: str) -> str:
    """Numbers to their last digit; without -0, which says nothing."""
    return between.join(f"{number + 0.0:.17g}" for number in numbers)
