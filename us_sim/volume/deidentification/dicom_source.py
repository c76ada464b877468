"""DICOM files as a source of an import."""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.deidentification.header_names import dicom_names
from us_sim.volume.deidentification.kept_part import (
    Regions,
    never_holds_text,
    pixel_size,
    ultrasound_regions,
)
from us_sim.volume.deidentification.kept_values import kept_values
from us_sim.volume.deidentification.source import Source, spread
from us_sim.volume.files.dicom.frame_times import frame_times
from us_sim.volume.files.dicom.grey import GreyImages
from us_sim.volume.files.dicom.placed_images import is_flat, opened_images, placed_images
from us_sim.volume.files.dicom.values import text
from us_sim.volume.files.dicom.vendors import is_cartesian

_ASSUMED = 0.04  # s, between images of which nothing says it


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
    times = _times(images)
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

    def read(keep: NDArray[np.bool_] | None) -> Iterator[NDArray[np.uint8]]:
        return images.images(which, keep)

    return Source(
        kind=_kind(images),
        shape=(images.form.columns, images.form.rows, len(which)),
        samples=list(images.images([which[n] for n in spread(len(which))])),
        names=_names(images),
        kept=_values(images),
        conversions=tuple(conversions),
        regions=regions,
        placement=placed.placement if placed else None,
        times=[n * _ASSUMED for n in range(len(which))] if times is None else times,
        pixel_mm=pixel,
        voxels=placed.voxels if placed else None,
        images=read,
    )


def _regions(images: GreyImages) -> Regions:
    """The regions on which all files agree; of kinds of volumes that need none, all of it."""
    if all(never_holds_text(file) or is_cartesian(file) for file in images.files):
        return Regions(())
    rows, columns = images.form.rows, images.form.columns
    every = [ultrasound_regions(file, rows, columns) for file in images.files]
    doubtful = next((regions for regions in every if regions.doubt), None)
    if doubtful is not None:
        return doubtful
    if len({regions.kept for regions in every}) > 1:
        return Regions((), doubt="the files have different ultrasound regions")
    return every[0]


def _times(images: GreyImages) -> list[float] | None:
    """Of all images; those of several files have none in common."""
    if len(images.files) > 1:
        return None
    return frame_times(images.files[0], images.form.frames)


def _values(images: GreyImages) -> dict[str, str]:
    """Values on which all files agree, and a frame of reference that leads nowhere."""
    first, *others = (kept_values(file.header) for file in images.files)
    agreed = {
        name: value
        for name, value in first.items()
        if all(other.get(name) == value for other in others)
    }
    header = images.files[0].header
    if text(header, "FrameOfReferenceUID") or text(header, "VolumeFrameOfReferenceUID"):
        # Of random numbers (PS3.5, B.2), and not of the original's digits by any function.
        agreed["frame_of_reference_uid"] = f"2.25.{uuid.uuid4().int}"
    return agreed


def _names(images: GreyImages) -> dict[str, int]:
    names: Counter[str] = Counter()
    for file in images.files:
        names.update(dicom_names(file.header))
        names["PixelData"] += 1
    return dict(names)


def _kind(images: GreyImages) -> str:
    """The standard's name of what the files are, which is no text of theirs."""
    from pydicom.uid import UID

    uid = text(images.files[0].header, "SOPClassUID")
    if is_cartesian(images.files[0]):
        return "DICOM, Cartesian export of Philips"
    name = UID(uid).name
    return f"DICOM, {name}" if name != uid else "DICOM of an unknown class"
