"""Writing images and their times as a sequence file, without poses: a MetaImage as Plus writes it.

>>> import numpy as np, pathlib, tempfile
>>> from us_sim.volume.sequences.image_sequence_file import write_image_sequence
>>> images = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "cine.igs.mha")
...     write_image_sequence(path, iter(images), (2, 3, 4), times=[0.0, 0.04])
...     lines = path.read_bytes().split(b"\\n")[:-1]
>>> lines[-3].decode()
'Seq_Frame0001_Timestamp = 0.04'
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError


def write_image_sequence(
    path: Path,
    images: Iterator[NDArray[np.uint8]],
    shape: tuple[int, int, int],
    times: Sequence[float],
    pixel_mm: tuple[float, float] = (1.0, 1.0),
    header: Mapping[str, str] | None = None,
) -> None:
    """Images (rows, columns), one after another, into a new file.

    Args:
        path: ends in .mha.
        images: in order.
        shape: number of images, rows, columns.
        times: s, of each image.
        pixel_mm: width and height of a pixel.
        header: further fields of one line each.

    Raises:
        VolumeError: the name ends otherwise, or the file cannot be written.
    """
    if not path.name.lower().endswith(".mha"):
        raise VolumeError(f"{path}: a sequence of images is written as .igs.mha or .mha")
    assert len(times) == shape[0]
    assert all(map(math.isfinite, times))
    try:
        number, name = tempfile.mkstemp(prefix=f".{path.name}.partial-", dir=path.parent)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        with os.fdopen(number, "wb") as file:
            file.write(_header(shape, times, pixel_mm, header or {}).encode("ascii"))
            for image in images:
                file.write(np.ascontiguousarray(image).tobytes())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)  # as any file; mkstemp's are the owner's alone
        os.replace(name, path)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        Path(name).unlink(missing_ok=True)


def _header(
    shape: tuple[int, int, int],
    times: Sequence[float],
    pixel_mm: tuple[float, float],
    more: Mapping[str, str],
) -> str:
    count, rows, columns = shape
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "DimSize": f"{columns} {rows} {count}",
        "ElementSpacing": f"{pixel_mm[0]:.9g} {pixel_mm[1]:.9g} 1",
        "ElementType": "MET_UCHAR",
        "Kinds": "domain domain list",
        "UltrasoundImageOrientation": "MFA",
        "UltrasoundImageType": "BRIGHTNESS",
        **more,
    }
    for number, time in enumerate(times):
        fields[f"Seq_Frame{number:04}_ImageStatus"] = "OK"
        fields[f"Seq_Frame{number:04}_Timestamp"] = f"{time:.9g}"
    fields["ElementDataFile"] = "LOCAL"
    return "".join(f"{key} = {value}\n" for key, value in fields.items())
