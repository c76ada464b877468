"""Which part of every image goes on: what the scanner's own header says is echo, or a rectangle.

A scanner writes names, dates and hospitals around the echoes. Where its header has a sequence of
ultrasound regions (PS3.3, C.8.5.5) only its two-dimensional regions of tissue and flow are kept:
grey bars, electrocardiograms, spectra and graphics are blanked with all that lies outside. Where
there is no such sequence, or one that cannot be true, a person has to say what is kept.

>>> import pydicom.data
>>> from us_sim.volume.deidentification.kept_part import ultrasound_regions
>>> from us_sim.volume.files.dicom.header import open_dicom
>>> file = open_dicom(pydicom.data.get_testdata_file("examples_ybr_color.dcm"))
>>> ultrasound_regions(file, rows=240, columns=320)
Regions(kept=(), blanked=0, doubt='a region reaches to 595,414 in an image of 320 × 240 pixels')
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.volume.deidentification.rectangle import Rectangle
from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.values import items, number, numbers, text, whole

_TWO_DIMENSIONAL = 1  # Region Spatial Format
_ECHOES = (1, 2)  # Region Data Type: tissue, colour flow
_CENTIMETRES = 3  # Physical Units
_GROUPS = ("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence")
_ENHANCED_US_VOLUME = "1.2.840.10008.5.1.4.1.1.6.2"


@dataclass(frozen=True)
class Regions:
    """What a header's sequence of ultrasound regions says."""

    kept: tuple[Rectangle, ...]
    blanked: int = 0  # regions of other kinds
    doubt: str = ""  # why it is not believed, or that there is none

    def mask(self, rows: int, columns: int) -> NDArray[np.bool_]:
        """(rows, columns) what is kept."""
        made = np.zeros((rows, columns), bool)
        for region in self.kept:
            made[region.slices] = True
        return made


def ultrasound_regions(file: DicomFile, rows: int, columns: int) -> Regions:
    """The regions of echoes, if the sequence is there and can be true."""
    listed = items(file.header, "SequenceOfUltrasoundRegions")
    if not listed:
        return Regions((), doubt="there is no sequence of ultrasound regions")
    kept, blanked = [], 0
    for region in listed:
        edges = [
            whole(region, f"RegionLocation{key}") for key in ("MinX0", "MinY0", "MaxX1", "MaxY1")
        ]
        if any(edge is None for edge in edges):
            return Regions((), doubt="a region has no edges")
        left, top, right, bottom = (int(edge or 0) for edge in edges)
        # Some scanners write the first column beyond a region as its last.
        if right > columns or bottom > rows or min(left, top) < 0:
            return Regions(
                (),
                doubt=f"a region reaches to {right},{bottom} in an image of {columns} × {rows} "
                f"pixels",
            )
        right, bottom = min(right, columns - 1), min(bottom, rows - 1)
        if right < left or bottom < top:
            return Regions((), doubt="a region holds no pixel")
        if _holds_echoes(region):
            kept.append(Rectangle(left, top, right, bottom))
        else:
            blanked += 1
    if not kept:
        return Regions((), blanked, doubt="no region is a two-dimensional image of tissue or flow")
    return Regions(tuple(kept), blanked)


def _holds_echoes(region: object) -> bool:
    return (
        whole(region, "RegionSpatialFormat") == _TWO_DIMENSIONAL
        and whole(region, "RegionDataType") in _ECHOES
    )


def never_holds_text(file: DicomFile) -> bool:
    """Whether it is of a kind of which the standard says that nothing is burned in.

    That is the Enhanced US Volume (PS3.3, C.8.24.3: Burned In Annotation is NO).
    """
    return (
        text(file.header, "SOPClassUID") == _ENHANCED_US_VOLUME
        and text(file.header, "BurnedInAnnotation") != "YES"
    )


def pixel_size(file: DicomFile, regions: Regions) -> tuple[tuple[float, float], bool]:
    """Width and height of a pixel in mm, and whether the header states them.

    Where all kept regions agree about it that counts, then `PixelSpacing` and what secondary
    captures have in its place. Of images that state their `PixelAspectRatio` alone the width is
    taken for 1 mm.
    """
    found = set()
    header = file.header
    for region in items(header, "SequenceOfUltrasoundRegions") if regions.kept else ():
        units = (whole(region, "PhysicalUnitsXDirection"), whole(region, "PhysicalUnitsYDirection"))
        delta = (number(region, "PhysicalDeltaX"), number(region, "PhysicalDeltaY"))
        if _holds_echoes(region) and units == (_CENTIMETRES, _CENTIMETRES) and all(delta):
            found.add((abs(delta[0] or 0.0) * 10.0, abs(delta[1] or 0.0) * 10.0))
    if len(found) == 1:
        return found.pop(), True
    for source in (header, *(each for key in _GROUPS for each in _measures(header, key))):
        # Between rows, then between columns (PS3.3, 10.7.1.3).
        stated = numbers(source, "PixelSpacing", 2)
        stated = stated or numbers(source, "NominalScannedPixelSpacing", 2)
        if stated and all(1e-4 <= each <= 100.0 for each in stated):
            return (stated[1], stated[0]), True
    ratio = numbers(header, "PixelAspectRatio", 2)  # vertical, then horizontal
    if ratio and min(ratio) > 0.0:
        return (1.0, ratio[0] / ratio[1]), False
    return (1.0, 1.0), False


def _measures(header: Any, key: str) -> list[Any]:
    """What the groups of values of an enhanced object say of its first image's pixels."""
    return [
        each for group in items(header, key)[:1] for each in items(group, "PixelMeasuresSequence")
    ]
