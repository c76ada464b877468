"""Sources of an import: images of any format, with their place or times.

A scanner writes names, dates and hospitals around the echoes. Of its 2D images only the
two-dimensional ultrasound regions of tissue and flow (PS3.3, C.8.5.5) are kept: grey bars,
electrocardiograms, spectra and graphics are blanked with all that lies outside. Each region has a
scale of its own. Of a header nothing goes on but where and when the images are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.deidentification.settings import Rectangle
from us_sim.volume.files.dicom.header import DicomFile, groups_of, items, number, numbers, text
from us_sim.volume.files.dicom.pixels import ImageFormat
from us_sim.volume.files.dicom.placed_images import is_flat, opened_images, placed_images
from us_sim.volume.files.dicom.planes import frame_times
from us_sim.volume.files.readers import open_image
from us_sim.volume.files.segments import holds_segments, no_grey_values
from us_sim.volume.files.stored_image import grey_voxels

Progress = Callable[[float, str], None]
Keep = NDArray[np.bool_] | None
"""(rows, columns) the part of every image that is kept; None: all of it."""
Scale = tuple[float, float]  # mm, width and height of a pixel


@dataclass(frozen=True)
class Region:
    """A region of echoes that a header states."""

    part: Rectangle
    pixel_mm: Scale | None  # None: its header does not state it


@dataclass(frozen=True, eq=False)
class Source:
    """Images of one volume or of one recording, as they come."""

    shape: tuple[int, int, int]  # columns, rows, images
    first: NDArray[np.uint8]  # (rows, columns) the first image as it is
    conversions: tuple[str, ...]  # of the stored values
    placement: NDArray[np.float64] | None  # (4, 4) m, from (column, row, image); None: no volume
    voxels: Callable[[Keep, Progress | None], NDArray[np.uint8]] | None  # reads (i, j, k)
    images: Callable[[Keep], Iterator[NDArray[np.uint8]]] | None = None  # reads one after another
    regions: tuple[Region, ...] = ()  # of echoes, as the header says
    doubt: str = ""  # why it states none, or is not believed
    needs_part: bool = False  # images that may show a name outside the regions
    times: Sequence[float] = ()  # s, of images that are no volume
    pixel_mm: Scale | None = None  # of all of an image, where it is stated


def file_source(path: Path, volume: int, spacing: tuple[float, ...] | None) -> Source:
    """Open a MetaImage, NRRD or NIfTI volume, whose images are the slices along its last axis.

    Args:
        path: of the file.
        volume: which one where there are several.
        spacing: (3,) mm, of a file that does not state it.
    """
    image = open_image(path, layers=True, spacing=spacing)
    if holds_segments(image.texts):
        raise no_grey_values(path)
    image.check(layers=False)
    placement = image.placement()
    voxels, conversions = grey_voxels(image, volume)
    first = np.ascontiguousarray(voxels[:, :, 0].T)
    return Source(image.shape, first, conversions, placement, lambda *_: voxels)


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
    """
    images = opened_images(paths)
    is_volume = needs_volume or not is_flat(images, spacing)
    placed = placed_images(images, volume, spacing) if is_volume else None
    which = placed.which if placed else images.all
    conversions = list(images.conversions)
    # Images of several files have no times in common.
    times = frame_times(images.files[0], images.form.frames) if len(images.files) == 1 else None
    if placed is None and times is None:
        conversions.append("times of images are not stated: one every 40 ms is assumed")
    if placed is not None and placed.volumes > 1:
        conversions.append(f"volume {volume} of {placed.volumes} in time")
    scales = {_stated_scale(file) for file in images.files}
    if placed is None and len(scales) > 1:
        raise VolumeError(
            f"{paths[0]}: and the other files have pixels of different sizes; import each by itself"
        )
    regions = {_ultrasound_regions(file, images.form) for file in images.files}
    burned = any(text(file.header, "BurnedInAnnotation") == "YES" for file in images.files)
    echoes, doubt = regions.pop()
    return Source(
        (images.form.columns, images.form.rows, len(which)),
        next(images.images(which[:1])),
        tuple(conversions),
        placed.placement if placed else None,
        placed.voxels if placed else None,
        lambda keep: images.images(which, keep),
        () if regions else echoes,
        "the files have different ultrasound regions" if regions else doubt,
        placed is None or burned,
        [n * 0.04 for n in range(len(which))] if times is None else times,
        next(iter(scales)),
    )


def _ultrasound_regions(file: DicomFile, form: ImageFormat) -> tuple[tuple[Region, ...], str]:
    """Return the regions of echoes; none, with the reason, if one of the header's cannot be."""
    kept = []
    for region in items(file.header, "SequenceOfUltrasoundRegions"):
        keys = ("MinX0", "MinY0", "MaxX1", "MaxY1")
        found = [number(region, f"RegionLocation{key}") for key in keys]
        edges = [-1 if each is None else int(each) for each in found]
        # Some scanners write the first column beyond a region as its last.
        ends = (form.columns - 1, form.rows - 1)
        part = Rectangle(edges[0], edges[1], *map(min, edges[2:], ends))
        is_within = edges[2] <= form.columns and edges[3] <= form.rows
        if min(edges) < 0 or min(part.size) < 1 or not is_within:
            doubt = f"a region is {edges} in an image of {form.columns} × {form.rows} pixels"
            return (), doubt
        kinds = number(region, "RegionSpatialFormat"), number(region, "RegionDataType")
        if kinds in ((1, 1), (1, 2)):  # two-dimensional, of tissue or of colour flow
            kept.append(Region(part, _region_scale(region)))
    return tuple(kept), "" if kept else "there is no ultrasound region of tissue or flow"


def _region_scale(region: Any) -> Scale | None:
    units = number(region, "PhysicalUnitsXDirection"), number(region, "PhysicalUnitsYDirection")
    x, y = number(region, "PhysicalDeltaX"), number(region, "PhysicalDeltaY")
    if units != (3, 3) or not x or not y:  # centimetres
        return None
    return float(f"{abs(x) * 10.0:.7g}"), float(f"{abs(y) * 10.0:.7g}")


def _stated_scale(file: DicomFile) -> Scale | None:
    """Read `PixelSpacing`, or its counterpart in secondary captures."""
    groups = groups_of(file.header, int(number(file.header, "NumberOfFrames") or 1))[0]
    measures = (each for group in groups for each in items(group, "PixelMeasuresSequence"))
    for source in (file.header, *measures):
        # Between rows, then between columns (PS3.3, 10.7.1.3).
        for key in ("PixelSpacing", "NominalScannedPixelSpacing"):
            stated = numbers(source, key, 2)
            if stated and all(1e-4 <= each <= 100.0 for each in stated):
                return stated[1], stated[0]
    return None
