"""Sources of an import: images of any format, with the facts of their header.

A scanner writes names, dates and hospitals around the echoes. Of its 2D images only the
two-dimensional ultrasound regions of tissue and flow (PS3.3, C.8.5.5) are kept: grey bars,
electrocardiograms, spectra and graphics are blanked with all that lies outside. Each region has a
scale of its own. Of a MetaImage, NRRD or NIfTI header nothing goes on but where the voxels lie.
"""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.deidentification.kept_values import dropped_names, kept_values
from us_sim.volume.deidentification.settings import Rectangle
from us_sim.volume.files.dicom.header import DicomFile, items, number, numbers, text
from us_sim.volume.files.dicom.pixels import GreyImages
from us_sim.volume.files.dicom.placed_images import is_flat, opened_images, placed_images
from us_sim.volume.files.dicom.planes import frame_times, is_cartesian
from us_sim.volume.files.readers import grey_voxels, open_image
from us_sim.volume.files.segments import holds_segments, no_grey_values

Progress = Callable[[float, str], None]
Keep = NDArray[np.bool_] | None
"""(rows, columns) the part of every image that is kept; None: all of it."""
Scale = tuple[float, float]  # mm, width and height of a pixel


@dataclass(frozen=True)
class Region:
    """A region of echoes that a header states."""

    part: Rectangle
    pixel_mm: Scale | None  # None: its header does not state it


@dataclass(frozen=True)
class Regions:
    """All regions of echoes."""

    kept: tuple[Region, ...] = ()
    blanked: int = 0  # regions of other kinds
    doubt: str = ""  # why the header is not believed, or that it has none


@dataclass(frozen=True, eq=False)
class Source:
    """Images of one volume or of one recording, as they come."""

    kind: str  # of the files, for a person and for provenance
    shape: tuple[int, int, int]  # columns, rows, images
    first: NDArray[np.uint8]  # (rows, columns) the first image as it is
    dropped: Mapping[str, int]  # elements of the header that do not go on, and how many of each
    kept: Mapping[str, str]  # values that go on, by their fields
    conversions: tuple[str, ...]  # of the stored values
    regions: Regions  # of echoes, as the header says
    needs_part: bool  # images that may show a name outside the regions
    placement: NDArray[np.float64] | None  # (4, 4) m, from (column, row, image); None: no volume
    times: list[float]  # s, of images that are no volume
    pixel_mm: Scale | None  # of all of an image, where it is stated
    voxels: Callable[[Keep, Progress | None], NDArray[np.uint8]] | None  # reads (i, j, k)
    images: Callable[[Keep], Iterator[NDArray[np.uint8]]] | None  # reads one after another


def file_source(path: Path, volume: int, spacing: tuple[float, ...] | None) -> Source:
    """Open a MetaImage, NRRD or NIfTI volume, whose images are the slices along its last axis.

    Args:
        path: of the file.
        volume: which one where there are several.
        spacing: (3,) mm, of a file that does not state it.

    Raises:
        VolumeError: as `read_volume`, and of a segmentation of 3D Slicer.
    """
    image = open_image(path, layers=True, spacing=spacing)
    if holds_segments(image.texts):
        raise no_grey_values(path)
    image.check(layers=False)
    placement = image.placement()
    voxels, conversions = grey_voxels(image, volume)
    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    kind = {"mha": "MetaImage", "mhd": "MetaImage", "nrrd": "NRRD", "nhdr": "NRRD"}
    return Source(
        kind=f"{kind.get(ending, 'NIfTI')} volume",
        shape=image.shape,
        first=np.ascontiguousarray(voxels[:, :, 0].T),
        dropped={"all of the header but the grid": 1},
        kept={},
        conversions=conversions,
        regions=Regions(),
        needs_part=False,
        placement=placement,
        times=[],
        pixel_mm=None,
        voxels=lambda *_: voxels,
        images=None,
    )


def dicom_source(
    paths: Sequence[Path], volume: int, spacing: tuple[float, ...], *, needs_volume: bool
) -> Source:
    """Open the images of DICOM files.

    Args:
        paths: files of one series.
        volume: which one where there are several in time.
        spacing: mm, width and height of pixels of images that do not state it, and for a volume
            the distance of images; or empty.
        needs_volume: refuse images that are no volume, and say why they are none.

    Raises:
        VolumeError: as `opened_images` and `placed_images`; or the spacing is not that of the file.
    """
    images = opened_images(paths)
    is_volume = needs_volume or not is_flat(images, spacing)
    placed = placed_images(images, volume, spacing) if is_volume else None
    which = placed.which if placed else images.all
    conversions = list(images.conversions)
    times = None  # images of several files have none in common
    if len(images.files) == 1:
        times = frame_times(images.files[0], images.form.frames)
    if placed is None and times is None:
        conversions.append("times of images are not stated: one every 40 ms is assumed")
    if placed is not None and placed.volumes > 1:
        conversions.append(f"volume {volume} of {placed.volumes} in time")
    scales = {_stated_scale(file) for file in images.files}
    if placed is None and len(scales) > 1:
        raise VolumeError(
            f"{paths[0]}: and the other files have pixels of different sizes; import them one "
            f"by one"
        )
    kept = _agreed_values(images.files)
    dropped: Counter[str] = Counter()
    for file in images.files:
        dropped.update(dropped_names(file.header, kept))
    regions = _agreed_regions(images)
    burned = any(text(file.header, "BurnedInAnnotation") == "YES" for file in images.files)
    return Source(
        kind=_kind(images.files[0]),
        shape=(images.form.columns, images.form.rows, len(which)),
        first=next(images.images(which[:1])),
        dropped=dict(dropped),
        kept=kept,
        conversions=tuple(conversions),
        regions=regions,
        needs_part=placed is None or burned,
        placement=placed.placement if placed else None,
        times=[n * 0.04 for n in range(len(which))] if times is None else times,
        pixel_mm=next(iter(scales)),
        voxels=placed.voxels if placed else None,
        images=lambda keep: images.images(which, keep),
    )


