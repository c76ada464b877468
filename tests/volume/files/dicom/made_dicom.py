"""DICOM files made with pydicom: there is no real Enhanced US Volume that could come with us."""

from __future__ import annotations

import copy
import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.uid import UID, ExplicitVRLittleEndian, JPEG2000Lossless, RLELossless, generate_uid

ENHANCED_US_VOLUME = "1.2.840.10008.5.1.4.1.1.6.2"
US_MULTI_FRAME = "1.2.840.10008.5.1.4.1.1.3.1"
US_IMAGE = "1.2.840.10008.5.1.4.1.1.6.1"


def item(**values: Any) -> Dataset:
    """A sequence's item, or a whole header, with these elements."""
    made = Dataset()
    for key, value in values.items():
        setattr(made, key, value)
    return made


def header(pixels: np.ndarray, sop_class: str, **values: Any) -> Dataset:
    """Images (frames, rows, columns) or (frames, rows, columns, 3) without a place."""
    made = item(
        SOPClassUID=sop_class,
        SOPInstanceUID=generate_uid(),
        StudyInstanceUID=generate_uid(),
        SeriesInstanceUID=generate_uid(),
        FrameOfReferenceUID=generate_uid(),
        Modality="US",
        PatientName="Doe^Jane",
        PatientID="HX-4711",
        Rows=pixels.shape[1],
        Columns=pixels.shape[2],
        NumberOfFrames=pixels.shape[0],
        SamplesPerPixel=3 if pixels.ndim == 4 else 1,
        PhotometricInterpretation="RGB" if pixels.ndim == 4 else "MONOCHROME2",
        BitsAllocated=8 * pixels.itemsize,
        BitsStored=8 * pixels.itemsize,
        HighBit=8 * pixels.itemsize - 1,
        PixelRepresentation=int(pixels.dtype.kind == "i"),
    )
    if pixels.ndim == 4:
        made.PlanarConfiguration = 0
    made.PixelData = pixels.tobytes() + b"\0" * (pixels.nbytes % 2)
    for key, value in values.items():
        setattr(made, key, value)
    return made


def write(
    path: Path, made: Dataset, syntax: str = ExplicitVRLittleEndian, *, deflated: bool = False
) -> Path:
    """Write a header with its images."""
    made.file_meta = FileMetaDataset()
    made.file_meta.TransferSyntaxUID = UID("1.2.840.10008.1.2.1.99" if deflated else syntax)
    made.file_meta.MediaStorageSOPClassUID = made.SOPClassUID
    made.file_meta.MediaStorageSOPInstanceUID = made.SOPInstanceUID
    made["PixelData"].VR = "OB" if made.BitsAllocated == 8 or UID(syntax).is_compressed else "OW"
    made.save_as(path, enforce_file_format=True)
    return path


def compressed(made: Dataset, syntax: str) -> Dataset:
    """A copy of 8-bit grey images, each compressed: by run lengths, JPEG 2000, or JPEG."""
    made = copy.deepcopy(made)
    if syntax == RLELossless:
        made.file_meta = FileMetaDataset()
        made.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        made.compress(RLELossless, generate_instance_uid=False)
        return made
    size = (made.NumberOfFrames, made.Rows, made.Columns)
    frames = []
    for image in np.frombuffer(made.PixelData, np.uint8)[: np.prod(size)].reshape(size):
        data = io.BytesIO()
        if syntax == JPEG2000Lossless:
            Image.fromarray(image).save(data, "JPEG2000", irreversible=False, no_jp2=True)
        else:
            Image.fromarray(image).save(data, "JPEG", quality=95)
        frames.append(data.getvalue())
    made.PixelData = encapsulate(frames)
    return made


def enhanced(
    voxels: np.ndarray,
    placement_mm: np.ndarray,
    *,
    order: list[int] | None = None,
    times: int = 1,
    **values: Any,
) -> Dataset:
    """An Enhanced US Volume of (i, j, k) voxels placed by a (4, 4) matrix in mm.

    Its images are stored in any order; several volumes in time follow one another, each of them
    with its values raised by one more.
    """
    count = voxels.shape[2]
    steps = np.linalg.norm(placement_mm[:3, :3], axis=0)
    along = placement_mm[:3, :3] / steps
    order = list(range(count)) if order is None else order
    pixels, groups = [], []
    for time in range(times):
        for k in order:
            pixels.append(voxels[:, :, k].T + voxels.dtype.type(time))
            position = placement_mm[:3, 3] + k * placement_mm[:3, 2]
            group = item(
                PlanePositionVolumeSequence=[item(ImagePositionVolume=position.tolist())],
                FrameContentSequence=[item(DimensionIndexValues=[time + 1, k + 1])],
            )
            if times > 1:
                at = item(TemporalPositionTimeOffset=0.04 * time)
                group.TemporalPositionSequence = [at]
            groups.append(group)
    directions = [*along[:, 0].tolist(), *along[:, 1].tolist()]
    made = header(np.array(pixels), ENHANCED_US_VOLUME, **values)
    made.SharedFunctionalGroupsSequence = [
        item(
            PlaneOrientationVolumeSequence=[item(ImageOrientationVolume=directions)],
            PixelMeasuresSequence=[
                item(
                    PixelSpacing=[float(f"{steps[1]:.12g}"), float(f"{steps[0]:.12g}")],
                    SliceThickness=float(f"{steps[2]:.12g}"),
                )
            ],
            ImageDataTypeSequence=[item(DataType="TISSUE_INTENSITY", AliasedDataType="NO")],
        )
    ]
    made.PerFrameFunctionalGroupsSequence = groups
    made.VolumeFrameOfReferenceUID = generate_uid()
    made.UltrasoundAcquisitionGeometry = "PATIENT"
    made.BurnedInAnnotation = "NO"
    return made


def turned(
    angle: float = 0.7, spacing: tuple[float, float, float] = (0.5, 0.25, 2.0)
) -> np.ndarray:
    """(4, 4) mm, an oblique anisotropic grid."""
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    cross = np.cross(np.eye(3), axis)
    rotation = np.eye(3) + np.sin(angle) * cross.T + (1 - np.cos(angle)) * cross.T @ cross.T
    made = np.eye(4)
    made[:3, :3] = rotation * spacing
    made[:3, 3] = (-12.5, 40.0, 7.75)
    return made
