"""Segmentations of DICOM: the voxels of each segment, its name and codes (PS3.3, C.8.20).

Frames are of one segment and one plane each, those without a voxel are left out, and segments may
overlap; in a label map the values of all frames are the segments' numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import (
    DicomFile,
    groups_of,
    items,
    number,
    numbers,
    text,
)
from us_sim.volume.files.dicom.pixels import ImageFormat, image_format, stored_frames
from us_sim.volume.files.dicom.placed_images import SEGMENTATIONS
from us_sim.volume.files.dicom.planes import grid_of, stated_planes
from us_sim.volume.files.segments import Segment
from us_sim.volume.files.stored_image import check_claim
from us_sim.volume.structure_names import Colour


@dataclass(frozen=True, eq=False)
class DicomSegmentation:
    """Segments on a grid."""

    file: DicomFile
    form: ImageFormat
    segments: list[Segment]  # each a layer of its own
    shape: tuple[int, int, int]
    placement: NDArray[np.float64]  # (4, 4) m, from indices
    _frames: list[tuple[int, int]]  # of each frame its segment's number, or 0 for all, and slice
    _least: int  # value from which on a voxel belongs to a segment; 0 in a label map

    def mask(self, segment: Segment) -> NDArray[np.bool_]:
        """Return the voxels (i, j, k) in a segment."""
        found = np.zeros(self.shape, bool)
        wanted = [n for n, (of, _) in enumerate(self._frames) if of in (0, segment.value)]
        for n, image in zip(wanted, stored_frames(self.file, self.form, wanted), strict=True):
            inside = image >= self._least if self._least else image == segment.value
            found[:, :, self._frames[n][1]] |= inside.T
        return found


def read_segmentation(file: DicomFile) -> DicomSegmentation:
    """Read the segments of a file.

    Raises:
        VolumeError: it is none, or does not say where its images lie or of which segment they are.
    """
    path, header = file.path, file.header
    if text(header, "SOPClassUID") not in SEGMENTATIONS:
        raise VolumeError(f"{path}: is a DICOM file without labels; give a DICOM segmentation")
    form = image_format(file)
    planes = stated_planes(file, form.frames)
    if planes is None:
        raise VolumeError(f"{path}: does not state where its images lie; export it again")
    groups = groups_of(header, form.frames)
    measures = (each for part in groups[0] for each in items(part, "PixelMeasuresSequence"))
    steps = (number(each, "SpacingBetweenSlices") for each in measures)
    slices, placement = grid_of(path, planes, next(filter(None, steps), None), sparse=True)
    is_map = text(header, "SegmentationType") == "LABELMAP"
    of = [0 if is_map else _segment_of(each) for each in groups]
    segments = [_segment(item) for item in items(header, "SegmentSequence")]
    if not segments or not set(of) <= {0, *(segment.value for segment in segments)}:
        raise VolumeError(f"{path}: has images of segments that it does not describe")
    shape = (form.columns, form.rows, max(slices) + 1)
    check_claim(path, shape, 1)
    least = 0 if is_map else (int(number(header, "MaximumFractionalValue") or 1) + 1) // 2
    return DicomSegmentation(
        file, form, segments, shape, placement, list(zip(of, slices, strict=True)), least
    )


def _segment_of(groups: tuple[Any, ...]) -> int:
    """Return the number of an image's segment; -1 where it is not stated."""
    found = (each for part in groups for each in items(part, "SegmentIdentificationSequence"))
    return int(number(next(found, {}), "ReferencedSegmentNumber") or -1)


def _segment(item: Any) -> Segment:
    kinds = items(item, "SegmentedPropertyTypeCodeSequence")[:1]
    for kind in kinds[:1]:
        kinds += items(kind, "SegmentedPropertyTypeModifierCodeSequence")[:1]
    codes = [
        text(kind, "CodeValue") for kind in kinds if text(kind, "CodingSchemeDesignator") == "SCT"
    ]
    return Segment(
        text(item, "SegmentLabel"),
        int(number(item, "SegmentNumber") or 0),
        0,
        _colour(item),
        tuple(codes),
    )


def _colour(item: Any) -> Colour | None:
    """Return red, green and blue of the recommended CIELab value (PS3.3, C.10.7.1.1)."""
    found = numbers(item, "RecommendedDisplayCIELabValue", 3)
    if not found:
        return None
    light, a, b = (value / 65535.0 for value in found)
    lab = np.array([[[100.0 * light, 255.0 * a - 128.0, 255.0 * b - 128.0]]], np.float32)
    red, green, blue = np.clip(cv2.cvtColor(lab, cv2.COLOR_Lab2RGB)[0, 0], 0.0, 1.0).tolist()
    return red, green, blue
