"""What a header has, by the names of its elements and never by their values.

A report that showed values would have to be kept as closely as the original. Private elements are
shown by their numbers, since the name of whoever made them is a text of the file as well; the same
holds for fields of other formats whose names are nobody's convention.

>>> from pydicom.dataset import Dataset
>>> from us_sim.volume.deidentification.header_names import dicom_names
>>> header, inner = Dataset(), Dataset()
>>> inner.CodeMeaning = "Left arm of Jane Doe"; header.AnatomicRegionSequence = [inner]
>>> header.add_new(0x00090010, "LO", "DOE"); header.PatientName = "Doe^Jane"
>>> for name, count in sorted(dicom_names(header).items()):
...     print(name, count)
AnatomicRegionSequence > CodeMeaning 1
PatientName 1
private element (0009,0010) 1
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

from us_sim.volume.files.dicom.values import quiet
from us_sim.volume.files.metaimage import metaimage_header
from us_sim.volume.files.nifti import NIFTI_TEXTS, nifti_fields

_DEEPEST = 12

_METAIMAGE = frozenset(
    [
        "ObjectType",
        "ObjectSubType",
        "NDims",
        "BinaryData",
        "BinaryDataByteOrderMSB",
        "ElementByteOrderMSB",
        "CompressedData",
        "CompressedDataSize",
        "TransformMatrix",
        "Rotation",
        "Orientation",
        "Offset",
        "Position",
        "Origin",
        "CenterOfRotation",
        "AnatomicalOrientation",
        "ElementSpacing",
        "ElementSize",
        "ElementNumberOfChannels",
        "DimSize",
        "ElementType",
        "ElementDataFile",
        "HeaderSize",
    ]
)
"""Fields of a MetaImage that say where its voxels are; a volume has no use for others."""

_NRRD = frozenset(
    [
        "type",
        "dimension",
        "space",
        "space dimension",
        "sizes",
        "space directions",
        "space origin",
        "space units",
        "kinds",
        "endian",
        "encoding",
        "spacings",
        "centers",
        "centerings",
        "thicknesses",
        "measurement frame",
        "units",
        "data file",
        "datafile",
        "line skip",
        "byte skip",
        "axis mins",
        "axis maxs",
        "block size",
    ]
)

_COMMON = frozenset(
    [
        "Comment",
        "Name",
        "ID",
        "Modality",
        "AcquisitionDate",
        "PatientName",
        "PatientID",
        "PatientSex",
        "PatientBirthDate",
        "StudyDate",
        "StudyTime",
        "StudyID",
        "SeriesDescription",
        "InstitutionName",
        "Manufacturer",
        "content",
        "number",
        "sample units",
        "old min",
        "old max",
        "labels",
        "UltrasoundImageOrientation",
        "UltrasoundImageType",
        "Seq_Frame0000_ImageStatus",
    ]
)
"""Names of fields that many programs write; any other name may be somebody's own."""


def dicom_names(header: Any) -> dict[str, int]:
    """How often each element is there, those within sequences by the way to them."""
    found: Counter[str] = Counter()
    meta = getattr(header, "file_meta", None)
    with quiet():
        if meta is not None:
            _count(meta, "", found, 0)
        _count(header, "", found, 0)
    return dict(found)


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


def _count(header: Any, before: str, found: Counter[str], depth: int) -> None:
    from pydicom.datadict import keyword_for_tag

    for tag in list(header.keys()):
        keyword = keyword_for_tag(tag)
        if not keyword:
            kind = "private" if tag.group % 2 else "unknown"
            keyword = f"{kind} element ({tag.group:04X},{tag.element:04X})"
        inner = _items(header, tag) if depth < _DEEPEST else []
        for item in inner:
            _count(item, f"{before}{keyword} > ", found, depth + 1)
        if not inner:
            found[before + keyword] += 1


def _items(header: Any, tag: Any) -> list[Any]:
    """The items of an element that is a sequence."""
    try:
        element = header[tag]
        return list(element.value) if element.VR == "SQ" else []
    except Exception:  # the bytes of a stranger: one that cannot be read is dropped as a whole
        return []


def _shown(keys: Any) -> dict[str, int]:
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
