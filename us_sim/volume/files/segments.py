"""Segments in the header of a 3D Slicer segmentation (``.seg.nrrd``).

Several segments share a layer as long as they do not overlap; in a layer each has a number. Files
of Slicer before 5 have a layer for each segment, in which it is 1
(slicer.readthedocs.io, "Segmentations", "Segmentation file (.seg.nrrd) file format").
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.settings.spelling import shown
from us_sim.volume.structure_names import Colour

_FIELD = re.compile(r"Segment(\d{1,6})_(\w+)")


@dataclass(frozen=True)
class Segment:
    """One segment of a file."""

    name: str
    value: int  # of its voxels
    layer: int
    colour: Colour | None  # red, green, blue, 0 to 1


def segments_of(path: Path, pairs: Mapping[str, str]) -> list[Segment]:
    """The segments that the keys and values of a header describe, in their order; often none."""
    for key in ("Segmentation_MasterRepresentation", "Segmentation_SourceRepresentation"):
        if (said := pairs.get(key, "Binary labelmap")).lower() != "binary labelmap":
            raise VolumeError(
                f"{path}: holds segments as {shown(said)}; save it with `Binary labelmap` as the "
                f"source representation"
            )
    found: dict[int, dict[str, str]] = {}
    for key, value in pairs.items():
        if match := _FIELD.fullmatch(key):
            found.setdefault(int(match[1]), {})[match[2]] = value
    shared = any("LabelValue" in fields for fields in found.values())
    segments = []
    for at, (number, fields) in enumerate(sorted(found.items())):
        value = fields.get("LabelValue", "1")
        layer = fields.get("Layer", "0" if shared else f"{at}")
        if not (value.isdecimal() and int(value) and layer.isdecimal()):
            raise VolumeError(
                f"{path}: its Segment{number} has the LabelValue {shown(value)} and the Layer "
                f"{shown(layer)}, where numbers belong, from 1 and 0 on; save it again"
            )
        segments.append(
            Segment(
                fields.get("Name", "").strip() or f"structure {number + 1}",
                int(value),
                int(layer),
                _colour(fields.get("Color", "")),
            )
        )
    return segments


def refuse_segments(path: Path, pairs: Mapping[str, str]) -> None:
    """Refuse a segmentation, by the keys of its header, where an image belongs."""
    if any(map(_FIELD.fullmatch, pairs)):
        raise VolumeError(
            f"{path}: is a segmentation, which has labels and no grey values; give it to "
            f"`us-sim segment CASE --labels {path.name}`"
        )


def _colour(text: str) -> Colour | None:
    """Read a colour; where it is none, the structure's name suggests one."""
    try:
        red, green, blue = (float(word) for word in text.split())
    except ValueError:
        return None
    return (red, green, blue) if all(0.0 <= part <= 1.0 for part in (red, green, blue)) else None
