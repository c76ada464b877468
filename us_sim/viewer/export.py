"""Files of a page's pictures and images: videos and DICOM.

>>> from us_sim.viewer.export import export_frames
>>> header = {"rows": 2, "columns": 3, "encoding": "mono8", "stamp": "0", "mode": "B-mode"}
>>> export_frames("dcm", [(header, bytes(6))])[128:132]
b'DICM'
"""

from __future__ import annotations

import datetime
import io
import struct
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim import __version__
from us_sim.errors import UsSimError
from us_sim.viewer.stream import Packet

Sent = tuple[Mapping[str, Any], bytes]
"""Header and payload of a frame, as the page was sent them; pictures are JPEG, with ``time``, s."""

LARGEST = 2**28  # bytes of a page's message: it keeps a third of that
MP4_RATE = 25.0
"""Pictures a second, since the times of a page's images are never even."""
_LONGEST = 60.0  # s; a page keeps ten
_US_IMAGE, _US_MULTI_FRAME = "1.2.840.10008.5.1.4.1.1.6.1", "1.2.840.10008.5.1.4.1.1.3.1"
_SIMULATED = "Simulated ultrasound, computed by us_sim: not an image of a patient"
_TWO_D, _TISSUE, _CENTIMETRES = 1, 1, 3  # PS3.3 C.8.5.5.1


def decode_frames(message: bytes) -> list[Sent]:
    """The frames of a page's message, which is a `Packet`: headers with ``bytes``, and payloads.

    Raises:
        UsSimError: it holds none.
    """
    frames: list[Sent] = []
    try:
        packet = Packet.from_bytes(message)
        payload = packet.payload
        for header in packet.header["frames"]:
            size = int(header["bytes"])
            frames.append((dict(header), payload[:size]))
            payload = payload[size:]
    except (struct.error, KeyError, TypeError, ValueError):
        frames = []
    if not frames or payload or not all(len(sent) == head["bytes"] for head, sent in frames):
        raise UsSimError("the page sent no frames that can be saved: load it again")
    return frames


def export_frames(kind: str, frames: Sequence[Sent]) -> bytes:
    """The file of a kind (``mp4``, ``dcm``) that holds these frames.

    Raises:
        UsSimError: it cannot be made.
    """
    make = KINDS.get(kind)
    if make is None:
        raise UsSimError(f"{kind!r} cannot be saved: choose one of {', '.join(KINDS)}")
    try:
        return make(frames)
    except (KeyError, TypeError, ValueError, ArithmeticError, OSError, cv2.error) as error:
        raise UsSimError(f"these frames cannot be saved ({error}): load the page again") from error


def _mp4(frames: Sequence[Sent]) -> bytes:
    pictures = _evenly(frames)
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    width, height = width + width % 2, height + height % 2  # as the format wants it
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "loop.mp4"
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(file), codec, MP4_RATE, (width, height))
        if not writer.isOpened():
            raise UsSimError("this computer's OpenCV writes no MP4: save DICOM instead")
        for picture in pictures:
            rows, columns = picture.shape[:2]
            border = (0, height - rows, 0, width - columns)
            writer.write(cv2.copyMakeBorder(picture, *border, cv2.BORDER_CONSTANT))
        writer.release()
        return file.read_bytes()


def _evenly(frames: Sequence[Sent]) -> list[NDArray[np.uint8]]:
    """The picture that was seen at each beat of the video, from the first to the last."""
    times = np.array([float(header["time"]) for header, _ in frames])
    times -= times[0]
    if not (np.isfinite(times).all() and (np.diff(times) >= 0.0).all() and times[-1] < _LONGEST):
        raise UsSimError("the times of these frames are not one after another")
    beats = np.arange(int(times[-1] * MP4_RATE) + 1) / MP4_RATE
    pictures = [_decoded(each) for each in frames]
    return [pictures[k] for k in np.searchsorted(times, beats + 1e-9, side="right") - 1]


def _decoded(frame: Sent) -> NDArray[np.uint8]:
    """(rows, columns, 3) blue, green, red of a JPEG."""
    found = cv2.imdecode(np.frombuffer(frame[1], np.uint8), cv2.IMREAD_COLOR)
    if found is None:
        raise UsSimError("a picture of the page is no JPEG: load the page again")
    return np.asarray(found, dtype=np.uint8)


def _pixels(frame: Sent) -> NDArray[np.uint8]:
    """(rows, columns), or (rows, columns, 3) red, green, blue of one in colour."""
    header, payload = frame
    shape = int(header["rows"]), int(header["columns"])
    if header["encoding"] == "mono8":
        return np.frombuffer(payload, np.uint8).reshape(shape)
    picture = _decoded(frame)
    if picture.shape[:2] != shape:
        raise UsSimError("a picture of the page has another size than it says: load the page again")
    if header.get("kind") == "image_jpeg":
        return np.ascontiguousarray(picture[:, :, 0])
    return np.ascontiguousarray(picture[:, :, ::-1])


