"""The values of a DICOM header that go on, each with its reason; all others are dropped.

Where voxels lie goes on as the grid itself. Beside it only numbers go on that say how the image
was made, within the range that such a number has, and words from the standard's own closed lists.
No date, text, identifier or name is among them, and no number of the patient's body.

>>> from pydicom.dataset import Dataset
>>> from us_sim.volume.deidentification.kept_values import kept_values
>>> header = Dataset()
>>> header.PatientName = "Doe^Jane"; header.PatientID = "98279"
>>> header.DepthOfScanField = 150; header.TransducerType = "LINEAR"
>>> kept_values(header)
{'depth_of_scan_field_mm': '150', 'transducer_type': 'LINEAR'}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from us_sim.volume.files.dicom.values import items, numbers, text

_REGIONS = "SequenceOfUltrasoundRegions"


@dataclass(frozen=True)
class KeptNumber:
    """A number, or several, that may go on."""

    name: str  # of the field in the file that is written, with its unit
    keyword: str  # of the standard
    low: float
    high: float
    why: str
    count: int | None = 1  # None: any number of them, up to 16
    within: str = ""  # the sequence whose first item has it


NUMBERS = (
    KeptNumber("frame_time_ms", "FrameTime", 1e-2, 1e5, "time between images"),
    KeptNumber("cine_rate_per_s", "CineRate", 0.1, 1e4, "time between images"),
    KeptNumber("depth_of_scan_field_mm", "DepthOfScanField", 1, 1000, "depth of the image"),
    KeptNumber("depths_of_focus_mm", "DepthsOfFocus", 0.1, 1000, "where it is sharpest", None),
    KeptNumber("mechanical_index", "MechanicalIndex", 0, 10, "pressure of the sound"),
    KeptNumber("bone_thermal_index", "BoneThermalIndex", 0, 20, "power of the sound"),
    KeptNumber("cranial_thermal_index", "CranialThermalIndex", 0, 20, "power of the sound"),
    KeptNumber("soft_tissue_thermal_index", "SoftTissueThermalIndex", 0, 20, "power of the sound"),
    KeptNumber(
        "transducer_frequency_khz",
        "TransducerFrequency",
        100,
        1e5,
        "wavelength, and with it the grain of speckle",
        within=_REGIONS,
    ),
    KeptNumber(
        "pulse_repetition_frequency_hz",
        "PulseRepetitionFrequency",
        1,
        1e6,
        "depth and rate of the image",
        within=_REGIONS,
    ),
    KeptNumber(
        "apex_position_mm", "ApexPosition", -1e4, 1e4, "where a fan of lines has its apex", 3
    ),
    KeptNumber(
        "volume_to_transducer",
        "VolumeToTransducerMappingMatrix",
        -1e4,
        1e4,
        "where the transducer was, as seen from the volume",
        16,
    ),
)

CLOSED_LISTS: Mapping[str, tuple[str, frozenset[str]]] = {
    "transducer_type": (
        "TransducerType",
        frozenset(
            [
                "SECTOR_PHASED",
                "SECTOR_MECH",
                "SECTOR_ANNULAR",
                "LINEAR",
                "CURVED LINEAR",
                "SINGLE CRYSTAL",
                "SPLIT XTAL CWD",
                "IV_PHASED",
                "IV_ROT XTAL",
                "IV_ROT MIRROR",
                "ENDOCAV_PA",
                "ENDOCAV_MECH",
                "ENDOCAV_CLA",
                "ENDOCAV_AA",
                "ENDOCAV_LINEAR",
                "VECTOR_PHASED",
            ]
        ),
    ),
    "ultrasound_acquisition_geometry": (
        "UltrasoundAcquisitionGeometry",
        frozenset({"APEX", "UNKNOWN"}),
    ),
}
"""By the field that is written: the keyword, and the standard's terms for it (PS3.3, C.8.5.6,
C.8.24.2); any other word is dropped."""

USED = frozenset(
    [
        "Rows",
        "Columns",
        "NumberOfFrames",
        "SamplesPerPixel",
        "PhotometricInterpretation",
        "PlanarConfiguration",
        "BitsAllocated",
        "BitsStored",
        "HighBit",
        "PixelRepresentation",
        "PixelData",
        "FloatPixelData",
        "DoubleFloatPixelData",
        "PixelSpacing",
        "NominalScannedPixelSpacing",
        "PixelAspectRatio",
        "SpacingBetweenSlices",
        "ImagePositionPatient",
        "ImageOrientationPatient",
        "ImagePositionVolume",
        "ImageOrientationVolume",
        "GridFrameOffsetVector",
        "TemporalPositionTimeOffset",
        "FrameTimeVector",
        "FrameIncrementPointer",
        "RescaleSlope",
        "RescaleIntercept",
        "TransferSyntaxUID",
        "RegionSpatialFormat",
        "RegionDataType",
        "RegionLocationMinX0",
        "RegionLocationMinY0",
        "RegionLocationMaxX1",
        "RegionLocationMaxY1",
        "PhysicalUnitsXDirection",
        "PhysicalUnitsYDirection",
        "PhysicalDeltaX",
        "PhysicalDeltaY",
        "RedPaletteColorLookupTableDescriptor",
        "GreenPaletteColorLookupTableDescriptor",
        "BluePaletteColorLookupTableDescriptor",
        "RedPaletteColorLookupTableData",
        "GreenPaletteColorLookupTableData",
        "BluePaletteColorLookupTableData",
        "SegmentedRedPaletteColorLookupTableData",
        "SegmentedGreenPaletteColorLookupTableData",
        "SegmentedBluePaletteColorLookupTableData",
    ]
)
"""Elements of which only the effect goes on: the grey values, the grid, the times, what is
blanked."""


def kept_values(header: Any) -> dict[str, str]:
    """The values that go on, as text, by the name of their field."""
    kept: dict[str, str] = {}
    for one in NUMBERS:
        source = next(iter(items(header, one.within)), None) if one.within else header
        found = numbers(source, one.keyword, one.count)
        if found and len(found) <= 16 and all(one.low <= each <= one.high for each in found):
            kept[one.name] = " ".join(f"{each:.9g}" for each in found)
    for name, (keyword, terms) in CLOSED_LISTS.items():
        word = text(header, keyword)
        if word in terms:
            kept[name] = word
    return kept


def sorted_out(
    names: Mapping[str, int], kept: Mapping[str, str]
) -> tuple[dict[str, int], dict[str, int]]:
    """Of the elements of a header those of which the effect goes on, and those that are dropped.

    Args:
        names: how often each is there, by its name or the way to it.
        kept: the values that go on as they are; their elements are among neither.
    """
    keywords = {one.keyword for one in NUMBERS if one.name in kept}
    keywords |= {keyword for name, (keyword, _) in CLOSED_LISTS.items() if name in kept}
    used, dropped = {}, {}
    for name, count in names.items():
        last = name.rpartition(" > ")[2]
        if last in USED:
            used[name] = count
        elif last not in keywords:
            dropped[name] = count
    return used, dropped
