"""Files that a page saves, read back by the programs that people have for them."""

import io
import json
import struct
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from us_sim.errors import UsSimError
from us_sim.viewer.export import decode_frames, export_frames
from us_sim.viewer.stream import Packet

MATRIX = [1e-4, 0, 0, -0.002, 0, 0, 0, 0, 0, 2e-4, 0, 1e-4, 0, 0, 0, 1]
TYPES_1_AND_2 = """PatientName PatientID PatientBirthDate PatientSex StudyInstanceUID StudyDate
StudyTime StudyID AccessionNumber ReferringPhysicianName Modality SeriesInstanceUID SeriesNumber
Manufacturer InstanceNumber PatientOrientation ImageType SamplesPerPixel PhotometricInterpretation
Rows Columns BitsAllocated BitsStored HighBit PixelRepresentation PixelData SOPClassUID
SOPInstanceUID RegionSpatialFormat"""
"""Attributes that must be there, by PS3.3 A.6.4, in the data set or in the region's."""
NOON = 1_790_000_000 * 10**9


def pictures(times: list[float], sizes: list[tuple[int, int]]) -> list[Any]:
    """JPEGs whose grey value is 20 times their number."""
    return [
        ({"time": at}, cv2.imencode(".jpg", np.full((*size, 3), 20 * k, np.uint8))[1].tobytes())
        for k, (at, size) in enumerate(zip(times, sizes, strict=True))
    ]


def images(count: int, **told: Any) -> list[Any]:
    rng = np.random.default_rng(1)
    header = {"rows": 30, "columns": 41, "encoding": "mono8", "kind": "image", "matrix": MATRIX}
    header |= {"mode": "B-mode", "facts": ["press 4.2 mm"], **told}
    return [
        (header | {"stamp": str(NOON + k * 40_000_000)}, rng.bytes(30 * 41)) for k in range(count)
    ]


def test_a_loop_plays_as_fast_as_it_came(tmp_path: Path) -> None:
    times = [100.0, 100.1, 100.9, 102.0]
    file = tmp_path / "loop.mp4"
    file.write_bytes(export_frames("mp4", pictures(times, [(120, 160)] * 3 + [(131, 160)])))
    film, greys = cv2.VideoCapture(str(file)), []
    while (read := film.read())[0]:
        greys.append(read[1][:100].mean())
    for at, grey in ((0.04, 0), (0.5, 20), (1.5, 40), (2.0, 60)):
        assert greys[round(at * film.get(cv2.CAP_PROP_FPS))] == pytest.approx(grey, abs=3)


@pytest.mark.parametrize(
    ("count", "kind"), [(1, "1.2.840.10008.5.1.4.1.1.6.1"), (3, "1.2.840.10008.5.1.4.1.1.3.1")]
)
def test_dicom_has_the_pixels_where_they_are_and_says_that_they_are_simulated(
    count: int, kind: str
) -> None:
    pydicom = pytest.importorskip("pydicom")
    frames = images(count)
    read = pydicom.dcmread(io.BytesIO(export_frames("dcm", frames)))
    assert read.SOPClassUID == read.file_meta.MediaStorageSOPClassUID == kind
    np.testing.assert_array_equal(
        read.pixel_array.ravel(), np.frombuffer(b"".join(sent for _, sent in frames), np.uint8)
    )
    assert read.ImageType[0] == "DERIVED"
    for text in (read.PatientName, read.PatientComments, read.ImageComments):
        assert "simulated" in str(text).lower()
    assert "press 4.2 mm" in read.ImageComments
    (region,) = read.SequenceOfUltrasoundRegions
    assert (region.PhysicalDeltaX, region.PhysicalDeltaY) == pytest.approx((0.01, 0.02))  # cm
    assert region.ReferencePixelPhysicalValueX == pytest.approx(-0.2)
    assert all(name in read or name in region for name in TYPES_1_AND_2.split())
    assert read.AcquisitionDateTime.startswith("20260921")
    assert read.LossyImageCompression == "00"
    if count > 1:
        assert list(read.FrameTimeVector) == pytest.approx([0, 40, 40])  # ms


def test_dicom_of_a_jpeg_in_colour_is_in_colour_and_says_that_it_lost_something() -> None:
    pydicom = pytest.importorskip("pydicom")
    picture = np.full((30, 41, 3), (30, 60, 200), np.uint8)  # blue, green, red
    sent = cv2.imencode(".jpg", picture)[1].tobytes()
    ((header, _),) = images(1, encoding="jpeg", kind="annotated")
    header |= {"panels": 2}
    read = pydicom.dcmread(io.BytesIO(export_frames("dcm", [(header, sent)])))
    assert read.SequenceOfUltrasoundRegions[0].RegionLocationMaxX1 == 19  # of two images
    assert np.abs(read.pixel_array[9, 9].astype(int) - (200, 60, 30)).max() < 6
    assert read.LossyImageCompression == "01"


def test_without_pydicom_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pydicom.dataset", None)
    with pytest.raises(UsSimError, match=r"us_sim\[dicom\]"):
        export_frames("dcm", images(1))


@pytest.mark.parametrize(
    ("kind", "frames"),
    [
        ("exe", images(1)),
        ("mp4", [({"time": 0.0}, b"no picture")]),
        ("mp4", pictures([0.0, -1.0], [(8, 8)] * 2)),
        ("mp4", pictures([0.0, 1e9], [(8, 8)] * 2)),
        ("dcm", images(1, rows=10**6)),
        ("dcm", [*images(1), *images(1, rows=15, columns=82)]),
        ("dcm", [(images(1)[0][0] | {"stamp": "9" * 40}, bytes(30 * 41))]),
    ],
)
def test_what_cannot_be_saved_is_refused(kind: str, frames: list[Any]) -> None:
    with pytest.raises(UsSimError):
        export_frames(kind, frames)


@pytest.mark.parametrize(
    "message",
    [
        b"",
        struct.pack("<I", 2) + b"{}",
        *(
            Packet("mp4", 0, {"frames": frames}, b"1234").encoded
            for frames in ([], [{"bytes": 5}], [{"bytes": -1}], 7)
        ),
    ],
)
def test_a_message_without_frames_is_refused(message: bytes) -> None:
    with pytest.raises(UsSimError, match="no frames"):
        decode_frames(message)


def test_frames_come_apart_as_they_were_sent() -> None:
    told = {"frames": [{"bytes": 1, "a": 1}, {"bytes": 3, "a": 2}]}
    frames = decode_frames(Packet("dcm", 0, json.loads(json.dumps(told)), b"wxyz").encoded)
    assert [(header["a"], sent) for header, sent in frames] == [(1, b"w"), (2, b"xyz")]
