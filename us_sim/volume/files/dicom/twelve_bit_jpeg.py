"""JPEG with 12 bits a pixel, a plugin for pydicom, whose own one does not ask GDCM for it."""

from __future__ import annotations

from typing import Any

from pydicom.pixels import get_decoder
from pydicom.uid import JPEGExtended12Bit

DECODER_DEPENDENCIES = {JPEGExtended12Bit: ("python-gdcm",)}  # as pydicom asks of a plugin
_NAME = "us_sim's GDCM"


def is_available(syntax: str) -> bool:
    """Whether `decode_frame` can decode a syntax."""
    try:
        import gdcm  # noqa: F401
    except ImportError:
        return False
    return syntax == JPEGExtended12Bit


def add_plugin() -> None:
    """Have pydicom ask this plugin, too."""
    decoder = get_decoder(JPEGExtended12Bit)
    if _NAME not in (*decoder.available_plugins, *decoder.missing_dependencies):
        decoder.add_plugin(_NAME, (__name__, "decode_frame"))


def decode_frame(source: bytes, runner: Any) -> bytes:
    """Decode an image by GDCM."""
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
    syntax = gdcm.TransferSyntax.GetTSType(JPEGExtended12Bit)
    image.SetTransferSyntax(gdcm.TransferSyntax(syntax))
    bits = runner.bits_stored
    image.SetPixelFormat(
        gdcm.PixelFormat(runner.samples_per_pixel, runner.bits_allocated, bits, bits - 1, 0)
    )
    # GDCM hands bytes over as a text.
    return bytes(image.GetBuffer().encode("utf-8", "surrogateescape"))
