"""Images of DICOM files: grey values, claims of sizes, decoders."""

import sys

import numpy as np
import pydicom
import pytest
from made_dicom import US_IMAGE, US_MULTI_FRAME, compressed, enhanced, header, item, turned, write
from pydicom.pixels import apply_color_lut, get_decoder, pixel_array
from pydicom.uid import ExplicitVRBigEndian, JPEG2000Lossless, JPEGBaseline8Bit, RLELossless

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import open_dicom
from us_sim.volume.files.dicom.pixels import GreyImages, image_format, stored_frames
from us_sim.volume.files.dicom.planes import frame_times

CINE = np.random.default_rng(3).integers(0, 256, (4, 12, 10), dtype=np.uint8)


def images(path):
    return np.array(list(GreyImages([open_dicom(path)]).images()))


def refused(path, message):
    """One sentence that begins with the file."""
    with pytest.raises(VolumeError, match=message) as error:
        images(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.fixture
def real(shared_file):
    return shared_file("dicom-us-2d")


def test_a_real_palette_of_16_bits_is_as_pydicom_makes_it(real):
    path = real / "gdcm-US-ALOKA-16.dcm"
    coloured = apply_color_lut(pixel_array(path), pydicom.dcmread(path)) / 65535
    brightness = coloured @ [0.299, 0.587, 0.114] * 255
    grey = images(path)[0]
    # Its table is written in 8 bits, in entries of 16: the brightest is 255.
    scale = 255 / brightness.max() if brightness.max() < 2 else 1.0
    assert np.abs(grey - brightness * scale).max() <= 1.0


@pytest.mark.parametrize(
    "name", ["JPGLosslessP14SV1_1s_1f_8b", "US1_J2KR", "US1_UNCR", "examples_ybr_color"]
)
def test_real_images_are_as_pydicom_decodes_them(real, name):
    path = real / f"{name}.dcm"
    stored = pixel_array(path).astype(float)
    expected = stored @ [0.299, 0.587, 0.114] if stored.shape[-1] == 3 else stored
    grey = images(path).reshape(expected.shape)
    assert np.abs(grey - expected).max() <= 1.5


def test_the_same_real_image_is_the_same_compressed_and_not(real):
    np.testing.assert_array_equal(images(real / "US1_J2KR.dcm"), images(real / "US1_UNCR.dcm"))


@pytest.mark.parametrize("syntax", [RLELossless, JPEG2000Lossless])
def test_compressed_images_come_back(tmp_path, syntax):
    path = write(tmp_path / "a.dcm", compressed(header(CINE, US_MULTI_FRAME), syntax), syntax)
    np.testing.assert_array_equal(images(path), CINE)


def test_big_endian_signed_and_inverted_values(tmp_path):
    stored = (np.arange(4 * 12 * 10).reshape(4, 12, 10) - 100).astype(np.int16)
    expected = np.floor(np.arange(480).reshape(stored.shape) / 479 * 255 + 0.5)
    path = write(tmp_path / "a.dcm", header(stored, US_MULTI_FRAME))
    np.testing.assert_array_equal(images(path), expected)
    swapped = header(stored.astype(">i2"), US_MULTI_FRAME)
    path = write(tmp_path / "b.dcm", swapped, ExplicitVRBigEndian)
    np.testing.assert_array_equal(images(path), expected)
    white = header(CINE, US_MULTI_FRAME, PhotometricInterpretation="MONOCHROME1")
    np.testing.assert_array_equal(images(write(tmp_path / "c.dcm", white)), 255 - CINE)
    falling = header(CINE, US_MULTI_FRAME, RescaleSlope=-2.0, RescaleIntercept=5.0)
    low, high = int(CINE.min()), int(CINE.max())
    spread = np.floor((high - CINE.astype(float)) / (high - low) * 255 + 0.5)
    np.testing.assert_array_equal(images(write(tmp_path / "d.dcm", falling)), spread)


def test_each_image_may_be_rescaled_on_its_own(tmp_path):
    voxels = np.full((3, 3, 4), 10, np.uint8)
    voxels[0] = 0
    made = enhanced(voxels, turned())
    for n, group in enumerate(made.PerFrameFunctionalGroupsSequence):
        by = item(RescaleSlope=float(n + 1), RescaleIntercept=0.0, RescaleType="US")
        group.PixelValueTransformationSequence = [by]
    grey = images(write(tmp_path / "a.dcm", made))
    np.testing.assert_array_equal(grey.max(axis=(1, 2)), [64, 128, 191, 255])


def test_bits_that_do_not_count_are_ignored(tmp_path):
    stored = CINE.astype(np.uint16) | 0xF000
    path = write(tmp_path / "a.dcm", header(stored, US_MULTI_FRAME, BitsStored=12, HighBit=11))
    grey = images(path)
    assert grey.min() == 0
    assert grey.max() == 255


def test_times_of_images(tmp_path):
    vector = header(CINE, US_MULTI_FRAME, FrameTimeVector=[0.0, 10.0, 30.0, 20.0])
    file = open_dicom(write(tmp_path / "a.dcm", vector))
    np.testing.assert_allclose(frame_times(file, 4), [0, 0.01, 0.04, 0.06])
    rate = open_dicom(write(tmp_path / "b.dcm", header(CINE, US_MULTI_FRAME, CineRate=50)))
    np.testing.assert_allclose(frame_times(rate, 4), [0, 0.02, 0.04, 0.06])
    none = open_dicom(write(tmp_path / "c.dcm", header(CINE, US_MULTI_FRAME)))
    assert frame_times(none, 4) is None


@pytest.mark.parametrize(
    ("key", "stamps", "times"),
    [
        (
            "FrameReferenceDateTime",
            [
                f"200612312{t}"
                for t in ("35959.5+0100", "30000+0000", "20000.25-0100", "30001+0000")
            ],
            [0, 0.5, 0.75, 1.5],
        ),
        ("FrameAcquisitionDateTime", [f"2006121912{n:02d}00" for n in range(4)], [0, 60, 120, 180]),
        ("FrameReferenceDateTime", ["20061219120000"] * 4, None),
        ("FrameReferenceDateTime", [f"200613191200{n:02d}" for n in range(4)], None),
        ("FrameReferenceDateTime", [f"200612191200{n:02d}" for n in range(3)], None),
    ],
    ids=["zones", "acquired", "all the same", "no month 13", "one without"],
)
def test_images_of_enhanced_objects_have_their_own_times(tmp_path, key, stamps, times):
    contents = [item(**{key: stamp}) for stamp in stamps] + [item()] * (4 - len(stamps))
    groups = [item(FrameContentSequence=[content]) for content in contents]
    made = header(CINE, US_MULTI_FRAME, PerFrameFunctionalGroupsSequence=groups)
    found = frame_times(open_dicom(write(tmp_path / "a.dcm", made)), 4)
    assert found == (None if times is None else pytest.approx(times))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"Rows": 13}, "480 bytes .* 520"),
        ({"NumberOfFrames": 3}, "480 bytes .* 360"),
        ({"NumberOfFrames": 60000, "Rows": 60000, "Columns": 60000}, "GB of memory"),
        ({"NumberOfFrames": -1}, "holds -1 images"),
        ({"Rows": None}, "describe"),
        ({"BitsAllocated": 1, "BitsStored": 1}, "its header says 60"),
        ({"BitsStored": 77}, "Bits Stored"),
        ({"PhotometricInterpretation": "PALETTE COLOR"}, "table of colours is missing"),
    ],
)
def test_headers_that_cannot_be_are_refused(tmp_path, values, message):
    refused(write(tmp_path / "a.dcm", header(CINE, US_MULTI_FRAME, **values)), message)


