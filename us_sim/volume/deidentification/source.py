"""Sources of an import: images of any format, with the facts of their header.

A scanner writes names, dates and hospitals around the echoes. Where its header has a sequence of
ultrasound regions (PS3.3, C.8.5.5) only its two-dimensional regions of tissue and flow are kept:
grey bars, electrocardiograms, spectra and graphics are blanked with all that lies outside. Where
there is no such sequence, or one that cannot be true, a person has to say what is kept. Of a
MetaImage, NRRD or NIfTI header nothing goes on but where the voxels lie.
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
from us_sim.volume.deidentification.kept_values import dicom_names, kept_values, other_names
from us_sim.volume.deidentification.settings import Rectangle
from us_sim.volume.files.dicom.header import DicomFile, items, number, numbers, text, whole
from us_sim.volume.files.dicom.pixels import GreyImages
from us_sim.volume.files.dicom.placed_images import is_flat, opened_images, placed_images
from us_sim.volume.files.dicom.planes import frame_times, is_cartesian
from us_sim.volume.files.readers import grey_voxels, open_image
from us_sim.volume.files.segments import holds_segments, no_grey_values

_ENHANCED_US_VOLUME = "1.2.840.10008.5.1.4.1.1.6.2"
_REGIONS = "SequenceOfUltrasoundRegions"

Progress = Callable[[float, str], None]
Keep = NDArray[np.bool_] | None
"""(rows, columns) the part of every image that is kept; None: all of it."""
Voxels = Callable[[Keep, Progress | None], NDArray[np.uint8]]  # reads the voxels (i, j, k)
Images = Callable[[Keep], Iterator[NDArray[np.uint8]]]
"""Reads the images (rows, columns), one after another."""
Sides = Callable[[Keep], Iterator[list[NDArray[np.uint8]]]]
"""Some slices across each of the other two axes."""


@dataclass(frozen=True)
class Regions:
    """The regions of echoes that a header states."""

    kept: tuple[Rectangle, ...]
    blanked: int = 0  # regions of other kinds
    doubt: str = ""  # why it is not believed, or that there is none

    def mask(self, rows: int, columns: int) -> NDArray[np.bool_]:
        """(rows, columns) true where an image is kept."""
        made = np.zeros((rows, columns), bool)
        for region in self.kept:
            made[region.slices] = True
        return made


@dataclass(frozen=True, eq=False)
class Source:
    """Images of one volume or of one recording, as they come."""

    kind: str  # of the files, for a person and for provenance
    shape: tuple[int, int, int]  # columns, rows, images
    samples: list[NDArray[np.uint8]]  # some images as they are, from all over
    names: Mapping[str, int]  # elements of the header, and how often each is there
    kept: Mapping[str, str]  # values that may go on, by their fields
    conversions: tuple[str, ...]  # of the stored values
    regions: Regions  # of echoes, as the header says
    placement: NDArray[np.float64] | None  # (4, 4) m, from (column, row, image); None: no volume
    times: list[float]  # s, of images that are no volume
    pixel_mm: tuple[float, float]  # their width and height
    voxels: Voxels | None
    images: Images | None
    sides: Sides | None = None  # of a volume whose axes may be in another order than a scanner's


def _spread(count: int) -> list[int]:
    """Up to 12 numbers from all over a count, of the images in which text is looked for."""
    return sorted({int(n) for n in np.linspace(0, count - 1, min(count, 12))})


def file_source(path: Path, volume: int, spacing: tuple[float, ...] | None) -> Source:
    """The slices of a MetaImage, NRRD or NIfTI volume along its last axis.

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
    count = voxels.shape[2]

    def blanked(keep: Keep, _: Progress | None) -> NDArray[np.uint8]:
        return voxels if keep is None else np.where(keep.T[:, :, None], voxels, np.uint8(0))

    def slices(keep: Keep) -> Iterator[NDArray[np.uint8]]:
        for k in range(count):
            image = np.ascontiguousarray(voxels[:, :, k].T)
            yield image if keep is None else np.where(keep, image, np.uint8(0))

    def sides(keep: Keep) -> Iterator[list[NDArray[np.uint8]]]:
        for axis in (0, 1):
            stack = []
            for n in _spread(voxels.shape[axis]):
                image = np.ascontiguousarray(np.take(voxels, n, axis))
                if keep is not None:
                    image[~np.take(keep, n, 1 - axis)] = 0
                stack.append(image)
            yield stack

    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    kind = {"mha": "MetaImage", "mhd": "MetaImage", "nrrd": "NRRD", "nhdr": "NRRD"}
    return Source(
        kind=f"{kind.get(ending, 'NIfTI')} volume",
        shape=image.shape,
        samples=[np.ascontiguousarray(voxels[:, :, k].T) for k in _spread(count)],
        names=other_names(path),
        kept={},
        conversions=conversions,
        regions=Regions(()),
        placement=placement,
        times=[],
        pixel_mm=(1.0, 1.0),
        voxels=blanked,
        images=slices,
        sides=sides,
    )


