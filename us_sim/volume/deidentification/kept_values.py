"""The values of a DICOM header that go on; all others are dropped.

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

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from us_sim.volume.files.dicom.header import items, numbers, quiet, text


class KeptNumber(NamedTuple):
    """A number, or several, that may go on."""

    name: str  # of the field in the file that is written, with its unit
    keyword: str  # of the standard
    low: float
    high: float
    length: int | None = 1  # None: any number of them, up to 16
    within: str = ""  # the sequence whose first item has it


_REGIONS = "SequenceOfUltrasoundRegions"
NUMBERS = (
    KeptNumber("frame_time_ms", "FrameTime", 1e-2, 1e5),
    KeptNumber("cine_rate_per_s", "CineRate", 0.1, 1e4),
    KeptNumber("depth_of_scan_field_mm", "DepthOfScanField", 1, 1000),
    KeptNumber("depths_of_focus_mm", "DepthsOfFocus", 0.1, 1000, None),
    KeptNumber("mechanical_index", "MechanicalIndex", 0, 10),
    KeptNumber("bone_thermal_index", "BoneThermalIndex", 0, 20),
    KeptNumber("cranial_thermal_index", "CranialThermalIndex", 0, 20),
    KeptNumber("soft_tissue_thermal_index", "SoftTissueThermalIndex", 0, 20),
    KeptNumber("transducer_frequency_khz", "TransducerFrequency", 100, 1e5, 1, _REGIONS),
    KeptNumber("pulse_repetition_frequency_hz", "PulseRepetitionFrequency", 1, 1e6, 1, _REGIONS),
    KeptNumber("apex_position_mm", "ApexPosition", -1e4, 1e4, 3),
    KeptNumber("volume_to_transducer", "VolumeToTransducerMappingMatrix", -1e4, 1e4, 16),
)


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


def kept_values(header: Any) -> dict[str, str]:
    """Return the values that go on, as text, by the name of their field."""
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


def dropped_names(header: Any, kept: Mapping[str, str]) -> dict[str, int]:
    """Return how often each element is there whose value does not go on, by the way to it."""
    keywords = {one.keyword for one in NUMBERS if one.name in kept}
    keywords |= {keyword for name, (keyword, _) in CLOSED_LISTS.items() if name in kept}
    found: Counter[str] = Counter()
    with quiet():
        for part in (getattr(header, "file_meta", None), header):
            _count(part or {}, "", found)
    return {name: n for name, n in found.items() if name.rpartition(" > ")[2] not in keywords}


def _count(header: Any, before: str, found: Counter[str]) -> None:
    from pydicom.datadict import keyword_for_tag

    for tag in list(header.keys()):
        kind = "private" if tag.group % 2 else "unknown"
        name = keyword_for_tag(tag) or f"{kind} element ({tag.group:04X},{tag.element:04X})"
        found[before + name] += 1
        for item in items(header, tag) if keyword_for_tag(tag).endswith("Sequence") else ():
            _count(item, f"{before}{name} > ", found)