@pytest.mark.parametrize(
    ("syntax", "values", "message"),
    [
        (RLELossless, {"NumberOfFrames": 5}, "decoded"),
        (RLELossless, {"Rows": 60000, "Columns": 60000}, "GB of memory"),
        (JPEG2000Lossless, {"Rows": 13}, "decoded"),
    ],
)
def test_compressed_images_are_as_the_header_says(tmp_path, syntax, values, message):
    made = compressed(header(CINE, US_MULTI_FRAME), syntax)
    for key, value in values.items():
        setattr(made, key, value)
    refused(write(tmp_path / "a.dcm", made, syntax), message)


@pytest.mark.parametrize(
    ("name", "at", "value"),
    [  # as pydicom's own tests have them
        ("JPEG-lossy", (420, 140), 244),
        ("JPEG-lossy", (230, 120), 95),
        ("HTJ2K_08_RGB", (160, 295), (91, 37, 2)),
        ("HTJ2K_08_RGB", (275, 635), (207, 193, 171)),
    ],
)
def test_jpeg_of_12_bits_and_htj2k_are_decoded(shared_file, name, at, value):
    path = shared_file(f"foreign-files/{name}.dcm")
    file = open_dicom(path)
    (stored,) = stored_frames(file, image_format(file), [0])
    np.testing.assert_array_equal(stored[at], value)


def test_a_decoder_that_is_missing_names_the_extra(tmp_path, monkeypatch):
    path = write(
        tmp_path / "a.dcm", compressed(header(CINE, US_IMAGE), JPEGBaseline8Bit), JPEGBaseline8Bit
    )
    monkeypatch.setattr(get_decoder(JPEGBaseline8Bit), "_available", {})
    refused(path, r"JPEG Baseline.*us_sim\[dicom\]")


def test_what_has_no_decoder_at_all_is_refused(tmp_path):
    made = compressed(header(CINE, US_MULTI_FRAME), JPEGBaseline8Bit)
    mpeg = "1.2.840.10008.1.2.4.102"
    refused(write(tmp_path / "a.dcm", made, mpeg), "MPEG-4")


def test_without_pydicom_the_extra_is_named(tmp_path, monkeypatch):
    path = write(tmp_path / "a.dcm", header(CINE, US_MULTI_FRAME))
    monkeypatch.setitem(sys.modules, "pydicom", None)
    with pytest.raises(VolumeError, match=r"us_sim\[dicom\]"):
        open_dicom(path)


@pytest.mark.parametrize("content", [b"", b"DICM", bytes(200), bytes(128) + b"DICM" + bytes(60)])
def test_what_is_no_dicom_is_refused(tmp_path, content):
    path = tmp_path / "a.dcm"
    path.write_bytes(content)
    refused(path, r"no DICOM file|read as DICOM|holds no image")


def test_a_cut_file_is_refused(tmp_path):
    path = write(tmp_path / "a.dcm", header(CINE, US_MULTI_FRAME))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(VolumeError, match="breaks off"):
        open_dicom(path)
