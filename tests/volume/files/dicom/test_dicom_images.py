"""Images of DICOM files: grey values, claims of sizes, decoders."""

import sys

import numpy as np
import pydicom
import pytest
from made_dicom import US_IMAGE, US_MULTI_FRAME, compressed, header, write
from pydicom.pixels import apply_color_lut, get_decoder, pixel_array
from pydicom.uid import (
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGBaseline8Bit,
)

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import open_dicom
from us_sim.volume.files.dicom.pixels import GreyImages, read_image_format, read_stored_frames

CINE = np.random.default_rng(3).integers(0, 256, (4, 12, 10), dtype=np.uint8)


def images(path):
    return np.array(list(GreyImages([open_dicom(path)]).read_images()))


def refused(path, message):
    """One sentence that begins with the file."""
    with pytest.raises(VolumeError, match=message) as error:
        images(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.fixture
def real(shared_file):
    return shared_file("dicom-us-2d")


@pytest.mark.parametrize("name", ["JPGLosslessP14SV1_1s_1f_8b", "US1_J2KR", "examples_ybr_color"])
def test_real_images_are_as_pydicom_decodes_them(real, name):
    stored = pixel_array(real / f"{name}.dcm").astype(float)
    expected = stored @ [0.299, 0.587, 0.114] if stored.shape[-1] == 3 else stored
    grey = images(real / f"{name}.dcm").reshape(expected.shape)
    assert np.abs(grey - expected).max() <= 1.5


def test_a_real_palette_of_16_bits_is_as_pydicom_makes_it(real):
    path = real / "gdcm-US-ALOKA-16.dcm"
    brightness = apply_color_lut(pixel_array(path), pydicom.dcmread(path)) @ [0.299, 0.587, 0.114]
    assert np.abs(images(path)[0] - brightness / 65535 * 255).max() <= 1.0


def test_big_endian_signed_and_inverted_values(tmp_path):
    def made(stored, syntax=ExplicitVRLittleEndian, **values):
        return images(write(tmp_path / "a.dcm", header(stored, US_MULTI_FRAME, **values), syntax))

    stored = (np.arange(4 * 12 * 10).reshape(4, 12, 10) - 100).astype(np.int16)
    expected = np.floor(np.arange(480).reshape(stored.shape) / 479 * 255 + 0.5)
    np.testing.assert_array_equal(made(stored), expected)
    np.testing.assert_array_equal(made(stored.astype(">i2"), ExplicitVRBigEndian), expected)
    inverted = made(CINE, PhotometricInterpretation="MONOCHROME1")
    np.testing.assert_array_equal(inverted, 255 - CINE)
    assert (CINE.min(), CINE.max()) == (0, 255)
    falling = made(CINE, RescaleSlope=-2.0, RescaleIntercept=5.0)
    np.testing.assert_array_equal(falling, 255 - CINE)
    twelve = made(CINE.astype(np.uint16) | 0xF000, BitsStored=12, HighBit=11)
    np.testing.assert_array_equal(twelve, CINE)  # four bits do not count


MPEG = "1.2.840.10008.1.2.4.102"


@pytest.mark.parametrize(
    ("syntax", "values", "message"),
    [
        (ExplicitVRLittleEndian, {"Rows": 13}, "480 bytes .* 520"),
        (
            ExplicitVRLittleEndian,
            {"NumberOfFrames": 60000, "Rows": 60000, "Columns": 60000},
            "are possible",
        ),
        (ExplicitVRLittleEndian, {"PhotometricInterpretation": "PALETTE COLOR"}, "table of col"),
        (JPEG2000Lossless, {"Rows": 13}, "decoded"),
        (MPEG, {}, "MPEG-4"),
    ],
)
def test_headers_that_do_not_fit_their_images_are_refused(tmp_path, syntax, values, message):
    made = header(CINE, US_MULTI_FRAME)
    made = made if syntax == ExplicitVRLittleEndian else compressed(made, syntax)
    for key, value in values.items():
        setattr(made, key, value)
    refused(write(tmp_path / "a.dcm", made, syntax), message)


def test_htj2k_is_decoded_and_jpeg_of_12_bits_refused(shared_file):
    file = open_dicom(shared_file("foreign-files/HTJ2K_08_RGB.dcm"))
    (stored,) = read_stored_frames(file, read_image_format(file), [0])
    np.testing.assert_array_equal(stored[160, 295], (91, 37, 2))  # as pydicom's own tests have it
    refused(shared_file("foreign-files/JPEG-lossy.dcm"), "decoded")


def test_without_pydicom_or_a_decoder_the_extra_is_named(tmp_path, monkeypatch):
    made = compressed(header(CINE, US_IMAGE), JPEGBaseline8Bit)
    path = write(tmp_path / "a.dcm", made, JPEGBaseline8Bit)
    monkeypatch.setattr(get_decoder(JPEGBaseline8Bit), "_available", {})
    refused(path, r"JPEG Baseline.*us_sim\[dicom\]")
    monkeypatch.setitem(sys.modules, "pydicom", None)
    refused(path, r"us_sim\[dicom\]")


def test_what_is_no_dicom_or_cut_is_refused(tmp_path):
    path = write(tmp_path / "a.dcm", header(CINE, US_MULTI_FRAME))
    contents = (path.read_bytes()[:-100], b"", b"DICM", bytes(128) + b"DICM" + bytes(60))
    for content in contents:
        path.write_bytes(content)
        refused(path, r"380 bytes|no DICOM file|read as DICOM|holds no image")
