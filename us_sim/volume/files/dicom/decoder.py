"""The process that decodes compressed images, and may end of one.

It is run as a script, imports nothing of this package, reads its task as JSON from stdin, and
writes the images one after another to stdout; a failure is a line of JSON on stderr. Decoders are
large programs in C and C++ that are handed a stranger's bytes: here one that fails ends nothing
else, and memory and time are bounded.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import warnings
from pathlib import Path
from typing import Any

MISSING, UNKNOWN, WRONG = "missing", "unknown", "wrong"
"""Kinds of failures: a library is not installed, the syntax is not read, the images are damaged."""

_EXTENDED = "1.2.840.10008.1.2.4.51"  # JPEG of up to 12 bits
DECODER_DEPENDENCIES = {_EXTENDED: ("python-gdcm",)}  # as pydicom asks of who decodes


def is_available(syntax: str) -> bool:
    """Whether `decode_twelve_bits` can decode a syntax."""
    try:
        import gdcm  # noqa: F401
    except ImportError:
        return False
    return syntax == _EXTENDED


def decode_twelve_bits(source: bytes, runner: Any) -> bytes:
    """An image of JPEG with 12 bits, which GDCM decodes and pydicom does not ask it for."""
    import gdcm

    fragment, fragments = gdcm.Fragment(), gdcm.SequenceOfFragments.New()
    fragment.SetByteStringValue(source)
    fragments.AddFragment(fragment)
    pixels = gdcm.DataElement(gdcm.Tag(0x7FE0, 0x0010))
    pixels.SetValue(fragments.__ref__())
    image = gdcm.Image()
    image.SetNumberOfDimensions(2)
    image.SetDimensions((runner.columns, runner.rows, 1))
    image.SetDataElement(pixels)
    grey = gdcm.PhotometricInterpretation.GetPIType(runner.photometric_interpretation)
    image.SetPhotometricInterpretation(gdcm.PhotometricInterpretation(grey))
    image.SetTransferSyntax(gdcm.TransferSyntax(gdcm.TransferSyntax.GetTSType(_EXTENDED)))
    bits = runner.bits_stored
    image.SetPixelFormat(
        gdcm.PixelFormat(runner.samples_per_pixel, runner.bits_allocated, bits, bits - 1, 0)
    )
    # GDCM hands bytes over as a text.
    return bytes(image.GetBuffer().encode("utf-8", "surrogateescape"))


def main() -> int:
    """Decode; 0 when all images were written."""
    task = json.loads(sys.stdin.buffer.readline())
    out = os.fdopen(os.dup(1), "wb", buffering=1 << 20)
    os.dup2(2, 1)  # what a decoder prints is no image
    warnings.simplefilter("ignore")
    from pydicom import config
    from pydicom.pixels import get_decoder, iter_pixels

    config.settings.reading_validation_mode = config.IGNORE
    try:
        decoder = get_decoder(task["syntax"])
    except NotImplementedError:
        return _fail(UNKNOWN)
    if task["syntax"] == _EXTENDED and task["bytes"] > 1:
        decoder.add_plugin("twelve bits", (__name__, "decode_twelve_bits"))
        available = is_available(_EXTENDED)
    else:
        available = decoder.is_available
    if not available:
        return _fail(MISSING)
    _limit(task["memory"], task["seconds"])
    shape, size = tuple(task["shape"]), task["bytes"]
    for job in task["files"]:
        try:
            for frame in iter_pixels(job["path"], indices=job["frames"], raw=False):
                if frame.shape != shape or frame.dtype.itemsize != size:
                    return _fail(WRONG)
                out.write(frame.astype(frame.dtype.newbyteorder("<"), copy=False).tobytes())
        except BrokenPipeError:
            return 1
        except Exception:  # whatever the bytes of a damaged image lead to, MemoryError too
            return _fail(WRONG)
    out.flush()
    return 0


def _limit(memory: int, seconds: int) -> None:
    """Allow so many more bytes of memory and seconds of processor time, and no file to be left."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    if pages:
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def _fail(kind: str) -> int:
    print(json.dumps({"kind": kind}), file=sys.stderr)
    return 3


if __name__ == "__main__":
    sys.exit(main())