def dicom_source(
    paths: Sequence[Path], volume: int, spacing: tuple[float, ...], *, needs_volume: bool
) -> Source:
    """The images of DICOM files.

    Args:
        paths: files of one series.
        volume: which one where there are several in time.
        spacing: mm, width and height of pixels of images that do not state it; or empty.
        needs_volume: refuse images that are no volume, and say why they are none.

    Raises:
        VolumeError: as `opened_images` and `placed_images`.
    """
    images = opened_images(paths)
    placed = placed_images(images, volume) if needs_volume or not is_flat(images) else None
    which = placed.which if placed else images.all
    regions = _regions(images)
    conversions = list(images.conversions)
    times = None  # images of several files have none in common
    if len(images.files) == 1:
        times = frame_times(images.files[0], images.form.frames)
    if placed is None and times is None:
        conversions.append("times of images are not stated: one every 40 ms is assumed")
    pixel, is_stated = pixel_size(images.files[0], regions)
    if spacing and (placed or is_stated):
        raise VolumeError(f"{paths[0]}: states the size of its pixels: leave out --spacing")
    if placed is None and not is_stated:
        pixel = (spacing[0], spacing[1]) if spacing else pixel
        said = "as was said" if spacing else "say it with --spacing X,Y"
        conversions.append(
            f"size of pixels is not stated: {pixel[0]:g} × {pixel[1]:g} mm is written ({said})"
        )
    if placed is not None and placed.volumes > 1:
        conversions.append(f"volume {volume} of {placed.volumes} in time")
    names: Counter[str] = Counter()
    for file in images.files:
        names.update(dicom_names(file.header))
        names["PixelData"] += 1
    return Source(
        kind=_kind(images.files[0]),
        shape=(images.form.columns, images.form.rows, len(which)),
        samples=list(images.images([which[n] for n in _spread(len(which))])),
        names=dict(names),
        kept=_agreed_values(images.files),
        conversions=tuple(conversions),
        regions=regions,
        placement=placed.placement if placed else None,
        times=[n * 0.04 for n in range(len(which))] if times is None else times,
        pixel_mm=pixel,
        voxels=placed.voxels if placed else None,
        images=lambda keep: images.images(which, keep),
    )


def _regions(images: GreyImages) -> Regions:
    """The regions on which all files agree; of kinds of volumes that need none, all of it."""
    if all(_never_holds_text(file) for file in images.files):
        return Regions(())
    rows, columns = images.form.rows, images.form.columns
    every = [ultrasound_regions(file, rows, columns) for file in images.files]
    doubtful = next((regions for regions in every if regions.doubt), None)
    if doubtful is not None:
        return doubtful
    if len({regions.kept for regions in every}) > 1:
        return Regions((), doubt="the files have different ultrasound regions")
    return every[0]


def _never_holds_text(file: DicomFile) -> bool:
    """Whether nothing is burned into images of this kind: Philips' Cartesian export, and the
    Enhanced US Volume (PS3.3, C.8.24.3: Burned In Annotation is NO)."""
    is_enhanced = text(file.header, "SOPClassUID") == _ENHANCED_US_VOLUME
    return is_cartesian(file) or (is_enhanced and text(file.header, "BurnedInAnnotation") != "YES")


def ultrasound_regions(file: DicomFile, rows: int, columns: int) -> Regions:
    """The regions of echoes, if the sequence is there and can be true."""
    listed = items(file.header, _REGIONS)
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
            doubt = f"a region reaches to {right},{bottom} in an image of {columns} × {rows} pixels"
            return Regions((), doubt=doubt)
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


def _holds_echoes(region: Any) -> bool:
    """Whether a region is two-dimensional, and of tissue or colour flow."""
    return whole(region, "RegionSpatialFormat") == 1 and whole(region, "RegionDataType") in (1, 2)


def pixel_size(file: DicomFile, regions: Regions) -> tuple[tuple[float, float], bool]:
    """Width and height of a pixel in mm, and whether the header states them.

    Where all kept regions agree about it that counts, then `PixelSpacing` and its counterparts in
    secondary captures. Of images that state their `PixelAspectRatio` alone the width is taken for
    1 mm.
    """
    found = set()
    header = file.header
    for region in items(header, _REGIONS) if regions.kept else ():
        units = (whole(region, "PhysicalUnitsXDirection"), whole(region, "PhysicalUnitsYDirection"))
        delta = (number(region, "PhysicalDeltaX"), number(region, "PhysicalDeltaY"))
        if _holds_echoes(region) and units == (3, 3) and all(delta):  # centimetres
            found.add((abs(delta[0] or 0.0) * 10.0, abs(delta[1] or 0.0) * 10.0))
    if len(found) == 1:
        return found.pop(), True
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
            return (stated[1], stated[0]), True
    ratio = numbers(header, "PixelAspectRatio", 2)  # vertical, then horizontal
    if ratio and min(ratio) > 0.0:
        return (1.0, ratio[0] / ratio[1]), False
    return (1.0, 1.0), False


def _agreed_values(files: Sequence[DicomFile]) -> dict[str, str]:
    """Values on which all files agree, and a frame of reference that leads nowhere."""
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
    """The standard's name of the kind of files, which is no text of theirs."""
    from pydicom.uid import UID

    uid = text(file.header, "SOPClassUID")
    if is_cartesian(file):
        return "DICOM, Cartesian export of Philips"
    name = UID(uid).name
    return f"DICOM, {name}" if name != uid else "DICOM of an unknown class"
