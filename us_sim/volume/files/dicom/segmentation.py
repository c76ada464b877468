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
from us_sim.volume.files.dicom.header import DicomFile, items, number, numbers, text, whole
from us_sim.volume.files.dicom.pixels import ImageFormat, image_format, stored_frames
from us_sim.volume.files.dicom.placed_images import SEGMENTATIONS
from us_sim.volume.files.dicom.planes import sparse_grid_of, stated_planes
from us_sim.volume.files.segments import Segment
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
        """(i, j, k) the voxels in a segment.

        Raises:
            VolumeError: an image is damaged, or its decoder is missing.
        """
        found = np.zeros(self.shape, bool)
        wanted = [n for n, (of, _) in enumerate(self._frames) if of in (0, segment.value)]
        for n, image in zip(wanted, stored_frames(self.file, self.form, wanted), strict=True):
            inside = image >= self._least if self._least else image == segment.value
            found[:, :, self._frames[n][1]] |= inside.T
        return found


def read_segmentation(file: DicomFile) -> DicomSegmentation:
    """The segments of a file.

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
    shared = items(header, "SharedFunctionalGroupsSequence")[:1]
    own = items(header, "PerFrameFunctionalGroupsSequence")
    steps = [
        number(each, "SpacingBetweenSlices")
        for group in (*shared, *own[:1])
        for each in items(group, "PixelMeasuresSequence")
    ]
    slices, placement = sparse_grid_of(
        path, planes, next((s for s in steps if s and s > 0.0), None)
    )
    is_map = text(header, "SegmentationType") == "LABELMAP"
    of = [0] * form.frames if is_map else [_segment_of(group, shared) for group in own]
    segments = [_segment(item) for item in items(header, "SegmentSequence")]
    known = {segment.value for segment in segments}
    if (not is_map and not set(of) <= known) or not segments:
        raise VolumeError(f"{path}: has images of segments that it does not describe")
    shape = (form.columns, form.rows, max(slices) + 1)
    if np.prod(shape, dtype=float) > 1 << 28:
        raise VolumeError(f"{path}: spans {shape[2]} slices, more than can be read; export a part")
    least = 0 if is_map else max(((whole(header, "MaximumFractionalValue") or 1) + 1) // 2, 1)
    return DicomSegmentation(
        file, form, segments, shape, placement, list(zip(of, slices, strict=True)), least
    )


def _segment_of(group: Any, shared: list[Any]) -> int:
    for each in (group, *shared):
        for item in items(each, "SegmentIdentificationSequence")[:1]:
            return whole(item, "ReferencedSegmentNumber") or -1
    return -1


def _segment(item: Any) -> Segment:
    codes = []
    for kind in items(item, "SegmentedPropertyTypeCodeSequence")[:1]:
        codes = [_code(kind)]
        for modifier in items(kind, "SegmentedPropertyTypeModifierCodeSequence")[:1]:
            codes.append(_code(modifier))
    return Segment(
        text(item, "SegmentLabel"),
        whole(item, "SegmentNumber") or 0,
        0,
        _colour(item),
        None,
        tuple(code for code in codes if code),
    )


def _code(item: Any) -> str:
    """A SNOMED code; empty where it is another scheme's."""
    return text(item, "CodeValue") if text(item, "CodingSchemeDesignator") == "SCT" else ""


def _colour(item: Any) -> Colour | None:
    """Red, green and blue of the recommended CIELab value (PS3.3, C.10.7.1.1)."""
    found = numbers(item, "RecommendedDisplayCIELabValue", 3)
    if found is None:
        return None
    light, a, b = (value / 65535.0 for value in found)
    lab = np.array([[[100.0 * light, 255.0 * a - 128.0, 255.0 * b - 128.0]]], np.float32)
    red, green, blue = (float(part) for part in cv2.cvtColor(lab, cv2.COLOR_Lab2RGB)[0, 0])
    return min(max(red, 0.0), 1.0), min(max(green, 0.0), 1.0), min(max(blue, 0.0), 1.0)
