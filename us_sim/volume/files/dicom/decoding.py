"""Compressed images, decoded in a process of their own.

The process starts in about half a second, decodes the images of any number of files, and hands
them over one by one.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom import decoder
from us_sim.volume.files.dicom.header import EXTRA, DicomFile
from us_sim.volume.files.dicom.image_format import ImageFormat

_MEMORY = 1 << 30
"""Bytes that decoders may take beside several copies of an image."""
_SECONDS = 60
_PIXELS_PER_SECOND = 1e6
"""The slowest decoder, of run lengths, is thirty times as fast on a slow machine."""


def decoded_frames(
    jobs: Sequence[tuple[DicomFile, Sequence[int]]], form: ImageFormat
) -> Iterator[NDArray[np.generic]]:
    """The images of files, by their numbers, as (rows, columns) or (rows, columns, RGB).

    Args:
        jobs: files of one transfer syntax, and which images of each.
        form: how their images are stored.

    Raises:
        VolumeError: a decoder is missing, or an image cannot be decoded or is not of that form.
    """
    shape = (form.rows, form.columns) + ((3,) if form.samples == 3 else ())
    total = form.rows * form.columns * form.samples * sum(len(which) for _, which in jobs)
    task = {
        "syntax": jobs[0][0].syntax,
        "shape": shape,
        "bytes": form.type.itemsize,
        "memory": _MEMORY + 16 * form.frame_bytes,
        "seconds": int(_SECONDS + total / _PIXELS_PER_SECOND),
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
            _tell(process.stdin, task)
            for file, which in jobs:
                for _ in which:
                    data = process.stdout.read(form.frame_bytes)
                    if len(data) != form.frame_bytes:
                        raise _failure(file, process)
                    yield np.frombuffer(data, dtype=form.type).reshape(shape)
        finally:
            process.kill()


def _tell(stdin: IO[bytes], task: dict[str, object]) -> None:
    try:
        stdin.write(json.dumps(task).encode() + b"\n")
        stdin.close()
    except BrokenPipeError:  # it ended at once, which the first image that is missing tells
        pass


def _failure(file: DicomFile, process: subprocess.Popen[bytes]) -> VolumeError:
    """Why an image is missing."""
    from pydicom.uid import UID

    assert process.stderr
    words = process.stderr.read(1 << 16).decode(errors="replace").strip().splitlines()
    process.wait()
    try:
        said = json.loads(words[-1])
        kind, why = str(said["kind"]), str(said["why"])
    except (ValueError, IndexError, TypeError, KeyError):
        kind, why = decoder.WRONG, ""
    name = UID(file.syntax).name
    name = name if name != file.syntax else "a way that is not known"
    if kind == decoder.MISSING:
        return VolumeError(
            f"{file.path}: its images are compressed as {name}, for which no decoder is "
            f"installed: {EXTRA}"
        )
    if why == "no decoder":
        return VolumeError(
            f"{file.path}: its images are compressed as {name}, which is not read; export them "
            f"uncompressed, or as JPEG, JPEG 2000 or RLE"
        )
    return VolumeError(
        f"{file.path}: its compressed images are damaged, or not of the size and type that its "
        f"header says; copy or export it again"
    )