def _agreed_regions(images: GreyImages) -> Regions:
    """Return the regions on which all files agree."""
    rows, columns = images.form.rows, images.form.columns
    every = [_ultrasound_regions(file, rows, columns) for file in images.files]
    if len({regions.kept for regions in every}) > 1:
        return Regions(doubt="the files have different ultrasound regions")
    return every[0]


def _ultrasound_regions(file: DicomFile, rows: int, columns: int) -> Regions:
    """Return the regions of echoes, if the sequence is there and can be true."""
    listed = items(file.header, "SequenceOfUltrasoundRegions")
    kept, blanked = [], 0
    for region in listed:
        keys = ("MinX0", "MinY0", "MaxX1", "MaxY1")
        edges = [number(region, f"RegionLocation{key}") for key in keys]
        if any(edge is None for edge in edges):
            return Regions(doubt="a region has no edges")
        left, top, right, bottom = (int(edge or 0) for edge in edges)
        # Some scanners write the first column beyond a region as its last.
        if right > columns or bottom > rows or min(left, top) < 0:
            doubt = f"a region reaches to {right},{bottom} in an image of {columns} × {rows} pixels"
            return Regions(doubt=doubt)
        part = Rectangle(left, top, min(right, columns - 1), min(bottom, rows - 1))
        if min(part.size) < 1:
            return Regions(doubt="a region holds no pixel")
        kinds = number(region, "RegionSpatialFormat"), number(region, "RegionDataType")
        if kinds in ((1, 1), (1, 2)):  # two-dimensional, of tissue or of colour flow
            kept.append(Region(part, _region_scale(region)))
        else:
            blanked += 1
    doubt = "no region is a two-dimensional image of tissue or flow" if not kept else ""
    doubt = doubt if listed else "there is no sequence of ultrasound regions"
    return Regions(tuple(kept), blanked, doubt)


def _region_scale(region: Any) -> Scale | None:
    units = number(region, "PhysicalUnitsXDirection"), number(region, "PhysicalUnitsYDirection")
    x, y = number(region, "PhysicalDeltaX"), number(region, "PhysicalDeltaY")
    if units != (3, 3) or not x or not y:  # centimetres
        return None
    return float(f"{abs(x) * 10.0:.7g}"), float(f"{abs(y) * 10.0:.7g}")


def _stated_scale(file: DicomFile) -> Scale | None:
    """Read `PixelSpacing`, or its counterpart in secondary captures."""
    header = file.header
    measures = [
        each
        for key in ("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence")
        for group in items(header, key)[:1]
        for each in items(group, "PixelMeasuresSequence")
    ]
    for source in (header, *measures):
        # Between rows, then between columns (PS3.3, 10.7.1.3).
        stated = numbers(source, "PixelSpacing", 2)
        stated = stated or numbers(source, "NominalScannedPixelSpacing", 2)
        if stated and all(1e-4 <= each <= 100.0 for each in stated):
            return stated[1], stated[0]
    return None


def _agreed_values(files: Sequence[DicomFile]) -> dict[str, str]:
    """Return values on which all files agree, and a frame of reference that leads nowhere."""
    first, *others = (kept_values(file.header) for file in files)
    agreed = {
        name: value
        for name, value in first.items()
        if all(other.get(name) == value for other in others)
    }
    header = files[0].header
    if text(header, "FrameOfReferenceUID") or text(header, "VolumeFrameOfReferenceUID"):
        # Of random numbers (PS3.5, B.2), and not of the original's digits by any function.
        agreed["frame_of_reference_uid"] = f"2.25.{uuid.uuid4().int}"
    return agreed


def _kind(file: DicomFile) -> str:
    """Return the standard's name of the kind of files, which is no text of theirs."""
    from pydicom.uid import UID

    uid = text(file.header, "SOPClassUID")
    if is_cartesian(file):
        return "DICOM, Cartesian export of Philips"
    name = UID(uid).name
    return f"DICOM, {name}" if name != uid else "DICOM of an unknown class"
