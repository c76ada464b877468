"""The values of a DICOM header that go on, each with its reason; all others are dropped.

Where voxels lie goes on as the grid itself. Beside it only numbers go on that say how the image
was made, within the range that such a number has, and words from the standard's own closed lists.
No date, text, identifier or name is among them, and no number of the patient's body. This list of
what stays needs no table of what to remove: tools that apply PS3.15, table E.1-1, leave private
elements and texts that it does not name to further rules.

A report names elements and never shows values, or it would have to be kept as closely as the
original. Private elements are shown by their numbers, since the name of whoever made them is a text
of the file as well; so are fields of other formats whose names are nobody's convention.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from us_sim.volume.files.dicom.header import items, numbers, quiet, text
from us_sim.volume.files.metaimage import metaimage_header
from us_sim.volume.files.nifti import NIFTI_TEXTS, nifti_fields


class KeptNumber(NamedTuple):
    """A number, or several, that may go on."""

    name: str  # of the field in the file that is written, with its unit
    keyword: str  # of the standard
    low: float
    high: float
    why: str
    length: int | None = 1  # None: any number of them, up to 16
    within: str = ""  # the sequence whose first item has it


_REGIONS = "SequenceOfUltrasoundRegions"
_POWER = "power of the sound"
_SEEN_FROM = "where the transducer was, as seen from the volume"
NUMBERS = tuple(
    KeptNumber(*values)
    for values in (
        ("frame_time_ms", "FrameTime", 1e-2, 1e5, "time between images"),
        ("cine_rate_per_s", "CineRate", 0.1, 1e4, "time between images"),
        ("depth_of_scan_field_mm", "DepthOfScanField", 1, 1000, "depth of the image"),
        ("depths_of_focus_mm", "DepthsOfFocus", 0.1, 1000, "where it is sharpest", None),
        ("mechanical_index", "MechanicalIndex", 0, 10, "pressure of the sound"),
        ("bone_thermal_index", "BoneThermalIndex", 0, 20, _POWER),
        ("cranial_thermal_index", "CranialThermalIndex", 0, 20, _POWER),
        ("soft_tissue_thermal_index", "SoftTissueThermalIndex", 0, 20, _POWER),
        ("transducer_frequency_khz", "TransducerFrequency", 100, 1e5,
         "wavelength, and with it the grain of speckle", 1, _REGIONS),
        ("pulse_repetition_frequency_hz", "PulseRepetitionFrequency", 1, 1e6,
         "depth and rate of the image", 1, _REGIONS),
        ("apex_position_mm", "ApexPosition", -1e4, 1e4, "where a fan of lines has its apex", 3),
        ("volume_to_transducer", "VolumeToTransducerMappingMatrix", -1e4, 1e4, _SEEN_FROM, 16),
    )
)  # fmt: skip


def _listed(text: str) -> frozenset[str]:
    """Terms, which may hold blanks, that commas separate."""
    return frozenset(" ".join(term.split()) for term in text.split(","))


_TRANSDUCERS = """
    SECTOR_PHASED, SECTOR_MECH, SECTOR_ANNULAR, LINEAR, CURVED LINEAR, SINGLE CRYSTAL,
    SPLIT XTAL CWD, IV_PHASED, IV_ROT XTAL, IV_ROT MIRROR, ENDOCAV_PA, ENDOCAV_MECH, ENDOCAV_CLA,
    ENDOCAV_AA, ENDOCAV_LINEAR, VECTOR_PHASED
"""
CLOSED_LISTS: Mapping[str, tuple[str, frozenset[str]]] = {
    "transducer_type": ("TransducerType", _listed(_TRANSDUCERS)),
    "ultrasound_acquisition_geometry": ("UltrasoundAcquisitionGeometry", _listed("APEX, UNKNOWN")),
}
"""By the field that is written: the keyword, and the standard's terms for it (PS3.3, C.8.5.6,
C.8.24.2); any other word is dropped."""

_USED_TEXT = """
    Rows Columns NumberOfFrames SamplesPerPixel PhotometricInterpretation PlanarConfiguration
    BitsAllocated BitsStored HighBit PixelRepresentation PixelData FloatPixelData
    DoubleFloatPixelData PixelSpacing NominalScannedPixelSpacing PixelAspectRatio
    SpacingBetweenSlices ImagePositionPatient ImageOrientationPatient ImagePositionVolume
    ImageOrientationVolume GridFrameOffsetVector TemporalPositionTimeOffset FrameTimeVector
    FrameIncrementPointer RescaleSlope RescaleIntercept TransferSyntaxUID RegionSpatialFormat
    RegionDataType RegionLocationMinX0 RegionLocationMinY0 RegionLocationMaxX1
    RegionLocationMaxY1 PhysicalUnitsXDirection PhysicalUnitsYDirection PhysicalDeltaX
    PhysicalDeltaY RedPaletteColorLookupTableDescriptor GreenPaletteColorLookupTableDescriptor
    BluePaletteColorLookupTableDescriptor RedPaletteColorLookupTableData
    GreenPaletteColorLookupTableData BluePaletteColorLookupTableData
    SegmentedRedPaletteColorLookupTableData SegmentedGreenPaletteColorLookupTableData
    SegmentedBluePaletteColorLookupTableData