def _dicom(frames: Sequence[Sent]) -> bytes:
    """A US Image, or a US Multi-frame Image, that says in all places that it is simulated.

    After DICOM PS3.3 A.6 and A.7. Pixels are those of the images, without what the page draws over
    them; where they are is in the region's calibration.
    """
    try:
        from pydicom.dataset import Dataset, FileMetaDataset
        from pydicom.uid import ExplicitVRLittleEndian, generate_uid
    except ImportError:
        raise UsSimError("DICOM needs pydicom: pip install 'us_sim[dicom]'") from None
    pixels = [_pixels(each) for each in frames]
    if len({each.shape for each in pixels}) > 1:
        raise UsSimError("images of several sizes cannot be one DICOM file: save one of them")
    header, _ = frames[0]
    when = datetime.datetime.fromtimestamp(1e-9 * int(header["stamp"]), datetime.UTC)
    date, time = when.strftime("%Y%m%d"), when.strftime("%H%M%S.%f")
    is_loop, is_colour = len(frames) > 1, pixels[0].ndim == 3
    made = Dataset()
    made.file_meta = FileMetaDataset()
    made.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    made.SpecificCharacterSet = "ISO_IR 192"
    made.ImageType = ["DERIVED", "PRIMARY", "", "0001"]  # 0001: 2D imaging
    made.SOPClassUID = _US_MULTI_FRAME if is_loop else _US_IMAGE
    for name in ("SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID"):
        setattr(made, name, generate_uid(prefix=None))
    made.StudyDate = made.SeriesDate = made.ContentDate = date
    made.StudyTime = made.SeriesTime = made.ContentTime = time
    made.AcquisitionDateTime = date + time
    made.TimezoneOffsetFromUTC = "+0000"
    made.Modality = "US"
    made.Manufacturer = made.ManufacturerModelName = "us_sim"
    made.SoftwareVersions = __version__
    made.StudyDescription = "Simulated ultrasound"
    made.SeriesDescription = str(header.get("mode", ""))[:64]
    made.DerivationDescription = _SIMULATED
    made.PatientName, made.PatientID = "Simulated^us_sim", "SIMULATED"
    made.PatientComments = _SIMULATED
    made.ImageComments = "; ".join([_SIMULATED, *map(str, header.get("facts", []))])[:10240]
    for name in ("AccessionNumber", "ReferringPhysicianName", "PatientBirthDate", "PatientSex"):
        setattr(made, name, "")
    made.StudyID = made.PatientOrientation = ""
    made.SeriesNumber = made.InstanceNumber = 1
    made.BurnedInAnnotation = "NO"
    made.SamplesPerPixel = 3 if is_colour else 1
    made.PhotometricInterpretation = "RGB" if is_colour else "MONOCHROME2"
    if is_colour:
        made.PlanarConfiguration = 0
    made.Rows, made.Columns = pixels[0].shape[:2]
    made.BitsAllocated = made.BitsStored = 8
    made.HighBit, made.PixelRepresentation = 7, 0
    raw = b"".join(each.tobytes() for each in pixels)
    made.LossyImageCompression = "00" if header["encoding"] == "mono8" else "01"
    if header["encoding"] != "mono8":
        made.LossyImageCompressionMethod = "ISO_10918_1"
        made.LossyImageCompressionRatio = f"{len(raw) / sum(len(sent) for _, sent in frames):.2f}"
    if is_loop:
        stamps = np.array([int(each["stamp"]) for each, _ in frames])
        made.NumberOfFrames = len(frames)
        made.FrameIncrementPointer = 0x00181065
        made.FrameTimeVector = [0.0, *np.round(1e-6 * np.diff(stamps), 3).tolist()]  # ms
    if header.get("matrix"):
        made.SequenceOfUltrasoundRegions = [_region(header, Dataset())]
    made.PixelData = raw + b"\0" * (len(raw) % 2)
    told = io.BytesIO()
    made.save_as(told, enforce_file_format=True)
    return told.getvalue()


def _region(header: Mapping[str, Any], region: Any) -> Any:
    """Where the pixels are: cm from the middle of the probe's face."""
    matrix = np.array(header["matrix"], dtype=np.float64).reshape(4, 4)
    region.RegionSpatialFormat, region.RegionDataType, region.RegionFlags = _TWO_D, _TISSUE, 0
    region.RegionLocationMinX0 = region.RegionLocationMinY0 = 0
    # Of two images beside each other it is the left one's.
    region.RegionLocationMaxX1 = int(header["columns"]) // int(header.get("panels", 1)) - 1
    region.RegionLocationMaxY1 = int(header["rows"]) - 1
    region.PhysicalUnitsXDirection = region.PhysicalUnitsYDirection = _CENTIMETRES
    region.ReferencePixelX0 = region.ReferencePixelY0 = 0
    region.ReferencePixelPhysicalValueX = 100.0 * matrix[0, 3]
    region.ReferencePixelPhysicalValueY = 100.0 * matrix[2, 3]
    region.PhysicalDeltaX, region.PhysicalDeltaY = 100.0 * matrix[0, 0], 100.0 * matrix[2, 1]
    return region


KINDS: dict[str, Callable[[Sequence[Sent]], bytes]] = {"mp4": _mp4, "dcm": _dicom}
"""Makers of files, by the name's ending."""