"""
USED = frozenset(_USED_TEXT.split())
"""Elements of which only the effect goes on: the grey values, the grid, the times, the blanks."""

_METAIMAGE_TEXT = """
    ObjectType ObjectSubType NDims BinaryData BinaryDataByteOrderMSB ElementByteOrderMSB
    CompressedData CompressedDataSize TransformMatrix Rotation Orientation Offset Position
    Origin CenterOfRotation AnatomicalOrientation ElementSpacing ElementSize
    ElementNumberOfChannels DimSize ElementType ElementDataFile HeaderSize
"""
_METAIMAGE = frozenset(_METAIMAGE_TEXT.split())
_NRRD_TEXT = """
    type, dimension, space, space dimension, sizes, space directions, space origin, space units,
    kinds, endian, encoding, spacings, centers, centerings, thicknesses, measurement frame,
    units, data file, datafile, line skip, byte skip, axis mins, axis maxs, block size
"""
_NRRD = _listed(_NRRD_TEXT)  # fields that say where voxels are; a volume has no use for others
_COMMON_TEXT = """
    Comment, Name, ID, Modality, AcquisitionDate, PatientName, PatientID, PatientSex,
    PatientBirthDate, StudyDate, StudyTime, StudyID, SeriesDescription, InstitutionName,
    Manufacturer, content, number, sample units, old min, old max, labels,
    UltrasoundImageOrientation, UltrasoundImageType, Seq_Frame0000_ImageStatus
"""
_COMMON = _listed(_COMMON_TEXT)
"""Names of fields that many programs write; any other name may be somebody's own."""


def kept_values(header: Any) -> dict[str, str]:
    """The values that go on, as text, by the name of their field."""
    kept: dict[str, str] = {}
    for one in NUMBERS:
        source = next(iter(items(header, one.within)), None) if one.within else header
        found = numbers(source, one.keyword, one.length)
        if found and len(found) <= 16 and all(one.low <= each <= one.high for each in found):
            kept[one.name] = " ".join(f"{each:.9g}" for each in found)
    for name, (keyword, terms) in CLOSED_LISTS.items():
        if (word := text(header, keyword)) in terms:
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


def dicom_names(header: Any) -> dict[str, int]:
    """How often each element is there, those within sequences by the way to them."""
    found: Counter[str] = Counter()
    meta = getattr(header, "file_meta", None)
    with quiet():
        for part in (meta, header) if meta is not None else (header,):
            _count(part, "", found, 0)
    return dict(found)


def _count(header: Any, before: str, found: Counter[str], depth: int) -> None:
    from pydicom.datadict import keyword_for_tag

    for tag in list(header.keys()):
        keyword = keyword_for_tag(tag)
        if not keyword:
            kind = "private" if tag.group % 2 else "unknown"
            keyword = f"{kind} element ({tag.group:04X},{tag.element:04X})"
        inner: list[Any] = []
        try:
            if depth < 12 and header[tag].VR == "SQ":
                inner = list(header[tag].value)
        except Exception:  # the bytes of a stranger: one that cannot be read is dropped as a whole
            pass
        for item in inner:
            _count(item, f"{before}{keyword} > ", found, depth + 1)
        if not inner:
            found[before + keyword] += 1


def other_names(path: Path) -> dict[str, int]:
    """Fields of a MetaImage, NRRD or NIfTI file that do not go on, and how often each is there."""
    ending = path.name.lower()
    if ending.endswith((".mha", ".mhd")):
        fields, _ = metaimage_header(path)
        return _shown(key for key in fields if key not in _METAIMAGE)
    if ending.endswith((".nrrd", ".nhdr")):
        return _shown(_nrrd_fields(path))
    texts = nifti_fields(path)
    return {name: 1 for name in NIFTI_TEXTS if texts.get(name, b"").strip(b"\0 ")}


def _shown(keys: Iterable[str]) -> dict[str, int]:
    """Names that are common or DICOM's own; others are counted only."""
    found: Counter[str] = Counter()
    for key in keys:
        if key in _COMMON or re.fullmatch(r"[0-9a-fA-F]{4}\|[0-9a-fA-F]{4}", key):
            found[key] += 1
        elif match := re.fullmatch(r"Seq_Frame[0-9]+_(Timestamp|FrameNumber|ImageStatus)", key):
            found[f"Seq_Frame_{match[1]}"] += 1
        else:
            found["field with a name of its own"] += 1
    return dict(found)


def _nrrd_fields(path: Path) -> list[str]:
    """Names of fields, pairs and comments that a volume has no use for."""
    keys = []
    with path.open("rb") as file:
        file.readline(64)
        while line := file.readline(1 << 16).decode("latin-1").rstrip("\r\n"):
            if line.startswith("#"):
                keys.append("Comment")
            elif ":=" in line:
                keys.append(line.partition(":=")[0].strip())
            elif line.partition(":")[0].strip().lower() not in _NRRD:
                keys.append(line.partition(":")[0].strip())
            if file.tell() > 1 << 24:
                break
    return keys
